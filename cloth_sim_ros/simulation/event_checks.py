# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of events before they change anything."""

from __future__ import annotations

import math
from collections.abc import Sequence

import attrs
import numpy as np

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.contact.parallel_jaw import NO_SETPOINT
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized, unit_quaternion
from cloth_sim_ros.physics.state.controller_state import JAWS_KEY, SETPOINTS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene import relaxation
from cloth_sim_ros.scene.gripper_pads import pads_of
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.bodies.bodies import adapt_states
from cloth_sim_ros.simulation.events import (
    Event,
    Grasp,
    Move,
    MoveObstacles,
    Relax,
    Reset,
    SetParameters,
    Target,
    ordered,
)

#: Largest coordinate of a target [m]; anything beyond it is a mistake.
MAX_COORDINATE = 1e4
#: Smallest clearance of pads at a stop that a change of thickness may leave, in thicknesses. No impact within the
#: design range of contact goes deeper.
_MIN_STOP_CLEARANCE = 0.3
#: Smallest speed of pads [m/s].
MIN_PAD_SPEED = 1e-4
#: Built once, because building a union of types takes longer than the isinstance check.
_GRIPPER_EVENTS = (Target, Grasp)


class EventError(ValueError):
    """Error: an event can't take effect; the message gives value, limit and remedy."""

    #: The event, if it is one of several that were checked together.
    event: Event | None = None


def check_all(events: Sequence[Event], scene: Scene, state: State, initial: State) -> list[Event]:
    """Return the events of a frame in the order of their effect; raise EventError if one can't follow the others."""
    in_order = ordered(list(events))
    for event in in_order:
        try:
            after = check(event, scene, state, initial)
        except EventError as error:
            error.event = event
            raise
        if after.obstacles != scene.obstacles:
            state, initial = state.shallow_copy(), initial.shallow_copy()
            adapt_states(scene, after, (state, initial))
        scene = after
    return in_order


def check(event: Event, scene: Scene, state: State, initial: State) -> Scene:
    """Raise EventError if an event can't take effect, else return the scene in force after it; change nothing.

    Args:
        event: the event.
        scene: the scene in force.
        state: the state before the event.
        initial: the state that a reset restores.

    Raises:
        EventError: naming the value, the limit and the remedy.
    """
    if isinstance(event, _GRIPPER_EVENTS):
        _check_name("gripper", event.gripper, scene.grippers)
    if isinstance(event, Grasp):
        _check_grasp(event, scene, state)
    elif isinstance(event, Target):
        _check_pose(event.gripper, event.position, event.orientation)
        _check_pads(event, scene, state)
    elif isinstance(event, Move):
        _check_name("obstacle", event.obstacle, scene.obstacles)
        _check_pose(event.obstacle, event.position, event.orientation)
    elif isinstance(event, MoveObstacles):
        _check_poses(event.obstacles, event.poses, scene)
    elif isinstance(event, SetParameters):
        return _check_parameters(event, scene, state)
    elif isinstance(event, Reset):
        _check_reset(event, scene)
        _check_start(scene, scene.obstacle_names, initial, "the cloth as it starts", event)
        subject = f"gripper.opening is {scene.gripper.opening:.4g} m; a reset"
        check_stops(scene, initial, subject, "set the opening of the start")
    elif isinstance(event, Relax) and not 1.0 <= event.factor <= relaxation.MAX_FACTOR:
        raise EventError(f"a tolerance is relaxed {event.factor} times; it must be from 1 to {relaxation.MAX_FACTOR:g}")
    elif not isinstance(event, Event):
        raise EventError(f"{event!r} is no event; see cloth_sim_ros.simulation.events")
    return scene


def _check_name(kind: str, name: str, known: Sequence[str]) -> None:
    if not name or name not in known:
        known_names = ", ".join(filter(None, known)) or "none"
        raise EventError(f"there is no {kind} '{name}'; this cloth has {known_names}")


def _check_grasp(event: Grasp, scene: Scene, state: State) -> None:
    """Raise EventError for an opening, force or speed that a gripper's pads cannot have, or pads beyond their stop."""
    name, opening, widest = event.gripper, event.opening, scene.gripper.opening
    if not scene.pinches(name):
        if opening is not None or event.force or event.speed:
            raise EventError(
                f"grasp of '{name}' has an opening, a force or a speed, and it has no pads: set {name}.mode to pinch"
            )
        return
    if opening is not None and not 0.0 <= opening <= widest:
        raise EventError(f"opening of '{name}' is {opening} m; it must be from 0 to {widest:g} m (gripper.opening)")
    if opening is not None and JAWS_KEY in state.memory:
        k, thickness = scene.pinching.index(name), scene.contact.thickness
        half_opening = float(state.memory[JAWS_KEY][k, 0])
        inner, outer = pads_of(scene, 1.0)[k].half_opening_range(event.closed, 0.5 * opening, thickness)
        if _stop_clearance(half_opening, inner, outer, thickness) < _MIN_STOP_CLEARANCE * thickness:
            command, remedy = ("close", "open") if event.closed else ("open", "close")
            raise EventError(
                f"opening of '{name}' is {opening} m, and its pads are {2.0 * half_opening:.4g} m apart; they cannot "
                f"{command} to that: {remedy} them"
            )
    if not 0.0 <= event.force < math.inf:
        raise EventError(f"force of '{name}' is {event.force} N; it must be finite and at least 0, which means any")
    if event.speed and not MIN_PAD_SPEED <= event.speed < math.inf:
        raise EventError(
            f"speed of '{name}' is {event.speed} m/s; it must be at least {MIN_PAD_SPEED:g} m/s, or 0, which means any"
        )


def _check_pose(name: str, position: Sequence[float], orientation: Sequence[float] | None) -> None:
    if len(position) != 3 or not all(map(math.isfinite, position)):
        raise EventError(f"target of '{name}' is {list(position)}; it must be 3 finite numbers")
    if max(map(abs, position)) > MAX_COORDINATE:
        raise EventError(f"target of '{name}' is {list(position)} m; no coordinate may be beyond {MAX_COORDINATE:g} m")
    if orientation is not None:
        try:
            unit_quaternion(orientation)
        except ValueError as error:
            raise EventError(f"target of '{name}': {error}") from error


def _check_reset(event: Reset, scene: Scene) -> None:
    """Raise EventError for an invalid name or pose of a reset, and for an obstacle that joints hold to the cloth."""
    if not event.obstacles and not event.poses:
        return
    lengths = {len(pose) for pose in event.poses}
    poses = np.array(event.poses) if len(lengths) == 1 else np.zeros((len(event.poses), 0))
    _check_poses(event.obstacles, poses, scene)
    joined = scene.joined_obstacles
    for name in event.obstacles:
        if name in joined:
            raise EventError(
                f"a reset gives a pose of obstacle '{name}', which joints hold to the cloth (cloth.joints): it starts "
                "where the scene has it; leave it out"
            )


def _check_poses(names: Sequence[str], poses: Array, scene: Scene) -> None:
    """Raise EventError if one of the names or poses of several obstacles is invalid, or a name is repeated."""
    known = set(scene.obstacle_names)
    if not known.issuperset(names):
        _check_name("obstacle", next(name for name in names if name not in known), scene.obstacles)
    if len(set(names)) != len(names):
        raise EventError(f"obstacles {list(names)} are moved; name each of them once")
    if poses.shape != (len(names), 7):
        raise EventError(f"poses of {len(names)} obstacles have shape {poses.shape}; give 7 numbers for each")
    squares = poses[:, 3] * poses[:, 3]
    for k in range(4, 7):
        squares = squares + poses[:, k] * poses[:, k]
    # A comparison with NaN is false.
    is_valid = (np.abs(poses[:, :3]) <= MAX_COORDINATE).all(axis=1) & (squares >= 1e-12) & (squares < math.inf)
    if not is_valid.all():
        k = int(np.argmin(is_valid))
        pose = poses[k].tolist()
        _check_pose(names[k], pose[:3], pose[3:])
        raise EventError(f"target of '{names[k]}' is {pose}; it must be 7 finite numbers")


def _check_pads(event: Target, scene: Scene, state: State) -> None:
    """Raise EventError if the pads would be in the cloth at a gripper's first target, which places it at once."""
    if not scene.pinches(event.gripper):
        return
    is_placed = state.memory.get("gripper.placed")
    if is_placed is not None and is_placed[scene.gripper_names.index(event.gripper)]:
        return
    from cloth_sim_ros.simulation.bodies.parallel_grippers import check_first_pose

    orientation = (0.0, 0.0, 0.0, 1.0) if event.orientation is None else normalized(event.orientation)
    pads = next(pads for pads in pads_of(scene, 1.0) if pads.gripper == event.gripper)
    try:
        poses = check_first_pose(pads, np.concatenate([event.position, orientation]), state)
        _check_faces(scene, pads.boxes(), poses, state, "the cloth")
    except ValueError as error:
        raise EventError(f"target of '{event.gripper}': {error}") from error


def _check_parameters(event: SetParameters, scene: Scene, state: State) -> Scene:
    if not isinstance(event.values, dict) or not all(isinstance(name, str) for name in event.values):
        raise EventError(f"parameters {event.values!r} must be values by full name, e.g. {{'air.drag': 0.5}}")
    try:
        new_scene = scene.changed(event.values)
    except ValueError as error:
        raise EventError(str(error)) from error
    check_new_scene(scene, new_scene, state)
    return new_scene


def _check_stops(scene: Scene, new_scene: Scene, state: State) -> None:
    """Raise EventError if a new contact thickness or opening puts pads beyond a stop, each other or their opening."""
    thickness, opening = new_scene.contact.thickness, new_scene.gripper.opening
    if thickness != scene.contact.thickness:
        check_stops(new_scene, state, f"contact.thickness is {thickness:.4g} m; it", "set it once they are at rest")
    elif opening != scene.gripper.opening:
        check_stops(new_scene, state, f"gripper.opening is {opening:.4g} m; it", "set it once they are closed")


def check_stops(scene: Scene, state: State, subject: str, remedy: str) -> None:
    """Raise EventError for a state whose pads are beyond a stop: pads stop at each other and at their opening.

    Args:
        scene: gives opening and contact thickness.
        state: state with half openings.
        subject: beginning of the message.
        remedy: what may be done, except to choose larger values.

    Raises:
        EventError: naming the gripper.
    """
    memory, thickness = state.memory, scene.contact.thickness
    if not scene.pinching or len(memory.get(JAWS_KEY, ())) != len(scene.pinching) or "gripper.closed" not in memory:
        # The state has no pads, or those of another scene. Pads start open then.
        return
    setpoints = (
        memory[SETPOINTS_KEY][:, 0].tolist() if SETPOINTS_KEY in memory else [NO_SETPOINT[0]] * len(scene.pinching)
    )
    indices = [scene.gripper_names.index(name) for name in scene.pinching]
    drives = zip(memory[JAWS_KEY].tolist(), memory["gripper.closed"][indices].tolist(), setpoints, strict=True)
    for pads, ((half_opening, _), closed, setpoint) in zip(pads_of(scene, 1.0), drives, strict=True):
        inner, outer = pads.half_opening_range(bool(closed), setpoint, thickness)
        clearance = _stop_clearance(half_opening, inner, outer, thickness)
        if clearance < _MIN_STOP_CLEARANCE * thickness:
            raise EventError(
                f"{subject} would leave the pads of '{pads.gripper}' {clearance:.4g} m from their stop, and they need "
                f"{_MIN_STOP_CLEARANCE * thickness:.4g} m; {remedy}, or choose a larger one"
            )


def _stop_clearance(half_opening: float, inner: float, outer: float, thickness: float) -> float:
    """Return the smaller gap [m] of a half opening [m] to the stops, see `ParallelJaw.half_opening_range`."""
    return min(half_opening - inner + 0.75 * thickness, outer + thickness - half_opening)


def check_new_scene(scene: Scene, new_scene: Scene, state: State) -> None:
    """Raise EventError if a new scene has obstacles in the cloth, or stops that pads are beyond.

    Checked are new obstacles, obstacles that contained anchored particles, and all obstacles if the thickness changes.

    Raises:
        EventError: naming the obstacle and the location, or the gripper.
    """
    remaining = [name for name in new_scene.obstacle_names if name in scene.obstacle_names]
    added = [name for name in new_scene.obstacle_names if name not in remaining]
    # New obstacles start at the pose in their description.
    _check_start(new_scene, added, State(state.positions), "the cloth")
    if (new_scene.cloth.anchors, new_scene.contact.thickness) != (scene.cloth.anchors, scene.contact.thickness):
        moved_scene = attrs.evolve(new_scene, obstacles=scene.obstacles)
        if remaining:
            let_go = new_scene.cloth.anchors != scene.cloth.anchors
            _check_start(moved_scene, remaining, state, "the cloth, once it is let go," if let_go else "the cloth")
        elif new_scene.contact.self_:
            _check_faces(moved_scene, [], np.empty((0, 7)), state, "the cloth")
        _check_present_pads(moved_scene, state)
    _check_stops(scene, new_scene, state)


def _check_present_pads(scene: Scene, state: State) -> None:
    """Raise EventError if pads at their present poses would be too close to the cloth or intersect it."""
    if not scene.pinching or "gripper.pose" not in state.memory:
        return
    from cloth_sim_ros.simulation.bodies.grippers import Grippers
    from cloth_sim_ros.simulation.bodies.parallel_grippers import ParallelGrippers

    state_copy = state.shallow_copy()
    pinching = ParallelGrippers(tuple(pads_of(scene, 1.0)), Grippers(scene.gripper_names, state_copy), state_copy)
    if placed_pads := pinching.placed_pads():
        _check_faces(scene, [pinching.boxes[k] for k in placed_pads], pinching.poses()[placed_pads], state, "the cloth")


def _check_start(scene: Scene, names: Sequence[str], state: State, subject: str, reset: Reset | None = None) -> None:
    """Raise EventError if a cloth is inside named obstacles.

    Obstacles stand at the poses of a reset, or else of the state, or else at their start.
    """
    if not names:
        return
    from cloth_sim_ros.simulation.bodies.obstacles import Obstacles

    try:
        obstacles = Obstacles(scene.solids, scene.described, state.shallow_copy())
        if reset is not None:
            obstacles.set_poses(reset)
        obstacles.check_outside(names, scene.anchored_particles())
    except ValueError as error:
        raise EventError(f"{subject} {error}") from error
    indices = [k for k, name in enumerate(scene.obstacle_names) if name in names]
    _check_faces(scene, [scene.solids[k] for k in indices], obstacles.poses()[indices], state, subject)


def _check_faces(scene: Scene, solids: Sequence[Obstacle], poses: Array, state: State, subject: str) -> None:
    """Raise EventError if obstacles at poses intersect the cloth or are too close to it, or it is to itself.

    A cloth that is too close to itself is refused as well.
    """
    from cloth_sim_ros.physics.contact.thickness import check_gaps
    from cloth_sim_ros.physics.model.forces.contact import Contact
    from cloth_sim_ros.physics.model.model import Model
    from cloth_sim_ros.physics.plan.plan import compile
    from cloth_sim_ros.scene.build import contact_surface
    from cloth_sim_ros.simulation.bodies.kinematic_bodies import constant_paths

    thickness = scene.contact.thickness
    faces = contact_surface(scene, scene.sheet)
    surface = faces if scene.contact.self_ else None
    contact = Contact(solids, thickness=thickness, faces=faces, surface=surface)
    contact.set_paths(constant_paths(0.0, poses))
    plan = compile(Model(np.ones(state.x.shape[1]), [contact], anchors=scene.anchored_particles()))
    assert plan.contact is not None
    try:
        plan.contact.check_initial_penetration(0.0, state.x, {})
    except ValueError as error:
        raise EventError(str(error)) from error
    try:
        check_gaps(plan.contact.contact_gaps(0.0, state.x, {}), thickness, [solid.name for solid in solids])
    except ValueError as error:
        raise EventError(f"{subject} {error}") from error
