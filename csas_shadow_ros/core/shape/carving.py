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
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ParameterError, ViewError
from ..geometry import View, ViewInfo
from ..imaging.mask_codes import MASK_COVERED, MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN
from ..imaging.masks import KeptMask
from ..kernels import kernel
from ..methods import method_named
from ..parameters import CarvingParameters
from ..threads import in_order
from .explained import ShadowFit, count_shadow_pixels, mean_fit, shadow_fit, unexplained_shadow
from .layover import MAIN_LOBE_CELLS, SIDELOBE_CELLS, echo_zones, opaque_part
from .plan import StandingPlan, plan_of_sides, shadow_sides
from .rings import filled_rings
from .seabed import SeabedSlope, seabed_slope, shadow_end
from .threshold import least_views_fraction, thresholded
from .volume import MARGIN_SHARE, Target, Volume, VoxelGrid

#: l_out is accumulated in steps of 1/4096, far below the spread of its estimate.
_SCALE = 4096
#: The second look is taken so many voxels round what the first one left.
_SECOND_LOOK_VOXELS = 2
#: Threads that do it.
_LOOKERS = 2
#: So many comparisons of bodies with the silhouettes are kept: those of one result.
_KEPT_FITS = 4
#: Voxels a side of the square blocks of a slice that are counted as one where a mask allows it.
_BLOCK = 8
#: Of a block that is not, parts of so many voxels a side are.
_PART = 4
#: What a block of voxels sees: shadow, lit seabed, nothing, or of each something.
_SHADOW, _LIT, _NOTHING, _MIXED = 0, 1, 2, 3
#: What an unknown pixel adds to the sums over a mask; blocks of more pixels than that are not looked up.
_UNKNOWN = 1 << 16
#: With what lit pixels on its plan took, a body must explain so much more of the segmented shadow (share,
#: mean over the views). Of 19 bodies of the population's development half a stack gains 0.27 of IoU at half
#: of it, a wedge loses 0.66 at double. A measured vehicle (docs/examples.md) would explain 0.024 more.
_EXPLAINED = 0.05
#: Or so much more than with what was taken from under it alone, less what either casts on lit seabed. Of 20
#: bodies of the development half the two cones and the pipe that gain by it explain 0.015 to 0.034 more so,
#: those that would lose (tables, crates, a rock, a pole) -0.13 to 0.011. At half a rock loses 0.05, at double
#: a cone of 5 dB 0.14.
_NET_EXPLAINED = 0.012
#: And casts so much of that at most on lit seabed (share of what it explains): the measured vehicle of
#: docs/examples.md, whose gun widens its plan, 0.5 to 0.6 (2.2 m too long with it); three bodies of the
#: development half that gain 0.2 to 0.3 of IoU by it 0.25 and less. At half one of these stays lost, at
#: double the vehicle is too long.
_LIT_OF_EXPLAINED = 1.0 / 3.0
#: And so much at most (share of what it explains) where nothing on its plan can echo. Fifteen bodies of the
#: development half that come back cast 0.00 to 0.03 there; a table on thin legs, whose shadows are lost, as a
#: block 0.27 to 0.83 (three headings, steps of 3 to 12 degrees). Chosen on both. At half and at
#: double the same come back.
_LIT_OFF_PLAN = 0.1
#: And less than this share of its views contradicts most of what comes back: a face is lit from half of the
#: circle at most, the seabed between bodies from nearly all of it. Of bodies of the development half 0.04 to
#: 0.31 do so; of a frame in its laying grid 0.55, where a slab of the grid's size would explain all shadows.
#: At half a wedge loses 0.61 and a table gains 0.12, at double the frame is that slab (IoU 0.09 for 0.50).
#: Chosen on both.
_FACING = 0.4
#: Or its top is lit from all round, as that of a low wide body: less than this share of the segmented shadow
#: lies on its plan, clear of the edges. Of seven low boxes, discs and frustums drawn at random 0.00 to 0.04
#: does, of walls round seabed 0.18 (test_own_echo.py), of frames in their laying grids, with a slab
#: of the grid's size, 0.48 to 0.60. At half nothing known changes; at double the walls are a slab.
_DARK_TOP = 0.1
#: Such a body's plan may be so many times as long and as wide as the volume that the search found: it found
#: 1.4 m of bricks of 2.0 and 1.6 m. These stay lost at half (IoU with the hull 0.05 for 0.8); double was not
#: measured.
_WIDER = 2.0
#: A body that leaves more than this of its segmented shadow unexplained is lost: the mean likelihood may tell
#: it instead. Where that tells nothing, what stands on the plan of its shadows may leave less than this
#: unexplained or lit. A box of 4 dB left 0.78. Double asks nothing; half was not measured.
_LOST = 0.5
#: What only the mean likelihood shows is a body unless it leaves more than this of the shadow unexplained.
#: Four empty seabeds of the development half have a phantom that leaves 0.53, 0.62, 0.82 and 0.90, and two
#: bodies of 6 dB are shown so that leave 0.54 (IoU with the hull 0.31) and 0.76 (0.00). At 0.5 all six are
#: candidates. At double nothing is.
_EXPLAINS_NOTHING = 0.75
#: Or they took so much from under the body (share of its voxels) at least. At half nothing changes, at double
#: a keg loses 0.09.
_UNDERCUT = 0.1
#: And less than this share of its views contradicts most of that. At half a tyre, a crate and an L plan lose
#: 0.2 to 0.3 each, at double a rock with an overhang loses 0.13.
_SELDOM = 0.1
#: Where only sidelobes of a body's echo may reach, so many times as many views must contradict a voxel as
#: elsewhere. Mean IoU of twenty bodies 0.791; half, as elsewhere, 0.782 (a rock loses 0.11, a sphere 0.07),
#: double 0.789: docs/method.md, "The second look".
_SIDELOBE_VIEWS = 2.0
_NOWHERE = np.empty((0, 0), np.bool_)


@kernel(fastmath={"contract", "arcp", "nsz"})
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


@kernel()
def _first_odd(mask: NDArray[np.uint8]) -> int:  # pragma: no cover
    """Return the first value that no mask may hold, -1 if there is none."""
    rows, cols = mask.shape
    for v in range(rows):
        odd = False
        for u in range(cols):
            m = mask[v, u]
            odd |= (m != MASK_OUTSIDE) & (m != MASK_COVERED) & (m != MASK_UNKNOWN) & (m != MASK_SHADOW)
        if odd:
            for u in range(cols):
                m = mask[v, u]
                if m not in (MASK_OUTSIDE, MASK_COVERED, MASK_UNKNOWN, MASK_SHADOW):
                    return int(m)
    return -1


@kernel()
def _cells_of_mask(
    mask: NDArray[np.uint8],
    echo: NDArray[np.bool_],
    first: tuple[int, int],
    cells: NDArray[np.uint8],
    sums: NDArray[np.uint32],
) -> None:  # pragma: no cover
    """Code the cells between four pixels of a part of a mask, and sum its pixels up.

    `first` is the part's first (row, col). A cell has a bit for each of its pixels that is outside the
    silhouette, and the fifth for any that is unknown; covered pixels are unknown in `echo` (everywhere if
    that is empty), outside elsewhere. `sums[v, u]` is the sum of the pixels above v and left of u: 1 outside,
    2¹⁶ unknown, modulo 2³².
    """
    rows, cols = cells.shape
    v0, u0 = first
    anywhere = echo.size == 0
    for v in range(rows):
        line = np.uint32(0)
        for u in range(cols):
            value = mask[v0 + v, u0 + u]
            if value == MASK_COVERED:
                value = MASK_UNKNOWN if anywhere or echo[v0 + v, u0 + u] else MASK_OUTSIDE
            code = np.uint8(0)
            if value == MASK_UNKNOWN:
                code = np.uint8(16)
                line += np.uint32(_UNKNOWN)
            elif value == MASK_OUTSIDE:
                code = np.uint8(1)
                line += np.uint32(1)
            sums[v + 1, u + 1] = sums[v, u + 1] + line
            cells[v, u] = code
    for v in range(rows - 1):
        for u in range(cols - 1):
            right, low, both = cells[v, u + 1], cells[v + 1, u], cells[v + 1, u + 1]
            code = cells[v, u] | ((right & 1) << 1) | ((low & 1) << 2) | ((both & 1) << 3)
            cells[v, u] = code | ((right | low | both) & 16)


@kernel(inline="always")
def _pixels_of(
    a: NDArray[np.float64], x0: float, y0: float, step: float, i0: int, i1: int, j0: int, j1: int
) -> tuple[int, int, int, int]:  # pragma: no cover
    """Return what pixels voxels [j0, j1) × [i0, i1) of a slice fall on: [left, right), [top, bottom).

    And one more all round: rounding, and neighbours in interpolation.
    """
    y = y0 + j0 * step
    du, dv = a[0, 0] * step, a[1, 0] * step
    u = a[0, 0] * x0 + a[0, 1] * y + a[0, 2] + i0 * du
    v = a[1, 0] * x0 + a[1, 1] * y + a[1, 2] + i0 * dv
    ru, rv = (i1 - 1 - i0) * du, (i1 - 1 - i0) * dv
    su, sv = (j1 - 1 - j0) * a[0, 1] * step, (j1 - 1 - j0) * a[1, 1] * step
    left = math.floor(u + min(ru, 0.0) + min(su, 0.0)) - 1
    right = math.floor(u + max(ru, 0.0) + max(su, 0.0)) + 3
    top = math.floor(v + min(rv, 0.0) + min(sv, 0.0)) - 1
    bottom = math.floor(v + max(rv, 0.0) + max(sv, 0.0)) + 3
    return left, right, top, bottom


@kernel(inline="always")
def _alike(
    sums: NDArray[np.uint32],
    a: NDArray[np.float64],
    x0: float,
    y0: float,
    step: float,
    i0: int,
    i1: int,
    j0: int,
    j1: int,
) -> int:  # pragma: no cover
    """Say what voxels [j0, j1) × [i0, i1) of a slice see: all the same, one of these, or `_MIXED`."""
    rows, cols = sums.shape[0] - 1, sums.shape[1] - 1
    left, right, top, bottom = _pixels_of(a, x0, y0, step, i0, i1, j0, j1)
    if right <= 0 or bottom <= 0 or left >= cols or top >= rows:
        return _NOTHING
    area = (right - left) * (bottom - top)
    if left < 0 or top < 0 or right > cols or bottom > rows or area >= _UNKNOWN:
        return _MIXED
    inside = np.uint32(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left])
    if inside == np.uint32(area) * np.uint32(_UNKNOWN):
        return _NOTHING
    if inside == np.uint32(0):
        return _SHADOW
    return _LIT if inside == np.uint32(area) else _MIXED


@kernel(inline="always")
def _of_cell(cell: int, fu: float, fv: float) -> int:  # pragma: no cover
    """Interpolate between the four pixels of a cell, which are known: a whole number of 1/4096."""
    if cell == 15:
        return _SCALE
    if cell == 0:
        return 0
    right, low = np.float32(fu), np.float32(fv)
    p00, p01 = np.float32(cell & 1), np.float32((cell >> 1) & 1)
    p10, p11 = np.float32((cell >> 2) & 1), np.float32(cell >> 3)
    upper = p00 + right * (p01 - p00)
    value = upper + low * (p10 + right * (p11 - p10) - upper)
    return int(value * np.float32(_SCALE) + np.float32(0.5))


@kernel(fastmath={"contract", "arcp", "nsz"})
def _carve_masks(  # noqa: C901, PLR0912  (a kernel)
    cells: NDArray[np.uint8],
    sums: NDArray[np.uint32],
    affines: NDArray[np.float64],
    x0: float,
    y0: float,
    step: float,
    first: int,
    last: int,
    total: NDArray[np.int32],
    count: NDArray[np.uint16],
    block_total: NDArray[np.int32],
    block_count: NDArray[np.uint16],
) -> None:  # pragma: no cover
    """Add a mask at every voxel's shadow pixel (bilinear) to the slices [first, last).

    A block of voxels whose shadow falls on pixels that are all alike is counted as one; of another one the
    parts that are so are at least not looked up voxel by voxel.
    """
    rows, cols = cells.shape
    ny, nx = total.shape[1:]
    one = np.int32(_SCALE)
    for k in range(first, last):
        a = affines[k]
        du, dv = a[0, 0] * step, a[1, 0] * step
        for bj in range(block_total.shape[1]):
            j0 = bj * _BLOCK
            j1 = min(j0 + _BLOCK, ny)
            for bi in range(block_total.shape[2]):
                i0 = bi * _BLOCK
                i1 = min(i0 + _BLOCK, nx)
                seen = _alike(sums, a, x0, y0, step, i0, i1, j0, j1)
                if seen == _NOTHING:
                    continue
                if seen != _MIXED:
                    block_count[k, bj, bi] += np.uint16(1)
                    if seen == _LIT:
                        block_total[k, bj, bi] += one
                    continue
                for pj in range(j0, j1, _PART):
                    qj = min(pj + _PART, j1)
                    for pi in range(i0, i1, _PART):
                        qi = min(pi + _PART, i1)
                        seen = _alike(sums, a, x0, y0, step, pi, qi, pj, qj)
                        if seen == _NOTHING:
                            continue
                        if seen != _MIXED:
                            more = one if seen == _LIT else np.int32(0)
                            for j in range(pj, qj):
                                for i in range(pi, qi):
                                    count[k, j, i] += np.uint16(1)
                                    total[k, j, i] += more
                            continue
                        for j in range(pj, qj):
                            line_y = y0 + j * step
                            u = a[0, 0] * x0 + a[0, 1] * line_y + a[0, 2]
                            v = a[1, 0] * x0 + a[1, 1] * line_y + a[1, 2]
                            for i in range(pi, qi):
                                uu, vv = u + i * du, v + i * dv
                                if uu < 0.0 or vv < 0.0 or uu > cols - 1 or vv > rows - 1:
                                    continue
                                iu, iv = min(int(uu), cols - 2), min(int(vv), rows - 2)
                                cell = np.int32(cells[iv, iu])
                                if cell >= 16:
                                    continue
                                count[k, j, i] += np.uint16(1)
                                total[k, j, i] += np.int32(_of_cell(int(cell), uu - iu, vv - iv))


@kernel(fastmath={"contract", "arcp", "nsz"})
def _carve_changes(  # noqa: C901  (a kernel)
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    differ: NDArray[np.int32],
    at: tuple[int, int],
    shape: tuple[int, int],
    affines: NDArray[np.float64],
    x0: float,
    y0: float,
    step: float,
    first: int,
    last: int,
    total: NDArray[np.int32],
    count: NDArray[np.uint16],
) -> None:  # pragma: no cover
    """Replace what a mask added to the slices [first, last) by what another adds.

    `before` and `after` are the cells of the part of them in which they differ; it begins at `at` (row, col)
    of an image of that shape. `differ[v, u]` counts the cells that differ above v and left of u of it.
    """
    rows, cols = before.shape
    ny, nx = total.shape[1:]
    for k in range(first, last):
        a = affines[k]
        du, dv = a[0, 0] * step, a[1, 0] * step
        for j0 in range(0, ny, _BLOCK):
            j1 = min(j0 + _BLOCK, ny)
            for i0 in range(0, nx, _BLOCK):
                i1 = min(i0 + _BLOCK, nx)
                left, right, top, bottom = _pixels_of(a, x0, y0, step, i0, i1, j0, j1)
                left, right = max(left - at[1], 0), min(right - at[1], cols)
                top, bottom = max(top - at[0], 0), min(bottom - at[0], rows)
                if left >= right or top >= bottom:
                    continue
                inside = differ[bottom, right] - differ[top, right] - differ[bottom, left] + differ[top, left]
                if inside == 0:
                    continue
                for j in range(j0, j1):
                    y = y0 + j * step
                    u = a[0, 0] * x0 + a[0, 1] * y + a[0, 2]
                    v = a[1, 0] * x0 + a[1, 1] * y + a[1, 2]
                    for i in range(i0, i1):
                        uu, vv = u + i * du, v + i * dv
                        if uu < 0.0 or vv < 0.0 or uu > shape[1] - 1 or vv > shape[0] - 1:
                            continue
                        iu, iv = min(int(uu), shape[1] - 2), min(int(vv), shape[0] - 2)
                        ju, jv = iu - at[1], iv - at[0]
                        if ju < 0 or jv < 0 or ju >= cols or jv >= rows:
                            continue
                        old, new = int(before[jv, ju]), int(after[jv, ju])
                        if old == new:
                            continue
                        if old < 16:
                            count[k, j, i] -= np.uint16(1)
                            total[k, j, i] -= np.int32(_of_cell(old, uu - iu, vv - iv))
                        if new < 16:
                            count[k, j, i] += np.uint16(1)
                            total[k, j, i] += np.int32(_of_cell(new, uu - iu, vv - iv))


def _threads(pool: ThreadPoolExecutor | None, work: Any, slices: int) -> None:
    if pool is None or slices < 2:
        work(0, slices)
        return
    middle = slices // 2
    upper = pool.submit(work, middle, slices)
    work(0, middle)
    upper.result()


class _Sums:
    """What has been added to each voxel of a volume: how many views, and their whole numbers.

    Blocks of voxels to which a mask adds the same are counted apart: most of a view takes no more than that.
    """

    def __init__(self, volume: Volume, pool: ThreadPoolExecutor | None) -> None:
        self._volume = volume
        self._pool = pool
        nz, ny, nx = volume.shape
        blocks = (nz, -(-ny // _BLOCK), -(-nx // _BLOCK))
        self._total, self._count = np.zeros(volume.shape, np.int32), np.zeros(volume.shape, np.uint16)
        self._block_total, self._block_count = np.zeros(blocks, np.int32), np.zeros(blocks, np.uint16)

    def add_image(self, image: NDArray[np.float32], info: ViewInfo) -> None:
        """Add an image, NaN where unknown, at every voxel's shadow pixel."""
        self._in_slices(_carve_slices, image, _slice_affines(info, self._volume))

    def add_mask(self, pixels: NDArray[np.uint8], info: ViewInfo, echo: NDArray[np.bool_] = _NOWHERE) -> None:
        """Add a mask: 1 outside the silhouette, 0 inside; covered pixels are outside except in `echo`."""
        affines, first, shape = self._onto(info, pixels.shape)
        if min(shape) < 2:
            return
        cells = np.empty(shape, np.uint8)
        sums = np.zeros((shape[0] + 1, shape[1] + 1), np.uint32)
        _cells_of_mask(pixels, echo, first, cells, sums)
        blocks = self._block_total, self._block_count
        self._in_slices(_carve_masks, cells, sums, affines, blocks=blocks)

    def _onto(
        self, info: ViewInfo, shape: tuple[int, ...]
    ) -> tuple[NDArray[np.float64], tuple[int, int], tuple[int, int]]:
        """Return the slices' affines onto the part of an image that shadows fall on, its corner and shape."""
        affines = _slice_affines(info, self._volume)
        first, part = _part_of_image(affines, self._volume, shape)
        affines[:, :, 2] -= first[::-1]  # they count from the part's own corner
        return affines, first, part

    def _in_slices(self, carve: Any, *given: Any, blocks: tuple[Any, ...] = ()) -> None:
        """Let a kernel add to all slices, the lower and the upper half at the same time."""
        v = self._volume

        def work(first: int, last: int) -> None:
            place = v.origin_m[0], v.origin_m[1], v.voxel_size_m
            carve(*given, *place, first, last, self._total, self._count, *blocks)

        _threads(self._pool, work, v.shape[0])

    def part(self, box: tuple[slice, ...], volume: Volume) -> _Sums:
        """Return the sums of a part of the volume, to be changed apart from these."""
        part = _Sums(volume, self._pool)
        part._total[:], part._count[:] = self.total[box], self.count[box]
        return part

    def change_mask(
        self,
        before: NDArray[np.uint8],
        after: NDArray[np.uint8],
        info: ViewInfo,
        echo: NDArray[np.bool_] = _NOWHERE,
    ) -> None:
        """Replace a mask that was added, with covered pixels unknown, by another: `add_mask` of `after`.

        Only voxels whose shadows fall where the two differ are looked up.
        """
        changed = before != after
        if echo.size:
            changed |= (after == MASK_COVERED) & ~echo
        at = _box_of(changed)
        if at is None:
            return
        affines, first, shape = self._onto(info, before.shape)
        # The cells of which a pixel differs, as far as shadows of the volume fall.
        begin = np.maximum(np.array(at[0]) - 1, first)
        end = np.minimum(np.array(at[1]) + 1, np.array(first) + shape)
        size = tuple(map(int, end - begin))
        if min(shape) < 2 or min(size) < 2:
            return
        corner = int(begin[0]), int(begin[1])
        cells = []
        for mask, zone in ((before, _NOWHERE), (after, echo)):
            sums = np.zeros((size[0] + 1, size[1] + 1), np.uint32)
            cells.append(np.empty(size, np.uint8))
            _cells_of_mask(mask, zone, corner, cells[-1], sums)
        # Of the last row and column the cells reach beyond the part.
        old, new = (np.ascontiguousarray(each[:-1, :-1]) for each in cells)
        differ = np.zeros(size, np.int32)
        np.cumsum(np.cumsum(old != new, axis=0, dtype=np.int32), axis=1, out=differ[1:, 1:])
        offset = corner[0] - first[0], corner[1] - first[1]
        self._in_slices(_carve_changes, old, new, differ, offset, shape, affines)

    @property
    def total(self) -> NDArray[np.int32]:
        """Sum of all images, in 1/4096, shape (nz, ny, nx)."""
        return np.asarray(self._total + self._spread(self._block_total), np.int32)

    @property
    def count(self) -> NDArray[np.uint16]:
        """Number of images that know something of each voxel, shape (nz, ny, nx)."""
        return np.asarray(self._count + self._spread(self._block_count), np.uint16)

    def _spread(self, blocks: NDArray[Any]) -> NDArray[Any]:
        _, ny, nx = self._volume.shape
        return blocks.repeat(_BLOCK, axis=1)[:, :ny].repeat(_BLOCK, axis=2)[:, :, :nx]


def _slice_affines(info: ViewInfo, volume: Volume) -> NDArray[np.float64]:
    """Return, for each height slice, the matrix from ground metres to pixels, shape (nz, 2, 3)."""
    return info.camera.height_slice_affines(volume.z_m)


def _part_of_image(
    affines: NDArray[np.float64], volume: Volume, shape: tuple[int, ...]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return first (row, col) and shape of the part of an image that a volume's shadows can fall on."""
    corners = np.array([[x, y, 1.0] for x in volume.x_m[[0, -1]] for y in volume.y_m[[0, -1]]])
    # Lines of points are cast to lines: the lowest and the highest slice bound all.
    pixels = np.concatenate([corners @ affines[0].T, corners @ affines[-1].T])[:, ::-1]
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.floor(pixels.max(axis=0)).astype(int) + 4, shape)
    size = np.maximum(high - low, 0)
    return (int(low[0]), int(low[1])), (int(size[0]), int(size[1]))


def _box_of(where: NDArray[np.bool_]) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Return the first and last + 1 (row, col) of the pixels that are set; None where none is."""
    rows, cols = np.flatnonzero(where.any(axis=1)), np.flatnonzero(where.any(axis=0))
    if not len(rows):
        return None
    return (int(rows[0]), int(cols[0])), (int(rows[-1]) + 1, int(cols[-1]) + 1)


class Carver:
    """A voxel grid that integrates views one by one, in any order.

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
    Memory is that of the grid (a little over 6 bytes a voxel), however many views are integrated; consensus
    carving also keeps the silhouettes, compressed to some kB each, for its second look.
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
        self._sums = _Sums(volume, pool)
        self._masks: dict[int, KeptMask] = {}
        #: The last comparisons of `shadow_fits`, by their bodies and the number of views.
        self._fits: dict[tuple[tuple[VoxelGrid, ...], int], dict[int, ShadowFit]] = {}
        #: Stamps of the views that have been integrated.
        self.stamps: set[int] = set()
        #: Of a part of a volume: so many views know some voxel of the whole.
        self._most_views = 0

    @property
    def keeps_masks(self) -> bool:
        """Whether the method keeps its silhouettes."""
        return method_named(self.parameters.method).looks_twice

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
            raise ViewError(f"the grid holds {len(self.stamps)} views; expected no more")
        self._check(view)
        top = self.volume.z_m[-1]
        if top >= view.info.camera.sonar_m[2]:
            raise ViewError(
                f"the volume reaches {top:g} m, the sonar is at {view.info.camera.sonar_m[2]:g} m;"
                " expected it above"
            )
        if self.parameters.takes_masks:
            self._sums.add_mask(np.ascontiguousarray(view.pixels), view.info)
        else:
            self._sums.add_image(np.ascontiguousarray(view.pixels), view.info)
        self.stamps.add(view.info.stamp_ns)
        if self.keeps_masks:
            self._masks[view.info.stamp_ns] = KeptMask.of(view)
        return True

    def _check(self, view: View) -> None:
        pixels = view.pixels
        method = self.parameters.method
        if not self.parameters.takes_masks:
            if pixels.dtype != np.float32:
                raise ViewError(f"{method} carving got {pixels.dtype} pixels; expected float32 l_out")
            low, high = float(np.nanmin(pixels, initial=1.0)), float(np.nanmax(pixels, initial=0.0))
            if low < 0.0 or high > 1.0:
                raise ViewError(f"l_out of the view spans [{low:g}, {high:g}]; expected [0, 1] or NaN")
            return
        if pixels.dtype != np.uint8:
            raise ViewError(f"{method} carving got {pixels.dtype} pixels; expected a uint8 mask")
        odd = _first_odd(pixels)
        if odd >= 0:
            raise ViewError(f"shadow mask holds the value {odd}; expected 0, 64, 128 or 255")

    def likelihood(self) -> NDArray[np.float32]:
        """Return the mean of l_out (masks: the fraction of views that contradict the voxel); NaN unknown."""
        return _mean(self._sums.total, self._sums.count, self.parameters, len(self.stamps))

    def grid(self) -> VoxelGrid:
        """Threshold the voxels carved so far.

        Returns
        -------
        VoxelGrid
            With NaN threshold and nothing occupied where there is no object.
        """
        carver, first = self, self.first_look()
        if not method_named(self.parameters.method).looks_twice or not first.occupied.any():
            return first
        slope = self._slope(first)
        if slope is not None and slope.believed:
            carver = self._over(slope)
            first = carver.first_look()
        return replace(carver._shape(first) if first.occupied.any() else first, seabed=slope)

    def _slope(self, first: VoxelGrid) -> SeabedSlope | None:
        """Fit the seabed's slope to the far ends of all silhouettes."""
        v = self.volume
        layers = np.flatnonzero(first.occupied.any(axis=(1, 2)))
        height = float(v.z_m[layers[-1]]) + v.voxel_size_m / 2.0
        found = in_order(lambda kept: shadow_end(kept.view()), self._masks.values(), _LOOKERS)
        ends = [end for _, end in found if end is not None]
        slope = seabed_slope(ends, v.centre_m[:2], height)
        if slope is not None and slope.believed:
            lowest = min(slope.applied(kept.info).camera.sonar_m[2] for kept in self._masks.values())
            if lowest <= v.z_m[-1]:
                return None
        return slope

    def _over_seabed_of(self, body: VoxelGrid) -> Carver:
        """Carve the same masks again over the seabed that a body was carved over, where that slopes."""
        slope = body.seabed
        return self if slope is None or not slope.believed else self._over(slope)

    def _over(self, slope: SeabedSlope) -> Carver:
        """Carve the same masks again, over a seabed that slopes."""
        return self._seen_by(slope.applied)

    def moved_back(self, shifts_m: Mapping[int, float]) -> Carver:
        """Carve the same masks again, views that lie beside their place put back (`alignment`)."""
        return self._seen_by(lambda info: info.moved_back(shifts_m.get(info.stamp_ns, 0.0)))

    def _seen_by(self, change: Callable[[ViewInfo], ViewInfo]) -> Carver:
        """Carve the same masks again, the geometry of their views changed."""
        again = Carver(self.volume, self.parameters, pool=self._pool)
        for stamp, kept in self._masks.items():
            again._masks[stamp] = KeptMask(change(kept.info), kept.packed)
            again._sums.add_mask(kept.view().pixels, again._masks[stamp].info)
        again.stamps = set(self.stamps)
        return again

    def _again(self, change: Callable[[KeptMask], KeptMask]) -> Carver:
        """Carve the same views again, their masks changed: only what these changes change is looked up."""
        again = Carver(self.volume, self.parameters, pool=self._pool)
        again._sums = self._sums.part((slice(None),) * 3, self.volume)
        again._most_views = self._most_views

        def changed(item: tuple[int, KeptMask]) -> tuple[KeptMask, NDArray[np.uint8], NDArray[np.uint8]]:
            after = change(item[1])
            before = item[1].view().pixels
            return after, before, before if after is item[1] else after.view().pixels

        for (stamp, kept), (after, old, new) in in_order(changed, self._masks.items(), _LOOKERS):
            again._masks[stamp] = after
            if after is not kept:
                again._sums.change_mask(old, new, kept.info)
        again.stamps = set(self.stamps)
        return again

    def _shape(self, first: VoxelGrid) -> VoxelGrid:
        """Leave of what covered pixels leave open what the shadows ask for.

        Taken for lit seabed, covered pixels far before a shadow carve low wide bodies away with their own lit
        tops; taken for unknown, they leave an apron round open ones. The leaner body counts, and what of the
        fuller one darkens pixels of the silhouettes that the leaner one leaves lit.
        """
        box, part = part_around(first.occupied, self.volume, _SECOND_LOOK_VOXELS)
        near = self._in_part(box, part)
        fuller, opened = near._second_look(near.first_look(), SIDELOBE_CELLS, MAIN_LOBE_CELLS)
        lean = near.leaner()
        leaner = lean.first_look()
        if leaner.occupied.any():
            (leaner,) = lean._second_look(leaner, SIDELOBE_CELLS)
        found = near._undercut(near._asked_for(leaner, fuller), opened)
        whole = replace(
            first,
            likelihood=first.likelihood.copy(),
            views=first.views.copy(),
            occupied=np.zeros_like(first.occupied),
            threshold=found.threshold,
        )
        whole.likelihood[box], whole.views[box] = found.likelihood, found.views
        whole.occupied[box] = found.occupied
        return whole

    def _undercut(self, body: VoxelGrid, opened: VoxelGrid) -> VoxelGrid:
        """Remove from a body what is seen lit where only sidelobes of its echo may reach.

        What the shadows ask for stays, with what it stands on.
        """
        with np.errstate(invalid="ignore"):
            seen_lit = body.occupied & (opened.likelihood >= _SIDELOBE_VIEWS * body.threshold)
        if not seen_lit.any():
            return body
        leaner = self._thresholded(np.where(seen_lit, opened.likelihood, body.likelihood), body.views)
        return self._asked_for(leaner, body, overhangs=True)

    def _in_part(self, box: tuple[slice, ...], part: Volume) -> Carver:
        """Return what was carved of a part of the volume."""
        carver = Carver(part, self.parameters, pool=self._pool)
        carver._sums = self._sums.part(box, part)
        carver._masks, carver.stamps = self._masks, self.stamps
        carver._most_views = int(self._sums.count.max(initial=self._most_views))
        return carver

    def leaner(self) -> Carver:
        """Carve the same views again, covered pixels far before a shadow taken for lit seabed."""
        return self._again(KeptMask.near)

    def _asked_for(
        self,
        leaner: VoxelGrid,
        fuller: VoxelGrid,
        others: Sequence[VoxelGrid] = (),
        *,
        overhangs: bool = False,
    ) -> VoxelGrid:
        """Add to the leaner of two bodies what of the fuller one explains shadow that nothing else does.

        That stands on all of the fuller body; so does the leaner one, unless it may have `overhangs`.
        """
        voxels = np.ascontiguousarray(np.argwhere(fuller.occupied & ~leaner.occupied), np.int32)
        if not len(voxels):
            return fuller
        asked = np.zeros(len(voxels), np.int32)

        def unexplained(kept: KeptMask) -> tuple[View, NDArray[np.bool_]]:
            view = kept.view()
            return view, unexplained_shadow(view, [leaner, *others])

        for _, (view, dark) in in_order(unexplained, self._masks.values(), _LOOKERS):
            count_shadow_pixels(view, self.volume, voxels, dark, asked)
        keep = np.zeros_like(leaner.occupied) if overhangs else leaner.occupied.copy()
        # As many views must ask for a voxel as would remove it.
        keep[tuple(voxels.T)] = asked >= fuller.threshold * fuller.views[tuple(voxels.T)]
        for k in range(len(keep) - 2, -1, -1):
            keep[k] |= keep[k + 1] & fuller.occupied[k]
        keep |= leaner.occupied
        likelihood = np.where(keep, fuller.likelihood, np.fmax(leaner.likelihood, fuller.likelihood))
        return self._thresholded(likelihood, fuller.views)

    def given_back(self, body: VoxelGrid, others: Sequence[VoxelGrid] = ()) -> VoxelGrid:
        """Give back to a body what only lit pixels on its own plan took from it, where these speak for that.

        Then the ground that it encloses is filled where its own shadow is not seen on it (`rings`).

        Parameters
        ----------
        body : VoxelGrid
            The body that `grid` or `beside` carved.
        others : sequence of VoxelGrid
            The other bodies of the scene.

        Returns
        -------
        VoxelGrid
            `body` itself where nothing is given back.
        """
        if not body.occupied.any() or not self._masks:
            return body
        told = self._on_own_plan(body, others)
        slope = told.seabed
        cell_m = float(np.median([kept.info.resolution_m[1] for kept in self._masks.values()]))
        views = (kept.view() for kept in self._masks.values())
        if slope is not None:
            views = (replace(view, info=slope.corrected(view.info)) for view in views)
        occupied = filled_rings(told, views, cell_m)
        if occupied is told.occupied:
            return told
        # What is lit there is the body's own top: no view contradicts.
        free = np.where(occupied & ~told.occupied, np.float32(0.0), told.likelihood)
        return replace(self._thresholded(free, told.views), seabed=slope)

    def _on_own_plan(self, body: VoxelGrid, others: Sequence[VoxelGrid]) -> VoxelGrid:
        """Give back what lit pixels on the body's own plan took, where they speak for its own echo.

        They may be seabed, seen in a hollow or under an overhang, or the echo of a side that slopes down to
        the seabed, or speckle on a top. Two signs tell that they are echo: with what they took, the body
        explains shadow that it leaves unexplained without; or they took much from under it, and few views
        contradict that.
        """
        count = int(np.count_nonzero(body.occupied))
        below = _columns_filled(body.occupied) & ~body.occupied
        undercut = np.count_nonzero(below) >= _UNDERCUT * count
        unexplained, lit = self.misfit([body, *others])
        if not undercut and not unexplained >= _EXPLAINED:
            return body
        beside = self._over_seabed_of(body)._clear_of(others)
        plan = beside._own_plan(body, self.volume)
        if plan is None:
            return body
        left = beside._clear_of_plan(plan).first_look()
        whole = self._with(body, left, left.occupied & plan.columns(self.volume) & ~body.occupied)
        faces = self._mostly_under(_FACING, body, whole.occupied & ~body.occupied)
        fit = self.misfit([whole, *others]) if unexplained >= _EXPLAINED else (math.nan, math.nan)
        explained = unexplained - fit[0]

        @cache
        def may_be_whole() -> bool:
            return self._more_lit_off(plan, whole, body, others) <= _LIT_OFF_PLAN * explained

        # What shines through under a slab would be lit by more than its shadows explain.
        if (
            explained >= _EXPLAINED
            and (faces or (explained >= fit[1] - lit and self._dark_on(plan) < _DARK_TOP))
            and may_be_whole()
        ):
            return whole
        filled = body
        below = _columns_filled(body.occupied, whole.occupied) & ~body.occupied
        if np.count_nonzero(below) >= _UNDERCUT * count and self._mostly_under(_SELDOM, body, below):
            filled = self._with(body, whole, below)
        if faces and unexplained >= _EXPLAINED:
            dark, lit = self.misfit([filled, *others])
            more, more_lit = dark - fit[0], fit[1] - lit
            net = more - more_lit >= _NET_EXPLAINED and more_lit <= _LIT_OF_EXPLAINED * more
            return whole if net and may_be_whole() else filled
        return filled

    @staticmethod
    def _mostly_under(share: float, body: VoxelGrid, voxels: NDArray[np.bool_]) -> bool:
        """Say whether less than a share of a body's views contradicts most of some voxels."""
        with np.errstate(invalid="ignore"):
            seldom = ~(body.likelihood[voxels] >= share)
        return bool(seldom.size) and float(seldom.mean()) > 0.5

    def misfit(self, bodies: Sequence[VoxelGrid]) -> tuple[float, float]:
        """Return how badly bodies fit the silhouettes, their own body's first: mean `unexplained` and `lit`.

        NaN where no view tells.
        """
        mean = mean_fit(self.shadow_fits(bodies).values())
        return mean.unexplained, mean.lit

    def lost(self, body: VoxelGrid, instead: VoxelGrid, others: Sequence[VoxelGrid] = ()) -> bool:
        """Say whether carving lost most of a body, and another grid of it explains its shadow better.

        Where carving left nothing, the other grid is a body unless it explains hardly any of its shadow.
        """
        if not body.occupied.any():
            return not self.misfit([instead, *others])[0] > _EXPLAINS_NOTHING
        unexplained, lit = self.misfit([body, *others])
        if not unexplained > _LOST:
            return False
        left, more_lit = self.misfit([instead, *others])
        return unexplained - left - max(more_lit - lit, 0.0) >= _EXPLAINED

    def on_plan_of(
        self, found: Target, seen: VoxelGrid, others: Sequence[VoxelGrid] = ()
    ) -> VoxelGrid | None:
        """Carve a body that carving lost again, on the plan that the sides of its shadows bound.

        The body's own lit top and sides, which carved it away, lie on that plan and say nothing.

        Parameters
        ----------
        found : Target
            What the search found.
        seen : VoxelGrid
            What the mean likelihood tells of it; nothing is occupied where that tells nothing.
        others : sequence of VoxelGrid
            The other bodies of the scene.

        Returns
        -------
        VoxelGrid or None
            None unless it fits the silhouettes: better than `seen`, or, where that is nothing, half of the
            shadow is explained, and its top is lit.
        """
        if not self._masks:
            return None
        seed = seen if seen.occupied.any() else _block(found, self.volume)
        # The search sees of a low wide body little more than where all its shadows cross.
        (x, y, _), (along_x, along_y, high) = self.volume.centre_m, self.volume.size_m
        room = (_WIDER * along_x, _WIDER * along_y, high)
        plan = self._own_plan(seed, Volume.around((x, y), room, self.volume.voxel_size_m))
        if plan is None or not self._dark_on(plan) < _DARK_TOP:
            return None
        carver = self._in(plan.volume_round(self.volume))
        cleared = carver._clear_of(others)._clear_of_plan(plan)
        left = cleared.first_look()
        occupied = left.occupied & plan.columns(left.volume)
        # All views bound the plan.
        views = np.where(occupied, np.uint16(len(self.stamps)), left.views)
        body = replace(left, occupied=occupied, views=views)
        if not body.occupied.any():
            return None
        most = sum(cleared.misfit([seen, *others])) if seen.occupied.any() else _LOST
        return body if sum(cleared.misfit([body, *others])) < most else None

    def _in(self, volume: Volume) -> Carver:
        """Carve the same views in another volume."""
        if volume == self.volume:
            return self
        carver = Carver(volume, self.parameters, pool=self._pool)
        for _, view in in_order(KeptMask.view, self._masks.values(), _LOOKERS):
            carver.integrate(view)
        return carver

    def _dark_on(self, plan: StandingPlan) -> float:
        """Return the share of the segmented shadow on the top of a plan, mean over the views.

        The top of a body is lit from edge to edge.
        """
        shares = []
        for kept in self._masks.values():
            view = kept.view()
            dark = view.pixels == MASK_SHADOW
            if count := int(np.count_nonzero(dark)):
                shares.append(np.count_nonzero(dark & plan.top(view.info)) / count)
        return float(np.mean(shares)) if shares else math.nan

    def _more_lit_off(
        self, plan: StandingPlan, whole: VoxelGrid, body: VoxelGrid, others: Sequence[VoxelGrid]
    ) -> float:
        """Return how much more of its shadow a whole casts on light that nothing on its plan can echo.

        Covered pixels there are seabed: what shines between the legs of a table, say.
        """

        def told(kept: KeptMask) -> KeptMask:
            view = kept.view()
            lit = (view.pixels == MASK_OUTSIDE) | (view.pixels == MASK_COVERED)
            says = np.where(plan.echo(kept.info), np.uint8(MASK_UNKNOWN), np.uint8(MASK_OUTSIDE))
            return KeptMask.of(replace(view, pixels=np.where(lit, says, view.pixels)))

        masks = {kept.info.stamp_ns: seen for kept, seen in in_order(told, self._masks.values(), _LOOKERS)}
        more, less = (mean_fit(compared_shadows(masks, [one, *others]).values()).lit for one in (whole, body))
        return more - less

    def _own_plan(self, body: VoxelGrid, within: Volume) -> StandingPlan | None:
        """Return the plan that the sides of a body's shadows bound within a volume, if they bound one."""
        middle = within.centre_m[:2]
        sides = in_order(lambda kept: shadow_sides(kept.view(), body, middle), self._masks.values(), _LOOKERS)
        corners = plan_of_sides([found for _, found in sides if found is not None], within)
        if corners is None:
            return None
        top = int(np.flatnonzero(body.occupied.any(axis=(1, 2)))[-1])
        return StandingPlan(corners, float(body.volume.z_m[top]) + body.volume.voxel_size_m / 2.0)

    def _clear_of_plan(self, plan: StandingPlan) -> Carver:
        """Carve the same masks again, lit pixels that may be the echo of what stands on a plan as unknown.

        The plan bounds what few views know then.
        """
        again = self._again(lambda kept: _unknown_where(kept, plan.echo(kept.info)))
        again.parameters = replace(self.parameters, min_views_fraction=0.0)
        return again

    def _with(self, body: VoxelGrid, other: VoxelGrid, voxels: NDArray[np.bool_]) -> VoxelGrid:
        """Add some voxels of another body to one, on a plan that all views bound."""
        likelihood = np.where(voxels, other.likelihood, body.likelihood)
        views = np.where(voxels, np.uint16(len(self.stamps)), body.views)
        return replace(self._thresholded(likelihood, views), seabed=body.seabed)

    def shadow_fits(self, grids: Sequence[VoxelGrid]) -> dict[int, ShadowFit]:
        """Compare the carving silhouettes with bodies' shadows, its own body's first, by stamp.

        Empty for methods that keep no silhouettes (soft, hard).
        """
        asked = tuple(grids), len(self._masks)  # bodies are equal only to themselves
        if asked not in self._fits:
            while len(self._fits) >= _KEPT_FITS:
                self._fits.pop(next(iter(self._fits)))
            self._fits[asked] = compared_shadows(self._masks, grids)
        return self._fits[asked]

    def _thresholded(self, likelihood: NDArray[np.float32], views: NDArray[np.uint16]) -> VoxelGrid:
        return thresholded(self.volume, likelihood, views, self.parameters, self._most_views)

    def first_look(self) -> VoxelGrid:
        """Threshold the voxels carved so far, with covered pixels unknown: the start of `grid`."""
        return self._thresholded(self.likelihood(), self._sums.count)

    def beside(self, leaner: VoxelGrid, others: Sequence[VoxelGrid]) -> VoxelGrid:
        """Add to `grid` the voxels that shadows require once the other bodies are known.

        Taken for unknown, pixels that other bodies' echoes may cover leave an apron between near ones. Taken
        for lit seabed they carve. What shadows ask for of the difference stays.
        """
        slope = leaner.seabed
        carver = self._over_seabed_of(leaner)
        cleared = carver._clear_of(others)
        if cleared is carver:
            return leaner
        first = cleared.first_look()
        fuller = cleared._shape(first) if first.occupied.any() else first
        return replace(carver._asked_for(leaner, fuller, others), seabed=slope)

    def _clear_of(self, others: Sequence[VoxelGrid]) -> Carver:
        """Carve the same masks again, lit pixels that other bodies' echoes may cover as unknown.

        A top as faint as the seabed that is laid over a shadow says nothing of the seabed there. Taken for
        lit seabed it removes the upper part of the body whose shadow it is, in all views along their line.
        """
        echoes = [_Echoes(grid.occupied, grid.volume) for grid in others if grid.occupied.any()]
        if not echoes or not self._masks:
            return self

        def cleared(kept: KeptMask) -> KeptMask:
            zones = [zone for one in echoes for zone in one.zones(kept, SIDELOBE_CELLS)]
            return _unknown_where(kept, np.logical_or.reduce(zones))

        return self._again(cleared)

    def _second_look(self, first: VoxelGrid, *reaches_cells: tuple[float, float]) -> list[VoxelGrid]:
        """Carve again what the first look left, with the pixels that its own echo cannot cover as seabed.

        Once for each reach of an echo.
        """
        echoes = _Echoes(first.occupied, self.volume, _SECOND_LOOK_VOXELS)
        box, part = echoes.box, echoes.part
        looks = [self._sums.part(box, part) for _ in reaches_cells]

        def look(kept: KeptMask) -> tuple[View, list[NDArray[np.bool_]]]:
            view = kept.view()
            if not (view.pixels == MASK_COVERED).any():
                return view, []
            return view, echoes.zones(kept, *reaches_cells)

        for _, (view, zones) in in_order(look, self._masks.values(), _LOOKERS):
            if zones:
                for sums, zone in zip(looks, zones, strict=True):
                    sums.change_mask(view.pixels, view.pixels, view.info, zone)
        found = []
        for sums in looks:
            likelihood, views = first.likelihood.copy(), first.views.copy()
            likelihood[box] = _mean(sums.total, sums.count, self.parameters, len(self.stamps))
            views[box] = sums.count
            found.append(self._thresholded(likelihood, views))
        return found


def compared_shadows(masks: Mapping[int, KeptMask], grids: Sequence[VoxelGrid]) -> dict[int, ShadowFit]:
    """Compare silhouettes with the shadows of bodies, the silhouettes' own body first, by stamp."""
    seabed = grids[0].seabed

    def fit(kept: KeptMask) -> ShadowFit:
        mask = kept.view()
        if seabed is not None:
            mask = replace(mask, info=seabed.corrected(mask.info))
        return shadow_fit(mask, grids)

    found = in_order(lambda item: fit(item[1]), masks.items(), _LOOKERS)
    return {stamp: one for (stamp, _), one in found}


class _Echoes:
    """Where a carved body may echo, view by view."""

    def __init__(self, occupied: NDArray[np.bool_], volume: Volume, margin: int = 0) -> None:
        self.box, self.part = part_around(occupied, volume, margin)
        self._body = occupied[self.box]
        self._opaque: dict[int, NDArray[np.bool_]] = {}

    def zones(self, kept: KeptMask, *reaches_cells: tuple[float, float]) -> list[NDArray[np.bool_]]:
        """Mark the pixels of a view that its echo may cover, for each reach of it."""
        # The grazing angle hardly changes round the circle: one body a quarter of a degree.
        quarters = kept.grazing_quarters
        opaque = self._opaque.get(quarters)
        if opaque is None:
            opaque = self._opaque[quarters] = opaque_part(self._body, math.radians(quarters / 4.0))
        return echo_zones(kept.info, self.part, self._body, opaque, reaches_cells)


def _block(found: Target, volume: Volume) -> VoxelGrid:
    """Return what the search found of a body, as a block: its volume without margins."""
    off = [
        np.abs(axis - middle) <= 0.5 * size / (1.0 + 2.0 * MARGIN_SHARE)
        for axis, middle, size in zip(
            (volume.x_m, volume.y_m), found.position_m, found.size_m[:2], strict=True
        )
    ]
    high = volume.z_m <= found.size_m[2] / (1.0 + MARGIN_SHARE)
    block = high[:, None, None] & off[1][None, :, None] & off[0]
    return VoxelGrid(volume, (~block).astype(np.float32), np.ones(block.shape, np.uint16), 0.5, block)


def _unknown_where(kept: KeptMask, zone: NDArray[np.bool_]) -> KeptMask:
    """Return a mask whose lit pixels say nothing in a zone."""
    view = kept.view()
    lit = ((view.pixels == MASK_OUTSIDE) | (view.pixels == MASK_COVERED)) & zone
    if not lit.any():
        return kept
    return KeptMask.of(replace(view, pixels=np.where(lit, np.uint8(MASK_UNKNOWN), view.pixels)))


def _columns_filled(
    occupied: NDArray[np.bool_], where: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Extend voxels downwards, as far as `where` reaches without a gap, or to the seabed."""
    out = occupied.copy()
    for k in range(len(out) - 2, -1, -1):
        out[k] |= out[k + 1] if where is None else out[k + 1] & where[k]
    return out


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
        first, last = int(where[0]) - margin, int(where[-1]) + margin
        box.append(slice(max(0, first), min(occupied.shape[axis], last + 1)))
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
