# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bending of a triangle mesh by the shape operator of each triangle, for a sheet that is flat at rest.

The curvature of a triangle follows from the slopes across its edges. The slope across an edge is the mean of those of
two quadratic functions, each through the six corners of a triangle and its neighbours.
docs/derivations/shape_operator.md derives it.
"""

from __future__ import annotations

import math

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.model.forces.couplings import Couplings
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.membrane import cross_rows, dot_rows, thread_coordinates

#: Gram determinant of the neighbours' quadratic functions, normalized to 1 for orthogonal ones, below which a neighbour
#: is left out: six corners on a conic determine no quadratic function.
_MIN_DETERMINANT = 0.02
#: Constants below this part of a modulus over the largest area are rounding, and left out.
_NEGLIGIBLE_FRACTION = 1e-12
#: Particles of a triangle, its three neighbours and theirs.
_STENCIL = 12
_PAIRS = ((0, 1), (0, 2), (1, 2))


@attrs.frozen(eq=False)
class ShapeOperator:
    """Curvatures of the triangles of a mesh as linear functions of particle positions.

    The curvature of a triangle is (κ11, κ22, 2 κ12) = Σ weights x over its particles, one for each coordinate of x.
    """

    #: Particles on which the curvature of each triangle depends, ascending; -1 after the last, shape (m, 12).
    particles: NDArray[np.int64]
    #: Weights [1/m²], shape (m, 3, 12).
    weights: Array
    #: Areas of the triangles [m²], shape (m,).
    areas: Array

    @classmethod
    def of(cls, triangles: NDArray[np.int64], positions: ArrayLike, *, warp: ArrayLike) -> ShapeOperator:
        """Return the shape operator of triangles (m, 3) from the rest positions of their particles (n, 3) [m].

        A curved surface counts as unfolded about each edge: its rest is flat.

        Args:
            triangles: particles of each triangle, counter-clockwise, shape (m, 3).
            positions: particles at rest [m], shape (n, 3).
            warp: direction of the warp, shape (3,); the first axis of curvatures.

        Raises:
            ValueError: if a triangle has no area, or every one is perpendicular to the warp.
        """
        faces = np.asarray(triangles, dtype=np.int64)
        x = np.asarray(positions, dtype=np.float64)
        opposite = _opposite_half_edges(faces)
        patch = _Patches(faces, x, opposite, warp)
        return cls(*_curvature_weights(faces, patch, opposite), patch.areas)

    def couplings(self, moduli: tuple[float, float, float], *, damping: float, masses: Array) -> Couplings:
        """Return the bending force of the energy ½ κ'D κ per area, with a diagonal D, as couplings between particles.

        Args:
            moduli: D11, D22 and D66 [N m]: moments per curvature along warp and weft, and half a twisting moment.
            damping: dimensionless k_d0. The damping time is k_d0 sqrt(2) / w. w^2 bounds the squared frequencies of a
                single triangle.
            masses: particle masses [kg], shape (n,).
        """
        valid = self.particles >= 0
        scaled = np.stack([modulus / self.areas for modulus in moduli], axis=1)
        areas2 = self.areas * self.areas
        first, second, pair_constants = [], [], []
        for i in range(_STENCIL):
            for j in range(i + 1, _STENCIL):
                rows = np.flatnonzero(valid[:, j])
                a, b, d = self.weights[rows, :, i], self.weights[rows, :, j], scaled[rows]
                product = d[:, 0] * a[:, 0] * b[:, 0] + d[:, 1] * a[:, 1] * b[:, 1] + d[:, 2] * a[:, 2] * b[:, 2]
                first.append(self.particles[rows, i])
                second.append(self.particles[rows, j])
                pair_constants.append(-product * areas2[rows])
        key = np.concatenate(first) * len(masses) + np.concatenate(second)
        keys, index = np.unique(key, return_inverse=True)
        constants = np.bincount(index.ravel(), np.concatenate(pair_constants), minlength=len(keys))
        has_force = np.abs(constants) > _NEGLIGIBLE_FRACTION * max(moduli) / self.areas.max()
        pairs = np.stack(np.divmod(keys[has_force], len(masses)), axis=1)
        return Couplings(
            pairs, constants[has_force], self._damping_time(moduli, damping, masses), name="shape_operator"
        )

    def _damping_time(self, moduli: tuple[float, float, float], damping: float, masses: Array) -> float:
        """Return the damping time k_d0 sqrt(2) / w [s]; w^2 is the largest trace of M^-1 K of a triangle."""
        if not damping or not max(moduli) > 0.0:
            return 0.0
        inverse = np.where(self.particles >= 0, 1.0 / masses[self.particles], 0.0)
        squares = np.zeros(len(self.areas))
        for modulus, weights in zip(moduli, np.moveaxis(self.weights, 1, 0), strict=True):
            for column in range(_STENCIL):
                squares += modulus * self.areas * (weights[:, column] * weights[:, column] * inverse[:, column])
        highest = float(squares.max())
        return damping * math.sqrt(2.0 / highest) if highest > 0.0 else 0.0


def _opposite_half_edges(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for each triangle's edges the neighbour's half-edge, 3 times triangle + edge; -1 at a border, (m, 3)."""
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(tail, head) * (faces.max(initial=0) + 1) + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    twins = np.flatnonzero(key[order][1:] == key[order][:-1])
    opposite = np.full(len(key), -1, dtype=np.int64)
    opposite[order[twins]], opposite[order[twins + 1]] = order[twins + 1], order[twins]
    return opposite.reshape(-1, 3)


class _Patches:
    """Triangles with their neighbours unfolded into their planes, and quadratic functions through their corners.

    Coordinates are u along the warp and v along the weft. A function has the quadratic part ½ (κ1 u² + κ2 v² + κ3 u v).
    """

    def __init__(self, faces: NDArray[np.int64], x: Array, opposite: NDArray[np.int64], warp: ArrayLike) -> None:
        #: Corners in the plane, (m, 3, 2), and the vectors of edges k from corner k on.
        self.corners = thread_coordinates(x, faces, warp)
        edges = np.roll(self.corners, -1, axis=1) - self.corners
        u, v = edges[..., 0], edges[..., 1]
        doubled = u[:, 0] * v[:, 1] - v[:, 0] * u[:, 1]
        self.areas = 0.5 * doubled
        self.lengths = np.sqrt(u * u + v * v)
        #: Unit vectors along edges, and outwards across them, (m, 3, 2).
        self.along = edges / self.lengths[..., None]
        self.outward = np.stack([self.along[..., 1], -self.along[..., 0]], axis=2)
        #: Gradients of the linear functions that are 1 at a corner and 0 at the others, (m, 3, 2).
        across = np.roll(edges, -1, axis=1)
        self.gradients = np.stack([-across[..., 1], across[..., 0]], axis=2) / doubled[:, None, None]
        has_neighbour = opposite >= 0
        flap = np.where(has_neighbour, faces.ravel()[_third_corner(opposite)], faces)
        #: Corners of the patch: the triangle's, then its neighbours', (m, 6).
        self.particles = np.concatenate([faces, flap], axis=1)
        #: Weights of a patch's corners in the curvature of its quadratic function [1/m²], (m, 3, 6).
        self.weights = self._curvatures(self._unfolded(faces, x, flap), has_neighbour)

    def _unfolded(self, faces: NDArray[np.int64], x: Array, flap: NDArray[np.int64]) -> Array:
        """Return the far corners of each triangle's three neighbours, unfolded into its plane [m], (m, 3, 2)."""
        places = np.empty_like(self.corners)
        for k in range(3):
            edge = x[faces[:, (k + 1) % 3]] - x[faces[:, k]]
            wing = x[flap[:, k]] - x[faces[:, k]]
            normal = cross_rows(edge, wing)
            foot, height = dot_rows(edge, wing), np.sqrt(dot_rows(normal, normal))
            length = self.lengths[:, k]
            for axis in (0, 1):
                along, outward = self.along[:, k, axis], self.outward[:, k, axis]
                places[:, k, axis] = self.corners[:, k, axis] + (foot * along + height * outward) / length
        return places

    def _curvatures(self, flaps: Array, has_neighbour: NDArray[np.bool_]) -> Array:
        """Return the weights [1/m²] of a patch's corners in the curvature of its quadratic function, (m, 3, 6).

        If a neighbour is missing, the function has the least square of curvatures.
        """
        shares = np.stack([self._barycentric_coordinates(flaps[:, k]) for k in range(3)], axis=1)
        corner_squares = _monomials(self.corners)
        excess = _monomials(flaps)
        for j in range(3):
            excess = excess - shares[:, :, j, None] * corner_squares[:, None, j]
        # The twist κ3 = 2 κ12 counts half: κ1² + κ2² + κ3²/2 does not depend on the axes.
        metric = excess * np.array([1.0, 1.0, 2.0])
        gram = np.empty((len(flaps), 3, 3))
        for i in range(3):
            for j in range(3):
                gram[:, i, j] = (
                    metric[:, i, 0] * excess[:, j, 0]
                    + metric[:, i, 1] * excess[:, j, 1]
                    + metric[:, i, 2] * excess[:, j, 2]
                )
        used = _independent_neighbours(gram, has_neighbour)
        inverse = _masked_inverse(gram, used)
        weights = np.zeros((len(flaps), 3, 6))
        for k in range(3):
            by_flap = metric[:, 0] * inverse[:, 0, k, None]
            for i in (1, 2):
                by_flap = by_flap + metric[:, i] * inverse[:, i, k, None]
            weights[:, :, 3 + k] = by_flap
            for j in range(3):
                weights[:, :, j] -= by_flap * shares[:, k, j, None]
        return weights

    def _barycentric_coordinates(self, places: Array) -> Array:
        """Return the barycentric coordinates of points (m, 2) in their triangles, shape (m, 3)."""
        u, v = (places - self.corners[:, 0]).T
        shares = self.gradients[..., 0] * u[:, None] + self.gradients[..., 1] * v[:, None]
        shares[:, 0] += 1.0
        return shares

    def slope_weights(self) -> Array:
        """Return the weights [1/m] of a patch's corners in the outward slopes at the edges' midpoints, (m, 3, 6)."""
        slopes = np.zeros((len(self.areas), 3, 6))
        squares = _monomials(self.corners)
        middles = 0.5 * (self.corners + np.roll(self.corners, -1, axis=1))
        for k in range(3):
            n = self.outward[:, k]
            linear = self.gradients[..., 0] * n[:, :1] + self.gradients[..., 1] * n[:, 1:]
            u, v = middles[:, k].T
            by_curvature = np.stack([u * n[:, 0], v * n[:, 1], 0.5 * (v * n[:, 0] + u * n[:, 1])], axis=1)
            for j in range(3):
                by_curvature = by_curvature - linear[:, j, None] * squares[:, j]
            slopes[:, k, :3] = linear
            for c in range(3):
                slopes[:, k] += by_curvature[:, c, None] * self.weights[:, c]
        return slopes


def _third_corner(half_edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index, 3 times triangle + corner, of the corner opposite a half-edge; any index for -1."""
    triangle, edge = np.divmod(np.maximum(half_edges, 0), 3)
    return 3 * triangle + (edge + 2) % 3


def _monomials(places: Array) -> Array:
    """Return u²/2, v²/2 and u v/2 of places (..., 2), shape (..., 3)."""
    u, v = places[..., 0], places[..., 1]
    return np.stack([0.5 * u * u, 0.5 * v * v, 0.5 * u * v], axis=-1)


def _independent_neighbours(gram: Array, has_neighbour: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask of neighbours that determine a curvature independently, (m, 3): all, the best pair, or one."""
    size = np.sqrt(np.where(has_neighbour, np.stack([gram[:, i, i] for i in range(3)], axis=1), 1.0))
    cosines = {(i, j): gram[:, i, j] / (size[:, i] * size[:, j]) for i, j in _PAIRS}
    a, b, c = (cosines[pair] for pair in _PAIRS)
    all_three = has_neighbour.all(axis=1) & (1.0 + 2.0 * a * b * c - a * a - b * b - c * c >= _MIN_DETERMINANT)
    used = np.zeros_like(has_neighbour)
    used[np.arange(len(used)), np.argmax(has_neighbour, axis=1)] = has_neighbour.any(axis=1)
    best = np.full(len(gram), _MIN_DETERMINANT)
    for (i, j), cosine in cosines.items():
        determinant = 1.0 - cosine * cosine
        is_best = has_neighbour[:, i] & has_neighbour[:, j] & (determinant > best)
        best = np.where(is_best, determinant, best)
        used[is_best] = [k in (i, j) for k in range(3)]
    used[all_three] = True
    return used


def _masked_inverse(gram: Array, used: NDArray[np.bool_]) -> Array:
    """Return the inverses of the masked rows and columns of symmetric matrices (m, 3, 3); other entries are 0."""
    mask = used[:, :, None] & used[:, None, :]
    g = np.where(mask, gram, np.where(np.eye(3, dtype=np.bool_), 1.0, 0.0))
    cofactors = np.empty_like(g)
    for i in range(3):
        for j in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            c, d = (j + 1) % 3, (j + 2) % 3
            cofactors[:, i, j] = g[:, a, c] * g[:, b, d] - g[:, a, d] * g[:, b, c]
    determinant = g[:, 0, 0] * cofactors[:, 0, 0] + g[:, 0, 1] * cofactors[:, 0, 1] + g[:, 0, 2] * cofactors[:, 0, 2]
    return np.where(mask, cofactors / determinant[:, None, None], 0.0)


def _curvature_weights(
    faces: NDArray[np.int64], patch: _Patches, opposite: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Array]:
    """Return the particles (m, 12) on which triangles' curvatures depend, and their weights [1/m²], (m, 3, 12)."""
    slopes = patch.slope_weights()
    count = len(faces)
    particles, weights = [faces], [np.zeros((count, 3, 3))]
    for k in range(3):
        (n1, n2), (t1, t2) = patch.outward[:, k].T, patch.along[:, k].T
        twist = np.stack([n1 * t1, n2 * t2, n1 * t2 + n2 * t1], axis=1)
        weights[0][:, :, (k + 1) % 3] += twist
        weights[0][:, :, k] -= twist
        across = np.stack([n1 * n1, n2 * n2, 2.0 * n1 * n2], axis=1) * patch.lengths[:, k, None]
        has_neighbour = opposite[:, k] >= 0
        triangle, edge = np.divmod(np.where(has_neighbour, opposite[:, k], 0), 3)
        mean = np.where(has_neighbour, 0.5, 1.0)
        particles += [patch.particles, np.where(has_neighbour[:, None], patch.particles[triangle], faces[:, :1])]
        within = slopes[:, k] * mean[:, None]
        beyond = slopes[triangle, edge] * np.where(has_neighbour, -0.5, 0.0)[:, None]
        weights += [across[:, :, None] * within[:, None], across[:, :, None] * beyond[:, None]]
    all_particles, all_weights = np.concatenate(particles, axis=1), np.concatenate(weights, axis=2)
    return _merge_equal(all_particles, all_weights / patch.areas[:, None, None])


def _merge_equal(particles: NDArray[np.int64], weights: Array) -> tuple[NDArray[np.int64], Array]:
    """Return particles (m, 12) and summed weights (m, 3, 12) without repetitions; particles ascend, then -1."""
    order = np.argsort(particles, axis=1, kind="stable")
    ascending = np.take_along_axis(particles, order, axis=1)
    is_new = np.diff(ascending, axis=1, prepend=-1) > 0
    column = np.zeros_like(ascending)
    for k in range(1, column.shape[1]):
        column[:, k] = column[:, k - 1] + is_new[:, k]
    row = np.broadcast_to(np.arange(len(particles))[:, None], column.shape)
    merged = np.full((len(particles), _STENCIL), -1, dtype=np.int64)
    merged[row, column] = ascending
    sums = np.zeros((len(particles), 3, _STENCIL))
    for c in range(3):
        np.add.at(sums[:, c], (row, column), np.take_along_axis(weights[:, c], order, axis=1))
    return merged, sums
