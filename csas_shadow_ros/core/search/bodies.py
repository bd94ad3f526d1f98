"""Find the target and the volume to carve, and check the spectrum's sign.

All three are asked of the shadows: a coarse soft carving of the whole scene with narrow sub-apertures,
which need no focus. Whatever casts a shadow of its own from all sides stands out as a body. What is then
asked of each is whether the seabed that only its height can darken, off its own plan and on another side
from each aspect, is dark: of a patch of dark sediment it is not. A second look goes by the mean power alone,
relative to its own spread over the scene: thin and faint bodies are too little for a likelihood that takes
every view by itself. "No object" is a valid answer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..errors import NoTargetError, SpectrumSignError, ViewError
from ..geometry import TWO_PI, CoherentImage, ShadowCamera, Track, View
from ..imaging.enhancement import enhance
from ..imaging.likelihood import Levels, box_mean, outside_likelihood, view_levels
from ..imaging.subaperture import Spectrum, SubApertures
from ..parameters import (
    CarvingParameters,
    LikelihoodParameters,
    ShadowParameters,
    SubApertureParameters,
)
from ..shape.carving import Carver
from ..shape.result import OTHER_SIGN, LeftOut
from ..shape.volume import MARGIN_SHARE, Target, Volume
from .relief import UNSEEN, Shading, shading

#: Aperture (deg) of the views that search: narrow enough that shadows stay sharp without enhancement.
_SEARCH_APERTURE_DEG = 6.0
_SEARCH_STEP_DEG = 10.0
#: Search voxels per side of the scene.
_SEARCH_VOXELS = 110
#: Views are smoothed over a search voxel, and over so many pixels at least: half of it is a whole number, or
#: the last digit of a spacing would decide.
_SMOOTHED_PX = 4.0
#: A search voxel is dark where the mean l_out of its (smoothed) views is under this.
_DARK = 0.4
#: The smallest body that the search reports, in search voxels.
_MIN_VOXELS = 12
#: The darkest voxels of a body, as many as that, have a mean under this: its core is dark from all sides.
_CORE = 0.28
#: The margin is at least this many search voxels.
_MARGIN_VOXELS = 5
#: Powers of the search are kept as whole numbers: so many are the seabed's mean, and one says "not known".
MEAN, UNKNOWN = 120, 255
#: A second-look voxel is dark where its mean power lies so many of its layer's spreads under its layer's
#: median. Chance alone reaches 5 in the 10^6 voxels of a scene. At 2.5 texture begins bodies, which the
#: thrown shadow has to refuse; at 10 poles of three cells, whose shadows' far ends are blurred, are not seen.
_FAINT_SPREADS = 5.0
#: Or it is dark where it has less than this of the median: a body and its shadows that fill much of the scene
#: are most of its spread. 3 dB are the least contrast of the population; at a quarter boxes of 5 dB are lost.
_FAINT_POWER = 0.5
#: No voxel of a faint body is less than so many spreads under the median: at half it runs out over the
#: seabed, at double poles are cut to pieces.
_LEAST_SPREADS = 2.5
#: What is round about: a square of this side (share of the scene's). At half bodies are their own level, at
#: double sediments are bodies.
_ROUND_ABOUT = 1.0 / 3.0
#: What is found over the local seabed alone throws its shadow so far: three cells of a view of 12°. At one
#: search cell the texture of eight seabeds of 96 is a body's.
_THROWN_LOCALLY_CELLS = 1.5
#: So many of the views (share) are darker than what is taken for lit seabed: the middle of the upper half.
_LIT_SHARE = 0.75
#: No seabed is darker than this (power over the scene's mean): 13 dB under it nothing is told from the noise.
_LEAST_LEVEL = 0.05
#: Search voxels that begin a faint body, and how many of these are looked at, the darkest first: 20 ms each.
_SEED_VOXELS = 4
_MOST_SEEDS = 32
#: A body reaches as far as this from its core's power to the seabed's (share): the edge of a shadow lies
#: halfway, and a voxel a little outside of it is lit from one side of the circle only. At 0.2 a dome over
#: dark sediment stays inside the patch, whose rim then seems to be its shadow; at 0.8 speckle is body.
_REACH = 0.41
#: The darkest part of a body reaches as far as this (share, likewise): dark from all sides.
_STRICT = 0.2
#: The thrown shadow's power, from the core's (0) to the seabed's (1): under the first a body casts it, over
#: the second none does. Bodies of the development half have 0.1 to 0.35, sediment 0.5 to 0.85. Halved, thin
#: bodies are doubted; doubled, patches are carved.
_CAST, _NOT_CAST = 0.4, 0.5
#: A body throws its shadow at least so many resolution cells off its own plan: less than one is the blur
#: of its edge. At half, soft edges of sediment seem thrown; at double, bodies of two cells of shadow are
#: candidates only.
_THROWN_CELLS = 1.0
#: Bodies that contradict the stated sign have less than this (power over the seabed's) before them. The other
#: way round a hollow looks like a body: its far wall, lit, lies before its shadow and is as long. Hollows of
#: 8 to 30 cm have 1.65 to 1.8 there, bodies 1.0 to 1.6, of which bright flanks seen steeply are the most. At
#: half no body tells a wrong sign; at double hollows do.
_PLAIN = 1.5
#: And they throw their shadow so far (resolution cells of a view of the search). Seabed whose views are
#: shifted by 1.5 cells towards the sonar, or away from it, seems to throw its dark patches' shadows. At half
#: one of 84 seabeds of the development half (scenes 120 to 330) is refused, with a patch of 13 dB.
_CONTRARY_CELLS = 2.0
#: Only what throws its shadow so far (cells of a view of the search), and is no darker than this (power over
#: the seabed's), may be a rise of the seabed: blurred over a cell, echo and shadow of a brick's edge go with
#: the aspect as the faces of a slope do, but a slope that shadows nothing is not as dark as a shadow. Mounds
#: found in the development half have 2.2 to 3.5 cells and 0.24 to 0.44, bricks with shadows of 1.3 to 2.6
#: cells and 10 dB or more 0.10 to 0.20. Of ten mounds and 22 bricks, half of the first makes a rise of one
#: more mound, half of the second of three bricks; at double of the first all mounds are bodies, of the second
#: six.
_RISE_CELLS, _RISE_POWER = 2.0, 0.2
#: The other sign must explain this many times more body than the stated one to be called the right one.
_SIGN_RATIO = 4.0

#: Why a body is none that is in view, but whose shadows are not.
LEAVES = "its shadow leaves the image"
#: A moving shadow that leaves the image takes at least this share of the scene in one view, and ends nearer
#: to the far edge than this share of the scene's side, in more than this share of the views. Seabed alone has
#: pieces of 0.4 to 1.2 % there, a patch at the edge 3 % in 13 of 36 views, cylinders of 0.7 sides 5 to 14 %
#: in 25 and 29. Half the first and patches are shadows; double the last and nobody's are.
_LEAVING_SHARE, _LEAVING_EDGE, _LEAVING_VIEWS = 0.03, 0.1, 0.5
#: What is dark in more of the views than this is seabed that is dark itself: a body's shadow covers one place
#: from less than half of the circle, but for its own plan.
_STILL = 0.6
#: Power of a shadow in a smoothed view, over the seabed's: 4 dB under it.
_SHADOW_POWER = 0.4

#: Why a body that is consistent only with the other sign is none, and no evidence for that sign either.
HOLLOW = (
    "its shadow falls towards the sonar: a hollow in the seabed, or a bright body and the wrong"
    " spectrum_sign; only a body without bright seabed before it would decide"
)


def stands_on_seabed(bottom_m: float, top_m: float) -> bool:
    """Say whether a body between these heights rests on the seabed.

    The shadows of several bodies cross, and high over the seabed between them a voxel's shadow may fall into
    one of these from nearly every side. Such a phantom has nothing under it. A body's lowest voxels may be
    lost in its own echo, but not more than that: it does not hang higher than it is high itself.
    """
    return bottom_m <= top_m - bottom_m


@dataclass(frozen=True)
class Thrown:
    """The shadow that a body's height throws on the seabed off its own plan, on another side in each view.

    Parameters
    ----------
    length_m : float
        How far it reaches over the plan's edge: its area by the plan's width, median of the views.
    power : float
        Mean power there, from that of the body's core (0) to that of the seabed (1); NaN where no view knows.
    core : float
        Mean power of the body's darkest voxels, over the seabed's.
    front : float
        Mean power as far before the body as its shadow reaches behind it, over the seabed's, echoes as 2.1;
        median of the views, NaN where that is off the scene.
    shading : Shading
        How the amplitude of the body and round about, as far as its shadow reaches, goes with the aspect.
    """

    length_m: float
    power: float
    core: float
    front: float
    shading: Shading = UNSEEN

    @property
    def contrast_db(self) -> float:
        """Contrast of the core below the seabed."""
        return -10.0 * math.log10(max(self.core, 1e-3))

    def is_rise(self, cell_m: float) -> bool:
        """Say whether a rise of the seabed explains it, in cells of so many metres."""
        plain = self.length_m >= _RISE_CELLS * cell_m and self.core >= _RISE_POWER
        return plain and self.shading.is_rise

    @property
    def is_one_sided(self) -> bool:
        """Whether it is not as dark before the body as where a shadow falls: so is dark sediment.

        Of the bodies found in scenes 0 to 119 of the development half none has less than 0.5 there (the
        core's power 0, the seabed's 1), all but one more than 0.8. Four dark patches that were taken for
        bodies, in scenes 109 to 379, have 0.2 to 0.3.
        """
        return not (self.front - self.core) / max(1.0 - self.core, 1e-3) <= _CAST


@dataclass(frozen=True, eq=False)
class Search:
    """Bodies that the search found and left out, and its coarse grid."""

    targets: tuple[Target, ...]
    volume: Volume
    likelihood: NDArray[np.float32]
    left_out: tuple[LeftOut, ...] = ()
    #: The thrown shadow of each target, in the same order.
    thrown: tuple[Thrown, ...] = ()
    #: No body that stands was evident at the first look: what was found is faint.
    is_faint: bool = False
    #: Where nothing was found, the views that were looked at.
    looks: tuple[Look, ...] = ()

    @property
    def best(self) -> Target | None:
        """The body with the most evidence, or None."""
        return self.targets[0] if self.targets else None


def search_views(views: Sequence[View]) -> Search:
    """Search a few views from all round for bodies.

    Parameters
    ----------
    views : sequence of View
        float32 amplitude views.

    Returns
    -------
    Search
        Bodies in order of evidence; none is a valid answer.

    Raises
    ------
    NoTargetError
        If there is no usable view.
    """
    if not views:
        raise NoTargetError("there is no view to find a target in; expected views from several aspects")
    extent = _known_extent(views)
    return _search(_search_looks(list(views), extent), views[0].info.camera, extent)


@dataclass(frozen=True, eq=False)
class Look:
    """What the search keeps of a view: l_out, and the mean power in whole numbers, both smoothed."""

    likelihood: View
    power: View

    def power_image(self, most: int) -> View:
        """Return the power, at most so much, as soft carving takes it: 0 to 1, the seabed's `MEAN` / 254."""
        pixels = np.minimum(self.power.pixels, most).astype(np.float32) / np.float32(UNKNOWN - 1)
        pixels[self.power.pixels == UNKNOWN] = np.nan
        return replace(self.power, pixels=pixels)


def _search_looks(views: list[View], extent_m: float, workers: int = 2) -> list[Look]:
    """Turn amplitude views into smoothed looks; empties the list, as both would be much memory.

    Raises
    ------
    NoTargetError
        If none of them can be: what the first one lacks.
    """
    parameters = LikelihoodParameters(smoothing_m=_smoothing_m(extent_m, views[0].info.camera))
    lacking: list[str] = []

    def look(_: int) -> Look | None:
        view = views.pop()
        try:
            levels = view_levels(view, parameters, target=False)
            power = _power(view, levels, parameters, smoothing_px(extent_m, view.info.camera))
            return Look(outside_likelihood(view, parameters, levels), power)
        except ViewError as error:
            lacking.append(str(error))
            return None  # a view without levels has nothing to say here; it is reported where it counts

    with ThreadPoolExecutor(workers) as pool:
        looks = [found for found in pool.map(look, range(len(views))) if found is not None]
    if not looks:
        raise NoTargetError(f"none of {len(lacking)} views can be searched: {lacking[0]}")
    return looks


def _smoothing_m(extent_m: float, camera: ShadowCamera) -> float:
    return max(extent_m / _SEARCH_VOXELS, _SMOOTHED_PX * max(camera.spacing_m))


def smoothing_px(extent_m: float, camera: ShadowCamera) -> tuple[int, int]:
    """Return how far (rows, columns) to either side a look's power is the mean of its view's."""
    half_m = _smoothing_m(extent_m, camera) / 2.0
    row_m, col_m = camera.spacing_m
    return max(1, round(half_m / row_m)), max(1, round(half_m / col_m))


def _power(view: View, levels: Levels, parameters: LikelihoodParameters, radius_px: tuple[int, int]) -> View:
    mean = box_mean(levels.power, levels.known, radius_px)
    pixels = np.minimum(mean * np.float32(MEAN) + np.float32(0.5), UNKNOWN - 1).astype(np.uint8)
    pixels[~levels.known | levels.unknown_echoes(parameters)] = UNKNOWN
    return replace(view, pixels=pixels)


def _search(
    looks: Sequence[Look], camera: ShadowCamera, extent_m: float, *, twice: bool = True, rises: bool = False
) -> Search:
    """Carve the whole scene coarsely and list its bodies; `camera` is any of the views'.

    `twice`: look again, for the faint; `rises`: those of the seabed are bodies.
    """
    middle = camera.pixel_to_ground[:2] @ np.array([(camera.cols - 1) / 2.0, (camera.rows - 1) / 2.0, 1.0])
    voxel = extent_m / _SEARCH_VOXELS
    # Higher bodies throw their shadows off the image, whose voxels stay unknown then.
    height = min(0.75 * extent_m * math.tan(camera.grazing_rad), 0.5 * float(camera.sonar_m[2]))
    volume = Volume.around((float(middle[0]), float(middle[1])), (extent_m, extent_m, height), voxel)
    mean = _carved(volume, (look.likelihood for look in looks))
    with np.errstate(invalid="ignore"):
        bodies = _bodies(mean < _DARK, mean, volume)
    judged = Judged(rises=rises)
    for body in bodies:
        if body.core <= _CORE:
            judged.add(body, looks)
    is_faint = not judged.stands
    if twice:
        look_again(judged, looks, volume)
        if leaving := None if judged.stands else _leaving(looks, volume):
            judged.left_out.append(leaving)
        else:
            look_locally(judged, looks, volume)
            # Where nothing stands, no shadows cross: it does hang, or its foot is faint.
            judged.found += [] if judged.stands else judged.hanging
    # Sorting is stable: what is as evident stays in the order of its place.
    found = sorted(judged.found, key=lambda one: (one[2] and not is_faint, -one[0].evidence))
    targets, thrown = tuple(target for target, _, _ in found), tuple(thrown for _, thrown, _ in found)
    kept = () if targets else tuple(looks)
    return Search(targets, volume, mean, tuple(judged.left_out), thrown, is_faint, kept)


def _carved(volume: Volume, images: Iterable[View]) -> NDArray[np.float32]:
    carver = Carver(volume, CarvingParameters(method="soft", min_views_fraction=0.3))
    for image in images:
        carver.integrate(image)
    return carver.likelihood()


def _known_extent(views: Sequence[View]) -> float:
    """Side (m) of the square whose area is what a view knows."""
    areas = [
        float(np.isfinite(v.pixels).sum()) * v.info.camera.spacing_m[0] * v.info.camera.spacing_m[1]
        for v in views
    ]
    return math.sqrt(float(np.median(areas)))


@dataclass(frozen=True, eq=False)
class _Body:
    """A piece of dark voxels: their (z, y, x) numbers in a volume, and the mean of the darkest."""

    volume: Volume
    voxels: tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]
    core: float

    def target(self) -> Target:
        """Return what is to be carved of it."""
        volume, (k, j, i) = self.volume, self.voxels
        d = volume.voxel_size_m
        # Layer by layer, so that the sum is the same in whatever order the voxels were found.
        layers = np.bincount(k - k.min())
        z = volume.z_m[k.min() : k.max() + 1]
        evidence = float((layers * z).sum()) * d**3
        low = np.array([volume.x_m[i.min()], volume.y_m[j.min()]]) - d / 2
        high = np.array([volume.x_m[i.max()], volume.y_m[j.max()]]) + d / 2
        size = high - low
        margin = np.maximum(MARGIN_SHARE * size, _MARGIN_VOXELS * d)
        top = float(z[-1]) + d / 2
        full = size + 2 * margin
        middle = (low + high) / 2
        return Target(
            (float(middle[0]), float(middle[1])),
            (float(full[0]), float(full[1]), float(top + max(MARGIN_SHARE * top, 2 * d))),
            evidence,
            stands_on_seabed(float(z[0]) - d / 2, top),
        )

    def thrown(self, looks: Sequence[Look]) -> Thrown:
        """Look where its height alone can darken the seabed.

        Where the whole body's shadow is not dark, that of its darkest part is looked at, off the whole plan:
        a body with gaps is surrounded by voxels that are lit from several sides. Over dark sediment nothing
        is left then, as the part lies inside of the patch with its shadow.
        """
        powers = self._powers(looks)
        known = np.sort(powers[np.isfinite(powers)])[:_MIN_VOXELS]
        core = float(known.mean()) if known.size else 1.0
        told = self._thrown(looks, core, np.ones(len(powers), np.bool_))
        if not told.power <= _CAST:
            part = self._thrown(looks, core, powers < core + _STRICT * (1.0 - core))
            if part.power <= _CAST and part.length_m >= _THROWN_CELLS * cell_m(looks):
                told = part
        return replace(told, shading=self._shading(looks, told.length_m))

    def _powers(self, looks: Sequence[Look]) -> NDArray[np.float64]:
        """Mean power of each voxel's shadow, the seabed's 1; NaN where no view knows it."""
        x, y, z = self._places()
        total, seen = np.zeros(len(x)), np.zeros(len(x), np.int64)
        for look in looks:
            powers, known = _powers_at(look.power, *_cast(look, x, y, z))
            total += np.where(known, powers, 0.0)
            seen += known
        return np.where(seen > 0, total / np.maximum(seen, 1), np.nan)

    def _places(self) -> tuple[NDArray[np.float64], ...]:
        k, j, i = self.voxels
        return self.volume.x_m[i], self.volume.y_m[j], self.volume.z_m[k]

    def _thrown(self, looks: Sequence[Look], core: float, casters: NDArray[np.bool_]) -> Thrown:
        """Look at what some of its voxels throw off the plan of all."""
        volume, (_, j, i) = self.volume, self.voxels
        d = volume.voxel_size_m
        x, y, z = (values[casters] for values in self._places())
        plan = np.zeros(volume.shape[1:], np.bool_)
        plan[j, i] = True
        width_m = math.sqrt(float(np.count_nonzero(plan))) * d
        lengths, sums, counts, fronts = [], [], [], []
        for look in looks:
            at_x, at_y = _cast(look, x, y, z)
            off_x, off_y = _cells_off(plan, volume, at_x, at_y)
            lengths.append(len(off_x) * d * d / width_m)
            powers, known = _powers_at(look.power, off_x, off_y)
            sums.append(float(powers[known].sum()))
            counts.append(int(known.sum()))
            powers, _ = _powers_at(look.power, *_cells_off(plan, volume, 2.0 * x - at_x, 2.0 * y - at_y))
            fronts.append(float(powers.mean()) if powers.size else math.nan)
        off = sum(sums) / sum(counts) if sum(counts) else math.nan
        length = float(np.median(lengths))
        share = (off - core) / max(1.0 - core, 1e-3)
        front = float(np.median(fronts))
        return Thrown(length, share, core, front)

    def _shading(self, looks: Sequence[Look], length_m: float) -> Shading:
        """Look at a disc round its plan, as far off it as its shadow reaches."""
        (x, y), d = self.target().position_m, self.volume.voxel_size_m
        reach = (max(map(np.ptp, self.voxels[1:])) + 1) * d / 2.0 + length_m
        at = np.arange(-reach, reach + d, d)
        off_x, off_y = (values.ravel() for values in np.meshgrid(at, at))
        disc = np.hypot(off_x, off_y) <= reach
        off = np.stack([off_x[disc], off_y[disc]])
        at_x, at_y = x + off[0], y + off[1]
        return shading(
            off, ((look.power.info.aspect_rad, *_powers_at(look.power, at_x, at_y)) for look in looks)
        )


def cell_m(looks: Sequence[Look]) -> float:
    """Return the larger side of a resolution cell."""
    return max(looks[0].power.info.resolution_m)


def _cast(
    look: Look, x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where the rays over points meet the seabed."""
    sonar_x, sonar_y, sonar_z = map(float, look.power.info.camera.sonar_m)
    beyond = z / (sonar_z - z)
    return x + (x - sonar_x) * beyond, y + (y - sonar_y) * beyond


def _cells_off(
    plan: NDArray[np.bool_], volume: Volume, x_m: NDArray[np.float64], y_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the middles of a volume's columns that hold one of the points and are not in a plan."""
    d = volume.voxel_size_m
    i = np.rint((x_m - volume.x_m[0]) / d).astype(np.intp)
    j = np.rint((y_m - volume.y_m[0]) / d).astype(np.intp)
    inside = (i >= 0) & (j >= 0) & (i < plan.shape[1]) & (j < plan.shape[0])
    taken = np.zeros_like(plan)
    taken[j[inside], i[inside]] = True
    j, i = np.nonzero(taken & ~plan)
    return volume.x_m[i], volume.y_m[j]


def _powers_at(
    power: View, x_m: NDArray[np.float64], y_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return a view's powers at ground positions, the seabed's mean 1, and which of them are known."""
    camera, pixels = power.info.camera, power.pixels
    u, v, _ = camera.ground_to_pixel @ np.stack([x_m, y_m, np.ones_like(x_m)])
    iu, iv = np.rint(u).astype(np.intp), np.rint(v).astype(np.intp)
    inside = (iu >= 0) & (iv >= 0) & (iu < camera.cols) & (iv < camera.rows)
    values = np.full(len(x_m), UNKNOWN, np.uint8)
    values[inside] = pixels[iv[inside], iu[inside]]
    return values / float(MEAN), values != UNKNOWN


def _bodies(
    dark: NDArray[np.bool_], values: NDArray[np.float32], volume: Volume, least: int = _MIN_VOXELS
) -> list[_Body]:
    """Part dark voxels into bodies of at least so many voxels, in two layers."""
    labels, count = scipy.ndimage.label(dark, np.ones((3, 3, 3), bool))
    found = []
    for label, box in enumerate(scipy.ndimage.find_objects(labels, count), start=1):
        body = labels[box] == label
        k, j, i = (index + part.start for index, part in zip(np.nonzero(body), box, strict=True))
        if len(k) < least or k.min() == k.max():
            continue
        core = float(np.sort(values[box][body])[:_MIN_VOXELS].mean())
        found.append(_Body(volume, (k, j, i), core))
    return found


@dataclass
class Judged:
    """Bodies that were found, and those that were not believed."""

    #: What it is, the shadow that it throws, and whether it is faint.
    found: list[tuple[Target, Thrown, bool]] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    #: What is faint and does not reach down to the seabed, likewise.
    hanging: list[tuple[Target, Thrown, bool]] = field(default_factory=list)
    #: A rise counts as a body: under the other sign it may be a hollow, which raises a doubt.
    rises: bool = False
    #: Where the bodies are, on the seabed: (y, x) numbers in the search's volume.
    plans: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = field(default_factory=list)

    @property
    def stands(self) -> bool:
        """Whether any body that was found stands on the seabed."""
        return any(target.stands for target, _, _ in self.found)

    @property
    def places(self) -> list[tuple[float, float]]:
        """Places of all that is, or may well be, a body."""
        bodies = [target.position_m for target, _, _ in (*self.found, *self.hanging)]
        return bodies + [left.position_m for left in self.left_out if left.strong]

    def add(
        self,
        body: _Body,
        looks: Sequence[Look],
        *,
        faint: bool = False,
        least_cells: float = _THROWN_CELLS,
    ) -> None:
        """Take a body in by the shadow that it throws, so many cells at least."""
        target, thrown = body.target(), body.thrown(looks)
        cell = cell_m(looks)
        if faint and (thrown.length_m < least_cells * cell or not thrown.power < _NOT_CAST):
            return  # texture of the seabed, which every scene has
        if faint and thrown.shading.stands:  # however much of its foot is lost: nothing looks for it again
            target = replace(target, stands=True)

        def doubt(why: str) -> None:
            told = f"dark by {thrown.contrast_db:.0f} dB, {why}"
            self.left_out.append(LeftOut(target.position_m, told, strong=True))

        if thrown.power <= _CAST and not thrown.is_one_sided:
            # Over the local seabed a body on dark sediment may still stand out.
            doubt("before it as where its shadow must fall: sediment, or a body on it")
            return
        self.plans.append(body.voxels[1:])
        if not self.rises and thrown.is_rise(cell):
            doubt("and as bright on the side of the sonar: the seabed rises, or a low body")
        elif thrown.power <= _CAST and thrown.shading.is_hollow:
            doubt("and bright on the far side: a hollow in dark seabed, or the wrong spectrum_sign")
        elif not target.stands and not faint:
            self.found.append((target, thrown, faint))
        elif thrown.length_m < _THROWN_CELLS * cell:
            doubt(
                f"but throws its shadow {thrown.length_m:.2f} m far: sediment, or too low to tell;"
                f" expected a shadow of {_THROWN_CELLS * cell:.2f} m"
            )
        elif thrown.power <= _CAST or (thrown.power < _NOT_CAST and thrown.shading.is_body):
            (self.found if target.stands else self.hanging).append((target, thrown, faint))
        elif not thrown.power < _NOT_CAST:
            why = "dark sediment: the same seabed is dark from all sides, no shadow moves"
            self.left_out.append(LeftOut(target.position_m, why))
        else:
            doubt(
                f"but {100 * thrown.power:.0f} % lit where its shadow must fall: sediment, or a body;"
                f" expected at most {100 * _CAST:.0f} %"
            )


def _over_local_seabed(looks: Sequence[Look], volume: Volume) -> list[Look]:
    """Divide each view's power by that of the seabed round about, which stays where it is from view to view.

    A body's shadow covers one place from less than half of the circle, so the upper half of the views is lit
    seabed. The median round about keeps the edge of a sediment where it is.
    """
    x, y = (values.ravel() for values in np.meshgrid(volume.x_m, volume.y_m))
    told = [_powers_at(look.power, x, y) for look in looks]
    powers = np.sort([np.where(known, values, np.inf) for values, known in told], axis=0)
    last = np.maximum(np.sum([known for _, known in told], axis=0) - 1, 0)
    half, lit = (
        np.take_along_axis(powers, np.rint(share * last).astype(np.intp)[None], axis=0)[0]
        for share in (0.5, _LIT_SHARE)
    )
    known = np.isfinite(lit) & (lit > 0.0)
    if not known.any():
        return list(looks)
    # Lit looks are brighter than all looks are in the median, on any seabed by as much.
    lit = np.where(known, lit * float(np.median(half[known] / lit[known])), 1.0)
    codes = np.clip(lit * MEAN, 1, UNKNOWN - 1).astype(np.uint8).reshape(len(volume.y_m), len(volume.x_m))
    side = 2 * round(_ROUND_ABOUT * _SEARCH_VOXELS / 2.0) + 1
    level = np.maximum(cv2.medianBlur(codes, side).astype(np.float32) / MEAN, _LEAST_LEVEL)
    d = volume.voxel_size_m
    to_grid = np.array([[1 / d, 0.0, -volume.x_m[0] / d], [0.0, 1 / d, -volume.y_m[0] / d], [0.0, 0.0, 1.0]])
    flat = []
    for look in looks:
        camera, pixels = look.power.info.camera, look.power.pixels
        placed = cv2.warpAffine(
            level,
            (to_grid @ camera.pixel_to_ground)[:2],
            (camera.cols, camera.rows),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        over = np.minimum(pixels / placed + np.float32(0.5), UNKNOWN - 1).astype(np.uint8)
        over[pixels == UNKNOWN] = UNKNOWN
        flat.append(replace(look, power=replace(look.power, pixels=over)))
    return flat


def look_again(judged: Judged, looks: Sequence[Look], volume: Volume) -> None:
    """Look for the thin and the faint, whose power is low in the mean of all views.

    Over the whole scene's seabed: a large body is most of what is round about.
    """
    _look_over(judged, looks, volume, 0.0, _THROWN_CELLS, UNKNOWN - 1)


def look_locally(judged: Judged, looks: Sequence[Look], volume: Volume) -> None:
    """Look again over the local seabed: on dark sediment, or beside it, all is dark or nothing.

    No view counts as brighter than the seabed: a small body's own echo would hide in the mean that its shadow
    is dark.
    """
    local = _over_local_seabed(looks, volume)
    _look_over(judged, local, volume, _FAINT_POWER, _THROWN_LOCALLY_CELLS, MEAN)


def _look_over(
    judged: Judged,
    looks: Sequence[Look],
    volume: Volume,
    reach: float,
    least_cells: float,
    most: int,
) -> None:
    """Grow bodies from what is dark; at least what has less than `reach` of its layer's median is one's."""
    power = _carved(volume, (look.power_image(most) for look in looks)) * np.float32((UNKNOWN - 1) / MEAN)
    seeds = np.zeros(power.shape, np.bool_)
    limits = np.zeros((len(power), 1, 1), np.float32)
    for layer, out, limit in zip(power, seeds, limits, strict=True):
        known = layer[np.isfinite(layer)]
        if not known.size:
            continue
        median = float(np.median(known))
        spread = 1.4826 * float(np.median(np.abs(known - median)))
        with np.errstate(invalid="ignore"):
            out[:] = layer < max(median - _FAINT_SPREADS * spread, _FAINT_POWER * median)
        limit[:] = max(median - _LEAST_SPREADS * spread, reach * median)
    taken = np.zeros(power.shape, np.bool_)
    for j, i in judged.plans:
        taken[:, j, i] = True  # it was judged at the first look
    found = sorted(_bodies(seeds, power, volume, _SEED_VOXELS), key=lambda body: body.core)
    for seed in found[:_MOST_SEEDS]:
        k, j, i = seed.voxels
        if taken[k, j, i].any():
            continue
        with np.errstate(invalid="ignore"):
            dark = power < np.minimum(limits, seed.core + _REACH * (1.0 - seed.core))
        labels, _ = scipy.ndimage.label(dark, np.ones((3, 3, 3)))
        darkest = np.argmin(power[k, j, i])
        z_at, y_at, x_at = np.nonzero(labels == labels[k[darkest], j[darkest], i[darkest]])
        whole = z_at, y_at, x_at
        taken[whole] = True
        (first_j, last_j), (first_i, last_i) = ((n.min(), n.max()) for n in whole[1:])
        inside = first_j > 0 and first_i > 0 and last_j < power.shape[1] - 1 and last_i < power.shape[2] - 1
        if len(whole[0]) >= _MIN_VOXELS and inside:  # what leads out of the scene is its level, no body
            judged.add(_Body(volume, whole, seed.core), looks, faint=True, least_cells=least_cells)


def _leaving(looks: Sequence[Look], volume: Volume) -> LeftOut | None:
    """Return the body whose shadows leave the image, if most views show large ones that move and end there.

    Such a body has no top that is dark from all sides, and so the search sees nothing of it.
    """
    d, extent_m = volume.voxel_size_m, volume.size_m[0]
    middle = float(volume.x_m.mean()), float(volume.y_m.mean())
    side = math.ceil(1.5 * _SEARCH_VOXELS)  # a square scene reaches over it at its corners
    at = (np.arange(side) - (side - 1) / 2.0) * d
    x, y = (values.ravel() for values in np.meshgrid(at + middle[0], at + middle[1]))
    dark, seen = np.zeros(side * side), np.zeros(side * side)
    for look in looks:
        powers, known = _powers_at(look.power, x, y)
        seen += known
        dark += known & (powers < _SHADOW_POWER)
    moves = (dark <= _STILL * seen).reshape(side, side)
    reaches, starts = [], []
    for look in looks:
        camera, pixels = look.power.info.camera, look.power.pixels
        known = pixels != UNKNOWN
        labels, count = scipy.ndimage.label(known & (pixels < _SHADOW_POWER * MEAN))
        row, col = np.nonzero(labels)
        if not count or not row.size:
            continue
        ground = camera.pixel_to_ground[:2] @ np.stack([col, row, np.ones_like(row)])
        i, j = (np.rint((g - m) / d + (side - 1) / 2.0) for g, m in zip(ground, middle, strict=True))
        i, j = (np.clip(n, 0, side - 1).astype(np.intp) for n in (i, j))
        sizes = np.bincount(labels[row, col][moves[j, i]], minlength=count + 1)
        largest = int(sizes.argmax())
        mine = labels[row, col] == largest
        row_m, col_m = camera.spacing_m
        far = camera.rows - 1 - np.argmax(known[::-1], axis=0)
        left = float((far[col[mine]] - row[mine]).min()) * row_m
        if sizes[largest] * row_m * col_m > _LEAVING_SHARE * extent_m**2 and left < _LEAVING_EDGE * extent_m:
            ground = ground[:, mine]
            reaches.append(float(np.hypot(ground[0] - middle[0], ground[1] - middle[1]).max()))
            starts.append(ground[:, int(row[mine].argmin())])
    if len(reaches) <= _LEAVING_VIEWS * len(looks):
        return None
    # Its shadows begin round the body itself, on the side of each view's sonar.
    place = np.mean(starts, axis=0)
    return LeftOut(
        (float(place[0]), float(place[1])),
        f"{LEAVES} in {len(reaches)} of {len(looks)} views; expected an image of at least"
        f" {2.0 * max(reaches):.1f} m",
        strong=True,
    )


def _searching(image: CoherentImage, track: Track, spectrum: Spectrum) -> SubApertures:
    parameters = SubApertureParameters(aperture_deg=_SEARCH_APERTURE_DEG, step_deg=_SEARCH_STEP_DEG)
    return SubApertures(image, track, parameters, spectrum=spectrum)


def _views_of_search(sub_apertures: SubApertures, workers: int = 2) -> list[View]:
    """Make the amplitude views that search; none where the track has a gap."""
    unfocused = ShadowParameters(enhancement="none")

    def view(aspect: float) -> View | None:
        try:
            return enhance(sub_apertures.view_of_aspect(aspect), (0.0, 0.0), unfocused)
        except ViewError:
            return None

    with ThreadPoolExecutor(workers) as pool:
        return [v for v in pool.map(view, map(float, sub_apertures.aspects_rad)) if v is not None]


def search_image(image: CoherentImage, track: Track, spectrum: Spectrum) -> Search | None:
    """Search a coherent image for bodies; None if the track leaves no view."""
    views = _views_of_search(_searching(image, track, spectrum))
    return search_views(views) if views else None


@dataclass(frozen=True)
class SignEvidence:
    """How well the shadows fit the stated spectrum sign, and the other one.

    Parameters
    ----------
    stated : int
        The image's `spectrum_sign`.
    stated_evidence, other_evidence : float
        Evidence of the best body under the stated and the other sign; 0 where there is none.
    """

    stated: int
    stated_evidence: float
    other_evidence: float

    @property
    def verdict(self) -> str:
        """'right', 'wrong', or 'unknown' without shadows that decide."""
        if self.stated_evidence > _SIGN_RATIO * self.other_evidence:
            return "right"
        if self.other_evidence > _SIGN_RATIO * self.stated_evidence:
            return "wrong"
        return "unknown"

    def __str__(self) -> str:
        text = {
            "right": "shadows fall away from the sonar, as they must",
            "wrong": "shadows fall towards the sonar and enhancement would blur them:"
            f" expected {-self.stated:+d}",
            "unknown": "no shadows to tell by",
        }[self.verdict]
        return f"spectrum_sign is {self.stated:+d}: {text}"

    def check(self) -> None:
        """Raise if the sign is wrong.

        Raises
        ------
        SpectrumSignError
            Naming the stated sign and the expected one.
        """
        if self.verdict == "wrong":
            raise SpectrumSignError(str(self))


def spectrum_sign_evidence(
    image: CoherentImage, track: Track, *, spectrum: Spectrum | None = None
) -> tuple[SignEvidence, Search | None]:
    """Compare the bodies found under the stated spectrum sign with those under the other.

    A wrong sign turns every view by 180°: what the views then show falls towards the sonar, and no
    body is consistent with it. So does the shadow in a hollow, whose lit far wall tells it from a body.

    Returns
    -------
    SignEvidence
        The comparison.
    Search or None
        The search under the stated sign, so that it need not be repeated.
    """
    spectrum = spectrum or Spectrum.of_image(image)
    sign = image.acoustics.spectrum_sign
    views = _views_of_search(_searching(image, track, spectrum))
    if not views:
        return SignEvidence(sign, 0.0, 0.0), None
    camera, extent = views[0].info.camera, _known_extent(views)
    looks = _search_looks(views, extent)
    other_image = replace(image, acoustics=replace(image.acoustics, spectrum_sign=-sign))
    turned = list(_under_other_sign(looks, _searching(other_image, track, spectrum)))
    stated = _search(looks, camera, extent)
    if not turned:  # of less than half a circle no view has its opposite: nothing tells the sign
        return SignEvidence(sign, 0.0, 0.0), stated
    best = stated.best.evidence if stated.best is not None else 0.0
    # What is only faint proves nothing before as much was looked for under the other sign.
    other = _search(turned, camera, extent, twice=stated.is_faint, rises=True)
    if leaving := [left for left in other.left_out if left.reason.startswith(LEAVES)]:
        best = 0.0
        doubts = (replace(left, reason=f"{OTHER_SIGN} {left.reason}") for left in leaving)
        stated = replace(stated, left_out=(*stated.left_out, *doubts))
    least_m = _CONTRARY_CELLS * cell_m(looks)
    # A hollow tells nothing; what is short, or dark before it too, raises a doubt and proves nothing.
    plain = [
        (target, thrown.is_one_sided and not thrown.length_m < least_m)
        for target, thrown in zip(other.targets, other.thrown, strict=True)
        if not thrown.front >= _PLAIN and not thrown.shading.may_be_relief
    ]
    contrary = [target for target, proves in plain if proves]
    against = max((target.evidence for target in contrary), default=0.0)
    if faint := stated.is_faint and other.is_faint:
        # What is faint proves no sign wrong. It raises a doubt where the search names nothing else.
        body = max((target for target, _ in plain), key=lambda target: target.evidence, default=None)
        if body is not None and body.evidence > _SIGN_RATIO * best and not stated.left_out:
            doubt = LeftOut(body.position_m, f"{OTHER_SIGN} a faint body throws a shadow here")
            stated = replace(stated, left_out=(*stated.left_out, doubt))
        against = min(against, best)
    evidence = SignEvidence(sign, best, against)
    evident = other.best is not None and not faint and other.best.evidence > _SIGN_RATIO * best
    if other.best is not None and evident and not contrary:
        hollow = LeftOut(other.best.position_m, HOLLOW, strong=True)
        stated = replace(stated, left_out=(*stated.left_out, hollow))
    return evidence, stated


def _under_other_sign(looks: Sequence[Look], other: SubApertures) -> Iterator[Look]:
    """Give the views of the other spectrum sign: that of aspect θ is that of θ + π, turned by 180°."""
    for look in looks:
        try:
            info = other.info(float((look.power.info.aspect_rad + math.pi) % TWO_PI))
        except ViewError:
            continue
        yield Look(*(View(info, view.pixels[::-1, ::-1]) for view in (look.likelihood, look.power)))
