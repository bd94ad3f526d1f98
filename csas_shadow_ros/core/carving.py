"""Space carving: from views of shadows to a voxel grid (section 4 of the paper).

A voxel projects to the seabed pixel where its shadow would fall; P · X does it for every view. Soft
carving averages l_out there over the views. Hard carving removes a voxel as soon as it falls outside
one view's segmented shadow. Consensus carving, the default, removes it when a few per cent of the
views agree that it does: one bad silhouette then does no harm.

All accumulate whole numbers, so that the grid does not depend on the order in which views arrive,
and all remember the stamps they hold, so that a view counts once however often it is sent.

Consensus carving looks twice. The first time a lit pixel between an echo and the shadow behind it says
nothing, as it may be the target's own echo. The shape that this leaves tells which of these pixels its
echo can cover; the others are seabed, and carve what the first look left standing under overhangs.
"""

from __future__ import annotations

import math
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from .echo import echo_zone, opaque_part
from .errors import ParameterError, ViewError
from .geometry import View, ViewInfo
from .parameters import CarvingParameters
from .threshold import least_views_fraction, thresholded
from .volume import Volume, VoxelGrid

#: l_out is accumulated in steps of 1/4096, far below the spread of its estimate.
_SCALE = 4096
#: Values of a shadow mask (mono8). Covered: lit, between an echo and the shadow behind it; either the
#: target's own echo, laid over what it hides, or seabed that is seen under it.
MASK_OUTSIDE, MASK_COVERED, MASK_UNKNOWN, MASK_SHADOW = 0, 64, 128, 255
#: The second look is taken so many voxels round what the first one left.
_SECOND_LOOK_VOXELS = 2


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


@dataclass(frozen=True, eq=False)
class KeptMask:
    """A shadow mask, kept small: some kB for a view."""

    info: ViewInfo
    packed: bytes

    @classmethod
    def of(cls, view: View) -> KeptMask:
        """Keep a mask."""
        return cls(view.info, zlib.compress(np.ascontiguousarray(view.pixels).tobytes(), 1))

    def view(self) -> View:
        """Return the mask as it was."""
        pixels = np.frombuffer(zlib.decompress(self.packed), np.uint8)
        return View(self.info, pixels.reshape(self.info.camera.shape))


def _outside_of_mask(pixels: NDArray[np.uint8], echo: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """Return 1 outside the silhouette, 0 inside, NaN unknown; covered pixels count outside but in `echo`."""
    outside = np.where(pixels == MASK_SHADOW, np.float32(0.0), np.float32(1.0))
    outside[pixels == MASK_UNKNOWN] = np.nan
    covered = pixels == MASK_COVERED
    outside[covered if echo is None else covered & echo] = np.nan
    return outside


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
    Memory is that of the grid (6 bytes a voxel), however many views are integrated; the consensus method also
    keeps the silhouettes, compressed to some kB each, for its second look.
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
        self._masks: dict[int, KeptMask] = {}
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
        top = self.volume.z_m[-1]
        if top >= view.info.camera.sonar_m[2]:
            raise ViewError(
                f"the volume reaches {top:g} m, the sonar is at {view.info.camera.sonar_m[2]:g} m;"
                " expected it above"
            )
        _add(image, view.info, self.volume, self._total, self._count, self._pool)
        self.stamps.add(view.info.stamp_ns)
        if self.parameters.method == "consensus":
            self._masks[view.info.stamp_ns] = KeptMask.of(view)
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
        odd = ~np.isin(pixels, (MASK_SHADOW, MASK_OUTSIDE, MASK_UNKNOWN, MASK_COVERED))
        if odd.any():
            raise ViewError(f"shadow mask holds the value {pixels[odd][0]}; expected 0, 64, 128 or 255")
        return _outside_of_mask(pixels)

    def likelihood(self) -> NDArray[np.float32]:
        """Return the mean of l_out (masks: the fraction of views that contradict the voxel); NaN unknown."""
        return _mean(self._total, self._count, self.parameters, len(self.stamps))

    def grid(self) -> VoxelGrid:
        """Threshold what has been carved so far.

        Returns
        -------
        VoxelGrid
            With NaN threshold and nothing occupied where there is no object.
        """
        first = self.first_look()
        if self.parameters.method != "consensus" or not first.occupied.any():
            return first
        return self._second_look(first)

    def first_look(self) -> VoxelGrid:
        """Threshold what has been carved so far, covered pixels unknown: what `grid` starts from."""
        return thresholded(self.volume, self.likelihood(), self._count.copy(), self.parameters)

    def _second_look(self, first: VoxelGrid) -> VoxelGrid:
        """Carve again what the first look left, with the pixels that its own echo cannot cover as seabed."""
        box, part = part_around(first.occupied, self.volume, _SECOND_LOOK_VOXELS)
        body = first.occupied[box]
        total, count = np.zeros(part.shape, np.int32), np.zeros(part.shape, np.uint16)
        opaque: dict[int, NDArray[np.bool_]] = {}
        for stamp in sorted(self._masks):
            kept = self._masks[stamp]
            pixels = kept.view().pixels
            zone = None
            if (pixels == MASK_COVERED).any():
                # The grazing angle hardly changes round the circle: one body a quarter of a degree.
                quarters = round(math.degrees(kept.info.camera.grazing_rad) * 4.0)
                if quarters not in opaque:
                    opaque[quarters] = opaque_part(body, math.radians(quarters / 4.0))
                zone = echo_zone(kept.info, part, body, opaque[quarters])
            _add(_outside_of_mask(pixels, zone), kept.info, part, total, count, self._pool)
        likelihood, views = first.likelihood.copy(), first.views.copy()
        likelihood[box] = _mean(total, count, self.parameters, len(self.stamps))
        views[box] = count
        return thresholded(self.volume, likelihood, views, self.parameters)


def _add(
    image: NDArray[np.float32],
    info: ViewInfo,
    volume: Volume,
    total: NDArray[np.int32],
    count: NDArray[np.uint16],
    pool: ThreadPoolExecutor | None,
) -> None:
    """Add an image to every voxel of a volume, at its shadow's pixel."""
    affines = np.stack([info.camera.height_slice_affine(float(z)) for z in volume.z_m])
    x0, y0, _ = volume.origin_m

    def work(first: int, last: int) -> None:
        _carve_slices(image, affines, x0, y0, volume.voxel_size_m, first, last, total, count)

    _threads(pool, work, volume.shape[0])


def _mean(
    total: NDArray[np.int32], count: NDArray[np.uint16], parameters: CarvingParameters, views: int
) -> NDArray[np.float32]:
    """Return total over count; NaN where too few of the views know anything."""
    least = max(1, math.ceil(least_views_fraction(parameters) * views))
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = total / (count.astype(np.float32) * np.float32(_SCALE))
    return np.where(count >= least, mean, np.float32(np.nan)).astype(np.float32)


def part_around(occupied: NDArray[np.bool_], volume: Volume, margin: int) -> tuple[tuple[slice, ...], Volume]:
    """Return the part of a volume round its occupied voxels."""
    box = []
    for axis in range(3):
        other = tuple(a for a in range(3) if a != axis)
        where = np.flatnonzero(occupied.any(axis=other))
        box.append(slice(max(0, where[0] - margin), min(occupied.shape[axis], where[-1] + margin + 1)))
    origin = tuple(o + box[2 - i].start * volume.voxel_size_m for i, o in enumerate(volume.origin_m))
    shape = tuple(s.stop - s.start for s in box)
    part = Volume((origin[0], origin[1], origin[2]), volume.voxel_size_m, (shape[0], shape[1], shape[2]))
    return tuple(box), part


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
