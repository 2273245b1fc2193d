# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grippers of a simulation: poses, targets and grips, kept in the state."""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Collection, Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.controls import Grasps, GripControls
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.pair_springs import damping_coefficient
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.gripper_path import to_body_frame
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.simulation.bodies.kinematic_bodies import (
    MAX_BODY_SPEED,
    KinematicBodies,
    clamp_motion,
    travel,
    writable_copy,
)
from cloth_sim_ros.simulation.events import Target

#: Tolerance for rounding, so that a target exactly at the speed limit is not clamped.
_ROUNDING_MARGIN = 1.0 + 1e-9


@attrs.frozen
class GraspResult:
    """Result of a command to close or open a gripper: number of grasped particles, or the reason for none."""

    gripper: str
    closed: bool
    #: Number of grasped particles.
    grasped_count: int
    #: Reason if it grasps nothing or nothing changed; else empty.
    reason: str = ""
    #: True if its pads have started to move; `Frame.pinches` reports their rest.
    pending: bool = False
    #: False if its pads came to rest before the commanded opening, because cloth is between them.
    reached: bool = True


class Grippers:
    """Grippers of one simulation: poses, targets and grasped particles, all kept in ``state.memory``.

    Args:
        names: names of the grippers; their order is that of every array.
        state: keeps poses and grips; missing entries are added.
        prescribing: names of the grippers that prescribe the motion of the particles that they grasp.
    """

    def __init__(self, names: list[str], state: State, prescribing: Collection[str] = ()) -> None:
        self.names = names
        self._state = state
        #: True for each gripper that prescribes the motion of its particles, shape (gripper_count,).
        self._prescribes: NDArray[np.bool_] = np.array([name in prescribing for name in names], dtype=np.bool_)
        #: Distance from the origin to the outermost point of the pads [m], by index of each pinching gripper.
        self.pad_reaches: dict[int, float] = {}
        #: Commanded speed [m/s] by name, of each gripper that the speed limit slowed in the newest frame.
        self.speed_limited: dict[str, float] = {}
        #: Arrays of grips, and the distance from each gripper's origin to its furthest grasped particle [m].
        self._lever_arms: tuple[Any, Any, list[float | None]] = (None, None, [])
        count = len(names)
        pose = np.zeros((count, 7))
        pose[:, 6] = 1.0
        self._bodies = KinematicBodies("gripper", pose, state)
        for name in ("gripper.placed", "gripper.closed"):
            state.memory.setdefault(name, np.zeros(count, dtype=bool))
        state.memory.setdefault("grip.starts", np.zeros(count + 1, dtype=np.int64))
        state.memory.setdefault("grip.particles", np.empty(0, dtype=np.int64))
        state.memory.setdefault("grip.offsets", np.empty((0, 3)))

    def poses(self) -> Array:
        """Return a copy of present poses: position [m] and quaternion x, y, z, w, shape (gripper_count, 7)."""
        return self._state.memory["gripper.pose"].copy()

    def lagging_poses(self, stopped: Sequence[str]) -> tuple[tuple[str, tuple[float, ...]], ...]:
        """Return (name, pose of 7 numbers) of each gripper that the newest frame left short of its commanded target.

        Args:
            stopped: names of the bodies that stopped in the newest frame; a stopped gripper's target became its pose.
        """
        pose, target = self._bodies.array("pose"), self._bodies.array("target")
        return tuple(
            (name, tuple(pose[g].tolist()))
            for g, name in enumerate(self.names)
            if name in stopped or (name in self.speed_limited and (pose[g] != target[g]).any())
        )

    def is_placed(self, index: int) -> bool:
        """Return True if the gripper of an index has received a target, and therefore has a pose."""
        return bool(self._state.memory["gripper.placed"][index])

    def is_closed(self, index: int) -> bool:
        """Return True if the gripper of an index is closed, with or without cloth."""
        return bool(self._state.memory["gripper.closed"][index])

    def grasped_particles(self, index: int) -> np.ndarray:
        """Return a copy of the indices of the particles attached to the gripper of an index; empty for pads."""
        starts = self._state.memory["grip.starts"]
        return self._state.memory["grip.particles"][starts[index] : starts[index + 1]].copy()

    @property
    def is_at_rest(self) -> bool:
        """True if every gripper is at its target and was there for a whole frame."""
        return self._bodies.is_at_rest

    def set_target(self, event: Target) -> bool:
        """Store a gripper's target. Return True for its first one, which places the gripper there at once."""
        g = self.names.index(event.gripper)
        target = self._bodies.set_target(g, event.position, event.orientation)
        is_first = not self._state.memory["gripper.placed"][g]
        if is_first:
            writable_copy(self._state, "gripper.placed")[g] = True
            self._bodies.writable_copy("pose")[g] = target
        return is_first

    def max_speed(self, index: int, speed_limit: float) -> float:
        """Return a gripper's effective speed limit [m/s], 0 for none; a gripper with pads always has one.

        Args:
            index: index of the gripper.
            speed_limit: the limit that is set [m/s], 0 for none.
        """
        return min(speed_limit or MAX_BODY_SPEED, MAX_BODY_SPEED) if index in self.pad_reaches else speed_limit

    def hold_position(self, among: Collection[int] | None = None) -> list[str]:
        """Hold the present poses of some grippers until their next targets; return names of those that were moving.

        Args:
            among: their indices; by default those that can crush the cloth: pinching grippers, and those that prescribe
                the motion of particles.
        """
        indices = {*self.pad_reaches, *self.prescribing_grippers()} if among is None else among
        return [self.names[g] for g in self._bodies.hold_position(sorted(indices))]

    def prescribing_grippers(self) -> list[int]:
        """Return the indices of the grippers that prescribe the motion of at least one particle."""
        if not self._prescribes.any():
            return []
        starts = self._state.memory["grip.starts"]
        indices: list[int] = np.flatnonzero(self._prescribes & (starts[1:] > starts[:-1])).tolist()
        return indices

    def close(self, name: str, model: Model, radius: float) -> GraspResult:
        """Close a gripper, and attach the free particles within the radius [m] of its pose; return their number."""
        memory = self._state.memory
        g = self.names.index(name)
        if memory["gripper.closed"][g]:
            return GraspResult(name, True, len(self.grasped_particles(g)), "it is closed already: open it first")
        writable_copy(self._state, "gripper.closed")[g] = True
        if not memory["gripper.placed"][g]:
            return GraspResult(name, True, 0, "it has had no target yet, so it is nowhere")
        pose = memory["gripper.pose"][g]
        x, y, z = self._state.x - pose[:3, None]
        distance = np.sqrt(x * x + y * y + z * z)
        is_in_reach = distance <= radius
        is_free = is_in_reach & (model.inverse_masses > 0.0)
        is_available = is_free.copy()
        # Two prescribed motions contradict each other, and a spring would pull at a particle that cannot yield.
        is_available[self._prescribed_particles()] = False
        particles = np.flatnonzero(is_available)
        self.attach(name, particles)
        if particles.size:
            return GraspResult(name, True, int(particles.size))
        if is_free.any():
            reason = f"all {int(is_free.sum())} free particles within {radius} m follow a gripper (gripper.model)"
            return GraspResult(name, True, 0, reason)
        if is_in_reach.any():
            return GraspResult(name, True, 0, f"all {int(is_in_reach.sum())} particles within {radius} m are anchored")
        reason = f"no particle within {radius} m of it; the nearest is {float(distance.min()):.3g} m away"
        return GraspResult(name, True, 0, reason)

    def check_prescribed_particles(self) -> None:
        """Raise ValueError if two grippers of the state prescribe the motion of one particle.

        Raises:
            ValueError: naming the particle.
        """
        particles = np.sort(self._prescribed_particles())
        if (repeated := particles[1:][particles[1:] == particles[:-1]]).size:
            raise ValueError(
                f"the state has particle {repeated[0]} in two grippers, which both prescribe its motion: set "
                "gripper.model to spring, or start from another state"
            )

    def _prescribed_particles(self) -> NDArray[np.int64]:
        """Return the indices of the particles whose motion a gripper prescribes, gripper by gripper."""
        memory = self._state.memory
        particles: NDArray[np.int64] = memory["grip.particles"][
            np.repeat(self._prescribes, np.diff(memory["grip.starts"]))
        ]
        return particles

    def attach(self, name: str, particles: NDArray[np.int64]) -> None:
        """Close a gripper that has a pose, and attach particles at their present positions, instead of former ones."""
        g = self.names.index(name)
        writable_copy(self._state, "gripper.closed")[g] = True
        pose = self._state.memory["gripper.pose"][g]
        self._replace(g, particles, to_body_frame(pose, self._state.x[:, particles]))

    def pinch(self, name: str, *, again: bool = False) -> GraspResult:
        """Start to close a gripper's pads, or with `again` closed ones to another opening; return a pending result."""
        memory, g = self._state.memory, self.names.index(name)
        if memory["gripper.closed"][g] and not again:
            return GraspResult(name, True, 0, "it is closed already: open it first")
        writable_copy(self._state, "gripper.closed")[g] = True
        if not memory["gripper.placed"][g]:
            return GraspResult(name, True, 0, "it has had no target yet, so it is nowhere")
        return GraspResult(name, True, 0, pending=True)

    def open(self, name: str) -> GraspResult:
        """Open a gripper: release its particles, let its pads, if any, open in the next frames; return the result."""
        memory = self._state.memory
        g = self.names.index(name)
        reason = "" if memory["gripper.closed"][g] else "it was open already"
        writable_copy(self._state, "gripper.closed")[g] = False
        self._replace(g, np.empty(0, dtype=np.int64), np.empty((0, 3)))
        return GraspResult(name, False, 0, reason)

    def move(
        self,
        present: Grasps,
        model: Model,
        t: float,
        duration: float,
        stiffness: float,
        damping: float,
        speeds: Sequence[float],
    ) -> tuple[GripControls, float]:
        """Move each gripper over a frame; return the controls of grips and the largest change of displacement [m].

        Args:
            present: grasped particles of the frame before.
            model: gives the masses of the grasped particles.
            t: time at which the frame starts [s].
            duration: length of the frame [s].
            stiffness: stiffness of the spring that holds the heaviest particle [N/m]; others in proportion to mass.
            damping: dimensionless damping k_d0 of that spring.
            speeds: speed limit of each gripper for its grasped particles, mean over the frame [m/s]; 0 for none.

        Returns:
            Controls of the frame, and the largest change of a closed gripper's displacement from the frame before to
            this one, along an axis [m].
        """
        is_closed, max_change = self._state.memory["gripper.closed"].tolist(), 0.0
        self.speed_limited = {}
        end_pose = functools.partial(self._end_pose, duration, speeds) if self.pad_reaches or any(speeds) else None
        paths, changes = self._bodies.move(t, duration, end_pose)
        controls = GripControls(paths, self._grasps(present, model, stiffness, damping))
        for g, change in enumerate(changes):
            if change > max_change and (is_closed[g] or g in self.pad_reaches):
                max_change = change
        return controls, max_change

    def _end_pose(
        self, duration: float, speeds: Sequence[float], g: int, pose: Sequence[float], target: Sequence[float]
    ) -> Sequence[float]:
        """Return gripper g's pose at a frame's end: its target, or nearer by its speed limit, which it then records.

        Pads are never faster than obstacles, because they would jump through the cloth.
        """
        if pose == target:
            return target
        speed = self.max_speed(g, speeds[g])
        reach = self.pad_reaches[g] if g in self.pad_reaches else self._lever_arm(g)
        if not speed or reach is None:
            return target
        max_travel = speed * duration * (1.0 if g in self.pad_reaches else _ROUNDING_MARGIN)
        end = clamp_motion(pose, target, reach, max_travel)
        if end is not target:
            self.speed_limited[self.names[g]] = travel(pose, target, reach) / duration
        return end

    def _lever_arm(self, g: int) -> float | None:
        """Return the distance from a gripper's origin to its furthest grasped particle [m]; None without particles."""
        starts, offsets = (self._state.memory[name] for name in ("grip.starts", "grip.offsets"))
        cached = self._lever_arms
        if cached[0] is not starts or cached[1] is not offsets:
            # By component, because a library might choose another order of sums.
            x, y, z = offsets.T
            lengths = np.sqrt(x * x + y * y + z * z)
            lever_arms = [float(lengths[a:b].max()) if a < b else None for a, b in itertools.pairwise(starts.tolist())]
            self._lever_arms = cached = (starts, offsets, lever_arms)
        return cached[2][g]

    def _grasps(self, present: Grasps, model: Model, stiffness: float, damping: float) -> Grasps:
        memory = self._state.memory
        particles, starts = memory["grip.particles"], memory["grip.starts"]
        source = particles, starts, memory["grip.offsets"], stiffness, damping
        if present.source and all(map(operator.is_, source, present.source)):
            return present
        # Border particles have half or a quarter of the mass, of the grip and of the threads. Therefore they do not
        # limit the step.
        stiffnesses = stiffness * model.masses[particles] / model.masses.max()
        prescribed = None
        if self._prescribes.any():
            prescribed = np.repeat(self._prescribes, np.diff(starts))
            stiffnesses[prescribed] = 0.0
        dampings = damping_coefficient(damping, stiffnesses, model.masses[particles])
        return Grasps(starts, particles, memory["grip.offsets"], stiffnesses, dampings, source, prescribed)

    def _replace(self, gripper: int, particles: np.ndarray, offsets: Array) -> None:
        """Replace the particles, and their offsets (k, 3) [m], that one gripper grasps, in the state's memory."""
        memory = self._state.memory
        starts = memory["grip.starts"]
        begin, end = int(starts[gripper]), int(starts[gripper + 1])
        for name, new in (("grip.particles", particles), ("grip.offsets", offsets)):
            old = memory[name]
            memory[name] = np.ascontiguousarray(np.concatenate([old[:begin], new, old[end:]]))
        new_starts = starts.copy()
        new_starts[gripper + 1 :] += len(particles) - (end - begin)
        memory["grip.starts"] = new_starts
