# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A batch of listed springs, and one leapfrog step of a few particles, in explicit vectors.

Each particle is a row of two quads of float64, `x y z 0` and `u v w 0` (the velocity that forces see), and has a
force quad. A batch is LANES springs: the differences of their ends' quads are turned into vectors of one component
each, the law is evaluated once for all, and the forces are given back to the quads, subtracted at the first end and
added at the second, one spring after the other: the order of the sums does not depend on the machine's vectors.
"""

from __future__ import annotations

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


class _Lanes(Vectors):
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


class _Batch:
    """Emits one batch: see the module. `first`, `second`: for each lane the index of its ends' rows in `rows`."""

    def __init__(self, builder: Any, rows: Any, first: list[Any], second: list[Any]) -> None:
        self.builder = builder
        self.wide, self.quad = _Lanes(builder, LANES), _Lanes(builder, QUAD)
        #: For each lane the second end's quads minus the first's, as many in a vector as fit.
        self.away = [
            [self._minus(rows, b, a, place) for place in range(0, ROW, LANES)]
            for a, b in zip(first, second, strict=True)
        ]

    def _minus(self, rows: Any, b: Any, a: Any, place: int) -> Any:
        offset = ir.Constant(ir.IntType(64), place)
        far, near = (self.wide.load(rows, self.builder.add(index, offset)) for index in (b, a))
        return self.wide.sub(far, near)

    def _turned(self, four: list[Any]) -> list[Any]:
        """Four vectors of quads as three vectors: in each quad's place one component of the four."""
        low, high = (
            [self.wide.unpack(four[0], four[1], odd), self.wide.unpack(four[2], four[3], odd)] for odd in (0, 1)
        )
        merge = self.wide.merge
        return [merge(low[0], low[1], 0), merge(high[0], high[1], 0), merge(low[0], low[1], 1)]

    def components(self, which: int) -> list[Any]:
        """Three components of the differences, a spring a lane: of positions (0) or of velocities (1)."""
        if LANES == QUAD:
            return self._turned([vectors[which] for vectors in self.away])
        halves = [self._turned([vectors[0] for vectors in self.away[at : at + QUAD]]) for at in (0, QUAD)]
        order = [which * QUAD + side + j for side in (0, LANES) for j in range(QUAD)]
        return [self.wide.shuffle(one, other, order) for one, other in zip(*halves, strict=True)]

    def scatter(self, factor: Any, force: Any, first: list[Any], second: list[Any]) -> None:
        """Subtract each lane's factor times its difference of positions from its first end's force quad, add it to
        its second end's.
        """
        # Through memory: one load gives a quad of equal factors, where a shuffle would wait for the others.
        factors = cgutils.alloca_once(self.builder, self.wide.type)
        self.builder.store(factor, factors, align=8)
        scalars = self.builder.bitcast(factors, ir.DoubleType().as_pointer())
        for lane, (a, b) in enumerate(zip(first, second, strict=True)):
            away = self.away[lane][0]
            away = away if LANES == QUAD else self.quad.shuffle(away, away, list(range(QUAD)))
            index = ir.Constant(ir.IntType(64), lane)
            pull = self.quad.splat(self.builder.load(self.builder.gep(scalars, [index]), align=8))
            self.quad.store(self.quad.fma(self.quad.neg(pull), away, self.quad.load(force, a)), force, a)
            self.quad.store(self.quad.fma(pull, away, self.quad.load(force, b)), force, b)


@intrinsic
def pull_springs(typing, rows, force, ends, table, first, last, damped):  # type: ignore[no-untyped-def]
    """Add the forces of the batches `first` to `last` - 1 of springs to the force quads.

    `rows`, `force`, `table`: flat float64. `ends`: flat int32, a batch's first ends, then its second ends, as
    particle * QUAD. `table`: for each batch LANES times k l0 [N], then k [N/m], then, unless `damped` is None, k_d
    [N s/m].
    """
    signature = types.void(rows, force, ends, table, types.intp, types.intp, damped)

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        rows_, force_, ends_, table_ = (
            context.make_array(signature.args[i])(context, builder, arguments[i]).data for i in range(4)
        )
        counted = signature.args[6] != types.none
        wide, long = _Lanes(builder, LANES), ir.IntType(64)

        def times(index: Any, factor: int) -> Any:
            return builder.mul(index, ir.Constant(long, factor))

        one = context.get_constant(types.intp, 1)
        with cgutils.for_range_slice(builder, arguments[4], arguments[5], one) as (number, _):
            start = times(number, 2 * LANES)
            at = [
                builder.sext(builder.load(builder.gep(ends_, [builder.add(start, ir.Constant(long, j))])), long)
                for j in range(2 * LANES)
            ]
            row = [times(index, ROW // QUAD) for index in at]
            batch = _Batch(builder, rows_, row[:LANES], row[LANES:])
            entry = times(number, (3 if counted else 2) * LANES)
            force_at_zero, stiffness = (
                wide.load(table_, builder.add(entry, ir.Constant(long, slot * LANES))) for slot in (0, 1)
            )
            s = batch.components(0)
            inverse = wide.inverse_root(wide.dot(s, s, wide.constant(SHORTEST_SQUARE)))
            # The force on the second end over the length, k (l0/L - 1) - k_d (u.s)/L^2.
            factor = wide.fma(force_at_zero, inverse, wide.neg(stiffness))
            if counted:
                u = batch.components(1)
                damping = wide.load(table_, builder.add(entry, ir.Constant(long, 2 * LANES)))
                rate = wide.neg(wide.mul(damping, wide.dot(u, s, wide.constant(0.0))))
                factor = wide.fma(rate, wide.mul(inverse, inverse), factor)
            batch.scatter(factor, force_, at[:LANES], at[LANES:])
        return context.get_dummy_value()

    return signature, generate


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
        quad, long = _Lanes(builder, QUAD), ir.IntType(64)

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
