"""Pictures for the eye: amplitudes in decibels, in 8 bits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: What is shown, dB over the view's median amplitude, which is about the seabed's. Of a seabed of fully
#: developed speckle (Rayleigh) 98 % of the pixels lie between -18 and +8 dB, and its shadow lies about 12 dB
#: lower (the `shadow_contrast_db` that the likelihood starts from); echoes saturate.
LOWEST_DB, HIGHEST_DB = -25.0, 15.0


def decibel_picture(amplitude: NDArray[Any]) -> NDArray[np.uint8]:
    """Turn amplitudes into a picture, in decibels over their median.

    Parameters
    ----------
    amplitude : ndarray of float, shape (rows, cols)
        Amplitudes; NaN where nothing is known.

    Returns
    -------
    ndarray of uint8, shape (rows, cols)
        1 at `LOWEST_DB` and below, 255 at `HIGHEST_DB` and above, linear in dB between; 0 for NaN.

    Examples
    --------
    >>> decibel_picture(np.array([[0.0, 1.0, 1.0, 1.0, 100.0, np.nan]], np.float32)).tolist()
    [[1, 160, 160, 160, 255, 0]]
    """
    known = np.isfinite(amplitude)
    out = np.zeros(amplitude.shape, np.uint8)
    values = amplitude[known].astype(np.float32)
    if values.size == 0:
        return out
    lowest = 10.0 ** (LOWEST_DB / 20.0)
    relative = values / max(float(np.median(values)), float(np.finfo(np.float32).tiny))
    level_db = 20.0 * np.log10(np.clip(relative, lowest, 10.0 ** (HIGHEST_DB / 20.0)))
    share = (level_db - LOWEST_DB) / (HIGHEST_DB - LOWEST_DB)
    out[known] = np.rint(1.0 + 254.0 * share).astype(np.uint8)
    return out
