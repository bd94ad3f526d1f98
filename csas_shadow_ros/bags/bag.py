"""rosbag2 directories and lone MCAP files: reading and writing messages, raw or decoded."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple

import yaml
from mcap.exceptions import McapError
from mcap.writer import CompressionType, Writer
from rosbags.serde import SerdeError

from csas_shadow_ros.core.errors import AdapterError, BagError
from csas_shadow_ros.durable import Place
from msg_adapters.messages import message_from_cdr, stamp_to_ns, type_name_of, typestore
from msg_adapters.topics import NAMESPACE, STREAMS, TOPICS, VIEW_STREAMS, absolute_name, clean_namespace

from .mcap_file import MAGIC, McapFile
from .metadata import METADATA, read_metadata
from .sqlite_file import SQLITE_MAGIC, SqliteFile
from .storage import (
    LZ4_MAGIC,
    ZSTD_MAGIC,
    StorageFile,
    TopicType,
    merged,
    open_regular,
    unfold_file,
    unfold_message,
)

_OWN_CHUNK_BYTES = 1 << 18
_ROS1_MAGIC = b"#ROSBAG "
#: How storage files end, and what compression of a whole file adds.
_STORED = (".mcap", ".db3")
_PACKED = (".zstd", ".zst", ".lz4")
#: Lines of damage that are kept: who reads more?
_MOST_PROBLEMS = 200
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


class BagMessage(NamedTuple):
    """One message of a bag.

    Parameters
    ----------
    topic, type_name : str
        Absolute name and ``package/msg/Name``.
    log_time_ns : int
        When it was recorded.
    number : int
        Its place among the messages of its topic, from 0, in reading order.
    cdr : memoryview
        The serialised message, as a publisher takes it.
    """

    topic: str
    type_name: str
    log_time_ns: int
    number: int
    cdr: memoryview

    def decode(self) -> Any:
        """Deserialise to a rosbags message; arrays are views of `cdr`.

        Raises
        ------
        BagError
            If the type is unknown or the bytes are no message of it.
        """
        try:
            return message_from_cdr(self.cdr, self.type_name, f"{self.topic} message {self.number}")
        except KeyError:
            raise BagError(f"{self.topic}: type {self.type_name!r} is unknown; cannot decode it") from None
        except AdapterError as error:
            raise BagError(str(error)) from error


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag: its type and number of messages."""

    name: str
    type_name: str
    count: int


class BagReader:
    """Reads a rosbag2 directory or a lone storage file.

    A bag that was cut off or damaged is read as far as it goes; every damage is one line in
    `problems`. What the files hold themselves counts, not what ``metadata.yaml`` says of them: MCAP and
    sqlite3, whole files or messages compressed or not, are told apart by their first bytes. Use as a context
    manager or not; files are open only while messages are iterated.

    Parameters
    ----------
    path : path-like
        A directory with ``metadata.yaml`` (or what is left of one), an ``.mcap`` or a ``.db3`` file.
    namespace : str, optional
        Namespace of the contract's topics; found by itself if not given.

    Raises
    ------
    BagError
        If there is nothing to read.

    Examples
    --------
    >>> import tempfile
    >>> from csas_shadow_ros.bags import BagReader, BagWriter
    >>> folder = tempfile.mkdtemp()
    >>> with BagWriter(f"{folder}/bag") as writer:
    ...     writer.write("/csas/track", bytes(64), 7, type_name="nav_msgs/msg/Path")
    >>> [(m.topic, m.log_time_ns) for m in BagReader(f"{folder}/bag").messages()]
    [('/csas/track', 7)]
    """

    def __init__(self, path: str | Path, namespace: str | None = None) -> None:
        self.path = Path(path)
        self._problems: dict[str, None] = {}
        self._files: list[StorageFile] = []
        #: Topics whose messages are no CDR, and what they are: nothing is said unless they are read.
        self._others: dict[str, str] = {}
        #: False if the recording was cut off or a file of it is missing.
        self.complete = True
        if not self.path.exists():
            raise BagError(f"there is no bag at {self.path}")
        self.topics: dict[str, TopicInfo] = {}
        if self.path.is_dir():
            self._open_directory()
        else:
            self._files = [self._open_file(self.path)]
        self.complete &= all(f.complete for f in self._files)
        for file in self._files:
            self._add_topics(file)
        self.namespace = clean_namespace(namespace) if namespace is not None else self._find_namespace()

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *exc: object) -> None:
        return None

    @property
    def problems(self) -> list[str]:
        """One line for each damage met so far."""
        return list(self._problems)

    @property
    def message_count(self) -> int:
        """Number of messages in the bag."""
        return sum(t.count for t in self.topics.values())

    @property
    def compressions(self) -> set[str]:
        """Chunk compressions in use: '', zstd, lz4."""
        return set().union(*(f.compressions for f in self._files))

    @property
    def has_checksums(self) -> bool:
        """Whether checksums cover everything read so far."""
        return all(f.has_checksums for f in self._files)

    @property
    def indexed_files(self) -> list[McapFile] | None:
        """The bag's MCAP files if all of them are complete; else None."""
        files = [f for f in self._files if isinstance(f, McapFile) and f.complete]
        return files if len(files) == len(self._files) else None

    def _complain(self, problem: str) -> None:
        if len(self._problems) < _MOST_PROBLEMS:
            self._problems[problem] = None
        else:
            self._problems[f"more than {_MOST_PROBLEMS} damages; the others are not listed"] = None

    def _open_directory(self) -> None:
        stored = sorted(p for p in self.path.iterdir() if _bare(p.name).endswith(_STORED))
        # A recorder that is killed while it compresses a file leaves both.
        names = {p.name for p in stored}
        stored = [p for p in stored if p.name == _bare(p.name) or _bare(p.name) not in names]
        wanted, counted = stored, 0
        if (self.path / METADATA).exists():
            try:
                metadata = read_metadata(self.path)
            except BagError as error:
                if not stored:
                    raise BagError(f"{error} and there is no .mcap or .db3 file") from error
                self._cut(f"{_unplaced(error, self.path)}; reading the storage files")
            else:
                wanted, counted = self._listed(metadata.files, stored), metadata.message_count
        elif stored:
            self._cut(f"{METADATA} is missing (the recording was cut off); reading the storage files")
        else:
            raise BagError(
                f"{self.path} holds no {METADATA} and no .mcap or .db3 file; expected a rosbag2 directory"
            )
        failed: list[BagError] = []
        for path in wanted:
            try:
                self._files.append(self._open_file(path))
            except BagError as error:
                failed.append(error)
        if failed and not self._files:
            raise failed[0]
        for refused in failed:
            self._cut(f"{_unplaced(refused, self.path)}; its messages are lost")
        found = sum(sum(f.counts.values()) for f in self._files)
        if found < counted and not self._problems:
            self._cut(f"{METADATA} lists {counted} messages; the files hold {found}: the others are lost")

    def _cut(self, problem: str) -> None:
        self.complete = False
        self._complain(problem)

    def _listed(self, names: list[str], stored: list[Path]) -> list[Path]:
        """Return the files that are listed, also where one was (de)compressed since; name what is missing."""
        there = {p.name: p for p in stored}
        present: list[Path] = []
        lost: list[str] = []
        for name in dict.fromkeys(names):
            bare = _bare(name)
            options = [name, bare, *(f"{bare}{packed}" for packed in _PACKED)]
            found = next(
                (self.path / o for o in options if o in there or (o and (self.path / o).exists())), None
            )
            if found is None:
                lost.append(name)
            elif found not in present:
                present.append(found)
        if not present and not stored:
            raise BagError(f"{self.path}: no storage file found; expected {', '.join(names[:8]) or 'one'}")
        for name in lost:
            self._cut(f"{name}, listed in {METADATA}, is missing")
        known = {_bare(p.name) for p in present or stored}
        for stranger in [p.name for p in stored if _bare(p.name) not in known]:
            # It may be a part of this recording or of another one: only a person can tell.
            self._cut(f"{stranger} is not listed in {METADATA}; it is not read")
        return present or stored

    def _open_file(self, path: Path) -> StorageFile:
        with open_regular(path) as file:
            start = file.read(len(SQLITE_MAGIC))
        source, name = path, path.name
        for compression, magic in (("zstd", ZSTD_MAGIC), ("lz4", LZ4_MAGIC)):
            if start.startswith(magic):
                folder = Path(tempfile.mkdtemp(prefix="csas_shadow_bag_"))
                weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
                source = folder / name.removesuffix(path.suffix)
                self.complete &= unfold_file(path, compression, source, self._complain)
                with open_regular(source) as file:
                    start = file.read(len(SQLITE_MAGIC))
        if start.startswith(_ROS1_MAGIC):
            raise BagError(f"{path} is a bag of ROS 1; expected one of ROS 2: rosbags-convert makes one")
        try:
            if start == SQLITE_MAGIC:
                return SqliteFile(source, self._complain, name)
            if start and not start.startswith(MAGIC) and ".db3" in path.suffixes:
                raise BagError(f"cannot read {path}: not a sqlite3 database (starts with {start[:8]!r})")
            return McapFile(source, self._complain, name)
        except BagError as error:
            raise BagError(str(error).replace(str(source), str(path))) from error

    def _add_topics(self, file: StorageFile) -> None:
        for i, channel in file.channels.items():
            topic, type_name, count = channel.topic, channel.type_name, file.counts.get(i, 0)
            if channel.message_encoding != "cdr":
                if count:
                    self._others.setdefault(topic, channel.message_encoding)
                continue
            if (known := self.topics.get(topic)) is not None:
                count += known.count
                if known.type_name != type_name:
                    self._complain(f"{topic} is recorded as {known.type_name} and as {type_name}")
                    type_name = known.type_name
            self.topics[topic] = TopicInfo(topic, type_name, count)

    def _find_namespace(self) -> str:
        """Return the namespace that holds a run; where none holds a whole one, that with most topics."""
        scores: dict[str, int] = {}
        for name in self.topics:
            for relative in TOPICS:
                if not relative.startswith("/") and name.endswith(f"/{relative}"):
                    prefix = name[: -len(relative) - 1]
                    scores[prefix] = scores.get(prefix, 0) + 1
        runs = {prefix: scores[prefix] for prefix in scores if self._holds_run(prefix)}
        if not scores or (NAMESPACE in scores and not runs):
            return NAMESPACE
        scores = runs or scores
        best = max(scores.values())
        # Of /a and /a/likelihood with equally many topics, the outer one is the namespace.
        leaders = sorted((p for p, n in scores.items() if runs or n == best), key=len)
        shortest = leaders[0]
        if others := [p for p in leaders[1:] if not p.startswith(f"{shortest}/")]:
            raise BagError(
                f"{self.path} holds topics of {shortest or '/'} and of {others[0]}; expected one run:"
                " name its namespace"
            )
        return shortest

    def _holds_run(self, namespace: str) -> bool:
        """Say whether a namespace holds what to start from: views, or an image or sectors with a track."""

        def held(relative: str) -> bool:
            info = self.topics.get(absolute_name(relative, namespace))
            return info is not None and info.count > 0

        whole = {s for s, kind in STREAMS.items() if held(kind.image_topic) and held(kind.info_topic)}
        return bool(whole & set(VIEW_STREAMS)) or (bool(whole & {"image", "sector"}) and held("track"))

    def topic(self, relative: str) -> TopicInfo | None:
        """Return a topic of the contract by its relative name, None if the bag lacks it."""
        return self.topics.get(absolute_name(relative, self.namespace))

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[BagMessage]:
        """Iterate messages in the order of their recording, over all files of the bag.

        Parameters
        ----------
        topics : iterable of str, optional
            Names, absolute or relative to the namespace; all topics by default.

        Raises
        ------
        BagError
            If the storage cannot be read at all. Damaged parts are left out and named in `problems`.
        """
        wanted = None if topics is None else {absolute_name(t, self.namespace) for t in topics}

        def chosen(channel: TopicType) -> bool:
            return channel.message_encoding == "cdr" and (wanted is None or channel.topic in wanted)

        for topic in self._others if wanted is None else self._others.keys() & wanted:
            self._complain(f"{topic} is encoded as {self._others[topic]!r}; expected cdr: left out")
        numbers: dict[str, int] = {}
        for file, message in merged(self._files, chosen):
            channel = self._files[file].channels[message.channel_id]
            number = numbers.get(channel.topic, 0)
            numbers[channel.topic] = number + 1
            try:
                data = unfold_message(message.data)
            except ValueError as error:
                self._complain(f"{channel.topic} message {number}: {error}; it is lost")
                continue
            yield BagMessage(channel.topic, channel.type_name, message.log_time_ns, number, data)
        for topic, info in self.topics.items():
            read = numbers.get(topic, 0)
            if (wanted is None or topic in wanted) and read < info.count and not self._problems:
                self._complain(f"{topic}: {read} of {info.count} messages could be read; the others are lost")


def _bare(name: str) -> str:
    """Return a storage file's name without what compression of the whole file adds."""
    return name.removesuffix(Path(name).suffix) if Path(name).suffix in _PACKED else name


def _unplaced(error: BagError, folder: Path) -> str:
    """Return what is wrong with a file of a bag, named without its folder."""
    return str(error).replace(f"{folder}/", "")


def qos_profile(depth: int, *, latched: bool = True) -> dict[str, Any]:
    """Return a reliable QoS profile as rosbag2's metadata (version 9) spells it.

    Parameters
    ----------
    depth : int
        How many samples are kept.
    latched : bool
        transient_local, which serves late and volatile subscribers alike; else volatile.
    """
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable",
        "durability": "transient_local" if latched else "volatile",
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }


@dataclass
class _Channel:
    id: int
    type_name: str
    qos: list[dict[str, Any]]
    digest: str
    count: int = 0


def _check_room(path: Path, overwrite: bool) -> None:
    """Refuse to write a bag where something is that is not to be replaced."""
    if not path.exists():
        return
    if not overwrite:
        raise BagError(f"{path} exists already; expected a new directory, or overwrite")
    inside = list(path.iterdir()) if path.is_dir() else None
    if inside is None or any(p.name != METADATA and p.suffix not in (".mcap", ".db3") for p in inside):
        raise BagError(f"{path} exists and is not a bag: not replaced")


@contextlib.contextmanager
def whole_bag(path: str | Path, *, compress: bool = True, overwrite: bool = False) -> Iterator[BagWriter]:
    """Write a bag that is in place once it is whole: whatever fails before leaves what was there.

    Parameters
    ----------
    path : path-like
        Directory to make.
    compress, overwrite
        See `BagWriter`.

    Raises
    ------
    BagError
        If the path is taken or cannot be made.
    """
    # Of a link, what it leads to is replaced.
    folder = Path(path).resolve()
    _check_room(folder, overwrite)
    place = Place(folder)
    place.clear(lambda _: None)
    try:
        with _named(path):
            work = place.make()
        name = f"{folder.name}_0.mcap"
        with BagWriter(work, compress=compress, overwrite=True, file_name=name) as writer:
            yield writer
        with _named(path):
            place.put(replace=overwrite, durable=False)
    finally:
        place.abandon()


@contextlib.contextmanager
def _named(path: str | Path) -> Iterator[None]:
    """Turn what the disk says into an error that names the bag."""
    try:
        yield
    except OSError as error:
        raise BagError(f"cannot make {path}: {error.strerror}") from error


class BagWriter:
    """Writes a rosbag2 directory: one MCAP file with checksums and definitions, and its metadata.

    Parameters
    ----------
    path : path-like
        Directory to make.
    compress : bool or str
        Chunks compressed with zstd; ``"lz4"``: a tenth larger, four times as fast.
    overwrite : bool
        Replace a bag that is there. Anything but a bag is never removed.
    depth : int
        Depth of the QoS that is offered on playing, for topics made without one.
    file_name : str, optional
        Name of the MCAP file; ``<directory>_0.mcap`` by default, as rosbag2 has it.

    Raises
    ------
    BagError
        If the path is taken or cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        compress: bool | Literal["lz4"] = True,
        overwrite: bool = False,
        depth: int = 100,
        file_name: str | None = None,
    ) -> None:
        self.path = Path(path)
        self._depth = depth
        self._channels: dict[str, _Channel] = {}
        self._schemas: dict[str, tuple[int, str]] = {}
        self._first: int | None = None
        self._last = 0
        self._closed = False
        _check_room(self.path, overwrite)
        try:
            if overwrite and self.path.exists() and any(self.path.iterdir()):
                shutil.rmtree(self.path)
            self.path.mkdir(parents=True, exist_ok=overwrite)
            self.file = self.path / (file_name or f"{self.path.resolve().name}_0.mcap")
            self._stream = self.file.open("wb")
        except OSError as error:
            raise BagError(f"cannot make {self.path}: {error.strerror}") from error
        kinds = {True: CompressionType.ZSTD, False: CompressionType.NONE, "lz4": CompressionType.LZ4}
        self._writer: Any = Writer(self._stream, compression=kinds[compress])
        self._writer.start(profile="ros2", library="csas_shadow_ros")

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # What was written up to an error is a sound bag too.
        self.close()

    def add_topic(
        self,
        topic: str,
        type_name: str,
        *,
        depth: int | None = None,
        latched: bool = True,
        definition: str | None = None,
    ) -> None:
        """Make a topic; needed before `write` only for raw messages or a special QoS.

        Parameters
        ----------
        topic : str
            Absolute name.
        type_name : str
            ``package/msg/Name``.
        depth, latched
            See `qos_profile`.
        definition : str, optional
            ``ros2msg`` text of a type that is not in ROS 2 Jazzy's common interfaces.

        Raises
        ------
        BagError
            If the topic exists with another type, is not absolute, or the type is unknown.
        """
        if not topic.startswith("/"):
            raise BagError(f"topic {topic!r} is not absolute; expected a leading slash")
        if (known := self._channels.get(topic)) is not None:
            if known.type_name != type_name:
                raise BagError(f"{topic} is a {known.type_name}; cannot write a {type_name} to it")
            return
        qos = [qos_profile(self._depth if depth is None else depth, latched=latched)]
        schema, digest = self._schema(type_name, definition)
        channel = self._writer.register_channel(
            topic=topic,
            message_encoding="cdr",
            schema_id=schema,
            metadata={
                "offered_qos_profiles": _dump(qos).strip(),
                "topic_type_hash": digest,
            },
        )
        self._channels[topic] = _Channel(channel, type_name, qos, digest)

    def _schema(self, type_name: str, definition: str | None) -> tuple[int, str]:
        if type_name not in self._schemas:
            digest = ""
            if definition is None:
                store = typestore()
                if type_name not in store.fielddefs:
                    raise BagError(
                        f"type {type_name!r} is unknown; expected a standard one, or its definition"
                    )
                definition = store.generate_msgdef(type_name, ros_version=2)[0]
                digest = store.hash_rihs01(type_name)
            number = self._writer.register_schema(type_name, "ros2msg", definition.encode())
            self._schemas[type_name] = (number, digest)
        return self._schemas[type_name]

    def write(
        self,
        topic: str,
        message: Any,
        log_time_ns: int | None = None,
        *,
        type_name: str | None = None,
    ) -> None:
        """Write one message.

        Parameters
        ----------
        topic : str
            Absolute name.
        message : message, bytes or memoryview
            An rclpy or rosbags message, or CDR as it is.
        log_time_ns : int, optional
            When it was recorded; the header's stamp by default.
        type_name : str, optional
            Needed for the first raw message of a topic that was not added.

        Raises
        ------
        BagError
            If the bag is closed, the type does not fit the topic, or no time is known.
        """
        if self._closed:
            raise BagError(f"{self.path} is closed; cannot write {topic}")
        if isinstance(message, bytes | bytearray | memoryview):
            data: Any = message
            known = self._channels.get(topic)
            type_name = type_name or (known.type_name if known else None)
            if type_name is None:
                raise BagError(f"{topic}: a raw message needs its type on a new topic")
        else:
            actual = type_name_of(message)
            if type_name not in (None, actual):
                raise BagError(f"{topic}: message is a {actual}; expected {type_name}")
            type_name, data = actual, _serialise(message, actual)
            if log_time_ns is None and hasattr(message, "header"):
                log_time_ns = stamp_to_ns(message.header.stamp)
        if log_time_ns is None:
            raise BagError(f"{topic}: a message without a header needs its time")
        self.add_topic(topic, type_name)
        channel = self._channels[topic]
        alone = len(data) > _OWN_CHUNK_BYTES
        try:
            if alone:
                # An image shares no chunk with small messages: those are read without touching it.
                self._writer.flush()
            self._writer.add_message(channel.id, log_time_ns, data, log_time_ns, channel.count)
            if alone:
                self._writer.flush()
        except OSError as error:
            raise BagError(f"cannot write to {self.file}: {error.strerror}") from error
        channel.count += 1
        self._first = log_time_ns if self._first is None else min(self._first, log_time_ns)
        self._last = max(self._last, log_time_ns)

    def flush(self) -> None:
        """Flush the written messages to the disk, safe from a crash.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        if self._closed:
            return
        try:
            self._writer.flush()
            self._stream.flush()
        except OSError as error:
            raise BagError(f"cannot write to {self.file}: {error.strerror}") from error

    def close(self) -> None:
        """Finish the file and write the metadata; a second call does nothing.

        Raises
        ------
        BagError
            If the disk refuses.
        """
        if self._closed:
            return
        self._closed = True
        information = self._information()
        try:
            text = _dump(information)
            self._writer.add_metadata("rosbag2", {"serialized_metadata": text})
            self._writer.finish()
            self._stream.close()
            partial = self.path / f"{METADATA}.tmp"
            whole = _dump({"rosbag2_bagfile_information": information})
            partial.write_text(whole, encoding="utf-8")
            partial.replace(self.path / METADATA)
        except (OSError, McapError) as error:
            raise BagError(f"cannot finish {self.path}: {error}") from error

    def _information(self) -> dict[str, Any]:
        count = sum(c.count for c in self._channels.values())
        start = self._first if self._first is not None else 0
        times = {
            "duration": {"nanoseconds": self._last - start if count else 0},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": count,
        }
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **times,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": c.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": c.qos,
                        "type_description_hash": c.digest,
                    },
                    "message_count": c.count,
                }
                for topic, c in self._channels.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.file.name],
            "files": [{"path": self.file.name, **times}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }


class _PlainDumper(yaml.SafeDumper):  # type: ignore[misc]  # PyYAML has no types
    """Writes equal parts out: not every reader of metadata knows YAML's anchors."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002  (PyYAML's)
        return True


def _dump(data: Any) -> str:
    text: str = yaml.dump(data, Dumper=_PlainDumper, sort_keys=False)
    return text


def _serialise(message: Any, type_name: str) -> Any:
    try:
        if hasattr(message, "__msgtype__"):
            return typestore().serialize_cdr(message, type_name)
        from rclpy.serialization import serialize_message

        return serialize_message(message)
    except (SerdeError, AdapterError, TypeError, ValueError, AttributeError) as error:
        raise BagError(f"cannot serialise {type_name}: {error}") from error


def copy(reader: BagReader, writer: BagWriter, keep: Callable[[BagMessage], bool] | None = None) -> int:
    """Copy messages unchanged from bag to bag; return how many."""
    n = 0
    for message in reader.messages():
        if keep is None or keep(message):
            writer.write(message.topic, message.cdr, message.log_time_ns, type_name=message.type_name)
            n += 1
    return n
