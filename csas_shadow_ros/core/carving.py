"""Space carving: from views of shadows to a voxel grid (section 4 of the paper).

A voxel projects to the seabed pixel where its shadow would fall; P · X does it for every view. Soft
carving averages l_out there over the views. Hard carving removes a voxel as soon as it falls outside
one view's segmented shadow. Consensus carving, the default, removes it when a few per cent of the
views agree that it does: one bad silhouette then does no harm.

All accumulate whole numbers, so that the grid does not depend on the order in which views arrive,
and all remember the stamps they hold, so that a view counts once however often it is sent.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from .errors import ParameterError, ViewError
from .geometry import View
from .parameters import CarvingParameters
from .threshold import thresholded
from .volume import Volume, VoxelGrid

#: l_out is accumulated in steps of 1/4096, far below the spread of its estimate.
_SCALE = 4096
#: Values of a shadow mask (mono8).
MASK_OUTSIDE, MASK_UNKNOWN, MASK_SHADOW = 0, 128, 255


@numba.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz"})
def _carve_slices(
    image: NDArray[np.float32],
    affines: NDArray[np.float64],
    x0: float,
    y0: float,
    step: float,
    first: int,
    last: int,
    total: NDArray[np.int32],
    count: NDArray[np.uint16],
) -> None:  # pragma: no cover
    """Add the image at every voxel's shadow pixel (bilinear) to the slices [first, last)."""
    rows, cols = image.shape
    ny, nx = total.shape[1:]
    for k in range(first, last):
        a = affines[k]
        du, dv = a[0, 0] * step, a[1, 0] * step
        for j in range(ny):
            y = y0 + j * step
            u = a[0, 0] * x0 + a[0, 1] * y + a[0, 2]
            v = a[1, 0] * x0 + a[1, 1] * y + a[1, 2]
            for i in range(nx):
                uu, vv = u + i * du, v + i * dv
                if uu < 0.0 or vv < 0.0 or uu > cols - 1 or vv > rows - 1:
                    continue
                iu, iv = min(int(uu), cols - 2), min(int(vv), rows - 2)
                fu, fv = np.float32(uu - iu), np.float32(vv - iv)
                top = image[iv, iu] + fu * (image[iv, iu + 1] - image[iv, iu])
                low = image[iv + 1, iu] + fu * (image[iv + 1, iu + 1] - image[iv + 1, iu])
                value = top + fv * (low - top)
                if value == value:  # NaN where any neighbour is unknown
                    total[k, j, i] += np.int32(value * np.float32(4096.0) + np.float32(0.5))
                    count[k, j, i] += np.uint16(1)


def _threads(pool: ThreadPoolExecutor | None, work: Any, slices: int) -> None:
    if pool is None or slices < 2:
        work(0, slices)
        return
    middle = slices // 2
    list(pool.map(lambda ends: work(*ends), ((0, middle), (middle, slices))))


class Carver:
    """A voxel grid that views are integrated into, one by one and in any order.

    Parameters
    ----------
    volume : Volume
        What to carve.
    parameters : CarvingParameters
        Method, threshold, least number of views.
    pool : ThreadPoolExecutor, optional
        Carve the lower and the upper half of the volume at the same time.

    Notes
    -----
    Memory is that of the grid (6 bytes a voxel), however many views are integrated.
    """

    def __init__(
        self,
        volume: Volume,
        parameters: CarvingParameters | None = None,
        *,
        pool: ThreadPoolExecutor | None = None,
    ) -> None:
        self.volume = volume
        self.parameters = parameters or CarvingParameters()
        self._pool = pool
        self._total = np.zeros(volume.shape, np.int32)
        self._count = np.zeros(volume.shape, np.uint16)
        #: Stamps of the views that have been integrated.
        self.stamps: set[int] = set()

    def integrate(self, view: View) -> bool:
        """Integrate one view.

        Parameters
        ----------
        view : View
            For the soft method l_out (float32, NaN unknown); for the others a shadow mask (uint8: 255
            shadow, 0 outside, 128 unknown).

        Returns
        -------
        bool
            False if a view of this stamp was integrated before; nothing changes then.

        Raises
        ------
        ViewError
            If the pixels are not what the method takes, or the sonar is below the volume's top.
        """
        if view.info.stamp_ns in self.stamps:
            return False
        if len(self.stamps) >= np.iinfo(np.uint16).max:
            raise ViewError(f"the grid holds {len(self.stamps)} views; expected no more than that")
        image = self._image(view)
        camera = view.info.camera
        top = self.volume.z_m[-1]
        if top >= camera.sonar_m[2]:
            raise ViewError(
                f"the volume reaches {top:g} m, the sonar is at {camera.sonar_m[2]:g} m; expected it above"
            )
        affines = np.stack([camera.height_slice_affine(float(z)) for z in self.volume.z_m])
        x0, y0, _ = self.volume.origin_m

        def work(first: int, last: int) -> None:
            _carve_slices(
                image, affines, x0, y0, self.volume.voxel_size_m, first, last, self._total, self._count
            )

        _threads(self._pool, work, self.volume.shape[0])
        self.stamps.add(view.info.stamp_ns)
        return True

    def _image(self, view: View) -> NDArray[np.float32]:
        pixels = view.pixels
        method = self.parameters.method
        if not self.parameters.takes_masks:
            if pixels.dtype != np.float32:
                raise ViewError(f"soft carving got {pixels.dtype} pixels; expected float32 l_out")
            low, high = float(np.nanmin(pixels, initial=1.0)), float(np.nanmax(pixels, initial=0.0))
            if low < 0.0 or high > 1.0:
                raise ViewError(f"l_out of the view spans [{low:g}, {high:g}]; expected [0, 1] or NaN")
            return np.ascontiguousarray(pixels)
        if pixels.dtype != np.uint8:
            raise ViewError(f"{method} carving got {pixels.dtype} pixels; expected a uint8 mask")
        odd = ~((pixels == MASK_SHADOW) | (pixels == MASK_OUTSIDE) | (pixels == MASK_UNKNOWN))
        if odd.any():
            raise ViewError(f"shadow mask holds the value {pixels[odd][0]}; expected 0, 128 or 255")
        outside = np.where(pixels == MASK_SHADOW, np.float32(0.0), np.float32(1.0))
        outside[pixels == MASK_UNKNOWN] = np.nan
        return outside

    def likelihood(self) -> NDArray[np.float32]:
        """Return the mean of l_out (masks: the fraction of views that contradict the voxel); NaN unknown."""
        least = max(1, math.ceil(self.parameters.min_views_fraction * len(self.stamps)))
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = self._total / (self._count.astype(np.float32) * np.float32(_SCALE))
        return np.where(self._count >= least, mean, np.float32(np.nan)).astype(np.float32)

    def grid(self) -> VoxelGrid:
        """Threshold what has been carved so far.

        Returns
        -------
        VoxelGrid
            With NaN threshold and nothing occupied where there is no object.
        """
        return thresholded(self.volume, self.likelihood(), self._count.copy(), self.parameters)


def carve(views: list[View], volume: Volume, parameters: CarvingParameters | None = None) -> VoxelGrid:
    """Carve a volume with all views at once.

    Raises
    ------
    ParameterError
        If there is no view.
    """
    if not views:
        raise ParameterError("there are no views; expected at least one to carve with")
    carver = Carver(volume, parameters)
    for view in views:
        carver.integrate(view)
    return carver.grid()
