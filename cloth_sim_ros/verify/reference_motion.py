# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of a simulation, and reference motions under the same commands."""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import numpy as np

from cloth_sim_ros.physics.model.controls import Controls, GripControls
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from cloth_sim_ros.physics.plan.plan import Plan
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, JAWS_KEY, PLASTIC_LENGTHS_KEY, THICKNESS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.bodies.bodies import adapt_states, carry_over_anchors
from cloth_sim_ros.simulation.events import Reset
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify.reference_integrator import MotionState


@attrs.frozen(eq=False, kw_only=True)
class SimulatedFrame:
    """A frame of the simulation, with its commands and the states before and after it."""

    index: int
    #: Time at its start, and its length [s].
    t: float
    duration: float
    scene: Scene
    #: State before it, with the obstacles of its scene; state after it.
    before: State
    after: State
    #: True if the cloth was reset at its beginning.
    reset: bool
    #: Controls of the frame.
    controls: Controls
    #: Grippers that closed at its beginning, or before it while paused.
    newly_closed: frozenset[int]
    #: Effective tolerance [m]; None if none is set.
    tolerance: float | None
    #: True if the simulation flagged the frame: its error may exceed its share of the tolerance.
    flagged: bool
    #: Smallest step of the simulation [s]; infinite if the cloth slept.
    step: float


class FrameCapture:
    """Converter of a simulation's frames to `SimulatedFrame`, so that reference motions follow the same commands."""

    def __init__(self) -> None:
        self._new: frozenset[int] = frozenset()
        self._reset = False

    def capture(
        self, simulation: Simulation, scene_before: Scene, state_before: State, frame: Frame
    ) -> SimulatedFrame | None:
        """Return the simulation's last frame with its controls; None if no time passed. Call it after every frame."""
        names = simulation.grippers.names
        if any(isinstance(event, Reset) for event in frame.events):
            self._reset, self._new = True, frozenset()
        else:
            closed = {names.index(result.gripper) for result in frame.grasps if result.closed and not result.reason}
            self._new |= closed
        if not frame.moved:
            return None
        new, reset = self._new, self._reset
        self._new, self._reset = frozenset(), False
        advance, scene = frame.advance, simulation.scene
        start = state_before.shallow_copy()
        adapt_states(scene_before, scene, [start])
        return SimulatedFrame(
            index=frame.index,
            t=state_before.frame * scene.period,
            duration=scene.period,
            scene=scene,
            before=start,
            after=simulation.state.shallow_copy(),
            reset=reset,
            controls=simulation.frame_controls,
            newly_closed=new,
            tolerance=frame.tolerance,
            flagged=bool(advance and advance.flagged),
            step=advance.step if advance and advance.steps else float("inf"),
        )


class Equations:
    """Plan that reference motions share, compiled for each new scene, with the controls of one motion at a time."""

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._plan: Plan | None = None

    def plan(self, frame: SimulatedFrame, motion: ReferenceMotion) -> Plan:
        """Return the shared plan, set to a frame's commands and to one motion's grip points until the next call."""
        if self._plan is None or self._scene is not frame.scene:
            self._scene, self._plan = frame.scene, frame.scene.plan()
        grips, contact = frame.controls
        if grips is not None:
            grips = grips._replace(grasps=attrs.evolve(grips.grasps, offsets=motion.offsets))
        self._plan.controls = Controls(grips, contact)
        return self._plan


#: Arrays of a state's memory that belong to the motion itself.
_MOTION_KEYS = (ANCHORS_KEY, JAWS_KEY, PLASTIC_LENGTHS_KEY)


class ReferenceMotion:
    """Motion from a given state under the simulation's commands; callers integrate its `state` frame by frame.

    The simulation decides the particles that a gripper grasps. The grip points follow from their positions in this
    motion.

    Args:
        state: initial state; not modified.
    """

    def __init__(self, state: State) -> None:
        memory = {key: state.memory[key] for key in _MOTION_KEYS if key in state.memory}
        self.state = MotionState(state.x, state.v, memory)
        self._scene: Scene | None = None
        count = len(state.memory.get("gripper.pose", ()))
        starts = state.memory.get("grip.starts", np.zeros(count + 1, dtype=np.int64))
        offsets = state.memory.get("grip.offsets", np.empty((0, 3)))
        self._offsets = [offsets[starts[g] : starts[g + 1]] for g in range(count)]

    @property
    def x(self) -> Array:
        """Positions [m], shape (3, n)."""
        return self.state.x

    @property
    def offsets(self) -> Array:
        """Grip points in their grippers' frames [m], shape (m, 3)."""
        return np.ascontiguousarray(np.concatenate([np.empty((0, 3)), *self._offsets]))

    def apply_grasps(self, frame: SimulatedFrame) -> None:
        """Grasp and release the same particles as the simulation at a frame's beginning; call it before each frame.

        Contacts get the simulation's thickness.
        """
        memory, (controls, contact) = dict(self.state.memory), frame.controls
        thickness = None if contact is None else contact.recovery.start
        anchors = memory.pop(ANCHORS_KEY, None)
        if anchors is not None and self._scene is not None and self._scene is not frame.scene:
            anchors = carry_over_anchors(anchors, self._scene, frame.scene)
        memory.pop(THICKNESS_KEY, None)
        memory |= {
            key: array for key, array in ((ANCHORS_KEY, anchors), (THICKNESS_KEY, thickness)) if array is not None
        }
        self._scene, self.state = frame.scene, self.state._replace(memory=memory)
        if controls is not None:
            self._offsets = [self._grip_points(controls, frame.newly_closed, g) for g in range(len(controls.paths))]

    def perturb(self, x: Array, v: Array) -> None:
        """Add a perturbation to positions [m] and velocities [m/s], shape (3, n) each."""
        self.state = self.state._replace(x=self.state.x + x, v=self.state.v + v)

    def _grip_points(self, controls: GripControls, newly_closed: frozenset[int], gripper: int) -> Array:
        starts, particles = controls.grasps.starts, controls.grasps.particles
        particles = particles[starts[gripper] : starts[gripper + 1]]
        if self._scene is not None and gripper >= len(self._scene.gripper_names):  # a joint to an obstacle
            return controls.grasps.offsets[starts[gripper] : starts[gripper + 1]]
        if gripper not in newly_closed and particles.size:
            return self._offsets[gripper]
        path = controls.paths[gripper]
        offsets = self.x[:, particles] - path[1:4, None]
        return np.asarray((rotation_matrix(path[13:17]).T @ offsets).T)


def starting_state(frame: SimulatedFrame) -> State:
    """Return the state at a frame's beginning: the previous one, or the initial one after a reset."""
    return frame.scene.starting_state() if frame.reset else frame.before


def apply_grasps(motions: Iterable[ReferenceMotion], frame: SimulatedFrame) -> None:
    """Grasp and release the same particles as the simulation in several reference motions."""
    for motion in motions:
        motion.apply_grasps(frame)
