# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grippers of a simulation: their poses, targets and grips, kept as named arrays of the state."""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Sequence
from typing import Any, TypeAlias

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.engine.binding import PATH_NUMBERS
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.forces.grips import Grips
from cloth_sim_ros.physics.forces.pair_springs import lecture_damping
from cloth_sim_ros.physics.gripper_path import rotation_matrix
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.simulation.events import Target
from cloth_sim_ros.simulation.movers import MOST_SPEED, Movers, renewed, travel, within

#: A target at the limit of speed is not beyond it by rounding.
_ROUNDING = 1.0 + 1e-9


@attrs.frozen
class GraspResult:
    """What closing or opening a gripper did."""

    gripper: str
    closed: bool
    #: Particles that the gripper holds now.
    held: int
    #: Why it holds none, or that nothing changed; empty otherwise.
    reason: str = ""
    #: Whether its pads only begin to close: `Frame.pinches` tells when they have.
    pending: bool = False


#: What a force holds, see `Grips.noted`; the arrays of the state and numbers that it came of; paths.
Noted: TypeAlias = tuple[tuple[Any, ...] | None, tuple[Any, ...] | None, Array]


class Grippers:
    """The grippers of one simulation; all that changes lies in ``state.memory``.

    Args:
        names: names of the grippers; their order is that of every array.
        state: the state that keeps poses and grips; entries that it lacks are added.
    """

    def __init__(self, names: list[str], state: State) -> None:
        self.names = names
        self._state = state
        #: What was laid into the force that holds particles last: as long as it is the same, only paths are new.
        self._laid: tuple[Any, ...] | None = None
        #: Of those that pinch, by index: how far their pads reach from their origin [m].
        self.reaches: dict[int, float] = {}
        #: Of those that their limit of speed held back in the newest frame, by name: the speed asked for [m/s].
        self.limited: dict[str, float] = {}
        #: Distance from each gripper's origin to the furthest particle that it holds [m], and the arrays that say so.
        self._arms: tuple[Any, Any, list[float | None]] = (None, None, [])
        #: Paths of all over the newest frame, shape (count, PATH_NUMBERS).
        self.paths = np.zeros((len(names), PATH_NUMBERS))
        count = len(names)
        pose = np.zeros((count, 7))
        pose[:, 6] = 1.0
        self._movers = Movers("gripper", pose, state)
        for name, array in (
            ("gripper.placed", np.zeros(count, dtype=bool)),
            ("gripper.closed", np.zeros(count, dtype=bool)),
            ("grip.starts", np.zeros(count + 1, dtype=np.int64)),
            ("grip.particles", np.empty(0, dtype=np.int64)),
            ("grip.offsets", np.empty((0, 3))),
        ):
            state.memory.setdefault(name, array)

    def poses(self) -> Array:
        """Present poses: position [m] and quaternion x, y, z, w, shape (gripper_count, 7)."""
        return self._state.memory["gripper.pose"].copy()

    def lagging(self, halted: Sequence[str]) -> tuple[tuple[str, tuple[float, ...]], ...]:
        """Return name and pose, 7 numbers, of each gripper that the newest frame left short of its commanded target.

        Args:
            halted: names of the bodies that were halted in the newest frame; a halted gripper's target became its pose.
        """
        pose, target = self._movers.array("pose"), self._movers.array("target")
        return tuple(
            (name, tuple(pose[g].tolist()))
            for g, name in enumerate(self.names)
            if name in halted or (name in self.limited and (pose[g] != target[g]).any())
        )

    def is_placed(self, index: int) -> bool:
        """Whether the gripper has had a target, and so has a pose."""
        return bool(self._state.memory["gripper.placed"][index])

    def is_closed(self, index: int) -> bool:
        """Whether the gripper is closed, on whatever it holds or on nothing."""
        return bool(self._state.memory["gripper.closed"][index])

    def held(self, index: int) -> np.ndarray:
        """Indices of the particles that a gripper holds."""
        starts = self._state.memory["grip.starts"]
        return self._state.memory["grip.particles"][starts[index] : starts[index + 1]].copy()

    @property
    def settled(self) -> bool:
        """Whether every gripper stands at its target, and stood there for a frame."""
        return self._movers.settled

    def noted(self, grips: Grips | None) -> Noted:
        """Return what was laid into the force that holds particles, for `go_back`."""
        laid = None if self._laid is None else self._laid[:-1]
        return None if grips is None else grips.noted(), laid, self.paths

    def go_back(self, noted: Noted, grips: Grips | None) -> None:
        """Lay into the force what was laid then, after the state has become what it was."""
        held, laid, self.paths = noted
        if grips is not None and held is not None:
            grips.go_back(held)
        self._laid = None if laid is None else (*laid, grips)

    def set_target(self, event: Target) -> bool:
        """Take note of a target; return whether it is the first one, which places the gripper there at once."""
        g = self.names.index(event.gripper)
        target = self._movers.aim(g, event.position, event.orientation)
        first = not self._state.memory["gripper.placed"][g]
        if first:
            renewed(self._state, "gripper.placed")[g] = True
            self._movers.renewed("pose")[g] = target
        return first

    def max_speed(self, index: int, speed: float) -> float:
        """Return the limit of a gripper's speed [m/s], 0 for none, for the one that is set; pads have one always."""
        return min(speed or MOST_SPEED, MOST_SPEED) if index in self.reaches else speed

    def halt(self) -> list[str]:
        """Let those that pinch stand still where they are, until they are commanded anew; return the names of those
        that moved.
        """
        return [self.names[g] for g in self._movers.halt(sorted(self.reaches))]

    def close(self, name: str, model: Model, radius: float) -> GraspResult:
        """Grab the free particles within the radius [m] of a gripper's present position."""
        memory = self._state.memory
        g = self.names.index(name)
        if memory["gripper.closed"][g]:
            return GraspResult(name, True, len(self.held(g)), "it is closed already: open it first")
        renewed(self._state, "gripper.closed")[g] = True
        if not memory["gripper.placed"][g]:
            return GraspResult(name, True, 0, "it has had no target yet, so it is nowhere")
        pose = memory["gripper.pose"][g]
        away = self._state.x - pose[:3, None]
        distance = np.sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2])
        near = distance <= radius
        particles = np.flatnonzero(near & (model.inverse_masses > 0.0))
        self.take(name, particles)
        if particles.size:
            return GraspResult(name, True, int(particles.size))
        if near.any():
            return GraspResult(name, True, 0, f"all {int(near.sum())} particles within {radius} m are anchored")
        return GraspResult(
            name, True, 0, f"no particle within {radius} m of it; the nearest is {float(distance.min()):.3g} m away"
        )

    def take(self, name: str, particles: NDArray[np.int64]) -> None:
        """Close a gripper that is anywhere, and let it hold these particles where they are."""
        g = self.names.index(name)
        renewed(self._state, "gripper.closed")[g] = True
        pose = self._state.memory["gripper.pose"][g]
        away = self._state.x - pose[:3, None]
        turn = rotation_matrix(pose[3:])
        # A world vector in the gripper's frame: R' d.
        x, y, z = away[:, particles]
        offsets = np.stack([turn[0, i] * x + turn[1, i] * y + turn[2, i] * z for i in range(3)], axis=1)
        self._replace(g, particles, offsets)

    def pinch(self, name: str) -> GraspResult:
        """Let the pads of a gripper close."""
        memory, g = self._state.memory, self.names.index(name)
        if memory["gripper.closed"][g]:
            return GraspResult(name, True, 0, "it is closed already: open it first")
        renewed(self._state, "gripper.closed")[g] = True
        if not memory["gripper.placed"][g]:
            return GraspResult(name, True, 0, "it has had no target yet, so it is nowhere")
        return GraspResult(name, True, 0, pending=True)

    def open(self, name: str) -> GraspResult:
        """Let go of everything that a gripper holds."""
        memory = self._state.memory
        g = self.names.index(name)
        reason = "" if memory["gripper.closed"][g] else "it was open already"
        renewed(self._state, "gripper.closed")[g] = False
        self._replace(g, np.empty(0, dtype=np.int64), np.empty((0, 3)))
        return GraspResult(name, False, 0, reason)

    def plan_frame(
        self,
        grips: Grips,
        model: Model,
        t: float,
        duration: float,
        stiffness: float,
        damping: float,
        speeds: Sequence[float],
    ) -> float:
        """Lay each gripper's path over the frame into the force that holds particles, with what it holds.

        Returns:
            By how much the way of a closed gripper over this frame differs from that over the one before [m], at most,
            along an axis.

        Args:
            grips: the force that holds particles.
            model: for the masses of the held particles.
            t: time at which the frame starts [s].
            duration: length of the frame [s].
            stiffness: stiffness of the spring that holds the heaviest particle [N/m]; others in proportion to their
            mass.
            damping: dimensionless damping k_d0 of it.
            speeds: of each gripper, the fastest that what it holds may move, mean over the frame [m/s]; 0 for no limit.
        """
        closed, most = self._state.memory["gripper.closed"].tolist(), 0.0
        self.limited = {}
        goal = functools.partial(self._within, duration, speeds) if self.reaches or any(speeds) else None
        self.paths, changes = self._movers.paths(t, duration, goal)
        self._lay(grips, self.paths, model, stiffness, damping)
        for g, change in enumerate(changes):
            if change > most and (closed[g] or g in self.reaches):
                most = change
        return most

    def _within(
        self, duration: float, speeds: Sequence[float], g: int, pose: Sequence[float], target: Sequence[float]
    ) -> Sequence[float]:
        """Pose of a gripper at a frame's end: its target, or, if it holds cloth, as near to it as its speed lets.
        Pads never follow faster than obstacles: they would jump through the cloth.
        """
        if pose == target:
            return target
        speed = self.max_speed(g, speeds[g])
        reach = self.reaches[g] if g in self.reaches else self._arm(g)
        if not speed or reach is None:
            return target
        most = speed * duration * (1.0 if g in self.reaches else _ROUNDING)
        end = within(pose, target, reach, most)
        if end is not target:
            self.limited[self.names[g]] = travel(pose, target, reach) / duration
        return end

    def _arm(self, g: int) -> float | None:
        """Distance from a gripper's origin to the furthest particle that it holds [m]; None if it holds none."""
        starts, offsets = (self._state.memory[name] for name in ("grip.starts", "grip.offsets"))
        known = self._arms
        if known[0] is not starts or known[1] is not offsets:
            # By component, so that no library chooses the order of sums.
            x, y, z = offsets.T
            lengths = np.sqrt(x * x + y * y + z * z)
            arms = [float(lengths[a:b].max()) if a < b else None for a, b in itertools.pairwise(starts.tolist())]
            self._arms = known = (starts, offsets, arms)
        return known[2][g]

    def _lay(self, grips: Grips, paths: Array, model: Model, stiffness: float, damping: float) -> None:
        memory = self._state.memory
        particles, starts = memory["grip.particles"], memory["grip.starts"]
        held = (particles, starts, memory["grip.offsets"], stiffness, damping, grips)
        if self._laid is not None and all(map(operator.is_, held, self._laid)):
            grips.move(paths)
            return
        self._laid = held
        # Border particles carry half or a quarter of the mass, and so of the grip, as they do of the threads: they
        # don't set the step.
        each = stiffness * model.masses[particles] / model.masses.max()
        damping_each = lecture_damping(damping, each, model.masses[particles])
        grips.hold(paths, starts, particles, memory["grip.offsets"], each, damping_each)

    def _replace(self, gripper: int, particles: np.ndarray, offsets: Array) -> None:
        """Set what one gripper holds, the others' grips staying as they are."""
        memory = self._state.memory
        starts = memory["grip.starts"]
        begin, end = int(starts[gripper]), int(starts[gripper + 1])
        for name, new in (("grip.particles", particles), ("grip.offsets", offsets)):
            old = memory[name]
            memory[name] = np.ascontiguousarray(np.concatenate([old[:begin], new, old[end:]]))
        moved = starts.copy()
        moved[gripper + 1 :] += len(particles) - (end - begin)
        memory["grip.starts"] = moved
