"""Means over boxes of a view's known pixels: what levels, echoes and shadow are told from.

Each asks of the mean power around a pixel only on which side of a threshold it lies, over a box of its own
size. Sums are kept in double precision, as a threshold must not depend on the order in which they were made.
Half of a view is off the image: every row is looked at only where it knows something.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .kernels import kernel

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
#: Shadow is measured where everything this far around is dark: by boxes of 5×5, the brightest of 5×5.
_INNER = 2

# Columns are counted unsigned in the loops over pixels: the compiler then need not ask whether an index
# counts from the end, and makes vectors of them without a slice for each row, which costs as much as 50
# pixels.
_index = np.uintp


@kernel()
def known_span(known: BoolImage, v: int) -> tuple[int, int]:  # pragma: no cover
    """Return the columns between which a row knows anything: first, and one after the last."""
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
def _mark_echoes(
    power: FloatImage, known: BoolImage, spans: Spans, threshold: float, out: BoolImage
) -> None:  # pragma: no cover
    """Mark the known pixels whose 3×3 mean is over a threshold, and their neighbours."""
    rows, cols = power.shape
    # No mean is over the threshold without a pixel in its box that is: chunks that lie near none are passed
    # over. `bright` says of each row of chunks whether it, or the column beside it, holds one.
    least = np.float32(threshold)
    bright = np.zeros((3, cols // _CHUNK + 1), np.bool_)
    over, total = np.zeros(_CHUNK + 2), np.empty(_CHUNK)
    for w in range(rows + 1):
        if w < rows:
            first, last = spans[w]
            bright[w % 3, :] = False
            for chunk in range(max(0, first - 1) // _CHUNK, (last + _CHUNK) // _CHUNK):
                left, right = max(first, chunk * _CHUNK - 1), min(last, (chunk + 1) * _CHUNK + 1)
                bright[w % 3, chunk] = _any_over(power, w, left, max(left, right), least)
        v = w - 1
        if v < 0:
            continue
        top, bottom = max(0, v - 1), min(rows, v + 2)
        first, last = spans[v]
        for chunk in range(first // _CHUNK, (last + _CHUNK - 1) // _CHUNK):
            if not (bright[top % 3, chunk] | bright[v % 3, chunk] | bright[(bottom - 1) % 3, chunk]):
                continue
            begin, end = chunk * _CHUNK, min(cols, (chunk + 1) * _CHUNK)
            left, right = max(0, begin - 1), min(cols, end + 1)
            over[:] = 0.0
            shift = 1 - begin
            for b in range(top, bottom):
                for u in range(_index(left), _index(right)):
                    bounded = min(np.float64(power[b, u]), MOST_POWER)
                    over[u + _index(shift)] += bounded - threshold * known[b, u]
            some = False
            for i in range(_CHUNK):
                total[i] = over[i] + over[i + 1] + over[i + 2]
                some |= total[i] > 0.0
            if some:
                for u in range(begin, end):
                    if known[v, u] and total[u - begin] > 0.0:
                        out[top:bottom, max(0, u - 1) : u + 2] = True


@kernel(error_model="numpy")
def _interiors(
    power: FloatImage,
    known: BoolImage,
    spans: Spans,
    threshold: float,
    levels: FloatImage,
    powers: FloatImage,
) -> int:  # pragma: no cover
    """List the pixels whose brightest neighbour in 5×5, by its own 5×5 mean, is under a threshold.

    Returns their number; `levels` gets the mean of that neighbour, `powers` the pixel's own power.
    """
    rows, cols = power.shape
    turn = 2 * _INNER + 1
    infinite = np.float32(np.inf)
    # With two columns more to either side of the view, which add nothing to a sum nor raise a maximum.
    sums, counts = np.zeros(cols + 2 * _INNER), np.zeros(cols + 2 * _INNER, np.float32)
    means = np.empty(cols + 2 * _INNER, np.float32)
    brightest = np.full((turn, cols), -infinite)
    highest = np.empty(cols, np.float32)
    found = 0
    for w in range(-_INNER, rows + _INNER):
        come, gone = w + _INNER, w - _INNER - 1
        if come < rows:
            for u in range(_index(spans[come, 0]), _index(spans[come, 1])):
                sums[u + _index(_INNER)] += min(np.float64(power[come, u]), MOST_POWER)
                counts[u + _index(_INNER)] += np.float32(known[come, u])
        if 0 <= gone < rows:
            for u in range(_index(spans[gone, 0]), _index(spans[gone, 1])):
                sums[u + _index(_INNER)] -= min(np.float64(power[gone, u]), MOST_POWER)
                counts[u + _index(_INNER)] -= np.float32(known[gone, u])
        if w >= rows:
            brightest[w % turn, :] = -infinite
        elif w >= 0:
            first, last = spans[w]
            s, n = sums[first : last + 2 * _INNER], counts[first : last + 2 * _INNER]
            mean, here = means[first + _INNER : last + _INNER], known[w, first:last]
            for i in range(last - first):
                total = s[i] + s[i + 1] + s[i + 2] + s[i + 3] + s[i + 4]
                count = n[i] + n[i + 1] + n[i + 2] + n[i + 3] + n[i + 4]
                mean[i] = np.float32(total) / count if here[i] else infinite
            for u in range(first - _INNER, first):
                means[u + _INNER] = infinite if u >= 0 else -infinite
            for u in range(last, last + _INNER):
                means[u + _INNER] = infinite if u < cols else -infinite
            m, most = means[first : last + 2 * _INNER], brightest[w % turn, first:last]
            for i in range(last - first):
                most[i] = max(max(max(m[i], m[i + 1]), max(m[i + 2], m[i + 3])), m[i + 4])
        v = w - _INNER
        if v < 0:
            continue
        # Beyond the span of any of these rows a neighbour is unknown.
        begin, end = max(0, v - _INNER), min(rows, v + _INNER + 1)
        first, last = 0, cols
        for b in range(begin, end):
            first, last = max(first, spans[b, 0]), min(last, spans[b, 1])
        some = False
        for u in range(_index(first), _index(max(first, last))):
            a, b = max(brightest[0, u], brightest[1, u]), max(brightest[2, u], brightest[3, u])
            highest[u] = max(max(a, b), brightest[4, u])
            some |= highest[u] < threshold
        if not some:
            continue
        for u in range(first, last):
            if highest[u] < threshold:
                levels[found], powers[found] = highest[u], power[v, u]
                found += 1
    return found


class LocalMeans:
    """Means of a view's power over boxes of its known pixels.

    Boxes are given by their half-size (rows, cols) in pixels, and end at the view's edges.

    Parameters
    ----------
    power : ndarray of float32, shape (rows, cols)
        (i/σ_r)²/2; 0 where unknown.
    known : ndarray of bool, shape (rows, cols)
        Pixels to count.
    spans : ndarray of int32, shape (rows, 2), optional
        Columns outside of which each row knows nothing: first, and one after the last. Looked for if not
        given.
    """

    def __init__(self, power: FloatImage, known: BoolImage, spans: Spans | None = None) -> None:
        self.power = power
        self.known = known
        self.spans = _spans_of(known) if spans is None else spans

    @property
    def total_known(self) -> int:
        """Number of known pixels."""
        return int(np.count_nonzero(self.known))

    def under(
        self, radius_px: tuple[int, int], threshold: float, rows: slice = _ALL, cols: slice = _ALL
    ) -> BoolImage:
        """Mark the known pixels around which the mean is less than a threshold, in a part of the view.

        Parameters
        ----------
        radius_px : (int, int)
            Half-size of the box.
        threshold : float
            Mean power.
        rows, cols : slice
            The part, without steps; boxes reach out of it.
        """
        out = np.empty(self.known[rows, cols].shape, np.bool_)
        corner = rows.indices(self.known.shape[0])[0], cols.indices(self.known.shape[1])[0]
        _under(self.power, self.known, self.spans, corner, radius_px, threshold, out)
        return out

    def echoes(self, threshold: float) -> BoolImage:
        """Mark the known pixels whose mean of 3×3 is more than a threshold, and their neighbours."""
        out = np.zeros(self.known.shape, np.bool_)
        _mark_echoes(self.power, self.known, self.spans, threshold, out)
        return out

    def interiors(self, threshold: float) -> tuple[FloatImage, FloatImage]:
        """List the pixels all of whose 5×5 neighbours have means of 5×5 under a threshold.

        Returns
        -------
        (levels, powers)
            The highest of these means, and the pixel's own power, row by row.
        """
        levels, powers = (np.empty(self.known.size, np.float32) for _ in range(2))
        found = _interiors(self.power, self.known, self.spans, threshold, levels, powers)
        return levels[:found], powers[:found]
