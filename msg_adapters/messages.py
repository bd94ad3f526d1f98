"""Two worlds of message classes behind one interface: rclpy's, and rosbags' dataclasses.

Nothing here imports ROS when the module is imported; `RclpyMessages` looks its classes up when it
makes its first message. Readers are duck-typed and need no factory at all.
"""

from __future__ import annotations

import array
import importlib
import math
import struct
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.errors import MAX_STAMP_NS, AdapterError, quoted
from csas_shadow_ros.core.frame_name import SCENE_FRAME as SCENE_FRAME
from csas_shadow_ros.core.frame_name import check_frame

NANOSECONDS = 1_000_000_000

#: Defaults that are not zero or empty in the common interfaces.
_DEFAULTS: dict[str, dict[str, Any]] = {
    "geometry_msgs/msg/Quaternion": {"w": 1.0},
    "sensor_msgs/msg/NavSatStatus": {"status": -2},
}

FLOAT_TYPES = ("float", "double", "float32", "float64")

#: No place on Earth has a larger coordinate on any map (m): half of the equator. UTM has up to 10 000 km.
MAX_COORDINATE_M = 2.004e7


class MessageFactory(Protocol):
    """What a writer needs from a message library."""

    #: Frame of the headers that are made with it.
    frame_id: str

    def in_frame(self, frame_id: str) -> MessageFactory:
        """Return the same factory for another frame."""

    def cls(self, type_name: str) -> Any:
        """Return the message class of a type such as ``sensor_msgs/msg/Image``."""

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message; omitted fields keep their defaults."""

    def octets(self, data: NDArray[Any]) -> Any:
        """Return a C-contiguous array's memory as the value of a ``uint8[]`` field."""

    def doubles(self, values: Any) -> Any:
        """Return numbers as the value of a ``float64[]`` field."""

    def octet(self, value: int) -> Any:
        """Return a number as the value of a ``byte`` field."""


class RclpyMessages:
    """Messages of an installed ROS 2 (needs the message packages, not a running node).

    Parameters
    ----------
    frame_id : str
        Frame of the headers that are made with it.
    """

    def __init__(self, frame_id: str = SCENE_FRAME) -> None:
        self.frame_id = frame_id
        self._classes: dict[str, Any] = {}

    def in_frame(self, frame_id: str) -> RclpyMessages:
        """Return the same factory for another frame."""
        if frame_id == self.frame_id:
            return self
        other = RclpyMessages(frame_id)
        other._classes = self._classes
        return other

    def cls(self, type_name: str) -> Any:
        """Return the message class of a type such as ``sensor_msgs/msg/Image``.

        Raises
        ------
        AdapterError
            If that message package is not installed.
        """
        found = self._classes.get(type_name)
        if found is None:
            package, _, name = type_name.split("/")
            try:
                found = getattr(importlib.import_module(f"{package}.msg"), name)
            except (ImportError, AttributeError) as error:
                raise AdapterError(
                    f"message type {type_name} is not installed ({error}); expected a ROS 2 environment,"
                    " or pip install 'csas_shadow_ros[ros]'"
                ) from error
            self._classes[type_name] = found
        return found

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message; omitted fields keep their defaults."""
        large = fields.pop("data") if isinstance(fields.get("data"), array.array) else None
        message = self.cls(type_name)(**fields)
        if large is not None:
            _hand_over(message, large)
        return message

    def octets(self, data: NDArray[Any]) -> array.array[int]:
        """Return an array's memory as ``array.array('B')``: rclpy copies an ndarray 1000 times slower."""
        out = array.array("B")
        if data.size:
            out.frombytes(np.ascontiguousarray(data).data.cast("B"))
        return out

    def doubles(self, values: Any) -> array.array[float]:
        """Return numbers as ``array.array('d')``."""
        return array.array("d", [float(v) for v in values])

    def octet(self, value: int) -> bytes:
        """Return a ``byte`` as rclpy wants it: a bytes object of length one."""
        return bytes([value])


def _hand_over(message: Any, data: array.array[int]) -> None:
    """Set a message's `data` without a copy.

    Constructor and setter that ROS 2 generates (Jazzy) each make one, unless the setter checks its value.
    """
    unchecked = getattr(message, "_check_fields", None) is False
    if unchecked:
        message._check_fields = True
    message.data = data
    if unchecked:
        message._check_fields = False


class RosbagsMessages:
    """Dataclass messages of the rosbags library (Jazzy definitions); no ROS needed.

    Parameters
    ----------
    frame_id : str
        Frame of the headers that are made with it.
    """

    def __init__(self, frame_id: str = SCENE_FRAME) -> None:
        self.frame_id = frame_id

    def in_frame(self, frame_id: str) -> RosbagsMessages:
        """Return the same factory for another frame."""
        return RosbagsMessages(frame_id)

    @staticmethod
    def _store() -> Any:
        return typestore()

    def cls(self, type_name: str) -> Any:
        """Return the message class of a type such as ``sensor_msgs/msg/Image``.

        Raises
        ------
        AdapterError
            If the type is unknown.
        """
        try:
            return self._store().types[type_name]
        except KeyError:
            raise AdapterError(f"message type {type_name} is unknown to rosbags' Jazzy definitions") from None

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message; omitted fields keep their defaults."""
        cls = self.cls(type_name)
        names = self._store().fielddefs[type_name][1]
        known = {name for name, _ in names}
        if unknown := sorted(set(fields) - known):
            raise AdapterError(
                f"{type_name} has no field {quoted(unknown[0])}; expected one of: {', '.join(sorted(known))}"
            )
        fields = _DEFAULTS.get(type_name, {}) | fields
        return cls(**{name: fields[name] if name in fields else self._default(kind) for name, kind in names})

    def _default(self, kind: Any) -> Any:
        node, detail = kind
        label = node.name
        if label == "NAME":
            return self.make(detail)
        if label == "BASE":
            base = detail[0]
            return "" if base == "string" else False if base == "bool" else 0.0 if base in FLOAT_TYPES else 0
        (inner_node, inner), length = detail
        if inner_node.name == "BASE" and inner[0] != "string":
            return np.zeros(length if label == "ARRAY" else 0, dtype=_numpy_name(inner[0]))
        return [self._default((inner_node, inner)) for _ in range(length if label == "ARRAY" else 0)]

    def octets(self, data: NDArray[Any]) -> NDArray[np.uint8]:
        """Return an array's memory as uint8, without a copy if it is C-contiguous."""
        return np.ascontiguousarray(data).reshape(-1).view(np.uint8)

    def doubles(self, values: Any) -> NDArray[np.float64]:
        """Return numbers as a float64 array."""
        return np.array(values, dtype=np.float64)

    def octet(self, value: int) -> int:
        """Return a ``byte`` as rosbags wants it: an int."""
        return int(value)


def _numpy_name(base: str) -> str:
    return {"byte": "uint8", "char": "uint8", "octet": "uint8"}.get(base, base)


@lru_cache(maxsize=1)
def typestore() -> Any:
    """Return the shared rosbags type store (Jazzy)."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def message_from_cdr(cdr: bytes | memoryview, type_name: str, where: str) -> Any:
    """Deserialise to a rosbags message, whose arrays are views of the bytes: nothing is copied.

    Raises
    ------
    KeyError
        If the type is unknown.
    AdapterError
        If the bytes are no message of it.
    """
    if type_name == PackedPath.__msgtype__:
        return PackedPath(cdr, where)
    return _decoded(cdr, type_name, where)


def _decoded(cdr: bytes | memoryview, type_name: str, where: str) -> Any:
    from rosbags.serde import SerdeError

    try:
        # Of bytes rosbags would take a slice, which is a copy of them all.
        return typestore().deserialize_cdr(memoryview(cdr), type_name)
    except (SerdeError, AssertionError, IndexError, OverflowError, MemoryError, ValueError) as error:
        # Also text that is no UTF-8, whose error quotes all of the text.
        reason = type(error).__name__ if isinstance(error, ValueError) else str(error)[:120] or "too short"
        raise AdapterError(f"{where} is not a {type_name}: {reason}") from error


#: A Path of more is refused: 200 Hz, as fast as inertial navigation comes, over 83 minutes. At half of it
#: all of such a mission in one Path is refused; at double a message of 160 MB is taken.
MAX_POSES = 1_000_000
#: What follows a pose's header: position and orientation.
_POSE_BYTES = 56


class PackedPath:
    """A serialised nav_msgs/Path, read without an object for each pose: 200 000 take seconds otherwise.

    Parameters
    ----------
    cdr : bytes-like
        The message.
    where : str
        What it is, for errors.

    Raises
    ------
    AdapterError
        If the bytes are no Path, or it has too many poses.
    """

    __msgtype__ = "nav_msgs/msg/Path"

    def __init__(self, cdr: bytes | memoryview, where: str) -> None:
        self._cdr, self._where = memoryview(cdr).cast("B"), where
        self._message: Any = None
        #: Stamp (sec, nanosec) and position of each pose, and the frame of all; None if that is not one.
        self.table: tuple[NDArray[np.int64], NDArray[np.float64], str] | None = None
        body = self._cdr[4:]
        if len(body) < 16 or self._cdr[0] != 0 or self._cdr[1] > 1:
            raise AdapterError(f"{where} is not a {self.__msgtype__}: too short, or not plain CDR")
        order = "<" if self._cdr[1] == 1 else ">"
        (length,) = struct.unpack_from(f"{order}I", body, 8)
        at = 12 + length + -length % 4
        if at + 4 > len(body):
            raise AdapterError(f"{where} is not a {self.__msgtype__}: too short")
        (self.count,) = struct.unpack_from(f"{order}I", body, at)
        if self.count > MAX_POSES:
            raise AdapterError(f"{where} has {self.count} poses; expected at most {MAX_POSES}")
        if self.count:
            self.table = self._alike(body, at + 4, order)
        if self.table is None:
            self._message = _decoded(cdr, self.__msgtype__, where)
            self.header = self._message.header
            return
        sec, nanosec = struct.unpack_from(f"{order}iI", body, 0)
        factory = RosbagsMessages()
        self.header = factory.make(
            "std_msgs/msg/Header",
            stamp=factory.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec),
            frame_id=_text(body[12 : 12 + length], where),
        )

    def _alike(
        self, body: memoryview, at: int, order: str
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], str] | None:
        """Read poses whose frames are all the same, so that they lie evenly; None if they do not."""
        if at + 12 > len(body):
            return None
        (length,) = struct.unpack_from(f"{order}I", body, at + 8)
        # Doubles begin at multiples of 8, so all poses but the first are aligned alike.
        size = 12 + length
        first_end = at + size + -(at + size) % 8 + _POSE_BYTES
        stride = size + -size % 8 + _POSE_BYTES
        if not length or first_end + (self.count - 1) * stride != len(body):
            return None
        stamps = np.empty((self.count, 2), np.int64)
        positions = np.empty((self.count, 3))
        name = bytes(body[at + 12 : at + size])
        stamps[0] = struct.unpack_from(f"{order}iI", body, at)
        positions[0] = struct.unpack_from(f"{order}3d", body, first_end - _POSE_BYTES)
        if self.count > 1:
            row = np.dtype(
                {
                    "names": ["sec", "nanosec", "length", "name", "xyz"],
                    "formats": [f"{order}i4", f"{order}u4", f"{order}u4", f"({length},)u1", f"(3,){order}f8"],
                    "offsets": [0, 4, 8, 12, stride - _POSE_BYTES],
                    "itemsize": stride,
                }
            )
            rows = np.frombuffer(body, row, self.count - 1, first_end)
            alike = (rows["length"] == length).all() and (rows["name"] == np.frombuffer(name, np.uint8)).all()
            if not alike:
                return None
            stamps[1:, 0], stamps[1:, 1], positions[1:] = rows["sec"], rows["nanosec"], rows["xyz"]
        return stamps, positions, _text(memoryview(name), self._where)

    @property
    def poses(self) -> Any:
        """The poses, one by one."""
        if self._message is None:
            self._message = _decoded(self._cdr, self.__msgtype__, self._where)
        return self._message.poses


def _text(raw: memoryview, where: str) -> str:
    try:
        return bytes(raw[:-1]).decode()
    except UnicodeDecodeError:
        raise AdapterError(f"{where} is not a {PackedPath.__msgtype__}: a frame is not UTF-8") from None


def type_name_of(msg: Any) -> str:
    """Return ``package/msg/Name`` of a message of either world.

    Raises
    ------
    AdapterError
        If the object is not a message.
    """
    name = getattr(msg, "__msgtype__", None)
    if isinstance(name, str):
        return name
    cls = type(msg)
    if hasattr(cls, "get_fields_and_field_types"):
        package, kind = cls.__module__.split(".")[:2]
        return f"{package}/{kind}/{cls.__name__}"
    raise AdapterError(
        f"{cls.__module__}.{cls.__qualname__} is not a ROS message; expected an rclpy or rosbags one"
    )


def check_type(msg: Any, type_name: str, where: str) -> None:
    """Refuse a message of another type.

    Raises
    ------
    AdapterError
        Naming both types.
    """
    actual = type_name_of(msg)
    if actual != type_name:
        raise AdapterError(f"{where} is a {actual}; expected {type_name}")


def stamp_to_ns(stamp: Any, where: str = "header.stamp") -> int:
    """Read a ``builtin_interfaces/Time`` as nanoseconds.

    Raises
    ------
    AdapterError
        If it is before 1970 or its nanoseconds are not below one second.
    """
    sec, nanosec = int(stamp.sec), int(stamp.nanosec)
    if sec < 0 or not 0 <= nanosec < NANOSECONDS:
        raise AdapterError(f"{where} is {sec} s {nanosec} ns; expected sec >= 0 and nanosec in [0, 1e9)")
    return sec * NANOSECONDS + nanosec


def data_stamp_to_ns(stamp: Any, where: str) -> int:
    """Read the stamp of an image or a sector as nanoseconds.

    Raises
    ------
    AdapterError
        If it is no time, or 0: that is what ROS has where nobody set a stamp, or no clock runs.
    """
    found = stamp_to_ns(stamp, where)
    if not found:
        raise AdapterError(f"{where} is 0; expected the time when its last data came")
    return found


def check_data_stamp(stamp_ns: int, where: str) -> None:
    """Refuse to write an image or a sector with stamp 0, which no reader accepts.

    Raises
    ------
    AdapterError
        Naming it.
    """
    if stamp_ns == 0:
        raise AdapterError(f"{where} has stamp 0 ns; expected the time when its last data came")


def stamp_from_ns(factory: MessageFactory, stamp_ns: int) -> Any:
    """Make a ``builtin_interfaces/Time``.

    Raises
    ------
    AdapterError
        If the stamp does not fit one (int32 seconds).
    """
    stamp = int(stamp_ns)
    if not 0 <= stamp <= MAX_STAMP_NS:
        raise AdapterError(f"stamp is {stamp} ns; expected a time in [0, 2^31 s)")
    return factory.make("builtin_interfaces/msg/Time", sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)


def make_header(factory: MessageFactory, stamp_ns: int) -> Any:
    """Make a ``std_msgs/Header`` in the factory's frame."""
    stamp = stamp_from_ns(factory, stamp_ns)
    return factory.make("std_msgs/msg/Header", stamp=stamp, frame_id=factory.frame_id)


def frame_of(msg: Any, where: str, expected: str = "") -> str:
    """Return the frame of a message.

    Parameters
    ----------
    msg : message with a header
        Of either message world.
    where : str
        What it is, for errors.
    expected : str
        The one frame that it may be in; empty: any that has a name.

    Raises
    ------
    AdapterError
        If it has none, or another one; the error names it.
    """
    frame = check_frame(f"{where}.header.frame_id", msg.header.frame_id, AdapterError)
    if expected and frame != expected:
        raise AdapterError(f"{where}.header.frame_id is {quoted(frame)}; expected {expected!r}")
    return frame


def point(factory: MessageFactory, xyz: Any, type_name: str = "geometry_msgs/msg/Point") -> Any:
    """Make a Point or a Vector3."""
    x, y, z = (float(v) for v in xyz)
    return factory.cls(type_name)(x=x, y=y, z=z)


def xyz_of(value: Any, where: str) -> tuple[float, float, float]:
    """Read a Point or a Vector3.

    Raises
    ------
    AdapterError
        If a coordinate is not finite.
    """
    xyz = (float(value.x), float(value.y), float(value.z))
    if not all(math.isfinite(v) for v in xyz):
        raise AdapterError(f"{where} is {xyz}; expected finite metres")
    return xyz
