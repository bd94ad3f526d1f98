"""Surface of the carved object, and its measures."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from ..equality import equal_where_nan
from ..errors import NoTargetError
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
    depth = np.nan_to_num(depth, nan=0.0, posinf=np.inf, neginf=-np.inf)  # a threshold that is not known
    limit = np.float32(max(1e-3, grid.threshold) if math.isfinite(grid.threshold) else 1.0)
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
    """Extract the object's closed surface: by marching cubes, or where these leave it open by tetrahedra.

    Parameters
    ----------
    grid : VoxelGrid
        Carved grid.

    Returns
    -------
    trimesh.Trimesh
        Watertight, outward normals, metres in the scene frame: every edge is of exactly two faces.

    Raises
    ------
    NoTargetError
        If the grid holds no object.

    Examples
    --------
    >>> import numpy as np
    >>> from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
    >>> occupied = np.zeros((3, 3, 3), bool)
    >>> occupied[0, 1, 1] = True
    >>> likelihood = np.where(occupied, np.float32(0), np.float32(1))
    >>> volume = Volume.around((0, 0), (0.3, 0.3, 0.3), 0.1)
    >>> grid = VoxelGrid(volume, likelihood, np.ones((3, 3, 3), np.uint16), 0.5, occupied)
    >>> mesh_from_grid(grid).is_watertight
    True
    """
    # Late: half a second that every process of the node graph, and the viewer, would wait for.
    import trimesh
    from skimage.measure import marching_cubes

    if not grid.occupied.any():
        raise NoTargetError("the grid holds no object; expected at least one occupied voxel to mesh")
    d = grid.volume.voxel_size_m
    field = surface_field(grid)
    origin = np.asarray(grid.volume.origin_m)
    vertices, faces, _, _ = marching_cubes(
        field, 0.0, spacing=(d, d, d)
    )
    xyz = vertices[:, ::-1] - d + origin  # (z, y, x) → (x, y, z); -d: the padding
    mesh = trimesh.Trimesh(xyz, faces[:, ::-1], process=True)
    if mesh.volume < 0:
        mesh.invert()
    if mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0:
        return mesh
    # Where voxels meet at an edge or a corner alone, the table of cubes has cases that do not fit their
    # neighbours. Tetrahedra have none.
    nodes, faces = _march_tetrahedra(field)
    return trimesh.Trimesh(nodes * d - d + origin, faces, process=False)


def _parity(order: Sequence[int]) -> bool:
    """Say whether a permutation is odd."""
    return bool(sum(a > b for a, b in itertools.combinations(order, 2)) % 2)


def _kuhn() -> NDArray[np.int64]:
    """Return the six tetrahedra of a cube, alike oriented; a corner's number has the bits x, y, z."""
    tetrahedra = []
    for axes in itertools.permutations(range(3)):
        first, second = 1 << axes[0], (1 << axes[0]) | (1 << axes[1])
        tetrahedra.append([0, second, first, 7] if _parity(axes) else [0, first, second, 7])
    return np.array(tetrahedra)


def _cuts() -> list[list[tuple[tuple[int, int], ...]]]:
    """Return the triangles for each set of corners inside (as bits): three (inside, outside) edges each."""
    table: list[list[tuple[tuple[int, int], ...]]] = []
    for code in range(16):
        inside = [i for i in range(4) if code >> i & 1]
        outside = [i for i in range(4) if not code >> i & 1]
        if len(inside) in (0, 4):
            table.append([])
        elif len(inside) == 2:
            (a, b), (c, d) = inside, outside
            if _parity((a, b, c, d)):
                c, d = d, c
            table.append([((a, c), (a, d), (b, d)), ((a, c), (b, d), (b, c))])
        else:
            alone, (b, c, d) = (inside, outside) if len(inside) == 1 else (outside, inside)
            a = alone[0]
            # Seen from outside, the cut's corners go round against the clock.
            if _parity((a, b, c, d)) is (len(inside) == 1):
                c, d = d, c
            edges = [(a, k) if len(inside) == 1 else (k, a) for k in (b, c, d)]
            table.append([tuple(edges)])
    return table


_KUHN = _kuhn()
_CUTS = _cuts()


def _march_tetrahedra(
    field: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the surface field = 0, which is closed whatever the signs of the field.

    Each cube is cut into six tetrahedra about the diagonal from its lowest to its highest corner, so that
    neighbours cut their common face alike. A tetrahedron's face is crossed by no segment or by one, which the
    signs at its three corners tell: so both tetrahedra at the face have the same, and each edge of the
    surface is of two triangles. Vertices are told apart by the edge that they lie on, not by their place.

    Parameters
    ----------
    field : ndarray of float32, shape (nz, ny, nx)
        Nowhere 0; negative all round.

    Returns
    -------
    vertices : ndarray of float64, shape (n, 3)
        (x, y, z), in voxels.
    faces : ndarray of int64, shape (m, 3)
        Normals point to the negative side.
    """
    _, ny, nx = field.shape
    offsets = [(i & 1) + nx * ((i >> 1 & 1) + ny * (i >> 2)) for i in range(8)]
    inside = field > 0
    count = np.zeros(tuple(n - 1 for n in field.shape), np.uint8)
    for corner in range(8):
        right, up, above = corner & 1, corner >> 1 & 1, corner >> 2
        count += inside[above:, up:, right:][: count.shape[0], : count.shape[1], : count.shape[2]]
    z, y, x = np.nonzero((count > 0) & (count < 8))
    base = x + nx * (y + ny * z.astype(np.int64))
    values, within = field.ravel(), inside.ravel()
    triangles = []
    for tetrahedron in _KUHN:
        codes = sum(
            within[base + offsets[corner]].astype(np.int64) << i for i, corner in enumerate(tetrahedron)
        )
        for code, cuts in enumerate(_CUTS):
            cubes = base[codes == code] if cuts else base[:0]
            for cut in cuts if len(cubes) else ():
                edges = []
                for one in cut:
                    low, high = sorted(int(tetrahedron[i]) for i in one)
                    # Along a cube's diagonals corners only gain bits: these say which edge it is.
                    edges.append((cubes + offsets[low]) * 8 + (high ^ low))
                triangles.append(np.stack(edges, axis=1))
    keys, faces = np.unique(np.concatenate(triangles), return_inverse=True)
    start, direction = keys // 8, keys % 8
    end = start + np.array(offsets)[direction]
    first, last = values[start].astype(np.float64), values[end].astype(np.float64)
    step = np.stack([direction & 1, direction >> 1 & 1, direction >> 2], axis=1)
    place = np.stack([start % nx, start // nx % ny, start // (nx * ny)], axis=1)
    return place + (first / (first - last))[:, None] * step, faces.reshape(-1, 3)


@equal_where_nan
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
    scatter_cells : float
        How far the sides of shadows scatter about one plan, 1σ, cross-range cells; NaN where none was fitted.
    """

    length_m: float
    width_m: float
    height_m: float
    volume_m3: float
    heading_rad: float
    position_m: tuple[float, float]
    hull_top_m: float = math.nan
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    scatter_cells: float = math.nan

    def __repr__(self) -> str:
        x, y = self.position_m
        return (
            f"{self.length_m:.3f} × {self.width_m:.3f} × {self.height_m:.3f} m, {self.volume_m3:.4f} m³,"
            f" heading {math.degrees(self.heading_rad):.1f}°, at x {x:.3f}, y {y:.3f} m"
        )

    def rounded(self, voxel_size_m: float) -> Dimensions:
        """Return the measures without meaningless digits.

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
            scatter_cells=round(self.scatter_cells, 3),
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
