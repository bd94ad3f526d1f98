"""The consumer of all views: it carves, and states the result.

`pipeline.run`, runs from views or sectors, and node `voxel_carver` all feed a `Reconstruction`, view by view,
in any order, whole views or the parts of one as they come. Sums are of whole numbers, and what is measured
goes by the views' stamps: whoever feeds the same views gets the same result.
"""

from __future__ import annotations

import copy
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import ViewError
from .geometry import SCENE_FRAME, View, ViewInfo
from .geometry.arcs import Arc, Arcs
from .imaging.composites import Composites
from .imaging.likelihood import Levels
from .imaging.mask_codes import MASK_SHADOW
from .imaging.masks import KeptMask
from .imaging.segmentation import require_silhouette
from .parameters import PipelineParameters
from .search.decision import Decision
from .search.pieces import APART_CELLS, is_same_body, objects_of, without_neighbours
from .shape.alignment import SCATTER_CELLS, shifts_across
from .shape.carving import Carver, compared_shadows
from .shape.explained import ShadowFit, mean_fit
from .shape.hollows import EchoLook, matter_mesh, matter_of
from .shape.measurement import (
    SilhouetteSides,
    doubted,
    levels_of_mask,
    measure_object,
    shadow_height,
    silhouette_sides,
)
from .shape.mesh import Dimensions, measure, mesh_from_grid
from .shape.result import LeftOut, ObjectResult, Result, ViewEvidence
from .shape.verdict import judge
from .shape.volume import Target, VoxelGrid
from .threads import in_order

if TYPE_CHECKING:
    import trimesh

    from .pipeline import ProcessedView

Item = TypeVar("Item", float, View)

#: What of a view can be taken in: by which the target is carved, measured, and its hollows told.
PARTS = ("likelihood", "mask", "levels", "sides", "look")
#: Views that wait for their silhouette at most, where it comes apart from them: twice the largest window.
_WAITING = 16


class Body:
    """One body during carving.

    Parameters
    ----------
    target : Target
        Its volume.
    parameters : PipelineParameters
        Of all stages.
    compare : bool
        Carve by the other method too (figure 8).
    judged : bool
        Keep the silhouettes by which the result is judged, also where the carver keeps none.
    """

    def __init__(
        self,
        target: Target,
        parameters: PipelineParameters,
        *,
        compare: bool = False,
        judged: bool = False,
        pool: ThreadPoolExecutor | None = None,
    ) -> None:
        p = parameters.carving
        volume = target.volume(p.voxel_size_m)
        self.target = target
        self.carver = Carver(volume, p, pool=pool)
        self.other = Carver(volume, p.other(), pool=pool) if compare else None
        self.infos: dict[int, ViewInfo] = {}
        self.levels: dict[int, tuple[float, float, bool]] = {}
        self.sides: dict[int, SilhouetteSides | None] = {}
        self.looks: dict[int, EchoLook] = {}
        #: Why the first view that was not usable was not.
        self.refused = ""
        self._masks: dict[int, KeptMask] = {}
        self._shows = judged and not self.carver.keeps_masks
        #: Silhouettes by which the result is judged, where the carver keeps none.
        self._shown: dict[int, KeptMask] = {}
        self._waiting: OrderedDict[int, Levels] = OrderedDict()

    def add(self, view: ProcessedView, parts: Collection[str]) -> bool:
        """Add parts of a view; say whether it is new to the grid.

        Raises
        ------
        ViewError
            If the grid cannot take it; whatever else of it is there is kept.
        """
        likelihood = view.likelihood if "likelihood" in parts else None
        mask = view.mask if "mask" in parts else None
        levels = view.levels if "levels" in parts else None
        info = next((one.info for one in (mask, likelihood, view.shadow) if one is not None), None)
        if info is None:
            return False
        stamp = info.stamp_ns
        if levels is not None:
            self.infos.setdefault(stamp, info)
            self.levels[stamp] = (levels.seabed_level, levels.contrast, levels.estimated)
            if "look" in parts and view.look is not None:
                self.looks[stamp] = view.look
        if mask is not None or levels is not None:
            self._take_sides(stamp, view, mask, levels)
        if self._shows and mask is not None and stamp not in self._shown:
            self._shown[stamp] = KeptMask.of(mask)
        fresh, errors = False, []
        for carver in (self.carver, self.other):
            pixels = None if carver is None else mask if carver.parameters.takes_masks else likelihood
            if carver is None or pixels is None:
                continue
            try:
                if carver.parameters.takes_masks:
                    require_silhouette(pixels)
                fresh |= carver.integrate(pixels) and carver is self.carver
            except ViewError as error:
                errors += [error] if carver is self.carver else []
        if errors:
            raise errors[0]
        if fresh:
            self.infos.setdefault(stamp, info)
        return fresh

    def _take_sides(self, stamp: int, view: ProcessedView, mask: View | None, levels: Levels | None) -> None:
        """Measure a silhouette's sides once both it and the view's levels are here, whichever comes first."""
        if self.sides.get(stamp) is not None:
            return
        if mask is not None and levels is not None:
            self.sides[stamp] = view.sides
        elif mask is not None and (known := self._waiting.pop(stamp, None)) is not None:
            self.sides[stamp] = silhouette_sides(known, mask, self.target.position_m)
        elif mask is not None:
            self._masks[stamp] = KeptMask.of(mask)
        elif levels is not None and (kept := self._masks.pop(stamp, None)) is not None:
            self.sides[stamp] = silhouette_sides(levels, kept.view(), self.target.position_m)
        elif levels is not None:
            self._waiting[stamp] = levels
            while len(self._waiting) > _WAITING:
                self._waiting.popitem(last=False)

    def shape(self) -> tuple[VoxelGrid, VoxelGrid | None]:
        """Return the carved grid, and the other method's if requested.

        Thin and faint bodies are too little for silhouettes and still darken the mean of all views, by which
        the search finds them. Where silhouettes leave nothing, that mean tells what is there.
        """
        other = self.other.grid() if self.other is not None and self.other.stamps else None
        return self._told(self.carver.grid(), other)

    def beside(
        self, alone: tuple[VoxelGrid, VoxelGrid | None], others: Sequence[VoxelGrid]
    ) -> tuple[VoxelGrid, VoxelGrid | None]:
        """Return `shape` again, given `alone` and the other bodies."""
        own, other = self._own_first(alone)
        return self._told(self.carver.beside(own, others), other)

    def given_back(
        self, carved: tuple[VoxelGrid, VoxelGrid | None], others: Sequence[VoxelGrid]
    ) -> tuple[VoxelGrid, VoxelGrid | None]:
        """Return what was carved with what only lit pixels on its own plan took (`Carver.given_back`).

        Where that still leaves most of its shadow unexplained, the mean likelihood tells what is there; or
        what carving leaves on its plan, if that fits the shadows better (`Carver.on_plan_of`).
        """
        own, other = self._own_first(carved)
        told = self._told(self.carver.given_back(own, others), other, others)
        if (told[0].occupied.any() and told[0] is not other) or not self.carver.keeps_masks:
            return told
        mended = self.carver.on_plan_of(self.target, told[0], others)
        return told if mended is None else (mended, other)

    def _own_first(
        self, told: tuple[VoxelGrid, VoxelGrid | None]
    ) -> tuple[VoxelGrid, VoxelGrid | None]:
        grid, other = told
        if other is not None and grid.method != self.carver.parameters.method:
            return other, grid
        return grid, other

    def _told(
        self, own: VoxelGrid, other: VoxelGrid | None, others: Sequence[VoxelGrid] | None = None
    ) -> tuple[VoxelGrid, VoxelGrid | None]:
        """Put the grid first that tells the body; once the other bodies are known, by what both explain."""
        if not self.carver.parameters.takes_masks or other is None or not other.occupied.any():
            return own, other
        lost = not own.occupied.any() if others is None else self.carver.lost(own, other, others)
        return (other, own) if lost else (own, other)

    def shadow_fits(self, grids: Sequence[VoxelGrid]) -> dict[int, ShadowFit]:
        """Compare the silhouettes with bodies' shadows, its own first, by stamp, whatever carved them."""
        if self.carver.keeps_masks:
            return self.carver.shadow_fits(grids)
        used = {stamp: kept for stamp, kept in self._shown.items() if stamp in self.carver.stamps}
        return compared_shadows(used, grids)

    def moved_back(self, shifts_m: Mapping[int, float]) -> Body:
        """Return the body as its views show it once those that lie beside their place are put back."""

        def back(info: ViewInfo) -> ViewInfo:
            return info.moved_back(shifts_m.get(info.stamp_ns, 0.0))

        moved = copy.copy(self)
        moved.carver = self.carver.moved_back(shifts_m)
        moved.infos = {stamp: back(info) for stamp, info in self.infos.items()}
        moved.looks = {stamp: replace(look, info=back(look.info)) for stamp, look in self.looks.items()}
        moved.sides = {side.info.stamp_ns: side.moved_back(shifts_m) for side in self.known_sides()}
        moved._masks = {}
        return moved

    def known_sides(self) -> list[SilhouetteSides]:
        """Return the sides of the views in the grid; of a silhouette that came alone it tells them itself."""
        for stamp, kept in self._masks.items():
            mask = kept.view()
            self.sides[stamp] = silhouette_sides(levels_of_mask(mask), mask, self.target.position_m)
        return [s for stamp, s in sorted(self.sides.items()) if s is not None and stamp in self.carver.stamps]


def _measured(
    grid: VoxelGrid, sides: Sequence[SilhouetteSides], *, final: bool
) -> tuple[trimesh.Trimesh | None, Dimensions | None]:
    """Extract a grid's surface and measure it; with intervals once no more views are to come."""
    if not grid.occupied.any():
        return None, None
    mesh = mesh_from_grid(grid)
    found = measure_object(grid, mesh, sides) if final else measure(mesh)
    return mesh, found.rounded(grid.volume.voxel_size_m)


def _doubted(found: Dimensions, fits: Mapping[int, ShadowFit], grid: VoxelGrid) -> Dimensions:
    """Widen intervals by the shares of shadow that an object leaves unexplained, or casts on lit seabed."""
    mean = mean_fit(fits.values())
    share = float(np.nansum([mean.unexplained, mean.lit]))
    return doubted(found, share).rounded(grid.volume.voxel_size_m)


class Reconstruction:
    """A scene during the arrival of its views.

    Parameters
    ----------
    decision : Decision
        What is carved.
    parameters : PipelineParameters
        Of all stages.
    compare : bool
        Carve the target by the other method too.
    compose : bool
        Add views to the images of the circle.
    run_ns : int, optional
        The run's name: the stamp of its track's first pose.
    pool : ThreadPoolExecutor, optional
        Carve the lower and the upper half of a volume at the same time.
    """

    def __init__(
        self,
        decision: Decision,
        parameters: PipelineParameters | None = None,
        *,
        compare: bool = True,
        compose: bool = True,
        run_ns: int | None = None,
        pool: ThreadPoolExecutor | None = None,
    ) -> None:
        p = self.parameters = parameters or PipelineParameters()
        self.decision, self.run_ns = decision, run_ns
        self.bodies: list[Body] = []
        if decision.target is not None:
            self.bodies = [Body(decision.target, p, compare=compare, judged=True, pool=pool)]
            self.bodies += [Body(other, p, pool=pool) for other in decision.others]
        self.arcs = Arcs()
        self.rejected: dict[float, str] = {}
        self.composites: Composites | None = None
        self.timings_s: dict[str, float] = {}
        #: Frame of the run; None before the first view, where no decision says it.
        self.frame = decision.frame
        #: Views that were lost on their way here, as a source has said.
        self.views_lost = 0
        self._compose = compose
        self._best: tuple[int, View | None] = (-1, None)

    @property
    def stamps(self) -> set[int]:
        """Stamps of the views in the target's grid."""
        return self.bodies[0].carver.stamps if self.bodies else set()

    def parts_of(self, number: int) -> tuple[str, ...]:
        """Return the parts of a view that a body needs; only the target needs those for hollows."""
        taken = "mask" if self.parameters.carving.takes_masks else "likelihood"
        return PARTS if number == 0 else tuple(dict.fromkeys((taken, "mask", "levels", "sides")))

    def add(self, view: ProcessedView, body: int = 0, parts: Collection[str] = PARTS) -> bool:
        """Add a view, or some parts of one; say whether it is new to the body's grid.

        Raises
        ------
        ViewError
            If the body's grid cannot take it, or it is in another frame than the run.
        """
        own = self.bodies[body]
        if view.info is not None:
            self._require_frame(view.info)
        fresh = own.add(view, parts)
        pixels = view.mask if "mask" in parts else view.likelihood
        if fresh and body == 0 and pixels is not None:
            half = pixels.info.aperture_rad / 2.0
            self.arcs.add(Arc(pixels.info.aspect_rad - half, 2.0 * half))
        return fresh

    def _require_frame(self, info: ViewInfo) -> None:
        if self.frame is None:
            self.frame = info.frame
        if info.frame != self.frame:
            raise ViewError(
                f"view stamped {info.stamp_ns} ns is in frame {info.frame!r}; expected that of the run,"
                f" {self.frame!r}"
            )

    def settle(self, decision: Decision) -> None:
        """Replace a provisional decision by the whole run's, for the same volumes."""
        self.decision = decision

    def refuse(self, aspect_rad: float, reason: str) -> None:
        """Record a view that could not be used."""
        self.rejected[round(math.degrees(aspect_rad), 6)] = reason

    def feed(
        self,
        items: Iterable[Item],
        make: Callable[[Item], list[ProcessedView]],
        total: int = 0,
        *,
        progress: Callable[[int, int], None] | None = None,
        on_view: Callable[[ProcessedView], None] | None = None,
        workers: int = 2,
    ) -> int:
        """Process views in threads and add them in order.

        Parameters
        ----------
        items : iterable of float or View
            Aspects (rad), or views.
        make : callable
            Takes one of them and gives the view for each body, the target's first.
        total : int
            How many there are, for `progress`; 0: unknown.
        progress, on_view : callable, optional
            Called with (done, in all), and with every view of the target that was processed.
        workers : int
            Threads.

        Returns
        -------
        int
            How many items there were.
        """
        began = time.perf_counter()

        def ready(item: Item) -> list[ProcessedView | ViewError] | ViewError:
            try:
                views: list[ProcessedView] = make(item)
                first: ProcessedView | ViewError = _made(views[0], self.parts_of(0))
                return [first, *(self._made_or_not(n, view) for n, view in enumerate(views[1:], start=1))]
            except ViewError as error:
                return error

        done = 0
        for done, (item, made) in enumerate(in_order(ready, items, workers), start=1):
            aspect = item.info.aspect_rad if isinstance(item, View) else item
            if isinstance(made, ViewError):
                self.refuse(aspect, str(made))
            else:
                self._take(made, aspect)
                if self.bodies and not isinstance(made[0], ViewError):
                    self._keep_best(made[0])
                    if on_view:
                        on_view(made[0])
            if progress:
                progress(done, max(total, done))
        self.timings_s["views"] = time.perf_counter() - began
        return done

    def _keep_best(self, view: ProcessedView) -> None:
        """Keep the view in which the target's shadow covers the most ground."""
        shown = view.shadow or view.likelihood or view.mask
        shadow = 0 if view.mask is None else int(np.count_nonzero(view.mask.pixels == MASK_SHADOW))
        if shown is not None and shadow > self._best[0]:
            self._best = (shadow, shown)

    def _made_or_not(self, number: int, view: ProcessedView) -> ProcessedView | ViewError:
        try:
            return _made(view, self.parts_of(number))
        except ViewError as error:
            return error

    def _take(self, views: list[ProcessedView | ViewError], aspect_rad: float) -> None:
        first = views[0]
        if self._compose and not isinstance(first, ViewError):
            self.compose(first.sub_aperture or first.shadow)
        for number, view in enumerate(views if self.bodies else ()):
            try:
                if isinstance(view, ViewError):
                    raise view
                self.add(view, number, self.parts_of(number))
            except ViewError as error:
                body = self.bodies[number]
                body.refused = body.refused or str(error)
                if number == 0:
                    self.refuse(aspect_rad, str(error))

    def add_others(self, views: Sequence[ProcessedView]) -> None:
        """Add a view for all bodies except the target, which receives its own separately."""
        for number, view in enumerate(views[: len(self.bodies)]):
            if number:
                try:
                    self.add(view, number, self.parts_of(number))
                except ViewError as error:
                    self.bodies[number].refused = self.bodies[number].refused or str(error)

    def compose(self, view: View | None) -> None:
        """Add a view to the images of the circle."""
        if view is None:
            return
        if self.composites is None:
            self.composites = Composites.for_view(view)
        self.composites.integrate(view)

    def result(self, *, final: bool = True) -> Result:
        """Return the result so far.

        Parameters
        ----------
        final : bool
            Whether no more views are to come. Until then carving looks once, and nothing is said of
            intervals, hollows and further bodies: a few ms instead of a second.

        Notes
        -----
        Views that lie beside one another across range are put together and carved again (`alignment`).
        """
        result = self._result(final=final)
        shifts_m = self._shifts_across(result)
        return self._moved_back(shifts_m)._result(final=final) if shifts_m else result

    def _shifts_across(self, result: Result) -> dict[int, float]:
        """Return how far each view lies beside its place, by stamp; empty where the sides bound one plan."""
        found = result.dimensions
        if found is None or result.grid is None or not found.scatter_cells > SCATTER_CELLS:
            return {}
        return shifts_across(result.sides, result.grid) if self.bodies[0].carver.keeps_masks else {}

    def _moved_back(self, shifts_m: Mapping[int, float]) -> Reconstruction:
        """Return the same scene from views of which those that lie beside their place are put back."""
        moved = copy.copy(self)
        moved.bodies = [
            body.moved_back(shifts_m) if body.carver.keeps_masks else body for body in self.bodies
        ]
        return moved

    def _result(self, *, final: bool) -> Result:
        """Return the result so far, each view where it lies."""
        began = time.perf_counter()
        result = Result(
            run_ns=self.run_ns,
            stamp_ns=max(self.stamps, default=0),
            final=final,
            target=self.decision.target,
            decision=self.decision,
            sign=self.decision.sign,
            composites=self.composites,
            views_used=len(self.stamps),
            views_lost=self.views_lost,
            arc_rad=self.arcs.covered_rad,
            rejected=dict(self.rejected),
            left_out=list(self.decision.left_out),
            detectable=self.decision.detectable,
            timings_s=dict(self.timings_s),
            best_shadow=self._best[1],
            frame=self.frame or SCENE_FRAME,
        )
        shapes, rest = self._shapes() if final else {}, None
        if self.stamps:
            body = self.bodies[0]
            if final:
                (result.grid, result.other_grid), rest = self._without_neighbours(shapes[0])
            else:
                result.grid = body.carver.first_look()
            result.timings_s["carve"] = time.perf_counter() - began
            if not final:
                result.mesh, result.dimensions = _measured(result.grid, (), final=False)
            else:
                looks = _over_seabed(result.grid, body.looks.values())
                result.looks = {look.info.stamp_ns: look for look in looks}
                with ThreadPoolExecutor(1) as pool:  # hollows and measures do not depend on each other
                    matter = pool.submit(_timed, result, "hollows", matter_of, result.grid, looks)
                    self._measure(result, body)
                    self._open_hollows(result, matter.result())
                result.timings_s["shape"] = time.perf_counter() - began - result.timings_s["carve"]
        if final and (len(self.bodies) > 1 or rest is not None):
            since = time.perf_counter()
            for number, body in enumerate(self.bodies[1:], start=1):
                self._add_objects(result, body, shapes[number][0] if number in shapes else None)
            self._add_neighbours(result, rest)
            result.timings_s["objects"] = time.perf_counter() - since
        if final and result.objects and self.stamps:
            since = time.perf_counter()
            self._compare_shadows(result)
            result.timings_s["compare"] = time.perf_counter() - since
        judge(result)
        return result

    @staticmethod
    def _measure(result: Result, body: Body) -> None:
        """Give the result the target's surface and measures, and what each view told."""
        if result.grid is None:
            return
        result.sides = _over_seabed(result.grid, body.known_sides())
        result.mesh, result.dimensions = _measured(
            result.grid, () if result.by_likelihood_alone else result.sides, final=True
        )
        shifts_m = {side.info.stamp_ns: side.shift_m for side in result.sides}
        heights = {}
        if (found := result.dimensions) is not None:
            heights = {side.info.stamp_ns: shadow_height(side, found) for side in result.sides}
        for stamp, info in sorted(body.infos.items()):
            level, contrast, estimated = body.levels.get(stamp, (math.nan, math.nan, False))
            x, y, z = map(float, info.camera.sonar_m)
            result.evidence[stamp] = ViewEvidence(
                stamp,
                info.aspect_rad,
                (x, y, z),
                level,
                contrast,
                estimated,
                heights.get(stamp, math.nan),
                shift_m=shifts_m.get(stamp, 0.0),
            )

    def _compare_shadows(self, result: Result) -> None:
        """Note how well what was found explains each view; what it does not widens intervals."""
        if result.grid is None:
            return
        grids = [result.grid, *(one.grid for one in result.further)]
        fits = self.bodies[0].shadow_fits(grids)
        for stamp, fit in fits.items():
            if stamp in result.evidence:
                told = replace(result.evidence[stamp], unexplained=fit.unexplained, lit=fit.lit)
                result.evidence[stamp] = told
        if result.dimensions is not None:
            result.dimensions = _doubted(result.dimensions, fits, result.grid)
        bodies = {id(body.target): body for body in self.bodies[1:]}
        for place, one in enumerate(result.further):
            body = bodies.get(id(one.target))
            if body is not None and one.dimensions.intervals:
                fits = body.shadow_fits([one.grid, *(grid for grid in grids if grid is not one.grid)])
                result.further[place] = replace(one, dimensions=_doubted(one.dimensions, fits, one.grid))

    @staticmethod
    def _open_hollows(result: Result, matter: NDArray[np.bool_]) -> None:
        """Tell the matter in a result's grid from hollows that no shadow shows; the grid stays as it is."""
        if result.grid is None or result.mesh is None or not result.looks:
            return
        result.matter = matter
        hollow = bool((result.grid.occupied & ~matter).any())
        result.matter_mesh = matter_mesh(result.grid, matter) if hollow else result.mesh

    def _shapes(self) -> dict[int, tuple[VoxelGrid, VoxelGrid | None]]:
        """Return the grid of each body by its number, and by the other method where it was asked for.

        Where there are several objects each is carved again without what the others' echoes may cover. What a
        body's own echo may have taken comes back once the others are known.
        """
        usable = {n: body for n, body in enumerate(self.bodies) if body.carver.stamps}
        shapes = {n: body.shape() for n, body in usable.items()}
        if 0 in shapes:
            shapes[0] = self._without_neighbours(shapes[0])[0]
        objects: dict[int, list[VoxelGrid]] = {}
        for n, (grid, _) in shapes.items():
            told = [one for found in objects.values() for one in found]
            objects[n] = objects_of(grid, self.bodies[n].target.position_m, told)[0] if n else [grid]
        # What is lost or falls to pieces comes first: where it is mended, it is one more body for the others.
        whole = [n for n, found in objects.items() if any(one is shapes[n][0] for one in found)]
        lost = [n for n in shapes if n not in whole and not self._told_before(shapes[n][0], objects, n)]
        for n in lost + whole:
            others = [one for m, found in objects.items() if m != n for one in found]
            again = usable[n].beside(shapes[n], others) if others else shapes[n]
            again = usable[n].given_back(again, others)
            if n not in whole:
                mended = objects_of(again[0], self.bodies[n].target.position_m, others)[0]
                if not (len(mended) == 1 and mended[0] is again[0]):
                    continue  # shadows of others would ask for ever more of it
                objects[n] = mended
            shapes[n] = again
        return shapes

    @staticmethod
    def _told_before(grid: VoxelGrid, objects: Mapping[int, Sequence[VoxelGrid]], number: int) -> bool:
        """Say whether what was carved for a body is, or holds, another body."""
        others = [one for n, found in objects.items() if n != number for one in found]
        return not objects[number] and any(is_same_body(grid, one) for one in others)

    def _without_neighbours(
        self, told: tuple[VoxelGrid, VoxelGrid | None]
    ) -> tuple[tuple[VoxelGrid, VoxelGrid | None], VoxelGrid | None]:
        """Leave of the target's grid the one body that it is for; return the rest too, if there is any."""
        body = self.bodies[0]
        cell = float(np.median([info.resolution_m[1] for info in body.infos.values()]))
        given = math.isnan(body.target.evidence)
        place = body.target.position_m if given else None
        grid, rest = without_neighbours(told[0], APART_CELLS * cell, place)
        return (grid, told[1]), rest

    @staticmethod
    def _add_objects(result: Result, body: Body, whole: VoxelGrid | None) -> None:
        """Add what a further body turned out to be, without what was reported before it."""
        place = body.target.position_m
        if whole is None:
            result.left_out.append(LeftOut(place, f"no view of it was usable: {body.refused}"))
            return
        found, left_out = objects_of(whole, place, [o.grid for o in result.objects])
        result.left_out += left_out
        for grid in found:
            if grid is not whole:
                _add_piece(result, grid, body)
                continue
            mesh, dimensions = _measured(grid, _over_seabed(grid, body.known_sides()), final=True)
            if mesh is not None and dimensions is not None:
                views = len(body.carver.stamps)
                result.further.append(ObjectResult(body.target, grid, mesh, dimensions, views))

    def _add_neighbours(self, result: Result, rest: VoxelGrid | None) -> None:
        """Add what was carved in the target's volume, is not of it, and was not reported for another body."""
        body = self.bodies[0]
        # A place that was given asks for one body.
        if rest is None or math.isnan(body.target.evidence):
            return
        reported = [one.grid for one in result.objects]
        found, left_out = objects_of(rest, body.target.position_m, reported, cut=True)
        result.left_out += left_out
        for grid in found:
            _add_piece(result, grid, body)


def _add_piece(result: Result, grid: VoxelGrid, body: Body) -> None:
    """Add a piece of what was carved in a body's volume; the silhouettes, of the whole, tell it no sides."""
    mesh, dimensions = _measured(grid, (), final=True)
    box = grid.volume
    target = Target((box.centre_m[0], box.centre_m[1]), box.size_m)
    if mesh is not None and dimensions is not None:
        result.further.append(ObjectResult(target, grid, mesh, dimensions, len(body.carver.stamps)))


def _timed(result: Result, step: str, work: Callable[..., Any], *args: Any) -> Any:
    """Note how long a piece of work took."""
    began = time.perf_counter()
    done = work(*args)
    result.timings_s[step] = time.perf_counter() - began
    return done


def _made(view: ProcessedView, parts: Collection[str]) -> ProcessedView:
    """Make the parts of a view, in this thread."""
    for part in parts:
        getattr(view, part)
    return view


Kept = TypeVar("Kept", SilhouetteSides, EchoLook)


def _over_seabed(grid: VoxelGrid, kept: Iterable[Kept]) -> list[Kept]:
    """Give what was kept of views the sonar's height over the seabed that the grid was carved over."""
    slope = grid.seabed
    return [one if slope is None else replace(one, info=slope.corrected(one.info)) for one in kept]
