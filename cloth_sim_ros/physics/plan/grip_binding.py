# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine binding of grips: uploads grasped particles and paths, returns wrenches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine import binding
from cloth_sim_ros.engine.binding import address, check, float64_address, library, writable_address
from cloth_sim_ros.physics.model.controls import GripControls
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.parts import min_damping_time
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable


class GripBinding(Uncopyable):
    """Engine binding of a plan's grips: uploads grasped particles and paths, evaluates wrenches.

    Args:
        engine_plan: handle of the engine's plan.
        grips: the force.
        particle_count: number of particles of the model.
    """

    def __init__(self, engine_plan: PlanHandle, grips: Grips, particle_count: int) -> None:
        self._engine_plan, self.force = engine_plan, grips
        self._library, self._handle = library(), engine_plan.pointer
        self._shape = (3, particle_count)
        #: Controls that the engine has; None if an upload failed.
        self._uploaded: GripControls | None = None
        #: Number of grippers.
        self.count = grips.gripper_count
        self._paths_shape = (self.count, binding.PATH_NUMBERS)

    def upload(self) -> None:
        """Upload grasped particles and paths of grippers to the engine if they changed; refuse invalid ones."""
        controls, uploaded = self.force.controls, self._uploaded
        if controls is uploaded:
            return
        self._uploaded = None
        if uploaded is None or controls.grasps is not uploaded.grasps:
            arrays = controls.grasps.validated(self.count, self._shape[1])
            # A snapshot from another process may contain read-only arrays.
            addresses = (
                address(array) if array.size and array.flags.writeable else array.ctypes.data for array in arrays
            )
            check(self._library.cloth_plan_grips(self._handle, self.count, len(arrays[0]), *addresses))
        paths = float64_address("paths of grippers", controls.paths, self._paths_shape)
        status = self._library.cloth_plan_gripper_paths(self._handle, paths)
        if status == binding.NOT_FINITE:
            raise ValueError(f"paths of grippers are {controls.paths.tolist()}; all numbers must be finite")
        check(status)
        self._uploaded = controls

    @property
    def prescribed_particles(self) -> NDArray[np.int64]:
        """Particles whose motion a gripper prescribes, ascending."""
        return self.force.controls.grasps.prescribed_particles

    def prescribe(self, t: float, x: Array, v: Array) -> Array:
        """Set x, v (3, n) of prescribed particles to their gripper's at t [s]; return impulses and work, (grippers, 8).

        Returns:
            Impulse [N s] (3), angular impulse [N m s] (3), work [J] and dissipation [J] of each gripper by the change
            of the velocities, shape (grippers, RECORD_NUMBERS). The signs are those of `wrench_rates`.
        """
        self.upload()
        out = np.zeros((self.count, binding.RECORD_NUMBERS))
        addresses = writable_address("x", x, self._shape), writable_address("v", v, self._shape)
        check(self._library.cloth_prescribe(self._handle, t, *addresses, out.ctypes.data))
        return out

    def wrench_rates(self, t: float, x: Array, v: Array, weight: float = 1.0) -> tuple[int, Array]:
        """Return the engine's status and, per gripper, wrench of the cloth, its power and dissipation, (grippers, 8).

        Args:
            t: time [s].
            x: positions [m], shape (3, n).
            v: velocities [m/s], shape (3, n).
            weight: factor on the result.

        Returns:
            Status of the engine. Force [N] (3), torque [N m] (3), power [W], dissipated power [W], shape (grippers,
            RECORD_NUMBERS).
        """
        self.upload()
        out = np.zeros((self.count, binding.RECORD_NUMBERS))
        addresses = float64_address("x", x, self._shape), float64_address("v", v, self._shape)
        status: int = self._library.cloth_grip_wrenches(self._handle, t, *addresses, weight, out.ctypes.data)
        return status, out

    def min_damping_time(self) -> float:
        """Return the least ratio of damping to stiffness, c / k [s], of the grips; infinity if there are none."""
        grasps = self.force.controls.grasps
        return min_damping_time(grasps.stiffness, grasps.damping)

    def add_bounds(self, stiff: Array, damped: Array) -> None:
        """Add stiffness [N/m] and damping [N s/m] of grips to their particles' blocks (6, n), in place."""
        grasps = self.force.controls.grasps
        # Several grippers may grasp one particle: plain indexing would not add up.
        for axis in range(3):
            np.add.at(stiff[axis], grasps.particles, grasps.stiffness)
            np.add.at(damped[axis], grasps.particles, grasps.damping)
