# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grippers, obstacles and pads of a scene, and their paths.

Modules of unused kinds are not imported.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.model.controls import ContactControls, Controls, GripControls, ThicknessRecovery
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.controller_state import (
    ANCHORS_KEY,
    JAWS_KEY,
    JOINTS_KEY,
    LAYER_SIDES,
    PLASTIC_LENGTHS_KEY,
    THICKNESS_KEY,
)
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.build import obstacle_joints
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.bodies.grippers import Grippers
from cloth_sim_ros.simulation.bodies.kinematic_bodies import constant_paths

#: Least gap of a prescribed particle as a fraction of the contact thickness, and samples of its path in a frame.
_MIN_GAP_FRACTION, _PATH_SAMPLES = 0.1, 4
#: Decrease of a gap by rounding, as a fraction of the contact thickness.
_GAP_ROUNDING = 1e-9

if TYPE_CHECKING:
    from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
    from cloth_sim_ros.physics.contact.obstacles import Obstacle
    from cloth_sim_ros.physics.model.forces.contact import Contact
    from cloth_sim_ros.physics.model.model import Model
    from cloth_sim_ros.physics.plan.plan import Plan
    from cloth_sim_ros.simulation.bodies.joints import ObstacleJoints
    from cloth_sim_ros.simulation.bodies.obstacles import Obstacles
    from cloth_sim_ros.simulation.bodies.parallel_grippers import ParallelGrippers


def build_grippers(scene: Scene, state: State) -> Grippers:
    """Build a scene's grippers on a state, adding missing poses and grips to it; raise ValueError if it does not fit.

    Raises:
        ValueError: for a state with another number of grippers, or with two prescribed motions of one particle.
    """
    grippers = Grippers(scene.gripper_names, state, scene.prescribing)
    n_poses = len(state.memory["gripper.pose"])
    if n_poses != len(grippers.names):
        raise ValueError(
            f"the state has {n_poses} grippers, the scene {len(grippers.names)} ({', '.join(grippers.names) or 'none'})"
        )
    grippers.check_prescribed_particles()
    return grippers


def build_obstacles(scene: Scene, state: State) -> Obstacles | None:
    """Build a scene's obstacles on a state, adding missing poses to it, or None; raise ValueError if it does not fit.

    Raises:
        ValueError: for a state with another number of obstacles.
    """
    if not scene.obstacle_names:
        return None
    from cloth_sim_ros.simulation.bodies.obstacles import Obstacles

    obstacles = Obstacles(scene.solids, scene.described, state)
    n_poses = len(state.memory["obstacle.pose"])
    if n_poses != len(obstacles.names):
        raise ValueError(
            f"the state has {n_poses} obstacles, the scene {len(obstacles.names)} ({', '.join(obstacles.names)})"
        )
    return obstacles


def build_joints(scene: Scene, model: Model, state: State) -> ObstacleJoints | None:
    """Build the joints to obstacles, or None without any; put their points into the state. Raises ValueError.

    Raises:
        ValueError: for a state with another number of joints.
    """
    if any(scene.cloth.joints) and obstacle_joints(scene, scene.sheet):
        from cloth_sim_ros.simulation.bodies.joints import ObstacleJoints

        return ObstacleJoints(scene, model.masses, state)
    if JOINTS_KEY in state.memory:
        count = len(state.memory[JOINTS_KEY])
        raise ValueError(f"the state has {count} joints to obstacles, the scene none (cloth.joints)")
    return None


def build_parallel_grippers(plan: Plan, grippers: Grippers, state: State) -> ParallelGrippers | None:
    """Build the pinching grippers of a plan on a state, and set their reach in `grippers`; None without any.

    Raises:
        ValueError: for a state with another number of pinching grippers.
    """
    pads = () if plan.contact is None else plan.contact.force.jaws
    if not pads:
        if JAWS_KEY in state.memory:
            raise ValueError(
                f"the state has {len(state.memory[JAWS_KEY])} grippers that pinch, the scene none: set gripper.mode to "
                "pinch, or start from another state"
            )
        return None
    from cloth_sim_ros.simulation.bodies.parallel_grippers import ParallelGrippers

    return ParallelGrippers(pads, grippers, state)


def move_bodies(
    plan: Plan,
    scene: Scene,
    obstacles: Obstacles | None,
    pinching: ParallelGrippers | None,
    grippers: Grippers,
    joints: ObstacleJoints | None,
    t: float,
) -> tuple[Controls, float]:
    """Move the bodies over the frame from time t [s] on; return controls and largest change of displacement [m].

    Returns:
        Controls of the frame, and the largest change of displacement from the frame before to this one, along an axis
        [m], of a body that can act on the cloth.
    """
    period, gripper, change = scene.period, scene.gripper, 0.0
    grips: GripControls | None = None
    if plan.grips is not None:
        speeds = [scene.of_gripper(name, "max_speed") for name in grippers.names]
        stiffness, damping = gripper.stiffness, gripper.damping
        present = plan.grips.controls.grasps if joints is None else joints.gripper_grasps(plan.grips.controls.grasps)
        grips, change = grippers.move(present, plan.model, t, period, stiffness, damping, speeds)
    if plan.contact is None:
        return Controls(grips), change
    thickness = plan.contact.force.thickness
    rows, obstacle_change, is_away = (None, 0.0, None) if obstacles is None else obstacles.move(t, period, thickness)
    contact = _contact_controls(plan.contact.force, rows, pinching, None if grips is None else grips.paths, t, is_away)
    if joints is not None and grips is not None and rows is not None:
        grips = joints.extend(grips, rows)
    return Controls(grips, contact), max(change, obstacle_change)


def standing_controls(
    plan: Plan, obstacles: Obstacles | None, pinching: ParallelGrippers | None, grippers: Grippers, t: float
) -> ContactControls | None:
    """Return controls of contact with obstacles and pads at rest at their poses at time t [s]; None without contact."""
    if plan.contact is None:
        return None
    rows = None if obstacles is None else obstacles.standing_paths(t)
    gripper_paths = constant_paths(t, grippers.poses())
    return _contact_controls(plan.contact.force, rows, pinching, gripper_paths, t)


def _contact_controls(
    force: Contact,
    rows: Array | None,
    pinching: ParallelGrippers | None,
    gripper_paths: Array | None,
    t: float,
    is_away: NDArray[np.bool_] | None = None,
) -> ContactControls:
    """Build controls of contact, without recovery, from paths of obstacles and grippers; without any, the old ones."""
    if rows is None and pinching is None:
        return force.controls
    paths, commands, setpoints = [] if rows is None else [rows], force.controls.jaw_commands, None
    if pinching is not None and gripper_paths is not None:
        paths.append(pinching.pad_paths(gripper_paths))
        commands, setpoints = pinching.drive_flags(), pinching.setpoints
    return ContactControls(np.concatenate(paths), commands, ThicknessRecovery(t), setpoints, is_away)


def blocked_grippers(plan: Plan, grippers: Grippers, state: State, t: float, duration: float) -> list[int]:
    """Return the indices of the grippers whose paths in a frame press a prescribed particle into an obstacle.

    Such a particle does not yield, so its contact force would have no bound. A path is blocked if the particle comes
    closer to an obstacle than before, and closer than a tenth of the contact thickness.

    Args:
        plan: equations of motion, with the paths of the frame.
        grippers: the grippers.
        state: state at the start of the frame.
        t: time at its start [s].
        duration: its length [s].
    """
    if plan.contact is None or not plan.contact.count:
        return []
    candidates = grippers.prescribing_grippers()
    if not candidates:
        return []
    thickness = plan.contact.force.thickness
    min_gap = _MIN_GAP_FRACTION * thickness
    particles = np.concatenate([grippers.grasped_particles(g) for g in candidates])
    times = [t + k * duration / _PATH_SAMPLES for k in range(_PATH_SAMPLES + 1)]
    path = [_prescribed_positions(plan, state, time) for time in times]
    travel = max(largest_distance(positions, path[0]) for positions in path)
    ends = (_min_gap_of(plan, times[k], state, path[k][:, particles]) for k in (0, -1))
    if min(ends) > min_gap + travel:
        return []
    blocked = []
    for g in candidates:
        particles = grippers.grasped_particles(g)
        gaps = [
            _min_gap_of(plan, time, state, positions[:, particles]) for time, positions in zip(times, path, strict=True)
        ]
        if min(gaps) < min(min_gap, gaps[0] - _GAP_ROUNDING * thickness):
            blocked.append(g)
    return blocked


def _prescribed_positions(plan: Plan, state: State, t: float) -> Array:
    """Return a state's positions, with prescribed particles at their grippers' points at time t [s], (3, n) [m]."""
    positions, unused = state.x.copy(), state.v.copy()
    plan.prescribe(t, positions, unused)
    return positions


def _min_gap_of(plan: Plan, t: float, state: State, points: Array) -> float:
    """Return the least gap between some points (3, m) [m] and the obstacles at time t [s]."""
    assert plan.contact is not None
    is_free = plan.model.inverse_masses > 0.0
    # The engine measures free particles: each one is at one of the points.
    positions = np.repeat(points[:, :1], len(is_free), axis=1)
    positions[:, is_free] = points[:, np.arange(np.count_nonzero(is_free)) % points.shape[1]]
    return float(plan.contact.obstacle_gaps(t, positions, state.memory)[:, 1].min(initial=np.inf))


def stop_bodies(obstacles: Obstacles | None, grippers: Grippers) -> tuple[str, ...]:
    """Hold bodies that can crush the cloth at their poses until their next targets; return names of moving ones.

    They are obstacles, pinching grippers, and grippers that prescribe the motion of particles.

    Return the names of the bodies that moved.
    """
    return (*([] if obstacles is None else obstacles.hold_position()), *grippers.hold_position())


def frame_wrenches(
    accumulator: WorkAccumulator | None,
    plan: Plan,
    grippers: Grippers,
    pinching: ParallelGrippers | None,
    joints: ObstacleJoints | None,
) -> tuple[Array, Array]:
    """Return the cloth's mean wrenches in a frame on grippers and obstacles, (count, 6) each; 0 if not recorded."""
    wrenches = accumulator.wrenches if accumulator else np.zeros((plan.gripper_count, 6))
    obstacle_wrenches = accumulator.obstacle_wrenches if accumulator else np.zeros((plan.obstacle_count, 6))
    if joints is not None:
        wrenches, obstacle_wrenches = joints.move_wrenches(wrenches, obstacle_wrenches)
    return wrenches, obstacle_wrenches if pinching is None else pinching.move_pad_wrenches(obstacle_wrenches, wrenches)


def solids_and_poses(obstacles: Obstacles | None, pinching: ParallelGrippers | None) -> tuple[list[Obstacle], Array]:
    """Return bodies that can touch the cloth, obstacles, then pads of placed grippers, and their poses (count, 7).

    Returns:
        Bodies, and poses: position [m] and quaternion x, y, z, w, shape (count, 7).
    """
    solids = [] if obstacles is None else list(obstacles.solids)
    poses = np.zeros((0, 7)) if obstacles is None else obstacles.poses()
    if pinching is not None:
        placed_pads = pinching.placed_pads()
        solids += [pinching.boxes[k] for k in placed_pads]
        poses = np.concatenate([poses, pinching.poses()[placed_pads]])
    return solids, poses


def adapt_states(before: Scene, scene: Scene, states: Iterable[State]) -> None:
    """Adapt obstacles, joints, friction anchors and contact thickness in states' memories to another scene.

    A scene without friction of bending has no plastic lengths.
    """
    for state in states:
        if not scene.bending.friction_moment and PLASTIC_LENGTHS_KEY in state.memory:
            state.memory = {key: array for key, array in state.memory.items() if key != PLASTIC_LENGTHS_KEY}
        if before.obstacles != scene.obstacles:
            from cloth_sim_ros.simulation.bodies.obstacles import replace_obstacles

            replace_obstacles(state, before.obstacle_names, scene.obstacle_names, scene.described)
            if any(scene.cloth.joints):
                from cloth_sim_ros.simulation.bodies.joints import replace_joints

                replace_joints(state, before, scene)
        if ANCHORS_KEY in state.memory:
            memory = dict(state.memory)
            anchors = carry_over_anchors(memory.pop(ANCHORS_KEY), before, scene)
            state.memory = memory if anchors is None else {**memory, ANCHORS_KEY: anchors}
        if THICKNESS_KEY in state.memory:
            memory = dict(state.memory)
            thickness = carry_over_thickness(memory.pop(THICKNESS_KEY), before, scene)
            state.memory = memory if thickness is None else {**memory, THICKNESS_KEY: thickness}


def carry_over_thickness(thickness: Array, before: Scene, scene: Scene) -> Array | None:
    """Return the contact thickness [m] after a change of scene, a row per body; None if all contacts have the full one.

    New obstacles have the full thickness.
    """
    if scene.contact.thickness != before.contact.thickness:
        return None
    pads = [f"{name}.{jaw}" for name in scene.pinching for jaw in ("left", "right")]
    names = [*before.obstacle_names, *pads, ""]
    rows = [thickness[names.index(name)] if name in names else None for name in (*scene.obstacle_names, *pads, "")]
    full_thickness = np.full(thickness.shape[1], scene.contact.thickness)
    carried_over = np.array([full_thickness if row is None else row for row in rows])
    return carried_over if (carried_over < full_thickness).any() else None


def carry_over_anchors(anchors: Array, before: Scene, scene: Scene) -> Array | None:
    """Return the friction anchors after a change of scene, rows by body; None if no contact has friction.

    Remaining obstacles keep their anchors, and new ones have none. If friction returns later, anchors start empty.
    """
    pads = [f"{name}.{jaw}" for name in scene.pinching for jaw in ("left", "right")]
    has_friction = any(solid.friction[0] > 0.0 for solid in scene.solids) or (pads and scene.gripper.friction[0] > 0.0)
    has_layer_friction = scene.contact.self_ and scene.contact.friction[0] > 0.0
    if not (has_friction or has_layer_friction):
        return None
    # The set of pinching grippers never changes.
    old_names, new_names = [*before.obstacle_names, *pads], [*scene.obstacle_names, *pads]
    carried_over = np.zeros((len(new_names), *anchors.shape[1:]))
    for k, name in enumerate(new_names):
        if name in old_names:
            carried_over[k] = anchors[old_names.index(name)]
    if not has_layer_friction:
        return carried_over
    # Anchors of layers follow those of obstacles.
    layer_anchors = anchors[len(old_names) :]
    if not len(layer_anchors):
        layer_anchors = np.zeros((LAYER_SIDES, *anchors.shape[1:]))
    return np.concatenate([carried_over, layer_anchors])
