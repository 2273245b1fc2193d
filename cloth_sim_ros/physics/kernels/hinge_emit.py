# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Batches of hinges (S8 and S9) in explicit vectors; the formulas are those of `crossed` and `tetrahedron`.

Where the signed length is not defined the inverse of M is set to zero, and so are the normal, the gradient and the
force with it.
"""

from __future__ import annotations

from typing import Any

from numba.core import types
from numba.extending import intrinsic

from cloth_sim_ros.physics.kernels.mesh_emit import Batch, Lanes, batches
from cloth_sim_ros.physics.kernels.tetrahedron import ALTITUDE_SINE, CROSSED_SINE

_LEAST_SQUARE = 1e-36
"""Least M^2 [m^4]: below it the single precision that 1/M starts from has no number for it."""


def _cross(wide: Lanes, a: list[Any], b: list[Any], start: list[Any] | None = None) -> list[Any]:
    """Start + a x b."""
    products = []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        other = wide.mul(a[k], b[j]) if start is None else wide.fma(a[k], b[j], wide.neg(start[i]))
        products.append(wide.fma(a[j], b[k], wide.neg(other)))
    return products


def _dot(wide: Lanes, a: list[Any], b: list[Any]) -> Any:
    return wide.dot(a, b, wide.constant(0.0))


def _combined(wide: Lanes, p: Any, a: list[Any], q: Any, b: list[Any]) -> list[Any]:
    """P a + q b."""
    return [wide.fma(p, one, wide.mul(q, other)) for one, other in zip(a, b, strict=True)]


def _inverse(wide: Lanes, square: Any, limit: Any) -> Any:
    """1/M where it is defined, else zero."""
    defined = wide.builder.and_(wide.above(square, limit), wide.above(square, wide.constant(_LEAST_SQUARE)))
    return wide.where(defined, wide.inverse_root(square))


def _tension(wide: Lanes, h: Any, rest: Any, stiffness: Any, damping: list[Any], rate: Any) -> Any:
    """-k (h - h0) - k_d dh/dt."""
    force = wide.mul(stiffness, wide.sub(rest, h))
    return wide.fma(wide.neg(damping[0]), rate, force) if damping else force


def _crossed(batch: Batch, number: Any, damped: bool) -> None:
    wide, quad = batch.wide, batch.quad
    p0, p1, p2, p3 = batch.ends(number, 4)
    edge, wings, between = batch.away(p0, p1), batch.away(p2, p3), batch.away(p0, p2)
    rest, stiffness, *damping = batch.constants(number, 3 if damped else 2)
    a, b, r = (batch.components(away, 0) for away in (edge, wings, between))
    c = _cross(wide, a, b)
    square = _dot(wide, c, c)
    sizes = wide.mul(_dot(wide, a, a), _dot(wide, b, b))
    inverse = _inverse(wide, square, wide.mul(wide.constant(CROSSED_SINE * CROSSED_SINE), sizes))
    n = [wide.neg(wide.mul(component, inverse)) for component in c]
    # The feet of the common normal: x0 + s a and x2 + t b.
    whole = wide.neg(inverse)
    s = wide.mul(whole, _dot(wide, _cross(wide, r, b), n))
    t = wide.mul(whole, _dot(wide, _cross(wide, r, a), n))
    rate = None
    if damped:
        va, vb, vr = (batch.components(away, 1) for away in (edge, wings, between))
        relative = [wide.fma(t, q, wide.fma(wide.neg(s), p, o)) for p, q, o in zip(va, vb, vr, strict=True)]
        rate = _dot(wide, n, relative)
    tension = _tension(wide, _dot(wide, n, r), rest, stiffness, damping, rate)
    one = wide.constant(1.0)
    pulls = batch.quads([wide.mul(tension, component) for component in n])
    weights = (wide.sub(s, one), wide.neg(s), wide.sub(one, t), t)
    shares = [batch.spread(weight) for weight in weights]
    for lane, pull in enumerate(pulls):
        for end, share in zip((p0, p1, p2, p3), shares, strict=True):
            batch.set_force(quad.fma(share[lane], pull, batch.force(end[lane])), end[lane])


def _altitude(batch: Batch, number: Any, damped: bool) -> None:
    wide, quad = batch.wide, batch.quad
    p0, p1, p2, p3 = batch.ends(number, 4)
    away = [batch.away(p0, other) for other in (p1, p2, p3)]
    rest, stiffness, *damping = batch.constants(number, 3 if damped else 2)
    a, b, c = (batch.components(one, 0) for one in away)
    d, e = ([wide.sub(p, q) for p, q in zip(side, a, strict=True)] for side in (b, c))
    n0, n1, n2, n3 = _cross(wide, e, d), _cross(wide, b, c), _cross(wide, c, a), _cross(wide, a, b)
    square = wide.constant(0.0)
    for normal in (n0, n1, n2, n3):
        square = wide.dot(normal, normal, square)
    size = wide.dot(c, c, wide.dot(b, b, _dot(wide, a, a)))
    thin = wide.mul(wide.constant(ALTITUDE_SINE), size)
    inverse = _inverse(wide, square, wide.mul(thin, thin))
    # |p x q|^2 / 2 has the gradients q x n and n x p.
    over, under = _cross(wide, n0, e), _cross(wide, d, n0)
    both = [wide.neg(wide.add(p, q)) for p, q in zip(over, under, strict=True)]
    areas = (
        _cross(wide, b, n3, _cross(wide, n2, c, both)),
        _cross(wide, n3, a, _cross(wide, c, n1, over)),
        _cross(wide, a, n2, _cross(wide, n1, b, under)),
    )
    h = wide.mul(_dot(wide, a, n1), inverse)
    turn = wide.neg(wide.mul(h, wide.mul(inverse, inverse)))
    gradients = [_combined(wide, inverse, volume, turn, area) for volume, area in zip((n1, n2, n3), areas, strict=True)]
    rate = wide.constant(0.0)
    if damped:
        for gradient, one in zip(gradients, away, strict=True):
            rate = wide.dot(gradient, batch.components(one, 1), rate)
    tension = _tension(wide, h, rest, stiffness, damping, rate)
    pulls = [batch.quads([wide.mul(tension, component) for component in gradient]) for gradient in gradients]
    for lane, three in enumerate(zip(*pulls, strict=True)):
        first = batch.force(p0[lane])
        for pull in three:
            first = quad.sub(first, pull)
        batch.set_force(first, p0[lane])
        for end, pull in zip((p1, p2, p3), three, strict=True):
            batch.set_force(quad.add(batch.force(end[lane]), pull), end[lane])


@intrinsic
def pull_crossed(typing, rows, force, ends, table, first, last, damped):  # type: ignore[no-untyped-def]
    """Add the forces of the batches `first` to `last` - 1 of hinges of S8 to the force quads.

    As `mesh_emit.pull_springs`, with four ends each, and in the table h0 [m], k [N/m] and, unless `damped` is None,
    k_d [N s/m].
    """
    return batches(_crossed, types.void(rows, force, ends, table, types.intp, types.intp, damped))


@intrinsic
def pull_altitude(typing, rows, force, ends, table, first, last, damped):  # type: ignore[no-untyped-def]
    """As `pull_crossed`, of S9."""
    return batches(_altitude, types.void(rows, force, ends, table, types.intp, types.intp, damped))
