"""From likelihoods to the object's voxels: the threshold, the support and the clean-up."""

from __future__ import annotations

import math

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..methods import method_named
from ..parameters import CarvingParameters
from .volume import Volume, VoxelGrid

#: No object: the darkest voxels are brighter than this fraction of the brightest.
_NO_OBJECT = 0.5
#: How many voxels "the darkest" are.
_DARKEST = 27
#: Pieces of less than this fraction of the largest piece are noise.
_PIECE = 0.05
#: An object has at least this many voxels in its largest piece; fewer are noise, and no object.
LEAST_VOXELS = 27


def object_threshold(likelihood: NDArray[np.float32], method: str) -> float:
    """Choose the threshold from the distribution of the voxels' likelihood (section 4.2).

    Parameters
    ----------
    likelihood : ndarray of float32
        Mean l_out, or the fraction of views that contradict the voxel; NaN unknown.
    method : str
        How it was carved: a name of `METHODS`.

    Returns
    -------
    float
        Threshold; NaN where no voxel is much darker than the rest, and the rest is free: there is no object.
    """
    how = method_named(method)
    known = likelihood[np.isfinite(likelihood)]
    if known.size < 2 * _DARKEST:
        return math.nan
    dark = float(np.partition(known, _DARKEST)[:_DARKEST].mean())
    bright = float(np.percentile(known, 99.0))
    inside = how.support if how.under is None else how.under
    if bright < inside:
        return inside  # nothing of the volume is seen to be free: it lies within the object
    if dark > _NO_OBJECT * bright:
        return math.nan
    return dark + how.level * (bright - dark) if how.under is None else how.under


def supported(dark: NDArray[np.bool_], likelihood: NDArray[np.float32], limit: float) -> NDArray[np.bool_]:
    """Extend dark voxels downwards, as objects rest on the seabed.

    The target's own echo lies over the pixels where its lowest voxels would cast their shadow, so that these
    look lit or unknown. A voxel below one of the object belongs to it unless its likelihood is over
    `limit`: under an overhang the seabed is seen lit, and the gap stays.

    Parameters
    ----------
    dark : ndarray of bool, shape (nz, ny, nx)
        Voxels under the threshold.
    likelihood : ndarray of float32, shape (nz, ny, nx)
        NaN unknown.
    limit : float
        Likelihood that contradicts.
    """
    out = dark.copy()
    with np.errstate(invalid="ignore"):
        open_to = ~(likelihood >= limit)
    for k in range(out.shape[0] - 2, -1, -1):
        out[k] |= out[k + 1] & open_to[k]
    return out


def least_views_fraction(parameters: CarvingParameters) -> float:
    """Return the fraction of the views that must know a voxel for it to have a likelihood at all.

    By silhouettes, a few views can tell that a voxel is *not* object. What they cannot do alone is to
    say that it is: see `occupied_voxels`.
    """
    return min(parameters.min_views_fraction, method_named(parameters.method).least_views)


def occupied_voxels(
    likelihood: NDArray[np.float32],
    threshold: float,
    method: str,
    well_seen: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """Return the object's voxels: under the threshold, supported, without stray pieces.

    A few voxels alone are no object: the smallest is 27 voxels in one piece.

    Parameters
    ----------
    likelihood : ndarray of float32, shape (nz, ny, nx)
        NaN unknown: never object by itself.
    threshold : float
        NaN for no object.
    method : str
        How it was carved.
    well_seen : ndarray of bool, shape (nz, ny, nx), optional
        Voxels that enough views know. One that fewer know, as its shadow leaves the image in most views, is
        object only where it stands on the object: high tops stay, phantom roofs do not.
    """
    how = method_named(method)
    if math.isnan(threshold):
        return np.zeros(likelihood.shape, bool)
    with np.errstate(invalid="ignore"):
        dark = likelihood < threshold
    limit = max(how.support, threshold)
    if well_seen is None:
        body = supported(dark, likelihood, limit)
    else:
        known = np.where(well_seen, likelihood, np.float32(np.nan))
        body = supported(dark & well_seen, known, limit)
        for k in range(1, body.shape[0]):
            body[k] |= dark[k] & ~well_seen[k] & body[k - 1]
    labels, count = scipy.ndimage.label(body, np.ones((3, 3, 3), bool))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    if sizes.max() < LEAST_VOXELS:
        return np.zeros(likelihood.shape, bool)
    return np.asarray((sizes >= _PIECE * sizes.max())[labels] & body)


def well_seen_voxels(
    views: NDArray[np.uint16], method: str, min_views_fraction: float, most_views: int = 0
) -> NDArray[np.bool_] | None:
    """Return the voxels that enough views know to be object by themselves.

    Enough are a fraction of those that know the best known voxel, of a whole volume also in a part of it.
    None if a voxel that fewer know is unknown anyway, as it is unless few views may say that it is free.
    """
    if method_named(method).least_views >= 1.0:
        return None
    return views >= max(1, math.ceil(min_views_fraction * int(views.max(initial=most_views))))


def thresholded(
    volume: Volume,
    likelihood: NDArray[np.float32],
    views: NDArray[np.uint16],
    parameters: CarvingParameters,
    most_views: int = 0,
) -> VoxelGrid:
    """Make the grid of carved likelihoods, by the given or the automatic threshold.

    Parameters
    ----------
    volume : Volume
        The lattice.
    likelihood : ndarray of float32, shape (nz, ny, nx)
        NaN unknown.
    views : ndarray of uint16, shape (nz, ny, nx)
        How many views know something of each voxel.
    parameters : CarvingParameters
        Method and threshold.
    most_views : int
        So many views know some voxel of a larger volume that this one is a part of.
    """
    method = parameters.method
    threshold = parameters.threshold or object_threshold(likelihood, method)
    well_seen = well_seen_voxels(views, method, parameters.min_views_fraction, most_views)
    occupied = occupied_voxels(likelihood, threshold, method, well_seen)
    return VoxelGrid(volume, likelihood, views, threshold, occupied, method)


def needed_threshold(
    likelihood: NDArray[np.float32], method: str, well_seen: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Return the threshold at which each voxel becomes object, stray pieces included.

    ``needed_threshold(…) < t`` is the body of `occupied_voxels` at t before the small pieces are left
    out, for every t at once: what a threshold that is moved by hand works on.

    Parameters
    ----------
    likelihood, method, well_seen
        As of `occupied_voxels`.

    Returns
    -------
    ndarray of float32, shape (nz, ny, nx)
        Infinite where no threshold makes the voxel object.
    """
    never = np.float32(np.inf)
    trusted = likelihood if well_seen is None else np.where(well_seen, likelihood, np.float32(np.nan))
    out = np.where(np.isnan(trusted), never, trusted)
    support = np.float32(method_named(method).support)
    for k in range(out.shape[0] - 2, -1, -1):
        with np.errstate(invalid="ignore"):
            open_to = np.isnan(trusted[k]) | (trusted[k] < support)
        out[k] = np.where(open_to, np.minimum(out[k], out[k + 1]), out[k])
    if well_seen is not None:
        for k in range(1, out.shape[0]):
            own = np.where(np.isnan(likelihood[k]), never, likelihood[k])
            standing = np.maximum(own, out[k - 1])
            out[k] = np.where(well_seen[k], out[k], np.minimum(out[k], standing))
    return np.asarray(out, dtype=np.float32)
