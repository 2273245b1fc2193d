# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bounds of the stiffness and damping of one row of a regular sheet: what `kernels.pairs.add_pair_bounds` adds for a
spring, family by family as `grid_rows` takes the forces.
"""

from __future__ import annotations

from typing import Any

from numba.extending import intrinsic

from cloth_sim_ros.physics.kernels.grid_emit import SHORTEST_SQUARE
from cloth_sim_ros.physics.kernels.grid_rows import (
    FAMILIES,
    FIRST_WEIGHT_SLOT,
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


# fmt: off
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
