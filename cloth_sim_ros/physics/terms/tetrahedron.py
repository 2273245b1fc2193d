# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What S8 and S9 share: springs on one signed length of the tetrahedron of two triangles with a common edge."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.kernels import altitude as kernels
from cloth_sim_ros.physics.terms.base import Array, Term


class TetrahedronSprings(Term):
    """Springs on the signed length h [m] of hinges: energy κ̂ (h - h0)²/2, damping force -k_d (∇h·v) ∇h.

    `CrossedSprings` (S8) and `AltitudeSprings` (S9) say which length. Neither has forces that push or turn the whole.

    Args:
        hinges: particles (edge0, edge1, wing0, wing1) as in `surface`, shape (m, 4).
        rest_length: signed rest lengths h0 [m], shape (m,) or one number; 0 is flat, positive where the wings rise to
            the side of the normal.
        stiffness: κ̂ [N/m], shape (m,) or one number, at least 0.
        damping: k_d [N s/m], shape (m,) or one number, at least 0.
        name: the term's name in a model.
        weak: whether it may be evaluated less often than every step.

    Raises:
        ValueError: for a shape that does not fit, a particle that a hinge names twice, or a value that is not finite
            or negative.
    """

    _crossed: bool

    def __init__(
        self,
        hinges: ArrayLike,
        rest_length: ArrayLike,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        *,
        name: str,
        weak: bool = False,
    ) -> None:
        self.name = name
        self.weak = weak
        self.hinges = np.ascontiguousarray(hinges, dtype=np.int64).reshape(-1, 4)
        count = len(self.hinges)
        ordered = np.sort(self.hinges, axis=1)
        wrong = np.flatnonzero((ordered[:, :-1] == ordered[:, 1:]).any(axis=1) | (ordered[:, :1] < 0).any(axis=1))
        if wrong.size:
            raise ValueError(
                f"hinge {wrong[0]} of '{name}' is {self.hinges[wrong[0]].tolist()}; "
                "it needs four different particles, counted from 0"
            )
        self.rest_length = self._per_hinge("rest_length", rest_length, count, signed=True)
        self.stiffness = self._per_hinge("stiffness", stiffness, count)
        self.damping = self._per_hinge("damping", damping, count)
        self.damped = bool(np.any(self.damping))

    def _per_hinge(self, what: str, value: ArrayLike, count: int, *, signed: bool = False) -> Array:
        array = np.asarray(value, dtype=np.float64)
        if array.ndim and array.shape != (count,):
            raise ValueError(
                f"{what} of '{self.name}' has shape {array.shape} for {count} hinges; give one number or one a hinge"
            )
        array = np.array(np.broadcast_to(array, (count,)))
        wrong = np.flatnonzero(~(np.isfinite(array) & (signed | (array >= 0.0))))
        if wrong.size:
            limit = "finite" if signed else "finite and at least 0"
            raise ValueError(f"{what} of hinge {wrong[0]} of '{self.name}' is {array[wrong[0]]}; it must be {limit}")
        return array

    def lengths(self, x: Array) -> Array:
        """Return the signed length h [m] of every hinge at positions x (3, n), NaN where undefined, shape (m,)."""
        return signed_lengths(self.hinges, x, crossed=self._crossed)

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        kernels.add_tetrahedron_forces(
            self.hinges, self.rest_length, self.stiffness, self.damping, self._crossed, x, v, f
        )

    def energy(self, t: float, x: Array) -> float:
        return float(kernels.tetrahedron_energy(self.hinges, self.rest_length, self.stiffness, self._crossed, x))

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        return float(kernels.tetrahedron_dissipation(self.hinges, self.damping, self._crossed, x, v))

    def add_stiffness(self, x: Array, blocks: Array) -> None:
        kernels.add_gradient_blocks(self.hinges, self.stiffness, self._crossed, x, blocks)
        kernels.add_curvature_blocks(self.hinges, self.rest_length, self.stiffness, self._crossed, x, blocks)

    def add_damping(self, x: Array, blocks: Array) -> None:
        kernels.add_gradient_blocks(self.hinges, self.damping, self._crossed, x, blocks)

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:
        kernels.add_tetrahedron_jacobian_product(
            self.hinges, self.rest_length, self.stiffness, self.damping, self._crossed, x, v, dx, dv, out
        )


def signed_lengths(hinges: ArrayLike, x: Array, *, crossed: bool) -> Array:
    """Return the signed lengths [m] of hinges (m, 4) at x (3, n), S8's if `crossed`, else S9's; NaN where undefined."""
    quads = np.ascontiguousarray(hinges, dtype=np.int64).reshape(-1, 4)
    lengths = np.empty(len(quads))
    kernels.tetrahedron_lengths(quads, crossed, np.ascontiguousarray(x, dtype=np.float64), lengths)
    return lengths
