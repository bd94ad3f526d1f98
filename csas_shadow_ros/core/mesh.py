"""Surface of the carved object, and its measures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import NoTargetError
from .volume import VoxelGrid

if TYPE_CHECKING:
    import trimesh


def surface_field(grid: VoxelGrid) -> NDArray[np.float32]:
    """Return a field that is positive in the object, padded by one voxel so that its surface closes.

    Inside it is threshold - likelihood; voxels that are unknown, or under the threshold but not of
    the object, count as outside.

    Returns
    -------
    ndarray of float32, shape (nz + 2, ny + 2, nx + 2)
    """
    with np.errstate(invalid="ignore"):
        depth = np.where(np.isfinite(grid.likelihood), grid.threshold - grid.likelihood, np.float32(-np.inf))
    limit = np.float32(max(grid.threshold, 1e-3))
    floor = np.float32(1e-3) * limit
    inside = np.clip(depth, floor, limit)
    outside = np.clip(depth, -limit, -floor)
    field = np.where(grid.occupied, inside, outside).astype(np.float32)
    # The padding mirrors the border, so that an object that fills the border layer ends half a voxel
    # beyond its centres: on the seabed, z = 0, for the lowest one.
    padded = np.pad(field, 1, mode="edge")
    rim = np.ones(padded.shape, bool)
    rim[1:-1, 1:-1, 1:-1] = False
    padded[rim] = -np.abs(padded[rim])
    return padded


def mesh_from_grid(grid: VoxelGrid) -> trimesh.Trimesh:
    """Extract the object's closed surface by marching cubes.

    Parameters
    ----------
    grid : VoxelGrid
        Carved grid.

    Returns
    -------
    trimesh.Trimesh
        Watertight, outward normals, metres in the scene frame.

    Raises
    ------
    NoTargetError
        If the grid holds no object.
    """
    # Late: half a second that every process of the node graph, and the viewer, would wait for.
    import trimesh
    from skimage.measure import marching_cubes

    if not grid.occupied.any():
        raise NoTargetError("the grid holds no object; expected at least one occupied voxel to mesh")
    d = grid.volume.voxel_size_m
    vertices, faces, _, _ = marching_cubes(  # type: ignore[no-untyped-call]
        surface_field(grid), 0.0, spacing=(d, d, d)
    )
    xyz = vertices[:, ::-1] - d + np.asarray(grid.volume.origin_m)  # (z, y, x) → (x, y, z); -d: the padding
    mesh = trimesh.Trimesh(xyz, faces[:, ::-1], process=True)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


@dataclass(frozen=True)
class Dimensions:
    """Measures of an object.

    Parameters
    ----------
    length_m, width_m : float
        Sides of the smallest rectangle round its plan, length ≥ width.
    height_m : float
        Highest point above the seabed.
    volume_m3 : float
        Volume enclosed.
    heading_rad : float
        Direction of the length, counter-clockwise from +x, in [0, π).
    position_m : (float, float)
        Middle (x, y) of the rectangle.
    hull_top_m : float
        Top of the carved hull, whose cap no shadow can tell from a flat top; NaN where it was not told apart.
    intervals : mapping of str to (float, float)
        95 % interval of each measure by its name (``position_x_m`` and ``position_y_m`` for the position);
        empty where there are none.
    """

    length_m: float
    width_m: float
    height_m: float
    volume_m3: float
    heading_rad: float
    position_m: tuple[float, float]
    hull_top_m: float = math.nan
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def rounded(self, voxel_size_m: float) -> Dimensions:
        """Return the measures without digits that say nothing.

        Lengths in the power of ten that is at most a hundredth of a voxel, the heading in 1e-4 rad. The
        least-squares fits behind them carry the rounding of the FFT, some 1e-9 m: the sum of sectors and the
        image that they are of would differ in digits that nobody measured. Ten times finer, one value in 10⁴
        would still differ; ten times coarser, the digits would begin to matter beside the interval.
        """
        digits = digits_of(voxel_size_m)

        def length(value: float) -> float:
            return round(value, digits) + 0.0

        def of(name: str, value: float) -> float:
            if name == "volume_m3":
                return value
            return round(value, 4) if name == "heading_rad" else length(value)

        return replace(
            self,
            length_m=length(self.length_m),
            width_m=length(self.width_m),
            height_m=length(self.height_m),
            heading_rad=round(self.heading_rad, 4) % math.pi,
            position_m=(length(self.position_m[0]), length(self.position_m[1])),
            hull_top_m=length(self.hull_top_m),
            intervals={name: (of(name, low), of(name, high)) for name, (low, high) in self.intervals.items()},
        )


def digits_of(voxel_size_m: float) -> int:
    """Return the decimals of the power of ten (m) that is at most a hundredth of a voxel."""
    return -math.floor(math.log10(voxel_size_m / 100.0))


def measure(mesh: trimesh.Trimesh) -> Dimensions:
    """Measure a closed mesh that stands on the seabed z = 0.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Metres, scene frame.
    """
    plan = np.asarray(mesh.vertices)[:, :2]
    # cv2 works in float32: measure about the middle, or a far-off scene loses its millimetres.
    offset = plan.mean(axis=0)
    (x, y), (first, second), degrees = cv2.minAreaRect((plan - offset).astype(np.float32))
    length, width = max(first, second), min(first, second)
    heading = math.radians(degrees) + (0.0 if first >= second else math.pi / 2)
    return Dimensions(
        length_m=float(length),
        width_m=float(width),
        height_m=float(mesh.vertices[:, 2].max()),
        volume_m3=float(mesh.volume),
        heading_rad=heading % math.pi,
        position_m=(float(x + offset[0]), float(y + offset[1])),
    )
