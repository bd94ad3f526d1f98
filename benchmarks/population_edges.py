"""What an error of the sides costs the population's IoU: how good 0.92 would have to be.

Every body of a half, where its bound asks for it (6 dB or more), has its shadow hull for a circle of views.
The sides of that hull are moved out, and in, by a part of a cross-range cell, the same everywhere and in the
plan alone: heights stay right. Nothing is simulated and no result is looked at::

    python benchmarks/population_edges.py --half test --scenes 500 --workers 2

The table gives the IoU of the moved hull with the true one, mean of out and in.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

import numpy as np
import scipy.ndimage
from population import in_processes
from population_scenes import DEVELOPMENT, TEST, draw
from population_scores import LEAST_CONTRAST_DB, TrueBody

#: Errors of a side, cross-range cells.
ERRORS_CELLS = (0.1, 0.15, 0.25, 0.35, 0.5)
#: Lattice: so many times finer than what the chain carves.
_FINER = 3
_VIEWS = 60
#: Layers of voxels that are moved at most.
_MOST_VOXELS = 4


def costs_of(half: str, index: int) -> list[list[float]]:
    """Return, for each body of a scene, the IoU that each of `ERRORS_CELLS` leaves.

    Parameters
    ----------
    half : str
        Of the population.
    index : int
        Number of the scene.
    """
    spec = draw(half, index)
    if spec.contrast_db < LEAST_CONTRAST_DB:
        return []
    angles = np.arange(_VIEWS) * (2.0 * math.pi / _VIEWS)
    circle = (spec.radius_m * np.cos(angles), spec.radius_m * np.sin(angles), np.full(_VIEWS, spec.height_m))
    voxel_m = spec.voxel_m / _FINER
    costs = []
    for mesh in spec.meshes():
        body = TrueBody(mesh, np.stack(circle, axis=1), voxel_m)
        hull, _ = body.on(body.own_volume(voxel_m))
        away = np.full(hull.shape, math.inf)  # of its layer's outline, voxels; less than 0 inside
        for layer, out in zip(hull, away, strict=True):
            if layer.any():
                edt = scipy.ndimage.distance_transform_edt
                out[:] = np.where(layer, 0.5 - edt(layer), edt(~layer) - 0.5)
        # Whole voxels can be moved; what lies between is interpolated.
        steps = np.arange(-_MOST_VOXELS, _MOST_VOXELS + 1)
        volume = np.array([np.count_nonzero(away < step) for step in steps], float)
        moved = np.array(ERRORS_CELLS) * spec.cell_m / voxel_m
        grown, shrunk = (np.interp(sign * moved, steps, volume) for sign in (1.0, -1.0))
        whole = np.interp(0.0, steps, volume)
        costs.append(list((whole / grown + shrunk / whole) / 2.0))
    return costs


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--half", choices=(DEVELOPMENT, TEST), default=DEVELOPMENT, help="development")
    parser.add_argument("--scenes", type=int, default=120, help="how many, from the first on: 120")
    parser.add_argument("--workers", type=int, default=2, help="processes, one scene each: 2")
    options = parser.parse_args(arguments)
    costs: list[list[float]] = []
    calls = [(options.half, index) for index in range(options.scenes)]
    for done, found in enumerate(in_processes(costs_of, calls, options.workers), start=1):
        costs += found
        print(f"{done}/{options.scenes}", file=sys.stderr, flush=True)
    if not costs:
        parser.error("none of these scenes has a body; expected more of them")
    print(f"{len(costs)} bodies of the {options.half} half\n")
    print("| sides wrong by, cross-range cells | IoU: median | tenth percentile |", "|---|---|---|", sep="\n")
    for error, values in zip(ERRORS_CELLS, np.array(costs).T, strict=True):
        print(f"| {error:g} | {np.median(values):.2f} | {np.percentile(values, 10):.2f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
