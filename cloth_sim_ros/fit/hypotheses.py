# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of grasped particles, scored by the whole motion of several recordings.

Late clouds and a turned camera hide which particle a gripper holds. Each plausible combination is simulated. Time
offset and camera pose are fitted for each, and the points' mean distance decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import attrs
import numpy as np

from cloth_sim_ros.fit.alignment import AlignmentModel
from cloth_sim_ros.fit.grasped import GraspedParticles, extrapolate_cloud, particles_within
from cloth_sim_ros.fit.joint import JointProblem
from cloth_sim_ros.fit.parameters import FitError, FitParameter
from cloth_sim_ros.fit.recorded import Recording
from cloth_sim_ros.fit.rest_shapes import choose_rest_shapes
from cloth_sim_ros.fit.screening import screen_clouds
from cloth_sim_ros.fit.start import closed_grippers, motion_recording, start_time
from cloth_sim_ros.fit.trajectory import TrajectoryPool
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene

#: Largest distance of a plausible particle from the gripper in the clouds, beside the gripper's radius [m]. A camera
#: that is turned by 5 degrees at a distance of 1 m shifts a cloud by 0.09 m.
PLAUSIBLE_DISTANCE = 0.1
#: Standard deviations by which plausible combinations are ranked: shift of the whole cloud [m], and change of the
#: distances between the grippers [m].
_SHIFT_SIGMA, _DISTANCE_SIGMA = 0.05, 0.012
#: Numbers of simulated combinations and of their recordings, from round to round.
ROUNDS = ((16, 2), (4, 6))
#: Largest number of combinations that are ranked.
_MAX_COMBINATIONS = 4096
#: Tolerance of the simulations [m].
_TOLERANCE = 1e-3
#: Least t value, over recordings, and least relative difference between the best combination and the next one.
_MIN_T, _MIN_DIFFERENCE = 2.0, 0.01


@attrs.frozen(kw_only=True, eq=False)
class Hypothesis:
    """Combination of particles that the grippers may hold, with its distance from the clouds of each recording."""

    #: Particles by gripper; the first one is at the gripper's origin.
    particles: Mapping[str, tuple[int, ...]]
    #: Mean distance of the points from the simulated cloth [m], by recording; empty if it was not simulated.
    distances: Mapping[int, float]

    @property
    def score(self) -> float:
        """Mean distance from the clouds of all recordings [m]; infinite if it was not simulated."""
        return float(np.mean(list(self.distances.values()))) if self.distances else math.inf


@attrs.frozen(kw_only=True, eq=False)
class GraspChoice:
    """Most likely combination of grasped particles, and the alternatives."""

    #: Combinations, the best one first.
    hypotheses: tuple[Hypothesis, ...]
    #: True if the user named the particles of each gripper.
    is_named: bool
    #: Name of each gripper that holds particles.
    grippers: tuple[str, ...]
    #: True if the choice was repeated with fitted parameters.
    is_final: bool = False

    @property
    def best(self) -> Hypothesis:
        """The chosen combination, the first of `hypotheses`."""
        return self.hypotheses[0]

    @property
    def is_tie(self) -> bool:
        """True if the next combination explains the motions nearly as well as the chosen one."""
        if len(self.hypotheses) < 2 or not self.hypotheses[1].distances:
            return False
        best, following = self.hypotheses[:2]
        common = [k for k in best.distances if k in following.distances]
        differences = np.array([following.distances[k] - best.distances[k] for k in common])
        if differences.mean() < _MIN_DIFFERENCE * best.score:
            return True
        if len(differences) < 3:
            return False
        error = float(differences.std(ddof=1)) / math.sqrt(len(differences))
        return bool(differences.mean() < _MIN_T * error)

    def selections(self) -> list[GraspedParticles]:
        """Return the chosen particles of each gripper."""
        return selections(self.best.particles, is_named=self.is_named)


def selections(particles: Mapping[str, tuple[int, ...]], *, is_named: bool = False) -> list[GraspedParticles]:
    """Return a `GraspedParticles` for each gripper from particles by gripper, without distances."""
    return [
        GraspedParticles(
            gripper=name,
            particles=entries,
            distance=0.0,
            neighbour=None,
            neighbour_distance=math.inf,
            is_seen=False,
            is_named=is_named,
        )
        for name, entries in particles.items()
    ]


def plausible_particles(
    recordings: Sequence[Recording], scene: Scene, named: Mapping[str, tuple[int, ...]], max_offset: float
) -> list[dict[str, tuple[int, ...]]]:
    """Return combinations of particles (by gripper) that the first clouds allow, the likeliest first. Raises FitError.

    A particle is plausible if it is near the gripper in the first clouds, wherever a poor camera pose puts them. The
    distances between the grippers rank the combinations.

    Raises:
        FitError: if no particle is near a gripper.
    """
    first = recordings[0]
    start = start_time(first, scene, max_offset)
    names = closed_grippers(scene, first.grippers, start, named)
    if not names:
        return [{}]
    rest_shape, radius = scene.sheet.positions(), scene.gripper.radius
    shapes, grippers = [], []
    for recording in recordings:
        cloud = recording.clouds[0]
        if len(cloud) == len(rest_shape) and np.isfinite(cloud).all(axis=1).sum() >= 4:
            shapes.append(extrapolate_cloud(rest_shape, cloud))
            begin = start_time(recording, scene, max_offset)
            grippers.append([recording.grippers[name].pose_at(begin)[0] for name in names])
    if not shapes:
        return [{name: named[name] for name in names}] if all(name in named for name in names) else [{}]
    # Vectors from the grippers to all particles, the median of the recordings: shape (grippers, particles, 3).
    offsets = np.median(np.array(shapes)[:, None] - np.array(grippers)[:, :, None], axis=0)
    candidates = []
    for g, name in enumerate(names):
        distances = np.linalg.norm(offsets[g], axis=1)
        nearby = np.flatnonzero(distances <= radius + PLAUSIBLE_DISTANCE)
        if name in named:
            nearby = np.array([named[name][0]])
        if not nearby.size:
            raise FitError(
                f"gripper '{name}' is {1e3 * distances.min():.0f} mm from the nearest particle, "
                f"{int(distances.argmin())}: its poses do not touch the cloth. Give the fingertips' poses, in the "
                f"clouds' frame and by their clock. Name the particles: --held {name}={int(distances.argmin())}"
            )
        candidates.append(nearby.tolist())
    ranked = _ranked_combinations(offsets, candidates)
    if not ranked:
        raise FitError(
            f"grippers {', '.join(names)} are near the same particle alone; name the particles of each by --held"
        )
    return [
        {
            name: named.get(name, particles_within(rest_shape, particle, radius))
            for name, particle in zip(names, combination, strict=True)
        }
        for combination in ranked[: ROUNDS[0][0]]
    ]


def _ranked_combinations(offsets: Array, candidates: Sequence[Sequence[int]]) -> list[tuple[int, ...]]:
    """Return combinations of different particles, the most plausible first; at most `_MAX_COMBINATIONS`.

    Grippers are added in turn. Of the combinations so far, those with the lowest bounds of their scores go on.
    """
    count = len(candidates)
    chosen = np.empty((1, 0), dtype=np.int64)
    sums, squares = np.zeros((1, 3)), np.zeros(1)
    for g, nearby in enumerate(candidates):
        vectors = offsets[g, nearby]
        sums = (sums[:, None] + vectors).reshape(-1, 3)
        squares = (squares[:, None] + np.square(vectors).sum(axis=1)).ravel()
        chosen = np.column_stack([np.repeat(chosen, len(nearby), axis=0), np.tile(nearby, len(chosen))])
        # The lowest score for any offsets of the grippers to come: they follow the mean, drawn a little to zero.
        n, missing = g + 1, (count - g - 1) / count
        shift, distance = 1.0 / _SHIFT_SIGMA**2, n / (2.0 * _DISTANCE_SIGMA) ** 2
        means = np.square(sums / n).sum(axis=1)
        bounds = means * shift * distance / (distance + shift * missing) + (squares / n - means) * distance
        bounds[(chosen[:, :-1] == chosen[:, -1:]).any(axis=1)] = np.inf
        order = np.argsort(bounds, kind="stable")[:_MAX_COMBINATIONS]
        order = np.sort(order[np.isfinite(bounds[order])])
        chosen, sums, squares = chosen[order], sums[order], squares[order]
    combinations = [tuple(row) for row in chosen.tolist()]
    return sorted(combinations, key=lambda combination: _implausibility(offsets, combination))


def _implausibility(offsets: Array, combination: Sequence[int]) -> float:
    """Return a score, small if the particles' offsets from their grippers are small and alike."""
    vectors = np.array([offsets[g, particle] for g, particle in enumerate(combination)])
    shift = vectors.mean(axis=0)
    # Grippers' distances change by the components of the deviations along their line; a rotation changes the others.
    squares = float(np.square(shift / _SHIFT_SIGMA).sum())
    return squares + float(np.square((vectors - shift) / (2.0 * _DISTANCE_SIGMA)).sum())


def score_hypotheses(
    recordings: Sequence[Recording],
    scene: Scene,
    combinations: Sequence[Mapping[str, tuple[int, ...]]],
    parameters: Sequence[FitParameter],
    *,
    values: Sequence[float],
    selected: Sequence[int],
    variations: tuple[str, str],
    settle_time: float,
    pool: TrajectoryPool,
    on_progress: Callable[[int], None] = lambda _runs: None,
) -> list[Hypothesis]:
    """Simulate combinations of grasped particles; return them with their distances from the clouds, the best first.

    Args:
        recordings: clouds and gripper poses.
        scene: the cloth and its grippers.
        combinations: particles by gripper.
        parameters: the fit's parameters.
        values: their values, in their units.
        selected: indices of the compared recordings.
        variations: variation of the time offset and of the camera pose between recordings, see `AlignmentModel`.
        settle_time: settling time [s].
        pool: processes of the simulations.
        on_progress: called with the number of simulations since the last call.
    """
    results = []
    for particles in combinations:
        model = AlignmentModel(
            n_recordings=len(selected),
            time=variations[0],
            camera=variations[1],
            has_shift=True,
            pivot=pivot_of(recordings),
        )
        prepared = [
            motion_recording(
                recordings[k], scene, selections(particles), settle_time=settle_time, max_offset=model.max_offset
            )
            for k in selected
        ]
        problem = JointProblem(
            recordings=prepared,
            used=list(screen_clouds(prepared).used),
            parameters=parameters,
            alignment=model,
            pool=pool,
            on_progress=on_progress,
        )
        try:
            distances = choose_rest_shapes(problem, np.log(values), range(len(selected)), _TOLERANCE)
        except FitError:
            # This combination can't be simulated.
            distances = {}
        results.append(Hypothesis(particles=particles, distances={selected[k]: mean for k, mean in distances.items()}))
    return sorted(results, key=lambda hypothesis: hypothesis.score)


def pivot_of(recordings: Sequence[Recording]) -> tuple[float, ...]:
    """Return the centre of the camera's rotation [m]: the median of the points of all first clouds."""
    points = [cloud[np.isfinite(cloud).all(axis=1)] for recording in recordings for cloud in recording.clouds[:1]]
    seen = np.concatenate(points)
    return tuple(np.median(seen, axis=0).tolist()) if len(seen) else (0.0, 0.0, 0.0)
