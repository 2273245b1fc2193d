# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings that contradict themselves: mirrored axes, exchanged particles, clocks too far apart."""

from __future__ import annotations

import math
from collections.abc import Sequence

import attrs
import numpy as np

from cloth_sim_ros.fit.alignment import MAX_OFFSET, cloud_residuals, moved_points
from cloth_sim_ros.fit.joint import JointProblem, Point
from cloth_sim_ros.fit.recording import visible_mask

#: Distance of mirrored points below which an axis points the other way [distance of the points as they are].
_MIRRORED = 0.5
#: Distance of a particle's points from another particle below which they are of that one [distance from its own].
_EXCHANGED = 0.5
#: Mean distance from its particle from which a point may be of another one [median of all particles].
_CANDIDATE = 3.0
#: Largest fraction of exchanged particles: with more of them the whole fit is wrong.
_MAX_EXCHANGED = 0.1
#: Distance of a time offset from its limit at which it is the limit [s].
_AT_LIMIT = 1e-3
_NAMED = 6


def contradiction(problem: JointProblem, point: Point, selected: Sequence[int]) -> str:
    """Return why recordings contradict themselves, with the remedy; empty if they do not.

    Args:
        problem: recordings and unknowns.
        point: result of a fit.
        selected: indices of the recordings that it used.
    """
    return (
        _mirrored_or_exchanged(problem, point, selected) if problem.recordings[selected[0]].matched else ""
    ) or _offset_at_limit(problem, point, selected)


def _offset_at_limit(problem: JointProblem, point: Point, selected: Sequence[int]) -> str:
    for k in selected:
        offset = problem.alignment.alignment(point.eta, k).offset
        if problem.alignment.max_offset and abs(offset) > problem.alignment.max_offset - _AT_LIMIT:
            return (
                f"the time offset of {problem.recordings[k].name} is at its limit, {offset:.3f} s: correct the stamps, "
                f"which may differ by {MAX_OFFSET:g} s from those of the gripper poses"
            )
    return ""


def _mirrored_or_exchanged(problem: JointProblem, point: Point, selected: Sequence[int]) -> str:
    masks = [visible_mask(problem.recordings[k].clouds[int(cloud)]) for k in selected for cloud in problem.used[k]]
    clouds = [problem.recordings[k].clouds[int(cloud)] for k in selected for cloud in problem.used[k]]
    measured = np.concatenate([cloud[mask] for mask, cloud in zip(masks, clouds, strict=True)])
    residuals = np.concatenate([residuals for part in point.residuals for residuals in part])
    if not len(measured):
        return ""
    distances = np.linalg.norm(residuals, axis=1)
    # The fitted time offset may hide the mirror.
    simulated = [measured - residuals]
    if problem.alignment.max_offset:
        simulated.append(measured - _residuals_in_time(problem, point, selected))
    mirrored = min(_moved_distance(x, measured, -1.0) for x in simulated)
    # A flat cloth equals its mirror image: its points may be off by a camera pose that is not fitted.
    as_they_are = min(float(distances.mean()), *(_moved_distance(x, measured, 1.0) for x in simulated))
    if mirrored < _MIRRORED * as_they_are:
        return (
            f"the points are {1e3 * mirrored:.2g} mm from the cloth if they are mirrored, and "
            f"{1e3 * as_they_are:.2g} mm as they are: an axis of the recording points the other way"
        )
    return _exchanged_particles(masks, clouds, [part for parts in point.residuals for part in parts])


def _moved_distance(x: np.ndarray, y: np.ndarray, determinant: float) -> float:
    """Return the mean distance [m] of points y from points x, (n, 3) each, moved to them; mirrored for -1."""
    return float(np.linalg.norm(y - moved_points(x, y, determinant), axis=1).mean())


def _residuals_in_time(problem: JointProblem, point: Point, selected: Sequence[int]) -> np.ndarray:
    """Return the residuals (points, 3) [m] without time offsets."""
    parts = []
    for k, trajectory in zip(selected, point.trajectories, strict=True):
        alignment = attrs.evolve(problem.alignment.alignment(point.eta, k), offset=0.0)
        parts += cloud_residuals(problem.recordings[k], trajectory, alignment, problem.pivot, problem.used[k])
    return np.concatenate(parts)


def _exchanged_particles(
    masks: Sequence[np.ndarray], clouds: Sequence[np.ndarray], residuals: Sequence[np.ndarray]
) -> str:
    """Return a sentence on particles whose points lie at each other; empty without any.

    Args:
        masks: visible particles of each cloud, shape (n,).
        clouds: points of each cloud [m], shape (n, 3).
        residuals: measured minus simulated visible points of each cloud [m].
    """
    count = len(masks[0])
    sums, n_seen = np.zeros(count), np.zeros(count)
    for mask, r in zip(masks, residuals, strict=True):
        sums[mask] += np.linalg.norm(r, axis=1)
        n_seen[mask] += 1
    to_itself = sums / np.maximum(n_seen, 1)
    candidates = np.flatnonzero(to_itself > _CANDIDATE * float(np.median(to_itself[n_seen > 0])))
    if not 0 < len(candidates) <= _MAX_EXCHANGED * count:
        return ""
    sums, n_seen = np.zeros((len(candidates),) * 2), np.zeros((len(candidates),) * 2)
    for mask, cloud, r in zip(masks, clouds, residuals, strict=True):
        rows = np.full(count, -1)
        rows[mask] = np.arange(len(r))
        seen = np.flatnonzero(rows[candidates] >= 0)
        measured = cloud[candidates[seen]]
        simulated = measured - r[rows[candidates[seen]]]
        sums[np.ix_(seen, seen)] += np.linalg.norm(measured[:, None] - simulated, axis=2)
        n_seen[np.ix_(seen, seen)] += 1
    # Mean distance of the points of particle i from the simulated particle j.
    means = np.where(n_seen > 0, sums / np.maximum(n_seen, 1), math.inf)
    is_other = means.min(axis=1) < _EXCHANGED * to_itself[candidates]
    exchanged = np.flatnonzero(is_other)
    if not len(exchanged) or sorted(means.argmin(axis=1)[exchanged].tolist()) != exchanged.tolist():
        return ""
    names = ", ".join(str(int(k)) for k in candidates[exchanged][:_NAMED]) + (
        ", ..." if len(exchanged) > _NAMED else ""
    )
    return f"the points of particles {names} lie at each other: correct their order in the recording"
