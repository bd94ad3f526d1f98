"""Shadow masks: what their values mean, how they are kept, and which of their covered pixels are near."""

from __future__ import annotations

import math
from dataclasses import dataclass

import lz4.block
import numpy as np
from numpy.typing import NDArray

from ..geometry import View, ViewInfo
from ..kernels import kernel
from .mask_codes import MASK_COVERED, MASK_OUTSIDE, MASK_SHADOW, MASK_UNKNOWN

#: An echo speaks for so much on either side of it (resolution cells across): an edge that glitters has gaps.
_BESIDE_CELLS = 0.75
#: The flank of a shadow without an echo before it (resolution cells down-range).
_FLANK_CELLS = 1.2


def beside_px(info: ViewInfo) -> int:
    """Return how many columns on either side an echo covers."""
    return max(1, round(_BESIDE_CELLS * info.cell_px[1]))


def flank_px(info: ViewInfo) -> int:
    """Return how many rows before a shadow are its flank."""
    return max(1, round(_FLANK_CELLS * info.cell_px[0]))


@dataclass(frozen=True, eq=False)
class KeptMask:
    """A shadow mask, kept small: some kB for a view."""

    info: ViewInfo
    packed: bytes

    @classmethod
    def of(cls, view: View) -> KeptMask:
        """Keep a mask."""
        return cls(view.info, lz4.block.compress(np.ascontiguousarray(view.pixels)))

    @property
    def grazing_quarters(self) -> int:
        """Grazing angle in quarters of a degree."""
        return round(math.degrees(self.info.camera.grazing_rad) * 4.0)

    def view(self) -> View:
        """Return the mask as it was."""
        pixels = np.frombuffer(lz4.block.decompress(self.packed), np.uint8)
        return View(self.info, pixels.reshape(self.info.camera.shape))

    def near(self) -> KeptMask:
        """Return the mask with covered pixels far before the shadow as lit seabed (`near_covered`)."""
        view = self.view()
        if not (view.pixels == MASK_COVERED).any():
            return self
        return KeptMask.of(near_covered(view))


def near_covered(mask: View) -> View:
    """Mark covered pixels as lit seabed if they lie farther before a stretch of shadow than it is long.

    What stands that near may be an open frame, what lies farther a low wide body: the two readings of a mask
    between which carving decides (`Carver`).

    Parameters
    ----------
    mask : View
        A shadow mask, shape (rows, cols).
    """
    out = np.where(mask.pixels == MASK_COVERED, np.uint8(MASK_OUTSIDE), mask.pixels)
    _mark_near(np.ascontiguousarray(mask.pixels), flank_px(mask.info), beside_px(mask.info), out)
    return View(mask.info, out)


@kernel()
def _mark_near(
    mask: NDArray[np.uint8], flank: int, beside: int, out: NDArray[np.uint8]
) -> None:  # pragma: no cover
    """Mark covered pixels from the farthest echo on that is no farther than the stretch behind it is long."""
    rows, cols = mask.shape
    starts = np.full(cols, -1, np.int32)
    for i in range(rows + 1):
        for j in range(cols):
            start = starts[j]
            dark = i < rows and mask[i, j] == MASK_SHADOW
            if dark == (start >= 0):
                continue
            if dark:
                starts[j] = i
                continue
            reach = max(0, start - (i - start))
            begin = max(reach, start - flank)
            for k in range(reach, start):
                echo = False
                for c in range(max(0, j - beside), min(cols, j + beside + 1)):
                    echo |= mask[k, c] == MASK_UNKNOWN
                if echo:
                    begin = min(begin, k)
                    break
            for k in range(begin, start):
                if mask[k, j] == MASK_COVERED:
                    out[k, j] = MASK_COVERED
            starts[j] = -1
