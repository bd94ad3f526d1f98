"""Means over boxes of a view's known pixels, of any size at the same small cost.

Levels, echoes and shadow each need the mean power around every pixel, over boxes of different sizes.
Power and known pixels are summed up once (summed-area tables); a box's mean is then four look-ups, and
most of those that ask want to know only on which side of a threshold it lies.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
BoolImage = NDArray[np.bool_]

#: A pixel counts with this power at most (70 dB above the seabed): more would drown the sums of all pixels
#: behind it in rounding, and no box of 3×3 with one in it is under a threshold that can be set (60 dB).
MOST_POWER = 1e7


@numba.njit(cache=True, nogil=True)
def _sum_up(
    power: FloatImage,
    known: BoolImage,
    sums: NDArray[np.float64],
    counts: NDArray[np.int32],
    spans: NDArray[np.int32],
) -> None:  # pragma: no cover
    """Fill summed-area tables, and the columns between which each row knows anything."""
    rows, cols = power.shape
    line, line_count = np.empty(cols, np.float64), np.empty(cols, np.int32)
    sums[0, :] = 0.0
    counts[0, :] = 0
    for v in range(rows):
        first, last = 0, cols
        while first < cols and not known[v, first]:
            first += 1
        while last > first and not known[v, last - 1]:
            last -= 1
        spans[v, 0], spans[v, 1] = first, last
        sums[v + 1, : first + 1] = sums[v, : first + 1]
        counts[v + 1, : first + 1] = counts[v, : first + 1]
        # First along the row, each waiting for the one before; then down, all at once.
        total, count = 0.0, 0
        powers, here = power[v, first:last], known[v, first:last]
        for i in range(last - first):
            total += min(np.float64(powers[i]), MOST_POWER) * here[i]
            count += here[i]
            line[i], line_count[i] = total, count
        above, below = sums[v, first + 1 : last + 1], sums[v + 1, first + 1 : last + 1]
        for i in range(last - first):
            below[i] = above[i] + line[i]
        above_count, below_count = counts[v, first + 1 : last + 1], counts[v + 1, first + 1 : last + 1]
        for i in range(last - first):
            below_count[i] = above_count[i] + line_count[i]
        for u in range(last + 1, cols + 1):
            sums[v + 1, u] = sums[v, u] + total
            counts[v + 1, u] = counts[v, u] + count


@numba.njit(cache=True, nogil=True)
def _box_sums(
    sums: NDArray[Any], v: int, first: int, last: int, radius: tuple[int, int], out: NDArray[Any]
) -> None:  # pragma: no cover
    """Sum over the boxes around a row's pixels `first` to `last`; boxes end at the view's edges."""
    rows, cols = sums.shape[0] - 1, sums.shape[1] - 1
    r = radius[1]
    above, below = sums[max(0, v - radius[0])], sums[min(rows, v + radius[0] + 1)]
    # Away from the edges without a clip, and from zero on, so that the compiler makes vectors of it.
    inner, outer = max(first, r), min(last, cols - r)
    n = max(outer - inner, 0)
    if n:
        b1, b0 = below[inner + r + 1 : outer + r + 1], below[inner - r : outer - r]
        a1, a0 = above[inner + r + 1 : outer + r + 1], above[inner - r : outer - r]
        middle = out[inner:outer]
        for i in range(n):
            middle[i] = (b1[i] - b0[i]) - (a1[i] - a0[i])
    for u in range(first, min(max(inner, first), last)):
        right, left = min(cols, u + r + 1), max(0, u - r)
        out[u] = (below[right] - below[left]) - (above[right] - above[left])
    for u in range(max(outer, inner, first), last):
        right, left = min(cols, u + r + 1), max(0, u - r)
        out[u] = (below[right] - below[left]) - (above[right] - above[left])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _means(
    sums: NDArray[np.float64],
    counts: NDArray[np.int32],
    spans: NDArray[np.int32],
    known: BoolImage,
    radius: tuple[int, int],
    out: FloatImage,
) -> None:  # pragma: no cover
    """Write the mean around every known pixel, infinity elsewhere."""
    rows, cols = known.shape
    total, count = np.empty(cols, np.float64), np.empty(cols, np.int32)
    for v in range(rows):
        first, last = spans[v]
        out[v, :] = np.float32(np.inf)
        _box_sums(sums, v, first, last, radius, total)
        _box_sums(counts, v, first, last, radius, count)
        means, here, of, by = out[v, first:last], known[v, first:last], total[first:last], count[first:last]
        for i in range(last - first):
            mean = np.float32(of[i]) / np.float32(by[i])
            means[i] = mean if here[i] else np.float32(np.inf)


@numba.njit(cache=True, nogil=True)
def _beyond(
    sums: NDArray[np.float64],
    counts: NDArray[np.int32],
    spans: NDArray[np.int32],
    known: BoolImage,
    radius: tuple[int, int],
    threshold: float,
    sign: float,
    out: BoolImage,
) -> None:  # pragma: no cover
    """Mark the known pixels whose mean is under (`sign` 1) or over (-1) a threshold."""
    rows, cols = known.shape
    total, count = np.empty(cols, np.float64), np.empty(cols, np.int32)
    for v in range(rows):
        first, last = spans[v]
        out[v, :first] = False
        out[v, last:] = False
        _box_sums(sums, v, first, last, radius, total)
        _box_sums(counts, v, first, last, radius, count)
        marks, here, of, by = out[v, first:last], known[v, first:last], total[first:last], count[first:last]
        for i in range(last - first):
            marks[i] = here[i] & (sign * (threshold * by[i] - of[i]) > 0.0)


class LocalMeans:
    """Means of a view's power over boxes of its known pixels.

    Boxes are given by their half-size (rows, cols) in pixels, and end at the view's edges.

    Parameters
    ----------
    power : ndarray of float32, shape (rows, cols)
        (i/σ_r)²/2; 0 where unknown.
    known : ndarray of bool, shape (rows, cols)
        Pixels to count.
    """

    def __init__(self, power: FloatImage, known: BoolImage) -> None:
        self.power = power
        self.known = known

    @cached_property
    def _tables(self) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32]]:
        rows, cols = self.power.shape
        sums, counts = np.empty((rows + 1, cols + 1)), np.empty((rows + 1, cols + 1), np.int32)
        spans = np.empty((rows, 2), np.int32)
        _sum_up(self.power, self.known, sums, counts, spans)
        return sums, counts, spans

    @property
    def total_known(self) -> int:
        """Number of known pixels."""
        return int(self._tables[1][-1, -1])

    def mean(self, radius_px: tuple[int, int]) -> FloatImage:
        """Return the mean around every known pixel, infinity around the others."""
        out = np.empty(self.power.shape, np.float32)
        _means(*self._tables, self.known, radius_px, out)
        return out

    def under(self, radius_px: tuple[int, int], threshold: float) -> BoolImage:
        """Mark the known pixels around which the mean is less than a threshold."""
        out = np.empty(self.power.shape, np.bool_)
        _beyond(*self._tables, self.known, radius_px, threshold, 1.0, out)
        return out

    def over(self, radius_px: tuple[int, int], threshold: float) -> BoolImage:
        """Mark the known pixels around which the mean is more than a threshold."""
        out = np.empty(self.power.shape, np.bool_)
        _beyond(*self._tables, self.known, radius_px, threshold, -1.0, out)
        return out
