"""Bags damaged by a seed, and what reading them says: ``python damage.py FIRST COUNT`` shows some."""

from __future__ import annotations

import collections
import faulthandler
import json
import math
import random
import resource
import shutil
import signal
import sqlite3
import sys
import tempfile
import traceback
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from csas_shadow_ros.bags import BagReader, BagWriter, check_bag, read_run
from csas_shadow_ros.bags.index import BagIndex
from csas_shadow_ros.core.errors import BagError, CsasError
from csas_shadow_ros.core.geometry import Acoustics, ShadowCamera, Track, View, ViewInfo, view_ground_to_pixel
from csas_shadow_ros.nodes.playing import BagViews, stage_of_bag
from csas_shadow_ros.run_bag import describe_run
from msg_adapters import RosbagsMessages, track_to_msg, view_to_msgs
from msg_adapters.messages import typestore

#: Processor time (s) after which reading a small bag counts as never ending.
MOST_SECONDS = 10
#: Memory (bytes) that reading may take on top of what the libraries do; the issue asks for less than 1 GB.
MOST_MEMORY = 1 << 29
START_NS = 1_700_000_000_000_000_000
VIEWS = 12

Message = tuple[str, str, int, bytes]


def run_messages() -> list[Message]:
    """Return the messages of a small run: its track, and a dozen views of one stage."""
    factory, store = RosbagsMessages(), typestore()
    aspects = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    positions = np.column_stack([75 * np.cos(aspects), 75 * np.sin(aspects), np.full(90, 18.0)])
    track = track_to_msg(factory, Track(START_NS + np.arange(90) * 1_000_000_000, positions))
    found = [("/csas/track", track, START_NS)]
    rng = np.random.default_rng(0)
    for n in range(VIEWS):
        aspect, stamp = aspects[7 * n], START_NS + 7 * n * 1_000_000_000
        sonar = tuple(map(float, positions[7 * n]))
        camera = ShadowCamera.from_ground(view_ground_to_pixel(aspect, 0.02, 16, 18, (0, 0)), sonar, 16, 18)
        info = ViewInfo(stamp, camera, Acoustics(120e3, 40e3, 1500.0, -1), aspect, math.radians(12))
        image, camera_info = view_to_msgs(factory, View(info, rng.random((16, 18), np.float32)), "likelihood")
        found += [
            ("/csas/likelihood/camera_info", camera_info, stamp),
            ("/csas/likelihood/image", image, stamp),
        ]
    return [(t, m.__msgtype__, w, bytes(store.serialize_cdr(m, m.__msgtype__))) for t, m, w in found]


def _ours(path: Path, messages: list[Message], **options) -> None:
    with BagWriter(path, **options) as writer:
        for topic, kind, when, cdr in messages:
            writer.write(topic, cdr, when, type_name=kind)


def _small_chunks(path: Path, messages: list[Message], **options) -> None:
    """Write with the plain library, chunks of a few messages, and ours for the metadata."""
    _ours(path, messages)
    with next(path.glob("*.mcap")).open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2", library="other")
        channels: dict[str, int] = {}
        for topic, kind, when, cdr in messages:
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", b"")
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], when, cdr, when)
        writer.finish()


def _split(path: Path, messages: list[Message]) -> None:
    path.mkdir()
    names = []
    for n in range(4):
        part = path / f"part_{n}"
        _small_chunks(part, messages[n::4], chunk_size=2000, compression=CompressionType.ZSTD)
        names.append(f"bag_{n}.mcap")
        shutil.move(next(part.glob("*.mcap")), path / names[-1])
        metadata = (part / "metadata.yaml").read_text()
        shutil.rmtree(part)
    listed = "\n".join(f"  - {name}" for name in names)
    metadata = metadata.replace("  - part_3_0.mcap", listed)
    (path / "metadata.yaml").write_text(metadata)


def _packed(path: Path, messages: list[Message], pack, ending: str) -> None:
    _ours(path, messages)
    plain = next(path.glob("*.mcap"))
    plain.with_name(f"{plain.name}.{ending}").write_bytes(pack(plain.read_bytes()))
    plain.unlink()


def _of_rosbags(
    path: Path, messages: list[Message], plugin: StoragePlugin, mode: CompressionMode | None
) -> None:
    writer = RosbagsWriter(path, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, when, cdr in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore())
            writer.write(connections[topic], when, cdr)


def _killed(path: Path, messages: list[Message]) -> None:
    """Leave what a sqlite3 recorder leaves that is killed: a database, a -wal file and no metadata."""
    _of_rosbags(path, messages[: len(messages) // 2], StoragePlugin.SQLITE3, None)
    (path / "metadata.yaml").unlink()
    file = next(path.glob("*.db3"))
    database = sqlite3.connect(file)
    database.execute("PRAGMA journal_mode=WAL")
    number = {name: n for n, name in database.execute("SELECT id, name FROM topics")}
    for topic, _, when, cdr in messages[len(messages) // 2 :]:
        database.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", (number[topic], when, cdr)
        )
        database.commit()
    kept = {p: p.read_bytes() for p in (file, file.with_name(f"{file.name}-wal"))}
    database.close()
    for p, data in kept.items():
        p.write_bytes(data)


KINDS = {
    "ours": _ours,
    "ours, lz4": lambda p, m: _ours(p, m, compress="lz4"),
    "small chunks": lambda p, m: _small_chunks(p, m, chunk_size=2000, compression=CompressionType.ZSTD),
    "small chunks, no index": lambda p, m: _small_chunks(p, m, chunk_size=2000, index_types=IndexType.NONE),
    "no chunks": lambda p, m: _small_chunks(p, m, use_chunking=False, enable_data_crcs=True),
    "no checksums": lambda p, m: _small_chunks(p, m, chunk_size=2000, enable_crcs=False),
    "split": _split,
    "whole file, zstd": lambda p, m: _packed(
        p, m, zstandard.ZstdCompressor(write_checksum=True).compress, "zstd"
    ),
    "whole file, lz4": lambda p, m: _packed(p, m, lz4.frame.compress, "lz4"),
    "messages, zstd": lambda p, m: _of_rosbags(p, m, StoragePlugin.MCAP, CompressionMode.MESSAGE),
    "sqlite3": lambda p, m: _of_rosbags(p, m, StoragePlugin.SQLITE3, None),
    "sqlite3, messages": lambda p, m: _of_rosbags(p, m, StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "sqlite3, killed": _killed,
}


# --- damage


def _place(rng: random.Random, size: int) -> int:
    """Return a byte of a file; heads and ends, on which the rest hangs, more often than the middle."""
    near = rng.randrange(min(size, 300))
    return rng.choice([near, size - 1 - near, rng.randrange(size)])


def _spoil(rng: random.Random, data: bytearray) -> str:
    kind = rng.choice(["cut", "flip", "zero", "noise", "swap", "remove", "repeat", "extreme"])
    size = len(data)
    at, length = _place(rng, size), rng.choice([1, 4, 8, 60, 512, 4096])
    if kind == "cut":
        del data[at:]
    elif kind == "flip":
        for _ in range(rng.choice([1, 1, 3, 20])):
            data[_place(rng, size)] ^= 1 << rng.randrange(8)
    elif kind == "zero":
        data[at : at + length] = bytes(len(data[at : at + length]))
    elif kind == "noise":
        data[at : at + length] = rng.randbytes(len(data[at : at + length]))
    elif kind == "swap":
        other = _place(rng, size)
        at, other = min(at, other), max(at, other)
        length = min(length, other - at, size - other)
        data[at : at + length], data[other : other + length] = (
            data[other : other + length],
            data[at : at + length],
        )
    elif kind == "remove":
        del data[at : at + length]
    elif kind == "repeat":
        data[at:at] = data[at : at + length]
    else:
        # What a length field may say at its worst.
        value = rng.choice([0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1])
        data[at : at + 8] = value.to_bytes(8, "little")[: len(data[at : at + 8])]
    return f"{kind} at {at}"


def _spoil_text(rng: random.Random, text: str) -> str:
    lines = text.splitlines()
    n = rng.randrange(len(lines))
    change = rng.choice(["drop", "twice", "value", "indent", "end", "anchor"])
    if change == "drop":
        del lines[n]
    elif change == "twice":
        lines.insert(n, lines[n])
    elif change == "value":
        odd = [
            "",
            "~",
            "-1",
            "1e400",
            ".nan",
            "[]",
            "{a: b}",
            "../..",
            "'",
            "!!set {x}",
            "9" * 50,
            "2026-01-02",
        ]
        lines[n] = f"{lines[n].partition(':')[0]}: {rng.choice(odd)}"
    elif change == "indent":
        lines[n] = " " * rng.randrange(8) + lines[n].lstrip()
    elif change == "anchor":
        lines[n] += rng.choice([" &a [*a]", " *none", " <<: *b", " &b {x: 1}"])
    else:
        lines = lines[:n]
    return "\n".join(lines)


def damage(path: Path, rng: random.Random) -> list[str]:
    """Damage a bag in one to three places; return what was done."""
    done = []
    for _ in range(rng.choice([1, 1, 2, 3])):
        files = sorted(p for p in path.iterdir() if p.is_file() and p.stat().st_size)
        if not files:
            break
        file = rng.choice(files)
        change = rng.choice(["bytes", "bytes", "bytes", "text", "delete", "empty", "files"])
        if change == "text" and (path / "metadata.yaml") in files:
            file = path / "metadata.yaml"
            file.write_text(_spoil_text(rng, file.read_text(errors="replace")))
            done.append("metadata.yaml: text")
        elif change == "delete":
            file.unlink()
            done.append(f"{file.name}: deleted")
        elif change == "empty":
            file.write_bytes(b"\0" * rng.choice([0, 5, file.stat().st_size]))
            done.append(f"{file.name}: emptied")
        elif change == "files" and len(files) > 1:
            other = rng.choice(files)
            a, b = file.read_bytes(), other.read_bytes()
            file.write_bytes(b)
            other.write_bytes(a)
            done.append(f"{file.name} and {other.name}: exchanged")
        else:
            data = bytearray(file.read_bytes())
            done.append(f"{file.name}: {_spoil(rng, data)}")
            file.write_bytes(data)
    return done


# --- reading


def read(path: Path) -> tuple[list[Message], list[str], bool]:
    """Read a bag every way there is; return its messages, what is told, and whether checksums cover them."""
    reader = BagReader(path)
    messages = [(m.topic, m.type_name, m.log_time_ns, bytes(m.cdr)) for m in reader.messages()]
    check_bag(path)
    try:
        run = read_run(path)
        list(run.views("likelihood"))
        json.dumps(describe_run(run), allow_nan=False)
        stage = stage_of_bag(reader)
        views = BagViews(reader, stage)
        for stamp in views.times:
            views.get(stamp)
        for _, load in BagIndex(reader).places("likelihood", set(views.times)):
            load()
    except CsasError:
        pass  # what cannot be used is refused; what was read counts
    return messages, reader.problems, reader.has_checksums


def judge(path: Path, sound: list[Message]) -> tuple[str, str]:
    """Return what became of a damaged bag, and why: `wrong` is what must not be."""
    try:
        messages, told, checked = read(path)
    except BagError as error:
        text = str(error)
        return ("wrong", f"refused in {text!r}") if "\n" in text or len(text) > 600 else ("refused", text)
    missing = collections.Counter(sound) - collections.Counter(messages)
    strange = collections.Counter(messages) - collections.Counter(sound)
    if not missing and not strange:
        return "whole", ""
    # Where no checksum covers what was read, that is what `check` and `info` say of the bag.
    if strange and checked and not told:
        return "wrong", f"{strange.total()} messages differ and nothing is told"
    if missing and not told and checked:
        return "wrong", f"{missing.total()} messages are lost and nothing is told"
    if missing and not strange and not told:
        return "wrong", f"{missing.total()} messages are lost and only the lack of checksums is told"
    return "told", told[0] if told else "there are no checksums"


def _too_long(*_: object) -> None:
    raise TimeoutError(f"not done after {MOST_SECONDS} s of processor time")


def main(first: int, count: int) -> None:
    """Damage, read and judge bags by their seeds; print a line of JSON for each."""
    faulthandler.enable()
    signal.signal(signal.SIGVTALRM, _too_long)
    sound = run_messages()
    with tempfile.TemporaryDirectory() as folder:
        for n, make in enumerate(KINDS.values()):
            make(Path(folder) / f"{n}", sound)
        read(Path(folder) / "0")  # loads what it needs
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY, used + MOST_MEMORY))
        for seed in range(first, first + count):
            rng = random.Random(seed)
            kind = rng.randrange(len(KINDS))
            path = Path(folder) / "damaged"
            shutil.rmtree(path, ignore_errors=True)
            shutil.copytree(Path(folder) / f"{kind}", path)
            done = damage(path, rng)
            signal.setitimer(signal.ITIMER_VIRTUAL, MOST_SECONDS)
            faulthandler.dump_traceback_later(300, exit=True)
            try:
                outcome, why = judge(path, sound)
            except Exception:
                outcome, why = "wrong", traceback.format_exc()
            finally:
                signal.setitimer(signal.ITIMER_VIRTUAL, 0)
                faulthandler.cancel_dump_traceback_later()
            line = {"seed": seed, "kind": list(KINDS)[kind], "damage": done, "outcome": outcome, "why": why}
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
