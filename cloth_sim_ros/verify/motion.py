# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a frame was under (scene, grips, paths), and motions that go through it from states of their own."""

from __future__ import annotations

from collections.abc import Iterable

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import rotation_matrix
from cloth_sim_ros.physics.plan import Plan
from cloth_sim_ros.physics.remembered import ANCHORS, PINCHED
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Reset
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.simulation.surroundings import change_obstacles, kept_anchors
from cloth_sim_ros.verify.fine import Moving


@attrs.frozen(eq=False, kw_only=True)
class Grasping:
    """How particles were held over a frame; arrays as in `physics.forces.grips.Grips`."""

    paths: Array
    starts: NDArray[np.int64]
    particles: NDArray[np.int64]
    stiffness: Array
    damping: Array
    #: Grippers that closed at its beginning, or while time stood still before it.
    new: frozenset[int]


@attrs.frozen(eq=False, kw_only=True)
class RunFrame:
    """A frame as the simulation ran it."""

    index: int
    #: Time at its start, and its length [s].
    t: float
    duration: float
    scene: Scene
    #: State before it, with the obstacles of its scene; state after it.
    before: State
    after: State
    #: Whether the cloth was put back to its initial state at its beginning.
    reset: bool
    #: None where the scene has no grippers.
    grasping: Grasping | None
    #: Paths of the obstacles and pads, see `Contact`; None where there are none.
    surrounding: Array | None
    #: Whether each gripper that pinches is anywhere, and whether it closes, see `Contact`; None where there are none.
    driven: NDArray[np.bool_] | None
    #: Thickness of contacts at its start, see `Touching.thickness_shape`; None where all have the whole one.
    thickness: Array | None
    #: The same at its end; None where it is the same.
    regained: Array | None
    #: Tolerance in force [m]; None where none is set.
    tolerance: float | None
    #: Whether the simulation said that its error may be above the tolerance's share.
    flagged: bool
    #: Smallest step it took [s]; infinite where the cloth slept.
    step: float


class FrameWatch:
    """Takes from a simulation, frame by frame, what other motions need to go through the same."""

    def __init__(self) -> None:
        self._new: frozenset[int] = frozenset()
        self._reset = False

    def after(self, simulation: Simulation, was: Scene, before: State, frame: Frame) -> RunFrame | None:
        """Return the frame just advanced, from scene and state before it; None where no time passed."""
        names, memory = simulation.grippers.names, simulation.state.memory
        if any(isinstance(event, Reset) for event in frame.events):
            self._reset, self._new = True, frozenset()
        else:
            closed = {names.index(result.gripper) for result in frame.grasps if result.closed and not result.reason}
            self._new |= closed
        if not frame.moved:
            return None
        new, reset = self._new, self._reset
        self._new, self._reset = frozenset(), False
        advance, grips, scene = frame.advance, simulation.plan.grips, simulation.scene
        contact, start = simulation.plan.contact, before.share()
        change_obstacles(was, scene, [start])
        grasping = None
        if grips is not None:
            grasping = Grasping(
                paths=grips.paths.copy(),
                starts=memory["grip.starts"],
                particles=memory["grip.particles"],
                stiffness=grips.stiffness,
                damping=grips.damping,
                new=new,
            )
        return RunFrame(
            index=frame.index,
            t=before.frame * scene.period,
            duration=scene.period,
            scene=scene,
            before=start,
            after=simulation.state.share(),
            reset=reset,
            grasping=grasping,
            surrounding=None if contact is None else contact.force.paths.copy(),
            driven=None if contact is None else contact.force.driven.copy(),
            thickness=None if contact is None else contact.thickness,
            regained=None if contact is None else contact.regained,
            tolerance=frame.tolerance,
            flagged=bool(advance and advance.flagged),
            step=advance.step if advance and advance.steps else float("inf"),
        )


class Equations:
    """A plan of its own for the scene of the frame at hand."""

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._plan: Plan | None = None

    def plan(self, frame: RunFrame, motion: Motion) -> Plan:
        """Return the plan for a frame, with the grips of one motion laid into it."""
        if self._plan is None or self._scene is not frame.scene:
            self._scene, self._plan = frame.scene, frame.scene.plan()
        held, grips = frame.grasping, self._plan.grips
        if held is not None and grips is not None:
            grips.hold(held.paths, held.starts, held.particles, motion.offsets, held.stiffness, held.damping)
        if frame.surrounding is not None and self._plan.contact is not None:
            self._plan.contact.force.move(frame.surrounding)
            if frame.driven is not None:
                self._plan.contact.force.drive(frame.driven)
            self._plan.contact.force.recover(frame.t, frame.duration, frame.regained)
            self._plan.contact.sync()
            self._plan.contact.lay_thickness(frame.thickness)
        return self._plan


class Motion:
    """Positions and velocities under the same commands as the simulation's, from a state of one's own.

    Which particles a gripper takes is what the simulation found; where it takes them is where they are in this motion.

    Args:
        state: where it starts; it stays as it is.
    """

    def __init__(self, state: State) -> None:
        self.now = Moving(state.x, state.v, state.memory.get(ANCHORS), state.memory.get(PINCHED))
        self._scene: Scene | None = None
        count = len(state.memory.get("gripper.pose", ()))
        starts = state.memory.get("grip.starts", np.zeros(count + 1, dtype=np.int64))
        offsets = state.memory.get("grip.offsets", np.empty((0, 3)))
        self._offsets = [offsets[starts[g] : starts[g + 1]] for g in range(count)]

    @property
    def x(self) -> Array:
        """Positions [m], shape (3, n)."""
        return self.now.x

    @property
    def offsets(self) -> Array:
        """Points of all grips in their grippers' frames [m], shape (m, 3)."""
        return np.ascontiguousarray(np.concatenate([np.empty((0, 3)), *self._offsets]))

    def take_hold(self, frame: RunFrame) -> None:
        """Grasp and let go as the simulation did at the frame's beginning, and keep what its obstacles hold."""
        if self.now.anchors is not None and self._scene is not None and self._scene is not frame.scene:
            self.now = self.now._replace(anchors=kept_anchors(self.now.anchors, self._scene, frame.scene))
        self._scene = frame.scene
        held = frame.grasping
        if held is not None:
            self._offsets = [self._held(held, g) for g in range(len(held.paths))]

    def kick(self, x: Array, v: Array) -> None:
        """Add to positions [m] and velocities [m/s]."""
        self.now = self.now._replace(x=self.now.x + x, v=self.now.v + v)

    def _held(self, held: Grasping, gripper: int) -> Array:
        particles = held.particles[held.starts[gripper] : held.starts[gripper + 1]]
        if gripper not in held.new and particles.size:
            return self._offsets[gripper]
        path = held.paths[gripper]
        away = self.x[:, particles] - path[1:4, None]
        return np.asarray((rotation_matrix(path[13:17]).T @ away).T)


def starting_state(frame: RunFrame) -> State:
    """Return the state in which a frame began: the one before it, or the initial one after a reset."""
    return frame.scene.starting_state() if frame.reset else frame.before


def take_hold(motions: Iterable[Motion], frame: RunFrame) -> None:
    """Let several motions grasp and let go as the simulation did."""
    for motion in motions:
        motion.take_hold(frame)
