# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Initial state of a simulation, anchored velocities, and the grasp command."""

from __future__ import annotations

from typing import TYPE_CHECKING

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.physics.state.controller_state import reset_step_control
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.scene.topology_id import difference
from cloth_sim_ros.simulation.bodies.bodies import adapt_states
from cloth_sim_ros.simulation.bodies.grippers import GraspResult, Grippers
from cloth_sim_ros.simulation.events import Grasp
from cloth_sim_ros.simulation.sleep import wake

if TYPE_CHECKING:
    from cloth_sim_ros.simulation.bodies.parallel_grippers import ParallelGrippers


def stop_particles(state: State, particles: NDArray[np.int64]) -> None:
    """Set the velocity of particles to zero in a state, in a new array."""
    if state.v[:, particles].any():
        state.v = state.v.copy()
        state.v[:, particles] = 0.0


def stop_anchored(scene: Scene, state: State) -> None:
    """Set the velocity of a scene's anchored particles to zero in a state, unless the sheet is raw springs.

    Without a force an anchored particle would keep its velocity. Anchors of raw springs keep the velocity of their
    file.
    """
    if not isinstance(scene.sheet, RawSprings):
        stop_particles(state, np.array(scene.anchored_particles(), dtype=np.int64))


def names_of_bodies(scene: Scene) -> tuple[tuple[str, ...], ...]:
    """Return the names of a scene's grippers, and of its obstacles, see `State.bodies`."""
    return tuple(scene.gripper_names), tuple(scene.obstacle_names)


def _bodies_difference(state: State, scene: Scene) -> str:
    """Return the difference of a state's grippers and obstacles from a scene's, as the end of a sentence, or "".

    Their numbers are checked elsewhere: a state that never ran fits any.
    """
    for kind, names, present in zip(
        ("grippers", "obstacles"), state.bodies or (), names_of_bodies(scene), strict=False
    ):
        if names != present and len(names) == len(present):
            return (
                f"has {kind} {', '.join(names)}, the scene {', '.join(present)}; give them the same names, in the same "
                "order"
            )
    return ""


def _follow_obstacles(initial: State, scene: Scene) -> None:
    """Adapt the state that a reset restores to obstacles that came or went while the cloth ran, by their names."""
    assert initial.bodies is not None
    names = initial.bodies[1]
    if names != tuple(scene.obstacle_names) and set(names) <= set(scene.described):
        adapt_states(attrs.evolve(scene, obstacles=names or ("",)), scene, (initial,))


def starting_states(scene: Scene, state: State | None) -> tuple[State, State]:
    """Return the state that a reset restores, and a copy of it or of `state` to start from; raise ValueError if unfit.

    Raises:
        ValueError: for a state of another cloth, or with other names of grippers or obstacles.
    """
    initial = scene.starting_state()
    if reason := _bodies_difference(initial if state is None else state, scene):
        subject = f"initial_state '{scene.initial_state}'" if state is None else "the state"
        raise ValueError(f"{subject} {reason}")
    mismatch = difference(state, initial.cloth) if state is not None and initial.cloth is not None else ""
    if mismatch:
        raise ValueError(f"the state {mismatch}: a state only continues the cloth that it was saved from")
    if state is not None and initial.bodies is not None:
        _follow_obstacles(initial, scene)
    # The state may have been saved asleep under other parameters.
    wake(initial)
    stop_anchored(scene, initial)
    start = initial.copy() if state is None else state.copy()
    if not initial.v.any():
        # The initial state is usually at rest. A broadcast zero then replaces the whole array.
        initial.v = np.broadcast_to(0.0, initial.v.shape)
    start.cloth, start.bodies = initial.cloth, names_of_bodies(scene)
    start.memory.setdefault("paused", np.zeros(1, dtype=bool))
    return initial, start


def apply_grasp(
    event: Grasp, state: State, scene: Scene, model: Model, grippers: Grippers, pinching: ParallelGrippers | None
) -> GraspResult:
    """Close or open a gripper by an event, and reset step control; return the result.

    The cloth in the state wakes if the grip changes, and at any event of a pinching gripper.
    """
    index = grippers.names.index(event.gripper)
    grasped_before = grippers.grasped_particles(index).size
    is_pinching = pinching is not None and event.gripper in pinching.names
    if pinching is not None and is_pinching:
        has_setpoint = event.opening is not None or pinching.setpoint(event.gripper)[0] >= 0.0
        result = _move_pads(event, grippers, again=has_setpoint)
        pinching.set_setpoint(event)
    elif event.closed:
        result = grippers.close(event.gripper, model, scene.gripper.radius)
    else:
        result = grippers.open(event.gripper)
    reset_step_control(state)
    if result.pending and pinching is not None:
        pinching.request_rest_result(event.gripper)
    if result.grasped_count != grasped_before or is_pinching:
        wake(state)
    return result


def _move_pads(event: Grasp, grippers: Grippers, *, again: bool) -> GraspResult:
    """Start to close or open pads; return the result, pending for closing, or opening to a given distance."""
    if event.closed:
        return grippers.pinch(event.gripper, again=again)
    result = grippers.open(event.gripper)
    is_placed = grippers.is_placed(grippers.names.index(event.gripper))
    return result if event.opening is None or not is_placed else attrs.evolve(result, reason="", pending=True)
