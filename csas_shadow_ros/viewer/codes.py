"""Pixels as the page gets them: one byte each, and their pictures."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..core.errors import ViewError
from ..core.imaging.mask_codes import MASK_SHADOW

#: Amplitudes: code 1 is so many dB over the view's median (the seabed's level), each further code a step.
LOW_DB, STEP_DB = -32.0, 0.25
#: Of every view so many pixels tell the median.
_SAMPLE = 1 << 16
#: Colour of what no view knows.
_UNKNOWN = (24, 40, 96)
Codes = NDArray[np.uint8]


def amplitude_codes(pixels: NDArray[Any]) -> Codes:
    """Code amplitudes (complex or real) by their level over the median; 0 where nothing is known.

    Raises
    ------
    ViewError
        If no pixel is known and over zero.
    """
    amplitude = np.abs(pixels).astype(np.float32, copy=False)
    sample = amplitude.ravel()[:: max(1, amplitude.size // _SAMPLE)]
    sample = sample[np.isfinite(sample) & (sample > 0)]
    if not sample.size:
        raise ViewError("the view has no known pixel above zero; expected something to show")
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.log10(amplitude / np.float32(np.median(sample)))
        code = level * np.float32(20.0 / STEP_DB) + np.float32(1.5 - LOW_DB / STEP_DB)
    return np.where(np.isnan(amplitude), np.float32(0), np.clip(code, 1, 255)).astype(np.uint8)


def likelihood_codes(pixels: NDArray[Any]) -> Codes:
    """Code l_out: 1 is 0, 255 is 1, and 0 unknown."""
    return np.where(np.isnan(pixels), 0, np.rint(1.0 + 254.0 * np.nan_to_num(pixels))).astype(np.uint8)


def likelihood_of(codes: Codes) -> NDArray[np.float32]:
    """Return l_out of its codes, to half of 1/254."""
    return np.where(codes == 0, np.float32(np.nan), (codes.astype(np.float32) - 1.0) / np.float32(254.0))


def shown(codes: Codes, kind: str) -> Codes:
    """Return codes as they are shown: likelihoods as grey, blue where unknown; all else as it is."""
    if kind != "likelihood":
        return codes
    grey = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    grey[0] = _UNKNOWN
    return np.asarray(grey[codes])


def picture(codes: NDArray[np.uint8], kind: str) -> bytes:
    """Encode codes, or RGB, as a picture.

    Parameters
    ----------
    codes : ndarray of uint8, shape (rows, cols) or (rows, cols, 3)
        Pixels.
    kind : {'jpg', 'png'}
        ``jpg`` for pictures that pass by, ``png`` is exact.
    """
    out = io.BytesIO()
    image = Image.fromarray(codes)
    if kind == "jpg":
        image.save(out, "JPEG", quality=90)
    else:
        image.save(out, "PNG", compress_level=1)
    return out.getvalue()


def contour(mask: NDArray[np.uint8]) -> list[list[float]]:
    """Return the outlines of a mask's shadow: one list (u0, v0, u1, v1, …) of pixels a closed line."""
    shadow = (mask == MASK_SHADOW).astype(np.uint8)
    lines, _ = cv2.findContours(shadow, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    thin = (cv2.approxPolyDP(line, 0.7, True) for line in lines if len(line) >= 3)
    return [line.ravel().tolist() for line in thin]
