# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rest shapes of a hanging cloth: a bulging sheet may hang in several, and a noisy cloud shows the wrong one.

Several starting shapes come to rest. The shapes that differ are compared over the whole motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import attrs
import numpy as np

from cloth_sim_ros.fit.alignment import Alignment, cloud_residuals, moved_points, search_alignment
from cloth_sim_ros.fit.joint import JointProblem
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recording import FitRecording
from cloth_sim_ros.fit.trajectory import SimulatedMotion, trajectory_run
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State

#: Depth of the tried bulges, and difference of two rest shapes [size of the sheet].
_BULGE, _DIFFERENCE = 0.1, 0.01


def starting_shapes(recording: FitRecording) -> list[State]:
    """Return the states from which a hanging cloth settles: the first cloud, and sheets that bulge to either side."""
    if recording.state is None or not recording.n_settle_frames or not recording.grasped:
        return [] if recording.state is None else [recording.state]
    scene, state = recording.scene, recording.state
    rest_shape, x = scene.sheet.positions(), state.positions
    driven = [particle for entry in recording.grasped for particle in entry.particles]
    line = x[driven[-1]] - x[driven[0]]
    gravity = np.array(scene.gravity, dtype=np.float64)
    normal = np.cross(line, gravity)
    if float(np.linalg.norm(normal)) < 1e-9:
        normal = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2][2]
    normal = normal / float(np.linalg.norm(normal))
    size = float(np.linalg.norm(np.ptp(rest_shape, axis=0))) / np.sqrt(2.0)
    distance = np.linalg.norm(rest_shape[:, None] - rest_shape[driven], axis=2).min(axis=1)
    bulge = _BULGE * size * np.sin(np.pi * np.clip(distance / max(float(distance.max()), 1e-12), 0.0, 1.0) * 0.75)
    # Of the rest shape: in the cloud points may be those of other particles.
    carried = moved_points(rest_shape, x)
    flat = carried - ((carried - x[driven[0]]) @ normal)[:, None] * normal
    states = [state]
    for sign in (1.0, -1.0):
        moved = state.copy()
        shape = flat + sign * bulge[:, None] * normal
        shape[driven] = x[driven]
        moved.x[:] = shape.T
        states.append(moved)
    return states


def settle(problem: JointProblem, theta: Array, selected: Sequence[int], tolerance: float) -> dict[int, list[State]]:
    """Let recorded cloths settle; return the different rest shapes by recording, that of the first cloud first."""
    jobs = [(k, state) for k in selected for state in starting_shapes(problem.recordings[k])]
    runs = []
    for k, state in jobs:
        recording = problem.recordings[k]
        n = recording.n_settle_frames
        short = attrs.evolve(recording, state=state, events=recording.events[:n], frames=np.array([float(n)]))
        runs.append(trajectory_run(short, problem.parameters, np.exp(theta).tolist(), tolerance=tolerance))
    results = problem.pool.simulate(runs)
    problem.on_progress(len(runs))
    shapes: dict[int, list[State]] = {k: [] for k in selected}
    for (k, _), result in zip(jobs, results, strict=True):
        if isinstance(result, str) or result.rest_state is None:
            continue
        size = float(np.ptp(problem.recordings[k].scene.sheet.positions(), axis=0).max())
        differences = [
            float(np.sqrt(np.square(result.rest_state.x - existing.x).sum(axis=0).mean())) for existing in shapes[k]
        ]
        if min(differences, default=np.inf) > _DIFFERENCE * size:
            shapes[k].append(result.rest_state)
    return shapes


def choose_rest_shapes(
    problem: JointProblem, theta: Array, selected: Sequence[int], tolerance: float
) -> dict[int, float]:
    """Store each recording's best rest shape in `problem.rest_states`; return mean distances [m]. Raises FitError.

    Args:
        problem: recordings and unknowns; their rest states are set.
        theta: logarithms of the parameters, shape (p,).
        selected: indices of the recordings.
        tolerance: tolerance of the simulations [m].

    Returns:
        Mean distance of the points of each recording from its simulated cloth [m].

    Raises:
        FitError: if a motion can't be simulated.
    """
    needed = [k for k in selected if problem.recordings[k].n_settle_frames and len(problem.used[k])]
    shapes = settle(problem, theta, needed, tolerance)
    jobs = [(k, state) for k in needed for state in shapes[k]]
    results = problem.simulate(
        [(k, theta) for k, _ in jobs],
        tolerance,
        rest_states=[state for _, state in jobs],
        are_at_rest=[True] * len(jobs),
    )
    motions: dict[int, list[tuple[State, SimulatedMotion]]] = {k: [] for k in needed}
    for (k, state), result in zip(jobs, results, strict=True):
        if not isinstance(result, str):
            motions[k].append((state, result))
    for k in needed:
        if not motions[k]:
            raise FitError(f"{problem.recordings[k].name}: the motion can't be simulated with the starting values")
    distances = dict[int, float]()
    for group in [needed] if problem.alignment.is_common else [[k] for k in needed]:
        for k, (shape, distance) in _best_shapes(problem, motions, group).items():
            problem.rest_states[k], distances[k] = motions[k][shape][0], distance
    return distances


def _best_shapes(
    problem: JointProblem, motions: dict[int, list[tuple[State, SimulatedMotion]]], group: Sequence[int]
) -> dict[int, tuple[int, float]]:
    """Return the index of the best rest shape, and the mean distance [m] of its points, of each recording of a group.

    The recordings share their alignment. An alignment with a wrong shape turns the camera until that shape fits best.
    So each shape is tried as the first one.
    """
    best = dict[int, tuple[int, float]]()
    for first in range(max((len(motions[k]) for k in group), default=0)):
        chosen = {k: (min(first, len(motions[k]) - 1), math.inf) for k in group}
        for _ in range(3):
            alignment, _ = search_alignment(
                [problem.recordings[k] for k in group],
                [motions[k][chosen[k][0]][1] for k in group],
                [problem.used[k] for k in group],
                problem.alignment,
                problem.offsets,
            )
            before, chosen = chosen, {k: _nearest_shape(problem, k, motions[k], alignment) for k in group}
            if all(chosen[k][0] == before[k][0] for k in group):
                break
        if not best or _total_distance(chosen) < _total_distance(best):
            best = chosen
    return best


def _nearest_shape(
    problem: JointProblem, index: int, motions: Sequence[tuple[State, SimulatedMotion]], alignment: Alignment
) -> tuple[int, float]:
    """Return the index of the rest shape whose motion is nearest to a recording's points, and its mean distance [m]."""
    means = []
    for _, trajectory in motions:
        r = cloud_residuals(problem.recordings[index], trajectory, alignment, problem.pivot, problem.used[index])
        means.append(float(np.concatenate([np.linalg.norm(part, axis=1) for part in r]).mean()))
    return int(np.argmin(means)), min(means)


def _total_distance(shapes: Mapping[int, tuple[int, float]]) -> float:
    """Return the sum of the mean distances [m] of a choice of rest shapes."""
    return sum(distance for _, distance in shapes.values())
