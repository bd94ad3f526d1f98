"""What a run found, as one JSON document and as a table to read."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.metadata
import itertools
import json
import math
import platform
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..core.geometry import CoherentImage, Place, Track, place_text
from ..core.parameters import CarvingParameters, PipelineParameters
from ..core.shape.mesh import Dimensions
from ..core.shape.result import Result, ViewEvidence
from ..core.shape.threshold import thresholded
from ..core.shape.verdict import explained_share, no_object_reason
from ..core.shape.volume import VoxelGrid
from .layout import FORMAT, json_ready
from .truth import KnownTruth, TruthError, read_truth


@dataclass(eq=False)
class Context:
    """What a report tells of a run besides its result.

    Parameters
    ----------
    parameters : PipelineParameters
        Parameters used.
    command : sequence of str
        Command line.
    input : mapping
        What the input bag is (`describe_input`).
    stage : str
        Where in the chain the run started: ``image`` or one of `core.stages.STAGES`.
    image, track : CoherentImage, Track or None
        What was processed.
    spectrum_sign_override : int or None
        The sign that replaced the stated one.
    problems : sequence of str
        What was wrong with the bag.
    truth : KnownTruth or None
        What is really there.
    timings_s : dict
        Seconds of the steps round the method.
    views_in : int or None
        Views that there were, if that is known otherwise than from the result.
    views_lost : int
        Views that vanished on their way through a graph.
    nodes : mapping or None
        What each node says of its part, if the run went through the node graph.
    failed : dict
        What could not be made beside the grid, and why.
    """

    parameters: PipelineParameters = field(default_factory=PipelineParameters)
    command: Sequence[str] = ()
    input: Mapping[str, Any] = field(default_factory=dict)
    stage: str = "image"
    image: CoherentImage | None = None
    track: Track | None = None
    spectrum_sign_override: int | None = None
    problems: Sequence[str] = ()
    truth: KnownTruth | None = None
    timings_s: dict[str, float] = field(default_factory=dict)
    views_in: int | None = None
    views_lost: int = 0
    nodes: Mapping[str, Any] | None = None
    failed: dict[str, str] = field(default_factory=dict)

    def read_truth(self, bag: str | Path) -> None:
        """Take the truth that lies beside a bag; one that cannot be read is named, and the run goes on."""
        try:
            self.truth = read_truth(bag)
        except TruthError as error:
            self.failed["truth"] = str(error)

    def describe(self, make: Callable[[], Mapping[str, Any]]) -> None:
        """Take a description of the input; it is made when the run is done, and is not to cost it."""
        try:
            self.input = make()
        except Exception as error:  # the bag may be gone by now, or no longer what it was
            self.failed["input"] = f"cannot be described: {type(error).__name__}: {error}"


@functools.cache  # a third of a second
def _distributions() -> Mapping[str, list[str]]:
    return importlib.metadata.packages_distributions()


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package and of every library that is loaded."""
    found = {"python": platform.python_version(), "csas_shadow_ros": __version__}
    distributions = _distributions()
    for module in {name.partition(".")[0] for name in sys.modules} - set(sys.stdlib_module_names):
        # Of a package that is one compiled file, only its own name is known.
        for name in distributions.get(module, [module]):
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                found.setdefault(name, importlib.metadata.version(name))
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


def _dimensions(d: Dimensions | None) -> dict[str, Any] | None:
    if d is None:
        return None
    return {**dataclasses.asdict(d), "heading_deg": math.degrees(d.heading_rad)}


def _grid(grid: VoxelGrid | None) -> dict[str, Any] | None:
    if grid is None:
        return None
    unknown = int(np.count_nonzero(~np.isfinite(grid.likelihood)))
    return {
        "method": grid.method,
        "threshold": grid.threshold,
        "voxel_size_m": grid.volume.voxel_size_m,
        "origin_m": grid.volume.origin_m,
        "shape_zyx": grid.volume.shape,
        "size_m": grid.volume.size_m,
        "occupied_voxels": int(np.count_nonzero(grid.occupied)),
        "unknown_voxels": unknown,
        "occupied_volume_m3": float(np.count_nonzero(grid.occupied)) * grid.volume.voxel_size_m**3,
    }


def _hollows(result: Result, scores: Mapping[str, float] | None) -> dict[str, Any] | None:
    """Say how much of the carved object its echoes show to be empty; None where none was looked at."""
    if result.grid is None or result.matter is None:
        return None
    voxels = int(np.count_nonzero(result.grid.occupied & ~result.matter))
    known = None
    if scores is not None and "iou_matter" in scores:
        known = {"occupied": scores["iou_truth"], "matter": scores["iou_matter"]}
    return {
        "voxels": voxels,
        "volume_m3": voxels * result.grid.volume.voxel_size_m**3,
        "iou_truth": known,
    }


def _objects(result: Result, truths: Sequence[KnownTruth | None]) -> list[dict[str, Any]]:
    """Return one entry an object, the target first."""
    # Where there is no target its truth stands there all the same.
    own = list(truths) if result.mesh is not None else list(truths[1:])
    own += [None] * (len(result.objects) - len(own))
    entries = []
    for number, one in enumerate(result.objects, start=1):
        # The first object is the target, unless its carving left none.
        of_target = number == 1 and result.mesh is not None
        entries.append(
            {
                "number": number,
                "position_m": one.dimensions.position_m,
                "dimensions": _dimensions(one.dimensions),
                "truth": None if (known := own[number - 1]) is None else _dimensions(known.dimensions),
                "place": result.place_of(one.dimensions),
                "target": one.target,
                "grid": _grid(one.grid),
                "views_used": one.views_used,
                "files": ["grid.npz", "mesh.stl"]
                if of_target
                else [f"object_{number}.npz", f"object_{number}.stl"],
            }
        )
    return entries


#: Thresholds that the sensitivity curve is made at, as multiples of the one that was used.
_SENSITIVITY = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)


def _sensitivity(grid: VoxelGrid | None, parameters: CarvingParameters) -> list[dict[str, float]]:
    """Say how the object changes with the threshold: the curve is flat where the threshold hardly matters."""
    if grid is None or not math.isfinite(grid.threshold):
        return []
    curve = []
    for factor in _SENSITIVITY:
        threshold = min(1.0, factor * grid.threshold)
        chosen = CarvingParameters.from_mapping(
            {**dataclasses.asdict(parameters), "method": grid.method, "threshold": threshold}
        )
        occupied = thresholded(grid.volume, grid.likelihood, grid.views, chosen).occupied
        layers = np.flatnonzero(occupied.any(axis=(1, 2)))
        d = grid.volume.voxel_size_m
        curve.append(
            {
                "threshold": threshold,
                "volume_m3": float(np.count_nonzero(occupied)) * d**3,
                "plan_m2": float(np.count_nonzero(occupied.any(axis=0))) * d**2,
                "top_m": float(grid.volume.z_m[layers[-1]] + d / 2) if len(layers) else 0.0,
            }
        )
    return curve


def _shadow_heights(result: Result) -> dict[str, Any] | None:
    """Return the height that each view's shadow length implies."""
    told = [one for _, one in sorted(result.evidence.items()) if math.isfinite(one.height_m)]
    if not told:
        return None
    return {
        "formula": "z = s_z (tip - top) / (s + tip), down-range from the origin; top: far side of the plan",
        "median_m": float(np.median([one.height_m for one in told])),
        "by_view": [
            {
                "aspect_deg": math.degrees(one.aspect_rad) % 360.0,
                "stamp_ns": one.stamp_ns,
                "height_m": one.height_m,
                "unexplained": one.unexplained,
                "lit": one.lit,
                "shift_m": one.shift_m,
            }
            for one in told
        ],
    }


def _levels(evidence: Mapping[int, ViewEvidence]) -> dict[str, Any]:
    """Summarise σ_r, σ_s and contrast, overall and by view."""
    views = [
        {
            "stamp_ns": stamp,
            "aspect_deg": math.degrees(one.aspect_rad) % 360.0,
            "sigma_r": one.seabed_level,
            "sigma_s": one.seabed_level / one.contrast,
            "contrast_db": 20.0 * math.log10(one.contrast),
            "estimated": one.levels_estimated,
        }
        for stamp, one in sorted(evidence.items())
        if math.isfinite(one.contrast)
    ]
    overall: dict[str, Any] = {"views": len(views), "estimated": sum(bool(v["estimated"]) for v in views)}
    for name in ("sigma_r", "sigma_s", "contrast_db"):
        numbers = np.array([v[name] for v in views], dtype=np.float64)
        quantiles = np.percentile(numbers, [0, 50, 100]) if len(numbers) else [math.nan] * 3
        overall[name] = dict(zip(("min", "median", "max"), map(float, quantiles), strict=True))
    return {"overall": overall, "by_view": views}


def _slope(grid: VoxelGrid | None) -> dict[str, Any] | None:
    """Say how the seabed slopes against the level of the track, and whether the grid was carved over that."""
    slope = grid.seabed if grid is not None else None
    if slope is None:
        return None
    gx, gy = slope.gradient
    return {
        "slope_deg": math.degrees(slope.slope_rad),
        "uphill_deg": math.degrees(math.atan2(gy, gx)) % 360.0,
        "sigma_deg": math.degrees(slope.sigma),
        "believed": slope.believed,
    }


def _sign(result: Result, context: Context) -> dict[str, Any]:
    override = context.spectrum_sign_override
    if result.sign is None:
        why = "there is no image to check it on" if context.image is None else "check_sign is off"
        stated = context.image.acoustics.spectrum_sign if context.image is not None else None
        return {"stated": stated, "verdict": "not checked", "why": why, "override": override}
    return {
        "stated": result.sign.stated,
        "verdict": result.sign.verdict,
        "why": str(result.sign),
        "stated_evidence": result.sign.stated_evidence,
        "other_evidence": result.sign.other_evidence,
        "override": override,
    }


def _quality(result: Result) -> dict[str, Any]:
    """Say how far the result can be trusted, and why no farther."""
    return {
        "verdict": result.quality.verdict,
        "reasons": list(result.quality.reasons),
        "explained": explained_share(result),
    }


def _views(result: Result, context: Context) -> dict[str, Any]:
    """Count the views: those that came, and what became of them."""
    used, rejected = result.views_used, len(result.rejected)
    composed = len(result.composites.stamps) if result.composites is not None else 0
    return {
        "in": max(used + rejected, composed) if context.views_in is None else context.views_in,
        "used": used,
        "rejected": rejected,
        "lost": context.views_lost,
        "reasons": _reasons(result.rejected.values()),
        "rejected_by_aspect_deg": {f"{a:g}": r for a, r in sorted(result.rejected.items())},
    }


def _how_it_was_made(context: Context, part: Callable[..., Any]) -> dict[str, Any]:
    """Say from what the result was made, and by which parameters and programs."""
    return {
        "stage": context.stage,
        "through": "one process" if context.nodes is None else "node graph",
        "nodes": context.nodes,
        "input": part("input", lambda: context.input, {}),
        "problems": list(context.problems),
        "parameters": dataclasses.asdict(context.parameters),
        "command": list(context.command),
        "versions": part("versions", versions, {"csas_shadow_ros": __version__}),
        "platform": platform.platform(),
    }


def build_report(
    result: Result,
    context: Context,
    *,
    other: Dimensions | None,
    truths: Sequence[KnownTruth | None],
    figures_left_out: Mapping[str, str],
    attempt: Callable[[str, Callable[[], Any], Any], Any],
) -> dict[str, Any]:
    """Make the report without scores and list of files; everything in it is JSON as it stands.

    Parameters
    ----------
    result, context : Result, Context
        What was found, and of what.
    other : Dimensions, optional
        Measures by the other method.
    truths : sequence of KnownTruth or None
        What the target is in truth, and each further object after it (`truth.of_objects`).
    figures_left_out : mapping
        Why figures are not there.
    attempt : callable
        Makes a part: its name, what makes it, and what stands there if that fails
        (`ResultsWriter.attempt`).
    """

    def part(name: str, make: Callable[[], Any], otherwise: Any = None) -> Any:
        return attempt(f"report: {name}", lambda: json_ready(make()), otherwise)

    no_levels = {"overall": {"views": 0, "estimated": 0}, "by_view": []}
    no_sign = {"stated": None, "verdict": "not checked", "why": "it cannot be told", "override": None}
    report = {
        "format": FORMAT,
        "object": result.mesh is not None,
        "verdict": result.verdict,
        "quality": _quality(result),
        "why_no_object": part("why_no_object", lambda: None if result.objects else no_object_reason(result)),
        "run": result.run_ns,
        "arc_deg": math.degrees(result.arc_rad),
        "frame": result.frame,
        "datum": result.datum,
        "objects": part("objects", lambda: _objects(result, truths), []),
        "objects_left_out": result.left_out,
        "detectable": result.detectable,
        "method": context.parameters.carving.method,
        "dimensions": part("dimensions", lambda: _dimensions(result.dimensions)),
        "threshold": result.grid.threshold if result.grid is not None else None,
        "sensitivity": part("sensitivity", lambda: _sensitivity(result.grid, context.parameters.carving), []),
        "shadow_heights": part("shadow_heights", lambda: _shadow_heights(result)),
        "target": result.target,
        "grid": part("grid", lambda: _grid(result.grid)),
        "seabed_slope": part("seabed_slope", lambda: _slope(result.grid)),
        "hollows": part("hollows", lambda: _hollows(result, None)),
        "other_method": part(
            "other_method",
            lambda: {"grid": _grid(result.other_grid), "dimensions": _dimensions(other)},
            {"grid": None, "dimensions": None},
        ),
        "truth": part("truth", lambda: _truth(context.truth, truths)),
        "views": _views(result, context),
        "levels": part("levels", lambda: _levels(result.evidence), no_levels),
        "spectrum_sign": part("spectrum_sign", lambda: _sign(result, context), no_sign),
        "timings_s": {**result.timings_s, **context.timings_s},
        **_how_it_was_made(context, part),
        "files": [],
        "figures_left_out": dict(figures_left_out),
        "failed": {},
    }
    ready: dict[str, Any] = json_ready(report)
    return ready


def _truth(truth: KnownTruth | None, truths: Sequence[KnownTruth | None]) -> dict[str, Any] | None:
    if truth is None:
        return None
    mine = truths[0] if truths else None
    notes = list(truth.notes)
    if mine is None:
        notes.append("it is of several bodies, and none of them alone is the object: nothing is compared")
    return {
        "mesh": str(truth.path),
        "object": truth.has_object,
        "dimensions": None if mine is None else _dimensions(mine.dimensions),
        "scores": None,
        "record": truth.record,
        "problem": truth.problem or None,
        "notes": notes,
    }


def complete_report(
    report: dict[str, Any],
    result: Result,
    context: Context,
    *,
    scores: Mapping[str, float] | None,
    figures_left_out: Mapping[str, str],
) -> None:
    """Put into a report what is made last.

    Parameters
    ----------
    report : dict
        By `build_report`.
    result, context : Result, Context
        What was found, and of what.
    scores : mapping, optional
        Against the truth (`truth.score`).
    figures_left_out : mapping
        Why figures are not there.
    """
    if scores is not None:
        report["truth"]["scores"] = json_ready(scores)
        report["hollows"] = json_ready(_hollows(result, scores))
    report["figures_left_out"] = dict(figures_left_out)
    report["timings_s"] = json_ready({**result.timings_s, **context.timings_s})
    report["versions"] = versions()  # figures load some more


def _reasons(reasons: Iterable[str]) -> dict[str, int]:
    """Count reasons that differ in nothing but numbers together, under the first of them."""
    first: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for reason in reasons:
        kind = " ".join("#" if any(c.isdigit() for c in word) else word for word in reason.split())
        counts[first.setdefault(kind, reason)] += 1
    return dict(counts.most_common())


def report_text(report: Mapping[str, Any]) -> str:
    """Write a report as JSON text."""
    return json.dumps(report, indent=2, allow_nan=False) + "\n"


def headline(report: Mapping[str, Any]) -> str:
    """Say in a few words what was found, and how far that can be trusted."""
    quality = report.get("quality") or {"verdict": "good"}  # reports of before this entry have none
    text = str(report["verdict"])
    if report.get("why_no_object") and report["verdict"] == "no object":
        text += f": {report['why_no_object']}"
    return f"{text} ({quality['verdict']})"


def _sides(d: Mapping[str, Any]) -> str:
    return f"{d['length_m']:.3f} x {d['width_m']:.3f} x {d['height_m']:.3f} m"


def spread_text(value: float, ends: Sequence[float], digits: int) -> str:
    """Say how far an interval reaches from a value: as far to either side, or down and up.

    Parameters
    ----------
    value : float
        The value.
    ends : sequence of float
        Low and high end, in its unit.
    digits : int
        After the point.

    Examples
    --------
    >>> spread_text(0.5, (0.4, 0.6), 2), spread_text(0.5, (0.45, 0.7), 2)
    ('± 0.10', '−0.05 +0.20')
    """
    down, up = (f"{abs(end - value):.{digits}f}" for end in ends)
    return f"± {up}" if down == up else f"−{down} +{up}"


def _size_lines(mine: Mapping[str, Any], true: Mapping[str, Any]) -> list[str]:
    """Write the table of sizes, found and true."""
    intervals = mine.get("intervals") or {}
    sure = f"{'95 %':>18}" if intervals else ""
    lines = [f"{'':<14}{'found':>12}{sure}" + (f"{'truth':>12}{'difference':>12}" if true else "")]
    rows = (
        ("length", "length_m", "m"),
        ("width", "width_m", "m"),
        ("height", "height_m", "m"),
        ("volume", "volume_m3", "m³"),
        ("heading", "heading_deg", "°"),
        ("position x", 0, "m"),
        ("position y", 1, "m"),
    )
    for label, key, unit in rows:
        values = [d["position_m"][key] if isinstance(key, int) else d[key] for d in (mine, true) if d]
        digits = 1 if unit == "°" else 4 if unit == "m³" else 3
        cells = [
            "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f} {unit}"  # no -0
            for value in values
        ]
        if not mine:
            cells.insert(0, "-")
        if intervals:
            name = {0: "position_x_m", 1: "position_y_m", "heading_deg": "heading_rad"}.get(key, key)
            scale = 180.0 / math.pi if name == "heading_rad" else 1.0
            ends = [end * scale for end in intervals.get(name, (math.nan, math.nan))]
            value = math.nan if values[0] is None else values[0]
            cells.insert(1, f"{spread_text(value, ends, digits)} {unit}")
        widths = (12, 18) if intervals else (12,)
        line = f"{label:<14}" + "".join(
            f"{cell:>{width}}" for cell, width in itertools.zip_longest(cells, widths, fillvalue=12)
        )
        if mine and true and None not in values:
            off = values[0] - values[1]
            if unit == "°":
                off = (off + 90.0) % 180.0 - 90.0
            line += f"{off:>+{12 - len(unit) - 1}.{digits}f} {unit}"
        lines.append(line)
    return lines


def _object_lines(report: Mapping[str, Any]) -> list[str]:
    """Write a line for each further object, and for each body that is none."""
    lines = []
    # Reports of before this entry have none.
    for entry in report.get("objects", []):
        if entry["files"][0] == "grid.npz":
            continue  # the target: told above
        d = entry["dimensions"]
        lines.append(
            f"object {entry['number']}: {_sides(d)}, {d['volume_m3']:.4f} m³,"
            f" heading {d['heading_deg']:.1f}°, at {place_text(d['position_m'])},"
            f" {entry['views_used']} views"
            + ("" if (t := entry.get("truth")) is None else f"; in truth {_sides(t)}")
        )
    for left in report.get("objects_left_out", []):
        lines.append(f"no object at {place_text(left['position_m'])}: {left['reason']}")
    return lines


def _title(report: Mapping[str, Any]) -> str:
    """Write the first line: what was found, and whether that is so."""
    line = f"csas-shadow {report['versions']['csas_shadow_ros']}: {headline(report)}"
    truth, found = report["truth"], bool(report["dimensions"])
    if not truth or found == truth["object"]:
        return f"{line} (as is true)" if truth and not found else line
    return f"{line} (in truth there is {'one' if truth['object'] else 'none'})"


def _place_lines(report: Mapping[str, Any]) -> list[str]:
    """Write where on earth each object lies."""
    lines = []
    # Reports of before this entry have none.
    for entry in report.get("objects", []):
        if entry.get("place"):
            place = Place(**{k: math.nan if v is None else v for k, v in entry["place"].items()})
            name = f"object {entry['number']}" if len(report["objects"]) > 1 else "place"
            lines.append(f"{name}: {place}, true bearing of its length {place.bearing_deg:.1f}°")
    return lines


def _score_lines(truth: Mapping[str, Any]) -> list[str]:
    """Write how well the grid agrees with the truth."""
    s = truth.get("scores")
    if not s:
        return []
    return [
        f"IoU against the truth {s['iou_truth']:.3f}, against its shadow hull {s['iou_hull']:.3f}"
        f" (the hull itself: {s['iou_hull_truth']:.3f})"
    ]


def _carving_lines(report: Mapping[str, Any]) -> list[str]:
    """Write what was carved, what of it is empty, and over what seabed."""
    lines = []
    hollows, slope, grid = report.get("hollows"), report.get("seabed_slope"), report["grid"]
    if hollows and hollows["voxels"]:
        line = f"hollows that no shadow shows, but echoes do: {hollows['volume_m3']:.4f} m³"
        if iou_truth := hollows["iou_truth"]:
            line += f"; without them, IoU against the truth {iou_truth['matter']:.3f}"
        lines.append(line)
    if slope and slope["believed"]:
        lines.append(
            f"the seabed slopes by {slope['slope_deg']:.1f}° ± {slope['sigma_deg']:.1f}° against the track's"
            f" level, up towards {slope['uphill_deg']:.0f}°: the sonar's heights were corrected"
        )
    if grid:
        threshold = "none" if grid["threshold"] is None else f"{grid['threshold']:.4f}"
        lines.append(f"{grid['method']} carving, voxels of {grid['voxel_size_m']:g} m, threshold {threshold}")
    return lines


def _view_lines(views: Mapping[str, Any]) -> list[str]:
    """Write how many views there were, and why some were not used."""
    # What a node beside the way to the grid refuses may be in the grid all the same.
    without = max(views["in"] - views["used"] - views["lost"], 0)
    unused = min(views["rejected"], without)
    rest = without - unused
    needless = f" {rest} not needed, as there was nothing to carve," if rest > 0 and not views["used"] else ""
    return [
        f"views: {views['in']} in, {views['used']} in the grid, {unused} not used,"
        f"{needless} {views['lost']} lost",
        *(
            f"  {n} refused{', the first' if n > 1 else ''}: {reason}"
            for reason, n in views["reasons"].items()
        ),
    ]


def _sign_lines(sign: Mapping[str, Any]) -> list[str]:
    """Write what the check of the spectrum's sign says, and whether the sign was overridden."""
    checked = "" if sign["verdict"] != "not checked" else "not checked, "
    lines = [f"spectrum sign: {checked}{sign['why']}"]
    if sign["override"] is not None:
        lines.append(f"spectrum sign was overridden to {sign['override']:+d} on the command line")
    return lines


def summary(report: Mapping[str, Any]) -> str:
    """Write the short table that is printed and kept as ``summary.txt``."""
    truth = report["truth"] or {}
    true = truth.get("dimensions") or {}
    mine = report["dimensions"] or {}
    quality = report.get("quality") or {"verdict": "good", "reasons": []}
    total = sum(v for v in report["timings_s"].values() if v is not None)
    lines = [
        _title(report),
        "",
        *([*_size_lines(mine, true), ""] if mine or true else []),
        *_place_lines(report),
        *_score_lines(truth),
        *(f"because {reason}" for reason in quality["reasons"]),
        *_carving_lines(report),
        *_object_lines(report),
        *_view_lines(report["views"]),
        *_sign_lines(report["spectrum_sign"]),
        *(f"problem with the input: {problem}" for problem in report["problems"]),
        *(f"truth: {note}" for note in truth.get("notes", ())),
        *(f"failed: {part}: {why}" for part, why in report.get("failed", {}).items()),
        f"time: {total:.1f} s",
    ]
    return "\n".join(lines) + "\n"
