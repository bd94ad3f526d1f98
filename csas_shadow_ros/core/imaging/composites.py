"""Images of the whole circle: multi-look, and colour by aspect (section 2 of the paper).

Both are made of the sub-aperture views, one by one, so that they grow while the run goes on and hold
three planes of memory whatever the number of views.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.color import hsv2rgb

from ..errors import ParameterError, check_range
from ..geometry import TWO_PI, GroundGrid, View
from ..kernels import kernel

FloatImage = NDArray[np.float32]


def _power(pixels: NDArray[Any]) -> FloatImage:
    """Return |i|² of complex or amplitude pixels."""
    if not np.iscomplexobj(pixels):
        return np.asarray(np.square(pixels), dtype=np.float32)
    out = np.empty(pixels.shape, np.float32)
    _power_of_parts(np.ascontiguousarray(pixels, np.complex64).view(np.float32), out)
    return out


@kernel()
def _power_of_parts(parts: FloatImage, out: FloatImage) -> None:  # pragma: no cover
    rows, cols = out.shape
    for v in range(rows):
        line, to = parts[v], out[v]
        for u in range(cols):
            to[u] = line[2 * u] * line[2 * u] + line[2 * u + 1] * line[2 * u + 1]


@kernel()
def _add(
    warped: FloatImage,
    cosine: np.float32,
    sine: np.float32,
    power: FloatImage,
    count: FloatImage,
    east: FloatImage,
    north: FloatImage,
) -> None:  # pragma: no cover
    """Add a view's power to the sums where it is finite: the view knows nothing elsewhere."""
    rows, cols = warped.shape
    for v in range(rows):
        line = warped[v]
        p, n, x, y = power[v], count[v], east[v], north[v]
        for u in range(cols):
            known = line[u] < np.float32(np.inf)
            value = line[u] if known else np.float32(0.0)
            p[u] += value
            n[u] += np.float32(known)
            x[u] += value * cosine
            y[u] += value * sine


class Composites:
    """Accumulate views into multi-look and colour-by-aspect images.

    Parameters
    ----------
    grid : GroundGrid
        North-up lattice of the images; a pixel like the views' loses nothing.
    """

    def __init__(self, grid: GroundGrid) -> None:
        self.grid = grid
        self._power = np.zeros(grid.shape, np.float32)
        self._resultant = np.zeros((2, *grid.shape), np.float32)
        self._count = np.zeros(grid.shape, np.float32)
        #: Stamps of the views that have been integrated.
        self.stamps: set[int] = set()

    @classmethod
    def for_view(cls, view: View) -> Composites:
        """Make an accumulator with a grid that covers the ground of views like this one."""
        camera = view.info.camera
        spacing = float(np.mean(camera.spacing_m))
        middle = camera.pixel_to_ground[:2] @ np.array(
            [(camera.cols - 1) / 2.0, (camera.rows - 1) / 2.0, 1.0]
        )
        side = max(camera.shape)
        return cls(GroundGrid.centred(side, side, spacing, (float(middle[0]), float(middle[1]))))

    def integrate(self, view: View) -> bool:
        """Add one view, complex or amplitude.

        Returns
        -------
        bool
            False if a view of this stamp was added before; nothing changes then.
        """
        if view.info.stamp_ns in self.stamps:
            return False
        power = _power(view.pixels)
        # Output pixel → ground → view pixel: what cv2 calls the inverse map.
        to_view = view.info.camera.ground_to_pixel @ np.linalg.inv(self.grid.ground_to_pixel)
        warped: Any = cv2.warpAffine(
            power,
            to_view[:2],
            (self.grid.cols, self.grid.rows),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=math.nan,
        )
        aspect = view.info.aspect_rad
        planes = (self._power, self._count, *self._resultant)
        _add(warped, np.float32(math.cos(aspect)), np.float32(math.sin(aspect)), *planes)
        self.stamps.add(view.info.stamp_ns)
        return True

    def multilook(self) -> NDArray[np.float32]:
        """Return the multi-look amplitude, the root of the mean power over the views; NaN where unseen."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self._count > 0, np.sqrt(self._power / self._count), np.float32(np.nan))

    def dominant_aspect(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the mean direction of each pixel's echo and how anisotropic it is.

        Returns
        -------
        aspect_rad : ndarray of float32, shape (rows, cols)
            Direction of Σ P(θ) (cos θ, sin θ), in [0, 2π).
        anisotropy : ndarray of float32, shape (rows, cols)
            |Σ P û| / Σ P: 0 the same from all sides, 1 seen from one side only.
        """
        length = np.hypot(*self._resultant)
        anisotropy = length / np.maximum(self._power, np.finfo(np.float32).tiny)
        aspect = np.mod(np.arctan2(self._resultant[1], self._resultant[0]), TWO_PI)
        return aspect.astype(np.float32), np.clip(anisotropy, 0, 1).astype(np.float32)

    def color_by_aspect(self, dynamic_range_db: float = 35.0) -> NDArray[np.uint8]:
        """Return the colour-by-aspect image: hue the aspect, saturation the anisotropy, value the level.

        Parameters
        ----------
        dynamic_range_db : float
            Levels shown, down from the 99.9th percentile.

        Returns
        -------
        ndarray of uint8, shape (rows, cols, 3)
            RGB; black where no view looked.
        """
        check_range("dynamic_range_db", dynamic_range_db, 1, 200, "dB")
        aspect, anisotropy = self.dominant_aspect()
        value = level_image(self.multilook(), dynamic_range_db)
        # The resultant of speckle alone is about 1/sqrt(looks), 0.2 for 12° views: shown as no colour.
        saturation = np.clip((anisotropy - 0.2) / 0.5, 0.0, 1.0)
        hsv = np.stack([aspect / TWO_PI, saturation, value], axis=-1)
        return np.asarray(np.round(hsv2rgb(hsv) * 255.0), dtype=np.uint8)


def level_image(amplitude: NDArray[np.floating], dynamic_range_db: float) -> NDArray[np.float32]:
    """Map amplitude to [0, 1] over a range in dB, 1 at its 99.9th percentile; 0 where unknown."""
    known = np.isfinite(amplitude) & (amplitude > 0)
    if not known.any():
        raise ParameterError("the image has no known pixel above zero; expected something to show")
    top = np.percentile(amplitude[known], 99.9)
    with np.errstate(divide="ignore", invalid="ignore"):
        db = 20.0 * np.log10(amplitude / top)
    return np.where(known, np.clip(1.0 + db / dynamic_range_db, 0.0, 1.0), 0.0).astype(np.float32)
