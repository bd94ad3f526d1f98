"""Interpolation of 4×4 complex samples as vector instructions.

Written as a loop it becomes vectors of two numbers at a time, or none: the compiler builds them from the two
results back. Here the four neighbours of a row, real and imaginary parts in turns, are one vector of eight.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


class _Emitter:  # pragma: no cover
    """Writes instructions for compiled code that work on the arguments of the intrinsic, by their number."""

    _FLAGS = ("fast",)

    def __init__(self, context: Any, builder: Any, sig: Any, args: Any) -> None:
        self._context, self._builder, self._sig, self._args = context, builder, sig, args
        self._integer, self._index = ir.IntType(32), ir.IntType(64)

    def _data(self, number: int) -> Any:
        make = self._context.make_array(self._sig.args[number])
        return make(self._context, self._builder, self._args[number]).data

    def _entry(self, number: int, pixel: Any) -> Any:
        place = self._builder.gep(self._data(number), [pixel])
        return self._builder.sext(self._builder.load(place), self._index)

    def _vector(self, pointer: Any, length: int) -> Any:
        kind = ir.VectorType(ir.FloatType(), length)
        loaded = self._builder.load(self._builder.bitcast(pointer, kind.as_pointer()))
        loaded.align = 4
        return loaded

    def _lanes(self, a: Any, b: Any, *which: int) -> Any:
        kind = ir.VectorType(self._integer, len(which))
        return self._builder.shuffle_vector(a, b, ir.Constant(kind, [self._integer(i) for i in which]))

    def halves(self, a: Any, b: Any, low: list[int], high: list[int]) -> Any:
        """Add some lanes of two vectors to others of them."""
        return self._builder.fadd(self._lanes(a, b, *low), self._lanes(a, b, *high), flags=self._FLAGS)

    def columns(self, k: int) -> Any:
        """Sum the rows of the k-th pixel from the first, and weigh its four columns."""
        builder = self._builder
        pixel = builder.add(self._args[6], self._index(k))
        row = builder.gep(self._data(0), [self._entry(3, pixel)])
        weight = builder.gep(self._data(2), [self._entry(5, pixel)])
        total = None
        for _ in range(4):
            one = self._vector(weight, 1)
            term = builder.fmul(self._vector(row, 8), self._lanes(one, one, *[0] * 8), flags=self._FLAGS)
            total = term if total is None else builder.fadd(total, term, flags=self._FLAGS)
            row, weight = builder.gep(row, [self._args[1]]), builder.gep(weight, [self._index(1)])
        weights = self._vector(builder.gep(self._data(2), [self._entry(4, pixel)]), 4)
        return builder.fmul(total, self._lanes(weights, weights, 0, 0, 1, 1, 2, 2, 3, 3), flags=self._FLAGS)

    def store(self, result: Any) -> None:
        """Store the pixels' values where they go."""
        place = self._builder.gep(self._data(7), [self._args[8]])
        pointer = self._builder.bitcast(place, result.type.as_pointer())
        self._builder.store(result, pointer).align = 4


def _interpolate_4x4(count: int) -> Any:
    """Return what interpolates `count` (1 or 4) neighbouring pixels, for compiled code. Nothing is checked.

    Pixel p is Σ_j table[down[p] + j] Σ_i table[across[p] + i] samples[starts[p] + j stride + i].

    Parameters of the intrinsic, all arrays flat
    --------------------------------------------
    samples, stride
        float32, real and imaginary parts in turns; how far the next row is.
    table
        float32, sets of four weights.
    starts, across, down
        int32; for each pixel, where the first of its samples and of its weights along both axes are.
    first
        The first pixel.
    out, place
        float32; where the first pixel's real part goes, the others behind it.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:  # pragma: no cover
        emit = _Emitter(context, builder, sig, args)
        if count == 1:
            whole = emit.columns(0)
            half = emit.halves(whole, whole, [0, 1, 2, 3], [4, 5, 6, 7])
            result = emit.halves(half, half, [0, 1], [2, 3])
        else:
            # Four sums at once: of two pixels each by halves, then of all by quarters.
            low, high = [0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]
            a, b = (emit.halves(emit.columns(k), emit.columns(k + 1), low, high) for k in (0, 2))
            result = emit.halves(a, b, [0, 1, 4, 5, 8, 9, 12, 13], [2, 3, 6, 7, 10, 11, 14, 15])
        emit.store(result)
        return context.get_dummy_value()

    def interpolate(
        typingctx: Any,  # noqa: ARG001  (numba's)
        samples: Any,
        stride: Any,
        table: Any,
        starts: Any,
        across: Any,
        down: Any,
        first: Any,
        out: Any,
        place: Any,
    ) -> Any:  # pragma: no cover
        return types.void(samples, stride, table, starts, across, down, first, out, place), codegen

    return intrinsic(interpolate)


#: Typed as what they are in compiled code: numba itself hands the first argument over.
interpolate_one: Any = _interpolate_4x4(1)
interpolate_four: Any = _interpolate_4x4(4)
