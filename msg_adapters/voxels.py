"""sensor_msgs/PointCloud2 to and from the voxels that may be object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.errors import AdapterError, quoted
from csas_shadow_ros.core.shape.volume import VoxelGrid

from .messages import MessageFactory, check_type, frame_of, make_header, stamp_to_ns
from .topics import POINT_CLOUD

_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "l_out", "views"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2"],
        "offsets": [0, 4, 8, 12, 16],
        "itemsize": 20,
    }
)
#: sensor_msgs/PointField datatypes.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_CODES = {name: code for code, name in _DATATYPES.items()}
_ALLOWED = {"x": ("f4",), "y": ("f4",), "z": ("f4",), "l_out": ("f4",), "views": ("u2", "u4")}


@dataclass(frozen=True, eq=False)
class Voxels:
    """A list of voxels.

    Parameters
    ----------
    stamp_ns : int
        Stamp, ns.
    points_m : ndarray of float32, shape (n, 3)
        Centres (x, y, z), scene frame.
    l_out : ndarray of float32, shape (n,)
        Mean likelihood of lying outside.
    views : ndarray of uint16 or uint32, shape (n,)
        How many views know something of the voxel.
    """

    stamp_ns: int
    points_m: NDArray[np.float32]
    l_out: NDArray[np.float32]
    views: NDArray[Any]


def voxels_to_msg(
    factory: MessageFactory, grid: VoxelGrid | None, stamp_ns: int, where: NDArray[np.bool_] | None = None
) -> Any:
    """Make the cloud of a grid's voxels that may be object.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    grid : VoxelGrid or None
        The grid; None: no voxels.
    stamp_ns : int
        Stamp, ns.
    where : ndarray of bool, shape (nz, ny, nx), optional
        Which voxels; the occupied ones by default.

    Raises
    ------
    AdapterError
        If `where` is not the grid's shape.
    """
    points = np.zeros(0, _POINT) if grid is None else _points(grid, grid.occupied if where is None else where)
    fields = [
        factory.make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=int(_POINT.fields[name][1]),  # type: ignore[index]
            datatype=_CODES[_POINT[name].str[1:]],
            count=1,
        )
        for name in _POINT.names or ()
    ]
    return factory.make(
        POINT_CLOUD,
        header=make_header(factory, stamp_ns),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=_POINT.itemsize,
        row_step=_POINT.itemsize * len(points),
        is_dense=True,
        data=factory.octets(points),
    )


def _points(grid: VoxelGrid, chosen: NDArray[np.bool_]) -> NDArray[Any]:
    if chosen.shape != grid.volume.shape:
        raise AdapterError(f"voxels: choice has shape {chosen.shape}; expected {grid.volume.shape} (z, y, x)")
    iz, iy, ix = np.nonzero(chosen)
    points = np.zeros(iz.size, _POINT)
    points["x"], points["y"], points["z"] = grid.volume.x_m[ix], grid.volume.y_m[iy], grid.volume.z_m[iz]
    points["l_out"] = grid.likelihood[iz, iy, ix]
    points["views"] = grid.views[iz, iy, ix]
    return points


def voxels_from_msg(msg: Any, where: str = "voxels") -> Voxels:
    """Read a cloud of voxels; other fields than x, y, z, l_out and views are passed over.

    Parameters
    ----------
    msg : sensor_msgs/PointCloud2
        Of either message world.
    where : str
        Its topic, for errors.

    Raises
    ------
    AdapterError
        If a field is missing, of another type or outside its point, the sizes contradict each other,
        or a position is not finite.
    """
    check_type(msg, POINT_CLOUD, where)
    frame_of(msg, where)
    points = _records(msg, _fields(msg, where), where)
    xyz = np.column_stack([points[c] for c in "xyz"]).astype(np.float32)
    bad = np.flatnonzero(~np.isfinite(xyz).all(axis=1))
    if bad.size:
        raise AdapterError(
            f"{where} has {bad.size} of {len(points)} points not finite, the first at {bad[0]}"
            f" ({xyz[bad[0]].tolist()}); expected finite metres"
        )
    views = points["views"]
    return Voxels(
        stamp_to_ns(msg.header.stamp, f"{where}.header.stamp"),
        xyz,
        points["l_out"].astype(np.float32),
        views.astype(views.dtype.newbyteorder("=")),
    )


def _fields(msg: Any, where: str) -> dict[str, tuple[str, int]]:
    """Return type and offset of each field of a voxel; refuse a cloud that lacks one."""
    found: dict[str, tuple[str, int]] = {}
    for field in msg.fields:
        if field.name not in _ALLOWED:
            continue
        kind = _DATATYPES.get(int(field.datatype), str(field.datatype))
        if kind not in _ALLOWED[field.name]:
            raise AdapterError(
                f"{where}.fields: {field.name} has datatype {field.datatype} ({kind});"
                f" expected {' or '.join(_ALLOWED[field.name])}"
            )
        if int(field.count) > 1:
            raise AdapterError(f"{where}.fields: {field.name} has count {field.count}; expected 1")
        end = int(field.offset) + np.dtype(kind).itemsize
        if end > int(msg.point_step):
            raise AdapterError(
                f"{where}.fields: {field.name} ends at byte {end};"
                f" expected inside point_step, {int(msg.point_step)}"
            )
        found[field.name] = (kind, int(field.offset))
    if missing := [name for name in _ALLOWED if name not in found]:
        raise AdapterError(f"{where}.fields lacks {quoted(missing[0])}; expected {', '.join(_ALLOWED)}")
    return found


def _records(msg: Any, fields: dict[str, tuple[str, int]], where: str) -> NDArray[Any]:
    """Return a cloud's points as records of those fields; refuse sizes that contradict each other."""
    step, rows, cols, row_step = int(msg.point_step), int(msg.height), int(msg.width), int(msg.row_step)
    if row_step < step * cols:
        raise AdapterError(
            f"{where}.row_step is {row_step} bytes; expected {step * cols} ({cols} points of {step} bytes)"
        )
    if len(msg.data) != row_step * rows:
        raise AdapterError(
            f"{where}.data has {len(msg.data)} bytes; expected row_step * height = {row_step * rows}"
        )
    order = ">" if msg.is_bigendian else "<"
    dtype = np.dtype(
        {
            "names": list(fields),
            "formats": [order + kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": step,
        }
    )
    if not rows * cols:
        return np.empty(0, dtype)
    raw = np.frombuffer(msg.data, np.uint8)
    if row_step != step * cols:
        raw = np.ascontiguousarray(raw.reshape(rows, row_step)[:, : step * cols]).reshape(-1)
    return raw.view(dtype)
