"""Means over boxes of a view's known pixels: what levels, echoes and shadow are told from.

Each asks of the mean power around a pixel only on which side of a threshold it lies, over a box of its own
size. Sums are kept in double precision, as a threshold must not depend on the order in which they were made.
Half of a view is off the image: every row is looked at only where it knows something.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..kernels import kernel

FloatImage = NDArray[np.float32]
BoolImage = NDArray[np.bool_]
Spans = NDArray[np.int32]

#: A pixel counts with this power at most (70 dB above the seabed): more would drown the running sums of its
#: column in rounding, and no box of 3×3 with one in it is under a threshold that can be set (60 dB).
MOST_POWER = 1e7
#: Pixels that are passed over at once where there is nothing in them.
_CHUNK = 32
#: The whole of an axis.
_ALL = slice(None)
#: Half-sizes of boxes (resolution cells: down-range, across). An echo is told by the mean of one, and marked
#: as far beyond: the flank of its response is neither seabed nor shadow.
ECHO_CELLS = (0.6, 0.375)
#: Shadow is measured where everything as far around is dark: by boxes of this size, the brightest of as many.
INNER_CELLS = (1.2, 0.75)

# Columns are counted unsigned in the loops over pixels: the compiler then need not ask whether an index
# counts from the end, and makes vectors of them without a slice for each row, which costs as much as 50
# pixels.
_index = np.uintp


@kernel()
def known_span(known: BoolImage, v: int) -> tuple[int, int]:  # pragma: no cover
    """Return the span of a row's known columns: the first, and one after the last."""
    cols = known.shape[1]
    first, last = 0, cols
    while first + _CHUNK <= cols and not _any(known, v, first):
        first += _CHUNK
    while first < cols and not known[v, first]:
        first += 1
    while last - _CHUNK >= first and not _any(known, v, last - _CHUNK):
        last -= _CHUNK
    while last > first and not known[v, last - 1]:
        last -= 1
    return first, last


@kernel()
def _any(known: BoolImage, v: int, first: int) -> bool:  # pragma: no cover
    """Say whether a row knows any of `_CHUNK` pixels, without a branch for each."""
    some = False
    for i in range(_CHUNK):
        some |= known[v, _index(first + i)]
    return some


@kernel()
def _spans_of(known: BoolImage) -> Spans:  # pragma: no cover
    """Find the columns between which each row knows anything."""
    spans = np.empty((known.shape[0], 2), np.int32)
    for v in range(known.shape[0]):
        spans[v, 0], spans[v, 1] = known_span(known, v)
    return spans


@kernel()
def _under(
    power: FloatImage,
    known: BoolImage,
    spans: Spans,
    corner: tuple[int, int],
    radius: tuple[int, int],
    threshold: float,
    out: BoolImage,
) -> None:  # pragma: no cover
    """Mark, in the part of a view that begins at `corner`, the known pixels whose mean is under a threshold.

    It is where the box's pixels fall short of the threshold by more than nothing, all in all.
    """
    rows, cols = power.shape
    top, left = corner
    height, width = out.shape
    r, c = radius
    turn = 2 * r + 1
    # By how much the column falls short in the box's rows, and what each of these rows adds to it. With `c`
    # columns more to either side: those beyond the view's edge stay zero.
    short, line_short = np.zeros(width + 2 * c), np.empty((turn, width + 2 * c))
    total = np.empty(width)
    begin, end = max(0, top - r), min(rows, top + height + r)
    low, high = max(0, left - c), min(cols, left + width + c)
    shift = c - left
    out[:] = False
    for w in range(begin, top + height + r):
        if w - turn >= begin:
            gone = line_short[w % turn]
            first, last = max(low, spans[w - turn, 0]) + shift, min(high, spans[w - turn, 1]) + shift
            for i in range(_index(first), _index(max(first, last))):
                short[i] -= gone[i]
        if w < end:
            come = line_short[w % turn]
            first, last = max(low, spans[w, 0]), min(high, spans[w, 1])
            for u in range(_index(first), _index(max(first, last))):
                place = u + _index(shift)
                come[place] = threshold * known[w, u] - min(np.float64(power[w, u]), MOST_POWER)
                short[place] += come[place]
        v = w - r
        if v < top:
            continue
        first, last = max(left, spans[v, 0]), min(left + width, spans[v, 1])
        n = max(0, last - first)
        at = first + shift
        middle = short[at : at + n]
        for i in range(n):
            total[i] = middle[i]
        for s in range(1, c + 1):
            before, after = short[at - s : at - s + n], short[at + s : at + s + n]
            for i in range(n):
                total[i] += before[i] + after[i]
        marks, here = out[v - top, first - left : first - left + n], known[v, first : first + n]
        for i in range(n):
            marks[i] = here[i] & (total[i] > 0.0)


@kernel()
def _any_over(
    power: FloatImage, v: int, first: int, last: int, least: np.float32
) -> bool:  # pragma: no cover
    """Say whether any pixel of a row between two columns has at least some power."""
    some = False
    for u in range(_index(first), _index(last)):
        some |= power[v, u] >= least
    return some


@kernel()
def _mark_echoes(  # noqa: C901, PLR0912  (a kernel)
    power: FloatImage,
    known: BoolImage,
    spans: Spans,
    radius: tuple[int, int],
    threshold: float,
    out: BoolImage,
) -> None:  # pragma: no cover
    """Mark the known pixels whose box's mean is over a threshold, and all in the box around them."""
    rows, cols = power.shape
    r, c = radius
    turn = 2 * r + 1
    # No mean is over the threshold without a pixel in its box that is: chunks that lie near none are passed
    # over. `bright` says of each row of chunks whether it, or a column beside it in the box, holds one.
    least = np.float32(threshold)
    chunks = cols // _CHUNK + 1
    bright = np.zeros((turn, chunks), np.bool_)
    over, total = np.zeros(_CHUNK + 2 * c), np.empty(_CHUNK)
    for w in range(rows + r):
        if w < rows:
            first, last = spans[w]
            bright[w % turn, :] = False
            for chunk in range(max(0, first - c) // _CHUNK, min(chunks, (last + c - 1) // _CHUNK + 1)):
                left, right = max(first, chunk * _CHUNK - c), min(last, (chunk + 1) * _CHUNK + c)
                bright[w % turn, chunk] = _any_over(power, w, left, max(left, right), least)
        v = w - r
        if v < 0:
            continue
        top, bottom = max(0, v - r), min(rows, v + r + 1)
        first, last = spans[v]
        for chunk in range(first // _CHUNK, (last + _CHUNK - 1) // _CHUNK):
            some = False
            for b in range(top, bottom):
                some |= bright[b % turn, chunk]
            if not some:
                continue
            begin, end = chunk * _CHUNK, min(cols, (chunk + 1) * _CHUNK)
            left, right = max(0, begin - c), min(cols, end + c)
            over[:] = 0.0
            shift = c - begin
            for b in range(top, bottom):
                for u in range(_index(left), _index(right)):
                    bounded = min(np.float64(power[b, u]), MOST_POWER)
                    over[u + _index(shift)] += bounded - threshold * known[b, u]
            total[:] = over[:_CHUNK]
            for s in range(1, 2 * c + 1):
                beside = over[s : s + _CHUNK]
                for i in range(_CHUNK):
                    total[i] += beside[i]
            some = False
            for i in range(_CHUNK):
                some |= total[i] > 0.0
            if some:
                for u in range(begin, end):
                    if known[v, u] and total[u - begin] > 0.0:
                        out[top:bottom, max(0, u - c) : u + c + 1] = True


@kernel(error_model="numpy")
def _interiors(  # noqa: C901, PLR0912  (a kernel)
    power: FloatImage,
    known: BoolImage,
    spans: Spans,
    radius: tuple[int, int],
    threshold: float,
    levels: FloatImage,
    powers: FloatImage,
) -> int:  # pragma: no cover
    """List the pixels whose brightest neighbour in a box, by the mean of its own, is under a threshold.

    Returns their number; `levels` gets the mean of that neighbour, `powers` the pixel's own power.
    """
    rows, cols = power.shape
    r, c = radius
    turn = 2 * r + 1
    infinite = np.float32(np.inf)
    # With `c` columns more to either side of the view, which add nothing to a sum nor raise a maximum.
    sums, counts = np.zeros(cols + 2 * c), np.zeros(cols + 2 * c, np.float32)
    means = np.empty(cols + 2 * c, np.float32)
    totals, numbers = np.empty(cols), np.empty(cols, np.float32)
    brightest = np.full((turn, cols), -infinite)
    highest = np.empty(cols, np.float32)
    found = 0
    for w in range(-r, rows + r):
        come, gone = w + r, w - r - 1
        if come < rows:
            for u in range(_index(spans[come, 0]), _index(spans[come, 1])):
                sums[u + _index(c)] += min(np.float64(power[come, u]), MOST_POWER)
                counts[u + _index(c)] += np.float32(known[come, u])
        if 0 <= gone < rows:
            for u in range(_index(spans[gone, 0]), _index(spans[gone, 1])):
                sums[u + _index(c)] -= min(np.float64(power[gone, u]), MOST_POWER)
                counts[u + _index(c)] -= np.float32(known[gone, u])
        if w >= rows:
            brightest[w % turn, :] = -infinite
        elif w >= 0:
            first, last = spans[w]
            length = last - first
            total, number = totals[:length], numbers[:length]
            total[:], number[:] = sums[first:last], counts[first:last]
            for s in range(1, 2 * c + 1):
                sums_beside, counts_beside = sums[first + s : last + s], counts[first + s : last + s]
                for i in range(length):
                    total[i] += sums_beside[i]
                    number[i] += counts_beside[i]
            mean, here = means[first + c : last + c], known[w, first:last]
            for i in range(length):
                mean[i] = np.float32(total[i]) / number[i] if here[i] else infinite
            for u in range(first - c, first):
                means[u + c] = infinite if u >= 0 else -infinite
            for u in range(last, last + c):
                means[u + c] = infinite if u < cols else -infinite
            most = brightest[w % turn, first:last]
            most[:] = means[first:last]
            for s in range(1, 2 * c + 1):
                means_beside = means[first + s : last + s]
                for i in range(length):
                    most[i] = max(most[i], means_beside[i])
        v = w - r
        if v < 0:
            continue
        # Beyond the span of any of these rows a neighbour is unknown.
        begin, end = max(0, v - r), min(rows, v + r + 1)
        first, last = 0, cols
        for b in range(begin, end):
            first, last = max(first, spans[b, 0]), min(last, spans[b, 1])
        some = False
        last = max(first, last)
        above = highest[first:last]
        above[:] = brightest[0, first:last]
        for b in range(1, turn):
            row = brightest[b, first:last]
            for i in range(last - first):
                above[i] = max(above[i], row[i])
        for i in range(last - first):
            some |= above[i] < threshold
        if not some:
            continue
        for u in range(first, last):
            if highest[u] < threshold:
                levels[found], powers[found] = highest[u], power[v, u]
                found += 1
    return found


class LocalMeans:
    """Means of a view's power over boxes of its known pixels.

    Boxes are given by their half-size (rows, cols) in resolution cells, and end at the view's edges.

    Parameters
    ----------
    power : ndarray of float32, shape (rows, cols)
        (i/σ_r)²/2; 0 where unknown.
    known : ndarray of bool, shape (rows, cols)
        Pixels to count.
    cell_px : (float, float)
        Pixels a resolution cell, (rows, cols): `ViewInfo.cell_px`.
    spans : ndarray of int32, shape (rows, 2), optional
        Columns outside of which each row knows nothing: first, and one after the last. Looked for if not
        given.
    """

    def __init__(
        self,
        power: FloatImage,
        known: BoolImage,
        cell_px: tuple[float, float],
        spans: Spans | None = None,
    ) -> None:
        self.power = power
        self.known = known
        self.cell_px = cell_px
        self.spans = _spans_of(known) if spans is None else spans

    @property
    def total_known(self) -> int:
        """Number of known pixels."""
        return int(np.count_nonzero(self.known))

    def box_px(self, half_cells: tuple[float, float]) -> tuple[int, int]:
        """Return the half-size of a box in pixels, at least one each way and at most the view's."""
        rows, cols = (
            round(min(half * cell, n))
            for half, cell, n in zip(half_cells, self.cell_px, self.known.shape, strict=True)
        )
        return max(rows, 1), max(cols, 1)

    def pixels(self, cells: float) -> int:
        """Return the number of pixels in this many resolution cells."""
        return math.ceil(cells * self.cell_px[0] * self.cell_px[1])

    def under(
        self, half_cells: tuple[float, float], threshold: float, rows: slice = _ALL, cols: slice = _ALL
    ) -> BoolImage:
        """Mark the known pixels around which the mean is less than a threshold, in a part of the view.

        Parameters
        ----------
        half_cells : (float, float)
            Half-size of the box, resolution cells.
        threshold : float
            Mean power.
        rows, cols : slice
            The part, without steps; boxes reach out of it.
        """
        out = np.empty(self.known[rows, cols].shape, np.bool_)
        corner = rows.indices(self.known.shape[0])[0], cols.indices(self.known.shape[1])[0]
        _under(self.power, self.known, self.spans, corner, self.box_px(half_cells), threshold, out)
        return out

    def echoes(self, threshold: float) -> BoolImage:
        """Mark the known pixels whose mean over `ECHO_CELLS` is over a threshold, and all in that box."""
        out = np.zeros(self.known.shape, np.bool_)
        _mark_echoes(self.power, self.known, self.spans, self.box_px(ECHO_CELLS), threshold, out)
        return out

    def interiors(self, threshold: float) -> tuple[FloatImage, FloatImage]:
        """List the pixels all of whose neighbours in `INNER_CELLS` have means over as much under a threshold.

        Returns
        -------
        (levels, powers)
            The highest of these means, and the pixel's own power, row by row.
        """
        levels, powers = (np.empty(self.known.size, np.float32) for _ in range(2))
        radius = self.box_px(INNER_CELLS)
        found = _interiors(self.power, self.known, self.spans, radius, threshold, levels, powers)
        return levels[:found], powers[:found]
