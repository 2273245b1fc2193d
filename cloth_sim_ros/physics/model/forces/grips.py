# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grips: zero-length springs (S4) between grippers and grasped particles, or prescribed motions of these."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.model.controls import Grasps, GripControls
from cloth_sim_ros.physics.model.forces.force import Array, EngineForce
from cloth_sim_ros.physics.model.parts import Part
from cloth_sim_ros.physics.old_names import with_old_names


@with_old_names(go_back="restore", hold="set_grips", move="set_paths", noted="save", owners="gripper_indices")
class Grips(EngineForce):
    """Grips: zero-length springs from grasped particles to points on grippers, or prescribed motions of particles.

    ``F = -k s - k_d ds/dt`` on the particle, with s its separation from its point on the gripper. A grip may instead
    prescribe the motion of its particle, which then follows its point exactly (docs/derivations/prescribed_grip.md).

    A gripper's path is a row of PATH_NUMBERS numbers. The first is the start time t0; s = t - t0 below. Then follow p0
    to p3 of the position p0 + p1 s + p2 s^2 + p3 s^3 [m]. The last are the orientation q0 (x, y, z, w) at s = 0 and r1
    to r3. The orientation is exp(r1 s + r2 s^2 + r3 s^3) q0, with the rotation vector in rad.

    Args:
        gripper_count: number of grippers.
    """

    name = "grips"
    damped = True
    damps_waves = False

    paths = property(attrgetter("controls.paths"))
    starts = property(attrgetter("controls.grasps.starts"))
    particles = property(attrgetter("controls.grasps.particles"))
    offsets = property(attrgetter("controls.grasps.offsets"))
    stiffness = property(attrgetter("controls.grasps.stiffness"))
    damping = property(attrgetter("controls.grasps.damping"))

    def __init__(self, gripper_count: int) -> None:
        if not isinstance(gripper_count, int | np.integer) or gripper_count < 0:
            raise ValueError(f"gripper_count is {gripper_count!r}; it must be a whole number of at least 0")
        self.gripper_count = int(gripper_count)
        paths = np.zeros((gripper_count, PATH_NUMBERS))
        paths[:, 16] = 1.0
        starts, particles = np.zeros(gripper_count + 1, dtype=np.int64), np.empty(0, dtype=np.int64)
        self.set_grips(paths, starts, particles, np.empty((0, 3)), np.empty(0), np.empty(0))

    def set_grips(
        self,
        paths: Array,
        starts: NDArray[np.int64],
        particles: NDArray[np.int64],
        offsets: Array,
        stiffness: Array,
        damping: Array,
        prescribed: NDArray[np.bool_] | None = None,
    ) -> None:
        """Set copies of paths, grasped particles and springs: gripper g grasps ``particles[starts[g]:starts[g + 1]]``.

        Args:
            paths: paths of the grippers, shape (gripper_count, PATH_NUMBERS).
            starts: first grip of each gripper, shape (gripper_count + 1,), int64.
            particles: grasped particles, shape (m,), int64.
            offsets: points in their gripper's frame [m], shape (m, 3).
            stiffness: k [N/m], shape (m,).
            damping: k_d [N s/m], shape (m,).
            prescribed: true for each particle that follows its point exactly, shape (m,); None for none. Such a grip
                has no spring.
        """
        # Copies: later writes into the caller's arrays must not change them.
        columns = np.array(offsets), np.array(stiffness), np.array(damping)
        followers = None if prescribed is None else np.array(prescribed, dtype=np.bool_)
        if followers is not None:
            columns = columns[0], np.where(followers, 0.0, columns[1]), np.where(followers, 0.0, columns[2])
        grasps = Grasps(np.array(starts), np.array(particles), *columns, (), followers)
        #: Paths of the grippers and grasped particles.
        self.controls = GripControls(np.array(paths, dtype=np.float64), grasps)

    def set_paths(self, paths: Array) -> None:
        """Set the grippers' paths from the next frame on, shape (gripper_count, PATH_NUMBERS); the grips stay."""
        self.controls = self.controls._replace(paths=np.array(paths, dtype=np.float64))

    def save(self) -> GripControls:
        """Return the present grips and paths for `restore`."""
        return self.controls

    def restore(self, saved: GripControls) -> None:
        """Restore grips and paths from `save`, also from the force of another model with the same masses."""
        self.controls = saved

    def parts(self, particle_count: int) -> Sequence[Part]:
        # Grips change from frame to frame: the plan uploads them in each frame.
        return ()

    def gripper_indices(self) -> NDArray[np.int64]:
        """Return the gripper index of each grip, shape (m,); check `starts`.

        Raises:
            ValueError: for starts that do not ascend from 0.
        """
        return self.controls.grasps.gripper_indices(self.gripper_count)

    def steady(self) -> bool:
        """Return true if no gripper that grasps a particle moves or turns in this frame."""
        grasps = self.controls.grasps
        if not grasps.particles.size:
            return True
        paths = self.controls.paths[np.diff(grasps.starts) > 0]
        return not (paths[:, 4:13].any() or paths[:, 17:26].any())
