"""The page of the population: what is asked and measured, distributions, and the worst ten."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from population_scenes import (
    COMPLICATION_SHARES,
    COMPLICATION_TEXT,
    COMPLICATIONS,
    FAMILIES,
    MOST_PIXELS,
    STEP_DEG,
)
from population_scores import LEAST_CONTRAST_DB, LEAST_SHADOW_CELLS, SIZE_TOLERANCE, SIZES, BodyScore, Row

# What is asked.
MEDIAN_IOU, TENTH_IOU = 0.92, 0.80
SIZE_SHARE = 0.95
COVERAGE = (0.92, 0.99)
HALF_WIDTH = 0.03
MOST_PHANTOMS = 1
MOST_MISSED, MOST_UNFLAGGED = 0.02, 0.02


@dataclass(frozen=True)
class Line:
    """One line of what is asked; `met` is None where the rows do not tell."""

    wanted: str
    measured: str
    met: bool | None


def _share(hits: Sequence[bool]) -> float:
    return sum(hits) / len(hits) if hits else math.nan


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100.0 * share:.0f} %"


def _of(share: Sequence[bool]) -> str:
    return f"{_percent(_share(share))} ({sum(share)} of {len(share)})"


def _quantile(values: Sequence[float], q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else math.nan


def bodies_of(rows: Iterable[Row], *, asked: bool = False) -> list[tuple[Row, BodyScore]]:
    """Return every body with its scene; `asked`: those alone that the bounds are asked of."""
    return [
        (r, b)
        for r in rows
        for b in r.bodies
        if not asked or (r.assessable and b.shadow_cells >= LEAST_SHADOW_CELLS)
    ]


def half_width_share(row: Row, body: BodyScore, name: str) -> float:
    """Return half of an interval over what it may be: 3 % of the truth or one voxel."""
    low, high = body.intervals[name]
    return 0.5 * (high - low) / max(HALF_WIDTH * body.true_size[name], row.voxel_m)


def _line(wanted: str, values: Sequence[Any], measured: str, met: bool) -> Line:
    return Line(wanted, measured if values else "not measured", met if values else None)


def acceptance(rows: Sequence[Row]) -> list[Line]:
    """Compare the rows with what is asked."""
    where = "where it is required*"
    asked = bodies_of(rows, asked=True)
    missed = [not b.found for _, b in asked]
    silent = [r.wrong() and not r.flagged for r in rows if r.bodies]
    return [
        *_asked_of_shapes(asked, where),
        *_asked_of_intervals(asked),
        _asked_of_empty_seabeds([r for r in rows if not r.bodies]),
        _line(
            f"objects missed, {where}: ≤ {_percent(MOST_MISSED)}",
            missed,
            _of(missed),
            _share(missed) <= MOST_MISSED,
        ),
        _line(
            "scenes with an extent off by more than its interval (and by more than 5 % and one voxel) without"
            f" a flag: ≤ {_percent(MOST_UNFLAGGED)}",
            silent,
            _of(silent),
            _share(silent) <= MOST_UNFLAGGED,
        ),
    ]


def _asked_of_shapes(asked: Sequence[tuple[Row, BodyScore]], where: str) -> list[Line]:
    ious = [b.iou_hull for _, b in asked]
    middle, tenth = _quantile(ious, 0.5), _quantile(ious, 0.1)
    within = [b.within(n, r.voxel_m) for r, b in asked for n in SIZES]
    return [
        _line(
            f"IoU with the shadow hull, {where}: median ≥ {MEDIAN_IOU:.2f}",
            ious,
            f"{middle:.3f} ({len(ious)} bodies)",
            middle >= MEDIAN_IOU,
        ),
        _line(f"the same, tenth percentile ≥ {TENTH_IOU:.2f}", ious, f"{tenth:.3f}", tenth >= TENTH_IOU),
        _line(
            f"length, width, height within 5 % or one voxel, {where}: ≥ {_percent(SIZE_SHARE)}",
            within,
            _of(within),
            _share(within) >= SIZE_SHARE,
        ),
    ]


def _asked_of_intervals(asked: Sequence[tuple[Row, BodyScore]]) -> list[Line]:
    held = [h for r, b in asked for n in SIZES if (h := b.holds(n)) is not None]
    low, high = COVERAGE
    measured = [(r, b, n) for r, b in asked for n in SIZES if n in b.intervals]
    widths = [half_width_share(r, b, n) for r, b, n in measured]
    relative = [0.5 * (b.intervals[n][1] - b.intervals[n][0]) / b.true_size[n] for _, b, n in measured]
    width = _quantile(widths, 0.5)
    return [
        _line(
            f"95 % intervals contain the truth: {100 * low:.0f} to {100 * high:.0f} %",
            held,
            _of(held),
            low <= _share(held) <= high,
        ),
        _line(
            f"their median half-width ≤ {_percent(HALF_WIDTH)} or one voxel",
            widths,
            f"{width:.2f} of that; {100 * _quantile(relative, 0.5):.1f} % of the extent",
            width <= 1.0,
        ),
    ]


def _asked_of_empty_seabeds(empty: Sequence[Row]) -> Line:
    phantoms = [r for r in empty if r.objects]
    return _line(
        f"seabeds without objects on which one is found: ≤ {MOST_PHANTOMS} of 200, flagged",
        empty,
        f"{len(phantoms)} of {len(empty)}, {sum(r.flagged for r in phantoms)} flagged",
        len(phantoms) <= MOST_PHANTOMS * len(empty) / 200.0 and all(r.flagged for r in phantoms),
    )


def _group_row(name: str, pairs: Sequence[tuple[Row, BodyScore]]) -> str:
    hull, truth = [b.iou_hull for _, b in pairs], [b.iou_truth for _, b in pairs]
    best = [b.hull_vs_truth for _, b in pairs]
    within = [b.within(n, r.voxel_m) for r, b in pairs for n in SIZES]
    held = [h for r, b in pairs for n in SIZES if (h := b.holds(n)) is not None]
    # A scene counts once, however many bodies of it are in the group.
    scenes = {r.index: r for r, _ in pairs}.values()
    silent = sum(r.wrong() and not r.flagged for r in scenes)
    cells = [
        name,
        str(len(pairs)),
        f"{_quantile(hull, 0.5):.2f} / {_quantile(hull, 0.1):.2f}",
        f"{_quantile(truth, 0.5):.2f} / {_quantile(truth, 0.1):.2f}",
        f"{_quantile(best, 0.5):.2f}",
        _percent(_share(within)),
        _percent(_share(held)),
        str(sum(not b.found for _, b in pairs)),
        str(silent),
        str(sum(r.flagged for r in scenes)),
    ]
    return f"| {' | '.join(cells)} |"


_GROUP_HEAD = [
    "| | bodies | IoU hull: median / tenth | IoU truth: median / tenth | hull vs truth"
    " | within 5 % or a voxel | interval holds | missed | wrong, no flag | flagged |",
    "|" + "---|" * 10,
]


def family_table(rows: Sequence[Row]) -> list[str]:
    """Write a line for each family, and one for all."""
    pairs = bodies_of(rows)
    lines = list(_GROUP_HEAD)
    for family in dict.fromkeys(b.family for _, b in sorted(pairs, key=lambda p: p[1].family)):
        lines.append(_group_row(family, [p for p in pairs if p[1].family == family]))
    lines.append(_group_row("**all**", pairs))
    lines.append(_group_row("where it is required*", bodies_of(rows, asked=True)))
    return lines


def quality_table(rows: Sequence[Row]) -> list[str]:
    """Write a line for each quality verdict, of the bodies that were found where it is required."""
    found = [(r, b) for r, b in bodies_of(rows, asked=True) if b.found]
    lines = [_GROUP_HEAD[0].replace("| |", "| quality |", 1), _GROUP_HEAD[1]]
    for quality in ("good", "limited", "not trustworthy"):
        own = [p for p in found if p[0].quality == quality]
        if own:
            lines.append(_group_row(quality, own))
    return lines


def complication_table(rows: Sequence[Row]) -> list[str]:
    """Write a line for each complication of scenes with objects."""
    lines = [_GROUP_HEAD[0].replace("| |", "| scenes with |", 1), _GROUP_HEAD[1]]
    plain = [p for p in bodies_of(rows) if not p[0].complications]
    if plain:
        lines.append(_group_row("nothing else", plain))
    for name in COMPLICATIONS:
        own = [p for p in bodies_of(rows) if name in p[0].complications]
        if own:
            lines.append(_group_row(name, own))
    return lines


def seabed_table(rows: Sequence[Row]) -> list[str]:
    """Write a line for each kind of seabed without objects."""
    empty = [r for r in rows if not r.bodies]
    lines = [
        "| seabed without objects, with | scenes | objects found on | of these flagged | refused |",
        "|" + "---|" * 5,
    ]
    for name in COMPLICATIONS:
        own = [r for r in empty if name in r.complications]
        if own:
            hit = [r for r in own if r.objects]
            refused = sum(bool(r.refused) for r in own)
            lines.append(f"| {name} | {len(own)} | {len(hit)} | {sum(r.flagged for r in hit)} | {refused} |")
    hit = [r for r in empty if r.objects]
    refused = sum(bool(r.refused) for r in empty)
    lines.append(f"| **all** | {len(empty)} | {len(hit)} | {sum(r.flagged for r in hit)} | {refused} |")
    return lines


def worst_of(rows: Iterable[Row], count: int = 10) -> list[Row]:
    """Return the scenes whose main body has the lowest IoU with its hull, the worst first."""
    with_body = [r for r in rows if r.bodies]
    return sorted(with_body, key=lambda r: (r.bodies[0].iou_hull, r.index))[:count]


def _metres(size: Mapping[str, float]) -> str:
    return " × ".join(f"{size[name]:.2f}" for name in SIZES) if size else "–"


def worst_table(rows: Sequence[Row]) -> list[str]:
    """Write a line for each of the worst scenes."""
    lines = [
        "| scene | family | with | contrast dB | grazing | shadow, cells | IoU hull | true L × W × H | found"
        " | says |",
        "|" + "---|" * 10,
    ]
    for r in worst_of(rows):
        b = r.bodies[0]
        says = r.refused or "; ".join((f"{r.verdict}, {r.quality}", *r.reasons))
        lines.append(
            f"| {r.index} | {b.family} | {', '.join(r.complications) or 'nothing'} | {r.contrast_db:.0f}"
            f" | {r.grazing_deg:.0f}° | {b.shadow_cells:.0f} | {b.iou_hull:.2f} | {_metres(b.true_size)}"
            f" | {_metres(b.size)} | {says} |"
        )
    return lines


def tables(rows: Sequence[Row]) -> list[str]:
    """Write what is asked and what was measured."""
    verdict = {True: "met", False: "**not met**", None: "–"}
    lines = ["| required | measured | |", "|---|---|---|"]
    return lines + [f"| {a.wanted} | {a.measured} | {verdict[a.met]} |" for a in acceptance(rows)]


def page(rows: Sequence[Row], half: str, figures: Mapping[str, str]) -> str:
    """Write the rows as a markdown page.

    Parameters
    ----------
    rows : sequence of Row
        All scenes.
    half : str
        Which half they are of.
    figures : mapping of str to str
        Path of each figure, as seen from the page, and what it shows.
    """
    codes = sorted({r.code for r in rows if r.code})
    kinds = "; ".join(f"{name} ({f.text})" for name, f in FAMILIES[half].items())
    shares = ", ".join(f"{n}: {_percent(s)}" for n, s in enumerate(COMPLICATION_SHARES))
    lines = [
        "# Accuracy on random scenes",
        "",
        "Results of the chain, fully automatic and with default parameters, on scenes drawn at random."
        " Written by:",
        "",
        f"    python benchmarks/population.py --half {half} --scenes {len(rows)} --out FOLDER",
        f"    python benchmarks/population.py --half {half} --out FOLDER --page docs/population.md",
        "",
        f"{sum(bool(r.bodies) for r in rows)} scenes with objects, {sum(not r.bodies for r in rows)} without,"
        f" of the {half} half (code {', '.join(codes) or 'unknown'}).",
        "The halves share no shape family. Parts outside the automatic volume, and bodies that were not",
        "found, count as missed. *Hull*: the shape that perfect silhouettes of the body alone would leave,",
        "the best that carving can give. True sizes are of the part above the seabed, by the rule of the",
        "report: the smallest rectangle round the plan, and the highest point.",
        "",
        "## Requirements and measurements",
        "",
        *tables(rows),
        "",
        f"\\* Contrast of {LEAST_CONTRAST_DB:g} dB or more, and a shadow in the image of at least"
        f" {LEAST_SHADOW_CELLS:g} cells. A body missed there has IoU 0, and no extent within 5 %.",
        "",
    ]
    lines += [f"![{text}]({path})\n" for path, text in figures.items() if "scene" not in Path(path).stem]
    lines += ["## By verdict", "", "Bodies that were found, where it is required*.", ""]
    lines += [*quality_table(rows), ""]
    lines += ["## By family", "", *family_table(rows), ""]
    lines += ["## By what else there is", "", *complication_table(rows), "", *seabed_table(rows), ""]
    lines += ["## The worst ten", "", "By IoU of the main body with its hull.", "", *worst_table(rows), ""]
    lines += [f"![{text}]({path})\n" for path, text in figures.items() if "scene" in Path(path).stem]
    lines += [
        "## How scenes are drawn",
        "",
        f"- families of this half, in turn: {kinds}",
        "- largest extent log-uniform within 0.1 to 4 m, by family; heading and place uniform, the place up"
        " to one length off the centre",
        "- radius log-uniform, 20 to 150 m (more where the body is large for it); grazing angle uniform,"
        " 6° to 35°",
        "- contrast uniform, 4 to 18 dB; echo: none in a fifth of the scenes, else uniform, 0 to 20 dB",
        "- band: bandwidth 25 to 45 % of its middle; 10 to 40 cross-range cells along the body and two"
        f" or more across it, as far as an image of {MOST_PIXELS} pixels holds body and shadow; voxel 0.65"
        " of a cell, 2 cm where that is near",
        f"- oversampling 1.5, 2 or 3; views every {STEP_DEG:g}°",
        f"- so many of the following at once: {shares}",
        *(f"- {name}: {text}" for name, text in COMPLICATION_TEXT.items()),
        "",
    ]
    return "\n".join(lines)


# ---- the figures

_STYLE: Any = {"font.size": 10.0, "axes.titlesize": 11.0, "figure.facecolor": "white"}
_FOUND, _HULL, _TRUTH = "#e08214", "#4d9de0", "#1b3a5c"


def _figure(columns: int, rows: int, width: float, height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for a in axes.flat:
        for side in ("top", "right"):
            a.spines[side].set_visible(False)
    return figure, axes


def draw_distributions(rows: Sequence[Row], path: Path) -> None:
    """Draw how IoU, errors of extents and half-widths of intervals are distributed."""
    pairs, asked = bodies_of(rows), bodies_of(rows, asked=True)
    with mpl.rc_context(_STYLE):
        figure, axes = _figure(3, 1, 13.0, 4.0)
        for values, colour, text in (
            ([b.iou_hull for _, b in pairs], _FOUND, "with the hull, all"),
            (
                [b.iou_hull for _, b in asked],
                _HULL,
                f"with the hull, ≥ {LEAST_CONTRAST_DB:g} dB, in the image",
            ),
            ([b.iou_truth for _, b in pairs], _TRUTH, "with the truth, all"),
        ):
            if values:
                axes[0, 0].step(
                    np.sort(values), np.arange(1, len(values) + 1) / len(values), color=colour, label=text
                )
        axes[0, 0].set(xlabel="IoU", ylabel="share of the bodies below", xlim=(0, 1), ylim=(0, 1))
        axes[0, 0].legend(frameon=False, fontsize=8)
        bins = np.linspace(-0.4, 0.4, 33)
        for name, colour in zip(SIZES, (_TRUTH, _FOUND, _HULL), strict=True):
            errors = [b.size[name] / b.true_size[name] - 1.0 for _, b in pairs if b.found]
            axes[0, 1].hist(np.clip(errors, -0.4, 0.4), bins, histtype="step", color=colour, label=name[:-2])
        axes[0, 1].axvspan(-SIZE_TOLERANCE, SIZE_TOLERANCE, color="0.92")
        axes[0, 1].set(xlabel="error of an extent (share of the truth)", ylabel="bodies")
        axes[0, 1].legend(frameon=False, fontsize=8)
        off = [
            (b.size[n] - b.true_size[n]) / max(0.5 * (b.intervals[n][1] - b.intervals[n][0]), 1e-9)
            for _, b in pairs
            for n in SIZES
            if n in b.intervals
        ]
        axes[0, 2].hist(np.clip(off, -4, 4), np.linspace(-4, 4, 41), color=_HULL)
        axes[0, 2].axvspan(-1, 1, color="0.92", zorder=0)
        axes[0, 2].set(xlabel="error over half of the 95 % interval", ylabel="extents")
        figure.savefig(path)


def draw_dependence(rows: Sequence[Row], path: Path) -> None:
    """Draw the IoU of each body against what its scene is like, and by family."""
    pairs = bodies_of(rows)
    with mpl.rc_context(_STYLE):
        figure, axes = _figure(3, 2, 13.0, 7.5)
        along: list[tuple[str, Callable[[Row, BodyScore], float], bool]] = [
            ("contrast (dB)", lambda r, _: r.contrast_db, False),
            ("grazing angle (°)", lambda r, _: r.grazing_deg, False),
            ("length (cells)", lambda r, b: b.true_size["length_m"] / r.cell_m, True),
            ("shadow (cells)", lambda _, b: b.shadow_cells, True),
            ("echo (dB; none: -5)", lambda r, _: max(r.echo_db, -5.0), False),
        ]
        for a, (text, value, log) in zip(axes.flat, along, strict=False):
            for flagged, colour, label in ((False, _TRUTH, "good"), (True, _FOUND, "flagged")):
                own = [(value(r, b), b.iou_hull) for r, b in pairs if r.flagged == flagged]
                a.plot(*(np.array(own).T if own else ([], [])), ".", color=colour, label=label)
            a.set(xlabel=text, ylabel="IoU with the hull", ylim=(-0.02, 1), xscale="log" if log else "linear")
            if log:
                a.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                a.xaxis.set_major_formatter("{x:g}")
                a.xaxis.set_minor_formatter(NullFormatter())
        axes[0, 0].legend(frameon=False, fontsize=8)
        families = sorted({b.family for _, b in pairs})
        last = axes.flat[5]
        for y, family in enumerate(families):
            values = [b.iou_hull for _, b in pairs if b.family == family]
            last.plot(values, [y] * len(values), "|", color=_TRUTH, markersize=9)
            last.plot(np.median(values), y, "o", color=_FOUND, markersize=4)
        last.set(
            xlabel="IoU with the hull", xlim=(-0.02, 1), yticks=range(len(families)), yticklabels=families
        )
        figure.savefig(path)


def draw_scene(row: Row, shapes: Path, path: Path) -> None:
    """Draw plan and side views: what was found, hull and truth."""
    kept = np.load(shapes)
    d, origin = float(kept["voxel"]), kept["origin"]
    with mpl.rc_context(_STYLE):
        figure, axes = _figure(3, 1, 13.0, 4.2)
        body = row.bodies[0]
        figure.suptitle(
            f"{row.name}: {body.family}, {', '.join(row.complications) or 'nothing else'};"
            f" {row.contrast_db:.0f} dB, echo {row.echo_db:.0f} dB, {row.grazing_deg:.0f}°,"
            f" {body.shadow_cells:.0f} cells of shadow; IoU {body.iou_hull:.2f} (truth {body.iou_truth:.2f});"
            f" {row.verdict}, {row.quality}",
            fontsize=9,
        )
        for a, view, names, (i, j) in zip(
            axes.flat, "zyx", (("x", "y"), ("x", "z"), ("y", "z")), ((0, 1), (0, 2), (1, 2)), strict=True
        ):
            shown = {name: kept[f"{name}_{view}"] for name in ("found", "hull", "truth")}
            rows, cols = shown["truth"].shape
            left, bottom = origin[i] - d / 2, origin[j] - d / 2
            extent = (left, left + cols * d, bottom, bottom + rows * d)
            picture = np.ones((rows, cols, 3))
            picture[shown["found"]] = (0.98, 0.85, 0.65)
            a.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
            x, y = left + (np.arange(cols) + 0.5) * d, bottom + (np.arange(rows) + 0.5) * d
            for name, colour, style in (("hull", _HULL, "--"), ("truth", _TRUTH, "-")):
                if shown[name].any() and min(rows, cols) > 1:
                    a.contour(
                        x,
                        y,
                        shown[name].astype(float),
                        [0.5],
                        colors=colour,
                        linestyles=style,
                        linewidths=1.2,
                    )
            a.set(xlabel=f"{names[0]} (m)", ylabel=f"{names[1]} (m)", aspect="equal")
        for colour, style, text in ((_TRUTH, "-", "truth"), (_HULL, "--", "hull")):
            axes[0, 0].plot([], [], style, color=colour, label=text)
        axes[0, 0].fill([], [], color=(0.98, 0.85, 0.65), label="found")
        axes[0, 0].legend(frameon=False, fontsize=8)
        figure.savefig(path)


def publish(rows: Sequence[Row], half: str, out: Path, target: Path) -> None:
    """Write a page and its figures.

    Parameters
    ----------
    rows, half
        As of `page`.
    out : Path
        Folder with shapes/, which the scenes left.
    target : Path
        The page.
    """
    folder = target.parent / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("population_*.png"):
        old.unlink()
    figures = {}
    if bodies_of(rows):
        draw_distributions(rows, folder / "population_distributions.png")
        draw_dependence(rows, folder / "population_dependence.png")
        figures = {
            "figures/population_distributions.png": "IoU, errors of extents, and errors over intervals",
            "figures/population_dependence.png": "IoU with the hull by contrast, grazing, size, echo, family",
        }
    for place, row in enumerate(worst_of(rows), start=1):
        shapes = out / "shapes" / f"{half}_{row.index}.npz"
        if shapes.exists():
            name = f"population_scene_{place:02d}.png"
            draw_scene(row, shapes, folder / name)
            figures[f"figures/{name}"] = f"Scene {row.index}, {row.bodies[0].family}: plan and sides"
    target.write_text(page(rows, half, figures), encoding="utf-8")
