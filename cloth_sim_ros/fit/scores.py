# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a fitted cloth beside two yardsticks: the cloth carried rigidly, and the camera's error."""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.alignment import rotation_of
from cloth_sim_ros.fit.joint import JointProblem, Point
from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.fit.trajectory import SimulatedMotion
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import Target

#: Largest distance from a driven particle in the rest shape whose points count for the floor [particle spacings].
_FLOOR_REACH = 1.5


#: Root mean square of the points' distances above which the fit is in doubt: in a few motions [floor], and in all
#: motions [that of the rigid cloth].
MAX_MISFIT, _MAX_OF_RIGID = 2.0, 1.1


@attrs.frozen(eq=False, kw_only=True)
class Score:
    """Distances of measured points from a cloth [m], and their statistics."""

    #: All distances [m], shape (points,).
    distances: NDArray[np.float64]

    @property
    def median(self) -> float:
        """Median of the distances [m]; nan without points."""
        return float(np.median(self.distances)) if self.distances.size else float("nan")

    @property
    def quantile_95(self) -> float:
        """95 % quantile of the distances [m]; nan without points."""
        return float(np.quantile(self.distances, 0.95)) if self.distances.size else float("nan")

    @property
    def rms(self) -> float:
        """Root mean square of the distances [m]; nan without points."""
        return float(np.sqrt(np.square(self.distances).mean())) if self.distances.size else float("nan")


def score(distances: Sequence[Array]) -> Score:
    """Pool the distances of several clouds [m] in one score."""
    return Score(
        distances=np.concatenate([np.asarray(d).ravel() for d in distances]) if len(distances) else np.zeros(0)
    )


def gripper_positions(recording: FitRecording, frames: NDArray[np.float64], names: Sequence[str]) -> Array:
    """Return commanded positions of grippers at times counted in frames [m], shape (times, grippers, 3).

    Before its first target a gripper has that target's position. Each gripper needs a target.
    """
    positions = np.full((len(recording.events) + 1, len(names), 3), np.nan)
    for n, events in enumerate(recording.events):
        positions[n + 1] = positions[n]
        for event in events:
            if isinstance(event, Target) and event.gripper in names:
                positions[n + 1, names.index(event.gripper)] = event.position
    for k in range(len(names)):
        first = int(np.isfinite(positions[:, k, 0]).argmax())
        positions[:first, k] = positions[first, k]
    at = np.clip(frames, 0.0, len(positions) - 1.0)
    below = np.minimum(np.floor(at).astype(np.int64), len(positions) - 2)
    fraction = (at - below)[:, None, None]
    return np.asarray((1.0 - fraction) * positions[below] + fraction * positions[below + 1])


def rigid_distances(problem: JointProblem, index: int, trajectory: SimulatedMotion, eta: Array) -> list[Array]:
    """Return the distances of a recording's points [m] from the cloth at rest, carried rigidly by its grippers.

    The cloth moves with the mean of the grippers and turns with the line from the first one to the last one.
    """
    recording = problem.recordings[index]
    names = sorted({event.gripper for events in recording.events for event in events if isinstance(event, Target)})
    frames = recording.frames[problem.used[index]]
    alignment = problem.alignment.alignment(eta, index)
    at = frames - alignment.offset * recording.scene.rate
    positions = gripper_positions(recording, np.concatenate([[float(recording.n_settle_frames)], at]), names)
    rest_shape = trajectory.x[0]
    carried = (
        [
            (rest_shape - positions[0].mean(axis=0)) @ _turn_between(positions[0], position).T + position.mean(axis=0)
            for position in positions[1:]
        ]
        if names
        else [rest_shape] * len(at)
    )
    copies = SimulatedMotion(
        frames=np.arange(len(carried)),
        x=np.array(carried),
        v=np.zeros((len(carried), *rest_shape.shape)),
        period=trajectory.period,
        n_missed=0,
        n_settle_frames=0,
    )
    still = attrs.evolve(
        recording,
        frames=np.arange(len(carried), dtype=np.float64),
        n_settle_frames=0,
        clouds=tuple(recording.clouds[int(k)] for k in problem.used[index]),
    )
    from cloth_sim_ros.fit.alignment import cloud_residuals

    residuals = cloud_residuals(
        still, copies, attrs.evolve(alignment, offset=0.0), problem.pivot, np.arange(len(carried))
    )
    return [np.linalg.norm(r, axis=1) for r in residuals]


def _turn_between(before: Array, after: Array) -> Array:
    """Return the smallest rotation of the line through the first and the last gripper, shape (3, 3)."""
    a, b = before[-1] - before[0], after[-1] - after[0]
    lengths = float(np.linalg.norm(a)) * float(np.linalg.norm(b))
    if lengths == 0.0:
        return np.eye(3)
    axis, cosine = np.cross(a, b) / lengths, float(a @ b) / lengths
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return rotation_of((axis / sine * np.arctan2(sine, cosine)).tolist())


def driven_floors(problem: JointProblem, point: Point, selected: Sequence[int]) -> tuple[list[Score], str]:
    """Return the camera error in each recording as scores at the grasped and anchored particles, and its description.

    Driven particles are held by a gripper or anchored. If the camera never shows them, their neighbours count. The list
    is empty if the camera shows neither.
    """
    recording = problem.recordings[selected[0]]
    if not recording.matched:
        return [], "bare points show no particle"
    driven = sorted(
        {particle for entry in recording.grasped for particle in entry.particles}
        | {int(k) for k in recording.scene.anchored_particles()}
    )
    if not driven:
        return [], "no particle is driven"
    rest_shape = recording.scene.sheet.positions()
    distances = np.linalg.norm(rest_shape[:, None] - rest_shape[driven], axis=2).min(axis=1)
    spacing = float(np.partition(distances, len(driven))[len(driven)]) if len(rest_shape) > len(driven) else 0.0
    for reach, basis in ((0.0, "driven particles"), (_FLOOR_REACH * spacing, "neighbours of the driven particles")):
        chosen = distances <= reach + 1e-12
        floors = []
        for k, residuals in zip(selected, point.residuals, strict=True):
            masks = [visible_mask(problem.recordings[k].clouds[int(cloud)]) for cloud in problem.used[k]]
            floors.append(
                score([np.linalg.norm(r[chosen[seen]], axis=1) for seen, r in zip(masks, residuals, strict=True)])
            )
        if any(floor.distances.size for floor in floors):
            return floors, basis
    return [], "the camera shows neither driven particles nor their neighbours"


def pooled_score(scores: Sequence[Score]) -> Score | None:
    """Return the score of all distances together; None without any."""
    return score([entry.distances for entry in scores]) if scores else None


def misfit_doubt(models: Sequence[Score], floors: Sequence[Score], resolution: float) -> str:
    """Return why a fit of a few motions is in doubt, if its error is far above the floor; empty if it is not.

    For `MIN_MOTIONS` motions and more `excess_misfit` tells.

    Args:
        models: error of the cloth in each motion.
        floors: camera's error at the driven particles in each motion.
        resolution: error of the simulations [m]: clouds without noise have no floor above it.
    """
    from cloth_sim_ros.fit.clusters import MIN_MOTIONS

    model, floor = pooled_score(models), pooled_score(floors)
    if model is None or floor is None or len(models) >= MIN_MOTIONS:
        return ""
    if not model.rms > MAX_MISFIT * max(floor.rms, resolution):
        return ""
    return (
        f"the simulated cloth does not follow the recording. Its points are off by {1e3 * model.rms:.2g} mm rms, the "
        f"driven particles by {1e3 * floor.rms:.2g} mm. Begin elsewhere by --start, or end earlier by --until"
    )


def rigid_doubt(models: Sequence[Score], rigids: Sequence[Score]) -> str:
    """Return why a fit is in doubt, if a rigid cloth is nearer to the points than the fitted one; empty if it is not.

    Args:
        models: error of the cloth in each motion.
        rigids: error of the cloth carried rigidly, in each motion.
    """
    model, rigid = pooled_score(models), pooled_score(rigids)
    if model is None or rigid is None or not model.rms > _MAX_OF_RIGID * rigid.rms:
        return ""
    return (
        f"a cloth carried rigidly is nearer to the points, {1e3 * rigid.rms:.2g} mm rms, than the simulated one, "
        f"{1e3 * model.rms:.2g} mm. Check the axes and the order of the points, and the poses of the grippers"
    )


def excess_misfit(models: Sequence[Score], floors: Sequence[Score]) -> float | None:
    """Return the cloth's error beyond the floor, a root mean square [m]; None if chance explains it or motions are few.

    Each motion is one observation of the difference of the mean squares. None stands for a difference that chance would
    exceed in one of a hundred fits of a right model, or for fewer than `MIN_MOTIONS` motions.

    Args:
        models: error of the cloth in each motion.
        floors: camera's error at the driven particles in each motion.
    """
    from scipy.stats import t

    from cloth_sim_ros.fit.clusters import MIN_MOTIONS

    pairs = [(m.rms, f.rms) for m, f in zip(models, floors, strict=True) if m.distances.size and f.distances.size]
    if len(pairs) < MIN_MOTIONS:
        return None
    differences = np.array([model**2 - floor**2 for model, floor in pairs])
    mean, deviation = float(differences.mean()), float(differences.std(ddof=1)) / np.sqrt(len(pairs))
    return float(np.sqrt(mean)) if mean > t.ppf(0.99, len(pairs) - 1) * deviation else None
