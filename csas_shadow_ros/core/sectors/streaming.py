"""Views while the vehicle still circles: sums sectors as they arrive, makes a view once it is complete.

A sector is one arc of the full-circle image, so its spectrum is one arc of the image's spectrum. `SectorSum`
adds that arc alone, so a view needs no more than the sectors that overlap its aperture, and what it is
made of does not change any more when others come: it is the view of the whole run, bit for bit. `Stream`
says which views can be made, and about which target: a provisional one while the circle is open, the
whole run's once it is closed. Where that makes a difference, everything is due again.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..errors import GeometryError, NoTargetError, ParameterError, ViewError
from ..geometry import TWO_PI, CoherentImage, GroundGrid, Track
from ..geometry.arcs import TOLERANCE_RAD, Arc, Arcs
from ..geometry.passage import passage
from ..geometry.pixels import check_finite_pixels
from ..imaging.subaperture import Spectrum, SubApertures
from ..kernels import kernel
from ..parameters import MAX_OBJECTS, PipelineParameters, SubApertureParameters, TargetParameters
from ..search.decision import Decision, decide_by_image
from ..shape.volume import Target, VoxelGrid
from .sector import LEAST_COSINE, Sector, same_grid, scene_of, unfit, unlike
from .sector_lattice import coefficients

if TYPE_CHECKING:
    from ..pipeline import ProcessedView
    from ..reconstruction import Reconstruction
    from ..shape.result import Result

#: Sectors share so much at their common edge that rounding leaves no bin to neither.
_EDGE_RAD = 1e-4
#: So much of a sector's energy may lie beyond its arc and be left out: nothing but rounding at the edge
#: itself; and -30 dB of sidelobes and rounded pixels half a sector further out.
_BEYOND_EDGE, _BEYOND_HALF = 1e-6, 1e-3
#: After a search that found nothing the next one waits for so much more arc.
_SEARCH_AGAIN_RAD = math.radians(30.0)


@kernel()
def _arc_of_box(
    box: NDArray[np.complex64],
    first: tuple[int, int],
    steps: tuple[float, float],
    low: float,
    high: float,
    whole: bool,
    out: NDArray[np.complex64],
) -> float:  # pragma: no cover
    """Return the energy of a box of the spectrum between two angles; add it to `out` unless that is empty."""
    rows, cols = out.shape
    cos_l, sin_l, cos_h, sin_h = math.cos(low), math.sin(low), math.cos(high), math.sin(high)
    cos_m, sin_m = math.cos((low + high) / 2.0), math.sin((low + high) / 2.0)
    energy = 0.0
    for i in range(box.shape[0]):
        ky = -(first[0] + i) * steps[0]
        for j in range(box.shape[1]):
            if not whole:
                kx = (first[1] + j) * steps[1]
                # An arc is narrower than half a turn: its middle is ahead.
                if (
                    cos_l * ky - sin_l * kx < 0.0
                    or cos_h * ky - sin_h * kx > 0.0
                    or cos_m * kx + sin_m * ky <= 0.0
                ):
                    continue
            value = box[i, j]
            energy += float(value.real) * float(value.real) + float(value.imag) * float(value.imag)
            if rows:
                out[(first[0] + i) % rows, (first[1] + j) % cols] += value
    return energy


def _cut(spectrum: NDArray[np.complex64], first: int, count: int, axis: int) -> NDArray[np.complex64]:
    """Return `count` bins from signed bin `first` on, along one axis of a spectrum in FFT order."""
    size, last = spectrum.shape[axis], first + count
    if first < 0 < last:
        parts = [slice(size + first, size), slice(0, last)]
    else:
        parts = [slice(first % size, first % size + count)]
    found = [spectrum[part] if axis == 0 else spectrum[:, part] for part in parts]
    return np.concatenate(found, axis) if len(found) > 1 else found[0]


def _on_scene(
    sector: Sector, scene: GroundGrid, box: NDArray[np.complex64], first: tuple[int, int], workers: int
) -> Sector:
    """Return a sector on the scene's lattice and on its carrier, by its coefficients there."""
    spectrum = np.zeros(scene.shape, np.complex64)
    _arc_of_box(box, first, (1.0, 1.0), 0.0, 0.0, True, spectrum)
    pixels = scipy.fft.ifft2(spectrum, norm="forward", overwrite_x=True, workers=workers)
    return replace(sector, pixels=pixels, grid=scene, carrier_rad_m=(0.0, 0.0))


def uncovered(arcs: Arcs, track: Track) -> list[Arc]:
    """Return the arcs of a track that no sector covers."""
    return [
        arc
        for arc in arcs.missing()
        if track.covered_fraction(arc.start_rad + arc.width_rad / 2.0, arc.width_rad) > 0.0
    ]


class SectorSum:
    """The full-circle spectrum, summed from sectors in any order.

    Parameters
    ----------
    workers : int
        Threads of the transforms.
    scene : GroundGrid, optional
        The full-circle image's lattice; by default what the first sector tells of it (`scene_of`).

    Notes
    -----
    Of each sector only its arc of the spectrum is added, and a little more at both ends: 1e-4 rad where its
    energy ends sharply, half its width where it does not. Every bin then gets at most two sectors of a
    partition, whose sum does not depend on their order. A sector whose energy lies elsewhere is added whole.

    One spectrum of the image's size is held, however many sectors come. A sector on a lattice of its own is
    taken to that spectrum's bins without an image of the scene's size in between (`sector_lattice`).
    """

    def __init__(self, workers: int = 2, *, scene: GroundGrid | None = None) -> None:
        self._workers = workers
        self._scene = scene
        #: The first sector, on the scene's lattice, without its pixels.
        self._first: Sector | None = None
        self._spectrum: Spectrum | None = None
        self.arcs = Arcs()
        #: Stamps of the sectors that are in.
        self.stamps: set[int] = set()
        #: The furthest that any sector reaches beyond its arc (rad).
        self.margin_rad = _EDGE_RAD

    @classmethod
    def of_image(cls, image: CoherentImage, workers: int = 2) -> SectorSum:
        """Take a full-circle image as the one sector that covers the circle."""
        total = cls(workers)
        blank = np.broadcast_to(np.complex64(0), image.grid.shape)
        whole = Sector(blank, image.grid, image.acoustics, image.stamp_ns, 0.0, TWO_PI, frame=image.frame)
        total._scene = image.grid
        total._first, total._spectrum = whole, Spectrum.of_image(image, workers)
        total.stamps.add(image.stamp_ns)
        total.arcs.add(Arc(0.0, TWO_PI))
        return total

    @property
    def newest_ns(self) -> int:
        """The latest stamp; 0 before the first sector."""
        return max(self.stamps, default=0)

    @property
    def spectrum(self) -> Spectrum:
        """The sum so far.

        Raises
        ------
        GeometryError
            If nothing has.
        """
        if self._spectrum is None:
            raise GeometryError("there are no sectors to sum; expected at least one")
        return self._spectrum

    @property
    def frame(self) -> CoherentImage:
        """The image's lattice and band, with empty pixels that take no memory."""
        first, scene = self._first, self._scene
        if first is None or scene is None:
            raise GeometryError("there are no sectors to sum; expected at least one")
        return CoherentImage(first.pixels, scene, first.acoustics, self.newest_ns, frame=first.frame)

    def image(self) -> CoherentImage:
        """Transform the sum back to the coherent image, stamped with the last sector's stamp."""
        frame = self.frame
        pixels = scipy.fft.ifft2(self.spectrum.values, norm="forward", workers=self._workers)
        rows, cols = frame.grid.shape
        return replace(frame, pixels=np.ascontiguousarray(pixels[:rows, :cols]))

    def add(self, sector: Sector, grazing_rad: float | None = None) -> Arc | None:
        """Add a sector.

        Parameters
        ----------
        sector : Sector
            The sector.
        grazing_rad : float, optional
            The track's mean grazing angle, where it is known: it tells whether a lattice folds its arc.

        Returns
        -------
        Arc or None
            The arc of the spectrum that it changed; None if a sector of its stamp is in already.

        Raises
        ------
        GeometryError
            If its band is not the first one's, its lattice folds its arc or covers less than the scene, its
            arc is no arc.
        ParameterError
            If a pixel is not finite.
        """
        if sector.stamp_ns in self.stamps:
            return None
        scene = self._check(sector, grazing_rad)
        pixels = np.ascontiguousarray(sector.pixels, np.complex64)
        empty = np.empty((0, 0), np.complex64)
        energy = _arc_of_box(pixels, (0, 0), (1.0, 1.0), 0.0, 0.0, True, empty) / pixels.size
        if not math.isfinite(energy):
            check_finite_pixels(f"sector at {sector.stamp_ns} ns", sector.pixels)
            raise ParameterError(f"energy of the sector at {sector.stamp_ns} ns is {energy}; expected less")
        if self._spectrum is None:
            shape = tuple(scipy.fft.next_fast_len(n) for n in scene.shape)
            blank = np.broadcast_to(np.complex64(0), scene.shape)
            self._scene, self._first = scene, replace(sector, pixels=blank, grid=scene)
            self._spectrum = Spectrum(np.zeros(shape, np.complex64), scene)
        arc = Arc(sector.aspect_rad - sector.aperture_rad / 2.0, sector.aperture_rad)
        margin = self._add(sector, arc, energy)
        self.stamps.add(sector.stamp_ns)
        self.arcs.add(arc)
        self.margin_rad = max(self.margin_rad, margin)
        return arc.widened(margin)

    def _check(self, sector: Sector, grazing_rad: float | None) -> GroundGrid:
        """Refuse a sector that cannot be of this sum; return the scene's lattice."""
        name = f"sector at {sector.stamp_ns} ns"
        if not 0.0 < sector.aperture_rad <= TWO_PI * (1.0 + 1e-9):
            raise GeometryError(
                f"{name} has aspect {math.degrees(sector.aspect_rad):g}° and aperture"
                f" {math.degrees(sector.aperture_rad):g}°; expected an arc of more than 0° and at most 360°"
            )
        first = self._first
        if first is not None and (differs := unlike(sector, first)):
            what, values = differs
            raise GeometryError(f"{name} has another {what} than the first, at {first.stamp_ns} ns: {values}")
        try:
            scene = self._scene or scene_of(sector)
        except GeometryError as error:
            raise GeometryError(f"{name}: {error}") from error
        if fault := unfit(sector, scene, grazing_rad):
            raise GeometryError(f"{name}: {fault}")
        return scene

    def _add(self, sector: Sector, arc: Arc, energy: float) -> float:
        """Add a sector's arc of the spectrum; return how far it reaches beyond the sector's."""
        values, steps, scene = self.spectrum.values, self.spectrum.step_rad_m, self.spectrum.grid
        half = arc.width_rad / 2.0
        narrow = arc.width_rad + 2.0 * half < math.pi
        if not (isinstance(sector.grid, GroundGrid) and same_grid(sector.grid, scene)):
            box, first = coefficients(sector, scene, self._workers)
            if values.shape == scene.shape:
                energy = float(np.vdot(box, box).real)
                if narrow and (margin := self._add_arc(box, first, arc, energy)) is not None:
                    return margin
                _arc_of_box(box, first, steps, 0.0, 0.0, True, values)
                return math.pi
            sector = _on_scene(sector, scene, box, first, self._workers)
            energy = float(np.vdot(sector.pixels, sector.pixels).real) / sector.pixels.size
        # The image's energy and its zero-padded transform's differ by the padding.
        energy *= sector.pixels.size / values.size
        if narrow:
            turn = 0.0 if sector.acoustics.spectrum_sign > 0 else math.pi
            first, shape = self._box(arc.widened(half), turn)
            along_x, along_y = sector.carrier()
            rows = np.asarray(sector.pixels * along_x[None, :], np.complex64)
            rows = scipy.fft.fft(rows, values.shape[1], 1, "forward", True, workers=self._workers)
            # The carrier along the other axis need only be put on the columns that are kept.
            columns = _cut(rows, first[1], shape[1], 1) * along_y[:, None]
            spectrum = scipy.fft.fft(columns, values.shape[0], 0, "forward", True, workers=self._workers)
            margin = self._add_arc(_cut(spectrum, first[0], shape[0], 0), first, arc, energy)
            if margin is not None:
                return margin
        pixels = np.asarray(sector.on_carrier(), np.complex64)
        values += scipy.fft.fft2(pixels, values.shape, norm="forward", workers=self._workers)
        return math.pi

    def _add_arc(
        self, box: NDArray[np.complex64], first: tuple[int, int], arc: Arc, energy: float
    ) -> float | None:
        """Add an arc of a box of a sector's spectrum; None if the sector's energy lies elsewhere."""
        values, steps = self.spectrum.values, self.spectrum.step_rad_m
        turn = 0.0 if self.frame.acoustics.spectrum_sign > 0 else math.pi
        empty = np.empty((0, 0), np.complex64)
        for margin, beyond in ((_EDGE_RAD, _BEYOND_EDGE), (arc.width_rad / 2.0, _BEYOND_HALF)):
            low = arc.start_rad - margin + turn
            high = low + arc.width_rad + 2.0 * margin
            if _arc_of_box(box, first, steps, low, high, False, empty) >= (1.0 - beyond) * energy:
                _arc_of_box(box, first, steps, low, high, False, values)
                return margin
        return None

    def _box(self, arc: Arc, turn: float) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return (first row, column) and the shape of the spectrum's box round an arc of the band."""
        steps = self.spectrum.step_rad_m
        grid, acoustics = self.frame.grid, self.frame.acoustics
        low, _, high = acoustics.ground_band(0.0)
        nyquist = math.pi / grid.spacing_m
        angles = arc.start_rad + turn + np.linspace(0.0, arc.width_rad, 129)
        # Whatever lies straight along an axis is the extreme one.
        quarters = np.arange(math.ceil(angles[0] / (math.pi / 2)), math.floor(angles[-1] / (math.pi / 2)) + 1)
        angles = np.concatenate([angles, quarters * (math.pi / 2)])
        rim = np.concatenate(
            [k * np.exp(1j * angles) for k in (LEAST_COSINE * low, min(1.1 * high, math.sqrt(2.0) * nyquist))]
        )
        row, col = -rim.imag / steps[0], rim.real / steps[1]
        limits = []
        for index, count in zip((row, col), self.spectrum.values.shape, strict=True):
            a = max(math.floor(index.min()) - 1, -(count // 2))
            b = min(math.ceil(index.max()) + 1, (count - 1) // 2)
            limits.append((a, b - a + 1))
        return (limits[0][0], limits[1][0]), (limits[0][1], limits[1][1])


def part_of_track(track: Track, arcs: Arcs) -> Track | None:
    """Return the poses at aspects within the arcs; None if they make no track."""
    inside = arcs.contains(track.aspects_rad)
    if int(inside.sum()) < 3:
        return None
    stamps, positions = track.stamps_ns[inside], track.positions_m[inside]
    return Track(stamps, positions, max_gap_rad=track.max_gap_rad, frame=track.frame)


def same_track(a: Track, b: Track) -> bool:
    """Say whether two tracks hold the same poses, and doubt the same arcs."""
    return (
        np.array_equal(a.stamps_ns, b.stamps_ns)
        and np.array_equal(a.positions_m, b.positions_m)
        and a.doubtful == b.doubtful
    )


class Stream:
    """The views and decisions of a run that is still going on.

    Parameters
    ----------
    sub_aperture : SubApertureParameters
        Aperture, step, taper, sampling, and whether the spectrum's sign is checked.
    target : TargetParameters
        A target given with its size is taken at once. Otherwise one is looked for.
    first_search_deg : float
        The arc that must be there for a provisional search; 360: none before the circle is closed.

    Notes
    -----
    Whatever order the sectors come in, after `finish` target and views are those of the whole run.
    `revision` counts how often all views became due again: when the target of the whole run is another than
    the provisional one, a sector came late that changes views made before, or the track has grown.
    """

    def __init__(
        self,
        sub_aperture: SubApertureParameters | None = None,
        target: TargetParameters | None = None,
        *,
        first_search_deg: float = 120.0,
        workers: int = 2,
        max_objects: int = MAX_OBJECTS,
    ) -> None:
        self.parameters = sub_aperture or SubApertureParameters()
        self.target_parameters = target or TargetParameters()
        self._workers = workers
        self.sum = SectorSum(workers)
        #: The part of the track that counts, and what was left out of it.
        self.track: Track | None = None
        self.notes: tuple[str, ...] = ()
        self._poses: Track | None = None
        self._image_ns: int | None = None
        self._sectors: list[tuple[int, float, float]] = []
        self.sub_apertures: SubApertures | None = None
        self.max_objects = max_objects
        #: What is carved, for the time being or for good; None before it is decided on.
        self.decision: Decision | None = None
        #: Whether target and views are those of the whole run.
        self.final = False
        self.revision = 0
        #: Sectors that came again, out of order, or too late for views that were made already.
        self.counts: Counter[str] = Counter()
        #: Aspects (rad) that no view can be made of, and why.
        self.refused: dict[float, str] = {}
        self._aspect_of: dict[int, float] = {}
        self._given: set[int] = set()
        self._all_here = False
        self._stale = False
        self._search_at_rad = math.radians(first_search_deg)

    @property
    def target_known(self) -> bool:
        """Whether the target is decided, provisionally or finally."""
        return self.decision is not None

    @property
    def target(self) -> Target | None:
        """The run's target; None if unknown or absent."""
        return None if self.decision is None else self.decision.target

    def take_track(self, track: Track) -> bool:
        """Take all known poses of the run; False if they change nothing."""
        if self._poses is not None and len(track) < len(self._poses):
            return False
        self._poses = track
        return self._choose_passage()

    def _choose_passage(self) -> bool:
        """Choose which of the poses count, by the stamps that are here."""
        if self._poses is None:
            return False
        chosen = passage(self._poses, image_ns=self._image_ns, sectors=self._sectors)
        self.notes = chosen.notes
        if self.track is not None and same_track(chosen.track, self.track):
            return False
        self._stale |= bool(self._given)
        self.track, self.sub_apertures, self.final = chosen.track, None, False
        return True

    def add(self, sector: Sector) -> bool:
        """Add a sector; False if it is already in.

        Raises
        ------
        GeometryError
            If it does not belong to the others.
        """
        newest = self.sum.newest_ns
        changed = self.sum.add(sector, None if self.track is None else self.track.grazing_rad)
        if changed is None:
            self.counts["repeated"] += 1
            return False
        self.counts["sectors"] += 1
        self._sectors.append(
            (sector.stamp_ns, sector.aspect_rad - sector.aperture_rad / 2.0, sector.aperture_rad)
        )
        if self.notes:
            self._choose_passage()  # a plain circle does not depend on what names it
        self.counts["out_of_order"] += sector.stamp_ns < newest
        if self.final or any(changed.touches(self._arc_of(self._aspect_of[s])) for s in self._given):
            self.counts["late"] += 1
            self._stale, self.final = True, False
        return True

    def take_image(self, image: CoherentImage) -> None:
        """Take the run as a whole: its full-circle image.

        Raises
        ------
        ParameterError
            If a pixel is not finite.
        GeometryError
            If there are sectors already.
        """
        if self.sum.stamps:
            raise GeometryError(
                f"image stamped {image.stamp_ns} ns came during a run of {len(self.sum.stamps)} sectors;"
                " expected one or the other"
            )
        self.sum, self._all_here = SectorSum.of_image(image, self._workers), True
        self._image_ns = image.stamp_ns
        self._choose_passage()

    def finish(self) -> None:
        """State that no more sectors will come; any further ones are late."""
        self._all_here = True

    @property
    def ended(self) -> bool:
        """Whether all sectors have arrived: the circle is closed, or their source said so."""
        return self._all_here or self.sum.arcs.whole

    def missing(self) -> list[Arc]:
        """Return the arcs that the track covers, but no sector."""
        return [] if self.track is None else uncovered(self.sum.arcs, self.track)

    def update(self, *, decide: bool = True) -> list[int]:
        """Decide on the target as far as possible, and return the stamps of newly due views.

        Parameters
        ----------
        decide : bool
            Whether target and views of the whole run are decided on, if all sectors are here. That takes a
            search: somebody who makes views meanwhile for the target as it is known may put it off.

        Raises
        ------
        CsasError
            As `pipeline.run` does where the whole run cannot be processed, such as a wrong spectrum sign.
        """
        if self.track is None or not self.sum.stamps:
            return []
        if self.sub_apertures is None:
            self._begin(self.track)
        if self.ended and not self.final and decide:
            self._decide(self.track)
        elif not self.target_known:
            self._decide_for_now(self.track)
        if not self.target_known:
            return []
        due = [
            stamp
            for stamp, aspect in self._aspect_of.items()
            if stamp not in self._given and (self.final or self._is_whole(aspect))
        ]
        self._given.update(due)
        return due

    def aspect_of(self, stamp_ns: int) -> float:
        """Return the aspect (rad) of a view by its stamp."""
        return self._aspect_of[stamp_ns]

    def _begin(self, track: Track) -> None:
        """List the views that the track allows."""
        self.sub_apertures = SubApertures(self.sum.frame, track, self.parameters, spectrum=self.sum.spectrum)
        self._aspect_of, self.refused = {}, {}
        for aspect in map(float, self.sub_apertures.aspects_rad):
            try:
                stamp = self.sub_apertures.info(aspect).stamp_ns
                if stamp in self._aspect_of:
                    raise ViewError(
                        f"view of aspect {math.degrees(aspect):.6g}° has the stamp {stamp} ns of another view"
                    )
            except ViewError as error:
                self.refused[aspect] = str(error)
                continue
            self._aspect_of[stamp] = aspect
        self._given &= set(self._aspect_of)

    def _arc_of(self, aspect_rad: float) -> Arc:
        width = math.radians(self.parameters.aperture_deg)
        return Arc(aspect_rad - width / 2.0, width)

    def _is_whole(self, aspect_rad: float) -> bool:
        return self.sum.arcs.cover(self._arc_of(aspect_rad).widened(self.sum.margin_rad))

    def _decided(self, track: Track, *, check_sign: bool) -> Decision:
        sub_aperture = replace(self.parameters, check_sign=check_sign)
        p = PipelineParameters(sub_aperture=sub_aperture, target=self.target_parameters)
        frame, spectrum = self.sum.frame, self.sum.spectrum
        return decide_by_image(frame, track, p, spectrum=spectrum, max_objects=self.max_objects)

    def _decide_for_now(self, track: Track) -> None:
        """Take a given target, or look for one in the arc that is there."""
        p = self.target_parameters
        if p.target == "given" and all(s > 0 for s in p.size_m):
            self.decision = self._decided(track, check_sign=False)
            return
        if self.sum.arcs.covered_rad < self._search_at_rad - TOLERANCE_RAD:
            return
        part = part_of_track(track, self.sum.arcs)
        self._search_at_rad = self.sum.arcs.covered_rad + _SEARCH_AGAIN_RAD
        if part is None:
            return
        try:
            found = self._decided(part, check_sign=False)
        except NoTargetError:
            return  # nothing is there as far as this arc tells
        if found.target is not None:
            self.decision = found

    def _decide(self, track: Track) -> None:
        """Find the target of the whole run; what was made for another one is due again."""
        before, decision = self.decision, self._decided(track, check_sign=self.parameters.check_sign)
        moved = before is not None and not before.same_target(decision)
        if self._given and (moved or self._stale):
            self.revision += 1
            self._given.clear()
        self.decision, self.final, self._stale = decision, True, False


class StreamedRun:
    """The whole method on a run that is still going on: sectors in, a growing grid out.

    Parameters
    ----------
    parameters : PipelineParameters
        Every stage's parameters.
    first_search_deg : float
        See `Stream`.
    workers : int
        Threads.
    max_objects : int
        At most so many bodies are carved, the target among them.
    run_ns : int, optional
        The run's name; by default the stamp of the track's first pose.
    """

    def __init__(
        self,
        parameters: PipelineParameters | None = None,
        *,
        first_search_deg: float = 120.0,
        workers: int = 2,
        max_objects: int = MAX_OBJECTS,
        run_ns: int | None = None,
    ) -> None:
        p = self.parameters = parameters or PipelineParameters()
        self.stream = Stream(
            p.sub_aperture,
            p.target,
            first_search_deg=first_search_deg,
            workers=workers,
            max_objects=max_objects,
        )
        self.run_ns = run_ns
        self.reconstruction: Reconstruction | None = None
        self._workers = workers
        self._revision = 0

    def take_track(self, track: Track) -> list[ProcessedView]:
        """Take the track, or a longer one; return the newly due views."""
        self.stream.take_track(track)
        if self.run_ns is None:
            self.run_ns = int(track.stamps_ns[0])
        return self._advance()

    def add(self, sector: Sector) -> list[ProcessedView]:
        """Add a sector; return the newly due views, which are then in the grid."""
        self.stream.add(sector)
        return self._advance()

    def finish(self) -> list[ProcessedView]:
        """State that no more sectors will come; return the newly due views."""
        self.stream.finish()
        return self._advance()

    def _advance(self) -> list[ProcessedView]:
        # Late: whoever takes a `Stream` alone, as the node does that all others wait for, needs none of it.
        from ..pipeline import process
        from ..reconstruction import Reconstruction

        stream, p = self.stream, self.parameters
        due = [stream.aspect_of(stamp) for stamp in stream.update()]
        decision, sub_apertures = stream.decision, stream.sub_apertures
        if decision is None or sub_apertures is None:
            return []
        if self.reconstruction is None or stream.revision != self._revision:
            self._revision = stream.revision
            self.reconstruction = Reconstruction(decision, p, run_ns=self.run_ns)
        self.reconstruction.settle(decision)
        made: list[ProcessedView] = []
        self.reconstruction.feed(
            due,
            lambda aspect: process(sub_apertures.view_of_aspect(aspect), "sub_aperture", decision, p),
            on_view=made.append,
            workers=self._workers,
        )
        if stream.final:
            for aspect, reason in stream.refused.items():
                self.reconstruction.refuse(aspect, reason)
        return made

    def grid(self) -> VoxelGrid | None:
        """Return the present grid; None before the first view."""
        return self.result().grid

    def result(self, *, final: bool | None = None) -> Result:
        """Return the result so far; by default in full once the run is over."""
        from ..shape.result import Result

        if self.reconstruction is None:
            return Result(final=False)
        return self.reconstruction.result(final=self.stream.final if final is None else final)
