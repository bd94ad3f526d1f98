"""How near the carved shape comes to what shadows can give, and to the truth.

Simulates known targets at three positions and headings, clean and with four kinds of fault, and empty
seabeds; reconstructs each run fully automatically and compares the voxels with the shadow hull (what perfect
silhouettes of the true target would leave) and with the truth. Writes a page, its numbers and two figures::

    python benchmarks/accuracy.py                      # everything: docs/accuracy.md, .json, figures
    python benchmarks/accuracy.py --resume             # go on with a run that was interrupted
    python benchmarks/accuracy.py --short              # four cases against benchmarks/accuracy_floor.json

Nothing is tuned a target: every case runs with the default parameters. The same arguments and the same code
write the same files.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

import csas_shadow_ros
from csas_shadow_ros.core.errors import CsasError, ViewError
from csas_shadow_ros.core.geometry import View
from csas_shadow_ros.core.imaging.segmentation import require_silhouette
from csas_shadow_ros.core.parameters import (
    CarvingParameters,
    PipelineParameters,
    ShadowParameters,
    SubApertureParameters,
)
from csas_shadow_ros.core.pipeline import ProcessedView, Result, run
from csas_shadow_ros.core.shape.carving import Carver
from csas_shadow_ros.core.shape.mesh import measure, mesh_from_grid
from csas_shadow_ros.core.shape.volume import Volume, VoxelGrid
from csas_shadow_ros.simulation import (
    PROFILES,
    Faults,
    SimulatedRun,
    iou,
    shadow_hull,
    simulate,
    voxelise_truth,
)

ROOT = Path(__file__).resolve().parents[1]
FLOOR = Path(__file__).resolve().parent / "accuracy_floor.json"

#: The targets that the acceptance lines count.
COMPACT = ("box", "cone", "cylinder", "sphere", "tyre", "rock", "frame", "l_shape")
#: A target among solids and cables that are no part of it: reported, in no mean.
CLUTTER = ("frame_grid",)
#: Targets whose hollows shadows do show: scored against the truth as well.
RING_AND_FRAME = ("tyre", "frame")
EMPTY = "empty"
TARGETS = (*COMPACT, *CLUTTER, EMPTY)
#: Position (x, y) in metres and heading in degrees that go with a seed.
POSES = {1: ((0.0, 0.0), 0.0), 2: ((0.15, -0.1), 33.0), 3: ((-0.2, 0.25), 71.0)}
EMPTY_SEABEDS = 20
CLEAN = "clean"
CONDITIONS = {
    CLEAN: Faults(),
    "contrast": Faults(contrast_db=6.0),
    "arc": Faults(missing_arcs_deg=((40.0, 130.0),)),
    "track": Faults(track_wobble_m=0.1, height_error=0.05),
    "phase": Faults(phase_error_rad=1.0),
}
CONDITION_TEXT = {
    CLEAN: "clean (15 dB)",
    "contrast": "contrast of 6 dB",
    "arc": "90° of arc missing",
    "track": "track wobble 0.1 m, height 5 % off",
    "phase": "phase error of 1 rad",
}
METHODS = ("consensus", "hard", "soft")
DEFAULT_METHOD = "consensus"
WITH_FFSE, WITHOUT_FFSE = "exact", "none"
SIZES = ("length_m", "width_m", "height_m")
QUANTITIES = (*SIZES, "volume_m3")

# What the acceptance lines ask for.
LEAST_MEAN_IOU = 0.90
LEAST_IOU = 0.80
LEAST_IOU_TRUTH = 0.60
SIZE_TOLERANCE = 0.05
LEAST_SIZE_SHARE = 1.0
LEAST_COVERAGE = 0.90
MOST_LOSS = 0.10

#: The short form: what continuous integration has time for.
SHORT_CASES = (("box", CLEAN), ("tyre", CLEAN), ("frame", CLEAN), ("box", "contrast"))
SHORT_SEED = 2
SHORT_STEP_DEG = 6.0
FLOOR_TOLERANCE = 0.02

# The lattice that is scored reaches this far beyond the true target: the hull is a little larger than it.
_ROOM_M = 0.2
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class AccuracyError(Exception):
    """The benchmark was asked for something that it cannot do."""


@dataclass(frozen=True)
class Settings:
    """What all cases of a run share.

    Parameters
    ----------
    profile : str
        Simulated profile.
    step_deg : float
        Aspect step between views.
    enhancements : tuple of str
        Each is a run of the chain.
    """

    profile: str = "standard"
    step_deg: float = 3.0
    enhancements: tuple[str, ...] = (WITH_FFSE, WITHOUT_FFSE)

    @property
    def voxel_size_m(self) -> float:
        """Edge of a voxel: the default, as for everything else."""
        return CarvingParameters().voxel_size_m


@dataclass(frozen=True)
class Case:
    """One simulated run: a target, the seed (with it position and heading), and what is wrong with it."""

    target: str
    seed: int
    condition: str = CLEAN

    def __str__(self) -> str:
        return f"{self.target}, seed {self.seed}, {self.condition}"


@dataclass(frozen=True)
class Score:
    """One reconstruction of a case.

    Parameters
    ----------
    method, enhancement : str
        How it was carved, and enhanced before.
    iou_hull, iou_truth : float
        Of the voxels with the shadow hull and with the truth; 0 where no object was found.
    threshold : float or None
        Chosen automatically.
    size : dict
        `QUANTITIES` as found; empty where no object was found.
    intervals : dict
        95 % intervals of them, where the chain gives them.
    """

    method: str
    enhancement: str
    iou_hull: float
    iou_truth: float
    threshold: float | None = None
    size: dict[str, float] = field(default_factory=dict)
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """What a case came to.

    Parameters
    ----------
    case : Case
        What was simulated.
    found : bool
        Whether the default chain says that there is an object.
    hull_vs_truth : float or None
        IoU of the hull with the truth: what the shape itself hides from shadows. None for an empty seabed.
    true_size : dict
        `QUANTITIES` of the true mesh.
    scores : tuple of Score
        One for each method and enhancement.
    refused : str
        Why the chain refused the run, if it did.
    seconds : float
        Wall time of the case. Kept out of what is published, which is the same for every run.
    """

    case: Case
    found: bool
    hull_vs_truth: float | None = None
    true_size: dict[str, float] = field(default_factory=dict)
    scores: tuple[Score, ...] = ()
    refused: str = ""
    seconds: float = 0.0

    def score(self, method: str = DEFAULT_METHOD, enhancement: str = WITH_FFSE) -> Score | None:
        """Return the score of a method, or None if it was not run."""
        for score in self.scores:
            if (score.method, score.enhancement) == (method, enhancement):
                return score
        return None

    def to_json(self, *, timed: bool) -> dict[str, Any]:
        """Return the row as plain values."""
        values = asdict(self)
        case = values.pop("case")
        if not timed:
            del values["seconds"]
        return {**case, **values}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Row:
        """Make a row of what `to_json` returned."""
        scores = tuple(
            Score(**{**s, "intervals": {k: (low, high) for k, (low, high) in s["intervals"].items()}})
            for s in values["scores"]
        )
        return cls(
            Case(values["target"], values["seed"], values["condition"]),
            values["found"],
            values["hull_vs_truth"],
            dict(values["true_size"]),
            scores,
            values["refused"],
            values.get("seconds", 0.0),
        )


# ---- one case


def simulate_case(case: Case, settings: Settings) -> SimulatedRun:
    """Simulate a case: its seed fixes position and heading as well."""
    position, heading = POSES[case.seed] if case.target != EMPTY else ((0.0, 0.0), 0.0)
    return simulate(
        settings.profile,
        case.target,
        seed=case.seed,
        position_m=position,
        heading_deg=heading,
        faults=CONDITIONS[case.condition],
        workers=1,
    )


def reconstruct(
    simulated: SimulatedRun, settings: Settings, enhancement: str
) -> tuple[Result, dict[str, VoxelGrid]]:
    """Run the chain once and carve its views by every method.

    Returns
    -------
    result : Result
        Of the default method.
    grids : dict
        Grid of each method; empty if no object was found.
    """
    parameters = PipelineParameters(
        sub_aperture=SubApertureParameters(step_deg=settings.step_deg),
        shadow=ShadowParameters(enhancement=enhancement),
        carving=CarvingParameters(method=DEFAULT_METHOD),
    )
    masks: list[View] = []  # of a view only this is kept: a run's views in full are a gigabyte

    def keep(view: ProcessedView) -> None:
        masks.append(view.mask)

    result = run(simulated.image, simulated.track, parameters, on_view=keep, workers=1)
    if result.grid is None or result.other_grid is None:
        return result, {}
    grids = {DEFAULT_METHOD: result.grid, "soft": result.other_grid}
    for method in METHODS:
        if method not in grids:
            grids[method] = _carved(masks, result.grid.volume, method)
    return result, grids


def _carved(masks: Sequence[View], volume: Volume, method: str) -> VoxelGrid:
    """Carve silhouettes by another method than the run's."""
    carver = Carver(volume, CarvingParameters(method=method))
    for mask in masks:
        try:
            carver.integrate(require_silhouette(mask))
        except ViewError:  # the chain leaves out a view without a silhouette, whatever carves
            continue
    return carver.grid()


def lattice_over(volume: Volume, mesh: trimesh.Trimesh) -> tuple[Volume, tuple[slice, slice, slice]]:
    """Extend a carved volume by whole voxels so that it holds the true target.

    What the automatic volume cuts off counts as missed: it would not be seen inside the volume.

    Returns
    -------
    wide : Volume
        The extended lattice.
    inside : tuple of slice
        Where the carved volume lies in it.
    """
    d = volume.voxel_size_m
    low = np.asarray(volume.origin_m) - d / 2.0
    high = low + np.asarray(volume.size_m)
    before = np.maximum(0, np.ceil((low - (mesh.bounds[0] - _ROOM_M)) / d)).astype(int)
    after = np.maximum(0, np.ceil((mesh.bounds[1] + _ROOM_M - high) / d)).astype(int)
    before[2] = 0  # the lowest layer stands on the seabed
    x, y, z = (float(o) for o in np.asarray(volume.origin_m) - before * d)
    nz, ny, nx = volume.shape
    shape = (nz + int(after[2]), ny + int(before[1] + after[1]), nx + int(before[0] + after[0]))
    inside = (
        slice(0, nz),
        slice(int(before[1]), int(before[1]) + ny),
        slice(int(before[0]), int(before[0]) + nx),
    )
    return Volume((x, y, z), d, shape), inside


class _Truth:
    """Hull and truth on the lattices that are asked for: most methods share one."""

    def __init__(self, simulated: SimulatedRun) -> None:
        self.mesh = simulated.truth.target
        every = max(1, len(simulated.truth.sonar_m) // 360)
        self._sonar = simulated.truth.sonar_m[::every]
        self._made: dict[Volume, tuple[NDArray[np.bool_], NDArray[np.bool_]]] = {}

    def on(self, volume: Volume) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return (hull, truth)."""
        if volume not in self._made:
            hull = shadow_hull(self.mesh, self._sonar, volume)
            self._made[volume] = hull, voxelise_truth(self.mesh, volume)
        return self._made[volume]

    def scores_of(self, grid: VoxelGrid) -> tuple[float, float]:
        """Return the IoU of a grid with the hull and with the truth."""
        wide, inside = lattice_over(grid.volume, self.mesh)
        occupied = np.zeros(wide.shape, bool)
        occupied[inside] = grid.occupied
        hull, truth = self.on(wide)
        return iou(occupied, hull), iou(occupied, truth)

    def hull_vs_truth(self, voxel_size_m: float) -> float:
        """Return the IoU of the hull with the truth, on a lattice that nothing was carved on."""
        low, high = self.mesh.bounds
        middle, size = (low + high) / 2.0, high - low + 2.0 * _ROOM_M
        volume = Volume.around(
            (float(middle[0]), float(middle[1])),
            (float(size[0]), float(size[1]), float(size[2])),
            voxel_size_m,
        )
        return iou(*self.on(volume))


def _rounded(value: float) -> float:
    # Far finer than anything that is reported; keeps the files short.
    return round(float(value), 6)


def _quantities(measures: Any) -> dict[str, float]:
    return {name: _rounded(getattr(measures, name)) for name in QUANTITIES}


def _intervals(measures: Any) -> dict[str, tuple[float, float]]:
    given = getattr(measures, "intervals", None) or {}
    return {
        name: (_rounded(given[name][0]), _rounded(given[name][1])) for name in QUANTITIES if name in given
    }


def score_case(case: Case, settings: Settings) -> Row:
    """Simulate a case, reconstruct it by every method and score it.

    Raises
    ------
    CsasError
        If the simulation refuses the case. A refusal by the chain is a result: `Row.refused`.
    """
    start = time.perf_counter()
    simulated = simulate_case(case, settings)
    if case.target == EMPTY:
        result, _ = reconstruct(simulated, settings, WITH_FFSE)
        return Row(case, found=result.dimensions is not None, seconds=time.perf_counter() - start)
    truth = _Truth(simulated)
    scores: list[Score] = []
    found, refused = False, ""
    for enhancement in settings.enhancements:
        try:
            result, grids = reconstruct(simulated, settings, enhancement)
        except CsasError as error:
            result, grids, refused = Result(), {}, str(error)
        if enhancement == WITH_FFSE:
            found = result.dimensions is not None
        for method in METHODS:
            grid = grids.get(method)
            if grid is None or not grid.occupied.any():
                scores.append(Score(method, enhancement, 0.0, 0.0))
                continue
            measures = result.dimensions if grid is result.grid else measure(mesh_from_grid(grid))
            to_hull, to_truth = truth.scores_of(grid)
            scores.append(
                Score(
                    method,
                    enhancement,
                    _rounded(to_hull),
                    _rounded(to_truth),
                    _rounded(grid.threshold),
                    _quantities(measures),
                    _intervals(measures),
                )
            )
    return Row(
        case,
        found,
        _rounded(truth.hull_vs_truth(settings.voxel_size_m)),
        _quantities(measure(truth.mesh)),
        tuple(scores),
        refused,
        time.perf_counter() - start,
    )


# ---- all cases


def plan(
    targets: Iterable[str], seeds: Sequence[int], conditions: Sequence[str], empty_seabeds: int
) -> list[Case]:
    """List the cases in the order in which they are reported."""
    named = list(targets)
    cases: list[Case] = []
    for condition in conditions:
        for target in named:
            if target != EMPTY:
                cases += [Case(target, seed, condition) for seed in seeds]
            elif condition == conditions[0]:
                cases += [Case(EMPTY, seed) for seed in range(1, empty_seabeds + 1)]
    return cases


def code_fingerprint() -> str:
    """Return a digest of what decides the numbers: a run is not gone on with after that has changed."""
    digest = hashlib.sha256()
    package = Path(csas_shadow_ros.__file__).parent
    for source in sorted([*(package / "core").rglob("*.py"), *(package / "simulation").rglob("*.py")]):
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()[:16]


def _stamp(settings: Settings) -> dict[str, Any]:
    return {**asdict(settings), "enhancements": list(settings.enhancements), "code": code_fingerprint()}


def read_rows(path: Path, settings: Settings) -> dict[Case, Row]:
    """Read the rows of an interrupted run; those of other settings or of other code are left out.

    Parameters
    ----------
    path : Path
        The .jsonl file; may be missing, and its last line may be cut short.
    settings : Settings
        What the rows must have been made with.
    """
    rows: dict[Case, Row] = {}
    stamp = _stamp(settings)
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            values = json.loads(line)
        except json.JSONDecodeError:  # the run ended while it wrote this
            continue
        if values.pop("settings") == stamp:
            row = Row.from_json(values)
            rows[row.case] = row
    return rows


def _limit_threads() -> None:
    cv2.setNumThreads(1)


def _score_all(cases: Sequence[Case], settings: Settings, jobs: int) -> Iterator[Row]:
    if jobs == 1:
        for case in cases:
            yield score_case(case, settings)
        return
    # The variables are read when the libraries are loaded: they are for the processes that start now.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_limit_threads)
    try:
        for future in as_completed([pool.submit(score_case, case, settings) for case in cases]):
            yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def _outcome(row: Row) -> str:
    if row.case.target == EMPTY:
        return "an object" if row.found else "no object"
    default = row.score()
    return "not scored" if default is None else f"IoU {default.iou_hull:.3f}"


def run_cases(
    cases: Sequence[Case],
    settings: Settings,
    record: Path,
    *,
    jobs: int = 1,
    resume: bool = False,
    say: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
) -> list[Row]:
    """Score cases and write each down as soon as it is done.

    Parameters
    ----------
    cases : sequence of Case
        What to score.
    settings : Settings
        What they share.
    record : Path
        The .jsonl file; replaced unless the run is resumed.
    jobs : int
        Processes, one case each; 1: in this process.
    resume : bool
        Take the rows that `record` holds instead of scoring their cases again.
    say : callable
        Takes a line of progress.

    Returns
    -------
    list of Row
        In the order of the cases.
    """
    rows = read_rows(record, settings) if resume else {}
    rows = {case: rows[case] for case in cases if case in rows}
    todo = [case for case in cases if case not in rows]
    if resume:
        say(f"{len(rows)} of {len(cases)} cases were done before")
    record.parent.mkdir(parents=True, exist_ok=True)
    start, stamp = time.monotonic(), _stamp(settings)
    with record.open("w", encoding="utf-8") as file:
        # What is kept is written again, so that a line cut short does not stay in the middle.
        for row in rows.values():
            file.write(json.dumps({**row.to_json(timed=True), "settings": stamp}) + "\n")
        file.flush()
        for done, row in enumerate(_score_all(todo, settings, jobs), start=1):
            rows[row.case] = row
            file.write(json.dumps({**row.to_json(timed=True), "settings": stamp}) + "\n")
            file.flush()
            elapsed = time.monotonic() - start
            rest = elapsed / done * (len(todo) - done)
            say(
                f"{len(rows)}/{len(cases)} {row.case}: {_outcome(row)}, {row.seconds:.0f} s;"
                f" {_clock(elapsed)} gone, about {_clock(rest)} to go"
            )
    return [rows[case] for case in cases]


# ---- what the rows say


@dataclass(frozen=True)
class Line:
    """One line of the acceptance list; `met` is None where the rows do not tell."""

    wanted: str
    measured: str
    met: bool | None


def _of(rows: Iterable[Row], condition: str, targets: Sequence[str] = COMPACT) -> list[Row]:
    return [r for r in rows if r.case.condition == condition and r.case.target in targets]


def _mean(values: Iterable[float]) -> float:
    listed = list(values)
    return math.fsum(listed) / len(listed) if listed else math.nan


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]  # str.capitalize would write dB as db


def _iou(
    row: Row, method: str = DEFAULT_METHOD, enhancement: str = WITH_FFSE, against: str = "hull"
) -> float:
    score = row.score(method, enhancement)
    return math.nan if score is None else score.iou_hull if against == "hull" else score.iou_truth


def size_errors(row: Row) -> dict[str, float]:
    """Return found minus true of the default method, by quantity; empty where no object was found."""
    score = row.score()
    size = score.size if score else {}
    return {name: size[name] - row.true_size[name] for name in size}


def sizes_within(row: Row, voxel_size_m: float) -> list[bool]:
    """Return whether length, width and height are within 5 % or a voxel, whichever is larger."""
    errors = size_errors(row)
    return [
        name in errors and abs(errors[name]) <= max(SIZE_TOLERANCE * row.true_size[name], voxel_size_m) + 1e-9
        for name in SIZES
    ]


def intervals_hold(row: Row, quantities: Sequence[str] = SIZES) -> list[bool]:
    """Return whether each interval that the default method gives contains the truth."""
    score = row.score()
    given = score.intervals if score else {}
    return [given[n][0] <= row.true_size[n] <= given[n][1] for n in quantities if n in given]


def _line(wanted: str, values: Sequence[float | bool], measured: Callable[[], str], met: bool) -> Line:
    return Line(wanted, measured() if values else "not measured", met if values else None)


def acceptance(rows: Sequence[Row], voxel_size_m: float) -> list[Line]:
    """Compare the rows with what is asked of the default method."""
    clean = _of(rows, CLEAN)
    empty = [not r.found for r in rows if r.case.target == EMPTY]
    return [
        *_asked_of_shapes(clean),
        *_asked_of_sizes(clean, voxel_size_m),
        *_asked_of_conditions(rows, clean),
        _line(
            "empty seabeds that give no object: all",
            empty,
            lambda: f"{sum(empty)} of {len(empty)}",
            all(empty),
        ),
    ]


def _asked_of_shapes(clean: Sequence[Row]) -> list[Line]:
    scores = [_iou(r) for r in clean]
    targets = len({r.case.target for r in clean})
    mean = _mean(scores)
    lowest = min(clean, key=_iou, default=None)
    lines = [
        _line(
            f"mean IoU with the hull, clean, at least {LEAST_MEAN_IOU:.2f}",
            scores,
            lambda: f"{mean:.3f} ({targets} targets, {len(clean)} cases)",
            mean >= LEAST_MEAN_IOU,
        ),
        _line(
            f"lowest IoU with the hull, clean, at least {LEAST_IOU:.2f}",
            scores,
            lambda: f"{_iou(lowest):.3f} ({lowest.case.target}, seed {lowest.case.seed})" if lowest else "",
            min(scores, default=0.0) >= LEAST_IOU,
        ),
    ]
    for target in RING_AND_FRAME:
        own = [_iou(r, against="truth") for r in clean if r.case.target == target]
        lines.append(
            _line(
                f"IoU of the {target} with the truth, clean, at least {LEAST_IOU_TRUTH:.2f}",
                own,
                lambda own=own: f"lowest {min(own):.3f}, mean {_mean(own):.3f}",  # type: ignore[misc]
                min(own, default=0.0) >= LEAST_IOU_TRUTH,
            )
        )
    return lines


def _asked_of_sizes(clean: Sequence[Row], voxel_size_m: float) -> list[Line]:
    within = [ok for r in clean for ok in sizes_within(r, voxel_size_m)]
    held = [ok for r in clean for ok in intervals_hold(r)]
    return [
        _line(
            f"length, width and height, clean, within {_percent(SIZE_TOLERANCE)} or one voxel"
            f" ({voxel_size_m * 100:g} cm), whichever is larger: at least {_percent(LEAST_SIZE_SHARE)}",
            within,
            lambda: f"{_percent(_mean(within))} ({sum(within)} of {len(within)})",
            _mean(within) >= LEAST_SIZE_SHARE,
        ),
        _line(
            "95 % intervals of length, width and height, clean, contain the truth: at least"
            f" {_percent(LEAST_COVERAGE)}",
            held,
            lambda: f"{_percent(_mean(held))} ({sum(held)} of {len(held)})",
            _mean(held) >= LEAST_COVERAGE,
        ),
    ]


def _asked_of_conditions(rows: Sequence[Row], clean: Sequence[Row]) -> list[Line]:
    before = {(r.case.target, r.case.seed): _iou(r) for r in clean}
    lines = []
    for condition in CONDITIONS:
        if condition == CLEAN:
            continue
        pairs = [
            (before[key], _iou(r))
            for r in _of(rows, condition)
            if (key := (r.case.target, r.case.seed)) in before
        ]
        loss = _mean(a - b for a, b in pairs)
        lines.append(
            _line(
                f"mean IoU lost by {CONDITION_TEXT[condition]}, at most {MOST_LOSS:.2f}",
                [a for a, _ in pairs],
                lambda loss=loss, pairs=pairs: f"{loss:.3f} (to {_mean(b for _, b in pairs):.3f})",  # type: ignore[misc]
                loss <= MOST_LOSS,
            )
        )
    return lines


# ---- the page


def _pair(rows: Sequence[Row], method: str, enhancement: str) -> str:
    values = [_mean(_iou(r, method, enhancement, against) for r in rows) for against in ("hull", "truth")]
    return "–" if math.isnan(values[0]) else f"{values[0]:.2f} / {values[1]:.2f}"


def _table_row(name: str, rows: Sequence[Row]) -> str:
    hull = _mean(r.hull_vs_truth for r in rows if r.hull_vs_truth is not None)
    columns = [_pair(rows, method, WITH_FFSE) for method in METHODS]
    columns.append(_pair(rows, DEFAULT_METHOD, WITHOUT_FFSE))
    return f"| {name} | {hull:.2f} | " + " | ".join(columns) + " |"


def _present(rows: Sequence[Row], targets: Sequence[str]) -> list[str]:
    return [t for t in targets if any(r.case.target == t for r in rows)]


def condition_table(rows: Sequence[Row], condition: str) -> list[str]:
    """Write the table of one condition: IoU by target and method, means over the seeds."""
    lines = [
        "| target | hull vs truth | "
        + " | ".join(f"{m}: hull / truth" for m in METHODS)
        + f" | {DEFAULT_METHOD} without FFSE |",
        "|---|---|" + "---|" * (len(METHODS) + 1),
    ]
    compact = _of(rows, condition)
    for target in _present(compact, COMPACT):
        lines.append(_table_row(target, [r for r in compact if r.case.target == target]))
    if compact:
        lines.append(_table_row("**mean**", compact))
    clutter = _of(rows, condition, CLUTTER)
    for target in _present(clutter, CLUTTER):
        lines.append(
            _table_row(
                f"{target} (clutter, not in the mean)", [r for r in clutter if r.case.target == target]
            )
        )
    notes = [f"No object: {r.case}." for r in (*compact, *clutter) if not r.found and not r.refused]
    notes += [f"Refused: {r.case}: {r.refused}." for r in (*compact, *clutter) if r.refused]
    return [*lines, *(["", *notes] if notes else [])]


def _share(hits: Sequence[bool]) -> str:
    return f"{sum(hits)} of {len(hits)}" if hits else "–"


def _metres(size: Mapping[str, float]) -> str:
    return " × ".join(f"{size[name]:.2f}" for name in SIZES)


def dimension_tables(rows: Sequence[Row], conditions: Sequence[str], voxel_size_m: float) -> list[str]:
    """Write the errors of the default method's dimensions: by target (clean), and by condition."""
    lines = [
        "| target | true L × W × H (m) | error of L / W / H (cm) | of the volume | within tolerance"
        " | in the interval |",
        "|---|---|---|---|---|---|",
    ]
    every = [*COMPACT, *CLUTTER]
    clean = _of(rows, CLEAN, every)
    for target in _present(clean, every):
        own = [r for r in clean if r.case.target == target]
        errors = [e for e in map(size_errors, own) if e]
        centimetres = " / ".join(f"{100.0 * _mean(e[n] for e in errors):+.1f}" for n in SIZES)
        volume = _mean(size_errors(r)["volume_m3"] / r.true_size["volume_m3"] for r in own if size_errors(r))
        # A rock is another one for every seed.
        sizes = list(dict.fromkeys(_metres(r.true_size) for r in own))
        name = target + (" (clutter)" if target in CLUTTER else "")
        within = _share([ok for r in own for ok in sizes_within(r, voxel_size_m)])
        held = _share([ok for r in own for ok in intervals_hold(r)])
        if not errors:
            centimetres, volume_text = "–", "–"
        else:
            volume_text = f"{100.0 * volume:+.0f} %"
        lines.append(f"| {name} | {'; '.join(sizes)} | {centimetres} | {volume_text} | {within} | {held} |")
    lines += [
        "",
        "| condition | mean absolute error of L / W / H (cm) | within tolerance"
        " | in the interval: L, W, H, volume |",
        "|---|---|---|---|",
    ]
    for condition in conditions:
        own = _of(rows, condition)
        errors = [e for e in map(size_errors, own) if e]
        if not errors:
            continue
        centimetres = " / ".join(f"{100.0 * _mean(abs(e[n]) for e in errors):.1f}" for n in SIZES)
        within = _share([ok for r in own for ok in sizes_within(r, voxel_size_m)])
        held = ", ".join(_share([ok for r in own for ok in intervals_hold(r, (n,))]) for n in QUANTITIES)
        lines.append(f"| {CONDITION_TEXT[condition]} | {centimetres} | {within} | {held} |")
    return lines


def threshold_table(rows: Sequence[Row], conditions: Sequence[str]) -> list[str]:
    """Write the thresholds that were chosen, lowest to highest over the compact targets."""
    lines = ["| condition | " + " | ".join(METHODS) + " |", "|---|" + "---|" * len(METHODS)]
    for condition in conditions:
        cells = []
        for method in METHODS:
            scores = [r.score(method) for r in _of(rows, condition)]
            chosen = [s.threshold for s in scores if s is not None and s.threshold is not None]
            cells.append(f"{min(chosen):.3f} to {max(chosen):.3f}" if chosen else "–")
        lines.append(f"| {CONDITION_TEXT[condition]} | " + " | ".join(cells) + " |")
    return lines


def page(rows: Sequence[Row], settings: Settings, arguments: Sequence[str], figures: Sequence[str]) -> str:
    """Write the rows as a markdown page.

    Parameters
    ----------
    rows : sequence of Row
        All cases.
    settings : Settings
        What they share.
    arguments : sequence of str
        Of the command that made them.
    figures : sequence of str
        Paths of the figures, as seen from the page.
    """
    voxel = settings.voxel_size_m
    with_target = [r.case for r in rows if r.case.target != EMPTY]
    conditions = [c for c in CONDITIONS if any(case.condition == c for case in with_target)]
    seeds = sorted({case.seed for case in with_target})
    poses = "; ".join(
        f"seed {s}: ({POSES[s][0][0]:g}, {POSES[s][0][1]:g}) m, {POSES[s][1]:g}°" for s in seeds
    )
    verdict = {True: "met", False: "**not met**", None: "–"}
    lines = [
        "# Accuracy",
        "",
        "How close the carved voxels come to the truth and to the *shadow hull*, the shape that perfect",
        "shadows of the true target would leave and the best that carving can give. Fully automatic, with",
        "default parameters and the same rule for every target. The rules were made on these targets:",
        "[Accuracy on random scenes](population.md) has shapes that chose nothing. Written by:",
        "",
        f"    python benchmarks/accuracy.py {' '.join(arguments)}".rstrip(),
        "",
        f"Profile {settings.profile}, views every {settings.step_deg:g}°, voxels of {voxel * 100:g} cm."
        f" The seed fixes speckle, position and heading ({poses or 'none'}).",
        "All numbers are in the .json file beside this page.",
        "",
        "## Requirements and measurements",
        "",
        f"Default method ({DEFAULT_METHOD}, with shadow enhancement), over"
        f" {', '.join(_present(rows, COMPACT)) or 'no target'}.",
        "Parts of the target outside the automatic volume count as missed.",
        "",
        "| required | measured | |",
        "|---|---|---|",
    ]
    lines += [f"| {a.wanted} | {a.measured} | {verdict[a.met]} |" for a in acceptance(rows, voxel)]
    lines.append("")
    lines += [f"![{_FIGURE_TEXT[Path(name).name]}]({name})\n" for name in figures]
    lines += ["## IoU", "", "With the hull / with the truth; means over the seeds.", ""]
    for condition in conditions:
        lines += [f"### {_capital(CONDITION_TEXT[condition])}", "", *condition_table(rows, condition), ""]
    lines += [
        "## Dimensions",
        "",
        f"Of the {DEFAULT_METHOD} method: found minus true, mean over the seeds, without faults. Within"
        f" tolerance: {_percent(SIZE_TOLERANCE)} or one voxel, whichever is larger.",
        "In the interval: the truth lies in the 95 % interval of the result. The volume's interval is that",
        "of the shadow hull, which is larger than the truth if no shadow shows a hollow.",
        "",
        *dimension_tables(rows, conditions, voxel),
        "",
        "## Thresholds",
        "",
        "Chosen automatically, lowest to highest over targets and seeds (clutter left out).",
        "",
        *threshold_table(rows, conditions),
        "",
    ]
    return "\n".join(lines)


# ---- the figures

IOU_FIGURE, METHODS_FIGURE = "accuracy_iou.png", "accuracy_methods.png"
_FIGURE_TEXT = {
    IOU_FIGURE: f"IoU with the shadow hull by target and condition, {DEFAULT_METHOD}",
    METHODS_FIGURE: "Mean IoU with the shadow hull by method, with and without shadow enhancement",
}
_STYLE: Any = {"font.size": 11.0, "axes.titlesize": 12.0, "figure.facecolor": "white"}
# Told apart by those who do not tell red from green, and in grey.
_COLOURS = ("#1b3a5c", "#e08214", "#4d9de0", "#7fb069", "#b5446e")
_MARKS = ("o", "s", "^", "D", "v")
_METHOD_COLOURS = dict(zip(METHODS, ("#1b3a5c", "#4d9de0", "#e08214", "#7fb069", "#b5446e"), strict=False))


def _axes(width: float, height: float, title: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_title(title)
    axes.set_ylabel("IoU with the shadow hull")
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks(np.arange(0.0, 1.01, 0.1))
    axes.grid(axis="y", color="0.88", linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure, axes


def draw_targets(rows: Sequence[Row], path: Path) -> None:
    """Draw the default method's IoU by target and condition: mean over the seeds, and their range."""
    targets = _present(rows, [*COMPACT, *CLUTTER])
    conditions = [c for c in CONDITIONS if _of(rows, c, targets)]
    with mpl.rc_context(_STYLE):
        figure, axes = _axes(10.0, 5.2, f"{_capital(DEFAULT_METHOD)} carving: mean and range over seeds")
        for k, condition in enumerate(conditions):
            shift = (k - (len(conditions) - 1) / 2.0) * 0.15
            for x, target in enumerate(targets):
                values = [_iou(r) for r in _of(rows, condition, (target,))]
                if values:
                    axes.plot([x + shift] * 2, [min(values), max(values)], color=_COLOURS[k], linewidth=1.6)
                    axes.plot(x + shift, _mean(values), _MARKS[k], color=_COLOURS[k], markersize=6)
            axes.plot([], [], _MARKS[k], color=_COLOURS[k], label=CONDITION_TEXT[condition])
        for x in range(1, len(targets)):
            axes.axvline(x - 0.5, color="0.93", linewidth=0.8)
        axes.set_xlim(-0.5, len(targets) - 0.5)
        axes.set_xticks(range(len(targets)))
        axes.set_xticklabels([t + ("\n(clutter)" if t in CLUTTER else "") for t in targets])
        axes.tick_params(axis="x", length=0)
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
        figure.savefig(path)


def draw_methods(rows: Sequence[Row], path: Path) -> None:
    """Draw the mean IoU of the compact targets by condition, method and enhancement, as bars."""
    conditions = [c for c in CONDITIONS if _of(rows, c)]
    enhancements = [
        e for e in (WITH_FFSE, WITHOUT_FFSE) if any(r.score(enhancement=e) for r in _of(rows, CLEAN) or rows)
    ]
    bars = [(method, enhancement) for method in METHODS for enhancement in enhancements]
    width = 0.84 / max(1, len(bars))
    with mpl.rc_context(_STYLE):
        figure, axes = _axes(10.0, 5.0, "Methods: mean over targets and seeds, without clutter")
        for x, condition in enumerate(conditions):
            for k, (method, enhancement) in enumerate(bars):
                value = _mean(_iou(r, method, enhancement) for r in _of(rows, condition))
                plain = enhancement == WITHOUT_FFSE
                axes.bar(
                    x + (k - (len(bars) - 1) / 2.0) * width,
                    value,
                    width * 0.92,
                    facecolor="white" if plain else _METHOD_COLOURS[method],
                    edgecolor=_METHOD_COLOURS[method],
                    hatch="////" if plain else None,
                    linewidth=1.0,
                )
        axes.set_xticks(range(len(conditions)))
        axes.set_xticklabels([CONDITION_TEXT[c].replace(", ", ",\n") for c in conditions])
        axes.tick_params(axis="x", length=0)
        handles = [
            Patch(facecolor=colour, edgecolor=colour, label=m) for m, colour in _METHOD_COLOURS.items()
        ]
        if WITHOUT_FFSE in enhancements:
            handles.append(Patch(facecolor="0.35", edgecolor="0.35", label="with FFSE"))
            handles.append(Patch(facecolor="white", edgecolor="0.35", hatch="////", label="without FFSE"))
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
        figure.savefig(path)


def publish(rows: Sequence[Row], settings: Settings, arguments: Sequence[str], out: Path) -> None:
    """Write the page, the numbers and the figures."""
    out.parent.mkdir(parents=True, exist_ok=True)
    figures: list[str] = []
    if any(r.case.target != EMPTY for r in rows):
        folder = out.parent / "figures"
        folder.mkdir(exist_ok=True)
        draw_targets(rows, folder / IOU_FIGURE)
        draw_methods(rows, folder / METHODS_FIGURE)
        figures = [f"figures/{IOU_FIGURE}", f"figures/{METHODS_FIGURE}"]
    out.write_text(page(rows, settings, arguments, figures), encoding="utf-8")
    head = {"arguments": list(arguments), "profile": settings.profile, "step_deg": settings.step_deg}
    head["voxel_size_m"] = settings.voxel_size_m
    cases = ",\n".join(" " + json.dumps(row.to_json(timed=False)) for row in rows)  # a case a line
    text = json.dumps(head)[:-1] + f', "cases": [\n{cases}\n]}}\n'
    out.with_suffix(".json").write_text(text, encoding="utf-8")


# ---- the short form


def short_cases(targets: Iterable[str] | None = None) -> list[Case]:
    """List the cases of the short form, of some targets only if they are named."""
    wanted = None if targets is None else set(targets)
    return [Case(t, SHORT_SEED, c) for t, c in SHORT_CASES if wanted is None or t in wanted]


def floor_of(rows: Iterable[Row], settings: Settings) -> dict[str, Any]:
    """Return what a floor file holds of the default method, case by case.

    The IoU with the hull, and which of `SIZES` are within 5 % or a voxel: these must stay so.
    """
    rows = list(rows)
    values = {str(r.case): round(_iou(r), 4) for r in rows}
    right = {
        str(r.case): [
            name for name, good in zip(SIZES, sizes_within(r, settings.voxel_size_m), strict=True) if good
        ]
        for r in rows
    }
    return {
        "profile": settings.profile,
        "step_deg": settings.step_deg,
        "iou_hull": values,
        "sizes_right": right,
    }


def below_floor(rows: Iterable[Row], settings: Settings, floor: Mapping[str, Any]) -> list[str]:
    """Return a message for each case that has become worse.

    Its IoU is more than `FLOOR_TOLERANCE` below its floor, or an extent that was right is more than 5 % or a
    voxel off.

    Raises
    ------
    AccuracyError
        If the floor is of another profile or step, or does not name a case.
    """
    for name in ("profile", "step_deg"):
        if floor[name] != getattr(settings, name):
            raise AccuracyError(
                f"the floor's {name} is {floor[name]!r}, the run's {getattr(settings, name)!r}; expected the"
                " same: write another floor with --write-floor"
            )
    messages = []
    for row in rows:
        least = floor["iou_hull"].get(str(row.case))
        if least is None:
            raise AccuracyError(f"the floor has no value for {row.case}; write one with --write-floor")
        value = _iou(row)
        if not value >= least - FLOOR_TOLERANCE:
            messages.append(
                f"{row.case}: IoU with the hull is {value:.4f}; expected at least {least:.4f} (the floor)"
                f" less {FLOOR_TOLERANCE:g}"
            )
        found = size_errors(row)
        for name, good in zip(SIZES, sizes_within(row, settings.voxel_size_m), strict=True):
            if not good and name in floor["sizes_right"][str(row.case)]:
                true = row.true_size[name]
                value = f"{true + found[name]:.3f}" if name in found else "not known"
                messages.append(f"{row.case}: {name} is {value}; expected {true:.3f} within 5 % or a voxel")
    return messages


def run_short(options: argparse.Namespace) -> int:
    """Score the short form's cases in this process and hold them against their floors."""
    step = SHORT_STEP_DEG if options.step_deg is None else options.step_deg
    settings = Settings(options.profile, step, (WITH_FFSE,))
    cases = short_cases(options.targets)
    if not cases:
        names = ", ".join(dict.fromkeys(t for t, _ in SHORT_CASES))
        raise AccuracyError(f"--targets names none of the short form's; expected some of: {names}")
    if not options.write_floor and not options.floor.exists():
        raise AccuracyError(f"{options.floor} does not exist; write it with --write-floor")
    rows = []
    for case in cases:
        rows.append(score_case(case, settings))
        print(f"{case}: {_outcome(rows[-1])}, {rows[-1].seconds:.0f} s", file=sys.stderr, flush=True)
    if options.write_floor:
        options.floor.write_text(json.dumps(floor_of(rows, settings), indent=1) + "\n", encoding="utf-8")
        print(f"wrote {options.floor}")
        return 0
    messages = below_floor(rows, settings, json.loads(options.floor.read_text(encoding="utf-8")))
    for message in messages:
        print(message, file=sys.stderr)
    if not messages:
        print(f"{len(rows)} cases: none is more than {FLOOR_TOLERANCE:g} below its floor")
    return 1 if messages else 0


# ---- the command


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--targets", nargs="+", choices=TARGETS, metavar="TARGET", help=f"of {', '.join(TARGETS)}: all")
    add("--seeds", nargs="+", type=int, choices=sorted(POSES), default=sorted(POSES), help="all")
    add(
        "--conditions",
        nargs="+",
        choices=list(CONDITIONS),
        default=list(CONDITIONS),
        metavar="CONDITION",
        help=f"of {', '.join(CONDITIONS)}: all",
    )
    add("--empty-seabeds", type=int, default=EMPTY_SEABEDS, metavar="N", help=f"{EMPTY_SEABEDS}")
    add("--profile", choices=list(PROFILES), default="standard")
    add("--step-deg", type=float, help="aspect step between views: 3, short form 6")
    add("--jobs", type=int, default=2, help="processes, one case each: 2")
    add(
        "--out",
        type=Path,
        default=ROOT / "docs" / "accuracy.md",
        help="page to write; .json and figures beside it",
    )
    add("--resume", action="store_true", help="go on with an interrupted run of the same settings and code")
    add("--short", action="store_true", help="four cases against their floors; exit code 1 if one is below")
    add("--floor", type=Path, default=FLOOR, help="file of the short form's floors")
    add("--write-floor", action="store_true", help="with --short: write the floors instead")
    return parser


def _of_the_numbers(arguments: Sequence[str]) -> list[str]:
    """Leave out the arguments that do not change what is written."""
    kept: list[str] = []
    skip = False
    for argument in arguments:
        if skip:
            skip = False
        elif argument in ("--jobs", "--out"):
            skip = True
        elif argument != "--resume" and not argument.startswith(("--jobs=", "--out=")):
            kept.append(argument)
    return kept


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark.

    Parameters
    ----------
    arguments : sequence of str, optional
        Of the command line.

    Returns
    -------
    int
        Exit code: 1 if the short form found a case below its floor, 2 if it could not be run.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser()
    options = parser.parse_args(given)
    if options.jobs < 1:
        parser.error(f"--jobs is {options.jobs}; expected at least 1")
    if options.write_floor and not options.short:
        parser.error("--write-floor goes with --short")
    if options.short:
        try:
            return run_short(options)
        except AccuracyError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
    settings = Settings(options.profile, 3.0 if options.step_deg is None else options.step_deg)
    cases = plan(options.targets or TARGETS, options.seeds, options.conditions, options.empty_seabeds)
    record = options.out.with_suffix(".jsonl")
    rows = run_cases(cases, settings, record, jobs=options.jobs, resume=options.resume)
    publish(rows, settings, _of_the_numbers(given), options.out)
    record.unlink()  # the .json holds it all now
    for line in acceptance(rows, settings.voxel_size_m):
        verdict = {True: "met", False: "NOT MET", None: "-"}[line.met]
        print(f"{verdict:8}{line.wanted}: {line.measured}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
