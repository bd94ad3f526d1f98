"""Two worlds of message classes behind one interface: rclpy's, and rosbags' dataclasses.

Nothing here imports ROS when the module is imported; `RclpyMessages` looks its classes up when it
makes its first message. Readers are duck-typed and need no factory at all.
"""

from __future__ import annotations

import array
import importlib
import math
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.errors import AdapterError

SCENE_FRAME = "csas_scene"
NANOSECONDS = 1_000_000_000
#: ``builtin_interfaces/Time.sec`` is an int32.
MAX_STAMP_NS = (1 << 31) * NANOSECONDS - 1

#: Defaults that are not zero or empty in the common interfaces.
_DEFAULTS: dict[str, dict[str, Any]] = {"geometry_msgs/msg/Quaternion": {"w": 1.0}}

FLOAT_TYPES = ("float", "double", "float32", "float64")


class MessageFactory(Protocol):
    """What a writer needs to know of a message world."""

    def cls(self, type_name: str) -> Any:
        """Return the message class of a type such as ``sensor_msgs/msg/Image``."""

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message; fields that are not given have their default value."""

    def octets(self, data: NDArray[Any]) -> Any:
        """Return a C-contiguous array's memory as the value of a ``uint8[]`` field."""

    def doubles(self, values: Any) -> Any:
        """Return numbers as the value of a ``float64[]`` field."""

    def octet(self, value: int) -> Any:
        """Return a number as the value of a ``byte`` field."""


class RclpyMessages:
    """Messages of an installed ROS 2 (needs the message packages, not a running node)."""

    def __init__(self) -> None:
        self._classes: dict[str, Any] = {}

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
        """Make a message; fields that are not given have their default value."""
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
    """Dataclass messages of the rosbags library (Jazzy definitions); no ROS needed."""

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
        """Make a message; fields that are not given have their default value."""
        cls = self.cls(type_name)
        names = self._store().fielddefs[type_name][1]
        known = {name for name, _ in names}
        if unknown := sorted(set(fields) - known):
            raise AdapterError(
                f"{type_name} has no field {unknown[0]!r}; expected one of: {', '.join(sorted(known))}"
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
    from rosbags.serde import SerdeError

    try:
        # Of bytes rosbags would take a slice, which is a copy of them all.
        return typestore().deserialize_cdr(memoryview(cdr), type_name)
    except (SerdeError, AssertionError, IndexError, OverflowError, MemoryError) as error:
        raise AdapterError(f"{where} is no {type_name}: {error or 'too short'}") from error


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


def make_header(factory: MessageFactory, stamp_ns: int, frame_id: str = SCENE_FRAME) -> Any:
    """Make a ``std_msgs/Header`` in the scene frame."""
    return factory.make("std_msgs/msg/Header", stamp=stamp_from_ns(factory, stamp_ns), frame_id=frame_id)


def check_frame(msg: Any, where: str) -> None:
    """Refuse a message that is not in the scene frame.

    Raises
    ------
    AdapterError
        Naming the frame.
    """
    frame = msg.header.frame_id
    if frame != SCENE_FRAME:
        raise AdapterError(f"{where}.header.frame_id is {frame!r}; expected {SCENE_FRAME!r}")


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
