# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounds of the stiffness and damping of one row of a regular sheet: what `kernels.pairs.add_pair_bounds` adds for a
spring, family by family as `grid_rows` takes the forces.
"""

from __future__ import annotations

from typing import Any

from numba.extending import intrinsic

from cloth_sim_ros.physics.kernels.grid_emit import BLOCK_BYTES, SHORTEST_SQUARE
from cloth_sim_ros.physics.kernels.grid_rows import (
    FAMILIES,
    FIRST_WEIGHT_SLOT,
    INVERSE_MASS_SLOT,
    VELOCITY,
    Row,
    generator,
    keep,
    row_signature,
)

BLOCK_PARTS = 6
"""Numbers of a symmetric 3 x 3 block: xx, yy, zz, xy, xz, yz."""

MOST_ACROSS = 9.0
"""Largest stiffness across a spring relative to that along it that counts: that of a tenth of the rest length."""

_PRODUCTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


class _Undamped(Row):
    """Gives both ends of a spring 2 (k dd' + across (I - dd'))."""

    parts = BLOCK_PARTS

    def add_spring(self, forces: dict[tuple[int, int], list[Any]], name: str, column: Any) -> None:
        vectors = self.vectors
        (x0, _), (x1, _) = (self.point(end, column, moving=False) for end in FAMILIES[name])
        d = [vectors.sub(b, a) for a, b in zip(x0, x1, strict=True)]
        inverse = vectors.inverse_root(vectors.dot(d, d, vectors.constant(SHORTEST_SQUARE)))
        unit = [vectors.mul(q, inverse) for q in d]
        products = [vectors.mul(unit[i], unit[j]) for i, j in _PRODUCTS]
        slot = FIRST_WEIGHT_SLOT + list(FAMILIES).index(name)
        weight = vectors.load(self.data["table"], self.index("table_row", slot, column))
        twice = vectors.mul(weight, vectors.constant(2.0))
        along = vectors.mul(twice, self.value(name, "l"))
        relative = vectors.fma(vectors.neg(vectors.mul(twice, self.value(name, "k"))), inverse, along)
        across = vectors.least(vectors.size(relative), vectors.mul(along, vectors.constant(MOST_ACROSS)))
        parts = self.block(products, vectors.sub(along, across), across)
        if self.parts > BLOCK_PARTS:
            parts += self.damping(products, vectors.mul(twice, self.value(name, "d")))
        for end in FAMILIES[name]:
            before = forces.get(end)
            forces[end] = parts if before is None else [vectors.add(p, q) for p, q in zip(before, parts, strict=True)]

    def block(self, products: list[Any], along: Any, across: Any) -> list[Any]:
        """along dd' + across I."""
        fma, mul = self.vectors.fma, self.vectors.mul
        return [fma(along, products[i], across) if i < 3 else mul(along, products[i]) for i in range(BLOCK_PARTS)]

    def damping(self, products: list[Any], rate: Any) -> list[Any]:
        """rate dd', rate I where the ends coincide and there is no direction."""
        vectors = self.vectors
        square = vectors.add(vectors.add(products[0], products[1]), products[2])
        return self.block(products, rate, vectors.mul(rate, vectors.sub(vectors.constant(1.0), square)))


class _Damped(_Undamped):
    """The same, and 2 k_d dd'."""

    parts = 2 * BLOCK_PARTS


#: cos(2 acos(t) / 3) by powers of t, the highest first, twice: see `stability.block_rates`.
TWICE_COSINE = (
    *(9.1371974490662e-05, -0.00074459295848305, 0.0028628194514527, -0.0070378744145726, 0.012798556604318),
    *(-0.01914712152288, 0.025832998977777, -0.033906752945952, 0.045694566199183, -0.065838662822131),
    *(0.10691636217626, -0.22222220890035, 1.1547005381807, 1.000000000001),
)


def _largest_eigenvalue(row: Row, block: list[Any]) -> Any:
    """As `stability.block_rates`, by the block relative to its mean eigenvalue: roots need not be exact then, and a
    NaN stays one.
    """
    vectors = row.vectors
    constant, add, sub, mul, fma = vectors.constant, vectors.add, vectors.sub, vectors.mul, vectors.fma
    mean = mul(add(add(block[0], block[1]), block[2]), constant(1.0 / 3.0))
    scale = vectors.builder.fdiv(constant(1.0), add(mean, constant(1e-300)))
    a, b, c = (mul(sub(number, mean), scale) for number in block[:3])
    d, e, f = (mul(number, scale) for number in block[3:])
    aside = vectors.dot([d, e, f], [d, e, f], constant(0.0))
    square = mul(fma(constant(2.0), aside, vectors.dot([a, b, c], [a, b, c], constant(0.0))), constant(1.0 / 6.0))
    inverse = vectors.inverse_root(add(square, constant(1e-30)))
    p = mul(square, inverse)
    a, b, c, d, e, f = (mul(number, inverse) for number in (a, b, c, d, e, f))
    first = mul(a, sub(mul(b, c), mul(f, f)))
    second, third = mul(d, sub(mul(d, c), mul(f, e))), mul(e, sub(mul(d, f), mul(b, e)))
    half = mul(constant(0.5), add(sub(first, second), third))
    half = vectors.least(constant(1.0), vectors.neg(vectors.least(constant(1.0), vectors.neg(half))))
    part = fma(constant(0.5), half, constant(0.5))
    t = mul(part, vectors.inverse_root(add(part, constant(1e-30))))
    cosine = constant(TWICE_COSINE[0])
    for number in TWICE_COSINE[1:]:
        cosine = fma(cosine, t, constant(number))
    return fma(mul(mean, p), cosine, mean)


def _watch(row: Row, force: list[Any], column: Any) -> None:
    """Keep, behind the ring's three rows, the largest rate and the sum of all, which a NaN shows in; of the stiffness,
    then of the damping.
    """
    vectors, builder = row.vectors, row.builder
    inverse = vectors.load(row.data["table"], row.index("table_row", INVERSE_MASS_SLOT, column))
    behind = builder.mul(row.values["pitch"], row.integer(3 * row.parts))
    for part in range(row.parts // BLOCK_PARTS):
        rate = vectors.mul(_largest_eigenvalue(row, force[part * BLOCK_PARTS : (part + 1) * BLOCK_PARTS]), inverse)
        largest, total = (builder.add(behind, row.integer((2 * part + which) * WATCHED // 4)) for which in (0, 1))
        before = vectors.load(row.data["ring"], largest)
        above = builder.fcmp_ordered(">", rate, before)
        vectors.store(builder.select(above, rate, before), row.data["ring"], largest)
        vectors.store(vectors.add(vectors.load(row.data["ring"], total), rate), row.data["ring"], total)


WATCHED = 4 * BLOCK_BYTES // 8
"""Numbers behind the ring that `row_rates` counts in: four vectors."""


# fmt: off
@intrinsic
def row_rates(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """As `row_bounds`, but of the row's complete blocks keep the largest eigenvalue over the mass alone: `_watch`."""
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(VELOCITY, 0, _watch, _Damped)


@intrinsic
def row_squares(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """As `row_rates`, of `row_stiffness`."""
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(VELOCITY, 0, _watch, _Undamped)


@intrinsic
def row_stiffness(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """Write a row's complete blocks [N/m] to ring row `ring0`, as `grid_rows.row_forces` does its forces; BLOCK_PARTS
    numbers a particle.
    """
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(VELOCITY, 0, keep, _Undamped)


@intrinsic
def row_bounds(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """As `row_stiffness`, followed by BLOCK_PARTS numbers of damping [N s/m]."""
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(VELOCITY, 0, keep, _Damped)
# fmt: on
