# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of events before they change anything."""

from __future__ import annotations

import math
from collections.abc import Sequence

import attrs
import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import normalised, unit
from cloth_sim_ros.physics.obstacles import Obstacle
from cloth_sim_ros.physics.remembered import PINCHED
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene import relaxation
from cloth_sim_ros.scene.pinch import pads_of
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Relax, Reset, SetParameters, Target
from cloth_sim_ros.simulation.surroundings import change_obstacles

#: Largest coordinate of a target [m]; anything beyond it is a mistake.
REACH = 1e4
#: Smallest clearance of pads at a stop that a change of thickness may leave, in thicknesses. No impact within the
#: design range of contact goes deeper.
_LEAST_STOP = 0.3
#: Built once, because building a union of types takes longer than the isinstance check.
_OF_GRIPPERS = (Target, Grasp)


class EventError(ValueError):
    """An event that can't take effect; the message gives the reason."""


def check_all(events: Sequence[Event], scene: Scene, state: State, initial: State) -> None:
    """Refuse the events of one frame if one of them can't take effect after those before it; see `check`."""
    for event in events:
        after = check(event, scene, state, initial)
        if after.obstacles != scene.obstacles:
            state, initial = state.share(), initial.share()
            change_obstacles(scene, after, (state, initial))
        scene = after


def check(event: Event, scene: Scene, state: State, initial: State) -> Scene:
    """Refuse an event that can't take effect, and return the scene in force after it.

    Args:
        event: the event.
        scene: the scene in force.
        state: the state before the event.
        initial: the state that a reset restores.

    Raises:
        EventError: naming the value, the limit and the remedy.
    """
    if isinstance(event, _OF_GRIPPERS):
        _check_name("gripper", event.gripper, scene.grippers)
    if isinstance(event, Target):
        _check_pose(event.gripper, event.position, event.orientation)
        _check_pads(event, scene, state)
    elif isinstance(event, Move):
        _check_name("obstacle", event.obstacle, scene.obstacles)
        _check_pose(event.obstacle, event.position, event.orientation)
    elif isinstance(event, SetParameters):
        return _check_parameters(event, scene, state)
    elif isinstance(event, Reset):
        _check_start(scene, scene.obstacle_names, initial, "the cloth as it starts")
    elif isinstance(event, Relax) and not 1.0 <= event.factor <= relaxation.MOST_FACTOR:
        raise EventError(
            f"a tolerance is relaxed {event.factor} times; it must be from 1 to {relaxation.MOST_FACTOR:g}"
        )
    elif not isinstance(event, Event):
        raise EventError(f"{event!r} is no event; see cloth_sim_ros.simulation.events")
    return scene


def _check_name(kind: str, name: str, known: Sequence[str]) -> None:
    if not name or name not in known:
        there = ", ".join(filter(None, known)) or "none"
        raise EventError(f"there is no {kind} '{name}'; this cloth has {there}")


def _check_pose(name: str, position: Sequence[float], orientation: Sequence[float] | None) -> None:
    if len(position) != 3 or not all(map(math.isfinite, position)):
        raise EventError(f"target of '{name}' is {list(position)}; it must be 3 finite numbers")
    if max(map(abs, position)) > REACH:
        raise EventError(f"target of '{name}' is {list(position)} m; no coordinate may be beyond {REACH:g} m")
    if orientation is not None:
        try:
            unit(orientation)
        except ValueError as error:
            raise EventError(f"target of '{name}': {error}") from error


def _check_pads(event: Target, scene: Scene, state: State) -> None:
    """Refuse a gripper's first target, which places it at once, if its pads would be in the cloth."""
    if not scene.pinches(event.gripper):
        return
    placed = state.memory.get("gripper.placed")
    if placed is not None and placed[scene.gripper_names.index(event.gripper)]:
        return
    from cloth_sim_ros.simulation.pinching import check_placed

    turn = (0.0, 0.0, 0.0, 1.0) if event.orientation is None else normalised(event.orientation)
    pads = next(pads for pads in pads_of(scene, 1.0) if pads.gripper == event.gripper)
    try:
        poses = check_placed(pads, np.concatenate([event.position, turn]), state)
        _check_faces(scene, pads.boxes(), poses, state, "the cloth")
    except ValueError as error:
        raise EventError(f"target of '{event.gripper}': {error}") from error


def _check_parameters(event: SetParameters, scene: Scene, state: State) -> Scene:
    if not isinstance(event.values, dict) or not all(isinstance(name, str) for name in event.values):
        raise EventError(f"parameters {event.values!r} must be values by full name, e.g. {{'air.drag': 0.5}}")
    try:
        wanted = scene.changed(event.values)
    except ValueError as error:
        raise EventError(str(error)) from error
    check_added(scene, wanted, state)
    _check_stops(scene, wanted, state)
    return wanted


def _check_stops(scene: Scene, wanted: Scene, state: State) -> None:
    """Refuse a contact thickness that would put pads beyond a stop. Pads stop at each other and at their opening."""
    thickness = wanted.contact.thickness
    if thickness == scene.contact.thickness:
        return
    for pads, (way, _) in zip(pads_of(wanted, 1.0), state.memory.get(PINCHED, np.empty((0, 2))).tolist(), strict=False):
        left = min(way + 0.75 * thickness, 0.5 * pads.opening + thickness - way)
        if left < _LEAST_STOP * thickness:
            raise EventError(
                f"contact.thickness is {thickness:.4g} m; it would leave the pads of '{pads.gripper}' {left:.4g} m "
                f"from their stop, and they need {_LEAST_STOP * thickness:.4g} m; set it once they are at rest, "
                "or choose a larger one"
            )


def check_added(scene: Scene, wanted: Scene, state: State) -> None:
    """Refuse a new scene if its obstacles would intersect or contain the cloth.

    Checked are new obstacles, obstacles that contained anchored particles, and all obstacles if the thickness changes.

    Raises:
        EventError: naming the obstacle and the location.
    """
    kept = [name for name in wanted.obstacle_names if name in scene.obstacle_names]
    added = [name for name in wanted.obstacle_names if name not in kept]
    # New obstacles start at the pose in their description.
    _check_start(wanted, added, State(state.positions), "the cloth")
    if (wanted.cloth.anchors, wanted.contact.thickness) != (scene.cloth.anchors, scene.contact.thickness):
        there = attrs.evolve(wanted, obstacles=scene.obstacles)
        if kept:
            let_go = wanted.cloth.anchors != scene.cloth.anchors
            _check_start(there, kept, state, "the cloth, once it is let go," if let_go else "the cloth")
        elif wanted.contact.self_:
            _check_faces(there, [], np.empty((0, 7)), state, "the cloth")
        _check_present_pads(there, state)


def _check_present_pads(scene: Scene, state: State) -> None:
    """Refuse a scene if placed pads would be too close to the cloth or intersect it."""
    if not scene.pinching or "gripper.pose" not in state.memory:
        return
    from cloth_sim_ros.simulation.grippers import Grippers
    from cloth_sim_ros.simulation.pinching import Pinching

    own = state.share()
    pinching = Pinching(tuple(pads_of(scene, 1.0)), Grippers(scene.gripper_names, own), own)
    if shown := pinching.shown():
        _check_faces(scene, [pinching.boxes[k] for k in shown], pinching.poses()[shown], state, "the cloth")


def _check_start(scene: Scene, names: Sequence[str], state: State, what: str) -> None:
    """Refuse a state that is inside named obstacles. Obstacles stand at the state's poses, or else at their start."""
    if not names:
        return
    from cloth_sim_ros.simulation.obstacles import Obstacles

    try:
        obstacles = Obstacles(scene.solids, scene.described, state.share())
        obstacles.check_outside(names, scene.anchored_particles())
    except ValueError as error:
        raise EventError(f"{what} {error}") from error
    kept = [k for k, name in enumerate(scene.obstacle_names) if name in names]
    _check_faces(scene, [scene.solids[k] for k in kept], obstacles.poses()[kept], state, what)


def _check_faces(scene: Scene, solids: Sequence[Obstacle], poses: Array, state: State, what: str) -> None:
    """Refuse obstacles at poses that intersect the cloth between particles or are too close to it.

    A cloth that is too close to itself is refused as well.
    """
    from cloth_sim_ros.physics.contact_thickness import check_gaps
    from cloth_sim_ros.physics.forces.contact import Contact, OwnSurface
    from cloth_sim_ros.physics.model import Model
    from cloth_sim_ros.physics.plan import compile
    from cloth_sim_ros.simulation.movers import standing

    thickness = scene.contact.thickness
    faces = OwnSurface(scene.sheet.triangles(), scene.sheet.positions(), thickness=thickness)
    surface = faces if scene.contact.self_ else None
    contact = Contact(solids, thickness=thickness, faces=faces, surface=surface)
    contact.move(standing(0.0, poses))
    plan = compile(Model(np.ones(state.x.shape[1]), [contact], anchors=scene.anchored_particles()))
    assert plan.contact is not None
    try:
        plan.contact.check_clear(0.0, state.x)
    except ValueError as error:
        raise EventError(str(error)) from error
    try:
        check_gaps(plan.contact.gap_rows(0.0, state.x), thickness, [solid.name for solid in solids])
    except ValueError as error:
        raise EventError(f"{what} {error}") from error
