"""Products of small matrices inside compiled loops, with their sums in registers, which LLVM does not find itself."""

from __future__ import annotations

from collections.abc import Callable

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

COLUMNS = 16
"""Columns of a product unless it says otherwise: two registers of AVX2, one of AVX-512."""


def product(rows: int, columns: int = COLUMNS, add: bool = False, relu: bool = False, gated: bool = False) -> Callable:
    """A part of compiled functions: ``c[r, j] = sum_s a[r, s] b[s, j]``, r < ``rows``, j < ``columns``.

    Six rows of sixteen columns fill the sixteen registers of AVX2. All three are contiguous float32 arrays of any
    shape, of which it is told where a matrix begins and how far apart its rows and columns are, in numbers::

        part(a, a_start, a_row, a_column, b, b_start, b_row, c, c_start, c_row, steps)

    Columns of b and c are neighbours. Nothing is checked: an index beyond an array reads or writes what is there.

    Args:
        rows: of a and c.
        columns: of b and c, a multiple of 16.
        add: to what is in c.
        relu: of the sum, at the end.
        gated: the part is given one array more, with numbers at the places of c's: c is 0 where they are zero or less,
            as the gradient of ReLU is, of its results.
    """
    vector, index = ir.VectorType(ir.FloatType(), columns), types.int64
    first_lane = ir.Constant(ir.VectorType(ir.IntType(32), columns), [0] * columns)
    undefined, zero = ir.Constant(vector, ir.Undefined), ir.Constant(vector, [0.0] * columns)

    def lowered(context, builder, signature, given):
        def data(argument):
            return context.make_array(signature.args[argument])(context, builder, given[argument]).data

        def at(base, start, step, times):
            return builder.gep(base, [builder.add(start, builder.mul(step, times))])

        def vector_at(base, start, step, times):
            return builder.bitcast(at(base, start, step, times), vector.as_pointer())

        _, a_start, a_row, a_column, _, b_start, b_row, _, c_start, c_row, steps = given[:11]
        a, b, c = data(0), data(4), data(7)
        numbers = [ir.IntType(64)(row) for row in range(rows)]
        places = [vector_at(c, c_start, c_row, row) for row in numbers]
        sums = [cgutils.alloca_once(builder, vector) for _ in numbers]  # LLVM makes registers of them
        for place, total in zip(places, sums, strict=True):
            builder.store(builder.load(place, align=4) if add else zero, total)
        with cgutils.for_range(builder, steps) as step:
            right = builder.load(vector_at(b, b_start, b_row, step.index), align=4)
            column = builder.add(a_start, builder.mul(a_column, step.index))
            for row, total in zip(numbers, sums, strict=True):
                left = builder.insert_element(undefined, builder.load(at(a, column, a_row, row)), ir.IntType(32)(0))
                left = builder.shuffle_vector(left, undefined, first_lane)
                product = builder.fmul(left, right, flags=("contract",))
                builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
        for row, place, total in zip(numbers, places, sums, strict=True):
            result = builder.load(total)
            if relu or gated:
                seen = builder.load(vector_at(data(11), c_start, c_row, row), align=4) if gated else result
                result = builder.select(builder.fcmp_ordered("<=", seen, zero), zero, result)
            builder.store(result, place, align=4)
        return context.get_dummy_value()

    def signature(a, b, c, *gate):
        return types.void(a, index, index, index, b, index, index, c, index, index, index, *gate)

    if gated:

        @intrinsic
        def part(_, a, a_start, a_row, a_column, b, b_start, b_row, c, c_start, c_row, steps, gate):
            return signature(a, b, c, gate), lowered

    else:

        @intrinsic
        def part(_, a, a_start, a_row, a_column, b, b_start, b_row, c, c_start, c_row, steps):
            return signature(a, b, c), lowered

    return part
