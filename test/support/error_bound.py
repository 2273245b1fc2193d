# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of scenes, and their error against an independent integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import integrate_intervals
from cloth_sim_ros.verify.reference_motion import Equations, FrameCapture, ReferenceMotion, SimulatedFrame

#: Parameters of a scene of raw springs without air.
SPRINGS = {
    "cloth.springs": "springs.yaml",
    "cloth.anchors": ["0"],
    "cloth.size": [1.0, 1e-6],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "bending.model": "none",
    "air.drag": 0.0,
    "wind.normal_drag": 0.0,
    "grippers": [""],
}


def unflagged_frames(
    scene: Scene, count: int, events: Mapping[int, Sequence[Event]], velocities: Array | None = None
) -> list[SimulatedFrame]:
    """Return a number of frames, with events by frame and velocities [m/s] at the start; no frame may be flagged."""
    simulation, capture, frames = Simulation(scene), FrameCapture(), list[SimulatedFrame]()
    if velocities is not None:
        simulation.state.v[:] = velocities
    for k in range(count):
        before = simulation.state.shallow_copy()
        done = simulation.advance(events.get(k, ()))
        simulated = capture.capture(simulation, simulation.scene, before, done)
        assert simulated is not None
        assert not simulated.flagged
        frames.append(simulated)
    return frames


def error_of_frames(frames: list[SimulatedFrame], steps: tuple[int, int], max_reference_error: float) -> float:
    """Return the largest error of positions [m] against a run from the first frame's start, checked by another."""
    equations = Equations()

    def integrate(count: int) -> list[Array]:
        motion, positions = ReferenceMotion(frames[0].before), list[Array]()
        for frame in frames:
            motion.apply_grasps(frame)
            plan = equations.plan(frame, motion)
            motion.state = integrate_intervals(plan, frame.t, [frame.duration], motion.state, (count,))
            positions.append(motion.x)
        return positions

    exact, check = map(integrate, steps)
    assert max(largest_distance(a, b) for a, b in zip(exact, check, strict=True)) <= max_reference_error
    return max(largest_distance(frame.after.x, x) for frame, x in zip(frames, exact, strict=True))


def error_by_evaluations(frames: list[SimulatedFrame]) -> float:
    """Return the largest error of positions [m] by DOP853, which evaluates forces alone and leaves out no contact."""
    equations, motion, error = Equations(), ReferenceMotion(frames[0].before), 0.0
    for frame in frames:
        motion.apply_grasps(frame)
        plan = equations.plan(frame, motion)
        tolerances = {"relative_tolerance": 1e-11, "absolute_tolerance": 1e-12}
        motion.state = dop853(plan, frame.t, frame.duration, motion.state, **tolerances)
        error = max(error, largest_distance(frame.after.x, motion.x))
    return error
