"""How near the carved shape comes to what shadows can give, and to the truth, method by method.

Simulates each target on a profile, reconstructs it fully automatically and compares the voxels with the
shadow hull (what perfect silhouettes of the true target would leave) and with the truth. Writes a table::

    python benchmarks/accuracy.py --out docs/accuracy.md

Nothing is tuned a target: every case runs with the default parameters.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from csas_shadow_ros.core.carving import Carver
from csas_shadow_ros.core.mesh import measure, mesh_from_grid
from csas_shadow_ros.core.parameters import (
    CarvingParameters,
    PipelineParameters,
    ShadowParameters,
    SubApertureParameters,
)
from csas_shadow_ros.core.pipeline import ProcessedView, run
from csas_shadow_ros.core.volume import VoxelGrid
from csas_shadow_ros.simulation import SimulatedRun, iou, shadow_hull, simulate, voxelise_truth

TARGETS = ("box", "cone", "cylinder", "sphere", "tyre", "rock", "frame", "frame_grid")
METHODS = ("consensus", "hard", "soft")


@dataclass(frozen=True)
class Case:
    """One target by one method."""

    target: str
    seed: int
    enhancement: str
    method: str
    iou_hull: float
    iou_truth: float
    hull_vs_truth: float
    length_m: float
    width_m: float
    height_m: float
    true_size_m: tuple[float, float, float]
    threshold: float
    seconds: float


def grids_of(
    simulated: SimulatedRun, step_deg: float, enhancement: str = "exact"
) -> tuple[dict[str, VoxelGrid], float]:
    """Reconstruct a run once and carve it by every method; empty if no object was found."""
    start = time.perf_counter()
    views: list[ProcessedView] = []
    parameters = PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=step_deg),
        shadow=ShadowParameters(enhancement=enhancement),
        carving=CarvingParameters(method="consensus"),
    )
    result = run(simulated.image, simulated.track, parameters, on_view=views.append)
    if result.grid is None or result.other_grid is None:
        return {}, time.perf_counter() - start
    hard = Carver(result.grid.volume, CarvingParameters(method="hard"))
    for view in views:
        hard.integrate(view.mask)
    grids = {"consensus": result.grid, "hard": hard.grid(), "soft": result.other_grid}
    return grids, time.perf_counter() - start


def cases_of(target: str, seed: int, profile: str, step_deg: float, enhancement: str) -> list[Case]:
    """Simulate and score one target."""
    simulated = simulate(profile, target, seed=seed)
    grids, seconds = grids_of(simulated, step_deg, enhancement)
    cases = []
    mesh = simulated.truth.target
    true_size = measure(mesh)
    every = max(1, len(simulated.truth.sonar_m) // 360)
    for method, grid in grids.items():
        hull = shadow_hull(mesh, simulated.truth.sonar_m[::every], grid.volume)
        truth = voxelise_truth(mesh, grid.volume)
        size = measure(mesh_from_grid(grid)) if grid.occupied.any() else None
        cases.append(
            Case(
                target,
                seed,
                enhancement,
                method,
                iou(grid.occupied, hull),
                iou(grid.occupied, truth),
                iou(hull, truth),
                size.length_m if size else np.nan,
                size.width_m if size else np.nan,
                size.height_m if size else np.nan,
                (true_size.length_m, true_size.width_m, true_size.height_m),
                grid.threshold,
                seconds,
            )
        )
    return cases


def table(cases: list[Case], arguments: str) -> str:
    """Write the cases as a markdown page."""
    lines = [
        "# Accuracy",
        "",
        "IoU of the carved voxels with the shadow hull (the best that perfect shadows can give) and with the",
        "truth: fully automatic, default parameters, the same rule for every target. Made by:",
        "",
        f"    python benchmarks/accuracy.py {arguments}".rstrip(),
        "",
        "| target | FFSE | hull vs truth | "
        + " | ".join(f"{m}: hull / truth" for m in METHODS)
        + " | consensus L × W × H (m) | truth |",
        "|---|---|---|" + "---|" * len(METHODS) + "---|---|",
    ]
    keys = list(dict.fromkeys((c.target, c.seed, c.enhancement) for c in cases))
    for key in keys:
        own = {c.method: c for c in cases if (c.target, c.seed, c.enhancement) == key}
        first = own["consensus"]
        scores = " | ".join(f"{own[m].iou_hull:.2f} / {own[m].iou_truth:.2f}" for m in METHODS)
        found = f"{first.length_m:.2f} × {first.width_m:.2f} × {first.height_m:.2f}"
        true = " × ".join(f"{size:.2f}" for size in first.true_size_m)
        ffse = "yes" if first.enhancement != "none" else "no"
        lines.append(f"| {first.target} | {ffse} | {first.hull_vs_truth:.2f} | {scores} | {found} | {true} |")
    for enhancement in dict.fromkeys(c.enhancement for c in cases):
        means = []
        for method in METHODS:
            values = [c.iou_hull for c in cases if (c.method, c.enhancement) == (method, enhancement)]
            means.append(f"{method} {np.mean(values):.3f}")
        how = "without" if enhancement == "none" else "with"
        lines += ["", f"Mean IoU with the hull, {how} FFSE: {', '.join(means)}."]
    lines += ["", f"Python {platform.python_version()}, {platform.machine()}.", ""]
    return "\n".join(lines)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--targets", nargs="+", default=list(TARGETS), help="which (default: all)")
    parser.add_argument("--profile", default="standard")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--step-deg", type=float, default=2.0, help="aspect step (default 2)")
    parser.add_argument("--without-ffse", action="store_true", help="also without shadow enhancement")
    parser.add_argument(
        "--out", type=Path, default=Path("docs/accuracy.md"), help="page to write, and a .json beside it"
    )
    options = parser.parse_args()
    cases: list[Case] = []
    for enhancement in ("exact", "none") if options.without_ffse else ("exact",):
        for target in options.targets:
            new = cases_of(target, options.seed, options.profile, options.step_deg, enhancement)
            cases += new
            print(target, enhancement, {c.method: round(c.iou_hull, 3) for c in new}, flush=True)
    options.out.write_text(table(cases, " ".join(sys.argv[1:])), encoding="utf-8")
    text = json.dumps([asdict(c) for c in cases], indent=1)
    options.out.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
