# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grippers, obstacles and pads of a scene, and their paths.

Modules of unused kinds are not imported.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.remembered import ANCHORS, LAYER_SIDES, PINCHED, THICKNESS
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.grippers import Grippers
from cloth_sim_ros.simulation.movers import standing

if TYPE_CHECKING:
    from cloth_sim_ros.physics.book import Book
    from cloth_sim_ros.physics.forces.contact import Contact
    from cloth_sim_ros.physics.obstacles import Obstacle
    from cloth_sim_ros.physics.plan import Plan
    from cloth_sim_ros.simulation.obstacles import Obstacles
    from cloth_sim_ros.simulation.pinching import Pinching


def grippers_of(scene: Scene, state: State) -> Grippers:
    """Return the grippers of a scene with a state's poses and grips.

    Raises:
        ValueError: for a state with another number of grippers.
    """
    grippers = Grippers(scene.gripper_names, state)
    known = len(state.memory["gripper.pose"])
    if known != len(grippers.names):
        raise ValueError(
            f"the state has {known} grippers, the scene {len(grippers.names)} ({', '.join(grippers.names) or 'none'})"
        )
    return grippers


def obstacles_of(scene: Scene, state: State) -> Obstacles | None:
    """Return the obstacles of a scene with a state's poses; None without obstacles.

    Raises:
        ValueError: for a state with another number of obstacles.
    """
    if not scene.obstacle_names:
        return None
    from cloth_sim_ros.simulation.obstacles import Obstacles

    obstacles = Obstacles(scene.solids, scene.described, state)
    known = len(state.memory["obstacle.pose"])
    if known != len(obstacles.names):
        raise ValueError(
            f"the state has {known} obstacles, the scene {len(obstacles.names)} ({', '.join(obstacles.names)})"
        )
    return obstacles


def pinching_of(plan: Plan, grippers: Grippers, state: State) -> Pinching | None:
    """Return the pinching grippers of a plan and a state; None without any.

    Raises:
        ValueError: for a state with another number of pinching grippers.
    """
    pads = () if plan.contact is None else plan.contact.force.pads
    if not pads:
        if PINCHED in state.memory:
            raise ValueError(
                f"the state has {len(state.memory[PINCHED])} grippers that pinch, the scene none: set gripper.mode to "
                "pinch, or start from another state"
            )
        return None
    from cloth_sim_ros.simulation.pinching import Pinching

    return Pinching(pads, grippers, state)


def plan_movers(
    plan: Plan, scene: Scene, obstacles: Obstacles | None, pinching: Pinching | None, grippers: Grippers, t: float
) -> float:
    """Upload the paths of grippers, obstacles and pads over the frame that starts at time t [s].

    Returns:
        Largest change of displacement from the frame before to this one, along an axis [m], of a body that can act on
        the cloth.
    """
    period, gripper, change = scene.period, scene.gripper, 0.0
    if plan.grips is not None:
        speeds = [scene.of_gripper(name, "max_speed") for name in grippers.names]
        change = grippers.plan_frame(plan.grips, plan.model, t, period, gripper.stiffness, gripper.damping, speeds)
    if plan.contact is None:
        return change
    force, paths, most = plan.contact.force, list[Array](), 0.0
    if obstacles is not None:
        rows, most = obstacles.plan_frame(t, period)
        paths.append(rows)
    if pinching is not None:
        paths.append(pinching.rows(grippers.paths))
        force.drive(pinching.driven())
    if paths:
        force.move(np.concatenate(paths))
    return max(change, most)


def stand(force: Contact, obstacles: Obstacles | None, pinching: Pinching | None, grippers: Grippers, t: float) -> None:
    """Upload the poses of obstacles and pads at time t [s] as constant paths, until a frame moves them."""
    force.recover(t)
    paths = [] if obstacles is None else [obstacles.standing(t)]
    if pinching is not None:
        paths.append(pinching.rows(standing(t, grippers.poses())))
        force.drive(pinching.driven())
    if paths:
        force.move(np.concatenate(paths))


def halt(obstacles: Obstacles | None, grippers: Grippers) -> tuple[str, ...]:
    """Stop obstacles and pinching grippers at their present poses until their next targets, because they crush the
    cloth.

    Return the names of the bodies that moved.
    """
    return (*([] if obstacles is None else obstacles.halt()), *grippers.halt())


def booked(book: Book | None, plan: Plan, grippers: Grippers, pinching: Pinching | None) -> tuple[Array, Array]:
    """Return the wrenches of the cloth on grippers and on obstacles in a frame; zeros without an accumulator."""
    wrenches = book.wrenches if book else np.zeros((len(grippers.names), 6))
    loads = book.loads if book else np.zeros((plan.obstacle_count, 6))
    return wrenches, loads if pinching is None else pinching.take_over(loads, wrenches)


def solids_and_poses(obstacles: Obstacles | None, pinching: Pinching | None) -> tuple[list[Obstacle], Array]:
    """Return the bodies in contact, obstacles and then pads of placed grippers, and their poses.

    Returns:
        Bodies, and poses: position [m] and quaternion x, y, z, w, shape (count, 7).
    """
    solids = [] if obstacles is None else list(obstacles.solids)
    poses = np.zeros((0, 7)) if obstacles is None else obstacles.poses()
    if pinching is not None:
        shown = pinching.shown()
        solids += [pinching.boxes[k] for k in shown]
        poses = np.concatenate([poses, pinching.poses()[shown]])
    return solids, poses


def change_obstacles(before: Scene, scene: Scene, states: Iterable[State]) -> None:
    """Replace obstacles, friction anchors and contact thickness in states by those of another scene."""
    for state in states:
        if before.obstacles != scene.obstacles:
            from cloth_sim_ros.simulation.obstacles import rearrange

            rearrange(state, before.obstacle_names, scene.obstacle_names, scene.described)
        if ANCHORS in state.memory:
            memory = dict(state.memory)
            anchors = kept_anchors(memory.pop(ANCHORS), before, scene)
            state.memory = memory if anchors is None else {**memory, ANCHORS: anchors}
        if THICKNESS in state.memory:
            memory = dict(state.memory)
            thickness = kept_thickness(memory.pop(THICKNESS), before, scene)
            state.memory = memory if thickness is None else {**memory, THICKNESS: thickness}


def kept_thickness(thickness: Array, before: Scene, scene: Scene) -> Array | None:
    """Return the contact thickness after a change of scene, or None if every contact has the full one.

    New obstacles have the full thickness.
    """
    if scene.contact.thickness != before.contact.thickness:
        return None
    pads = [f"{name}.{side}" for name in scene.pinching for side in ("left", "right")]
    names = [*before.obstacle_names, *pads, ""]
    rows = [thickness[names.index(name)] if name in names else None for name in (*scene.obstacle_names, *pads, "")]
    whole = np.full(thickness.shape[1], scene.contact.thickness)
    kept = np.array([whole if row is None else row for row in rows])
    return kept if (kept < whole).any() else None


def kept_anchors(anchors: Array, before: Scene, scene: Scene) -> Array | None:
    """Return the friction anchors after a change of scene, or None if no body has friction.

    Remaining obstacles keep their anchors, and new ones have none. If friction returns later, anchors start empty.
    """
    pads = [f"{name}.{side}" for name in scene.pinching for side in ("left", "right")]
    rough = any(solid.friction[0] > 0.0 for solid in scene.solids) or (pads and scene.gripper.friction[0] > 0.0)
    layered = scene.contact.self_ and scene.contact.friction[0] > 0.0
    if not (rough or layered):
        return None
    # The set of pinching grippers never changes.
    names, now = [*before.obstacle_names, *pads], [*scene.obstacle_names, *pads]
    kept = np.zeros((len(now), *anchors.shape[1:]))
    for k, name in enumerate(now):
        if name in names:
            kept[k] = anchors[names.index(name)]
    if not layered:
        return kept
    # Anchors of layers follow those of obstacles.
    own = anchors[len(names) :]
    return np.concatenate([kept, own if len(own) else np.zeros((LAYER_SIDES, *anchors.shape[1:]))])
