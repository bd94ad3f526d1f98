"""The contact report: one page that says what lies there, how large it is and how sure that is."""

from __future__ import annotations

import base64
import datetime
import html
import io
import math
import string
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from .. import __version__
from ..core.imaging.mask_codes import MASK_SHADOW
from ..core.shape.mesh import mesh_from_grid
from ..results.report import spread_text
from .contacts import axis_bearing_deg, north_shown_deg
from .crop import HIGH_SHOWN_DB as _HIGH
from .crop import LOW_SHOWN_DB as _LOW
from .crop import Window, cast, colours_of, contact_named, grey_of, outlines, shadow_m, to_north
from .server import STATIC
from .store import Entry, ViewStore

#: A4, inches.
_PAGE = (8.27, 11.69)
#: Its margins, shares of its width.
_LEFT, _RIGHT = 0.07, 0.93
_STYLE: Any = {"font.size": 8.5, "pdf.fonttype": 42, "axes.linewidth": 0.6}
#: Triangles are painted in pixels, not as lines: a report is to be sent by a narrow link.
_DPI = 170
_PICTURE_PX = 560
_COLOURS = {"mine-like": "#b3261e", "not mine-like": "#1d7a3c", "undecided": "#9a5b00", "": "#555555"}
_QUALITY = {"good": "#1d7a3c", "limited": "#9a5b00", "not trustworthy": "#b3261e"}
#: Behind what is written over a picture.
_BOX = {"facecolor": "black", "alpha": 0.65, "pad": 1.5, "edgecolor": "none"}
#: Side of the picture in colour, in sizes of the contact: it and what stands beside it.
_ROUND = 3.0
#: So many views are tried for a further contact, at so many places of its shadow.
_TRIED, _SAMPLES = 36, 40
#: Lines of text that the page has room for; more are counted.
_REMARK_LINES, _DAMAGE_LINES = 7, 4
_ROWS = (
    ("Length", "length_m", "m", 2),
    ("Width", "width_m", "m", 2),
    ("Height", "height_m", "m", 2),
    ("Volume", "volume_m3", "m³", 3),
)
_LEGEND = (
    f"Amber: segmented shadow. Blue: shadow that the shape casts. Grey: {_LOW:g} to +{_HIGH:g} dB over the"
    " view's median. Hue: from which side it is bright. White: nothing was imaged there."
)
Draw = Callable[[Any], None]


@dataclass
class Sheet:
    """What stands in a report, whatever it is written as."""

    title: str
    about: str
    judgement: str
    judged: str
    remark: str
    verdict: str
    quality: str
    reasons: list[str]
    head: list[str]
    rows: list[list[str]]
    facts: list[str]
    damage: list[str]
    versions: str
    pictures: list[tuple[str, Draw]] = field(default_factory=list)
    shapes: list[tuple[str, Draw]] = field(default_factory=list)


# -- what it says -----------------------------------------------------------------------------------


def _value(d: Mapping[str, Any], key: str, unit: str, digits: int, *, interval: bool = True) -> str:
    value = d.get(key)
    if value is None:
        return "—"
    ends = (d.get("intervals") or {}).get(key) if interval else None
    spread = "" if not ends or None in ends else f" {spread_text(value, ends, digits)}"
    return f"{value:.{digits}f}{spread} {unit}"


def _axis(d: Mapping[str, Any], north: float) -> str:
    if d.get("heading_rad") is None:
        return "—"
    low, high = (d.get("intervals") or {}).get("heading_rad") or (None, None)
    spread = "" if low is None or high is None else f" ± {math.degrees((high - low) / 2.0):.1f}"
    return f"{axis_bearing_deg(d['heading_rad'], north):05.1f}{spread} °"


def _position(contact: Mapping[str, Any]) -> str:
    x, y = contact["position_m"]
    scene = f"x {x + 0.0:.2f} m, y {y + 0.0:.2f} m in the scene"
    if (place := contact.get("geographic")) is None:
        return scene
    latitude, longitude = place
    sides = "S" if latitude < 0 else "N", "W" if longitude < 0 else "E"
    return f"{abs(latitude):.6f}° {sides[0]}, {abs(longitude):.6f}° {sides[1]} (WGS-84); {scene}"


def _when(run: str | None) -> str:
    try:
        at = datetime.datetime.fromtimestamp(int(run or "x") / 1e9, datetime.timezone.utc)
    except (ValueError, OverflowError, OSError):
        return "time unknown"
    return at.strftime("%Y-%m-%d %H:%M:%S UTC")


def _damage(report: Mapping[str, Any], damage: str) -> list[str]:
    views = report.get("views") or {}
    lines = [damage] if damage else []
    lines += [f"{views[k]} views {k}" for k in ("lost", "rejected") if views.get(k)]
    lines += [f"{n} rejected: {reason}" for reason, n in (views.get("reasons") or {}).items()]
    return lines + [str(p) for p in report.get("problems") or []]


def _facts(scene: Mapping[str, Any], contact: Mapping[str, Any]) -> list[str]:
    report = scene["report"] or {}
    views, lines = report.get("views") or {}, [f"Position: {_position(contact)}."]
    if contact.get("reason"):
        lines.append(f"Left out: {contact['reason']}.")
    used = contact.get("views_used") or views.get("used")
    if used:
        lines.append(f"Views: {used} used" + (f" of {views['in']}." if views.get("in") else "."))
    heights = sorted(h[1] for h in report.get("heights") or [])
    if heights and contact.get("volume") == "main":
        low, high = np.percentile(heights, [5, 95])
        lines.append(
            f"Heights by view: median {report['height_median_m']:.2f} m,"
            f" nine of ten {low:.2f} to {high:.2f} m."
        )
    hollows = report.get("hollows")
    if hollows and hollows["voxels"] and contact.get("volume") == "main":
        lines.append(f"Hollows by their echoes: {hollows['volume_m3']:.3f} m³.")
    others = [c for c in scene["contacts"] if c["id"] != contact["id"]]
    objects = sum(c["kind"] == "object" for c in others)
    if others:
        strong = sum(bool(c.get("strong")) for c in others)
        text = f"Also in this run: {objects or 'no'} further contact{'s' if objects != 1 else ''}"
        left = len(others) - objects
        lines.append(f"{text}, {left} left out{f', {strong} of them may be an object' if strong else ''}.")
    return lines


def sheet_of(store: ViewStore, contact: str = "") -> Sheet:
    """Collect what a report says.

    Parameters
    ----------
    store : ViewStore
        A run that has been read.
    contact : str
        Which contact; the first by default.

    Raises
    ------
    ViewerError
        If there is no such contact.
    """
    one, scene = contact_named(store, contact), store.scene()
    report = scene["report"] or {}
    item = scene["desk"]["items"].get(one["id"])
    judgement = item["value"] if item else {"verdict": "", "remark": "", "operator": ""}
    judged = "not judged yet"
    if item:
        by = f" by {judgement['operator']}" if judgement["operator"] else ""
        judged = f"judged{by}, {item['time'].replace('T', ' ').replace('Z', ' UTC')}"
        for other in item["earlier"]:
            who = other["value"]["operator"] or "somebody"
            judged += f"; {who}: {other['value']['verdict']}"
    target = one.get("volume") == "main"
    dimensions = (scene["dimensions"] if target else None) or one.get("dimensions") or {}
    truth = scene["truth"] if target else one.get("truth")
    rows = []
    for label, key, unit, digits in _ROWS:
        if dimensions.get(key) is not None:
            row = [label, _value(dimensions, key, unit, digits)]
            rows.append(row + ([_value(truth, key, unit, digits, interval=False)] if truth else []))
    if dimensions.get("heading_rad") is not None:
        north = north_shown_deg(scene)
        rows.append(["Axis bears", _axis(dimensions, north)])
        if truth:
            rows[-1].append(_axis({**truth, "intervals": None}, north))
    quality = report.get("quality") or {"verdict": "", "reasons": []}
    reasons = [str(r) for r in quality["reasons"]]
    if report.get("why_no_object"):
        reasons.insert(0, str(report["why_no_object"]))
    sheet = Sheet(
        title=f"{store.title}: {one['name'].lower()}",
        about=f"Run of {_when(report.get('run'))}",
        judgement=judgement["verdict"],
        judged=judged,
        remark=judgement["remark"],
        verdict=str(report.get("verdict") or "no verdict"),
        quality=str(quality["verdict"]),
        reasons=reasons,
        head=["", "found, 95 %"] + (["truth"] if truth else []),
        rows=rows,
        facts=_facts(scene, one),
        damage=_damage(report, scene["damage"]),
        versions=f"made by csas-shadow {__version__}"
        + (f", of a result of csas-shadow {report['version']}" if report.get("version") else ""),
    )
    _add_pictures(sheet, store, one, scene)
    return sheet


# -- its pictures -----------------------------------------------------------------------------------


def best_view(store: ViewStore, report: Mapping[str, Any]) -> tuple[str, Entry] | None:
    """Return the view whose shadow tells most: explained by what was found, and of the median height."""
    name = next((n for n in ("shadow", "sub_aperture") if store.sets[n]), None)
    if name is None:
        return None
    views = list(store.sets[name].values())
    median, told = report.get("height_median_m"), report.get("heights") or []
    rejected = [aspect for aspect, _ in report.get("rejected") or []]

    def off(one: Entry, aspect_deg: float) -> float:
        return abs((math.degrees(one.info.aspect_rad) - aspect_deg + 180.0) % 360.0 - 180.0)

    scored = sorted(
        (
            ((unexplained or 0.0) + (lit or 0.0) + abs(height - median) / median, aspect)
            for aspect, height, unexplained, lit in told
            if median
        ),
    )
    for _, aspect in scored:
        near = min(views, key=lambda one: off(one, aspect))
        if off(near, aspect) < 1.0 and all(off(near, r) > 0.05 for r in rejected):
            return name, near
    return name, views[0]


def view_of_shadow(store: ViewStore, contact: Mapping[str, Any]) -> tuple[str, Entry] | None:
    """Return the view in which most of a contact's shadow was segmented; None where nobody knows."""
    name = next((n for n in ("shadow", "sub_aperture") if store.sets[n]), None)
    masks = sorted(store.sets["shadow_mask"].values(), key=lambda one: one.info.aspect_rad)
    masks = [m for m in masks if name is not None and m.info.stamp_ns in store.sets[name]]
    if name is None or not masks:
        return None
    size = float(contact["size_m"])

    def share(one: Entry) -> float:
        away = -np.array([math.cos(one.info.aspect_rad), math.sin(one.info.aspect_rad)])
        reach = np.linspace(size / 2, shadow_m(one.info, contact), _SAMPLES)
        points = np.asarray(contact["position_m"]) + reach[:, None] * away
        onto, mask = one.info.camera.ground_to_pixel, one.load()
        u, v = np.rint(onto[:2, :2] @ points.T + onto[:2, 2:]).astype(int)
        inside = (u >= 0) & (v >= 0) & (v < mask.shape[0]) & (u < mask.shape[1])
        return float(np.mean(inside & (mask[v * inside, u * inside] == MASK_SHADOW)))

    best = max(masks[:: math.ceil(len(masks) / _TRIED)], key=share)
    return name, store.sets[name][best.info.stamp_ns]


def _surface(store: ViewStore, contact: Mapping[str, Any]) -> trimesh.Trimesh | None:
    grid = store.grids.get(str(contact.get("volume", "")))
    return mesh_from_grid(grid) if grid is not None and grid.occupied.any() else None


def _add_pictures(
    sheet: Sheet, store: ViewStore, contact: Mapping[str, Any], scene: Mapping[str, Any]
) -> None:
    # How well each view is explained is known of the target alone.
    found = None if contact.get("volume") == "main" else view_of_shadow(store, contact)
    mesh, found = _surface(store, contact), found or best_view(store, scene["report"] or {})
    if found is not None:
        _, entry = found
        aspect = math.degrees(entry.info.aspect_rad) % 360.0
        bearing = (90.0 + north_shown_deg(scene) - aspect) % 360.0
        sheet.pictures.append(
            (
                f"Best shadow, sonar up; the sonar bears {bearing:03.0f}°",
                lambda axes: _draw_shadow(axes, store, entry, contact, mesh),
            )
        )
    if "color_by_aspect" in store.pictures:
        sheet.pictures.append(
            (
                "Colour by aspect, north up",
                lambda axes: _draw_colours(axes, store, contact, north_shown_deg(scene)),
            )
        )
    if mesh is not None:
        heading = float((contact.get("dimensions") or {}).get("heading_rad") or 0.0)
        for title, axis in (("From above", 2), ("Along its side", 1), ("From its end", 0)):
            sheet.shapes.append((title, partial(draw_side, mesh=mesh, heading_rad=heading, axis=axis)))


def _picture(axes: Any, window: Window, pixels: NDArray[Any], **more: Any) -> None:
    axes.imshow(pixels, interpolation="bilinear", **more)
    axes.set_xlim(-0.5, window.pixels - 0.5)
    axes.set_ylim(window.pixels - 0.5, -0.5)
    axes.set_xticks([])
    axes.set_yticks([])
    # The roundest length of a quarter of the picture.
    goal = window.side_m / 4
    ten = 10.0 ** math.floor(math.log10(goal))
    length = next(m * ten for m in (5.0, 2.0, 1.0) if m * ten <= goal)
    bar, at = length / window.side_m * window.pixels, 0.95 * window.pixels
    x = 0.05 * window.pixels
    for width, colour in ((4.5, "black"), (2.5, "white")):
        axes.plot([x, x + bar], [at, at], color=colour, lw=width, solid_capstyle="butt")
    axes.text(x, at - 0.025 * window.pixels, f"{length:g} m", color="white", va="bottom", bbox=_BOX)


def _draw_shadow(
    axes: Any,
    store: ViewStore,
    entry: Entry,
    contact: Mapping[str, Any],
    mesh: trimesh.Trimesh | None,
) -> None:
    aspect, shadow = entry.info.aspect_rad, shadow_m(entry.info, contact)
    up = (math.cos(aspect), math.sin(aspect))
    side = 1.25 * (contact["size_m"] + shadow)
    x, y = contact["position_m"]
    window = Window((x - up[0] * shadow / 2, y - up[1] * shadow / 2), side, up, _PICTURE_PX)
    pixels = grey_of(window, entry, "amplitude", unknown=255)
    _picture(axes, window, pixels, cmap="gray", vmin=0, vmax=255)
    for line in outlines(store, entry.info.stamp_ns, window):
        axes.plot(*np.vstack([line, line[:1]]).T, color="#ffb347", lw=1.0)
    if mesh is not None:
        for line in cast(mesh, entry.info, window):
            axes.plot(*np.vstack([line, line[:1]]).T, color="#4fd1e8", lw=1.0)
    axes.annotate(
        "to the sonar",
        (0.5, 0.995),
        (0.5, 0.915),
        xycoords="axes fraction",
        ha="center",
        va="top",
        color="#5fe687",
        bbox=_BOX,
        arrowprops={"arrowstyle": "-|>", "color": "#5fe687", "lw": 1.8, "shrinkA": 0},
    )


def _draw_colours(axes: Any, store: ViewStore, contact: Mapping[str, Any], north: float) -> None:
    window = Window(contact["position_m"], _ROUND * contact["size_m"], to_north(north), _PICTURE_PX)
    _picture(axes, window, colours_of(window, store, unknown=255))
    wheel = axes.inset_axes((0.8, 0.8, 0.19, 0.19))
    y, x = np.mgrid[1:-1:120j, -1:1:120j]
    hue = (np.arctan2(y, x) / math.tau + north / 360.0) % 1.0
    ring = np.hypot(x, y)
    rgb = mpl.colors.hsv_to_rgb(np.dstack([hue, np.ones_like(hue), np.ones_like(hue)]))
    alpha = ((ring < 1) & (ring > 0.5)).astype(float)
    wheel.imshow(np.dstack([rgb, alpha]), extent=(-1, 1, -1, 1))
    wheel.axis("off")


def draw_side(axes: Any, mesh: trimesh.Trimesh, heading_rad: float, axis: int) -> None:
    """Draw a surface seen along one of its own axes: 2 from above, 1 along its width, 0 along its length."""
    turned = mesh.copy()
    turned.apply_transform(trimesh.transformations.rotation_matrix(-heading_rad, (0, 0, 1)))
    middle = turned.bounds.mean(axis=0)
    points = np.asarray(turned.vertices) - [middle[0], middle[1], 0.0]
    across = {2: (0, 1), 1: (0, 2), 0: (1, 2)}[axis]
    toward = {2: 1.0, 1: -1.0, 0: 1.0}[axis]  # the eye's side of that axis
    normals = np.asarray(turned.face_normals)
    facing = normals[:, axis] * toward > 0
    triangles = points[turned.faces[facing]]
    order = np.argsort(triangles[:, :, axis].mean(axis=1) * toward)
    light = np.array([0.3, -0.5, 0.8]) / math.sqrt(0.98)
    shade = 0.45 + 0.5 * np.clip(normals[facing] @ light, 0, 1)
    colours = shade[order, None] * np.array([[0.62, 0.71, 0.77]]) / 0.85
    drawn = PolyCollection(
        list(triangles[order][:, :, across]),
        facecolors=np.clip(colours, 0, 1).tolist(),
        edgecolors="face",
        linewidths=0.15,
        rasterized=True,
    )
    axes.add_collection(drawn)
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.56 * float(np.max(high[:2] - low[:2]))
    axes.set_xlim(-half, half)
    if axis == 2:
        axes.set_ylim(-half, half)
    else:
        axes.axhline(0.0, color="#8a6d3b", lw=1.0)  # the seabed
        axes.set_ylim(-0.08 * half, max(1.15 * float(high[2]), 1.2 * half))
    axes.set_aspect("equal")
    axes.grid(lw=0.3, color="#bbbbbb")
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=7, length=2)
    for side in (axes.xaxis, axes.yaxis):
        side.set_major_locator(MaxNLocator(5))
    axes.set_xlabel("m", fontsize=7, labelpad=1)


# -- how it is written ------------------------------------------------------------------------------


def _wrapped(lines: list[str], width: int, most: int) -> str:
    out = [part for line in lines for part in (textwrap.wrap(line, width) or [""])]
    if len(out) > most:
        out = [*out[: most - 1], f"… and {len(out) - most + 1} more lines in the results"]
    return "\n".join(out)


def as_pdf(sheet: Sheet) -> bytes:
    """Write a report as a PDF of one page."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_PAGE)
        FigureCanvasPdf(figure)
        _lay_out(figure, sheet)
        out = io.BytesIO()
        figure.savefig(out, format="pdf", dpi=_DPI, metadata={"Title": sheet.title, "Creator": "csas-shadow"})
    return out.getvalue()


def _lay_out(figure: Figure, sheet: Sheet) -> None:
    """Put everything in its place, from the top of the page to its foot."""
    _write_head(figure, sheet)
    _draw_views(figure, sheet)
    _draw_shapes(figure, sheet)
    _dimension_table(figure, sheet, _LEFT)
    _write(figure, 0.5, 0.335, _wrapped(sheet.facts, 62, 11), linespacing=1.35)
    _write_judgement(figure, sheet)
    damage = sheet.damage or ["None is known: no view was lost or rejected."]
    _write(figure, _LEFT, 0.094, "Damage", fontweight="bold")
    _write(figure, _LEFT, 0.081, _wrapped(damage, 125, _DAMAGE_LINES))
    _write(figure, _LEFT, 0.025, sheet.versions, fontsize=7, color="#444444")


def _write(figure: Figure, x: float, y: float, text: str, **more: Any) -> None:
    """Write text below a point of the page (shares of its width and height)."""
    figure.text(x, y, text, va="top", **more)


def _write_head(figure: Figure, sheet: Sheet) -> None:
    """Write what this is, how it was judged, and how far it can be trusted."""
    _write(figure, _LEFT, 0.965, sheet.title[:60], fontsize=17, fontweight="bold")
    _write(figure, _LEFT, 0.94, sheet.about, fontsize=9, color="#444444")
    _write(
        figure,
        _RIGHT,
        0.955,
        (sheet.judgement or "not judged").upper(),
        ha="right",
        fontsize=14,
        fontweight="bold",
        color="white",
        bbox={"facecolor": _COLOURS[sheet.judgement], "edgecolor": "none", "boxstyle": "round,pad=0.4"},
    )
    quality = f"{sheet.verdict}; the result is {sheet.quality}" if sheet.quality else sheet.verdict
    colour = _QUALITY.get(sheet.quality, "#222222")
    _write(figure, _LEFT, 0.92, quality, fontsize=10.5, fontweight="bold", color=colour)
    _write(figure, _LEFT, 0.903, _wrapped(["; ".join(sheet.reasons)], 115, 2), fontsize=8.5)


def _draw_views(figure: Figure, sheet: Sheet) -> None:
    """Draw the pictures, side by side, over what they show."""
    width = 0.41
    for i, (title, draw) in enumerate(sheet.pictures):
        axes = figure.add_axes((_LEFT + i * (width + 0.04), 0.575, width, width * _PAGE[0] / _PAGE[1]))
        axes.set_title(title, fontsize=9, loc="left", pad=3)
        draw(axes)
    _write(figure, _LEFT, 0.568, _LEGEND.replace(". Hue", ".\nHue"), fontsize=7, color="#444444")


def _draw_shapes(figure: Figure, sheet: Sheet) -> None:
    """Draw the carved shape from its sides."""
    for i, (title, draw) in enumerate(sheet.shapes):
        axes = figure.add_axes((_LEFT + 0.015 + i * 0.295, 0.375, 0.25, 0.15))
        axes.set_title(title, fontsize=9, loc="left", pad=3)
        draw(axes)


def _write_judgement(figure: Figure, sheet: Sheet) -> None:
    """Write the operator's judgement and remark into a box."""
    figure.add_artist(
        FancyBboxPatch(
            (_LEFT, 0.1),
            _RIGHT - _LEFT,
            0.108,
            boxstyle="round,pad=0,rounding_size=0.004",
            facecolor="#f3f3f3",
            edgecolor="#bbbbbb",
            lw=0.6,
            transform=figure.transFigure,
        )
    )
    remark = sheet.remark.splitlines() or ["No remarks."]
    _write(figure, _LEFT + 0.01, 0.203, f"Judgement: {sheet.judged}"[:120], fontweight="bold")
    _write(figure, _LEFT + 0.01, 0.188, _wrapped(remark, 112, _REMARK_LINES))


def _dimension_table(figure: Figure, sheet: Sheet, left: float) -> None:
    y = 0.335
    columns = (left, left + 0.105, left + 0.29)
    if not sheet.rows:
        figure.text(left, y, "No dimensions: nothing was measured.", va="top")
        return
    for i, row in enumerate([sheet.head, *sheet.rows]):
        for x, cell in zip(columns, row, strict=False):
            weight = "bold" if i and x == columns[1] else "normal"
            colour = "#444444" if not i or x == columns[0] else "black"
            figure.text(x, y - 0.019 * i, cell, va="top", fontsize=10, fontweight=weight, color=colour)


def _png(draw: Draw, inches: float) -> str:
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(inches, inches), layout="constrained")
        FigureCanvasAgg(figure)
        draw(figure.add_subplot())
        out = io.BytesIO()
        figure.savefig(out, format="png", dpi=600 / inches)
    return base64.b64encode(out.getvalue()).decode()


def as_html(sheet: Sheet) -> bytes:
    """Write a report as one HTML file that asks nothing of any other."""
    safe = html.escape

    def figures(entries: list[tuple[str, Draw]], inches: float) -> str:
        return "".join(
            f'<figure><img alt="{safe(title)}" src="data:image/png;base64,{_png(draw, inches)}">'
            f"<figcaption>{safe(title)}</figcaption></figure>"
            for title, draw in entries
        )

    def cells(row: list[str], head: bool) -> str:
        made = (
            f'<th scope="{"col" if head else "row"}">{safe(c)}</th>'
            if c and (head or not i)
            else f"<td>{safe(c)}</td>"
            for i, c in enumerate(row)
        )
        return f"<tr>{''.join(made)}</tr>"

    def paragraphs(lines: list[str]) -> str:
        return "".join(f"<div>{safe(line)}</div>" for line in lines)

    table = "<p>Nothing was measured.</p>"
    if sheet.rows:
        table = f"<table>{cells(sheet.head, True)}{''.join(cells(row, False) for row in sheet.rows)}</table>"
    page = string.Template((STATIC / "report.html").read_text(encoding="utf-8"))
    return page.substitute(
        title=safe(sheet.title),
        about=safe(sheet.about),
        colour=_COLOURS[sheet.judgement],
        judgement=safe(sheet.judgement or "not judged"),
        quality_colour=_QUALITY.get(sheet.quality, "#222"),
        quality=safe(f"{sheet.verdict}; the result is {sheet.quality}" if sheet.quality else sheet.verdict),
        reasons=safe("; ".join(sheet.reasons)),
        pictures=figures(sheet.pictures, 4.2),
        legend=safe(_LEGEND),
        shapes=figures(sheet.shapes, 2.8),
        table=table,
        facts=paragraphs(sheet.facts),
        judged=safe(sheet.judged),
        remark=safe(sheet.remark or "No remarks."),
        damage=paragraphs(sheet.damage or ["None is known: no view was lost or rejected."]),
        versions=safe(sheet.versions),
    ).encode()


__all__ = ["Sheet", "as_html", "as_pdf", "best_view", "sheet_of", "view_of_shadow"]
