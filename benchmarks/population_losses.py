"""Where the population loses its shapes: in segmentation, in echoes, or in carving itself.

Scenes of the development half go through the whole chain; then the target is carved again, from the same
views and geometry, with what is true instead of what was segmented::

    python benchmarks/population_losses.py --scenes 120 --workers 2

Its columns of IoU with the shadow hull:

- *found*: the result, as the chain leaves it.
- *true shadows*: each silhouette is the true one, but what the view's echoes hide or may cover stays as the
  chain marked it. What is lost from here to *found* is segmentation's.
- *no echoes*: each silhouette is the true one, and echoes hide nothing. What is lost from here to *true
  shadows* is what echoes leave open.

What *no echoes* lacks to 1 is lost in carving: to pixels, voxels and the share of views that removes a voxel.

Scenes with one body, a contrast of 6 dB or more and shadows in the image take part, where some of the body
was found.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from population import in_processes
from population_scenes import DEVELOPMENT, draw
from population_scores import LEAST_CONTRAST_DB, TrueBody

from csas_shadow_ros.core.errors import CsasError
from csas_shadow_ros.core.geometry import View
from csas_shadow_ros.core.imaging.mask_codes import MASK_OUTSIDE, MASK_SHADOW
from csas_shadow_ros.core.pipeline import ProcessedView, run
from csas_shadow_ros.core.shape.carving import carve
from csas_shadow_ros.core.shape.explained import cast_shadow
from csas_shadow_ros.core.shape.volume import VoxelGrid
from csas_shadow_ros.simulation import iou

#: The true shadow is cast from voxels so many times finer than those carved.
_FINER = 3


@dataclass(frozen=True)
class Losses:
    """IoU with the shadow hull of one scene's body."""

    index: int
    family: str
    found: float
    true_shadows: float
    no_echoes: float


def losses_of(index: int) -> Losses | None:
    """Carve a scene of the development half three ways; None where it does not take part.

    Parameters
    ----------
    index : int
        Number of the scene.
    """
    spec = draw(DEVELOPMENT, index)
    asked = spec.contrast_db >= LEAST_CONTRAST_DB and "cropped" not in spec.complications
    if len(spec.bodies) != 1 or not asked:
        return None
    made = spec.simulate()
    seen: list[ProcessedView] = []
    try:
        result = run(made.image, made.track, spec.parameters(), workers=1, on_view=seen.append)
    except CsasError:
        return None
    body, fine = (TrueBody(spec.meshes()[0], made.truth.sonar_m, spec.voxel_m / n) for n in (1, _FINER))
    grid = result.grid
    if grid is None or not grid.occupied.any() or not body.overlap(grid):
        return None
    masks = [view.mask for view in seen if view.mask is not None]
    return Losses(index, spec.family, *_compared(body, fine, grid, masks))


def _compared(
    body: TrueBody, fine: TrueBody, grid: VoxelGrid, masks: Sequence[View]
) -> tuple[float, float, float]:
    """Return the IoU of the grid, with true shadows, and without echoes."""
    lattice = fine.own_volume(grid.volume.voxel_size_m / _FINER)
    hull, _ = fine.on(lattice)
    if grid.seabed is not None:
        masks = [replace(mask, info=grid.seabed.corrected(mask.info)) for mask in masks]
    cast = [cast_shadow(mask, lattice, hull) for mask in masks]

    def scored(make: Callable[[View, NDArray[np.bool_]], NDArray[np.uint8]]) -> float:
        views = [replace(m, pixels=make(m, c)) for m, c in zip(masks, cast, strict=True)]
        return _iou(body, carve(views, grid.volume))

    def true_shadow(mask: View, shadow: NDArray[np.bool_]) -> NDArray[np.uint8]:
        told = (mask.pixels == MASK_OUTSIDE) | (mask.pixels == MASK_SHADOW)
        return np.where(told, _silhouette(shadow), mask.pixels)

    return _iou(body, grid), scored(true_shadow), scored(lambda _, shadow: _silhouette(shadow))


def _silhouette(shadow: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.where(shadow, np.uint8(MASK_SHADOW), np.uint8(MASK_OUTSIDE))


def _iou(body: TrueBody, grid: VoxelGrid) -> float:
    occupied, hull, _ = body.compared(grid)
    return iou(occupied, hull)


def table(rows: Sequence[Losses]) -> list[str]:
    """Return the lines of the table: a family a line, then the median and the tenth percentile of all."""
    by_family: dict[str, list[Losses]] = defaultdict(list)
    for row in rows:
        by_family[row.family].append(row)
    lines = ["| family | bodies | found | true shadows | no echoes |", "|---|---|---|---|---|"]
    for family, own in sorted(by_family.items()):
        lines.append(_line(family, own, 0.5))
    return [*lines, _line("**median**", rows, 0.5), _line("**tenth percentile**", rows, 0.1)]


def _line(name: str, rows: Sequence[Losses], share: float) -> str:
    values = np.quantile([(r.found, r.true_shadows, r.no_echoes) for r in rows], share, axis=0)
    return f"| {name} | {len(rows)} | " + " | ".join(f"{value:.2f}" for value in values) + " |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=60, help="how many, from the first on: 60")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="these scenes alone")
    parser.add_argument("--workers", type=int, default=2, help="processes, one scene each: 2")
    options = parser.parse_args(arguments)
    indices = options.only or range(options.scenes)
    rows = []
    calls = [(index,) for index in indices]
    for done, row in enumerate(in_processes(losses_of, calls, options.workers), start=1):
        told = "takes no part" if row is None else f"scene {row.index} {row.family}: IoU {row.found:.2f}"
        print(f"{done}/{len(indices)} {told}", file=sys.stderr, flush=True)
        rows += [] if row is None else [row]
    if not rows:
        parser.error("none of these scenes takes part; expected more of them")
    print("\n".join(table(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
