# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Linear system of an implicit stage: the band matrix M + d^2 K + d D."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine import band
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.band_matrix import BandMatrix
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.membrane_triangles import MembraneTriangles
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import ElementList
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.controller_state import StateMemory

#: Pairs do not widen the band if their stiffness is below this fraction of the largest one at both ends. Newton's
#: iteration then converges by about this factor per step.
_NEGLIGIBLE_FRACTION = 0.05
#: Mass of a particle that does not yield to any force [kg].
_IMMOVABLE_MASS = 1e30
NO_PARTICLES: NDArray[np.int64] = np.empty(0, dtype=np.int64)


class StageMatrix:
    """Band matrix M + d^2 K + d D of a model's implicit stages, without negative stiffness of compressed springs.

    Therefore it is positive definite. Springs, joints and membranes enter exactly. Hinges, panels and forces in numpy
    enter by particle blocks that bound them, which slows the iteration. Free particles are numbered by reverse
    Cuthill-McKee, or row by row on a grid, for a narrow band.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        count = model.particle_count
        springs, other_forces = _split_forces(model)
        #: Springs and joints as lists; all other forces.
        self._springs = compile(Model(model.masses, springs))
        # Anchored particles may lie inside obstacles, where forces are not finite.
        self._other_forces = compile(Model(model.masses, other_forces, anchors=model.anchors))
        parts = [part for force in springs for part in force.parts(count) or () if isinstance(part, ElementList)]
        self._pairs = [_coupled_pairs(part) for part in parts]
        is_free = model.inverse_masses > 0.0
        block_rows, width = _block_order(self._band_pairs(parts), is_free)
        self._matrix = BandMatrix(block_rows, width, self._pairs)

    @property
    def size(self) -> tuple[int, int]:
        """Number of block rows, and of 3x3 blocks per row of the upper half, diagonal included."""
        return self._matrix.count, self._matrix.width + 1

    def _band_pairs(self, parts: list[ElementList]) -> NDArray[np.int64]:
        """Return the pairs that the band must contain: those that are not negligible at one of their ends."""
        # Stiffness k [N/m] at any position: the order does not depend on the state.
        rigidities = [_rigidities(part) for part in parts]
        ends = np.concatenate([np.empty((0, 2), dtype=np.int64), *self._pairs])
        size = np.concatenate([np.empty(0), *rigidities])
        largest = np.zeros(self._model.particle_count)
        for end_index in (0, 1):
            np.maximum.at(largest, ends[:, end_index], size)
        is_coupled = size >= _NEGLIGIBLE_FRACTION * largest[ends].min(axis=1)
        # The matrix of a triangle is positive definite only as a whole.
        kinds = [np.full(len(pairs), part.is_membrane) for pairs, part in zip(self._pairs, parts, strict=True)]
        is_coupled |= np.concatenate([np.empty(0, dtype=np.bool_), *kinds])
        return ends[is_coupled]

    def update(
        self, t: float, x: Array, d: float, memory: StateMemory, prescribed: NDArray[np.int64] = NO_PARTICLES
    ) -> None:
        """Assemble and factorise M + d^2 K + d D with stiffness K and damping D at positions x, for `solve`.

        Args:
            t: time [s].
            x: positions [m], shape (3, n).
            d: coefficient of the stage [s].
            memory: memory of the state.
            prescribed: particles whose motion a gripper prescribes.

        Raises:
            UnstableError: if an entry is not finite.
        """
        stiffness, damping = np.zeros((2, 6, self._model.particle_count))
        self._other_forces.add_bounds(x, stiffness, damping, t, memory)
        masses = self._model.masses
        if prescribed.size:
            # Their corrections vanish, and the rows keep their order.
            masses = masses.copy()
            masses[prescribed] = _IMMOVABLE_MASS
        blocks = d * d * stiffness + d * damping
        if self._other_forces.carries_air:
            blocks += self._other_forces.mass_blocks(x)
        pair_blocks = [self._springs.pair_blocks(k, len(pairs), x, d * d, d) for k, pairs in enumerate(self._pairs)]
        self._matrix.update(pair_blocks, masses, blocks)

    def solve(self, right: Array) -> None:
        """Replace the right-hand side (3, n) by the solution, after `update`; zero for anchored particles."""
        self._matrix.solve(right)


class ParticleBlocks:
    """Block-diagonal bound of the stage matrix A, a 3x3 block a particle: x'Ax <= sum of x_i' B_i x_i.

    A correction by the blocks decreases the same objective, more slowly, for the price of a force evaluation.

    Args:
        plan: equations of motion.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        # Anchored particles may lie inside obstacles, where blocks are not finite.
        self._is_free = plan.model.inverse_masses > 0.0
        self._blocks = np.empty((6, plan.model.particle_count))

    def update(
        self, t: float, x: Array, d: float, memory: StateMemory, prescribed: NDArray[np.int64] = NO_PARTICLES
    ) -> None:
        """Calculate the particle blocks that bound M + d^2 K + d D, see `StageMatrix.update`."""
        stiffness, damping = np.zeros((2, 6, self._plan.model.particle_count))
        self._plan.add_bounds(x, stiffness, damping, t, memory)
        blocks = d * d * stiffness + d * damping
        blocks[:3] += self._plan.model.masses
        if self._plan.carries_air:
            blocks += self._plan.mass_blocks(x)
        is_free = self._is_free.copy()
        is_free[prescribed] = False
        self._blocks = np.where(is_free, blocks, np.array([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]]).T)

    def solve(self, right: Array) -> None:
        """Replace the right-hand side (3, n) by the solution with each particle's block, after `update`."""
        xx, yy, zz, xy, xz, yz = self._blocks
        x, y, z = right.copy()
        # Cofactors of the symmetric block.
        a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        e, f, g = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        determinant = xx * a + xy * b + xz * c
        right[0] = (a * x + b * y + c * z) / determinant
        right[1] = (b * x + e * y + f * z) / determinant
        right[2] = (c * x + f * y + g * z) / determinant


_MATRICES: WeakKeyDictionary[Model, StageMatrix] = WeakKeyDictionary()


def stage_matrix(model: Model) -> StageMatrix:
    """Return the `StageMatrix` of a model from a cache; the first call builds it."""
    if model not in _MATRICES:
        _MATRICES[model] = StageMatrix(model)
    return _MATRICES[model]


def iteration_cost(model: Model) -> float:
    """Return the estimated cost [ns] of an iteration of the implicit method; build the stage matrix if missing."""
    rows, width = stage_matrix(model).size
    # Symmetry halves the products of 3 x 3 blocks in the band.
    factorization_cost = CONSTANTS.factorization_time * 4.5 * rows * width * width
    return factorization_cost + CONSTANTS.python_force_time * model.particle_count


def _split_forces(model: Model) -> tuple[list[Force], list[Force]]:
    """Return two lists of a model's forces: springs (those of a grid as pairs), joints, membranes; and all others."""
    springs: list[Force] = []
    other_forces: list[Force] = []
    for force in model.forces:
        if isinstance(force, GridSprings):
            springs.append(force.pair_springs)
        else:
            (springs if isinstance(force, PairSprings | MembraneTriangles) else other_forces).append(force)
    return springs, other_forces


def _coupled_pairs(part: ElementList) -> NDArray[np.int64]:
    """Return the pairs of particles that the elements of a list couple, in the order of their blocks, shape (k, 2)."""
    particles = part.particles
    if part.is_membrane:
        particles = np.stack([particles[:, [0, 1]], particles[:, [0, 2]], particles[:, [1, 2]]], axis=1).reshape(-1, 2)
    return np.ascontiguousarray(particles)


def _rigidities(part: ElementList) -> Array:
    """Return the stiffness of each coupled pair [N/m], for triangles from the largest modulus, shape (k,)."""
    if not part.is_membrane:
        return part.coefficients[:, 1 if part.kind == "spring" else 0]
    assert part.shared_coefficients is not None
    p1, p2, q1, q2, area = part.coefficients[:, :5].T
    modulus = max(part.shared_coefficients[0], part.shared_coefficients[2])
    slopes = np.stack([p1 + p2, p1, p2]), np.stack([q1 + q2, q1, q2])
    steepness = np.sqrt(slopes[0] * slopes[0] + slopes[1] * slopes[1])
    pairs = steepness[0] * steepness[1], steepness[0] * steepness[2], steepness[1] * steepness[2]
    return np.asarray(modulus * area[:, None] * np.stack(pairs, axis=1)).ravel()


def _block_order(pairs: NDArray[np.int64], is_free: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    """Return the block row of each particle, -1 for anchored ones, and the largest row distance of a pair."""
    block_rows = np.where(is_free, np.cumsum(is_free) - 1, -1).astype(np.int64)
    ends = block_rows[pairs]
    ends = ends[(ends >= 0).all(axis=1)]
    if not len(ends):
        return block_rows, 0
    width = int(np.abs(ends[:, 0] - ends[:, 1]).max())
    count = int(is_free.sum())
    order = band.cuthill_mckee(count, ends)
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    ordered_width = int(np.abs(rank[ends[:, 0]] - rank[ends[:, 1]]).max())
    if ordered_width >= width:
        return block_rows, width
    return np.where(block_rows >= 0, rank[block_rows], -1), ordered_width
