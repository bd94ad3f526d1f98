"""One interpolation of 4×4 complex samples as vector instructions.

Written as a loop it becomes vectors of two numbers at a time, or none: the compiler builds them from the two
results back. Here the four neighbours of a row, real and imaginary parts in turns, are one vector of eight.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _interpolate_4x4(
    typingctx: Any,
    samples: Any,
    first: Any,
    stride: Any,
    across: Any,
    entry_across: Any,
    down: Any,
    entry_down: Any,
    out: Any,
    place: Any,
) -> Any:  # pragma: no cover
    """Write Σ_j down[j] Σ_i across[i] samples[first + j stride + i] to `out`, all flat arrays of float32.

    For compiled code. Nothing is checked.

    Parameters
    ----------
    samples, first, stride
        Real and imaginary parts in turns; where the first of 4×4 begins, and how far the next row is.
    across, entry_across
        Weights along a row, each twice, and where the first of eight is.
    down, entry_down
        Weights of the rows, and where the first of four is.
    out, place
        Where the real part goes, the imaginary one behind it.
    """
    signature = types.void(samples, first, stride, across, entry_across, down, entry_down, out, place)
    two, four, eight = (ir.VectorType(ir.FloatType(), n) for n in (2, 4, 8))
    integer = ir.IntType(32)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def at(number: int, index: Any) -> Any:
            data = context.make_array(sig.args[number])(context, builder, args[number]).data
            return builder.gep(data, [index])

        def vector(pointer: Any, kind: Any) -> Any:
            loaded = builder.load(builder.bitcast(pointer, kind.as_pointer()))
            loaded.align = 4
            return loaded

        def lanes(value: Any, *which: int) -> Any:
            mask = ir.Constant(ir.VectorType(integer, len(which)), [integer(i) for i in which])
            return builder.shuffle_vector(value, ir.Constant(value.type, ir.Undefined), mask)

        flags = ("fast",)
        row = at(0, args[1])
        weights, total = vector(at(5, args[6]), four), None
        for j in range(4):
            term = builder.fmul(vector(row, eight), lanes(weights, *[j] * 8), flags=flags)
            total = term if total is None else builder.fadd(total, term, flags=flags)
            row = builder.gep(row, [args[2]])
        weighted = builder.fmul(total, vector(at(3, args[4]), eight), flags=flags)
        half = builder.fadd(lanes(weighted, 0, 1, 2, 3), lanes(weighted, 4, 5, 6, 7), flags=flags)
        result = builder.fadd(lanes(half, 0, 1), lanes(half, 2, 3), flags=flags)
        stored = builder.store(result, builder.bitcast(at(7, args[8]), two.as_pointer()))
        stored.align = 4
        return context.get_dummy_value()

    return signature, codegen


#: Typed as what it is in compiled code: numba itself hands the first argument over.
interpolate_4x4: Any = intrinsic(_interpolate_4x4)
