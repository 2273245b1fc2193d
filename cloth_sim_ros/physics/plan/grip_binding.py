# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine binding of grips: uploads grasped particles and paths, returns wrenches."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine import binding
from cloth_sim_ros.engine.binding import address, check, float64_address, library, writable_address
from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.model.controls import Grasps, GripControls
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.plan.plan_handle import PlanHandle
from cloth_sim_ros.physics.plan.uncopyable import Uncopyable


class _StrongestGrip(NamedTuple):
    """Strongest grip of a gripper: what its particles' accelerations follow of its path."""

    gripper: int
    #: Largest k/m [1/s^2] and k_d/m [1/s] of its grips, and largest distance of a grasped point from its origin [m].
    stiffness: float
    damping: float
    reach: float
    #: Smallest k/m of its grips [1/s^2].
    min_stiffness: float
    #: True if the gripper prescribes the motion of a particle.
    is_prescribed: bool


def _jerk_change(omega2: float, damping: float, acceleration: float, duration: float) -> float:
    """Return the change of jerk by a path that an error of velocity shows at the end of an interval [m/s^3].

    Args:
        omega2: squared frequency of the spring to the path [1/s^2].
        damping: its damping rate [1/s].
        acceleration: largest acceleration of the path [m/s^2].
        duration: of the interval [s].
    """
    if omega2:
        # Waves decay. Without damping their phase errors add up.
        decay = max(3.0 / math.sqrt(omega2), 2.0 * damping / omega2, 4.0 / damping if damping else duration)
        duration = min(duration, decay)
    return acceleration * (omega2 * duration + 3.0 * damping)


def _accelerations(path: list[float], t: float, duration: float, reach: float) -> tuple[float, float, float]:
    """Return upper bounds of a point's acceleration at the ends of an interval, and of its change between them [m/s^2].

    Args:
        path: of the gripper, PATH_NUMBERS.
        t: start of the interval [s].
        duration: its length [s].
        reach: distance of the point from the gripper's origin [m].
    """
    start, at_start, at_end, change = t - path[0], 0.0, 0.0, 0.0
    for first, scale in ((7, 2.0), (20, 2.0 * reach)):
        second, third = path[first : first + 3], [3.0 * a for a in path[first + 3 : first + 6]]
        at_start += scale * _length([a + start * b for a, b in zip(second, third, strict=True)])
        at_end += scale * _length([a + (start + duration) * b for a, b in zip(second, third, strict=True)])
        change += scale * _length([duration * b for b in third])
    return at_start, at_end, change


def _length(vector: list[float]) -> float:
    x, y, z = vector
    return math.sqrt(x * x + y * y + z * z)


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
        #: Grasps, the strongest grip of each gripper that grasps a free particle, and true if several grippers grasp
        #: one, see `_strongest_grips`.
        self._known_grips: tuple[Grasps | None, list[_StrongestGrip], bool] = (None, [], False)
        #: Grasps, stiffness over mass of their grips [1/s^2], ascending, and the least c / k [s] from each of them on.
        self._known_damping: tuple[Grasps | None, Sequence[float], Sequence[float]] = (None, (), ())

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

    def jerk_change(
        self, t: float, duration: float, inverse_masses: Array, rates: tuple[float, float], error_time: float
    ) -> float:
        """Return the largest change of a particle's jerk by its gripper's path over an interval, times T^2/8 [m/s].

        With the largest acceleration a of the point it is a (k τ + 3 k_d)/m. Waves decay in the time τ, which is at
        most T. If several grippers grasp one particle, their changes add up. A prescribed particle acts through the
        sheet's springs. Waves keep an error of velocity for 1/w only, and an error of positions adds to it. The change
        is therefore weighted by that fraction of `error_time` (docs/derivations/changes.md).

        Args:
            t: start of the interval [s].
            duration: its length T [s].
            inverse_masses: of the particles [1/kg], shape (n,).
            rates: bounds of the sheet's squared frequency w^2 [1/s^2] and damping rate [1/s].
            error_time: time within which an error of velocity displaces [s].
        """
        changes, paths = [0.0], self.force.controls.paths
        grips, are_shared = self._strongest_grips(inverse_masses)
        for gripper, stiffness, damping, reach, min_stiffness, is_prescribed in grips:
            acceleration = max(_accelerations(paths[gripper].tolist(), t, duration, reach)[:2])
            fraction = min(1.0, 2.0 / math.sqrt(min_stiffness * error_time * error_time + 1.0))
            change = fraction * _jerk_change(stiffness, damping, acceleration, duration)
            if is_prescribed:
                fraction = 1.0 / math.sqrt(rates[0] * error_time * error_time + 1.0)
                change = max(change, fraction * _jerk_change(*rates, acceleration, duration))
            changes.append(change)
        return 0.125 * duration * duration * (ordered_sum(changes) if are_shared else max(changes))

    def acceleration_change(self, t: float, duration: float, inverse_masses: Array) -> float:
        """Return the sum of the changes of a grasped point's acceleration over an interval, from and to 0 [m/s^2].

        It is an upper bound for the points of all grippers. If several grippers grasp one particle, theirs add up.

        Args:
            t: start of the interval [s].
            duration: its length [s].
            inverse_masses: of the particles [1/kg], shape (n,).
        """
        paths, (grips, are_shared) = self.force.controls.paths, self._strongest_grips(inverse_masses)
        changes = [ordered_sum(_accelerations(paths[grip.gripper].tolist(), t, duration, grip.reach)) for grip in grips]
        return ordered_sum(changes) if are_shared else max(changes, default=0.0)

    def _strongest_grips(self, inverse_masses: Array) -> tuple[list[_StrongestGrip], bool]:
        """Return the strongest grip of each gripper that grasps a free particle, and true if two grasp the same one.

        They are cached while the grasps stay.
        """
        grasps = self.force.controls.grasps
        if grasps is not self._known_grips[0]:
            particles, _, offsets, stiffness, damping, prescribed = grasps.validated(self.count, self._shape[1])
            strongest = list[_StrongestGrip]()
            for gripper in range(self.count if len(particles) else 0):
                grips = slice(grasps.starts[gripper], grasps.starts[gripper + 1])
                inverse, points = inverse_masses[particles[grips, 0]], np.ascontiguousarray(offsets[grips].T)
                if not inverse.any():
                    continue
                rates = stiffness[grips] * inverse
                largest = float(rates.max()), float((damping[grips] * inverse).max())
                min_stiffness = float(rates[inverse > 0.0].min())
                reach = largest_distance(points, np.zeros_like(points))
                is_prescribed = bool(prescribed[grips].any())
                strongest.append(_StrongestGrip(gripper, *largest, reach, min_stiffness, is_prescribed))
            self._known_grips = grasps, strongest, len(np.unique(particles)) < len(particles)
        return self._known_grips[1:]

    def min_damping_time(self, soft: float, inverse_masses: Array) -> float:
        """Return the least ratio of damping to stiffness, c / k [s], of the grips; infinity if there are none.

        Args:
            soft: stiffness over mass [1/s^2], from 0, up to which a grip does not count.
            inverse_masses: of the particles [1/kg], shape (n,).
        """
        grasps = self.force.controls.grasps
        if grasps is not self._known_damping[0]:
            stiffness = grasps.stiffness * inverse_masses[grasps.particles]
            order = np.argsort(stiffness)
            order = order[stiffness[order] > 0.0]
            ratios = grasps.damping[order] / grasps.stiffness[order]
            self._known_damping = grasps, stiffness[order].tolist(), np.minimum.accumulate(ratios[::-1])[::-1].tolist()
        _, rates, times = self._known_damping
        first = bisect_right(rates, soft)
        return times[first] if first < len(rates) else math.inf

    def add_bounds(self, stiff: Array, damped: Array) -> None:
        """Add stiffness [N/m] and damping [N s/m] of grips to their particles' blocks (6, n), in place."""
        grasps = self.force.controls.grasps
        # Several grippers may grasp one particle: plain indexing would not add up.
        for axis in range(3):
            np.add.at(stiff[axis], grasps.particles, grasps.stiffness)
            np.add.at(damped[axis], grasps.particles, grasps.damping)
