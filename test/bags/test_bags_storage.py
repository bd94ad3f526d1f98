"""Storage files as recorders, tools and accidents leave them, and as an enemy makes them."""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
import subprocess
import sys

import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from csas_shadow_ros.bags import BagReader, BagWriter, read_run
from csas_shadow_ros.bags.index import BagIndex
from csas_shadow_ros.bags.metadata import read_metadata
from csas_shadow_ros.core.errors import BagError
from csas_shadow_ros.nodes.playing import BagViews, stage_of_bag
from csas_shadow_ros.run_bag import describe_run
from msg_adapters.messages import typestore

VIEWS = 12
START_NS = 1_700_000_000_000_000_000


def messages(topic="/csas/progress", count=VIEWS, step_s=1):
    """Messages as (topic, type, time, cdr): small, each with bytes of its own."""
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    for n in range(count):
        when = START_NS + n * step_s * 1_000_000_000
        sec, nanosec = divmod(when, 1_000_000_000)
        yield topic, kind, when, b"\0\1\0\0" + struct.pack("<iIIII", sec, nanosec, 1, 0, 0) + bytes([n] * 60)


def content(path, **options):
    return [
        (m.topic, m.type_name, m.log_time_ns, bytes(m.cdr)) for m in BagReader(path, **options).messages()
    ]


def write(path, what, **options):
    with BagWriter(path, **options) as writer:
        for topic, kind, when, cdr in what:
            writer.write(topic, cdr, when, type_name=kind)
    return path


def edit(path, **changes):
    """Change metadata.yaml."""
    document = yaml.safe_load((path / "metadata.yaml").read_text())
    document["rosbag2_bagfile_information"].update(changes)
    (path / "metadata.yaml").write_text(yaml.safe_dump(document, sort_keys=False))


def split(path, groups, *, metadata=True):
    """A bag of several files, as a recorder that splits leaves it."""
    path.mkdir()
    for n, group in enumerate(groups):
        part = write(path.with_name(f"part_{n}"), group, file_name=f"{path.name}_{n}.mcap")
        shutil.move(part / f"{path.name}_{n}.mcap", path)
        if n == 0 and metadata:
            shutil.move(part / "metadata.yaml", path)
        shutil.rmtree(part)
    if metadata:
        names = [f"{path.name}_{n}.mcap" for n in range(len(groups))]
        edit(path, relative_file_paths=names, message_count=sum(map(len, groups)))
    return path


def of_rosbags(path, plugin, mode=None):
    writer = RosbagsWriter(path, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, when, cdr in messages():
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore())
            writer.write(connections[topic], when, cdr)
    return path


# --- content counts, not what metadata.yaml says of it


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("mode", [None, CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize(
    "change", ["quality of service", "types' hashes", "nothing left", "no metadata.yaml"]
)
def test_a_bag_reads_the_same_whatever_its_metadata_says(tmp_path, plugin, mode, change):
    path = of_rosbags(tmp_path / "bag", plugin, mode)
    document = yaml.safe_load((path / "metadata.yaml").read_text())
    information = document["rosbag2_bagfile_information"]
    for topic in information["topics_with_message_count"]:
        if change == "quality of service":
            topic["topic_metadata"]["offered_qos_profiles"] = []
        elif change == "types' hashes":
            topic["topic_metadata"]["type_description_hash"] = "RIHS01_" + "0" * 64
    if change == "nothing left":
        document = {
            "rosbag2_bagfile_information": {"relative_file_paths": information["relative_file_paths"]}
        }
    (path / "metadata.yaml").write_text(yaml.safe_dump(document))
    if change == "no metadata.yaml":
        (path / "metadata.yaml").unlink()
    reader = BagReader(path)
    assert content(path) == list(messages())
    assert reader.message_count == VIEWS
    assert reader.complete == (change != "no metadata.yaml")
    for file in path.glob("bag*"):
        assert content(file) == list(messages()), f"{file.name} alone"


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("case", ["as listed", "decompressed since", "compressed since", "both there"])
def test_a_file_compressed_as_a_whole_is_found_whatever_became_of_it(tmp_path, compression, case):
    path = write(tmp_path / "bag", messages())
    plain = path / "bag_0.mcap"
    packed = path / f"bag_0.mcap.{compression}"
    pack = zstandard.ZstdCompressor().compress if compression == "zstd" else lz4.frame.compress
    packed.write_bytes(pack(plain.read_bytes()))
    listed = {"compressed since": plain}.get(case, packed)
    edit(path, compression_mode="FILE", compression_format=compression, relative_file_paths=[listed.name])
    if case == "both there":
        (path / "metadata.yaml").unlink()
    elif case == "decompressed since":
        packed.unlink()
    else:
        plain.unlink()
    assert content(path) == list(messages())


def test_a_file_that_was_decompressed_by_hand_is_read_although_the_metadata_call_it_compressed(tmp_path):
    path = write(tmp_path / "bag", messages())
    edit(path, compression_mode="FILE", compression_format="zstd")
    reader = BagReader(path)
    assert content(path) == list(messages())
    assert (reader.complete, reader.problems) == (True, [])


def test_a_file_whose_compression_was_cut_off_is_read_as_far_as_it_goes(tmp_path):
    rng = np.random.default_rng(0)
    noise = [(t, k, w, cdr + rng.bytes(300_000)) for t, k, w, cdr in messages(count=40)]
    path = write(tmp_path / "bag", noise, compress=False)
    plain = path / "bag_0.mcap"
    packed = zstandard.ZstdCompressor(level=1).compress(plain.read_bytes())
    plain.unlink()
    (path / "bag_0.mcap.zstd").write_bytes(packed[: len(packed) // 2])
    edit(path, compression_mode="FILE", relative_file_paths=["bag_0.mcap.zstd"])
    reader = BagReader(path)
    assert not reader.complete
    assert "footer is missing" in "\n".join(reader.problems)
    read = list(content(path))
    assert read == noise[: len(read)]
    assert 10 < len(read) < 30


# --- sqlite3


def killed_recorder(path):
    """What is left of a sqlite3 recorder that was killed: half in the database, half in its -wal file."""
    path.mkdir()
    work = path.with_name("work.db3")
    db = sqlite3.connect(work)
    db.execute("PRAGMA journal_mode=WAL")
    db.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
    )
    db.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
        " data BLOB NOT NULL)"
    )
    db.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    for n, (topic, kind, when, cdr) in enumerate(messages()):
        if n == 0:
            db.execute("INSERT INTO topics VALUES(1, ?, ?, 'cdr', '')", (topic, kind))
        db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", (when, cdr))
        db.commit()
        if n == VIEWS // 2:
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    for end in ("", "-wal"):
        shutil.copy(f"{work}{end}", path / f"bag_0.db3{end}")
    db.close()
    return path


@pytest.mark.parametrize("lone", [False, True])
def test_what_a_killed_recorder_left_in_its_wal_file_is_read_and_nothing_is_left_beside_it(tmp_path, lone):
    path = killed_recorder(tmp_path / "bag")
    before = {p.name: p.read_bytes() for p in path.iterdir()}
    assert content(path / "bag_0.db3" if lone else path) == list(messages())
    reader = BagReader(path)
    assert not reader.complete
    assert any("its recorder was killed" in line for line in reader.problems)
    assert {p.name: p.read_bytes() for p in path.iterdir()} == before


def test_a_killed_recorders_bag_is_read_from_a_folder_that_cannot_be_written(tmp_path):
    path = killed_recorder(tmp_path / "bag")
    path.chmod(0o555)
    try:
        assert content(path) == list(messages())
    finally:
        path.chmod(0o755)


ENDLESS = {
    "a view": "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
    " SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(1000000) AS data FROM n",
    "a computed column": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
    " data AS (zeroblob(900000000)))",
    "no table": "CREATE TABLE others(id)",
    "no column": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, data BLOB)",
}


@pytest.mark.parametrize("how", ENDLESS)
def test_a_database_that_is_no_plain_recording_is_refused(tmp_path, how):
    db = sqlite3.connect(tmp_path / "x.db3")
    db.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
    db.execute("INSERT INTO topics VALUES(1, '/csas/track', 'nav_msgs/msg/Path', 'cdr')")
    db.execute(ENDLESS[how])
    if how == "a computed column":
        db.execute("INSERT INTO messages VALUES(1, 1, 1)")
    db.commit()
    db.close()
    with pytest.raises(BagError, match="expected a rosbag2 recording"):
        BagReader(tmp_path / "x.db3")


# --- MCAP without what the format allows to leave out


class _NoCounts(dict):
    """Counts that the writer keeps and does not write."""

    def items(self):
        return {}.items()

    def __len__(self):
        return 0


@pytest.mark.parametrize("chunks", [True, False])
def test_an_mcap_without_counts_by_channel_holds_what_it_holds(tmp_path, chunks):
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, chunk_size=300, use_chunking=chunks)
        writer.start(profile="ros2", library="other")
        channel = None
        for topic, kind, when, cdr in messages("/csas/likelihood/camera_info"):
            if channel is None:
                channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
            writer.add_message(channel, when, cdr, when)
        statistics = writer._Writer__statistics
        statistics.channel_message_counts = _NoCounts(statistics.channel_message_counts)
        writer.finish()
    reader = BagReader(path)
    assert reader.message_count == VIEWS
    assert content(path) == list(messages("/csas/likelihood/camera_info"))
    assert (reader.complete, reader.problems) == (True, [])
    BagIndex(reader)  # what was walked once is found at will


# --- split bags

SPOILT = {
    "missing": None,
    "0 bytes": b"",
    "NULs": bytes(4096),
    "half a magic": b"\x89MCA",
    "the magic alone": b"\x89MCAP0\r\n",
    "text": b"no bag at all",
}


@pytest.mark.parametrize("what", SPOILT)
@pytest.mark.parametrize("metadata", [True, False])
def test_a_file_of_a_split_bag_that_is_spoilt_costs_its_own_messages_and_is_told(tmp_path, what, metadata):
    groups = [[m] for m in messages()]
    path = split(tmp_path / "bag", groups, metadata=metadata)
    file = path / "bag_5.mcap"
    file.unlink()
    if SPOILT[what] is not None:
        file.write_bytes(SPOILT[what])
    reader = BagReader(path)
    expected = [m for n, m in enumerate(messages()) if n != 5]
    assert content(path) == expected
    assert not reader.complete
    # Without metadata.yaml nobody knows of a file that is not there.
    assert any("bag_5.mcap" in line for line in reader.problems) == (metadata or what != "missing")


def test_a_bag_all_of_whose_files_are_spoilt_is_refused_by_the_name_of_one(tmp_path):
    path = split(tmp_path / "bag", [[m] for m in messages()])
    for file in path.glob("*.mcap"):
        file.write_bytes(b"")
    with pytest.raises(BagError, match=r"bag_0\.mcap is empty \(0 bytes\)"):
        BagReader(path)


def test_a_storage_file_that_is_not_listed_is_not_mixed_in_and_is_told(tmp_path):
    path = split(tmp_path / "bag", [[m] for m in messages()])
    names = [f"bag_{n}.mcap" for n in range(VIEWS) if n != 5]
    edit(path, relative_file_paths=names, message_count=len(names))
    reader = BagReader(path)
    assert content(path) == [m for n, m in enumerate(messages()) if n != 5]
    assert reader.problems == ["bag_5.mcap is not listed in metadata.yaml; it is not read"]


@pytest.mark.parametrize(
    "name", ["../other/other_0.mcap", "{}/other/other_0.mcap", "./../other/other_0.mcap"]
)
def test_a_name_in_metadata_leads_to_no_file_beside_the_bag(tmp_path, name):
    other = write(tmp_path / "other", messages("/csas/likelihood/camera_info"))
    assert (other / "other_0.mcap").is_file()
    path = write(tmp_path / "bag", messages())
    (path / "bag_0.mcap").rename(path / "bag_1.mcap")
    edit(path, relative_file_paths=[name.format(tmp_path), "bag_1.mcap"])
    reader = BagReader(path)
    assert content(path) == list(messages())
    assert reader.problems == ["other_0.mcap, listed in metadata.yaml, is missing"]


def test_messages_that_metadata_tells_of_and_the_files_lack_are_told(tmp_path):
    path = write(tmp_path / "bag", messages())
    edit(path, message_count=36)
    assert any("lists 36 messages; the files hold 12" in line for line in BagReader(path).problems)


@pytest.mark.parametrize("order", ["names without zeros", "every other one", "reversed"])
def test_files_of_a_split_bag_are_read_in_time_whatever_their_order(tmp_path, order):
    what = list(messages("/csas/likelihood/camera_info"))
    groups = {
        "names without zeros": [[m] for m in what],
        "every other one": [what[::2], what[1::2]],
        "reversed": [what[6:], what[:6]],
    }[order]
    path = split(tmp_path / "bag", groups, metadata=order != "names without zeros")
    assert content(path) == what
    views = BagViews(BagReader(path), "likelihood")
    assert list(views.times.values()) == [when for _, _, when, _ in what]


# --- namespaces


def run_topics(namespace):
    return [
        (f"{namespace}/{name}", kind, START_NS, b"\0\1\0\0" + bytes(64))
        for name, kind in (
            ("image", "sensor_msgs/msg/Image"),
            ("camera_info", "sensor_msgs/msg/CameraInfo"),
            ("track", "nav_msgs/msg/Path"),
        )
    ]


@pytest.mark.parametrize("stray", ["progress", "target", "voxel_grid/image"])
def test_a_stray_topic_in_the_usual_namespace_hides_no_run_in_another(tmp_path, stray):
    path = write(tmp_path / "bag", [*messages(f"/csas/{stray}"), *run_topics("/auv1/sas")])
    assert BagReader(path).namespace == "/auv1/sas"


def test_cameras_beside_a_sonar_are_no_runs(tmp_path):
    cameras = [m for name in ("/left", "/right") for m in run_topics(name) if not m[0].endswith("track")]
    path = write(tmp_path / "bag", [*cameras, *run_topics("/auv1/sas")])
    assert BagReader(path).namespace == "/auv1/sas"


def test_a_run_beside_one_in_the_usual_namespace_must_be_named(tmp_path):
    path = write(tmp_path / "bag", [*run_topics("/csas"), *run_topics("/auv1/sas")])
    with pytest.raises(BagError, match="holds topics of /csas and of /auv1/sas; expected one run: name"):
        BagReader(path)
    assert stage_of_bag(BagReader(path, "/auv1/sas")) == "image"


def test_a_channel_of_another_encoding_on_a_topic_of_the_contract_is_left_out_and_told(tmp_path):
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="other")
        schema = writer.register_schema("foxglove.PosesInFrame", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/csas/progress", "json", schema), 1, b"{}", 1)
        for topic, kind, when, cdr in messages():
            schema = writer.register_schema(kind, "ros2msg", b"")
            writer.add_message(writer.register_channel(topic, "cdr", schema), when, cdr, when)
        writer.finish()
    reader = BagReader(path)
    assert content(path) == list(messages())
    assert reader.topics["/csas/progress"].type_name == "diagnostic_msgs/msg/DiagnosticArray"
    assert reader.problems == []
    assert len(list(reader.messages(["progress"]))) == VIEWS
    assert reader.problems == ["/csas/progress is encoded as 'json'; expected cdr: left out"]


# --- what costs more than it is worth

#: More than Python, numpy and numba take, and less than any of the bombs.
_MEMORY_BYTES = 1 << 30
_OPEN = """
import resource, sys
from pathlib import Path
from csas_shadow_ros.bags import BagReader
from csas_shadow_ros.core.errors import BagError
resource.setrlimit(resource.RLIMIT_AS, ({memory}, {memory}))
try:
    reader = BagReader(sys.argv[1])
    for message in reader.messages():
        message.cdr
except BagError as error:
    print(error)
else:
    print(*reader.problems, sep="\\n")
"""


def told_in_little_memory(path):
    """Read a bag in a process of its own with a gigabyte; return what it said of it."""
    code = _OPEN.format(memory=_MEMORY_BYTES)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=60, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def chunk(compression, data, size):
    name = compression.encode()
    body = struct.pack("<QQQI", 0, 1, size, 0) + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


def mcap_of(path, *records):
    header = b"\x01" + struct.pack("<QII", 8, 0, 0)
    end = b"\x0f" + struct.pack("<QI", 4, 0) + b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0)
    path.write_bytes(b"\x89MCAP0\r\n" + header + b"".join(records) + end + b"\x89MCAP0\r\n")
    return path


_BOMB_BYTES = 3 << 29


def zeros(compression, *, told=True):
    """A frame of 1.5 GB of zeros."""
    piece, out = bytes(1 << 24), b""
    if compression == "zstd":
        packer = zstandard.ZstdCompressor(level=1).compressobj(size=_BOMB_BYTES if told else -1)
        out = b"".join(packer.compress(piece) for _ in range(_BOMB_BYTES >> 24)) + packer.flush()
        return out
    with lz4.frame.LZ4FrameCompressor() as packer:
        out = packer.begin(_BOMB_BYTES if told else 0)
        return out + b"".join(packer.compress(piece) for _ in range(_BOMB_BYTES >> 24)) + packer.flush()


@pytest.fixture(scope="module", params=["zstd", "lz4"])
def bomb(request):
    return request.param, zeros(request.param), zeros(request.param, told=False)


@pytest.mark.parametrize("claim", [_BOMB_BYTES, 1000, 0, 1 << 62])
def test_a_chunk_takes_no_more_memory_than_recordings_unfold_to(tmp_path, bomb, claim):
    compression, told, untold = bomb
    path = mcap_of(tmp_path / "x.mcap", chunk(compression, told, claim), chunk(compression, untold, claim))
    assert told_in_little_memory(path).count("damaged at byte") == 2


def test_a_whole_file_or_a_message_takes_no_more_either(tmp_path, bomb):
    compression, told, untold = bomb
    for name, data in (("told", told), ("untold", untold)):
        path = tmp_path / f"{name}.mcap.{compression}"
        path.write_bytes(data)
        assert "unfolds to more than" in told_in_little_memory(path)
    if compression == "zstd":
        with (tmp_path / "m.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2", library="other")
            channel = writer.register_channel(
                "/csas/track", "cdr", writer.register_schema("x/msg/X", "", b"")
            )
            for data in (told, untold):
                writer.add_message(channel, 1, data, 1)
            writer.finish()
        assert told_in_little_memory(tmp_path / "m.mcap").count("it is lost") == 2


def test_many_messages_in_few_bytes_and_many_bombs_in_one_file_are_refused(tmp_path):
    empty = b"\x05" + struct.pack("<QHIQQ", 22, 1, 0, 0, 0)
    records = empty * 1_000_000
    one = chunk("zstd", zstandard.compress(records), len(records))
    path = mcap_of(tmp_path / "messages.mcap", one)
    assert "holds more messages than that" in told_in_little_memory(path)
    size = 60_000_000
    small = chunk("zstd", zstandard.compress(b"\x90" + struct.pack("<Q", size - 9) + bytes(size - 9)), size)
    path = mcap_of(tmp_path / "bombs.mcap", *[small] * 400)
    assert "the rest is lost" in told_in_little_memory(path)


# --- metadata.yaml

_A_BOMB = "\n".join(
    ["  custom_data:", "    a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    + [f"    a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
)
BAD_METADATA = {
    "aliases that unfold": (
        lambda text: text.replace("  custom_data: null", _A_BOMB),
        "unfold without bounds",
    ),
    "100 000 brackets": (lambda _: "[" * 100_000, "cannot be read"),
    "100 000 braces": (lambda _: "{a: " * 100_000, "cannot be read"),
    "deep blocks": (lambda _: "\n".join(" " * n + "a:" for n in range(900)), "nests deeper than 32"),
    "an alias of itself": (lambda text: text.replace("custom_data: null", "custom_data: &a [*a]"), "itself"),
    "NULs": (lambda _: "\0" * 1_000_000, "cannot be read"),
    "a huge text": (lambda text: text + "  more: " + "x" * 3_000_000, "larger than"),
    "a list": (lambda _: "- a", "cannot be read"),
    "nothing": (lambda _: "", "cannot be read"),
    "numbers for names": (lambda text: text.replace("- bag_0.mcap", "- 7"), "cannot be read"),
    "a Python object": (
        lambda text: f"{text}  evil: !!python/object/apply:os.system [true]\n",
        "cannot be read",
    ),
}


@pytest.mark.parametrize("how", BAD_METADATA)
def test_metadata_that_are_no_metadata_are_told_in_one_line_and_the_files_are_read(tmp_path, how):
    change, reason = BAD_METADATA[how]
    path = write(tmp_path / "bag", messages())
    text = (path / "metadata.yaml").read_text()
    assert change(text) != text
    (path / "metadata.yaml").write_text(change(text))
    reader = BagReader(path)
    assert content(path) == list(messages())
    (line,) = reader.problems
    assert reason in line
    assert len(line) < 300
    assert "\n" not in line
    assert not reader.complete
    assert describe_run(read_run(path))["metadata"] is None


def test_what_metadata_hold_besides_json_is_told_as_text(tmp_path):
    path = write(tmp_path / "bag", messages())
    text = (path / "metadata.yaml").read_text()
    odd = "custom_data: {a: 2026-01-02, b: .nan, 3: !!binary aGk=, d: !!set {x}, e: &q [1], f: *q}"
    (path / "metadata.yaml").write_text(text.replace("custom_data: null", odd))
    custom = read_metadata(path).information["custom_data"]
    assert custom == {"a": "2026-01-02", "b": "nan", "3": "b'hi'", "d": ["x"], "e": [1], "f": [1]}


# --- what is no file


@pytest.mark.parametrize("which", ["bag_0.mcap", "metadata.yaml", "alone"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "circle"])
def test_what_has_no_end_is_refused_and_not_waited_for(tmp_path, which, kind):
    path = write(tmp_path / "bag", messages())
    file = path / which if which != "alone" else tmp_path / "alone.mcap"
    file.unlink(missing_ok=True)
    match kind:
        case "pipe":
            os.mkfifo(file)
        case "device":
            file.symlink_to("/dev/zero")
        case "folder":
            file.mkdir()
        case "circle":
            file.symlink_to(file)
    if which == "metadata.yaml":
        assert content(path) == list(messages())
        assert not BagReader(path).complete
    else:
        with pytest.raises(
            BagError, match=r"expected a file|there is no bag|no storage file|symbolic|holds no"
        ):
            BagReader(path if which != "alone" else file)
