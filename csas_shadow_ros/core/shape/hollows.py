"""Beyond shadows: hollows of the carved body that its echoes show to be empty.

No shadow shows a hollow that opens upwards, such as the hole of a tyre: the shadow hull fills it. Echoes can.
A voxel at (x, y, z) is imaged, towards the sonar, at

    (x, y) + z tan ψ û(θ).

A voxel of the carved body's surface, in plain view of the sonar, whose pixel is dark in about half of the
views that see it or more, holds no matter. Taking it away bares the voxels behind it, and so on.

A smooth top is dark too, as it sends nothing back. A real hollow has a far wall, which the filling hid, that
faces the sonar and answers. What was taken away without such an answer is put back.

The hull stays what it is: this is a second grid, a part of it.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..geometry import ViewInfo
from ..imaging.likelihood import Levels, box_mean
from ..imaging.local_means import ECHO_CELLS
from .layover import count_looks, layover_per_metre
from .mesh import mesh_from_grid
from .volume import Volume, VoxelGrid

if TYPE_CHECKING:
    import trimesh

BoolArray = NDArray[np.bool_]

#: Dark: the mean power over a box of a cell (`ECHO_CELLS`) is under this part of the seabed's. Empty space
#: behind a rim is in shadow.
_DARK_POWER = 0.5
#: A visible voxel is empty where at least this share of the views that see it are dark there. Rough matter is
#: dark in a quarter of its looks by speckle (such a box is about two looks), empty space in nearly all.
#: At 0.45 speckle opens a solid cylinder by some voxels.
_DARK_SHARE = 0.5
#: At least this share of all views must see a voxel: neighbouring views share their aperture and its speckle.
_LEAST_SEEN = 0.1
#: A ray passes over what rises no more than this above it (voxels): the cap of a hull slopes just as the rays
#: do, and rounding to voxels, by half of one, must not hide its far side. With more, rays pass through rims.
_GRAZE = 0.5
#: What was taken away with fewer free voxels among the 9 round it in its layer is a pit: speckle.
_PIT_NEIGHBOURS = 5
#: Walls that were bared must answer: no more than this share of the looks at them may be dark. It is
#: up to 0.44 in real hollows, 0.8 and more under smooth tops.
_WALL_DARK = 2.0 / 3.0
#: Smaller hollows bare too little wall to be judged by it (voxels: 3 a side).
_LEAST_HOLLOW = 27
#: Pixels kept round what a view shows of the volume, beside the box of the mean: rounding.
_ROUNDING_PX = 2


@dataclass(frozen=True, eq=False)
class EchoLook:
    """Dark pixels of a view round the target, in some kB.

    Parameters
    ----------
    info : ViewInfo
        The view.
    first : (int, int)
        Row and column of the view where the part that is kept begins.
    shape : (int, int)
        Its rows and columns.
    packed : bytes
        Its dark and its known pixels, a bit each, compressed.
    """

    info: ViewInfo
    first: tuple[int, int]
    shape: tuple[int, int]
    packed: bytes

    @classmethod
    def of(cls, levels: Levels, info: ViewInfo, volume: Volume) -> EchoLook:
        """Keep the part of a view that a volume's echoes can lie in.

        Parameters
        ----------
        levels : Levels
            The view relative to its seabed level.
        info : ViewInfo
            The view.
        volume : Volume
            What is carved.
        """
        box = levels.local.box_px(ECHO_CELLS)
        rows, cols = _pixels_of(info, volume, box)
        known = levels.known[rows, cols]
        # Where the contrast is poor, shadow itself may be brighter: dark is then halfway between both in dB.
        limit = np.float32(max(_DARK_POWER, 1.0 / levels.contrast))
        dark = known & (box_mean(levels.power[rows, cols], known, box) < limit) if known.size else known
        packed = zlib.compress(np.packbits(np.stack([dark, known])).tobytes(), 1)
        return cls(info, (rows.start, cols.start), (known.shape[0], known.shape[1]), packed)

    def pixels(self) -> tuple[BoolArray, BoolArray]:
        """Return the dark and the known pixels, each of shape `shape`."""
        rows, cols = self.shape
        bits = np.unpackbits(np.frombuffer(zlib.decompress(self.packed), np.uint8), count=2 * rows * cols)
        dark, known = bits.view(np.bool_).reshape(2, rows, cols)
        return dark, known


def _pixels_of(info: ViewInfo, volume: Volume, box: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of a view that a volume's echoes can lie in."""
    x, y, _ = volume.centre_m
    length, width, height = volume.size_m
    corners = np.array([[x + a * length, y + b * width] for a in (-0.5, 0.5) for b in (-0.5, 0.5)])
    corners = np.concatenate([corners, corners + height * layover_per_metre(info)])
    camera = info.camera
    pixels = corners @ camera.ground_to_pixel[:2, :2].T + camera.ground_to_pixel[:2, 2]
    slices = []
    bounds = zip(pixels.min(axis=0), pixels.max(axis=0), camera.shape[::-1], box[::-1], strict=True)
    for low, high, n, half in bounds:
        margin = half + _ROUNDING_PX
        first = min(max(0, math.floor(low) - margin), n)
        slices.append(slice(first, min(max(first, math.ceil(high) + margin + 1), n)))
    return slices[1], slices[0]


def _surface(occupied: BoolArray) -> BoolArray:
    """Return the voxels with a face that can be seen: a side or the top that no other voxel covers."""
    out = np.zeros_like(occupied)
    padded = np.pad(occupied, 1)
    inner = (slice(1, -1),) * 3
    for axis, step in ((0, -1), (1, -1), (1, 1), (2, -1), (2, 1)):
        out |= occupied & ~np.roll(padded, step, axis)[inner]
    return out


def _looks(
    voxels: NDArray[np.int32],
    occupied: BoolArray,
    volume: Volume,
    looks: Iterable[EchoLook],
    fuller: BoolArray | None = None,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Count, for each voxel, the views that see it, and those that are dark where it is imaged.

    With a `fuller` body, only those views count in which that one would hide the voxel.
    """
    seen, dark_seen = np.zeros(len(voxels), np.int32), np.zeros(len(voxels), np.int32)
    nothing = np.empty((0, 0, 0), np.bool_)
    for look in looks:
        camera = look.info.camera
        affine = np.array(camera.ground_to_pixel[:2], dtype=np.float64)
        affine[:, 2] -= look.first[::-1]
        dark, known = look.pixels()
        count_looks(
            voxels,
            occupied,
            nothing if fuller is None else fuller,
            _GRAZE,
            np.asarray(volume.origin_m, dtype=np.float64),
            volume.voxel_size_m,
            np.asarray(camera.sonar_m, dtype=np.float64),
            layover_per_metre(look.info),
            affine,
            dark,
            known,
            seen,
            dark_seen,
        )
    return seen, dark_seen


def matter_of(grid: VoxelGrid, looks: Iterable[EchoLook]) -> BoolArray:
    """Open the hollows of a carved body that shadows cannot show.

    Parameters
    ----------
    grid : VoxelGrid
        What shadows leave.
    looks : iterable of EchoLook
        Of all views, in any order.

    Returns
    -------
    ndarray of bool, shape (nz, ny, nx)
        `grid.occupied` without its hollows; all of it where there is none, or no look.

    Notes
    -----
    The floor of a hollow is in view only from as far as its rim lets the sonar look in: of a hole that is w
    wide, no more than the upper w tan ψ is opened.
    """
    views, occupied, volume = list(looks), grid.occupied, grid.volume
    carved = np.ascontiguousarray(occupied).copy()
    least = max(1, math.ceil(_LEAST_SEEN * len(views)))
    while views and carved.any():
        voxels = np.argwhere(_surface(carved)).astype(np.int32)
        seen, dark_seen = _looks(voxels, carved, volume, views)
        empty = (seen >= least) & (dark_seen >= _DARK_SHARE * seen)
        if not empty.any():
            break
        carved[tuple(voxels[empty].T)] = False
    return _answered(occupied, _without_pits(occupied, carved), volume, views)


def matter_mesh(grid: VoxelGrid, matter: BoolArray) -> trimesh.Trimesh:
    """Extract the closed surface of the matter in a carved grid.

    Parameters
    ----------
    grid : VoxelGrid
        What shadows leave.
    matter : ndarray of bool, shape (nz, ny, nx)
        `matter_of` it.

    Raises
    ------
    NoTargetError
        If there is no matter.
    """
    # A voxel that was opened counts as if nothing was known of it: the surface runs halfway to it.
    likelihood = np.where(grid.occupied & ~matter, np.float32(np.nan), grid.likelihood)
    return mesh_from_grid(replace(grid, likelihood=likelihood, occupied=matter))


def _without_pits(occupied: BoolArray, carved: BoolArray) -> BoolArray:
    """Put back what was taken away with too few free voxels round it in its layer, until there is none."""
    out = carved.copy()
    window = np.ones((1, 3, 3), np.uint8)
    while True:
        free = scipy.ndimage.convolve((~out).astype(np.uint8), window, mode="constant", cval=1)
        back = occupied & ~out & (free < _PIT_NEIGHBOURS)
        if not back.any():
            return out
        out |= back


def _answered(occupied: BoolArray, carved: BoolArray, volume: Volume, looks: list[EchoLook]) -> BoolArray:
    """Put back every hollow whose bared walls do not answer."""
    labels, count = scipy.ndimage.label(occupied & ~carved, np.ones((3, 3, 3), bool))
    if not count:
        return occupied.copy()
    beside = scipy.ndimage.maximum_filter(labels, 3)
    voxels = np.argwhere(_surface(carved) & (beside > 0)).astype(np.int32)
    seen, dark_seen = _looks(voxels, carved, volume, looks, np.ascontiguousarray(occupied))
    at = beside[tuple(voxels.T)]
    seen_of = np.bincount(at, seen, count + 1)
    dark_of = np.bincount(at, dark_seen, count + 1)
    hollow = (seen_of > 0) & (dark_of <= _WALL_DARK * seen_of)
    hollow &= np.bincount(labels.ravel(), minlength=count + 1) >= _LEAST_HOLLOW
    hollow[0] = False
    return np.asarray(occupied & ~hollow[labels], dtype=np.bool_)
