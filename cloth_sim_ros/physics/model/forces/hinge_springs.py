# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Base class of S8 and S9: springs on one signed length of a hinge.

A hinge is the tetrahedron of two triangles with a common edge.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.binding import KINDS, check, checked_floats, checked_indices, float64_address, library
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import ElementList, Part


class HingeSprings(EngineForce):
    """Springs on the signed length h [m] of hinges: energy κ̂ (h - h0)²/2, damping force -k_d (∇h·v) ∇h.

    `CrossedSprings` (S8), `AltitudeSprings` (S9) and `CandidateSprings` define the length. Their forces have no
    resultant and no torque.

    Args:
        hinges: particles (edge0, edge1, wing0, wing1) as in `surface`, shape (m, 4).
        rest_length: signed rest lengths h0 [m], shape (m,) or one number; 0 is flat, positive if the wings rise to the
            side of the normal.
        stiffness: κ̂ [N/m], shape (m,) or one number, at least 0.
        damping: k_d [N s/m], shape (m,) or one number, at least 0.
        name: the force's name in a model.

    Raises:
        ValueError: for a shape that does not fit, a particle that a hinge names twice, or an entry that is negative or
            not finite.
    """

    #: The kind of length: a key of `engine.binding.KINDS`.
    kind: str

    def __init__(
        self, hinges: ArrayLike, rest_length: ArrayLike, stiffness: ArrayLike, damping: ArrayLike = 0.0, *, name: str
    ) -> None:
        self.name = name
        self.hinges: NDArray[np.int64] = checked_indices(f"hinges of '{name}'", hinges, 4, np.iinfo(np.int64).max)
        count = len(self.hinges)
        ordered = np.sort(self.hinges, axis=1)
        wrong = np.flatnonzero((ordered[:, :-1] == ordered[:, 1:]).any(axis=1))
        if wrong.size:
            raise ValueError(
                f"hinge {wrong[0]} of '{name}' is {self.hinges[wrong[0]].tolist()}; it needs four different particles"
            )
        self.rest_length = checked_floats(f"rest_length of '{name}'", rest_length, (count,))
        self.stiffness = checked_floats(f"stiffness of '{name}'", stiffness, (count,), lower=0.0)
        self.damping = checked_floats(f"damping of '{name}'", damping, (count,), lower=0.0)
        self.damped = bool(np.any(self.damping))

    def parts(self, particle_count: int) -> Sequence[Part]:
        hinges = checked_indices(f"hinges of '{self.name}'", self.hinges, 4, particle_count)
        if not len(hinges):
            return ()
        coefficients = np.stack([self.rest_length, self.stiffness, self.damping], axis=1)
        return (ElementList(kind=self.kind, particles=hinges, coefficients=coefficients),)

    def lengths(self, x: Array) -> Array:
        """Return the signed length h [m] of every hinge at positions x (3, n), NaN if undefined, shape (m,)."""
        return signed_lengths(self.hinges, x, kind=self.kind)


def signed_lengths(hinges: ArrayLike, x: Array, *, kind: str) -> Array:
    """Return the signed lengths h [m] of hinges at positions x (3, n), for a kind of length, (m,); NaN if undefined.

    Args:
        hinges: particles (edge0, edge1, wing0, wing1), shape (m, 4).
        x: positions [m], shape (3, n).
        kind: `crossed` (S8), `altitude` (S9), `edge_edge` or `point_face`.
    """
    return _lengths(hinges, x, kind)[0]


def gradient_squares(hinges: ArrayLike, x: Array, *, kind: str) -> Array:
    """Return |dh/dx|^2 of each hinge's signed length h at x (3, n), for each of its four particles, shape (m, 4)."""
    return _lengths(hinges, x, kind)[1]


def _lengths(hinges: ArrayLike, x: Array, kind: str) -> tuple[Array, Array]:
    positions = np.ascontiguousarray(x, dtype=np.float64)
    count = positions.shape[1]
    quads = checked_indices("hinges", hinges, 4, count)
    lengths, squares = np.empty(len(quads)), np.empty((len(quads), 4))
    address = float64_address("x", positions, (3, count))
    inputs = KINDS[kind][0], len(quads), quads.ctypes.data, address, count
    check(library().cloth_hinge_lengths(*inputs, lengths.ctypes.data, squares.ctypes.data))
    return lengths, squares
