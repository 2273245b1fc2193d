# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows between the (3, n) float64 arrays of the state and the padded rows of the kernels, in explicit vectors.

Written down as vectors because loops over two arrays are only vectorised behind checks that they do not overlap,
which cost more than a row.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from cloth_sim_ros.physics.kernels.grid_emit import vector_bytes


def _loops(context: Any, builder: Any, count: Any, narrow: bool, body: Any) -> None:
    """Call body(index, lanes) for whole vectors of `count` numbers, then for the numbers left over, one at a time."""
    lanes = vector_bytes() // (4 if narrow else 8)
    width = context.get_constant(types.intp, lanes)
    whole = builder.mul(builder.sdiv(count, width), width)
    with cgutils.for_range_slice(builder, context.get_constant(types.intp, 0), whole, width) as (index, _):
        body(index, lanes)
    with cgutils.for_range_slice(builder, whole, count, context.get_constant(types.intp, 1)) as (index, _):
        body(index, 1)


def _kind(narrow: bool, lanes: int) -> Any:
    element = ir.FloatType() if narrow else ir.DoubleType()
    return element if lanes == 1 else ir.VectorType(element, lanes)


def _place(builder: Any, data: Any, start: Any, index: Any, kind: Any) -> Any:
    return builder.bitcast(builder.gep(data, [builder.add(start, index)]), kind.as_pointer())


def _splat(builder: Any, scalar: Any, lanes: int) -> Any:
    if lanes == 1:
        return scalar
    kind, mask = ir.VectorType(scalar.type, lanes), ir.VectorType(ir.IntType(32), lanes)
    empty = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(empty, scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, empty, ir.Constant(mask, [ir.Constant(ir.IntType(32), 0)] * lanes))


@intrinsic
def copy_in(typing, source, start, origin, count, target, place):  # type: ignore[no-untyped-def]
    """target[place + j] = source[start + j] - origin for j < count. `source` is flat float64, `target` flat of
    either precision.
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        _, start_, origin_, count_, _, place_ = arguments
        narrow = signature.args[4].dtype == types.float32
        data, goal = (context.make_array(signature.args[i])(context, builder, arguments[i]).data for i in (0, 4))

        def body(index: Any, lanes: int) -> None:
            value = builder.load(_place(builder, data, start_, index, _kind(False, lanes)), align=8)
            value = builder.fsub(value, _splat(builder, origin_, lanes))
            if narrow:
                value = builder.fptrunc(value, _kind(True, lanes))
            builder.store(value, _place(builder, goal, place_, index, _kind(narrow, lanes)), align=4 if narrow else 8)

        _loops(context, builder, count_, narrow, body)
        return context.get_dummy_value()

    return types.void(source, types.intp, types.float64, types.intp, target, types.intp), generate


@intrinsic
def add_out(typing, source, place, count, target, start):  # type: ignore[no-untyped-def]
    """target[start + j] += source[place + j] for j < count. `source` is flat of either precision, `target` flat
    float64.
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        _, place_, count_, _, start_ = arguments
        narrow = signature.args[0].dtype == types.float32
        data, goal = (context.make_array(signature.args[i])(context, builder, arguments[i]).data for i in (0, 3))

        def body(index: Any, lanes: int) -> None:
            value = builder.load(_place(builder, data, place_, index, _kind(narrow, lanes)), align=4 if narrow else 8)
            if narrow:
                value = builder.fpext(value, _kind(False, lanes))
            at = _place(builder, goal, start_, index, _kind(False, lanes))
            builder.store(builder.fadd(builder.load(at, align=8), value), at, align=8)

        _loops(context, builder, count_, narrow, body)
        return context.get_dummy_value()

    return types.void(source, types.intp, types.intp, target, types.intp), generate


@intrinsic
def change_out(typing, before, start, origin, count, rows, place, speed, back, target):  # type: ignore[no-untyped-def]
    """target[start + j] = before[start + j] + (rows[place + j] - b - back rows[speed + j]) for j < count, b being
    before[start + j] - origin rounded as `rows` is. `before` and `target` are flat float64 and may be the same, `rows`
    flat of either precision. Only the difference to b is taken in the precision of `rows`.
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        _, start_, origin_, count_, _, place_, speed_, back_, _ = arguments
        narrow = signature.args[4].dtype == types.float32
        old, data, goal = (
            context.make_array(signature.args[i])(context, builder, arguments[i]).data for i in (0, 4, 8)
        )
        align = 4 if narrow else 8

        def body(index: Any, lanes: int) -> None:
            wide, own = _kind(False, lanes), _kind(narrow, lanes)
            first = builder.load(_place(builder, old, start_, index, wide), align=8)
            rounded = builder.fsub(first, _splat(builder, origin_, lanes))
            change = builder.load(_place(builder, data, place_, index, own), align=align)
            moving = builder.load(_place(builder, data, speed_, index, own), align=align)
            if narrow:
                change = builder.fpext(builder.fsub(change, builder.fptrunc(rounded, own)), wide)
                moving = builder.fpext(moving, wide)
            else:
                change = builder.fsub(change, rounded)
            change = builder.fsub(change, builder.fmul(_splat(builder, back_, lanes), moving))
            builder.store(builder.fadd(first, change), _place(builder, goal, start_, index, wide), align=8)

        _loops(context, builder, count_, narrow, body)
        return context.get_dummy_value()

    kinds = (before, types.intp, types.float64, types.intp, rows, types.intp, types.intp, types.float64, target)
    return types.void(*kinds), generate
