"""Where is the target, how large a volume must be carved, and does the spectrum's sign fit it?

All three are asked of the shadows: a coarse soft carving of the whole scene with narrow sub-apertures,
which need no focus. Whatever casts a shadow of its own from all sides stands out as a body; a patch
of seabed, however bright or dark, does not. "No object" is a valid answer.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from .carving import Carver
from .errors import NoTargetError, SpectrumSignError, ViewError
from .geometry import TWO_PI, CoherentImage, ShadowCamera, Track, View
from .likelihood import outside_likelihood
from .parameters import (
    CarvingParameters,
    LikelihoodParameters,
    ShadowParameters,
    SubApertureParameters,
)
from .shadow import enhance
from .subaperture import Spectrum, SubApertures
from .volume import MARGIN_SHARE, Target, Volume

#: Aperture (deg) of the views that search: narrow enough that shadows stay sharp without enhancement.
_SEARCH_APERTURE_DEG = 6.0
_SEARCH_STEP_DEG = 10.0
#: Search voxels per side of the scene.
_SEARCH_VOXELS = 110
#: A search voxel is dark where the mean l_out of its (smoothed) views is under this.
_DARK = 0.4
#: The smallest body that the search reports, in search voxels.
_MIN_VOXELS = 12
#: The darkest voxels of a body, as many as that, have a mean under this: its core is dark from all sides.
_CORE = 0.28
#: The margin is at least this many search voxels.
_MARGIN_VOXELS = 5
#: The other sign must explain this many times more body than the stated one to be called the right one.
_SIGN_RATIO = 4.0


def stands_on_seabed(bottom_m: float, top_m: float) -> bool:
    """Say whether a body that reaches from one height to another rests on the seabed.

    The shadows of several bodies cross, and high over the seabed between them a voxel's shadow may fall into
    one of these from nearly every side. Such a phantom has nothing under it. A body's lowest voxels may be
    lost in its own echo, but not more than that: it does not hang higher than it is high itself.
    """
    return bottom_m <= top_m - bottom_m


@dataclass(frozen=True, eq=False)
class Search:
    """What the search found, and the coarse grid that it looked at."""

    targets: tuple[Target, ...]
    volume: Volume
    likelihood: NDArray[np.float32]

    @property
    def best(self) -> Target | None:
        """The most evident body, or None."""
        return self.targets[0] if self.targets else None


def search_views(views: Sequence[View]) -> Search:
    """Look for bodies in a few views from all round.

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
    return _search(_search_likelihoods(list(views), extent), views[0].info.camera, extent)


def _search_likelihoods(views: list[View], extent_m: float, workers: int = 2) -> list[View]:
    """Turn amplitude views into smoothed likelihoods; empties the list, as both would be much memory."""
    smoothing_m = max(extent_m / _SEARCH_VOXELS, 3.0 * max(views[0].info.camera.spacing_m))
    parameters = LikelihoodParameters(smoothing_m=smoothing_m)

    def likelihood(_: int) -> View | None:
        view = views.pop()
        try:
            return outside_likelihood(view, parameters)
        except ViewError:
            return None  # a view without levels has nothing to say here; it is reported where it counts

    with ThreadPoolExecutor(workers) as pool:
        return [view for view in pool.map(likelihood, range(len(views))) if view is not None]


def _search(likelihoods: Iterable[View], camera: ShadowCamera, extent_m: float) -> Search:
    """Carve the whole scene coarsely and list its bodies; `camera` is any of the views'."""
    middle = camera.pixel_to_ground[:2] @ np.array([(camera.cols - 1) / 2.0, (camera.rows - 1) / 2.0, 1.0])
    voxel = extent_m / _SEARCH_VOXELS
    # Higher bodies throw their shadows off the image, whose voxels stay unknown then.
    height = min(0.75 * extent_m * math.tan(camera.grazing_rad), 0.5 * float(camera.sonar_m[2]))
    volume = Volume.around((float(middle[0]), float(middle[1])), (extent_m, extent_m, height), voxel)
    carver = Carver(volume, CarvingParameters(method="soft", min_views_fraction=0.3))
    for likelihood in likelihoods:
        carver.integrate(likelihood)
    mean = carver.likelihood()
    return Search(tuple(_bodies(mean, volume)), volume, mean)


def _known_extent(views: Sequence[View]) -> float:
    """Side (m) of the square whose area is what a view knows."""
    areas = [
        float(np.isfinite(v.pixels).sum()) * v.info.camera.spacing_m[0] * v.info.camera.spacing_m[1]
        for v in views
    ]
    return math.sqrt(float(np.median(areas)))


def _bodies(likelihood: NDArray[np.float32], volume: Volume) -> list[Target]:
    with np.errstate(invalid="ignore"):
        dark = likelihood < _DARK
    labels, count = scipy.ndimage.label(dark, np.ones((3, 3, 3), bool))
    d = volume.voxel_size_m
    found = []
    for label, box in enumerate(scipy.ndimage.find_objects(labels, count), start=1):
        body = labels[box] == label
        layers = np.flatnonzero(body.any(axis=(1, 2)))
        if int(body.sum()) < _MIN_VOXELS or len(layers) < 2:
            continue
        if np.sort(likelihood[box][body])[:_MIN_VOXELS].mean() > _CORE:
            continue
        z = volume.z_m[box[0]]
        evidence = float((body.sum(axis=(1, 2)) * z).sum()) * d**3
        low = np.array([volume.x_m[box[2].start], volume.y_m[box[1].start]]) - d / 2
        high = np.array([volume.x_m[box[2].stop - 1], volume.y_m[box[1].stop - 1]]) + d / 2
        size = high - low
        margin = np.maximum(MARGIN_SHARE * size, _MARGIN_VOXELS * d)
        top = float(z[-1]) + d / 2
        full = size + 2 * margin
        middle = (low + high) / 2
        found.append(
            Target(
                (float(middle[0]), float(middle[1])),
                (float(full[0]), float(full[1]), float(top + max(MARGIN_SHARE * top, 2 * d))),
                evidence,
                stands_on_seabed(float(z[0]) - d / 2, top),
            )
        )
    return sorted(found, key=lambda target: -target.evidence)


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
    """Look for bodies in a coherent image; None where the track leaves no view to look in."""
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
        """'right', 'wrong', or 'unknown' where there are no shadows to tell it by."""
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
    body is consistent with it.

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
    likelihoods = _search_likelihoods(views, extent)
    other_image = replace(image, acoustics=replace(image.acoustics, spectrum_sign=-sign))
    turned = _under_other_sign(likelihoods, _searching(other_image, track, spectrum))
    stated, other = _search(likelihoods, camera, extent), _search(turned, camera, extent)
    scores = [s.best.evidence if s.best is not None else 0.0 for s in (stated, other)]
    return SignEvidence(sign, scores[0], scores[1]), stated


def _under_other_sign(views: Sequence[View], other: SubApertures) -> Iterator[View]:
    """Give the views of the other spectrum sign: that of aspect θ is that of θ + π, turned by 180°."""
    for view in views:
        try:
            info = other.info(float((view.info.aspect_rad + math.pi) % TWO_PI))
        except ViewError:
            continue
        yield View(info, view.pixels[::-1, ::-1])
