"""The truth that a simulated bag has beside it, and how far a reconstruction is from it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import CsasError
from ..core.mesh import Dimensions, measure
from ..core.volume import Volume, VoxelGrid
from ..simulation.hull import iou, shadow_hull, voxelise_truth

if TYPE_CHECKING:
    import trimesh

#: Margin round the true target in which scores look for what was wrongly left standing, voxels.
_MARGIN_VOXELS = 2


class TruthError(CsasError):
    """A truth file cannot be read."""


@dataclass(frozen=True, eq=False)
class KnownTruth:
    """What is really there.

    Parameters
    ----------
    path : Path
        The STL file it was read from.
    mesh : trimesh.Trimesh
        The target, scene frame, metres; without faces for an empty seabed.
    record : dict
        What the simulation wrote about it.
    """

    path: Path
    mesh: trimesh.Trimesh
    record: dict[str, Any]

    @property
    def dimensions(self) -> Dimensions | None:
        """Measures of the target, taken as a reconstruction's are; None where there is none."""
        return measure(self.mesh) if len(self.mesh.faces) else None


def read_truth(bag: str | Path) -> KnownTruth | None:
    """Read ``<bag>.truth.stl`` and, where it is there too, ``<bag>.truth.json``.

    Returns
    -------
    KnownTruth or None
        None if the bag has no truth beside it.

    Raises
    ------
    TruthError
        If it has one that cannot be read.
    """
    base = Path(bag).resolve()
    stl, record_path = (base.with_name(f"{base.name}.truth.{kind}") for kind in ("stl", "json"))
    if not stl.exists():
        return None
    import trimesh  # late: few bags have a truth beside them

    try:
        record = json.loads(record_path.read_text(encoding="utf-8")) if record_path.exists() else {}
        raw = stl.read_bytes()
        # A binary STL without triangles, an empty seabed, is none to trimesh.
        empty = len(raw) == 84 and int.from_bytes(raw[80:84], "little") == 0
        mesh: Any = trimesh.Trimesh() if empty else trimesh.load(str(stl), force="mesh")
        if not empty:
            mesh.merge_vertices()
    except Exception as error:  # trimesh raises whatever its readers raise
        raise TruthError(f"truth {stl} cannot be read: {error}; repair it or take it away") from error
    return KnownTruth(stl, mesh, record)


def score(
    truth: KnownTruth, grid: VoxelGrid, sonar_m: ArrayLike, matter: NDArray[np.bool_] | None = None
) -> dict[str, float]:
    """Compare a reconstruction with the truth and with the truth's shadow hull.

    The shadow hull, which perfect silhouettes from the same sonar positions would leave, is the best that
    carving can do; its own IoU against the truth says how good that is.

    Parameters
    ----------
    truth : KnownTruth
        A target with faces.
    grid : VoxelGrid
        The reconstruction.
    sonar_m : array_like, shape (n, 3)
        Where the sonar was for the views in the grid.
    matter : ndarray of bool, shape (nz, ny, nx), optional
        The reconstruction without its hollows.

    Returns
    -------
    dict
        ``iou_truth``, ``iou_hull``, ``iou_hull_truth``; with matter also ``iou_matter``.
    """
    volume, before = _widened(grid.volume, truth.mesh)
    nz, ny, nx = grid.volume.shape
    z, y, x = before

    def widened(voxels: NDArray[np.bool_]) -> NDArray[np.bool_]:
        out = np.zeros(volume.shape, bool)
        out[z : z + nz, y : y + ny, x : x + nx] = voxels
        return out

    occupied = widened(grid.occupied)
    solid = voxelise_truth(truth.mesh, volume)
    positions = np.asarray(sonar_m, dtype=np.float64)
    # Half a voxel is far finer than what the hull is compared with.
    hull = shadow_hull(truth.mesh, positions, volume, spacing_m=min(grid.volume.voxel_size_m / 2, 10.0))
    scores = {
        "iou_truth": iou(occupied, solid),
        "iou_hull": iou(occupied, hull),
        "iou_hull_truth": iou(hull, solid),
    }
    if matter is not None:
        scores["iou_matter"] = iou(widened(matter), solid)
    return scores


def _widened(volume: Volume, mesh: trimesh.Trimesh) -> tuple[Volume, tuple[int, int, int]]:
    """Return the lattice grown to hold the mesh, and how many voxels were put before (z, y, x)."""
    d = volume.voxel_size_m
    low, high = mesh.bounds
    before, after = [], []
    for axis, n in zip(range(3), volume.shape[::-1], strict=True):
        first = volume.origin_m[axis]
        margin = _MARGIN_VOXELS * d
        missing = math.ceil((first - d / 2 - (low[axis] - margin)) / d)
        before.append(max(0, missing) if axis < 2 else 0)
        after.append(max(0, math.ceil((high[axis] + margin - (first + (n - 0.5) * d)) / d)))
    nx, ny, nz = (n + b + a for n, b, a in zip(volume.shape[::-1], before, after, strict=True))
    x, y, z = (volume.origin_m[i] - before[i] * d for i in range(3))
    return Volume((x, y, z), d, (nz, ny, nx)), (before[2], before[1], before[0])
