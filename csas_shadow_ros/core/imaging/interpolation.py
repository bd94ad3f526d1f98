"""Interpolation of 4×4 complex samples as vector instructions.

Written as a loop it becomes vectors of two numbers at a time, or none: the compiler builds them from the two
results back. Here the four neighbours of a row, real and imaginary parts in turns, are one vector of eight.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


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
        signature = types.void(samples, stride, table, starts, across, down, first, out, place)
        integer, index = ir.IntType(32), ir.IntType(64)
        flags = ("fast",)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            def data(number: int) -> Any:
                return context.make_array(sig.args[number])(context, builder, args[number]).data

            def entry(number: int, pixel: Any) -> Any:
                return builder.sext(builder.load(builder.gep(data(number), [pixel])), index)

            def vector(pointer: Any, length: int) -> Any:
                kind = ir.VectorType(ir.FloatType(), length)
                loaded = builder.load(builder.bitcast(pointer, kind.as_pointer()))
                loaded.align = 4
                return loaded

            def lanes(a: Any, b: Any, *which: int) -> Any:
                mask = ir.Constant(ir.VectorType(integer, len(which)), [integer(i) for i in which])
                return builder.shuffle_vector(a, b, mask)

            def halves(a: Any, b: Any, low: list[int], high: list[int]) -> Any:
                return builder.fadd(lanes(a, b, *low), lanes(a, b, *high), flags=flags)

            def columns(k: int) -> Any:
                """Sum a pixel's rows, and weigh its four columns."""
                pixel = builder.add(args[6], index(k))
                row = builder.gep(data(0), [entry(3, pixel)])
                weight = builder.gep(data(2), [entry(5, pixel)])
                total = None
                for _ in range(4):
                    one = vector(weight, 1)
                    term = builder.fmul(vector(row, 8), lanes(one, one, *[0] * 8), flags=flags)
                    total = term if total is None else builder.fadd(total, term, flags=flags)
                    row, weight = builder.gep(row, [args[1]]), builder.gep(weight, [index(1)])
                weights = vector(builder.gep(data(2), [entry(4, pixel)]), 4)
                return builder.fmul(total, lanes(weights, weights, 0, 0, 1, 1, 2, 2, 3, 3), flags=flags)

            if count == 1:
                whole = columns(0)
                half = halves(whole, whole, [0, 1, 2, 3], [4, 5, 6, 7])
                result = halves(half, half, [0, 1], [2, 3])
            else:
                # Four sums at once: of two pixels each by halves, then of all by quarters.
                low, high = [0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]
                a, b = (halves(columns(k), columns(k + 1), low, high) for k in (0, 2))
                result = halves(a, b, [0, 1, 4, 5, 8, 9, 12, 13], [2, 3, 6, 7, 10, 11, 14, 15])
            pointer = builder.bitcast(builder.gep(data(7), [args[8]]), result.type.as_pointer())
            builder.store(result, pointer).align = 4
            return context.get_dummy_value()

        return signature, codegen

    return intrinsic(interpolate)


#: Typed as what they are in compiled code: numba itself hands the first argument over.
interpolate_one: Any = _interpolate_4x4(1)
interpolate_four: Any = _interpolate_4x4(4)
