# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rest shapes of a hanging cloth: a bulging sheet may hang in several, and a noisy cloud shows the wrong one.

Several starting shapes come to rest. The shapes that differ are compared over the whole motion.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np

from cloth_sim_ros.fit.alignment import cloud_residuals, search_alignment
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
    flat = x - ((x - x[driven[0]]) @ normal)[:, None] * normal
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
    chosen, distances = dict.fromkeys(needed, 0), dict[int, float]()
    groups = [needed] if problem.alignment.is_common else [[k] for k in needed]
    for group in groups:
        if not group:
            continue
        for _ in range(3):
            alignment, _ = search_alignment(
                [problem.recordings[k] for k in group],
                [motions[k][chosen[k]][1] for k in group],
                [problem.used[k] for k in group],
                problem.alignment,
                problem.offsets,
            )
            best = {}
            for k in group:
                means = []
                for _, trajectory in motions[k]:
                    r = cloud_residuals(problem.recordings[k], trajectory, alignment, problem.pivot, problem.used[k])
                    means.append(float(np.concatenate([np.linalg.norm(part, axis=1) for part in r]).mean()))
                best[k] = int(np.argmin(means))
                distances[k] = min(means)
            if all(best[k] == chosen[k] for k in group):
                break
            chosen.update(best)
    for k in needed:
        problem.rest_states[k] = motions[k][chosen[k]][0]
    return distances
