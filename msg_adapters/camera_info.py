"""sensor_msgs/CameraInfo to and from grids, bands and shadow cameras."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.errors import AdapterError, CsasError, quoted
from csas_shadow_ros.core.geometry import (
    SCENE_FRAME,
    TWO_PI,
    Acoustics,
    GroundGrid,
    GroundLattice,
    ShadowCamera,
    ViewInfo,
    down_range_axis,
    ground_from_projection,
    wrap_angle,
)
from csas_shadow_ros.core.sectors.sector import Sector
from csas_shadow_ros.core.shape.volume import Volume

from .messages import (
    MAX_COORDINATE_M,
    MessageFactory,
    check_type,
    frame_of,
    make_header,
    stamp_to_ns,
)
from .topics import (
    CAMERA_INFO,
    CSAS_IMAGE,
    CSAS_SECTOR,
    CSAS_VOXEL_GRID,
    D_ENTRIES,
    VIEW_STREAMS,
    stream,
)

#: How far P's rows may point away from the aspect in D before the two contradict each other.
MAX_ASPECT_MISMATCH_RAD = math.radians(5.0)

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class GroundInfo:
    """Everything about a ground-plane image except its pixels.

    Parameters
    ----------
    stamp_ns : int
        Stamp, ns.
    grid : GroundGrid
        Its lattice.
    acoustics : Acoustics
        Its band.
    frame : str
        Name of the scene frame.
    """

    stamp_ns: int
    grid: GroundGrid
    acoustics: Acoustics
    frame: str = field(default=SCENE_FRAME, kw_only=True)


@dataclass(frozen=True)
class SectorInfo:
    """Everything about a sector image except its pixels.

    Parameters
    ----------
    stamp_ns : int
        Stamp, ns.
    grid : GroundGrid or GroundLattice
        Its lattice.
    acoustics : Acoustics
        Its band.
    aspect_rad, aperture_rad : float
        Centre and width of the arc.
    carrier_rad_m : (float, float)
        Wavenumber (kx, ky), scene axes, that was divided out.
    frame : str
        Name of the scene frame.
    """

    stamp_ns: int
    grid: GroundGrid | GroundLattice
    acoustics: Acoustics
    aspect_rad: float
    aperture_rad: float
    carrier_rad_m: tuple[float, float]
    frame: str = field(default=SCENE_FRAME, kw_only=True)

    @classmethod
    def of(cls, sector: Sector) -> SectorInfo:
        """Return a sector's info."""
        return cls(
            sector.stamp_ns,
            sector.grid,
            sector.acoustics,
            sector.aspect_rad,
            sector.aperture_rad,
            sector.carrier_rad_m,
            frame=sector.frame,
        )


@contextmanager
def _named(field: str) -> Iterator[None]:
    """Turn core's refusals into ones that name the message's field."""
    try:
        # Huge numbers overflow on the way to being refused: that is no news for a node's standard error.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            yield
    except AdapterError:
        raise
    except CsasError as error:
        raise AdapterError(f"{field}: {error}") from error


def _size(msg: Any, where: str) -> tuple[int, int]:
    rows, cols = int(msg.height), int(msg.width)
    for name, n in (("width", cols), ("height", rows)):
        if n < 1:
            raise AdapterError(f"{where}.{name} is {n} pixels; expected at least 1")
    if int(msg.binning_x) > 1 or int(msg.binning_y) > 1:
        raise AdapterError(f"{where}.binning is {msg.binning_x} by {msg.binning_y}; expected none (0 or 1)")
    roi = msg.roi
    if any((roi.x_offset, roi.y_offset, roi.width, roi.height)):
        raise AdapterError(
            f"{where}.roi is {roi.width} by {roi.height} at {roi.x_offset}, {roi.y_offset};"
            " expected none (all zero)"
        )
    return rows, cols


def _entries(msg: Any, allowed: tuple[str, ...], where: str) -> FloatArray:
    """Return D after checking distortion_model, length and finiteness."""
    model = msg.distortion_model
    if model not in allowed:
        expected = ", ".join(allowed)
        raise AdapterError(f"{where}.distortion_model is {quoted(model)}; expected one of: {expected}")
    names = D_ENTRIES[model]
    d = np.array(msg.d, dtype=np.float64)
    if d.shape != (len(names),):
        raise AdapterError(f"{where}.d has {d.size} entries; expected {len(names)}: {', '.join(names)}")
    for i, (name, value) in enumerate(zip(names, d, strict=True)):
        if name.startswith("focus range"):
            if np.isinf(value):
                raise AdapterError(
                    f"{where}.d[{i}], the {name}, is {value}; expected a number, or NaN before enhancement"
                )
        elif not np.isfinite(value):
            raise AdapterError(f"{where}.d[{i}], the {name}, is {value}; expected a finite number")
    return d


def _acoustics(d: FloatArray, where: str) -> Acoustics:
    if d[3] not in (1.0, -1.0):
        raise AdapterError(f"{where}.d[3], the spectrum_sign, is {d[3]:g}; expected +1 or -1")
    with _named(f"{where}.d"):
        return Acoustics(float(d[0]), float(d[1]), float(d[2]), int(d[3]))


def _aperture(d: FloatArray, where: str) -> tuple[float, float, tuple[float, float]]:
    if not 0 < d[5] <= TWO_PI + 1e-9:
        raise AdapterError(f"{where}.d[5], the aperture width, is {d[5]:g} rad; expected (0, 2 pi]")
    return float(d[4]), float(d[5]), (float(d[6]), float(d[7]))


def _projection(msg: Any, where: str) -> FloatArray:
    p = np.array(msg.p, dtype=np.float64)
    if p.size != 12:
        raise AdapterError(f"{where}.p has {p.size} entries; expected 12 (3 by 4, row by row)")
    return p.reshape(3, 4)


def _ground_grid(msg: Any, where: str) -> GroundGrid:
    rows, cols = _size(msg, where)
    with _named(f"{where}.p"):
        return GroundGrid.from_projection(_projection(msg, where), rows, cols)


def _band(acoustics: Acoustics) -> list[float]:
    return [
        acoustics.centre_frequency_hz,
        acoustics.bandwidth_hz,
        acoustics.sound_speed_mps,
        float(acoustics.spectrum_sign),
    ]


def _make(
    factory: MessageFactory,
    stamp_ns: int,
    shape: tuple[int, int],
    model: str,
    d: list[float],
    k: FloatArray,
    r: FloatArray,
    p: FloatArray,
) -> Any:
    return factory.make(
        CAMERA_INFO,
        header=make_header(factory, stamp_ns),
        height=shape[0],
        width=shape[1],
        distortion_model=model,
        d=factory.doubles(d),
        k=np.array(k, np.float64).reshape(9),
        r=np.array(r, np.float64).reshape(9),
        p=np.array(p, np.float64).reshape(12),
    )


def _make_ground(
    factory: MessageFactory, stamp_ns: int, grid: GroundGrid | GroundLattice, model: str, d: list[float]
) -> Any:
    if isinstance(grid, GroundGrid):
        # A camera that looks straight down with north up: R turns y and z round, K is in pixels a metre.
        k = np.abs(grid.ground_to_pixel)
        k[:2, 2] = grid.ground_to_pixel[:2, 2]
        r = np.diag([1.0, -1.0, -1.0])
    else:
        k = r = np.zeros((3, 3))  # no north-up picture: P alone tells
    return _make(factory, stamp_ns, grid.shape, model, d, k, r, grid.projection)


def ground_info_to_msg(factory: MessageFactory, info: GroundInfo) -> Any:
    """Make the CameraInfo of a ground-plane image (`csas_image`)."""
    factory = factory.in_frame(info.frame)
    return _make_ground(factory, info.stamp_ns, info.grid, CSAS_IMAGE, _band(info.acoustics))


def ground_info_from_msg(msg: Any, stream_name: str = "image") -> GroundInfo:
    """Read the CameraInfo of a ground-plane image (`csas_image`).

    Raises
    ------
    AdapterError
        Naming the field that breaks the contract, its value and what was expected.
    """
    where = stream(stream_name).info_topic
    check_type(msg, CAMERA_INFO, where)
    frame = frame_of(msg, where)
    d = _entries(msg, (CSAS_IMAGE,), where)
    stamp = stamp_to_ns(msg.header.stamp, f"{where}.header.stamp")
    return GroundInfo(stamp, _ground_grid(msg, where), _acoustics(d, where), frame=frame)


def sector_info_to_msg(factory: MessageFactory, info: SectorInfo) -> Any:
    """Make the CameraInfo of a sector (`csas_sector`)."""
    d = [*_band(info.acoustics), info.aspect_rad, info.aperture_rad, *info.carrier_rad_m, math.nan]
    return _make_ground(factory.in_frame(info.frame), info.stamp_ns, info.grid, CSAS_SECTOR, d)


def sector_info_from_msg(msg: Any) -> SectorInfo:
    """Read the CameraInfo of a sector (`csas_sector`).

    Raises
    ------
    AdapterError
        Naming the field that breaks the contract, its value and what was expected.
    """
    where = stream("sector").info_topic
    check_type(msg, CAMERA_INFO, where)
    frame = frame_of(msg, where)
    d = _entries(msg, (CSAS_SECTOR,), where)
    stamp = stamp_to_ns(msg.header.stamp, f"{where}.header.stamp")
    rows, cols = _size(msg, where)
    with _named(f"{where}.p"):
        grid = ground_from_projection(_projection(msg, where), rows, cols)
    acoustics = _acoustics(d, where)
    return SectorInfo(stamp, grid, acoustics, *_aperture(d, where), frame=frame)


def view_info_to_msg(factory: MessageFactory, info: ViewInfo, stream_name: str) -> Any:
    """Make the CameraInfo of a view (`csas_sub_aperture` or `csas_shadow`, as the stream wants).

    Raises
    ------
    AdapterError
        If the stream holds no views.
    """
    kind = stream(stream_name)
    if stream_name not in VIEW_STREAMS:
        raise AdapterError(f"{stream_name!r} holds no views; expected one of: {', '.join(VIEW_STREAMS)}")
    k, r = info.camera.decompose()
    d = [
        *_band(info.acoustics),
        info.aspect_rad,
        info.aperture_rad,
        *info.carrier_rad_m,
        info.focus_range_m,
    ]
    factory = factory.in_frame(info.frame)
    return _make(
        factory, info.stamp_ns, info.camera.shape, kind.distortion_model, d, k, r, info.camera.projection
    )


def view_info_from_msg(msg: Any, stream_name: str) -> ViewInfo:
    """Read the CameraInfo of a view.

    Raises
    ------
    AdapterError
        Naming the field that breaks the contract, its value and what was expected; also if P looks
        another way than the aspect in D says.
    """
    kind = stream(stream_name)
    where = kind.info_topic
    check_type(msg, CAMERA_INFO, where)
    frame = frame_of(msg, where)
    d = _entries(msg, (kind.distortion_model,), where)
    acoustics = _acoustics(d, where)
    aspect, aperture, carrier = _aperture(d, where)
    rows, cols = _size(msg, where)
    with _named(f"{where}.p"):
        camera = ShadowCamera(_projection(msg, where), rows, cols)
    if np.abs(camera.sonar_m).max() > MAX_COORDINATE_M:
        sonar = ", ".join(f"{v:.6g}" for v in camera.sonar_m)
        raise AdapterError(
            f"{where}.p puts the sonar at [{sonar}] m; expected coordinates of at most"
            f" {MAX_COORDINATE_M:.6g} m"
        )
    down = camera.pixel_to_ground[:2, 1]
    along = float(down @ down_range_axis(aspect)) / float(np.hypot(*down))
    if along < math.cos(MAX_ASPECT_MISMATCH_RAD):
        off = math.degrees(math.acos(max(-1.0, min(1.0, along))))
        raise AdapterError(
            f"{where}.p: rows point {off:.1f} degrees away from the down-range of the aspect in d[4]"
            f" ({math.degrees(aspect):.1f} degrees); expected rows to grow away from the sonar"
        )
    # Half an aperture of slack: the sonar may be anywhere on the arc that the view was made from.
    slack = max(aperture / 2, MAX_ASPECT_MISMATCH_RAD)
    if abs(float(wrap_angle(camera.aspect_rad - aspect))) > slack:
        raise AdapterError(
            f"{where}.p: its sonar stands at aspect {math.degrees(camera.aspect_rad):.1f} degrees, but d[4]"
            f" says {math.degrees(aspect):.1f}; expected the two to agree within {math.degrees(slack):.1f}"
        )
    stamp = stamp_to_ns(msg.header.stamp, f"{where}.header.stamp")
    return ViewInfo(stamp, camera, acoustics, aspect, aperture, carrier, float(d[8]), frame=frame)


def voxel_info_to_msg(factory: MessageFactory, volume: Volume, stamp_ns: int) -> Any:
    """Make the CameraInfo of a dense voxel grid (`csas_voxel_grid`): its ground-plane map, z in D.

    Raises
    ------
    AdapterError
        If the lattice has fewer than two voxels along x or y.
    """
    _, ny, nx = volume.shape
    x, y, z = volume.origin_m
    with _named("voxel_grid/camera_info"):
        grid = GroundGrid(ny, nx, volume.voxel_size_m, x, y + (ny - 1) * volume.voxel_size_m)
    return _make_ground(factory, stamp_ns, grid, CSAS_VOXEL_GRID, [z, volume.voxel_size_m])


def voxel_info_from_msg(msg: Any, layers: int, stream_name: str = "voxel_grid") -> tuple[int, Volume]:
    """Read the CameraInfo of a dense voxel grid.

    Parameters
    ----------
    msg : sensor_msgs/CameraInfo
        Of either message world.
    layers : int
        Channels of the image that belongs to it.
    stream_name : str
        The stream that it is of.

    Returns
    -------
    stamp_ns : int
    volume : Volume

    Raises
    ------
    AdapterError
        Naming the field that breaks the contract; also if the voxels are not cubes.
    """
    where = stream(stream_name).info_topic
    check_type(msg, CAMERA_INFO, where)
    frame_of(msg, where)
    d = _entries(msg, (CSAS_VOXEL_GRID,), where)
    grid = _ground_grid(msg, where)
    if abs(d[1] - grid.spacing_m) > 1e-6 * grid.spacing_m:
        raise AdapterError(
            f"{where}.d[1], the layer spacing, is {d[1]:g} m; expected cubes of the pixel spacing,"
            f" {grid.spacing_m:g} m"
        )
    y_min = grid.y_max_m - (grid.rows - 1) * grid.spacing_m
    with _named(where):
        volume = Volume((grid.x_min_m, y_min, float(d[0])), grid.spacing_m, (layers, grid.rows, grid.cols))
    return stamp_to_ns(msg.header.stamp, f"{where}.header.stamp"), volume


def check_pair(image: Any, info: Any, where: str = "image") -> None:
    """Refuse an Image and a CameraInfo that do not belong together.

    Raises
    ------
    AdapterError
        If their stamps, frames or sizes differ.
    """
    a = stamp_to_ns(image.header.stamp, f"{where}.header.stamp")
    b = stamp_to_ns(info.header.stamp, f"{where} camera_info.header.stamp")
    if a != b:
        raise AdapterError(f"{where}: camera_info is stamped {b} ns; expected the image's stamp, {a} ns")
    frame_of(info, f"{where}: camera_info", frame_of(image, where))
    for name in ("width", "height"):
        x, y = int(getattr(image, name)), int(getattr(info, name))
        if x != y:
            raise AdapterError(f"{where}: camera_info.{name} is {y}; expected the image's {name}, {x}")
