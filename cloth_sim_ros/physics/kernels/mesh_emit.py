# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A batch of listed springs, and one leapfrog step of a few particles, in explicit vectors.

Each particle is a row of two quads of float64, `x y z 0` and `u v w 0` (the velocity that forces see), and has a
force quad. A batch is LANES springs: the differences of their ends' quads are turned into vectors of one component
each, the law is evaluated once for all, and the forces are given back to the quads, subtracted at the first end and
added at the second, one spring after the other: the order of the sums does not depend on the machine's vectors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from cloth_sim_ros.physics.kernels.grid_emit import SHORTEST_SQUARE, Vectors, vector_bytes

QUAD = 4
"""Numbers of a quad: three components and a zero."""

ROW = 2 * QUAD
"""Numbers of a particle's row."""

LANES = max(vector_bytes() // 8, QUAD)
"""Springs of a batch."""

_LONG = ir.IntType(64)


class Lanes(Vectors):
    """Vectors of float64 with `lanes` lanes, whatever the machine's width: LLVM cuts them up where it must."""

    def __init__(self, builder: Any, lanes: int) -> None:
        super().__init__(builder, 8)
        self.lanes = lanes
        self.type = ir.VectorType(self.element, lanes)

    def shuffle(self, a: Any, b: Any, order: list[int]) -> Any:
        """The vector of the elements of a and b, counted through, in this order."""
        mask = ir.Constant(ir.VectorType(ir.IntType(32), len(order)), [ir.Constant(ir.IntType(32), j) for j in order])
        return self.builder.shuffle_vector(a, b, mask)

    def unpack(self, a: Any, b: Any, odd: int) -> Any:
        """a0 b0 a2 b2 ..., or with `odd` a1 b1 a3 b3 ..."""
        return self.shuffle(a, b, [j + odd + side for j in range(0, self.lanes, 2) for side in (0, self.lanes)])

    def merge(self, a: Any, b: Any, odd: int) -> Any:
        """Of every four elements the first two of a, then of b; with `odd` the last two of each."""
        first = [j + 2 * odd for j in range(0, self.lanes, QUAD)]
        return self.shuffle(a, b, [k + side + low for k in first for side in (0, self.lanes) for low in (0, 1)])

    def where(self, condition: Any, a: Any) -> Any:
        """a where the condition holds, else zero."""
        return self.builder.select(condition, a, self.constant(0.0))

    def above(self, a: Any, b: Any) -> Any:
        """a > b; false for a NaN."""
        return self.builder.fcmp_ordered(">", a, b)


class Batch:
    """Emits a batch: a vector has a spring a lane, a list of LANES values one for each.

    Springs have two ends, hinges four; the words are the springs'.
    """

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.builder = builder
        self.wide, self.quad = Lanes(builder, LANES), Lanes(builder, QUAD)
        self._rows, self._force, self._ends, self._table = (
            context.make_array(signature.args[i])(context, builder, arguments[i]).data for i in range(4)
        )

    def times(self, index: Any, factor: int) -> Any:
        """An index times a constant."""
        return self.builder.mul(index, ir.Constant(_LONG, factor))

    def ends(self, number: Any, count: int) -> list[list[Any]]:
        """Force quads of the first, second, ... ends of the springs of batch `number`."""
        start = self.times(number, count * LANES)
        at = [self.builder.add(start, ir.Constant(_LONG, j)) for j in range(count * LANES)]
        found = [self.builder.sext(self.builder.load(self.builder.gep(self._ends, [j])), _LONG) for j in at]
        return [found[LANES * end : LANES * (end + 1)] for end in range(count)]

    def constants(self, number: Any, count: int) -> list[Any]:
        """Constants of the springs of batch `number`."""
        start = self.times(number, count * LANES)
        return [
            self.wide.load(self._table, self.builder.add(start, ir.Constant(_LONG, k * LANES))) for k in range(count)
        ]

    def away(self, first: list[Any], second: list[Any]) -> list[list[Any]]:
        """For each spring the row of its second end minus that of the first, as many quads in a vector as fit."""
        return [
            [
                self._minus(self.times(b, ROW // QUAD), self.times(a, ROW // QUAD), place)
                for place in range(0, ROW, LANES)
            ]
            for a, b in zip(first, second, strict=True)
        ]

    def _minus(self, b: Any, a: Any, place: int) -> Any:
        offset = ir.Constant(_LONG, place)
        far, near = (self.wide.load(self._rows, self.builder.add(index, offset)) for index in (b, a))
        return self.wide.sub(far, near)

    def _turned(self, four: list[Any]) -> list[Any]:
        """Four vectors of quads as three vectors: in each quad's place one component of the four."""
        low, high = (
            [self.wide.unpack(four[0], four[1], odd), self.wide.unpack(four[2], four[3], odd)] for odd in (0, 1)
        )
        merge = self.wide.merge
        return [merge(low[0], low[1], 0), merge(high[0], high[1], 0), merge(low[0], low[1], 1)]

    def components(self, away: list[list[Any]], which: int) -> list[Any]:
        """Three vectors, of the differences of positions (0) or of velocities (1)."""
        if LANES == QUAD:
            return self._turned([vectors[which] for vectors in away])
        halves = [self._turned([vectors[0] for vectors in away[at : at + QUAD]]) for at in (0, QUAD)]
        order = [which * QUAD + side + j for side in (0, LANES) for j in range(QUAD)]
        return [self.wide.shuffle(one, other, order) for one, other in zip(*halves, strict=True)]

    def positions(self, away: list[list[Any]]) -> list[Any]:
        """The differences of positions as quads."""
        if LANES == QUAD:
            return [vectors[0] for vectors in away]
        return [self.quad.shuffle(vectors[0], vectors[0], list(range(QUAD))) for vectors in away]

    def quads(self, f: list[Any]) -> list[Any]:
        """Three vectors as a quad for each spring."""
        found: list[Any] = [None] * LANES
        for odd in (0, 1):
            pair, rest = self.wide.unpack(f[0], f[1], odd), self.wide.unpack(f[2], self.wide.constant(0.0), odd)
            for half in (0, 1):
                merged = self.wide.merge(pair, rest, half)
                for first in range(0, LANES, QUAD):
                    own = list(range(first, first + QUAD))
                    found[first + 2 * half + odd] = self.quad.shuffle(merged, merged, own)
        return found

    def spread(self, factor: Any) -> list[Any]:
        """For each spring a quad of its number in a vector.

        Through memory: a load spreads a number by itself, where a shuffle would wait for the others.
        """
        kept = cgutils.alloca_once(self.builder, self.wide.type)
        self.builder.store(factor, kept, align=8)
        numbers = self.builder.bitcast(kept, ir.DoubleType().as_pointer())
        places = [self.builder.gep(numbers, [ir.Constant(_LONG, lane)]) for lane in range(LANES)]
        return [self.quad.splat(self.builder.load(place, align=8)) for place in places]

    def force(self, at: Any) -> Any:
        """A force quad."""
        return self.quad.load(self._force, at)

    def set_force(self, value: Any, at: Any) -> None:
        """Set a force quad."""
        self.quad.store(value, self._force, at)


def batches(emit: Callable[[Batch, Any, bool], None], signature: Any) -> Any:
    """What an intrinsic returns that takes rows, force, ends, table, first, last, damped: `emit` for each batch, told
    whether its springs are damped.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        batch = Batch(context, builder, signature, arguments)
        one = context.get_constant(types.intp, 1)
        with cgutils.for_range_slice(builder, arguments[4], arguments[5], one) as (number, _):
            emit(batch, number, signature.args[6] != types.none)
        return context.get_dummy_value()

    return signature, generate


def _spring(batch: Batch, number: Any, damped: bool) -> None:
    wide, quad = batch.wide, batch.quad
    first, second = batch.ends(number, 2)
    away = batch.away(first, second)
    force_at_zero, stiffness, *damping = batch.constants(number, 3 if damped else 2)
    s = batch.components(away, 0)
    inverse = wide.inverse_root(wide.dot(s, s, wide.constant(SHORTEST_SQUARE)))
    # The force on the second end over the length, k (l0/L - 1) - k_d (u.s)/L^2.
    factor = wide.fma(force_at_zero, inverse, wide.neg(stiffness))
    if damped:
        rate = wide.dot(batch.components(away, 1), s, wide.constant(0.0))
        factor = wide.fma(wide.neg(wide.mul(damping[0], rate)), wide.mul(inverse, inverse), factor)
    for a, b, along, pull in zip(first, second, batch.positions(away), batch.spread(factor), strict=True):
        batch.set_force(quad.fma(quad.neg(pull), along, batch.force(a)), a)
        batch.set_force(quad.fma(pull, along, batch.force(b)), b)


@intrinsic
def pull_springs(typing, rows, force, ends, table, first, last, damped):  # type: ignore[no-untyped-def]
    """Add the forces of the batches `first` to `last` - 1 of springs to the force quads.

    `rows`, `force`, `table`: flat float64. `ends`: flat int32, a batch's first ends, then its second ends, as
    particle * QUAD. `table`: for each batch LANES times k l0 [N], then k [N/m], then, unless `damped` is None, k_d
    [N s/m].
    """
    return batches(_spring, types.void(rows, force, ends, table, types.intp, types.intp, damped))


@intrinsic
def move_particles(  # type: ignore[no-untyped-def]
    typing, rows, force, motion, inverse, first, last, values, gravity, drag, start
):
    """Move the particles `first` to `last` - 1, whose forces are complete, and set the forces to zero.

    `rows`, `force`: flat float64. `motion`: flat float64, a quad of velocity and one of the acceleration of the step
    before for each particle; None where no force depends on velocity: the rows then hold the velocity itself.
    `inverse`: 1/m, zero for anchored particles. `values`: the step h, h/2, h/4, the drag rate, and a quad of gravity.
    `gravity`, `drag`: None where there is none. `start`: None for a step; else the forces are those at the start, and
    only the first prediction and the first half of the way follow.
    """
    signature = types.void(rows, force, motion, inverse, types.intp, types.intp, values, gravity, drag, start)

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        def data(i: int) -> Any:
            return context.make_array(signature.args[i])(context, builder, arguments[i]).data

        has = [kind != types.none for kind in signature.args]
        rows_, force_, inverse_, values_ = data(0), data(1), data(3), data(6)
        motion_ = data(2) if has[2] else None
        quad, long = Lanes(builder, QUAD), _LONG

        def scalar(pointer: Any, index: Any) -> Any:
            return builder.load(builder.gep(pointer, [index]))

        step, half, quarter, rate = (quad.splat(scalar(values_, ir.Constant(long, i))) for i in range(4))
        weight = quad.load(values_, ir.Constant(long, QUAD))
        zero = quad.constant(0.0)
        one = context.get_constant(types.intp, 1)
        with cgutils.for_range_slice(builder, arguments[4], arguments[5], one) as (i, _):
            row = builder.mul(i, ir.Constant(long, ROW))
            seen_at = builder.add(row, ir.Constant(long, QUAD))
            force_at = builder.mul(i, ir.Constant(long, QUAD))
            lightness = scalar(inverse_, i)
            a = quad.mul(quad.load(force_, force_at), quad.splat(lightness))
            quad.store(zero, force_, force_at)
            seen = quad.load(rows_, seen_at)
            if has[7] or has[8]:
                more = weight if has[7] else zero
                if has[8]:
                    more = quad.sub(more, quad.mul(rate, seen))
                free = builder.fcmp_ordered(">", lightness, ir.Constant(ir.DoubleType(), 0.0))
                a = quad.add(a, builder.select(free, more, zero))
            position = quad.load(rows_, row)
            if motion_ is None:
                v = quad.fma(step, a, seen)
                quad.store(v, rows_, seen_at)
                quad.store(quad.fma(step, v, position), rows_, row)
            else:
                before_at = seen_at
                if has[9]:
                    v = quad.load(motion_, row)
                    quad.store(quad.fma(half, a, v), rows_, seen_at)
                    quad.store(quad.fma(half, v, position), rows_, row)
                else:
                    v = quad.fma(step, a, quad.load(motion_, row))
                    both = quad.add(a, quad.load(motion_, before_at))
                    quad.store(v, motion_, row)
                    quad.store(quad.fma(quarter, both, v), rows_, seen_at)
                    quad.store(quad.fma(step, v, position), rows_, row)
                quad.store(a, motion_, before_at)
        return context.get_dummy_value()

    return signature, generate
