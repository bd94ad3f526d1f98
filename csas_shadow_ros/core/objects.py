"""Several objects in one scene: each further body that the search found, carved in a volume of its own.

The main target goes through `pipeline.process_view`. What else stands on the seabed shares its sub-apertures
and goes through the same steps from there on, since enhancement focuses at the range of one body, and the
silhouette begins at one body. Nothing of that touches the main target's grid.

A body of the search need not become an object: it may be a phantom of crossing shadows, the part of another
body that reaches into its volume, or nothing once it is looked at sharply. What is left out says why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from .carving import Carver, part_around
from .errors import ViewError
from .geometry import View
from .likelihood import outside_likelihood, view_levels
from .measurement import SilhouetteSides, measure_object, silhouette_sides
from .mesh import Dimensions, mesh_from_grid
from .parameters import PipelineParameters
from .segmentation import require_silhouette, segment_shadow
from .shadow import enhance
from .target import Search, stands_on_seabed
from .threshold import LEAST_VOXELS
from .volume import Target, Volume, VoxelGrid

if TYPE_CHECKING:
    import trimesh

#: Bodies carved if nothing else is asked for, the target among them. Each further one takes about half
#: of the target's time.
MAX_OBJECTS = 4
#: More than this are refused: their views would not fit into memory.
MOST_OBJECTS = 64
#: Two carved objects are the same body where they share this much of the smaller one.
_SAME_BODY = 0.25
#: Voxels round one of several pieces that were carved in one volume.
_MARGIN_VOXELS = 3


@dataclass(frozen=True, eq=False)
class ObjectResult:
    """One object of the scene.

    Parameters
    ----------
    target : Target
        The volume that was carved; for one of several pieces in a volume, the piece's part of it.
    grid : VoxelGrid
        By the chosen method; nothing is occupied but the object.
    mesh, dimensions : trimesh.Trimesh, Dimensions
        Surface and measures.
    views_used : int
        Views in the grid.
    """

    target: Target
    grid: VoxelGrid
    mesh: trimesh.Trimesh
    dimensions: Dimensions
    views_used: int


@dataclass(frozen=True)
class LeftOut:
    """A body that is no object, or was not looked at: where it is (x, y) and why."""

    position_m: tuple[float, float]
    reason: str


@dataclass(frozen=True, eq=False)
class FurtherView:
    """What a further body is carved with in one view: its mask (soft: l_out), and the silhouette's sides."""

    pixels: View
    sides: SilhouetteSides | None


@dataclass(eq=False)
class FurtherBody:
    """A body besides the target, while it is carved.

    Parameters
    ----------
    target : Target
        Its volume.
    parameters : PipelineParameters
        Of all stages.
    """

    target: Target
    parameters: PipelineParameters
    carver: Carver = field(init=False)
    sides: list[SilhouetteSides] = field(default_factory=list)
    #: Why the first view that was not usable was not.
    refused: str = ""

    def __post_init__(self) -> None:
        carving = self.parameters.carving
        self.carver = Carver(
            Volume.around(self.target.position_m, self.target.size_m, carving.voxel_size_m), carving
        )

    def process(self, sub_aperture: View) -> FurtherView | ViewError:
        """Take one sub-aperture through the stages that depend on the body; safe in any thread."""
        p, position = self.parameters, self.target.position_m
        try:
            shadow = enhance(sub_aperture, position, p.shadow)
            levels = view_levels(shadow, p.likelihood)
            mask = segment_shadow(shadow, position, p.likelihood, levels, reach_m=self.target.reach_m)
            sides = silhouette_sides(levels, mask, position)
            if p.carving.takes_masks:
                return FurtherView(require_silhouette(mask), sides)
            return FurtherView(outside_likelihood(shadow, p.likelihood, levels), sides)
        except ViewError as error:
            return error

    def integrate(self, view: FurtherView | ViewError) -> None:
        """Carve with one view; one that is not usable is passed over."""
        try:
            if isinstance(view, ViewError):
                raise view
            if self.carver.integrate(view.pixels) and view.sides is not None:
                self.sides.append(view.sides)
        except ViewError as error:
            self.refused = self.refused or str(error)

    def objects(self, reported: Sequence[VoxelGrid]) -> tuple[list[ObjectResult], list[LeftOut]]:
        """Return what the carving left, without what is in the grids that were reported before.

        Parameters
        ----------
        reported : sequence of VoxelGrid
            Grids of the target and of the objects found so far, in that order.

        Returns
        -------
        objects : list of ObjectResult
            None to many, the largest first: a body of the search may turn out to be several.
        left_out : list of LeftOut
            Pieces, or the whole body, that are no objects.
        """
        if not self.carver.stamps:
            return [], [LeftOut(self.target.position_m, f"no view of it was usable: {self.refused}")]
        grid = self.carver.grid()
        pieces = connected_pieces(grid.occupied)
        if not pieces:
            return [], [
                LeftOut(self.target.position_m, "no voxel of its volume lies in shadow from all sides")
            ]
        objects: list[ObjectResult] = []
        left_out = []
        for piece in pieces:
            one = _only(grid, piece, whole=len(pieces) == 1)
            reason = _why_no_object(grid, piece, [*reported, *(o.grid for o in objects)])
            if reason:
                left_out.append(LeftOut(_middle(one), reason))
                continue
            mesh = mesh_from_grid(one)
            # Silhouettes are those of the whole body: they measure a piece only where it is all of it.
            sides = self.sides if len(pieces) == 1 else []
            if grid.seabed is not None:
                sides = [replace(side, info=grid.seabed.corrected(side.info)) for side in sides]
            target = self.target
            if len(pieces) > 1:
                volume = one.volume
                target = Target((volume.centre_m[0], volume.centre_m[1]), volume.size_m)
            dimensions = measure_object(one, mesh, sides)
            objects.append(ObjectResult(target, one, mesh, dimensions, len(self.carver.stamps)))
        return objects, left_out


def further_targets(search: Search, max_objects: int = MAX_OBJECTS) -> tuple[list[Target], list[LeftOut]]:
    """Choose which bodies of the search are carved besides the target, which is the most evident one.

    Parameters
    ----------
    search : Search
        What was found.
    max_objects : int
        At most so many bodies are carved, the target among them.

    Returns
    -------
    targets : list of Target
        In order of evidence.
    left_out : list of LeftOut
        The others: phantoms, and bodies beyond `max_objects`.
    """
    targets: list[Target] = []
    left_out = []
    for body in search.targets[1:]:
        if not body.stands:
            left_out.append(LeftOut(body.position_m, _PHANTOM))
        elif len(targets) + 1 >= max_objects:
            left_out.append(LeftOut(body.position_m, f"no more than {max_objects} bodies are carved"))
        else:
            targets.append(body)
    return targets, left_out


_PHANTOM = "a phantom: shadows of other bodies cross over it, and it does not reach down to the seabed"


def connected_pieces(occupied: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    """Return the pieces of a carved grid that do not touch one another, the largest first.

    Parameters
    ----------
    occupied : ndarray of bool, shape (nz, ny, nx)
        Voxels that meet at a corner are connected.

    Returns
    -------
    list of ndarray of bool, each of that shape
    """
    labels, count = scipy.ndimage.label(occupied, np.ones((3, 3, 3), bool))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    return [np.asarray(labels == 1 + i) for i in np.argsort(-sizes, kind="stable")]


def overlap_share(a: VoxelGrid, b: VoxelGrid) -> float:
    """Return how much two grids' objects share, as a fraction of the smaller one (by volume).

    The lattices may differ: a voxel of `a` is shared where its centre lies in an occupied voxel of `b`.
    """
    if not a.occupied.any() or not b.occupied.any():
        return 0.0
    k, j, i = np.nonzero(a.occupied)
    index = []
    for where, axis, origin, size in zip(
        (k, j, i),
        (a.volume.z_m, a.volume.y_m, a.volume.x_m),
        b.volume.origin_m[::-1],
        b.occupied.shape,
        strict=True,
    ):
        at = np.rint((axis[where] - origin) / b.volume.voxel_size_m).astype(np.intp)
        index.append(np.where((at >= 0) & (at < size), at, -1))
    inside = np.all([at >= 0 for at in index], axis=0)
    shared = np.count_nonzero(b.occupied[tuple(at[inside] for at in index)])
    d_a, d_b = a.volume.voxel_size_m**3, b.volume.voxel_size_m**3
    smaller = min(len(k) * d_a, np.count_nonzero(b.occupied) * d_b)
    return float(shared * d_a / smaller)


def _why_no_object(grid: VoxelGrid, piece: NDArray[np.bool_], reported: Sequence[VoxelGrid]) -> str:
    """Return why a piece is no object of its own; empty if it is one."""
    if int(np.count_nonzero(piece)) < LEAST_VOXELS:
        return f"fewer than {LEAST_VOXELS} voxels are left of it"
    alone = VoxelGrid(grid.volume, grid.likelihood, grid.views, grid.threshold, piece, grid.method)
    for number, other in enumerate(reported, start=1):
        share = overlap_share(alone, other)
        if share >= _SAME_BODY:
            return f"the same body as object {number}: they share {100.0 * share:.0f} % of the smaller one"
    layers = np.flatnonzero(piece.any(axis=(1, 2)))
    half = grid.volume.voxel_size_m / 2.0
    bottom, top = grid.volume.z_m[layers[0]] - half, grid.volume.z_m[layers[-1]] + half
    if not stands_on_seabed(float(bottom), float(top)):
        return _PHANTOM
    plan = np.asarray(piece.any(axis=0))
    if plan[0].any() or plan[-1].any() or plan[:, 0].any() or plan[:, -1].any():
        return "it reaches through the side of its volume: a part of something else"
    return ""


def _only(grid: VoxelGrid, piece: NDArray[np.bool_], *, whole: bool) -> VoxelGrid:
    """Return a grid in which a piece alone is occupied; cut down to the piece unless it is the whole body."""
    if whole:
        return grid
    box, volume = part_around(piece, grid.volume, _MARGIN_VOXELS)
    return VoxelGrid(
        volume, grid.likelihood[box], grid.views[box], grid.threshold, piece[box].copy(), grid.method
    )


def _middle(grid: VoxelGrid) -> tuple[float, float]:
    _, j, i = np.nonzero(grid.occupied)
    return float(grid.volume.x_m[i].mean()), float(grid.volume.y_m[j].mean())
