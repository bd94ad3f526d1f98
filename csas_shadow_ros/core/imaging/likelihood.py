"""How likely each pixel lies outside the shadow (section 4.2 of the paper).

Amplitudes are taken as Rayleigh distributed, with mode σ_r on the seabed and σ_s in shadow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ViewError
from ..geometry import View
from ..kernels import kernel
from ..parameters import LikelihoodParameters
from .local_means import LocalMeans, Spans, known_span

FloatImage = NDArray[np.float32]

#: Median of a Rayleigh distribution over its mode.
_MEDIAN_OVER_MODE = math.sqrt(2.0 * math.log(2.0))
#: Nodes a side of the lattice of the seabed's level, from edge to edge of a view.
_LATTICE = 33
#: A view needs this many known pixels for its seabed level to be estimated.
_MIN_PIXELS = 256
#: Shadow interiors of fewer resolution cells than this do not give a level.
_LEAST_CELLS = 9.0
#: A shadow less than 4 dB under the seabed is its own speckle.
_MIN_CONTRAST2 = 10.0**0.4
#: Contrast (power ratio, 6 dB) to start from where the first guess finds no shadow of a target. Chosen on 17
#: bodies of the population's scenes 0 to 119: from 4 dB, the least contrast, their mean IoU with the hull is
#: 0.006 less, from 9 dB 0.1. On scenes 120 to 167, which chose nothing, seven of 38 bodies gain 0.01 to 0.56
#: and none loses.
_FAINT_CONTRAST2 = 10.0**0.6


@dataclass(frozen=True, eq=False)
class Levels:
    """Seabed and shadow level of one view, and the view relative to them.

    Parameters
    ----------
    seabed_level : float
        Median of σ_r over the view.
    contrast : float
        σ_r / σ_s.
    shadow_fraction : float
        Fraction of the known pixels inside shadows; NaN if it was not measured.
    estimated : bool
        Whether σ_s was measured (True) or comes from the contrast hypothesis.
    local : LocalMeans
        The view's power, and its means over boxes.
    """

    seabed_level: float
    contrast: float
    shadow_fraction: float
    estimated: bool
    local: LocalMeans
    _echoes: dict[float, NDArray[np.bool_]] = field(default_factory=dict, repr=False)

    @property
    def power(self) -> FloatImage:
        """(i/σ_r)²/2, which has mean 1 on the seabed; 0 where unknown. Shape (rows, cols)."""
        return self.local.power

    @property
    def known(self) -> NDArray[np.bool_]:
        """Pixels that the view knows, shape (rows, cols)."""
        return self.local.known

    def echoes(self, echo_db: float) -> NDArray[np.bool_]:
        """Return `echo_mask` of the view, computed once for likelihood and segmentation."""
        if echo_db not in self._echoes:
            self._echoes[echo_db] = echo_mask(self.local, echo_db)
        return self._echoes[echo_db]

    def unknown_echoes(self, parameters: LikelihoodParameters) -> NDArray[np.bool_]:
        """Return the echoes that count as unknown: all or none, by the parameters."""
        return self.echoes(parameters.echo_db) if parameters.echo_unknown else np.zeros_like(self.known)


@kernel(inline="always")
def _l_out(power: np.float32, contrast2: np.float32, octaves: np.float32) -> np.float32:  # pragma: no cover
    """Evaluate `l_out` of one power, for (σ_r/σ_s)² and (1 - (σ_r/σ_s)²) / ln 2.

    The exponential is 2^n · 2^f with a polynomial for f in [-½, ½], as the compiler makes vectors of that but
    not of a library's: right to 2.5e-7 of itself, and l_out to 4e-7.
    """
    # Beyond 2^-126 nothing is left of it beside 1.
    exponent = max(power * octaves, np.float32(-126.0))
    n = np.int32(exponent - np.float32(0.5))
    f = exponent - np.float32(n)
    part = np.float32(1.5403530e-4) * f + np.float32(1.3333558e-3)
    part = part * f + np.float32(9.6181291e-3)
    part = part * f + np.float32(5.5504109e-2)
    part = part * f + np.float32(2.4022651e-1)
    part = part * f + np.float32(6.9314718e-1)
    part = part * f + np.float32(1.0)
    # A float32 whose exponent is n and whose fraction is zero.
    power_of_two = np.int32((n + 127) << 23).view(np.float32)
    inverse = np.float32(1.0) / (np.float32(1.0) + contrast2 * (part * power_of_two))
    return inverse * inverse


def _constants(contrast: float) -> tuple[np.float32, np.float32]:
    """Return what `_l_out` takes of a contrast."""
    contrast2 = contrast * contrast
    return np.float32(contrast2), np.float32((1.0 - contrast2) / math.log(2.0))


def l_out(power: FloatImage, contrast: float) -> FloatImage:
    """Evaluate l_out = (p_r / (p_r + p_s))² for powers (i/σ_r)²/2 and contrast σ_r/σ_s.

    Written as (1 + (σ_r/σ_s)² exp(-(i/σ_r)²/2 · ((σ_r/σ_s)² - 1)))⁻², which is finite at i = 0 and
    cannot overflow.

    Parameters
    ----------
    power : ndarray of float32
        (i/σ_r)²/2, not negative.
    contrast : float
        σ_r/σ_s, over 1.
    """
    out = np.empty(power.shape, np.float32)
    _l_out_of_all(np.ascontiguousarray(power).ravel(), *_constants(contrast), out.ravel())
    return out


@kernel(error_model="numpy")
def _l_out_of_all(
    power: FloatImage, contrast2: np.float32, octaves: np.float32, out: FloatImage
) -> None:  # pragma: no cover
    for i in range(power.size):
        out[i] = _l_out(power[i], contrast2, octaves)


@kernel(error_model="numpy")
def _l_out_of_known(
    power: FloatImage,
    known: NDArray[np.bool_],
    echo: NDArray[np.bool_],
    spans: Spans,
    contrast2: np.float32,
    octaves: np.float32,
    out: FloatImage,
) -> None:  # pragma: no cover
    """Evaluate `l_out` of the known pixels that are no echo; NaN elsewhere."""
    for v in range(power.shape[0]):
        first, last = spans[v]
        out[v, :first] = np.nan
        out[v, last:] = np.nan
        of, to = power[v, first:last], out[v, first:last]
        here, bright = known[v, first:last], echo[v, first:last]
        for i in range(last - first):
            value = _l_out(of[i], contrast2, octaves)
            to[i] = value if here[i] and not bright[i] else np.float32(np.nan)


def expected_l_out(contrast: float) -> tuple[float, float]:
    """Return the mean of l_out over Rayleigh shadow pixels and over Rayleigh seabed pixels."""
    # i²/(2σ²) is exponential: integrate over its quantiles.
    power = -np.log1p(-(np.arange(4096) + 0.5) / 4096).astype(np.float32)
    shadow = l_out(power / np.float32(contrast * contrast), contrast)
    return float(shadow.mean()), float(l_out(power, contrast).mean())


@kernel()
def _count_known(amplitude: FloatImage, enough: int) -> int:  # pragma: no cover
    """Count known pixels, row by row until there are enough."""
    count = 0
    for v in range(amplitude.shape[0]):
        for u in range(amplitude.shape[1]):
            count += abs(amplitude[v, u]) < np.inf
        if count >= enough:
            break
    return count


@kernel()
def _whole_blocks(
    amplitude: FloatImage,
    blocks: tuple[int, int],
    size: tuple[int, int],
    tiles: FloatImage,
    whole: NDArray[np.int64],
) -> int:  # pragma: no cover
    """Copy every other pixel of the blocks of which all of these are known; return how many blocks."""
    found = 0
    for block in range(blocks[0] * blocks[1]):
        top, left = block // blocks[1] * size[0], block % blocks[1] * size[1]
        tile = tiles[found]
        n, known = 0, True
        for v in range(top, top + size[0], 2):
            for u in range(left, left + size[1], 2):
                pixel = amplitude[v, u]
                known &= abs(pixel) < np.inf
                tile[n] = pixel
                n += 1
            if not known:
                break
        if known:
            whole[found] = block
            found += 1
    return found


def _block_medians(
    amplitude: FloatImage, block: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Median of each wholly known block, and the blocks' middles in [-1, 1]."""
    rows, cols = amplitude.shape
    n_v, n_u = max(rows // block, 1), max(cols // block, 1)
    height, width = min(block, rows), min(block, cols)
    # Neighbouring pixels hold the same speckle: every other one tells as much.
    tiles: NDArray[np.float32] = np.empty((n_v * n_u, -(-height // 2) * -(-width // 2)), np.float32)
    whole: NDArray[np.int64] = np.empty(n_v * n_u, np.int64)
    found = _whole_blocks(amplitude, (n_v, n_u), (height, width), tiles, whole)
    tiles, whole = tiles[:found], whole[:found]
    middle = tiles.shape[1] // 2
    medians = np.partition(tiles, middle, axis=1)[:, middle]
    v, u = np.divmod(whole, n_u)
    return medians.astype(np.float64), ((v + 0.5) * block / rows) * 2 - 1, ((u + 0.5) * block / cols) * 2 - 1


def _surface(v: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.ones_like(v), v, u, v * v, v * u, u * u], axis=-1)


@lru_cache(maxsize=1)
def _lattice_surface() -> NDArray[np.float64]:
    nodes = np.linspace(-1, 1, _LATTICE)
    return _surface(*np.meshgrid(nodes, nodes, indexing="ij"))


def _median(values: NDArray[Any]) -> float:
    """Return the median of finite numbers; `numpy.median` costs ten times as much on a few hundred."""
    middle = values.size // 2
    if values.size % 2:
        return float(np.partition(values, middle, axis=None)[middle])
    return float(np.partition(values, (middle - 1, middle), axis=None)[middle - 1 : middle + 1].mean())


def seabed_level(amplitude: FloatImage, background: str) -> FloatImage:
    """Estimate σ_r, the seabed's Rayleigh mode, on a coarse lattice over a view: the surface is smooth.

    Shadows and echoes are outliers: the level is the median of block medians (`global`), or a
    quadratic surface fitted to their logarithm with Tukey's biweight (`local`), which follows a
    seabed whose level varies slowly.

    Parameters
    ----------
    amplitude : ndarray of float32, shape (rows, cols)
        Amplitude, NaN where unknown.
    background : {'local', 'global'}
        One level or a surface.

    Returns
    -------
    ndarray of float32, shape (33, 33)
        From the first row and column's outer edge to the last one's.

    Raises
    ------
    ViewError
        If too few pixels are known, or the seabed is zero.
    """
    rows, cols = amplitude.shape
    known = _count_known(amplitude, _MIN_PIXELS)
    if known < _MIN_PIXELS:
        raise ViewError(
            f"view has {known} known pixels; expected at least {_MIN_PIXELS} to estimate its levels"
        )
    block = max(8, min(rows, cols) // 24)
    medians, v, u = _block_medians(amplitude, block)
    if medians.size == 0:
        raise ViewError(
            f"no block of {block} x {block} pixels of the view is wholly known; expected some to estimate its"
            " levels from"
        )
    medians_ok = medians > 0
    medians, v, u = medians[medians_ok], v[medians_ok], u[medians_ok]
    if medians.size == 0:
        raise ViewError("the seabed level of the view is zero; expected an amplitude image with a lit seabed")
    log_level = np.log(medians)
    middle = _median(log_level)
    if background == "global" or medians.size < 24:
        return np.full((_LATTICE, _LATTICE), math.exp(middle) / _MEDIAN_OVER_MODE, np.float32)
    design = _surface(v, u)
    # A little damping of slope and curvature: where outliers cover much of the view, stay flat.
    damping = np.diag([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    coefficients: NDArray[np.float64] = np.zeros(6)
    coefficients[0] = middle
    for _ in range(8):
        residual = log_level - design @ coefficients
        scale = max(1.4826 * _median(np.abs(residual)), 0.02)
        weight = np.maximum(1.0 - (residual / (4.0 * scale)) ** 2, 0.0) ** 2
        weighted = design.T * weight
        coefficients = np.asarray(np.linalg.solve(weighted @ design + damping, weighted @ log_level))
    return np.exp(_lattice_surface() @ coefficients).astype(np.float32) / np.float32(_MEDIAN_OVER_MODE)


@kernel(error_model="numpy")
def _relative_power(
    amplitude: FloatImage,
    lattice: FloatImage,
    power: FloatImage,
    known: NDArray[np.bool_],
    spans: Spans,
    level: FloatImage,
) -> None:  # pragma: no cover
    """Work out (i/σ_r)²/2, σ_r from a lattice; 0 where unknown. `level` gets each eighth σ_r."""
    rows, cols = amplitude.shape
    last_node = lattice.shape[0] - 1
    place = (np.arange(cols) + 0.5) * last_node / cols
    node = place.astype(np.int32)
    part = (place - node).astype(np.float32)
    begins = np.searchsorted(node, np.arange(last_node + 1))
    nodes, line = np.empty(last_node + 1, np.float32), np.empty(cols, np.float32)
    for v in range(rows):
        at = (v + 0.5) * last_node / rows
        i = int(at)
        for j in range(last_node + 1):
            nodes[j] = lattice[i, j] + np.float32(at - i) * (lattice[i + 1, j] - lattice[i, j])
        here = known[v]
        for u in range(cols):
            here[u] = abs(amplitude[v, u]) < np.float32(np.inf)
        first, last = known_span(known, v)
        spans[v, 0], spans[v, 1] = first, last
        if v % 8 == 0:
            _interpolate(nodes, begins, part, 0, cols, line)
            level[v // 8] = line[::8]
        else:
            _interpolate(nodes, begins, part, first, last, line)
        power[v, :first] = np.float32(0.0)
        power[v, last:] = np.float32(0.0)
        # Rows of their own: the compiler then makes vectors of what it does with them.
        pixels, sigma = amplitude[v, first:last], line[first:last]
        powers, here = power[v, first:last], known[v, first:last]
        for u in range(last - first):
            ratio = pixels[u] / sigma[u]
            value = np.float32(0.5) * ratio * ratio
            powers[u] = value if value < np.float32(np.inf) else np.float32(0.0)
            here[u] = value < np.float32(np.inf)


@kernel()
def _interpolate(
    nodes: FloatImage, begins: NDArray[np.int64], part: FloatImage, first: int, last: int, line: FloatImage
) -> None:  # pragma: no cover
    """Interpolate columns `first` to `last`: those from `begins[j]` on lie by a part each beyond node j."""
    for j in range(nodes.size - 1):
        here, step = nodes[j], nodes[j + 1] - nodes[j]
        begin, end = max(first, begins[j]), min(last, begins[j + 1])
        for u in range(np.uintp(begin), np.uintp(max(begin, end))):
            line[u] = here + part[u] * step


def box_mean(power: FloatImage, known: NDArray[np.bool_], radius_px: tuple[int, int]) -> FloatImage:
    """Mean over a box of known pixels only.

    Parameters
    ----------
    power : ndarray of float32, shape (rows, cols)
        0 where unknown.
    known : ndarray of bool, shape (rows, cols)
        Pixels to count.
    radius_px : (int, int)
        Half-size of the box, (rows, cols).
    """
    size = (2 * radius_px[1] + 1, 2 * radius_px[0] + 1)
    total = cv2.boxFilter(power, -1, size, normalize=False)
    weight = cv2.boxFilter(known.view(np.uint8), cv2.CV_32F, size, normalize=False)
    np.maximum(weight, np.float32(1.0), out=weight)
    return np.asarray(np.divide(total, weight, out=total), dtype=np.float32)


def fit_contrast(
    local: LocalMeans, start_db: float, *, fainter: bool = False
) -> tuple[float, float] | None:
    """Measure σ_r/σ_s on the view's own shadows.

    Shadows are found first, as patches of low mean power, and the level is that of their interiors:
    single pixels of seabed speckle, or a receiver that clips at zero, then do not count as shadow.

    Parameters
    ----------
    local : LocalMeans
        Of the view's power (i/σ_r)²/2.
    start_db : float
        Contrast to start from.
    fainter : bool
        Where that finds no shadow, look for a fainter one.

    Returns
    -------
    (contrast, shadow_fraction) or None
        None where the view holds no shadow to measure: the fit is then refused rather than trusted.
    """
    # A pixel is inside a shadow if all of its neighbours are dark: if the brightest of them is.
    # Halfway between the two levels in dB; boxes of so many looks seldom cross it by chance. No threshold
    # that is asked for below lies higher than that of the least contrast.
    started = 10.0 ** (start_db / 10.0)
    levels, powers = local.interiors(float(np.float32(min(started, _MIN_CONTRAST2) ** -0.5)))
    fit = _fitted(levels, powers, started, local)
    if fit is None and fainter and started > _FAINT_CONTRAST2:
        fit = _fitted(levels, powers, _FAINT_CONTRAST2, local)
    return fit


def _fitted(
    levels: FloatImage, powers: FloatImage, contrast2: float, local: LocalMeans
) -> tuple[float, float] | None:
    """Measure the contrast on the interiors of what is dark by half of a first guess."""
    count = 0
    for _ in range(3):
        interior = powers[levels < contrast2**-0.5]
        count = interior.size
        if count < local.pixels(_LEAST_CELLS):
            return None
        contrast2 = 1.0 / max(float(interior.mean(dtype=np.float64)), 1e-6)
        if contrast2 < _MIN_CONTRAST2:
            return None
    return math.sqrt(contrast2), count / local.total_known


def view_levels(
    view: View, parameters: LikelihoodParameters | None = None, *, target: bool = True
) -> Levels:
    """Estimate a view's σ_r and σ_s.

    Parameters
    ----------
    view : View
        Amplitude after enhancement.
    parameters : LikelihoodParameters
        Local or global seabed level; measured or assumed contrast.
    target : bool
        Whether a target throws its shadow here. Where none is known to, a faint patch is no shadow.

    Raises
    ------
    ViewError
        If the view is not a real amplitude image, or holds too little to estimate levels.
    """
    p = parameters or LikelihoodParameters()
    amplitude: FloatImage = view.pixels
    if amplitude.dtype != np.float32:
        raise ViewError(f"shadow view has {amplitude.dtype} pixels; expected float32 amplitude")
    amplitude = np.ascontiguousarray(amplitude)
    power, known = np.empty(amplitude.shape, np.float32), np.empty(amplitude.shape, np.bool_)
    spans = np.empty((amplitude.shape[0], 2), np.int32)
    seabed = np.empty(tuple(-(-n // 8) for n in amplitude.shape), np.float32)
    _relative_power(amplitude, seabed_level(amplitude, p.background), power, known, spans, seabed)
    local = LocalMeans(power, known, view.info.cell_px, spans)
    fit = None
    if p.shadow_level == "estimated":
        fit = fit_contrast(local, p.shadow_contrast_db, fainter=target)
    contrast, fraction = fit or (10.0 ** (p.shadow_contrast_db / 20.0), math.nan)
    return Levels(_median(seabed), contrast, fraction, fit is not None, local)


def echo_mask(local: LocalMeans, echo_db: float) -> NDArray[np.bool_]:
    """Mark echoes: pixels whose mean power over a box of a cell is `echo_db` above the seabed's.

    Parameters
    ----------
    local : LocalMeans
        Of the view's power (i/σ_r)²/2.
    echo_db : float
        Threshold over the seabed's mean power 2σ_r², dB.
    """
    return local.echoes(10.0 ** (echo_db / 10.0))


def outside_likelihood(
    view: View, parameters: LikelihoodParameters | None = None, levels: Levels | None = None
) -> View:
    """Turn a shadow view into l_out per pixel (section 4.2).

    Parameters
    ----------
    view : View
        float32 amplitude after enhancement, NaN where unknown.
    parameters : LikelihoodParameters
        Levels and treatment of echoes.
    levels : Levels, optional
        Levels that were estimated before.

    Returns
    -------
    View
        float32 l_out in [0, 1]; NaN where the view knows nothing (off the image, and in the target's
        echo unless told otherwise).

    Raises
    ------
    ViewError
        If the levels cannot be estimated.
    """
    p = parameters or LikelihoodParameters()
    levels = levels or view_levels(view, p)
    power = levels.power
    if p.smoothing_m > 0:
        rows_m, cols_m = view.info.camera.spacing_m
        radius = round(p.smoothing_m / (2.0 * rows_m)), round(p.smoothing_m / (2.0 * cols_m))
        power = box_mean(power, levels.known, radius)
    out = np.empty_like(power)
    _l_out_of_known(
        power, levels.known, levels.unknown_echoes(p), levels.local.spans, *_constants(levels.contrast), out
    )
    return replace(view, pixels=out)
