"""Size of the object, with intervals.

Length, width, heading and position come from the sides of the silhouettes, not from the voxels. Seen from
aspect θ, the shadow ends to either side where the target's plan does: at the plan's support h in the
directions e_c(θ) and -e_c(θ). All looks of the aperture add up in a view, each with its own edge, so that the
edge's mean place is the mean of h over the aperture,

    h̄(φ) = 1/w ∫ h(φ + α) dα,   |α| < w/2,

and beside a flat side seen along it, lies outside of it. A plan is convex to its shadows: h + h'' ≥ 0. The
least-squares h under that condition undoes the mean over the aperture.

The height of a target with upright walls comes from the length of its shadows, which then agree from view to
view. Otherwise it comes from both ends of the shadows, where the views agree on these (`contour.py`), and
else from the carved layers. The far ends alone cannot tell a flat top from one that rises towards the middle
at up to the grazing angle, and carving leaves that cap: the height is then half-way between a flat top's,
where the cap begins, and a dome's, and its interval holds the cap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..geometry import TWO_PI, View, ViewInfo, cross_range_axis, down_range_axis, wrap_angle
from ..imaging.likelihood import Levels
from ..imaging.local_means import LocalMeans
from ..imaging.mask_codes import MASK_SHADOW, MASK_UNKNOWN
from .cap import HOLE_CELLS, TIP_SHARE, cap_height, cap_of
from .contour import Contour, contour_height, contour_of
from .echo_sides import echo_reach_px
from .mesh import Dimensions, digits_of, measure
from .opposed import apart_share, doubt_cells, opposed_sides, reach_cells, sides_beyond
from .rectangle import Rectangle, SupportSamples, fitted_plan, looks_over, shape_of_plan
from .seabed import largest_piece, leaves_image
from .volume import VoxelGrid

if TYPE_CHECKING:
    import trimesh

FloatArray = NDArray[np.float64]

#: Rows of a silhouette's side whose edge is so far from the outermost take part, by a running median over so
#: many rows to either side (resolution cells across, and down-range).
_SIDE_CELLS, _MEDIAN_HALF_CELLS = 1.9, 2.4
#: The edge's mean place is taken from so much on either side of it (resolution cells across).
_PROFILE_CELLS = 2.25
#: A side that is drawn in by less than this over its rows is straight along range (resolution cells across).
_TAPER_CELLS = 0.94
#: A side whose middle stands out by more than this is round (resolution cells across).
_BULGE_CELLS = 0.3
#: The side of what is round stands out most within this share of its rows; else it tapers.
_BULGE_WITHIN = 0.8
#: An edge is told by at least so much of it (resolution cells down-range).
_LEAST_CELLS = 4.8
#: Roughness of an edge that no fit must explain (resolution cells across): a pixel's rounding.
_ROUGH_CELLS = 0.11
#: What a side of a silhouette may be: as far out at every range, drawn in upwards, out in its middle,
#: straight above a foot that stands out, or one line from its foot to far up that leans inwards.
SHAPES = ("straight", "tapering", "round", "flared", "leaning")
_STRAIGHT, _FLARED, _LEANING = (SHAPES.index(name) for name in ("straight", "flared", "leaning"))
#: A side leans if a line from where it is widest (within so much, resolution cells across) over one of these
#: shares of the rows from there on is drawn in by so much (across), is so long (down-range; share of the
#: shadow), and fits the edge to so much, and this share of what it is drawn in by (across; rms, and how far
#: its middle bulges). Half and double: docs/method.md.
_LEAN_OPEN_CELLS, _LEAN_SHARES = 0.5, (1.0, 0.85, 0.7)
_LEAN_CELLS, _LEAN_LONG_CELLS, _LEAN_LEAST_SHARE = 3.0, 6.0, 0.5
_LEAN_ROUGH_CELLS, _LEAN_ROUGH_SHARE = 0.4, 0.05
#: And if more than this share of the sides see it so that views so far to either side show (apertures).
_LEAN_VOTES, _LEAN_BESIDE = 1.0 / 3.0, 1.0
#: And if the lines bound one plan with the other sides: they scatter about it by less (across, rms).
_LEAN_SCATTER_CELLS = 0.5
#: A foot is so long (resolution cells down-range), and stands out if the views beside agree on more than this
#: (across).
_FOOT_CELLS, _FLARE_CELLS = 14.4, 0.375
#: What all sides are counts so much of what the sides beside are.
_ALL_SIDES = 1.0
#: Directions that a plan's sides may face.
_DIRECTIONS = 120
#: A side that holds this share of the outline gets finer directions round it: so many, so far apart (rad).
_FLAT_SHARE, _FINE, _FINE_STEP_RAD = 0.08, 4, math.radians(0.5)
#: Directions that the smallest rectangle is looked for among.
_FINE_DIRECTIONS = 720
#: After enhancement a straight side is seen so many cross-range cells outside of the mean over the aperture:
#: the seabed is out of focus where the shadow is in focus, as light is behind a knife's edge. Measured on the
#: simulated box and frame: 0.1 to 0.25.
_OUTSIDE_CELLS = 0.15
#: The target's own echo is seen so much farther out than its plan reaches: 1.0 to 1.4 cells for flat walls
#: seen along, whose looks and response spread it, 0 for slopes. And it tells a side if most of the views
#: beside see it so much farther out still than their shadows end, in their median (cross-range cells).
#: Without the former boxes, crates and poles with bright walls come out 1 to 2 cells too wide.
_ECHO_SPREAD_CELLS, _ECHO_BEYOND_CELLS = 0.75, 0.75
#: The carved voxels stand in for sides that no view shows: they count so much beside an edge that is seen,
#: and so much where none is within half an aperture. Where two shadows touch, no view shows the side between.
#: The demonstration's frame, 0.50 m wide, is measured by views every 3° as 0.71 m with 0.1 there, 0.59 m with
#: 0.3 and 0.57 m with 1 (its carved voxels have 0.58 m).
_VOXEL_WEIGHT, _VOXEL_ALONE = 0.1, 1.0
#: A side that stands out of the carved voxels by more than this (cross-range cells) belongs to something else
#: whose shadow touches the target's.
_FOREIGN_CELLS = 3.0
#: A side that leans down to its foot may stand out by so many times more: what slopes is carved away there by
#: its own light. A wedge's thin end stands out by 8 cells. At half it stays 4 cells too short, at double
#: nothing changes.
_FOOT_LOST = 2.0
#: Fewer edges than this give no plan: the voxels alone are measured then.
MIN_EDGES = 24
#: Fewer views than this whose shadow ends in the image tell no height (looks): one or two may be
#: bad silhouettes. Reasoned; what half and double of it change is not measured.
LEAST_ENDS = 3
#: Sides that scatter about the fitted plan by more than this (cross-range cells, 1σ) are not those of one
#: plan: edges are found to a fraction of a cell. Simulated targets scatter by 0.19 to 0.57, the chips of a
#: measured vehicle, which were cut out one by one (docs/examples.md), by 1.65 before they are put together.
ONE_PLAN_CELLS = 1.0
#: Parts of a plan that are thinner than this are not measured where the sides scatter so (cross-range cells).
#: The measured vehicle of docs/examples.md, before its chips are put together, is 7.74 m long with its crumbs
#: and 6.96 m without (its hull has 6.95 m); at half 7.02 m, at double 6.76 m.
_THIN_CELLS = 2.0
#: Resamplings of the views.
_RESAMPLINGS = 20
#: Error of one extent besides what resampling shows (1σ, cross-range cells). On the population's development
#: half extents are wrong by 0.8 cells (rms, 58 extents of results that are not called untrustworthy), and
#: their intervals hold 95 % of the truths; at half 71 %, at double all of them.
_EDGE_CELLS = 0.8
#: Walls are upright if more than this share of the silhouettes' sides are straight and of the views tell one
#: height, to its error, which is within so many voxels of a flat top as the carved cap or the contours tell
#: it.
_MOST, _UPRIGHT_VOXELS = 0.5, 2.0
#: Walls stand as carved if the layer under the height that shadows tell has this share of the area of the
#: largest below. Of the development half boxes have 0.80 to 0.97, spheres 0.51 to 0.83, wedges up to 0.62.
_STANDING = 0.85
#: The height that upright walls tell: this percentile of the views, the middle of their higher half (a view
#: that sees something else narrower at its top tells too little).
_UPRIGHT_PERCENTILE = 75.0
_SIGMAS_95 = 1.96
#: A drawn silhouette has no levels of its own.
_DRAWN_CONTRAST = 1e3


@dataclass(frozen=True)
class SilhouetteSides:
    """Where the target's shadow ends in one view.

    Parameters
    ----------
    info : ViewInfo
        The view.
    direction_rad : tuple of float
        Directions φ on the ground of the sides that were found, none to two.
    support_m : tuple of float
        The plan's support in these directions, mean over the aperture: the largest p · (cos φ, sin φ), m, as
        this view alone tells it.
    tip_m : float
        Down-range e_r · p of the shadow's far end, m.
    shapes : tuple of str
        Which of `SHAPES` each side seems to be in this view alone (never flared, which one view is too rough
        to tell); empty where nobody looked.
    support_by_shape_m : tuple of tuple of float
        The support of each side if it is of each of `SHAPES`, m; NaN where it cannot be.
    cut : bool
        Whether the shadow goes on where the view knows nothing: off the image.
    contour : Contour, optional
        Where the last rays over the target leave it; None where the silhouette holds the target's echo too,
        as one that is drawn by hand.
    echo_support_m : tuple of float
        The support of each side as the target's own echo tells it, m; NaN where none is seen.
    shift_m : float
        How far along e_c the view lay from its place before it was put back, m (`alignment`).
    leaning : tuple of (float, float)
        Direction (rad) across the line that each side leans inwards along, if it does, and the plan's support
        there, m; NaN where it does not.
    """

    info: ViewInfo
    direction_rad: tuple[float, ...]
    support_m: tuple[float, ...]
    tip_m: float
    shapes: tuple[str, ...] = ()
    support_by_shape_m: tuple[tuple[float, ...], ...] = ()
    cut: bool = False
    contour: Contour | None = None
    echo_support_m: tuple[float, ...] = ()
    shift_m: float = 0.0
    leaning: tuple[tuple[float, float], ...] = ()

    @property
    def signs(self) -> tuple[int, ...]:
        """Whether each side faces along e_c (1) or against it (-1)."""
        across = cross_range_axis(self.info.aspect_rad)
        faces = (math.cos(phi) * across[0] + math.sin(phi) * across[1] for phi in self.direction_rad)
        return tuple(1 if face > 0.0 else -1 for face in faces)

    def moved_back(self, shifts_m: Mapping[int, float]) -> SilhouetteSides:
        """Return the sides of the view put back that lies so far along e_c (by stamp, m) from its place."""
        shift = shifts_m.get(self.info.stamp_ns, 0.0)
        back = np.array([-sign * shift for sign in self.signs])
        across = cross_range_axis(self.info.aspect_rad)

        def moved(told: Sequence[float]) -> tuple[float, ...]:
            return tuple((np.array(told) + back[: len(told)]).tolist())

        contour = self.contour
        return replace(
            self,
            info=self.info.moved_back(shift),
            support_m=moved(self.support_m),
            support_by_shape_m=tuple(
                tuple((np.array(each) + by).tolist())
                for each, by in zip(self.support_by_shape_m, back, strict=False)
            ),
            contour=contour and replace(contour, across_m=tuple(x - shift for x in contour.across_m)),
            echo_support_m=moved(self.echo_support_m),
            shift_m=self.shift_m + shift,
            leaning=tuple(
                (phi, out - shift * float(across @ (math.cos(phi), math.sin(phi))))
                for phi, out in self.leaning
            ),
        )


def silhouette_sides(levels: Levels, mask: View, target_m: tuple[float, float]) -> SilhouetteSides | None:
    """Find the edges of a view's shadow on both sides, to a fraction of a pixel.

    Parameters
    ----------
    levels : Levels
        The view relative to its seabed.
    mask : View
        Its segmented shadow.
    target_m : (float, float)
        Ground position of the target.

    Returns
    -------
    SilhouetteSides or None
        None if no shadow was segmented.
    """
    shadow = largest_piece(mask.pixels == MASK_SHADOW)
    if shadow is None:
        return None
    info = mask.info
    camera = info.camera
    rows = np.flatnonzero(shadow.any(axis=1))
    sonar_range = math.hypot(camera.sonar_m[0] - target_m[0], camera.sonar_m[1] - target_m[1])
    u0, v0, _ = camera.ground_to_pixel @ np.array([target_m[0], target_m[1], 1.0])
    row_m, col_m = camera.spacing_m
    # Rays fan out from the sonar: seen at the target's range, the shadow behind it is narrower.
    scale = sonar_range / (sonar_range + (rows - v0) * row_m)
    cols = shadow.shape[1]
    first = shadow[rows].argmax(axis=1).astype(np.float64)
    last = cols - 1 - shadow[rows][:, ::-1].argmax(axis=1).astype(np.float64)
    outside = _OUTSIDE_CELLS * info.resolution_m[1] if math.isfinite(info.focus_range_m) else 0.0
    e_c = cross_range_axis(info.aspect_rad)
    directions, supports, shapes, echoes, leaning = [], [], [], [], []
    reach_px = echo_reach_px(levels, mask, shadow, (u0, v0))
    middle = (first + last) / 2.0
    for sign, edge in ((1, last), (-1, first)):
        out_px, inner_px = (sign * (column - u0) * scale for column in (edge, middle))
        own_edge = _Edge(levels, sign, (u0, v0), info.cell_px, rows, scale, out_px, inner_px)
        calm = own_edge.calmed()
        found = _side(own_edge, calm)
        if found is None:
            continue
        out, shape = found
        axis = sign * e_c
        directions.append(math.atan2(axis[1], axis[0]))
        here = float(axis @ np.asarray(target_m))
        out_m, lean = _leaning(calm, (row_m, col_m)) or (math.nan, math.nan)
        axis = math.cos(lean) * axis + math.sin(lean) * down_range_axis(info.aspect_rad)
        leaning.append((math.atan2(axis[1], axis[0]), out_m + float(axis @ np.asarray(target_m))))
        beyond = {"straight": outside, "flared": outside}
        supports.append(tuple(out[name] * col_m - beyond.get(name, 0.0) + here for name in SHAPES))
        shapes.append(shape)
        echoes.append(reach_px[0 if sign > 0 else 1] * col_m + here)
    tip = info.down_range_of_rows()[rows[-1]] + row_m / 2.0
    own = tuple(each[SHAPES.index(shape)] for each, shape in zip(supports, shapes, strict=True))
    cut = leaves_image(mask.pixels != MASK_UNKNOWN, shadow, int(rows[-1]))
    contour = None if math.isnan(levels.seabed_level) else contour_of(shadow, info)
    return SilhouetteSides(
        info,
        tuple(directions),
        own,
        float(tip),
        tuple(shapes),
        tuple(supports),
        cut,
        contour,
        tuple(echoes),
        leaning=tuple(leaning),
    )


def levels_of_mask(mask: View) -> Levels:
    """Substitute levels for a view with only a silhouette, such as one drawn by hand."""
    known = mask.pixels != MASK_UNKNOWN
    power = (known & (mask.pixels != MASK_SHADOW)).astype(np.float32)
    return Levels(
        math.nan, _DRAWN_CONTRAST, math.nan, False, LocalMeans(power, np.asarray(known), mask.info.cell_px)
    )


@dataclass(frozen=True)
class _Edge:
    """One side of a silhouette, row by row.

    Places are pixels outwards from the target's column, taken back to the target's range: rays fan out from
    the sonar.
    """

    levels: Levels
    #: 1: to the right of the target, -1: to its left.
    sign: int
    target_px: tuple[float, float]
    cell_px: tuple[float, float]
    #: Of each row: its number, what takes its columns back to the target's range, its edge, and its middle.
    rows: NDArray[np.intp]
    scale: FloatArray
    out_px: FloatArray
    inner_px: FloatArray

    def calmed(self) -> _Edge:
        """Return it by a running median: rows chosen by their own edges would be those that err outwards."""
        size = 2 * round(_MEDIAN_HALF_CELLS * self.cell_px[0]) + 1
        calm, inner = (
            scipy.ndimage.median_filter(px, size, mode="nearest") for px in (self.out_px, self.inner_px)
        )
        return replace(self, out_px=calm, inner_px=inner)

    def of_rows(self, which: NDArray[np.bool_] | slice) -> _Edge:
        """Return some of its rows."""
        of = {name: getattr(self, name)[which] for name in ("rows", "scale", "out_px", "inner_px")}
        return replace(self, **of)

    def beyond(self, curve_px: FloatArray) -> float:
        """Return how far outside of a fitted curve it lies, pixels.

        From the mean profile across the edge, rows laid over one another along the curve; NaN where unknown.
        The side has the shadow from its middle outwards: what lies towards that is the other side's. A shadow
        that is narrower than the profile would lose there what is lit behind the other edge.
        """
        levels, sign, u0, scale = self.levels, self.sign, self.target_px[0], self.scale
        half = max(1, round(_PROFILE_CELLS * self.cell_px[1]))
        steps = sign * np.arange(-half, half + 1)
        curve = sign * curve_px
        columns = np.round(u0 + (curve[:, None] + steps) / scale[:, None]).astype(np.intp)
        inside = (columns >= 0) & (columns < levels.power.shape[1])
        offsets = sign * ((columns - u0) * scale[:, None] - curve[:, None])
        columns = np.clip(columns, 0, levels.power.shape[1] - 1)
        known = levels.known[self.rows[:, None], columns] & inside
        if not known.any(axis=0).all():
            return math.nan
        shadow_power = 1.0 / levels.contrast**2
        own = sign * (columns - u0) * scale[:, None] >= self.inner_px[:, None]
        powers = np.where(own, levels.power[self.rows[:, None], columns], shadow_power)
        power = np.where(known, powers, 0.0).sum(axis=0) / known.sum(axis=0)
        dark = np.clip((1.0 - power) / (1.0 - shadow_power), -0.5, 1.2)
        return -half - 0.5 + float(dark.sum()) + float((offsets - sign * steps).mean())


def _side(edge: _Edge, calm: _Edge) -> tuple[dict[str, float], str] | None:
    """Return how far out a side reaches if it is of each of `SHAPES`, and which it seems to be.

    In pixels from the target's column, at the target's range; None where too little of it is seen.
    """
    down_px, across_px = edge.cell_px
    kept = np.abs(calm.out_px - np.percentile(calm.out_px, 90)) <= _SIDE_CELLS * across_px
    if kept.sum() < _LEAST_CELLS * down_px:
        return None
    calm = calm.of_rows(kept)
    rows = calm.rows
    curves, shape, slope = _fitted_side(rows - rows.mean(), edge.out_px[kept], across_px)
    # The target's echo hides the foot of a side that is drawn in upwards: its shadow would begin at the
    # target's own range.
    hidden = min(max(0.0, float(rows[0]) - edge.target_px[1]), float(rows[-1] - rows[0]))
    out = dict.fromkeys(SHAPES, math.nan)
    for name, curve in curves.items():
        foot = max(0.0, -slope) * hidden if name == "tapering" else 0.0
        out[name] = float(curve.max()) + foot + calm.beyond(curve)
    near = calm.of_rows(rows < rows[0] + _FOOT_CELLS * down_px)
    foot_px = np.full(len(near.rows), float(near.out_px.mean()))
    out["flared"] = float(foot_px[0]) + near.beyond(foot_px)
    return None if math.isnan(out[shape]) else (out, shape)


def _leaning(calm: _Edge, spacing_m: tuple[float, float]) -> tuple[float, float] | None:
    """Return how far (m) a side that leans inwards lies off the target's place, and how much it leans (rad).

    None where it does not. Lines stay lines as both coordinates are taken back to the target's range.
    """
    (down_px, across_px), (row_m, col_m) = calm.cell_px, spacing_m
    # The shadow opens up to where the body's own echo hides it no more. If it runs straight from there and
    # narrows later, that is the shadow of a top.
    widest = np.flatnonzero(calm.out_px >= calm.out_px.max() - _LEAN_OPEN_CELLS * across_px)[0]
    least = max(_LEAN_LONG_CELLS * down_px, _LEAN_LEAST_SHARE * len(calm.rows))
    lower = calm.of_rows(slice(widest, None))
    for share in _LEAN_SHARES:
        n = math.ceil(share * len(lower.rows))
        if n < least:
            return None
        own = lower.of_rows(slice(n))
        along = (own.rows - own.target_px[1]) * own.scale * row_m / col_m
        slope, level = np.polyfit(along, own.out_px, 1)
        line = level + slope * along
        rough = float(np.sqrt(np.mean((own.out_px - line) ** 2)))
        bulge = abs(float(np.polyfit(along, own.out_px, 2)[0])) * float(np.ptp(along)) ** 2 / 4.0
        drawn_in = -float(slope) * float(np.ptp(along))
        if drawn_in < _LEAN_CELLS * across_px:
            continue
        if max(rough, bulge) > _LEAN_ROUGH_CELLS * across_px + _LEAN_ROUGH_SHARE * drawn_in:
            continue
        beyond, lean = own.beyond(line), math.atan(-slope)
        return None if math.isnan(beyond) else (float(level + beyond) * col_m * math.cos(lean), lean)
    return None


def _fitted_side(
    along: FloatArray, out_px: FloatArray, cell_px: float
) -> tuple[dict[str, FloatArray], str, float]:
    """Fit a side with each of `SHAPES` that it may have; say which it seems to be, and its taper."""
    weight = np.ones_like(out_px)
    slope = level = 0.0
    for _ in range(5):
        middle, level = np.average(along, weights=weight), float(np.average(out_px, weights=weight))
        spread = float((weight * (along - middle) ** 2).sum())
        slope = float((weight * (along - middle) * (out_px - level)).sum()) / max(spread, 1e-9)
        level -= slope * float(middle)
        residual = np.abs(out_px - level - slope * along)
        rough = 1.4826 * float(np.median(residual)) + _ROUGH_CELLS * cell_px
        weight = 1.0 / np.maximum(1.0, residual / (1.5 * rough))
    mean = float(np.average(out_px, weights=weight))
    reach = max(float(np.abs(along).max()), 1.0)
    design = np.stack([np.ones_like(along), along / reach, (along / reach) ** 2], axis=1)
    bend, *_ = np.linalg.lstsq(design * weight[:, None], out_px * weight, rcond=None)
    curves = {"straight": np.full_like(out_px, mean), "tapering": np.asarray(level + slope * along)}
    shape = "tapering" if abs(slope) * float(np.ptp(along)) >= _TAPER_CELLS * cell_px else "straight"
    if bend[2] < 0.0 and abs(bend[1] / (2.0 * bend[2])) < _BULGE_WITHIN:
        curves["round"] = np.asarray(design @ bend)
        if float(curves["round"].max()) - mean > _BULGE_CELLS * cell_px:
            shape = "round"
    return curves, shape, slope


def agreed_sides(
    sides: Sequence[SilhouetteSides], grid: VoxelGrid
) -> tuple[list[SilhouetteSides], FloatArray]:
    """Return what the sides tell of the plan together.

    Parameters
    ----------
    sides : sequence of SilhouetteSides
        Of all views, in any order.
    grid : VoxelGrid
        What was carved of them.

    Returns
    -------
    sides : list of SilhouetteSides
        By stamp; those that lean inwards as bounds across their own lines (`leaning_agreed`).
    support_m : ndarray of float
        The plan's support in the direction of each of their sides, m (`agreed_support`).

    Notes
    -----
    A line bounds the plan where it meets the ground. The upper edge of a wall, or of a body that stands on a
    wider one, casts such a line from its own height: it passes outside of the plan, the farther the more it
    leans. Then the lines and the other sides bound no one plan (`_LEAN_SCATTER_CELLS`), and no side leans.
    """
    in_order = sorted(sides, key=lambda side: side.info.stamp_ns)
    leaning = leaning_agreed(in_order)
    if not _bound_one_plan(leaning, grid):
        leaning = in_order
    return leaning, agreed_support(leaning)


def _bound_one_plan(sides: Sequence[SilhouetteSides], grid: VoxelGrid) -> bool:
    """Say whether the sides that lean, if any, bound one plan with the others."""
    leans = _leans(sides)
    if not leans.any():
        return True
    fit = PlanFit(sides, grid)
    fit.solve()
    beyond = fit.beyond_m[leans[fit.kept]]
    cell = float(np.median([side.info.resolution_m[1] for side in sides]))
    return bool(len(beyond)) and math.sqrt(float(np.mean(beyond**2))) <= _LEAN_SCATTER_CELLS * cell


def _leans(sides: Sequence[SilhouetteSides]) -> NDArray[np.bool_]:
    """Say which sides lean inwards; none of a program that does not tell shapes."""
    told = (side.shapes or ("",) * len(side.direction_rad) for side in sides)
    return np.array([shape == SHAPES[_LEANING] for shapes in told for shape in shapes], np.bool_)


def leaning_agreed(sides: Sequence[SilhouetteSides]) -> list[SilhouetteSides]:
    """Return the sides, those that lean inwards as bounds across their own lines.

    The edge of a shadow that leans from its beginning on is the shadow of a slanting edge or side. The line
    meets the plan at its foot, and a convex body lies to one side of it: it bounds the plan in the direction
    across itself. Its shadow alone is too short there to be seen. A side leans if most of the views beside
    see it so: one view alone may take the far end of a shadow for its side.
    """
    lines = np.array([line for side in sides for line in side.leaning]).reshape(-1, 2)
    if len(lines) != sum(len(side.direction_rad) for side in sides):
        return list(sides)  # of a program that does not tell them
    seen = np.isfinite(lines[:, 1])
    beside = _beside(sides, _LEAN_BESIDE)
    leans = np.count_nonzero(beside & seen, axis=1) > _LEAN_VOTES * np.count_nonzero(beside, axis=1)
    out, first = [], 0
    for side in sides:
        mine = range(first, first := first + len(side.direction_rad))
        # Where the others lean and a view tells no line, its shadow ends too early.
        left = [(own, n) for own, n in enumerate(mine) if seen[n] or not leans[n]]

        def told(own: Sequence[Any], lean: Callable[[int], Any], left: Any = left) -> tuple[Any, ...]:
            return tuple(lean(n) if leans[n] else own[at] for at, n in left) if len(own) else ()

        out.append(
            replace(
                side,
                direction_rad=told(side.direction_rad, lambda n: float(lines[n, 0])),
                support_m=told(side.support_m, lambda n: float(lines[n, 1])),
                shapes=told(side.shapes, lambda _: SHAPES[_LEANING]),
                support_by_shape_m=told(
                    side.support_by_shape_m, lambda n: (float(lines[n, 1]),) * len(SHAPES)
                ),
                echo_support_m=told(side.echo_support_m, lambda _: math.nan),
                leaning=told(side.leaning, lambda n: (float(lines[n, 0]), float(lines[n, 1]))),
            )
        )
    return out


def agreed_support(sides: Sequence[SilhouetteSides]) -> FloatArray:
    """Return the supports of all sides, each taken for the shape that the sides beside it and all sides have.

    Speckle roughens edges, so that one view alone is wrong about a side in six, and a straight side that is
    taken for a round one is measured 2 cm too far out. Views within half an aperture look at the same side;
    what all sides are counts as much as these, as few bodies have walls here and bulges there.
    """
    own = np.array([support for side in sides for support in side.support_m], dtype=np.float64)
    told = [shape for side in sides for shape in side.shapes]
    if len(told) != len(own) or not told:
        return own  # of a program that does not tell shapes
    shape = np.array([SHAPES.index(name) for name in told], dtype=np.intp)
    by_shape = np.array([each for side in sides for each in side.support_by_shape_m]).reshape(-1, len(SHAPES))
    beside = _beside(sides)
    ballots = np.eye(len(SHAPES))[shape]
    votes = beside.astype(np.float64) @ ballots
    votes += _ALL_SIDES * votes.sum(axis=1, keepdims=True) * ballots.mean(axis=0)
    # What a view alone says breaks a tie.
    votes[np.arange(len(shape)), shape] += 0.5
    agreed = by_shape[np.arange(len(shape)), votes.argmax(axis=1)]
    straight = np.flatnonzero(votes.argmax(axis=1) == _STRAIGHT)
    cell_m = np.array([side.info.resolution_m[1] for side in sides for _ in side.direction_rad])
    flare = by_shape[:, _FLARED] - by_shape[:, _STRAIGHT]
    for index in straight:
        told_beside = flare[beside[index] & np.isfinite(flare)]
        stands_out = float(np.median(told_beside)) if len(told_beside) else 0.0
        if stands_out > _FLARE_CELLS * cell_m[index]:
            agreed[index] += stands_out
    return np.where(np.isnan(agreed), own, agreed)


def _beside(sides: Sequence[SilhouetteSides], apertures: float = 0.5) -> NDArray[np.bool_]:
    """Say which sides look at the same side of the target: within half an aperture of one another."""
    phi = np.array([angle for side in sides for angle in side.direction_rad])
    half = np.array([apertures * side.info.aperture_rad for side in sides for _ in side.direction_rad])
    away = np.abs(wrap_angle(phi[:, None] - phi[None, :]))
    return np.asarray(away <= half[:, None] + 1e-9)


def _with_echoes(supports: FloatArray, sides: Sequence[SilhouetteSides]) -> FloatArray:
    """Move sides out to where the target's own echo ends, if most views beside see it clearly farther out.

    A low flank shines where its shadow is too short to be seen.
    """
    echo = np.array([each for side in sides for each in side.echo_support_m])
    if len(echo) != len(supports):
        return supports
    cell_m = np.array([side.info.resolution_m[1] for side in sides for _ in side.direction_rad])
    out = supports.copy()
    for index, row in enumerate(_beside(sides)):
        told = np.where(np.isnan(echo[row]), -math.inf, echo[row])  # no echo: it reaches nowhere
        reach = float(np.median(told)) - _ECHO_SPREAD_CELLS * cell_m[index]
        if reach > supports[index] + _ECHO_BEYOND_CELLS * cell_m[index]:
            out[index] = reach
    return out


class PlanFit:
    """Least-squares support function of a plan from the sides of silhouettes.

    The outline is a polygon whose sides face fixed directions, at first every 3°, then also finely round the
    directions that long sides were found to face.

    Parameters
    ----------
    sides : sequence of SilhouetteSides
        Of all views.
    grid : VoxelGrid
        Carved voxels, which stand in where no side is seen.
    support_m : ndarray of float, optional
        The plan's support in the direction of each side, m; by default as shadows tell it.

    Attributes
    ----------
    count : int
        Sides that take part.
    centre : ndarray, shape (2,)
        Ground point (m) that supports are taken about.
    directions : ndarray, shape (720,)
        Directions (rad) that `solve` answers for.
    kept : ndarray of bool
        Which sides take part: not those that stand out of the voxels.
    spread_m : float
        How far these scatter about the plan, 1σ, m, once it is solved for.
    beyond_m : ndarray of float, shape (count,)
        How far each of these lies outside of the plan then, m.
    counts : ndarray of bool, shape (count,)
        Which of these are not outliers then.
    """

    def __init__(
        self, sides: Sequence[SilhouetteSides], grid: VoxelGrid, support_m: FloatArray | None = None
    ) -> None:
        pairs = [
            (phi, math.nan, side.info.aperture_rad, index)
            for index, side in enumerate(sides)
            for phi in side.direction_rad
        ]
        seen: FloatArray = np.array(pairs, dtype=np.float64).reshape(-1, 4)
        # The fit makes 1e-4 m of the FFT's rounding, 1e-9 m: to a hundredth of a voxel the same image leaves
        # the same sides, whether it came whole or as a sum of sectors. Edges are ten times less sure.
        told = agreed_support(sides) if support_m is None else support_m
        seen[:, 1] = np.round(told, digits_of(grid.volume.voxel_size_m))
        self._every = seen
        self.directions: FloatArray = _round_circle(_FINE_DIRECTIONS)
        coarse = _round_circle(_DIRECTIONS)
        own = _voxel_support(grid, coarse)
        self.kept = np.ones(len(seen), np.bool_)
        leans = _leans(sides)
        if len(seen):
            cell = float(np.median([side.info.resolution_m[1] for side in sides]))
            margin = _FOREIGN_CELLS * cell + grid.volume.voxel_size_m
            expected = np.interp(seen[:, 0] % TWO_PI, coarse, own, period=TWO_PI)
            # What slopes down to its foot may be carved away there by its own light.
            self.kept = np.abs(seen[:, 1] - expected) <= np.where(leans, _FOOT_LOST, 1.0) * margin
            seen, leans = seen[self.kept], leans[self.kept]
        self.count = len(seen)
        self.centre = 2.0 * np.array([np.mean(own * np.cos(coarse)), np.mean(own * np.sin(coarse))])
        self._phi = np.concatenate([seen[:, 0], coarse])
        self._aperture = np.concatenate([seen[:, 2], np.zeros(_DIRECTIONS)])
        about = self.centre[0] * np.cos(self._phi) + self.centre[1] * np.sin(self._phi)
        self._values = np.concatenate([seen[:, 1], own]) - about
        away = np.abs(wrap_angle(coarse[:, None] - seen[None, :, 0]))
        alone = ~(away <= seen[None, :, 2] / 2.0).any(axis=1)
        if leans.any():
            alone &= ~leans[away.argmin(axis=1)]  # for the same reason
        weights = np.where(alone, _VOXEL_ALONE, _VOXEL_WEIGHT)
        self._weights = np.concatenate([np.ones(self.count), weights])
        # Five numbers need no voxels beside sides.
        self._tells_shape = np.concatenate([np.ones(self.count, np.bool_), alone])
        self._robust = np.ones_like(self._weights)
        self._shape: str | None = None
        self.spread_m = 0.0
        self.beyond_m = np.zeros(self.count)
        self.counts = np.ones(self.count, np.bool_)
        self.view_of = seen[:, 3].astype(np.intp)
        self._face(coarse)
        radii = self._solve(self._weights)[: len(coarse)]
        flat = coarse[radii > _FLAT_SHARE * radii.sum()]
        steps = np.arange(-_FINE, _FINE + 1) * _FINE_STEP_RAD
        self._face(np.unique(np.mod(np.concatenate([coarse, (flat[:, None] + steps).ravel()]), TWO_PI)))

    def _face(self, faces: FloatArray) -> None:
        """Let the outline's sides face these directions."""
        self._faces = faces
        looks = looks_over(self._phi, self._aperture).T
        self._design = np.mean([self._basis(look) for look in looks], axis=0)
        # Σρ cos = Σρ sin = 0: the outline closes.
        self._closing = np.zeros((2, self._design.shape[1]))
        self._closing[0, : len(faces)] = 10.0 * np.cos(faces)
        self._closing[1, : len(faces)] = 10.0 * np.sin(faces)

    def _basis(self, phi: NDArray[Any]) -> FloatArray:
        """Response of h at φ to the lengths ρ = h + h'' ≥ 0 of the sides, and to a shift."""
        t = np.mod(phi[:, None] - self._faces[None, :], TWO_PI)
        green = ((math.pi - t) * np.sin(t)) / TWO_PI + np.cos(t) / (2.0 * TWO_PI)
        shift = np.stack([np.cos(phi), -np.cos(phi), np.sin(phi), -np.sin(phi)], axis=1)
        return np.concatenate([green, shift], axis=1)

    def _solve(self, weights: FloatArray) -> FloatArray:
        left = np.concatenate([self._design * weights[:, None], self._closing])
        right = np.concatenate([self._values * weights, [0.0, 0.0]])
        normal = left.T @ left
        # The normal equations' root: as many rows as unknowns, whatever the number of views.
        root = np.linalg.cholesky(normal + 1e-9 * np.trace(normal) / len(normal) * np.eye(len(normal)))
        solution, _ = nnls(root.T, np.linalg.solve(root, left.T @ right), maxiter=50 * len(normal))
        return np.asarray(solution, dtype=np.float64)

    def solve(self, rounds: int = 3) -> FloatArray:
        """Return h (m) about `centre` at every direction.

        Parameters
        ----------
        rounds : int
            Rounds of Tukey's biweight, against sides that something else was taken for.
        """
        for _ in range(rounds):
            solution = self._solve(self._weights * self._robust)
            residual = (self._values - self._design @ solution)[: self.count]
            spread = self.spread_m = 1.4826 * float(np.median(np.abs(residual))) + 1e-4
            self._robust[: self.count] = np.sqrt(np.clip(1.0 - (residual / (4.0 * spread)) ** 2, 0.0, None))
        self.beyond_m = (self._values - self._design @ solution)[: self.count]
        self.counts = self._robust[: self.count] > 0.0
        return np.asarray(self._basis(self.directions) @ solution)

    def outside_m(self, support: FloatArray, told_m: FloatArray) -> FloatArray:
        """Return how far sides lie outside of the plan, also those that took no part, m.

        Parameters
        ----------
        support : ndarray, shape (720,)
            The plan, as `solve` returned it.
        told_m : ndarray
            Where each side lies, m, in the order of all sides.
        """
        phi, aperture = self._every[:, 0], self._every[:, 2]
        looks = np.mod(looks_over(phi, aperture), TWO_PI)
        reach = np.interp(looks, self.directions, support, period=TWO_PI).mean(axis=1)
        return np.asarray(told_m - reach - self.centre[0] * np.cos(phi) - self.centre[1] * np.sin(phi))

    def plan(self, smallest: Rectangle) -> Rectangle:
        """Return the rectangle round the plan's own shape where it has one, else the smallest round it.

        Parameters
        ----------
        smallest : Rectangle
            The latter, by what `solve` returned.
        """
        samples = self._samples(self._weights * self._robust)
        self._shape = shape_of_plan(samples, smallest, samples.scatter_m(self.beyond_m))
        return smallest if self._shape is None else fitted_plan(self._shape, samples, smallest)

    def resampled(self, share: FloatArray, plan: Rectangle) -> Rectangle:
        """Return the plan as `plan` does, each side counting `share` times, shape (count,)."""
        weights = self._weights * self._robust
        weights[: self.count] *= np.sqrt(share)
        if self._shape is not None:
            return fitted_plan(self._shape, self._samples(weights), plan)
        return _rectangle(self._basis(self.directions) @ self._solve(weights), self.centre)

    def _samples(self, weights: FloatArray) -> SupportSamples:
        about = self.centre[0] * np.cos(self._phi) + self.centre[1] * np.sin(self._phi)
        weights = weights * self._tells_shape
        return SupportSamples(self._phi, self._aperture, self._values + about, weights, self.count)


def _round_circle(count: int) -> FloatArray:
    return np.arange(count, dtype=np.float64) * (TWO_PI / count)


def _voxel_support(grid: VoxelGrid, directions: FloatArray) -> FloatArray:
    """Return the support of the occupied voxels' plan; its edges lie about 0.3 voxels outside of centres."""
    volume = grid.volume
    j, i = np.nonzero(grid.occupied.any(axis=0))
    plan = np.stack([volume.x_m[i], volume.y_m[j]], axis=1)
    reach = plan @ np.stack([np.cos(directions), np.sin(directions)])
    return np.asarray(reach.max(axis=0) + 0.3 * volume.voxel_size_m)


def _without_thin_parts(grid: VoxelGrid, width_m: float) -> VoxelGrid:
    """Return a grid without the parts of its plan that are thinner than that; as it is if nothing were left.

    What is thinner than views can resolve are crumbs that the scatter of the views left beside a body.
    """
    plan = grid.occupied.any(axis=0)
    radius = width_m / 2.0 / grid.volume.voxel_size_m
    padded = np.pad(plan, 1 + math.ceil(radius))
    core = scipy.ndimage.distance_transform_edt(padded) > radius
    opened = scipy.ndimage.distance_transform_edt(~core) <= radius
    inner = slice(1 + math.ceil(radius), -1 - math.ceil(radius))
    kept = opened[inner, inner] & plan
    return replace(grid, occupied=grid.occupied & kept) if kept.any() else grid


def _rectangle(support: FloatArray, centre: FloatArray) -> Rectangle:
    """Return the smallest rectangle round a plan with that support."""
    h, m = support, len(support)
    angles = _round_circle(m)
    widths = h + np.roll(h, -m // 2)
    quarter = m // 4
    area = (widths * np.roll(widths, -quarter))[:quarter]
    a = int(np.argmin(area))
    b = a + quarter
    if widths[a] < widths[b]:
        a, b = b, a
    middle = np.array(centre, dtype=np.float64)
    for k in (a, b):
        off = (h[k] - h[(k + m // 2) % m]) / 2.0
        middle += off * np.array([math.cos(angles[k]), math.sin(angles[k])])
    return Rectangle(
        float(widths[a]), float(widths[b]), float(angles[a] % math.pi), (float(middle[0]), float(middle[1]))
    )


def upright_height(
    sides: Sequence[SilhouetteSides],
    dimensions: Dimensions,
    tops_m: Sequence[float],
    sigma_m: float,
    voxel_size_m: float,
) -> float | None:
    """Return the height (m) of a target with upright walls, None if its walls are not.

    Parameters
    ----------
    sides : sequence of SilhouetteSides
        Of all views.
    dimensions : Dimensions
        The target's plan.
    tops_m : sequence of float
        Where the top may be if it is flat: as carving tells, and as the views' contours do.
    sigma_m : float
        Standard deviation of the height that one view tells, m.
    voxel_size_m : float
        Edge of a voxel.

    Notes
    -----
    Upright walls have straight sides, and behind them each shadow's length tells the height
    (`shadow_height`); behind others it tells too little, and another height from each side.
    """
    shapes = [shape == "straight" for side in sides for shape in side.shapes]
    if not shapes or float(np.mean(shapes)) <= _MOST:
        return None
    height, agreed = _told_height(sides, dimensions, sigma_m)
    near = min(abs(height - top) for top in tops_m) <= _UPRIGHT_VOXELS * voxel_size_m
    return height if agreed and near else None


def _told_height(
    sides: Sequence[SilhouetteSides], dimensions: Dimensions, sigma_m: float
) -> tuple[float, bool]:
    """Return the height (m) that the shadows' lengths tell, and whether most views agree on it."""
    told = np.array([shadow_height(side, dimensions) for side in sides])
    height = float(np.percentile(told, _UPRIGHT_PERCENTILE))
    return height, float(np.mean(np.abs(told - height) <= sigma_m)) > _MOST


def standing_height(
    sides: Sequence[SilhouetteSides], dimensions: Dimensions, grid: VoxelGrid, sigma_m: float
) -> float | None:
    """Return the height (m) that most shadows tell if carved walls stand up to it, None if they do not.

    Where an edge is rough the sides' shapes are not told, and the carved top is ragged: of a low slab's cap
    the shadows' lengths are the better witness.

    Parameters
    ----------
    sides : sequence of SilhouetteSides
        Of all views.
    dimensions : Dimensions
        The target's plan.
    grid : VoxelGrid
        Carved grid with an object.
    sigma_m : float
        Standard deviation of the height that one view tells, m.
    """
    height, agreed = _told_height(sides, dimensions, sigma_m)
    areas = grid.occupied.sum(axis=(1, 2))[grid.volume.z_m + grid.volume.voxel_size_m / 4.0 <= height]
    stands = bool(areas.any()) and areas[-1] >= _STANDING * areas.max()
    return height if agreed and stands else None


def shadow_height(side: SilhouetteSides, dimensions: Dimensions) -> float:
    """Return the height (m) that one view's shadow length implies.

    z = s_z (ρ_tip - ρ_top) / (s + ρ_tip): the ray over the top, at down-range ρ_top, meets the seabed at the
    shadow's tip ρ_tip; s is the sonar's ground range to the scene's origin. The far side of the plan's
    rectangle is taken for ρ_top, which is exact for an upright box and too far for a target that is narrower
    at the top: a lower bound.
    """
    info = side.info
    axis = down_range_axis(info.aspect_rad)
    along = np.array([math.cos(dimensions.heading_rad), math.sin(dimensions.heading_rad)])
    across = np.array([-along[1], along[0]])
    reach = 0.5 * (dimensions.length_m * abs(along @ axis) + dimensions.width_m * abs(across @ axis))
    top = float(axis @ np.asarray(dimensions.position_m)) + reach
    sonar = info.camera.sonar_m
    ground_range = -float(axis @ sonar[:2])
    return float(sonar[2] * (side.tip_m - top) / (ground_range + side.tip_m))


@dataclass(frozen=True)
class _PlanTold:
    """What shadows and echoes tell of a plan.

    Parameters
    ----------
    fit : PlanFit
        Solved for what both tell.
    support : ndarray, shape (720,)
        The plan.
    spread_m : float
        How far the sides of shadows scatter about a plan of their own, m.
    apart, beyond, short : (ndarray, ndarray)
        Directions, and how far opposite views see sides apart (`opposed_sides`); how far outside of the plan
        echo or shadow tell them; how far inside of it shadows do (`sides_beyond`), cells.
    """

    fit: PlanFit
    support: FloatArray
    spread_m: float
    apart: tuple[FloatArray, FloatArray]
    beyond: tuple[FloatArray, FloatArray]
    short: tuple[FloatArray, FloatArray]

    def doubts_m(
        self, plan: Rectangle, cell_m: float, aperture_rad: float
    ) -> list[tuple[float, float, float]]:
        """Return by how much length and width are in doubt to both sides, downwards, and upwards, m."""
        doubts = []
        for face in (plan.heading_rad, plan.heading_rad + math.pi / 2.0):
            both = doubt_cells(*self.apart, face, aperture_rad)
            less, more = (reach_cells(*told, face, aperture_rad) for told in (self.short, self.beyond))
            doubts.append((both * cell_m, less * cell_m, more * cell_m))
        return doubts


def _plan_told(agreed: list[SilhouetteSides], by_shadows: FloatArray, grid: VoxelGrid) -> _PlanTold | None:
    """Fit the plan to what shadows and echoes tell (as `agreed_sides` returns it); None of too few sides."""
    fit = PlanFit(agreed, grid, by_shadows)
    if fit.count < MIN_EDGES:
        return None
    support = fit.solve()
    # Shadows alone tell whether there is one plan: echoes would hide that they do not agree.
    spread_m = fit.spread_m
    apart = opposed_sides(agreed, np.where(fit.kept, by_shadows, np.nan))
    by_echoes = _with_echoes(by_shadows, agreed)
    if (by_echoes != by_shadows).any():
        # An echo far outside of what was carved may be the seabed's: it is a doubt, and moves no side.
        near = PlanFit(agreed, grid, by_echoes).kept
        fit = PlanFit(agreed, grid, np.where(near, by_echoes, by_shadows))
        support = fit.solve()
    # A slope's echo does not spread: what is moved out may lie as far out as it is seen.
    cell_m = np.array([side.info.resolution_m[1] for side in agreed for _ in side.direction_rad])
    farthest = by_echoes + np.where(by_echoes > by_shadows, _ECHO_SPREAD_CELLS * cell_m, 0.0)
    beyond = sides_beyond(agreed, fit.outside_m(support, farthest))
    short = sides_beyond(agreed, -fit.outside_m(support, by_shadows))
    return _PlanTold(fit, support, spread_m, apart, beyond, short)


def measure_object(
    grid: VoxelGrid, mesh: trimesh.Trimesh, sides: Sequence[SilhouetteSides], *, seed: int = 0
) -> Dimensions:
    """Measure the carved object, with 95 % intervals.

    Parameters
    ----------
    grid : VoxelGrid
        Carved grid with an object.
    mesh : trimesh.Trimesh
        Its surface.
    sides : sequence of SilhouetteSides
        Of all views; few or none: the surface alone is measured, without intervals.
    seed : int
        Of the resampling.

    Returns
    -------
    Dimensions
        Length, width, heading and position of the plan, from the silhouettes (from the surface where their
        sides scatter by more than a cell about the best plan); height from the shadows' lengths or from both
        their ends if the views agree on one, otherwise from the carved layers; volume of the surface.
        Intervals of length and width come from resampling the views in blocks of an aperture (neighbours
        share their looks), with the error of an edge (0.8 of a cross-range cell) added in quadrature.
        Height and volume have none where the shadows of all but two views leave the image.

    Notes
    -----
    Volume is that of the shadow hull, whose hollows no shadow shows: its interval is that of the hull.
    """
    whole = measure(mesh)
    sides, by_shadows = agreed_sides(sides, grid)
    told = _plan_told(sides, by_shadows, grid)
    if told is None:
        return whole
    fit = told.fit
    smallest = _rectangle(told.support, fit.centre)
    plan = fit.plan(smallest)
    grazing = float(np.median([side.info.camera.grazing_rad for side in sides]))
    resampled = _resampled(fit, plan, sides, seed)
    down, across = (float(np.median([s.info.resolution_m[axis] for s in sides])) for axis in (0, 1))
    edge = _EDGE_CELLS * across
    d = grid.volume.voxel_size_m
    if told.spread_m > ONE_PLAN_CELLS * across:
        # No one plan has these sides, as where each view lies at a place of its own: the voxels, which a few
        # views do not move, are what all agree on.
        solid = _without_thin_parts(grid, _THIN_CELLS * across)
        plan = _rectangle(_voxel_support(solid, fit.directions), np.zeros(2))
    aperture = float(np.median([side.info.aperture_rad for side in sides]))
    intervals = _plan_intervals(plan, smallest, resampled, edge, told.doubts_m(plan, across, aperture))
    cap = cap_of(grid, grazing, HOLE_CELLS * across, down * math.tan(grazing), across)
    sigma, above = math.hypot(d / 2.0, down * math.tan(grazing)), 0.0
    measured = replace(
        whole,
        length_m=plan.length_m,
        width_m=plan.width_m,
        heading_rad=plan.heading_rad,
        position_m=plan.position_m,
        hull_top_m=cap.top_m,
    )
    contours = [(side.info, side.contour) for side in sides if side.contour is not None]
    contour = contour_height(contours, measured.position_m, cap.top_m)
    tops = [cap.begins_m] if contour is None else [cap.begins_m, contour.height_m]
    height = upright_height(sides, measured, tops, sigma, d)
    if height is None and contour is not None:
        height, sigma = contour.height_m, math.hypot(contour.sigma_m, d / 2.0)
    elif height is None:
        # Flat or round: half-way. The true top lies anywhere in the cap, or where half of the views end.
        standing = standing_height(sides, measured, grid, sigma)
        # Views that lay beside one another do so down-range too: half keep more of a top for that alone.
        share = 0.0 if any(side.shift_m for side in sides) else TIP_SHARE
        height = standing or cap_height(cap, down * math.tan(grazing), share)
        sigma = math.hypot(sigma, max(cap.half_m - height, height - cap.begins_m, 0.0) / _SIGMAS_95)
        above = cap.apex_m - height if standing is None and cap.apex_m > height else 0.0
    if sum(not side.cut for side in sides) >= LEAST_ENDS:
        half = _SIGMAS_95 * sigma
        intervals["height_m"] = (max(0.0, height - half), height + math.hypot(half, above))
        # A surface that lies wrong by one error everywhere.
        change = float(mesh.area) * math.hypot(edge / 2.0, d / 4.0)
        intervals["volume_m3"] = (max(0.0, whole.volume_m3 - change), whole.volume_m3 + change)
    return replace(measured, height_m=height, intervals=intervals, scatter_cells=told.spread_m / across)


def sides_apart(sides: Sequence[SilhouetteSides], grid: VoxelGrid) -> tuple[float, float]:
    """Return the shares of a body's sides that are seen at different places.

    Parameters
    ----------
    sides : sequence of SilhouetteSides
        Of all views.
    grid : VoxelGrid
        What was carved of them.

    Returns
    -------
    opposed : float
        Share that opposite views see apart (`opposed_sides`).
    beside : float
        Share that shadow or echo tell beside the plan (`sides_beyond`).
    """
    agreed, by_shadows = agreed_sides(sides, grid)
    told = _plan_told(agreed, by_shadows, grid)
    beside = 0.0 if told is None else apart_share(np.fmax(told.beyond[1], told.short[1]))
    return apart_share(opposed_sides(agreed, by_shadows)[1]), beside


def _plan_intervals(
    plan: Rectangle,
    smallest: Rectangle,
    resampled: Sequence[Rectangle],
    edge_m: float,
    doubts_m: Sequence[tuple[float, float, float]],
) -> dict[str, tuple[float, float]]:
    """Return the 95 % intervals of a plan by its resamplings, an edge's error, and what views see apart.

    And by how far it is from the smallest rectangle round the best convex plan: which of the two is right is
    not known. And by what shadow or echo tell beside the plan, to that side alone.
    """
    intervals = {}
    for name, (doubt, less, more) in zip(("length_m", "width_m"), doubts_m, strict=True):
        value = getattr(plan, name)
        sigma = math.hypot(float(np.std([getattr(r, name) for r in resampled])), edge_m)
        half = math.hypot(_SIGMAS_95 * sigma, doubt, value - getattr(smallest, name))
        intervals[name] = (max(0.0, value - math.hypot(half, less)), value + math.hypot(half, more))
    for axis, name in enumerate(("position_x_m", "position_y_m")):
        sigma = math.hypot(float(np.std([r.position_m[axis] for r in resampled])), edge_m / 2.0)
        value = plan.position_m[axis]
        intervals[name] = (value - _SIGMAS_95 * sigma, value + _SIGMAS_95 * sigma)
    turns = [math.remainder(r.heading_rad - plan.heading_rad, math.pi) for r in resampled]
    sigma = math.hypot(float(np.sqrt(np.mean(np.square(turns)))), edge_m / plan.length_m)
    heading = plan.heading_rad
    intervals["heading_rad"] = (heading - _SIGMAS_95 * sigma, heading + _SIGMAS_95 * sigma)
    return intervals


def doubted(found: Dimensions, share: float) -> Dimensions:
    """Widen the intervals of an object that does not explain its shadows.

    Parameters
    ----------
    found : Dimensions
        Its measures.
    share : float
        Share of the shadow that it leaves unexplained, and of its own that is lit in the views.

    Notes
    -----
    Resampling the views shows what is random. Shadow that the object does not cast may be that of a part that
    it lacks, and each measure so much larger; shadow that is lit in the views, that of a part that is not
    there.

    Examples
    --------
    >>> box = Dimensions(1.0, 0.5, 0.2, 0.1, 0.0, (0.0, 0.0), intervals={"length_m": (0.9, 1.1)})
    >>> [round(float(end), 3) for end in doubted(box, 0.2).intervals["length_m"]]
    [0.7, 1.3]
    """
    sizes = {name: getattr(found, name) for name in ("length_m", "width_m", "height_m", "volume_m3")}
    more = {name: share * size for name, size in sizes.items()}
    more |= dict.fromkeys(("position_x_m", "position_y_m"), share * found.length_m / 2.0)
    intervals = {}
    for name, (low, high) in found.intervals.items():
        lower = low - more.get(name, 0.0)
        intervals[name] = (max(0.0, lower) if name in sizes else lower, high + more.get(name, 0.0))
    return replace(found, intervals=intervals)


def _resampled(
    fit: PlanFit, plan: Rectangle, sides: Sequence[SilhouetteSides], seed: int
) -> list[Rectangle]:
    """Fit the plan to views drawn again and again, in blocks of an aperture."""
    rng = np.random.default_rng(seed)
    aperture = max(float(np.median([s.info.aperture_rad for s in sides])), 1e-3)
    block = np.floor(np.array([s.info.aspect_rad % TWO_PI for s in sides]) / aperture).astype(np.intp)
    names, block = np.unique(block, return_inverse=True)
    out = []
    for _ in range(_RESAMPLINGS):
        drawn = np.bincount(rng.integers(0, len(names), len(names)), minlength=len(names))
        share = drawn[block][fit.view_of].astype(np.float64)
        out.append(fit.resampled(share, plan))
    return out


__all__ = [
    "PlanFit",
    "SilhouetteSides",
    "doubted",
    "levels_of_mask",
    "measure_object",
    "shadow_height",
    "sides_apart",
    "silhouette_sides",
    "upright_height",
]
