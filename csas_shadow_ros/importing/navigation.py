"""Where the sonar was, as vehicles record it: CSV, Odometry, poses, fixes and transforms, to a `Track`."""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.messages import NANOSECONDS, stamp_to_ns

from ..bags import BagReader
from ..core.errors import CsasError
from ..core.frame_name import SCENE_FRAME
from ..core.geometry import Datum, Track
from .settings import AXES, ImportSettingsError, Settings

FloatArray = NDArray[np.float64]
_UNITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
#: Names of time columns that need not be told, with the unit that they say.
_TIME_NAMES = {"time": "s", "t": "s", "stamp": "s", "time_s": "s", "time_ms": "ms", "time_us": "us"}
_TIME_NAMES |= {"time_ns": "ns", "stamp_ns": "ns", "timestamp": "s"}
#: A pose that two transforms are put together of: both may be so far apart in time (s).
_MOST_APART_S = 1.0
_TF = "tf2_msgs/msg/TFMessage"
_ISO = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d+))?(Z|[+-]\d\d:\d\d)?")


@dataclass(eq=False)
class Poses:
    """Poses as they were recorded.

    Parameters
    ----------
    stamps_ns : list of int
        When.
    places : list of (float, float, float)
        Where, in the navigation's own axes.
    turns : list of (float, float, float, float)
        Quaternions x y z w from the vehicle's axes; empty where nothing says so.
    """

    stamps_ns: list[int] = field(default_factory=list)
    places: list[tuple[float, float, float]] = field(default_factory=list)
    turns: list[tuple[float, float, float, float]] = field(default_factory=list)


def read_track(settings: Settings, datum: Datum | None, file: Path | None = None) -> Track:
    """Read the navigation and put it into the scene.

    Parameters
    ----------
    settings : Settings
        Its part `track`.
    datum : Datum or None
        Where the scene is: geographic positions need it.
    file : Path, optional
        The navigation, instead of ``track.file``.

    Raises
    ------
    ImportSettingsError
        If something is lacking.
    TrackError
        If what is there is no track.
    """
    path = file or settings.folder / settings.text("track", "file")
    if not path.exists():
        raise ImportSettingsError(f"there is no navigation {path}; expected a CSV file or a bag")
    if path.is_dir() or path.suffix in (".mcap", ".db3", ".zstd"):
        poses, geographic = _of_bag(path, settings)
        axes = "geographic" if geographic else settings.one_of("track", "axes", list(AXES), "enu")
        if geographic and settings.has("track", "axes") and settings.text("track", "axes") != axes:
            raise settings.wrong("track", "axes", "geographic, or none: the bag's messages are fixes")
    else:
        axes = settings.one_of("track", "axes", list(AXES))
        poses = _of_csv(path, settings, axes)
    if not poses.stamps_ns:
        raise ImportSettingsError(f"{path} holds no pose")
    places: FloatArray = np.array(poses.places, dtype=np.float64).reshape(-1, 3)
    if settings.has("track", "lever_arm_m"):
        places = places + _lever_arms(poses, settings, path)
    positions = (
        _geographic(places, datum, path) if axes == "geographic" else _cartesian(places, axes, settings)
    )
    stamps = np.array(poses.stamps_ns, dtype=np.int64)
    if (np.diff(stamps) < 0).any():
        order = np.argsort(stamps, kind="stable")
        stamps, positions = stamps[order], positions[order]
    # Some receivers say a pose twice.
    kept = np.concatenate([[True], np.diff(stamps) > 0])
    try:
        return Track(stamps[kept], positions[kept], frame=settings.frame or SCENE_FRAME)
    except CsasError as error:
        hint = _hint(positions, axes, settings)
        raise ImportSettingsError(f"{path}: {error}{hint}") from error


def _hint(positions: FloatArray, axes: str, settings: Settings) -> str:
    below = bool((positions[:, 2] <= 0).any())
    if below and axes != "geographic" and not settings.has("track", "origin_m"):
        return f"; {settings.name} lacks track.origin_m, the {axes} coordinates of the scene's origin"
    if below and axes == "geographic" and not settings.has("origin", "altitude_m"):
        return f"; {settings.name} lacks origin.altitude_m, the altitude of the seabed"
    return ""


def _cartesian(places: FloatArray, axes: str, settings: Settings) -> FloatArray:
    origin = np.array(settings.numbers("track", "origin_m", 3, [0.0, 0.0, 0.0]))
    moved: FloatArray = places - origin
    return moved[:, [1, 0, 2]] * [1.0, 1.0, -1.0] if axes == "ned" else moved


def _geographic(places: FloatArray, datum: Datum | None, path: Path) -> FloatArray:
    if datum is None:
        raise ImportSettingsError(
            f"{path} holds latitudes and longitudes; expected origin.latitude_deg and origin.longitude_deg,"
            " where the scene's origin is"
        )
    rotation, origin = datum.scene_to_earth
    positions = np.empty_like(places)
    for row, (latitude, longitude, altitude) in enumerate(places.tolist()):
        try:
            there = Datum(latitude, longitude, altitude_m=altitude).scene_to_earth[1]
        except CsasError:  # also NaN, as receivers say what they do not know
            raise ImportSettingsError(
                f"{path}: pose {row} is at latitude {latitude:g}, longitude {longitude:g}, altitude"
                f" {altitude:g}; expected degrees, and metres over the ellipsoid"
            ) from None
        positions[row] = rotation.T @ (there - origin)
    return positions


def _lever_arms(poses: Poses, settings: Settings, path: Path) -> FloatArray:
    from scipy.spatial.transform import Rotation

    arm = settings.numbers("track", "lever_arm_m", 3)
    if not poses.turns:
        raise ImportSettingsError(f"{path} holds no orientations; expected none of track.lever_arm_m")
    turns = np.array(poses.turns)
    bad = np.flatnonzero(~(np.abs(np.linalg.norm(turns, axis=1) - 1.0) < 0.01))
    if bad.size:
        raise ImportSettingsError(
            f"{path}: pose {bad[0]} has the orientation {turns[bad[0]].tolist()}; expected a unit quaternion"
        )
    turned: FloatArray = Rotation.from_quat(turns).apply(arm)
    return turned


# -- CSV --------------------------------------------------------------------------------------------


def _of_csv(path: Path, settings: Settings, axes: str) -> Poses:
    names = settings.mapping("track", "columns")
    poses = Poses()
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            sample = file.read(4096)
            file.seek(0)
            delimiter = max(",;\t", key=sample.count) if any(c in sample for c in ",;\t") else " "
            reader = csv.DictReader(file, delimiter=delimiter, skipinitialspace=True)
            columns = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = columns
            time, unit = _time_column(columns, names, settings, path)
            third, sign = AXES[axes][2], 1.0
            if axes == "geographic" and "depth" in names:
                third, sign = "depth", -1.0
            wanted = [_column(name, columns, names, path) for name in (*AXES[axes][:2], third)]
            for row in reader:
                line = reader.line_num
                a, b, c = (_number(row, name, path, line) for name in wanted)
                poses.stamps_ns.append(_stamp(row.get(time), unit, path, line))
                poses.places.append((a, b, sign * c))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImportSettingsError(f"{path} cannot be read: {error}; expected CSV with a header") from error
    return poses


def _column(what: str, columns: Sequence[str], names: dict[str, str], path: Path) -> str:
    name = names.get(what, what)
    if name not in columns:
        why = "track.columns says so" if what in names else f"track.columns.{what} names no other"
        raise ImportSettingsError(
            f"{path} has no column {name!r} ({why}); its columns are: {', '.join(columns) or 'none'}"
        )
    return name


def _time_column(
    columns: Sequence[str], names: dict[str, str], settings: Settings, path: Path
) -> tuple[str, str]:
    unit = ""
    if settings.has("track", "time_unit"):
        unit = settings.one_of("track", "time_unit", [*_UNITS, "iso"])
    if "time" in names:
        time = _column("time", columns, names, path)
        unit = unit or _TIME_NAMES.get(time.lower(), "")
        if not unit:
            raise ImportSettingsError(f"{settings.name} lacks track.time_unit; expected s, ms, us, ns or iso")
        return time, unit
    known = [name for name in columns if name.lower() in _TIME_NAMES]
    if len(known) != 1:
        raise ImportSettingsError(
            f"{settings.name} lacks track.columns.time; columns of {path} are: {', '.join(columns)}"
        )
    return known[0], unit or _TIME_NAMES[known[0].lower()]


def _number(row: dict[str, Any], name: str, path: Path, line: int) -> float:
    try:
        return float(row[name])
    except (TypeError, ValueError):
        raise ImportSettingsError(
            f"{path}, line {line}: {name} is {str(row[name])[:40]!r}; expected a number"
        ) from None


def _stamp(text: Any, unit: str, path: Path, line: int) -> int:
    try:
        if unit == "iso":
            parts = _ISO.fullmatch(str(text).strip())
            if parts is None:
                raise ValueError(text)
            zone = "+00:00" if parts[3] in (None, "Z") else parts[3]
            since = datetime.fromisoformat(parts[1] + zone) - datetime(1970, 1, 1, tzinfo=timezone.utc)
            # datetime knows microseconds.
            fraction = int((parts[2] or "0")[:9].ljust(9, "0"))
            return (since.days * 86_400 + since.seconds) * NANOSECONDS + fraction
        # A float of seconds since 1970 is good to 0.2 µs alone.
        return int((Decimal(str(text)) * 10 ** _UNITS[unit]).to_integral_value())
    except (ValueError, InvalidOperation, OverflowError):
        raise ImportSettingsError(
            f"{path}, line {line}: time is {str(text)[:40]!r}; expected {unit}"
        ) from None


# -- bags -------------------------------------------------------------------------------------------


def _pose(pose: Any) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    p, q = pose.position, pose.orientation
    return (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)


#: Types of messages that tell a pose each, and where.
_POSES: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/Odometry": lambda m: m.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda m: m.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: m.pose.pose,
}
_FIX = "sensor_msgs/msg/NavSatFix"


def _of_bag(path: Path, settings: Settings) -> tuple[Poses, bool]:
    """Return the poses of a bag, and whether they are latitudes, longitudes and altitudes."""
    reader = BagReader(path)
    if settings.has("track", "frames"):
        return _of_transforms(reader, *settings.names("track", "frames")), False
    fit = {name: info.type_name for name, info in reader.topics.items() if info.type_name in (*_POSES, _FIX)}
    if settings.has("track", "topic"):
        topic = settings.text("track", "topic")
        if topic not in fit:
            told = reader.topics.get(topic)
            what = "no topic" if told is None else f"a {told.type_name} on"
            raise ImportSettingsError(
                f"{path} has {what} {topic}; expected one of: {', '.join(fit) or ', '.join((*_POSES, _FIX))}"
            )
    elif len(fit) != 1:
        hint = " (or track.frames, of its transforms)" if _transform_topics(reader) else ""
        raise ImportSettingsError(
            f"{settings.name} lacks track.topic{hint}; navigation in {path} is: {', '.join(fit) or 'none'}"
        )
    else:
        (topic,) = fit
    poses, frames = Poses(), set[str]()
    for message in reader.messages():
        if message.topic != topic:
            continue
        decoded = message.decode()
        frames.add(str(decoded.header.frame_id))
        poses.stamps_ns.append(stamp_to_ns(decoded.header.stamp, f"{topic}.header.stamp"))
        if fit[topic] == _FIX:
            poses.places.append((decoded.latitude, decoded.longitude, decoded.altitude))
            continue
        place, turn = _pose(_POSES[fit[topic]](decoded))
        poses.places.append(place)
        poses.turns.append(turn)
    if len(frames) > 1:
        raise ImportSettingsError(f"{topic} of {path} is in frames {', '.join(sorted(frames))}; expected one")
    return poses, fit[topic] == _FIX


def _transform_topics(reader: BagReader) -> list[str]:
    return [name for name, info in reader.topics.items() if info.type_name == _TF]


@dataclass(eq=False)
class _Edge:
    """A transform from a child frame to its parent over time."""

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    places: list[tuple[float, float, float]] = field(default_factory=list)
    turns: list[tuple[float, float, float, float]] = field(default_factory=list)

    def at(self, stamps: NDArray[np.int64]) -> tuple[NDArray[np.bool_], FloatArray, Any]:
        """Return at which stamps it is known, and its translations and rotations there."""
        from scipy.spatial.transform import Rotation, Slerp

        if self.static or len(self.stamps) == 1:
            n, last = len(stamps), len(self.places) - 1
            turn = Rotation.from_quat(np.tile(self.turns[last], (n, 1)))
            return np.ones(n, bool), np.tile(self.places[last], (n, 1)), turn
        times, first = np.unique(np.array(self.stamps, dtype=np.int64), return_index=True)
        places, turns = np.array(self.places)[first], np.array(self.turns)[first]
        after = np.clip(np.searchsorted(times, stamps), 1, len(times) - 1)
        apart = (times[after] - times[after - 1]) <= _MOST_APART_S * NANOSECONDS
        known = (stamps >= times[0]) & (stamps <= times[-1]) & apart
        seconds, wanted = (
            (t - times[0]) / NANOSECONDS for t in (times, np.clip(stamps, times[0], times[-1]))
        )
        moved = np.stack([np.interp(wanted, seconds, places[:, k]) for k in range(3)], axis=1)
        return known, moved, Slerp(seconds, Rotation.from_quat(turns))(wanted)


def _of_transforms(reader: BagReader, parent: str, child: str) -> Poses:
    """Follow the transforms from one frame up to another, at the stamps of the one that comes most often."""
    edges = _edges(reader)
    chain: list[_Edge] = []
    frame = child
    while frame != parent:
        edge = edges.get(frame)
        if edge is None or len(chain) > len(edges):
            frames = sorted({*edges, *(one.parent for one in edges.values())})
            raise ImportSettingsError(
                f"{reader.path}: transforms lead from {child!r} to {frame!r}, not to {parent!r}; its frames"
                f" are: {', '.join(frames) or 'none'}"
            )
        chain.append(edge)
        frame = edge.parent
    moving = [edge for edge in chain if not edge.static]
    if not moving:
        raise ImportSettingsError(
            f"{reader.path}: {child!r} stands still in {parent!r}; expected a transform that moves"
        )
    stamps = np.unique(np.array(max(moving, key=lambda edge: len(edge.stamps)).stamps, dtype=np.int64))
    known = np.ones(len(stamps), bool)
    places: FloatArray = np.zeros((len(stamps), 3))
    turn: Any = None
    for edge in chain:  # p' = R p + t, from the sonar upwards
        there, moved, turned = edge.at(stamps)
        known &= there
        places = turned.apply(places) + moved
        turn = turned if turn is None else turned * turn
    quaternions = turn.as_quat()[known].tolist()
    return Poses(stamps[known].tolist(), [tuple(p) for p in places[known].tolist()], quaternions)


def _edges(reader: BagReader) -> dict[str, _Edge]:
    edges: dict[str, _Edge] = {}
    parents: dict[str, set[str]] = defaultdict(set)
    for topic, transform in _transforms(reader):
        child, parent = str(transform.child_frame_id), str(transform.header.frame_id)
        static = topic.endswith("tf_static")
        parents[child].add(parent)
        edge = edges.setdefault(child, _Edge(parent, static))
        if edge.parent != parent:
            told = ", ".join(sorted(parents[child]))
            raise ImportSettingsError(f"{reader.path}: {child!r} has the parents {told}; expected one")
        t, q = transform.transform.translation, transform.transform.rotation
        edge.stamps.append(stamp_to_ns(transform.header.stamp, f"{topic}.header.stamp"))
        edge.places.append((t.x, t.y, t.z))
        edge.turns.append((q.x, q.y, q.z, q.w))
    return edges


def _transforms(reader: BagReader) -> Iterator[tuple[str, Any]]:
    topics = set(_transform_topics(reader))
    for message in reader.messages():
        if message.topic in topics:
            for transform in message.decode().transforms:
                yield message.topic, transform
