"""Image and CameraInfo pairs to and from the core's types, and pairing by stamp."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csas_shadow_ros.core.errors import AdapterError
from csas_shadow_ros.core.geometry import CoherentImage, View
from csas_shadow_ros.core.sectors.sector import Sector
from csas_shadow_ros.core.shape.volume import Volume

from .camera_info import (
    GroundInfo,
    SectorInfo,
    check_pair,
    ground_info_from_msg,
    ground_info_to_msg,
    sector_info_from_msg,
    sector_info_to_msg,
    view_info_from_msg,
    view_info_to_msg,
    voxel_info_from_msg,
    voxel_info_to_msg,
)
from .image import image_from_msg, image_to_msg
from .messages import MessageFactory, check_data_stamp, data_stamp_to_ns, stamp_to_ns
from .topics import stream


def coherent_image_from_msgs(image: Any, info: Any) -> CoherentImage:
    """Read the full-circle image.

    Raises
    ------
    AdapterError
        If either message breaks the contract or they do not belong together.
    """
    check_pair(image, info, "image")
    data_stamp_to_ns(image.header.stamp, "image.header.stamp")
    ground = ground_info_from_msg(info)
    pixels = image_from_msg(image, "image")
    return CoherentImage(pixels, ground.grid, ground.acoustics, ground.stamp_ns, frame=ground.frame)


def coherent_image_to_msgs(
    factory: MessageFactory, image: CoherentImage, encoding: str | None = None
) -> tuple[Any, Any]:
    """Make (Image, CameraInfo) of the full-circle image.

    Raises
    ------
    AdapterError
        If its stamp is 0, or it breaks the contract otherwise.
    """
    check_data_stamp(image.stamp_ns, "image")
    info = GroundInfo(image.stamp_ns, image.grid, image.acoustics, frame=image.frame)
    return (
        image_to_msg(factory.in_frame(image.frame), image.pixels, image.stamp_ns, "image", encoding),
        ground_info_to_msg(factory, info),
    )


def sector_from_msgs(image: Any, info: Any) -> Sector:
    """Read a sector.

    Raises
    ------
    AdapterError
        If either message breaks the contract or they do not belong together.
    """
    check_pair(image, info, "sector/image")
    data_stamp_to_ns(image.header.stamp, "sector/image.header.stamp")
    s = sector_info_from_msg(info)
    pixels = image_from_msg(image, "sector")
    arc = s.aspect_rad, s.aperture_rad, s.carrier_rad_m
    return Sector(pixels, s.grid, s.acoustics, s.stamp_ns, *arc, frame=s.frame)


def sector_to_msgs(factory: MessageFactory, sector: Sector, encoding: str | None = None) -> tuple[Any, Any]:
    """Make (Image, CameraInfo) of a sector.

    Raises
    ------
    AdapterError
        If its stamp is 0, or it breaks the contract otherwise.
    """
    check_data_stamp(sector.stamp_ns, "sector")
    return (
        image_to_msg(factory.in_frame(sector.frame), sector.pixels, sector.stamp_ns, "sector", encoding),
        sector_info_to_msg(factory, SectorInfo.of(sector)),
    )


def view_from_msgs(image: Any, info: Any, stream_name: str) -> View:
    """Read a view: `sub_aperture`, `shadow`, `likelihood` or `shadow_mask`.

    Raises
    ------
    AdapterError
        If either message breaks the contract or they do not belong together.
    """
    check_pair(image, info, stream(stream_name).image_topic)
    view_info = view_info_from_msg(info, stream_name)
    return View(view_info, image_from_msg(image, stream_name))


def view_to_msgs(
    factory: MessageFactory, view: View, stream_name: str, *, trusted: bool = False
) -> tuple[Any, Any]:
    """Make (Image, CameraInfo) of a view; both carry the view's stamp.

    `trusted` as of `image_to_msg`: a stage's own views are looked at by whoever takes them.
    """
    factory = factory.in_frame(view.info.frame)
    return (
        image_to_msg(factory, view.pixels, view.info.stamp_ns, stream_name, trusted=trusted),
        view_info_to_msg(factory, view.info, stream_name),
    )


def ground_picture_from_msgs(image: Any, info: Any, stream_name: str) -> tuple[GroundInfo, NDArray[Any]]:
    """Read a composite: `multilook` (float32) or `color_by_aspect` (uint8, rows × cols × 3).

    Raises
    ------
    AdapterError
        If either message breaks the contract or they do not belong together.
    """
    check_pair(image, info, stream(stream_name).image_topic)
    ground = ground_info_from_msg(info, stream_name)
    return ground, image_from_msg(image, stream_name)


def ground_picture_to_msgs(
    factory: MessageFactory, pixels: NDArray[Any], info: GroundInfo, stream_name: str
) -> tuple[Any, Any]:
    """Make (Image, CameraInfo) of a composite.

    Raises
    ------
    AdapterError
        If the picture's size is not its grid's.
    """
    if pixels.shape[:2] != info.grid.shape:
        raise AdapterError(
            f"{stream(stream_name).image_topic} has {pixels.shape[:2]} pixels; expected {info.grid.shape}"
        )
    factory = factory.in_frame(info.frame)
    return (
        image_to_msg(factory, pixels, info.stamp_ns, stream_name),
        ground_info_to_msg(factory, info),
    )


def voxel_grid_to_msgs(
    factory: MessageFactory,
    volume: Volume,
    likelihood: NDArray[Any],
    stamp_ns: int,
    stream_name: str = "voxel_grid",
) -> tuple[Any, Any]:
    """Make (Image, CameraInfo) of a dense grid.

    Parameters
    ----------
    factory : MessageFactory
        The message world.
    volume : Volume
        The lattice.
    likelihood : ndarray of float32, shape (nz, ny, nx)
        Mean l_out; NaN where unknown. Goes out as rows y (north up), columns x, a channel a height.
    stamp_ns : int
        Stamp, ns.
    stream_name : str
        What the numbers are: likelihoods (`voxel_grid`) or counts of views (`voxel_views`), of the target or
        under a prefix; or what is matter (`matter`, an array of bool).

    Raises
    ------
    AdapterError
        If the array is not the lattice's shape.
    """
    if likelihood.shape != volume.shape:
        raise AdapterError(
            f"{stream_name}/image has {likelihood.shape} voxels; expected {volume.shape} (z, y, x)"
        )
    if stream(stream_name).content == "matter":
        likelihood = np.where(likelihood, np.uint8(255), np.uint8(0))
    else:
        likelihood = likelihood.astype(np.float32, copy=False)
    pixels = np.ascontiguousarray(likelihood.transpose(1, 2, 0)[::-1])
    return (
        image_to_msg(factory, pixels, stamp_ns, stream_name),
        voxel_info_to_msg(factory, volume, stamp_ns),
    )


def voxel_grid_from_msgs(
    image: Any, info: Any, stream_name: str = "voxel_grid"
) -> tuple[int, Volume, NDArray[Any]]:
    """Read a dense grid: likelihoods, counts of views (`voxel_views`), or matter (`matter`).

    Returns
    -------
    stamp_ns : int
    volume : Volume
        Origin and voxel size to rounding: P holds their quotient. `measurements` holds them exactly.
    likelihood : ndarray of float32, shape (nz, ny, nx)
        Of `matter`: of bool.

    Raises
    ------
    AdapterError
        If either message breaks the contract or they do not belong together.
    """
    check_pair(image, info, f"{stream_name}/image")
    pixels = image_from_msg(image, stream_name)
    stamp_ns, volume = voxel_info_from_msg(info, pixels.shape[2], stream_name)
    if stream(stream_name).content == "matter":
        pixels = pixels != 0
    return stamp_ns, volume, np.ascontiguousarray(pixels[::-1].transpose(2, 0, 1))


class Pairer:
    """Finds the Image and the CameraInfo of one stamp, whichever comes first.

    Parameters
    ----------
    where : str
        Name of the image topic, for messages.
    capacity : int
        How many lonely messages are kept; the oldest is given up (and named) beyond that.
    """

    def __init__(self, where: str, capacity: int = 16) -> None:
        self._where = where
        self._capacity = capacity
        self._waiting: OrderedDict[int, tuple[str, Any]] = OrderedDict()
        #: One line for each message whose partner never came.
        self.orphans: list[str] = []

    def add(self, msg: Any, *, is_info: bool) -> tuple[Any, Any] | None:
        """Add a message; return (image, camera_info) once both of its stamp have arrived.

        Raises
        ------
        AdapterError
            If the stamp is not a time.
        """
        kind = "camera_info" if is_info else "image"
        stamp = stamp_to_ns(msg.header.stamp, f"{self._where} {kind}.header.stamp")
        found = self._waiting.get(stamp)
        if found is not None and found[0] != kind:
            del self._waiting[stamp]
            return (found[1], msg) if is_info else (msg, found[1])
        self._waiting[stamp] = (kind, msg)
        self._waiting.move_to_end(stamp)
        while len(self._waiting) > self._capacity:
            self._give_up(*self._waiting.popitem(last=False))
        return None

    def _give_up(self, stamp: int, waiting: tuple[str, Any]) -> None:
        other = "image" if waiting[0] == "camera_info" else "camera_info"
        self.orphans.append(
            f"{self._where}: {waiting[0]} stamped {stamp} ns has no {other} of the same stamp"
        )

    def flush(self) -> list[str]:
        """Drop everything that still waits; return all orphans."""
        while self._waiting:
            self._give_up(*self._waiting.popitem(last=False))
        return self.orphans
