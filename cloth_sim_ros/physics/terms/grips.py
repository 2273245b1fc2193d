# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grips: particles held by grippers with zero-length springs (S4)."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.gripper_path import rotation_matrix
from cloth_sim_ros.physics.integrators.base import Observer
from cloth_sim_ros.physics.kernels import grips as kernels
from cloth_sim_ros.physics.terms.base import Array, Term


class Grips(Term):
    """Zero-length springs between held particles and points fixed to moving grippers.

    ``F = -k s - k_d ds/dt`` on the particle, with s its separation from its point on the gripper.

    Args:
        gripper_count: number of grippers.
    """

    name = "grips"
    damped = True

    def __init__(self, gripper_count: int) -> None:
        self.gripper_count = gripper_count
        self.paths = np.zeros((gripper_count, kernels.PATH_COLUMNS))
        self.paths[:, 16] = 1.0
        self.wrenches = np.zeros((gripper_count, 7))
        self.hold(
            np.zeros(gripper_count + 1, dtype=np.int64),
            np.empty(0, dtype=np.int64),
            np.empty((0, 3)),
            np.empty(0),
            np.empty(0),
        )

    def hold(self, starts: np.ndarray, particles: np.ndarray, offsets: Array, stiffness: Array, damping: Array) -> None:
        """Set what is held: gripper g holds ``particles[starts[g]:starts[g + 1]]``.

        Args:
            starts: shape (gripper_count + 1,), int64.
            particles: held particles, shape (m,), int64.
            offsets: points in their gripper's frame [m], shape (m, 3).
            stiffness: k [N/m], shape (m,).
            damping: k_d [N s/m], shape (m,).
        """
        self.starts, self.particles, self.offsets = starts, particles, offsets
        self.stiffness, self.damping = stiffness, damping
        self.wrenches.fill(0.0)

    def owners(self) -> np.ndarray:
        """Gripper of each grip, shape (m,)."""
        return np.repeat(np.arange(self.gripper_count), np.diff(self.starts))

    def arms(self) -> Array:
        """From each grip's gripper to its held point [m], as the grippers stand at the start of their paths, shape (m,
        3).
        """
        turns = np.stack([rotation_matrix(path[13:17]) for path in self.paths])
        return np.einsum("nij,nj->ni", turns[self.owners()], self.offsets)

    def add_force(self, t: float, x: Array, v: Array, f: Array) -> None:
        if self.particles.size:
            kernels.grip_forces(
                self.paths,
                self.starts,
                self.particles,
                self.offsets,
                self.stiffness,
                self.damping,
                t,
                x,
                v,
                f,
                self.wrenches,
            )

    def steady(self) -> bool:
        """Whether no gripper that holds something moves or turns over its path."""
        if not self.particles.size:
            return True
        paths = self.paths[np.diff(self.starts) > 0]
        return not (paths[:, 4:13].any() or paths[:, 17:26].any())

    def energy(self, t: float, x: Array) -> float:
        return self._energy(t, x, x)[0]

    def dissipation(self, t: float, x: Array, v: Array) -> float:
        return self._energy(t, x, v)[1]

    def _energy(self, t: float, x: Array, v: Array) -> tuple[float, float]:
        energy, lost = kernels.grip_energy(
            self.paths, self.starts, self.particles, self.offsets, self.stiffness, self.damping, t, x, v
        )
        return float(energy), float(lost)

    # A grip pulls on one particle only: its point on the gripper moves as commanded. So its blocks are k I, not 2 k I.
    # Several grippers may hold one particle: np.add.at adds up, plain indexing would not.
    def add_stiffness(self, x: Array, blocks: Array) -> None:
        for i in range(3):
            np.add.at(blocks[i], self.particles, self.stiffness)

    def add_damping(self, x: Array, blocks: Array) -> None:
        for i in range(3):
            np.add.at(blocks[i], self.particles, self.damping)

    def multiples(self) -> tuple[np.ndarray, Array, Array]:
        return self.particles, self.stiffness, self.damping

    def add_jacobian_product(self, t: float, x: Array, v: Array, dx: Array, dv: Array, out: Array) -> None:
        p = self.particles
        for i in range(3):
            np.subtract.at(out[i], p, self.stiffness * dx[i, p] + self.damping * dv[i, p])


class WrenchObserver(Observer):
    """Mean force and torque of the cloth on each gripper over an advance, and the work that the grippers did.

    Args:
        grips: the term that is observed.
    """

    def __init__(self, grips: Grips) -> None:
        self._grips = grips
        self._sum = np.zeros((grips.gripper_count, 7))
        self._duration = 0.0
        self._nothing: Array | None = None

    def restart(self) -> None:
        self._sum.fill(0.0)
        self._duration = 0.0

    def observe(self, t: float, x: Array, v: Array, weight: float) -> None:
        self._duration += weight
        if self._grips.particles.size:
            if self._nothing is None:
                self._nothing = np.zeros_like(x)
            self._grips.add_force(t, x, v, self._nothing)
            self._sum += weight * self._grips.wrenches

    def add_run(self, booked: Array | None, duration: float, weight: float) -> None:
        """Take note of a whole run of a compiled loop, during which no gripper turned.

        Args:
            booked: time integral of the force on each grip's point [N s] and the work done on the cloth by it [J],
                shape (m, 4); None where nothing is held.
            duration: length of the run [s], times the weight.
            weight: factor on what was booked.
        """
        if booked is not None:
            impulses, work = booked[:, :3], booked[:, 3:]
            booked = np.concatenate([impulses, np.cross(self._grips.arms(), impulses), work], axis=1)
        self.add_booked(booked, duration, weight)

    def add_booked(self, booked: Array | None, duration: float, weight: float) -> None:
        """Take note of a whole run of a compiled loop.

        Args:
            booked: time integrals of the force [N s] and of the torque [N m s] about its pose that each grip's point
                exerts on its gripper, and the work done on the cloth by it [J], shape (m, 7); None where nothing is
                held.
            duration: length of the run [s], times the weight.
            weight: factor on what was booked.
        """
        self._duration += duration
        if booked is not None:
            np.add.at(self._sum, self._grips.owners(), weight * booked)

    @property
    def mean_wrenches(self) -> Array:
        """Force [N] and torque [N m] on each gripper about its pose, mean over time, shape (gripper_count, 6)."""
        return self._sum[:, :6] / self._duration if self._duration else np.zeros((len(self._sum), 6))

    @property
    def work(self) -> float:
        """Work that the grippers did on the cloth [J], what their springs store and lose included."""
        return float(self._sum[:, 6].sum())
