"""Runs in bags: what is written is read, by us and by others; damage is named and survived."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import Reader as RosbagsReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from csas_shadow_ros.bags import BagReader, BagWriter, copy, read_run, write_run
from csas_shadow_ros.core.errors import AdapterError, BagError, CsasError
from csas_shadow_ros.core.geometry import (
    Acoustics,
    CoherentImage,
    GroundGrid,
    ShadowCamera,
    Track,
    View,
    ViewInfo,
    view_ground_to_pixel,
)
from csas_shadow_ros.core.sectors.sector import Sector, image_from_sectors
from msg_adapters import RosbagsMessages, coherent_image_to_msgs, track_to_msg, view_to_msgs
from msg_adapters.messages import typestore

START_NS = 1_700_000_000_000_000_000
ACOUSTICS = Acoustics(120e3, 40e3, 1500.0, -1)
FACTORY = RosbagsMessages()


def speckle(shape, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)


@pytest.fixture
def image():
    return CoherentImage(speckle((40, 30)), GroundGrid.centred(40, 30, 0.005), ACOUSTICS, START_NS + 5)


@pytest.fixture
def track():
    aspects = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    positions = np.column_stack([75 * np.cos(aspects), 75 * np.sin(aspects), np.full(360, 18.0)])
    return Track(START_NS + np.arange(360) * 1_000_000_000, positions)


def view(degrees, stage="likelihood"):
    aspect = math.radians(degrees)
    sonar = (75 * math.cos(aspect), 75 * math.sin(aspect), 18.0)
    camera = ShadowCamera.from_ground(view_ground_to_pixel(aspect, 0.02, 8, 9, (0, 0)), sonar, 8, 9)
    rng = np.random.default_rng(degrees)
    pixels = rng.random((8, 9)).astype(np.float32)
    if stage == "sub_aperture":
        pixels = speckle((8, 9), degrees)
    elif stage == "shadow_mask":
        pixels = (pixels > 0.5).astype(np.uint8) * 255
    info = ViewInfo(START_NS + degrees * 1_000_000_000, camera, ACOUSTICS, aspect, math.radians(12))
    return View(info, pixels)


def same_image(a, b):
    np.testing.assert_array_equal(a.pixels, b.pixels)
    assert (a.acoustics, a.stamp_ns, a.grid.shape) == (b.acoustics, b.stamp_ns, b.grid.shape)


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("encoding", ["32FC2", "64FC2"])
def test_a_run_survives_the_bag(tmp_path, image, track, encoding, compress):
    path = write_run(tmp_path / "run", image, track, encoding=encoding, compress=compress)
    run = read_run(path)
    same_image(run.image, image)
    assert run.image.pixels.dtype == (np.complex128 if encoding == "64FC2" else np.complex64)
    np.testing.assert_array_equal(run.track.positions_m, track.positions_m)
    np.testing.assert_array_equal(run.track.stamps_ns, track.stamps_ns)
    assert run.problems == []
    assert run.counts == {"image": 1}


@pytest.mark.parametrize(("encoding", "limit"), [("8SC2", 127), ("16SC2", 32767)])
def test_integers_fill_their_range_without_clipping(tmp_path, image, track, encoding, limit):
    pixels = read_run(write_run(tmp_path / "run", image, track, encoding=encoding)).image.pixels
    parts = np.concatenate([pixels.real, pixels.imag])
    assert np.abs(parts).max() == limit
    scale = limit / max(np.abs(image.pixels.real).max(), np.abs(image.pixels.imag).max())
    assert np.abs(pixels - image.pixels * scale).max() <= np.sqrt(0.5) * (1 + 1e-4)


def test_sectors_survive_and_sum_to_the_image(tmp_path, image, track):
    x, y = image.grid.x_of_columns(), image.grid.y_of_rows()
    parts, sectors = [speckle((40, 30), seed) for seed in range(3)], []
    for i, part in enumerate(parts):
        kx, ky = 200.0 * i, -100.0 * i
        carrier = np.exp(1j * (kx * x[None, :] + ky * y[:, None]))
        baseband = (part / carrier).astype(np.complex64)
        sectors.append(Sector(baseband, image.grid, ACOUSTICS, START_NS + i, 0.5 * i, 0.5, (kx, ky)))
    path = write_run(tmp_path / "run", None, track, sectors=sectors)
    run = read_run(path)
    assert run.image is None
    assert run.counts == {"sector": 3}
    assert [s.stamp_ns for s in run.sectors()] == [s.stamp_ns for s in sectors]
    np.testing.assert_allclose(run.coherent_image().pixels, sum(parts), atol=1e-5)
    # A sector that comes twice counts once.
    np.testing.assert_array_equal(
        image_from_sectors([*sectors, sectors[1]]).pixels, image_from_sectors(sectors).pixels
    )
    coarse = read_run(write_run(tmp_path / "int", None, track, sectors=sectors, encoding="16SC2"))
    whole = coarse.coherent_image().pixels
    scale = np.vdot(whole, sum(parts)) / np.vdot(whole, whole)
    assert np.abs(whole * scale - sum(parts)).max() < 1e-3 * np.abs(sum(parts)).max()


@pytest.mark.parametrize("stage", ["sub_aperture", "shadow", "likelihood", "shadow_mask"])
def test_views_of_every_stage_come_back_in_order(tmp_path, track, stage):
    views = [view(d, stage) for d in (0, 10, 20)]
    extra = []
    for v in views:
        a, b = view_to_msgs(FACTORY, v, stage)
        extra += [(f"{stage}/image", a), (f"{stage}/camera_info", b)]
    run = read_run(write_run(tmp_path / "run", None, track, extra=extra))
    for _ in range(2):  # lazily, and again
        back = list(run.views(stage))
        assert [v.info.stamp_ns for v in back] == [v.info.stamp_ns for v in views]
        for a, b in zip(back, views, strict=True):
            np.testing.assert_array_equal(a.pixels, b.pixels)
    assert run.problems == []
    with pytest.raises(BagError, match="'mesh' holds no views; expected one of: sub_aperture"):
        run.views("mesh")
    with pytest.raises(BagError, match="there is no full-circle image"):
        run.coherent_image()


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(order=st.permutations(range(6)))
def test_the_order_of_images_and_infos_does_not_matter(tmp_path_factory, order):
    views = [view(d) for d in (0, 10, 20)]
    messages = []
    for v in views:
        a, b = view_to_msgs(FACTORY, v, "likelihood")
        messages += [("/csas/likelihood/image", a), ("/csas/likelihood/camera_info", b)]
    path = tmp_path_factory.mktemp("bag") / "run"
    with BagWriter(path) as writer:
        for when, i in enumerate(order):
            writer.write(*messages[i], log_time_ns=when)
    run = read_run(path)
    assert {v.info.stamp_ns for v in run.views("likelihood")} == {v.info.stamp_ns for v in views}
    assert run.problems == []


def test_a_latched_message_recorded_twice_counts_once_and_another_of_its_stamp_is_reported(tmp_path):
    v, other = view(10), view(10)
    other.pixels[0, 0] = 0.123
    a, b = view_to_msgs(FACTORY, v, "likelihood")
    with BagWriter(tmp_path / "run") as writer:
        for when in range(3):
            writer.write("/csas/likelihood/image", a, when)
            writer.write("/csas/likelihood/camera_info", b, when)
        writer.write("/csas/likelihood/image", view_to_msgs(FACTORY, other, "likelihood")[0], 9)
    run = read_run(tmp_path / "run")
    (back,) = run.views("likelihood")
    np.testing.assert_array_equal(back.pixels, v.pixels)
    (problem,) = run.problems
    assert str(problem) == (
        f"/csas/likelihood/image message 3 ({v.info.stamp_ns} ns):"
        " differs from an earlier message of the same stamp"
    )


def test_lonely_and_malformed_messages_are_left_out_and_each_is_named_once(tmp_path):
    messages = {d: view_to_msgs(FACTORY, view(d), "likelihood") for d in range(0, 60, 10)}
    messages[10][0].step = 1
    messages[20][1].distortion_model = "fisheye"
    with BagWriter(tmp_path / "run") as writer:
        for d, (a, b) in messages.items():
            if d != 30:
                writer.write("/csas/likelihood/image", a)
            if d != 40:
                writer.write("/csas/likelihood/camera_info", b)
    run = read_run(tmp_path / "run")
    for _ in range(2):
        assert [round(math.degrees(v.info.aspect_rad)) for v in run.views("likelihood")] == [0, 50]
    reasons = sorted(str(p) for p in run.problems)
    assert len(reasons) == 4
    assert reasons[0].startswith(
        "/csas/likelihood/camera_info message 3 (1700000030000000000 ns): has no image"
    )
    assert "message 1 (1700000010000000000 ns): likelihood/image.step is 1 bytes" in reasons[1]
    assert "distortion_model is 'fisheye'; expected one of: csas_shadow" in reasons[2]
    assert "message 3 (1700000040000000000 ns): has no camera_info of the same stamp" in reasons[3]


def test_a_growing_track_counts_as_its_longest(tmp_path, track):
    with BagWriter(tmp_path / "run") as writer:
        for n in (100, 200, 360, 50):
            part = Track(track.stamps_ns[:n], track.positions_m[:n])
            writer.write("/csas/track", track_to_msg(FACTORY, part), n)
    assert len(read_run(tmp_path / "run").track) == 360


def test_what_is_missing_is_said_with_the_reason(tmp_path, image, track):
    a, b = coherent_image_to_msgs(FACTORY, image)
    b.d = np.array([1.0, 2.0])
    path = tmp_path / "run"
    with BagWriter(path) as writer:
        writer.write("/csas/image", a)
        writer.write("/csas/camera_info", b)
    run = read_run(path)
    with pytest.raises(
        BagError, match=r"no full-circle image can be used: /csas/image message 0 .*d has 2 entries; expect"
    ):
        run.coherent_image()
    with pytest.raises(BagError, match="there is no track"):
        run.require_track()


# --- other tools, other writers


def test_rosbags_and_mcap_read_our_bags_with_definitions_checksums_and_qos(tmp_path, image, track):
    path = write_run(tmp_path / "run", image, track)
    with RosbagsReader(path) as reader:
        got = {c.topic: (c.msgtype, len(data)) for c, _, data in reader.messages()}
        connections = {c.topic: c for c in reader.connections}
    assert {t: k for t, (k, _) in got.items()} == {
        "/csas/image": "sensor_msgs/msg/Image",
        "/csas/camera_info": "sensor_msgs/msg/CameraInfo",
        "/csas/track": "nav_msgs/msg/Path",
    }
    connection = connections["/csas/image"]
    assert "uint32 height" in connection.msgdef.data
    assert "MSG: std_msgs/Header" in connection.msgdef.data
    assert connection.digest == typestore().hash_rihs01("sensor_msgs/msg/Image")
    (qos,) = connection.ext.offered_qos_profiles
    assert (qos.reliability.name, qos.durability.name, qos.depth) == ("RELIABLE", "TRANSIENT_LOCAL", 1)
    with (path / "run_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert sum(1 for _ in reader.iter_messages()) == 3
    info = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (info["version"], info["storage_identifier"], info["message_count"]) == (9, "mcap", 3)
    assert info["relative_file_paths"] == ["run_0.mcap"]
    assert "&id" not in (path / "metadata.yaml").read_text()
    ours = BagReader(path)
    assert len(list(ours.messages())) == 3
    assert ours.has_checksums


def foreign(path, messages, compression=CompressionType.NONE, profile="ros2", **options):
    """Write a lone MCAP file with the plain mcap library, as any other tool would."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, **options)
        writer.start(profile=profile, library="somebody else")
        channels = {}
        for when, (topic, msg) in enumerate(messages):
            name = msg.__msgtype__
            if topic not in channels:
                definition = typestore().generate_msgdef(name, ros_version=2)[0].encode()
                schema = writer.register_schema(name, "ros2msg", definition)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], when, bytes(typestore().serialize_cdr(msg, name)), when)
        writer.finish()
    return path


LAYOUTS = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {},
    "small chunks": {"chunk_size": 100},
    "no chunks": {"use_chunking": False},
    "no chunks, data checksum": {"use_chunking": False, "enable_data_crcs": True},
    "no checksums": {"enable_crcs": False},
    "no index": {"index_types": IndexType.NONE},
    "no summary": {
        "index_types": IndexType.NONE,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_statistics": False,
        "use_summary_offsets": False,
    },
    "no profile": {"profile": ""},
}


def run_messages(image, track, namespace):
    a, b = coherent_image_to_msgs(FACTORY, image)
    return [
        (f"{namespace}/image", a),
        (f"{namespace}/track", track_to_msg(FACTORY, track)),
        (f"{namespace}/camera_info", b),
    ]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("namespace", ["/csas", "/boat_7/sonar", ""])
def test_a_lone_file_of_another_writer_reads_the_same_whatever_its_layout(
    tmp_path, image, track, layout, namespace
):
    path = foreign(tmp_path / "theirs.mcap", run_messages(image, track, namespace), **LAYOUTS[layout])
    run = read_run(path)
    assert run.namespace == namespace
    same_image(run.image, image)
    assert len(run.track) == 360
    assert run.problems == []


@pytest.mark.parametrize("storage", ["sqlite3", "message", "file", "storage"])
def test_rosbag2_directories_of_rosbags_read_the_same(tmp_path, image, track, storage):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    writer = RosbagsWriter(tmp_path / "theirs", version=9, storage_plugin=plugin)
    if storage != "sqlite3":
        writer.set_compression(CompressionMode[storage.upper()], CompressionFormat.ZSTD)
    with writer:
        for topic, msg in run_messages(image, track, "/csas"):
            connection = writer.add_connection(topic, msg.__msgtype__, typestore=typestore())
            writer.write(connection, 7, typestore().serialize_cdr(msg, msg.__msgtype__))
    run = read_run(tmp_path / "theirs")
    same_image(run.image, image)
    assert len(run.track) == 360
    assert run.problems == []
    reader = BagReader(tmp_path / "theirs")
    assert len(list(reader.messages())) == 3
    assert reader.has_checksums is False


def test_two_runs_in_one_bag_need_a_name(tmp_path, image, track):
    messages = run_messages(image, track, "/port") + run_messages(image, track, "/starboard")
    path = foreign(tmp_path / "theirs.mcap", messages)
    with pytest.raises(BagError, match=r"holds topics of /port and of /starboard; expected one run"):
        read_run(path)
    same_image(read_run(path, namespace="starboard").image, image)


def test_a_later_stage_alone_is_found_in_its_namespace(tmp_path):
    a, b = view_to_msgs(FACTORY, view(30), "likelihood")
    path = foreign(tmp_path / "x.mcap", [("/a/likelihood/image", a), ("/a/likelihood/camera_info", b)])
    run = read_run(path)
    assert run.namespace == "/a"
    assert len(list(run.views("likelihood"))) == 1


def test_messages_of_overlapping_chunks_come_in_time_order(tmp_path):
    path = tmp_path / "x.mcap"
    times = [5, 1, 9, 3, 2, 8, 4]
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1)
        writer.start(profile="ros2")
        definition = typestore().generate_msgdef("std_msgs/msg/String", ros_version=2)[0].encode()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", definition)
        channel = writer.register_channel("/s", "cdr", schema)
        for t in times:
            cdr = typestore().serialize_cdr(
                FACTORY.make("std_msgs/msg/String", data=str(t)), "std_msgs/msg/String"
            )
            writer.add_message(channel, t, bytes(cdr), t)
        writer.finish()
    messages = list(BagReader(path).messages())
    assert [m.log_time_ns for m in messages] == sorted(times)
    assert [m.decode().data for m in messages] == [str(t) for t in sorted(times)]
    assert [m.number for m in messages] == list(range(len(times)))


def test_raw_messages_copy_bit_by_bit(tmp_path, image, track):
    path = write_run(tmp_path / "run", image, track)
    with BagWriter(tmp_path / "copy") as writer:
        assert copy(BagReader(path), writer) == 3
    a, b = (
        [(m.topic, m.log_time_ns, bytes(m.cdr)) for m in BagReader(p).messages()] for p in (path, writer.path)
    )
    assert a == b


def test_rclpy_messages_are_written_as_well(tmp_path, image, track):
    pytest.importorskip("rclpy")
    from msg_adapters import RclpyMessages

    a, b = coherent_image_to_msgs(RclpyMessages(), image)
    with BagWriter(tmp_path / "run") as writer:
        writer.write("/csas/image", a)
        writer.write("/csas/camera_info", b)
        writer.write("/csas/track", track_to_msg(RclpyMessages(), track))
    run = read_run(tmp_path / "run")
    same_image(run.image, image)
    assert len(run.track) == 360


def test_messages_of_unwanted_topics_are_not_decoded_and_unknown_types_are_no_obstacle(
    tmp_path, image, track
):
    path = tmp_path / "run"
    with BagWriter(path) as writer:
        writer.add_topic("/ping", "sonar_msgs/msg/Ping", definition="float32 range\n")
        writer.write("/ping", struct.pack("<If", 0x00000100, 1.0), 3)
        for topic, msg in run_messages(image, track, "/csas"):
            writer.write(topic, msg, 4)
    same_image(read_run(path).image, image)
    (ping,) = BagReader(path).messages(["/ping"])
    with pytest.raises(BagError, match="/ping: type 'sonar_msgs/msg/Ping' is unknown"):
        ping.decode()


# --- damage


@pytest.fixture
def many(tmp_path):
    """Twenty likelihood views in chunks of their own, uncompressed."""
    path = tmp_path / "many"
    with BagWriter(path, compress=False) as writer:
        for d in range(20):
            a, b = view_to_msgs(FACTORY, view(d), "likelihood")
            writer.write("/csas/likelihood/camera_info", b)
            writer.write("/csas/likelihood/image", a)
            writer._writer.flush()
    return path


@pytest.mark.parametrize("lost", ["metadata.yaml", None])
def test_a_bag_cut_off_is_read_as_far_as_it_goes_and_says_so(many, lost):
    file = many / "many_0.mcap"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    if lost:
        (many / lost).unlink()
    run = read_run(many)
    views = list(run.views("likelihood"))
    assert 5 <= len(views) <= 12
    for v in views:
        np.testing.assert_array_equal(v.pixels, view(round(math.degrees(v.info.aspect_rad))).pixels)
    text = "\n".join(str(p) for p in run.problems)
    assert "footer is missing: the recording was cut off" in text
    assert "ends in the middle of a record at byte" in text
    assert "messages recovered" in text
    assert ("metadata.yaml is missing" in text) == bool(lost)
    assert not BagReader(many).complete


def test_a_flipped_bit_costs_its_chunk_alone_and_is_reported(many):
    file = many / "many_0.mcap"
    data = bytearray(file.read_bytes())
    needle = view(7).pixels.tobytes()[40:80]
    at = bytes(data).index(needle)
    data[at] ^= 1
    file.write_bytes(data)
    run = read_run(many)
    degrees = [round(math.degrees(v.info.aspect_rad)) for v in run.views("likelihood")]
    assert degrees == [d for d in range(20) if d != 7]
    assert any("checksum is wrong: some bits have changed" in p for p in run._reader.problems)


def test_a_flipped_bit_in_a_file_without_chunks_is_noticed(tmp_path, image, track):
    messages = run_messages(image, track, "/csas")
    path = foreign(tmp_path / "x.mcap", messages, use_chunking=False, enable_data_crcs=True)
    data = bytearray(path.read_bytes())
    data[bytes(data).index(image.pixels.tobytes()[:64])] ^= 1
    path.write_bytes(data)
    assert any("checksum of its data is wrong" in str(p) for p in read_run(path).problems)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_no_damage_is_read_as_truth_nor_ends_in_another_error(many, data):
    file = many / "many_0.mcap"
    if not (many / "sound").exists():
        (many / "sound").write_bytes(file.read_bytes())
    sound = (many / "sound").read_bytes()
    broken = bytearray(sound[: data.draw(st.integers(8, len(sound)), label="cut")])
    for _ in range(data.draw(st.integers(0, 3), label="flips")):
        at = data.draw(st.integers(8, len(broken)), label="at")
        if at < len(broken):
            broken[at] ^= 1 << data.draw(st.integers(0, 7), label="bit")
    file.write_bytes(broken)
    try:
        run = read_run(many)
        views = list(run.views("likelihood"))
    except BagError:
        return
    for v in views:  # every message lies in a chunk with a checksum
        np.testing.assert_array_equal(v.pixels, view(round(math.degrees(v.info.aspect_rad))).pixels)


def test_what_is_no_bag_is_refused_by_name(tmp_path):
    with pytest.raises(BagError, match="there is no bag at"):
        read_run(tmp_path / "nothing")
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(BagError, match=r"empty\.mcap is empty \(0 bytes\); expected an MCAP file"):
        read_run(tmp_path / "empty.mcap")
    (tmp_path / "text.mcap").write_text("this is no bag")
    with pytest.raises(BagError, match=r"text\.mcap is not an MCAP file \(starts with b'this is '\)"):
        read_run(tmp_path / "text.mcap")
    (tmp_path / "old.db3").write_text("this is no database")
    with pytest.raises(BagError, match=r"cannot read .*old\.db3"):
        read_run(tmp_path / "old.db3")
    (tmp_path / "folder").mkdir()
    with pytest.raises(BagError, match=r"holds no metadata\.yaml and no \.mcap or \.db3 file"):
        read_run(tmp_path / "folder")
    (tmp_path / "folder" / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    with pytest.raises(BagError, match=r"metadata\.yaml cannot be read"):
        read_run(tmp_path / "folder")


def test_an_empty_bag_holds_nothing_and_no_error(tmp_path):
    BagWriter(tmp_path / "run").close()
    run = read_run(tmp_path / "run")
    assert (run.image, run.track, run.counts, run.problems) == (None, None, {}, [])


def test_a_listed_file_that_is_missing_is_reported(many):
    meta = many / "metadata.yaml"
    meta.write_text(meta.read_text().replace("- many_0.mcap", "- many_0.mcap\n  - many_1.mcap"))
    reader = BagReader(many)
    assert reader.problems == ["many_1.mcap, listed in metadata.yaml, is missing"]
    assert not reader.complete
    assert reader.message_count == 40


# --- writing


def test_a_bag_is_not_replaced_unless_asked_and_nothing_else_ever(tmp_path, image, track):
    path = write_run(tmp_path / "run", image, track)
    with pytest.raises(BagError, match="exists already; expected a new directory, or overwrite"):
        write_run(path, image, track)
    write_run(path, image, track, overwrite=True)
    (path / "notes.txt").write_text("mine")
    with pytest.raises(BagError, match="exists and is not a bag: not replaced"):
        write_run(path, image, track, overwrite=True)
    assert (path / "notes.txt").read_text() == "mine"
    (tmp_path / "file").write_text("mine")
    with pytest.raises(BagError, match="exists and is not a bag"):
        write_run(tmp_path / "file", image, track, overwrite=True)


def test_what_cannot_be_written_is_refused_by_name(tmp_path, image, track):
    with pytest.raises(BagError, match="encoding is 'mono8'; expected one of: 32FC2"):
        write_run(tmp_path / "run", image, track, encoding="mono8")
    with BagWriter(tmp_path / "run") as writer:
        with pytest.raises(BagError, match="topic 'image' is not absolute"):
            writer.write("image", coherent_image_to_msgs(FACTORY, image)[0])
        with pytest.raises(BagError, match="a raw message needs its type"):
            writer.write("/x", b"\0\1\0\0", 1)
        with pytest.raises(BagError, match="a message without a header needs its time"):
            writer.write("/x", FACTORY.make("std_msgs/msg/String"))
        with pytest.raises(BagError, match="type 'a_msgs/msg/B' is unknown"):
            writer.add_topic("/y", "a_msgs/msg/B")
        with pytest.raises(AdapterError, match=r"builtins\.int is not a ROS message"):
            writer.write("/x", 3, 1)
        writer.write("/x", FACTORY.make("std_msgs/msg/String"), 1)
        with pytest.raises(BagError, match="/x is a std_msgs/msg/String; cannot write a std_msgs/msg/Bool"):
            writer.write("/x", FACTORY.make("std_msgs/msg/Bool"), 1)
    with pytest.raises(BagError, match="is closed; cannot write /x"):
        writer.write("/x", FACTORY.make("std_msgs/msg/String"), 1)


def test_what_was_written_before_an_error_is_a_sound_bag(tmp_path, image, track):
    def fail(writer):
        for topic, msg in run_messages(image, track, "/csas"):
            writer.write(topic, msg, 1)
        raise RuntimeError("disk fell off")

    with pytest.raises(RuntimeError, match="disk fell off"), BagWriter(tmp_path / "run") as writer:
        fail(writer)
    run = read_run(tmp_path / "run")
    same_image(run.image, image)
    assert run.problems == []


def test_an_image_or_a_sector_without_a_stamp_is_not_written_and_replaces_no_bag(tmp_path, tiny_box_bag):
    run = read_run(tiny_box_bag.path)
    there = write_run(tmp_path / "there", run.image, run.track)
    with pytest.raises(AdapterError, match="image has stamp 0 ns; expected the time when its last data came"):
        write_run(there, replace(run.image, stamp_ns=0), run.track, overwrite=True)
    assert read_run(there).image.stamp_ns == run.image.stamp_ns
    sector = Sector(run.image.pixels, run.image.grid, run.image.acoustics, 0, 0.0, 1.0)
    with pytest.raises(AdapterError, match="sector has stamp 0 ns"):
        write_run(tmp_path / "new", None, run.track, sectors=[sector])


class CallerError(Exception):
    """Of the caller's own making."""


def fails_after(sectors, error):
    yield from sectors
    raise error


@pytest.mark.parametrize("error", [CallerError("a fault of the caller"), KeyboardInterrupt()])
@pytest.mark.parametrize("before", ["nothing", "a bag"])
def test_a_run_whose_writing_fails_leaves_what_was_there(tmp_path, image, track, before, error):
    path = tmp_path / "run"
    if before == "a bag":
        write_run(path, image, track)
    kept = {p.relative_to(tmp_path): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    one = Sector(image.pixels, image.grid, image.acoustics, image.stamp_ns, 0.0, 6.28)
    with pytest.raises(type(error)):
        write_run(path, None, track, sectors=fails_after([one], error), overwrite=True)
    assert {p.relative_to(tmp_path): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == kept
    with pytest.raises(CsasError):
        write_run(path, image, None, extra=[("odd", object())], overwrite=True)
    assert {p.relative_to(tmp_path): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == kept
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run"] * bool(kept)


def test_a_run_may_be_written_over_the_bag_that_it_is_read_from(tmp_path, image, track):
    path = tmp_path / "run"
    one = Sector(image.pixels, image.grid, image.acoustics, image.stamp_ns, 0.0, 6.28)
    write_run(path, None, track, sectors=[one])
    run = read_run(path)
    write_run(path, None, run.track, sectors=run.sectors(), overwrite=True)
    (again,) = read_run(path).sectors()
    assert np.array_equal(again.pixels, one.pixels)


def test_a_link_to_a_bag_stays_a_link(tmp_path, image, track):
    (tmp_path / "disk").mkdir()
    (tmp_path / "run").symlink_to(tmp_path / "disk" / "run")
    for overwrite in (False, True):
        write_run(tmp_path / "run", image, track, overwrite=overwrite)
    assert (tmp_path / "run").is_symlink()
    assert sorted(p.name for p in (tmp_path / "disk" / "run").iterdir()) == ["metadata.yaml", "run_0.mcap"]
