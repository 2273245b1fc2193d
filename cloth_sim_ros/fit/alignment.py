# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time offset and camera pose of recorded clouds: unknowns beside the parameters of the cloth.

A cloud with the stamp t shows the cloth at t - offset. A camera with a pose error shows the point x at
`R (x - pivot) + pivot + shift`. R is the rotation by a rotation vector.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.recording import FitRecording, visible_mask
from cloth_sim_ros.fit.trajectory import SimulatedMotion
from cloth_sim_ros.physics.model.forces.force import Array

#: Kinds of an unknown: fixed, one for all recordings, or one for each recording.
FIXED, SHARED, PER_RECORDING = "no", "shared", "each"
#: Largest time offset between clouds and gripper poses [s].
MAX_OFFSET = 0.6
#: Spacing of the time offsets that the search examines first [s].
_OFFSET_STEP = 0.04
#: Tolerance of a refined time offset [s].
_OFFSET_TOLERANCE = 1e-4
#: Steps of a robust registration of points.
_REGISTRATION_STEPS = 4
#: Standard deviations of the prior: time offset [s], rotation [rad] and shift [m] of the camera.
PRIOR_SIGMAS = (0.3, *(0.2,) * 3, *(0.3,) * 3)
#: Difference steps of the same unknowns.
_STEPS = (2e-3, *(1e-4,) * 3, *(1e-4,) * 3)


@attrs.frozen(kw_only=True)
class Alignment:
    """Time offset [s] and camera pose (rotation vector, shift) of one recording."""

    #: Delay of the clouds against the gripper poses [s].
    offset: float = 0.0
    #: Rotation vector of the camera's error [rad].
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0)
    #: Shift of the clouds at the pivot [m].
    shift: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def angle(self) -> float:
        """Angle of the camera's rotation [rad]."""
        return math.sqrt(sum(component * component for component in self.rotation))

    def to_camera(self, x: Array, pivot: Array) -> Array:
        """Return true points as the misplaced camera shows them [m], shape (..., 3). `pivot`: centre of rotation."""
        return (x - pivot) @ rotation_of(self.rotation).T + pivot + np.array(self.shift)

    def from_camera(self, x: Array, pivot: Array) -> Array:
        """Return the true positions of points as the camera shows them [m], the inverse of `to_camera`."""
        return (x - pivot - np.array(self.shift)) @ rotation_of(self.rotation) + pivot


def rotation_of(vector: Sequence[float]) -> Array:
    """Return the rotation matrix of a rotation vector [rad], shape (3, 3), by Rodrigues' formula."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + cross
    return np.eye(3) + math.sin(angle) / angle * cross + (1.0 - math.cos(angle)) / angle**2 * (cross @ cross)


def rotation_vector(matrix: Array) -> tuple[float, ...]:
    """Return the rotation vector [rad], 3 numbers, of a rotation matrix (3, 3), for angles below pi."""
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]) / 2.0
    sine, cosine = float(np.linalg.norm(axis)), (float(np.trace(matrix)) - 1.0) / 2.0
    return tuple((axis * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0)).tolist())


@attrs.frozen(kw_only=True)
class AlignmentModel:
    """Layout of the vector of unknown time offsets and camera poses of all recordings.

    Columns: the time offset, then rotation vector and shift of the camera; with `PER_RECORDING`, one after another.
    """

    n_recordings: int
    #: FIXED, SHARED or PER_RECORDING.
    time: str
    camera: str
    #: True if the camera's shift is unknown also where its rotation is fixed.
    has_shift: bool
    #: Centre of the camera's rotation [m].
    pivot: tuple[float, ...]

    @property
    def max_offset(self) -> float:
        """Largest time offset that the fit considers [s]; 0 if the offset is fixed."""
        return 0.0 if self.time == FIXED else MAX_OFFSET

    @property
    def is_common(self) -> bool:
        """True if all recordings have one alignment."""
        return PER_RECORDING not in (self.time, self.camera)

    @property
    def n_unknowns(self) -> int:
        """Length of the vector of unknowns."""
        return max((int(columns.max(initial=-1)) for columns in self._all_columns()), default=-1) + 1

    def _all_columns(self) -> list[NDArray[np.int64]]:
        return [self.columns(k)[1] for k in range(self.n_recordings)]

    def columns(self, index: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return two arrays: a recording's components (0 to 6), and their indices in the vector of all unknowns.

        Component 0 is the time offset, 1 to 3 are the rotation, 4 to 6 the shift.
        """
        components, places = list[int](), list[int]()
        n_time = {FIXED: 0, SHARED: 1, PER_RECORDING: self.n_recordings}[self.time]
        if n_time:
            components.append(0)
            places.append(index if self.time == PER_RECORDING else 0)
        first = 1 if self.camera != FIXED else 4
        if self.camera != FIXED or self.has_shift:
            width, block = 7 - first, index if self.camera == PER_RECORDING else 0
            components += range(first, 7)
            places += range(n_time + block * width, n_time + (block + 1) * width)
        return np.array(components, dtype=np.int64), np.array(places, dtype=np.int64)

    def prior_sigmas(self) -> Array:
        """Return the standard deviation of each unknown's prior, shape (unknowns,)."""
        sigmas = np.ones(self.n_unknowns)
        for k in range(self.n_recordings):
            components, places = self.columns(k)
            sigmas[places] = np.array(PRIOR_SIGMAS)[components]
        return sigmas

    def shared_mask(self) -> NDArray[np.bool_]:
        """Return a mask of the unknowns that several recordings share, shape (unknowns,)."""
        counts = np.zeros(self.n_unknowns, dtype=np.int64)
        for k in range(self.n_recordings):
            counts[self.columns(k)[1]] += 1
        return counts > 1

    def alignment(self, unknowns: Array, index: int) -> Alignment:
        """Return one recording's time offset and camera pose, read from the vector of all unknowns."""
        components, places = self.columns(index)
        numbers = np.zeros(7)
        numbers[components] = unknowns[places]
        return Alignment(offset=float(numbers[0]), rotation=tuple(numbers[1:4]), shift=tuple(numbers[4:]))

    def write_alignment(self, unknowns: Array, index: int, alignment: Alignment) -> None:
        """Write a recording's time offset and camera pose into the vector of all unknowns, in place."""
        components, places = self.columns(index)
        unknowns[places] = np.array([alignment.offset, *alignment.rotation, *alignment.shift])[components]

    def clamp(self, unknowns: Array, offsets: tuple[float, float]) -> Array:
        """Return a copy of the vector of unknowns with its time offsets clamped to (smallest, largest) [s]."""
        clamped = unknowns.copy()
        for k in range(self.n_recordings):
            components, places = self.columns(k)
            times = places[components == 0]
            clamped[times] = np.clip(clamped[times], *offsets)
        return clamped


def cloud_residuals(
    recording: FitRecording, trajectory: SimulatedMotion, alignment: Alignment, pivot: Array, clouds: NDArray[np.int64]
) -> list[Array]:
    """Return measured minus simulated points of some clouds [m], an array (n, 3), or (n, 1) of bare points, for each.

    A matched cloud gives a vector per visible particle, shape (n, 3). Bare points give distances, shape (n, 1).

    Args:
        recording: the clouds.
        trajectory: simulated motion.
        alignment: time offset and camera pose.
        pivot: centre of the camera's rotation [m], shape (3,).
        clouds: indices of the clouds.
    """
    scene = recording.scene
    frames = _frames_from(recording, trajectory)[clouds]
    x = trajectory.sample(frames - alignment.offset * scene.rate)
    if not recording.matched:
        from cloth_sim_ros.fit.surface import signed_distances

        triangles = scene.sheet.triangles()
        points = [alignment.from_camera(cloud[visible_mask(cloud)], pivot) for cloud in _selected(recording, clouds)]
        return [signed_distances(p, positions, triangles)[:, None] for p, positions in zip(points, x, strict=True)]
    shown = alignment.to_camera(x, pivot)
    return [
        cloud[visible_mask(cloud)] - positions[visible_mask(cloud)]
        for cloud, positions in zip(_selected(recording, clouds), shown, strict=True)
    ]


def alignment_derivatives(
    recording: FitRecording,
    trajectory: SimulatedMotion,
    alignment: Alignment,
    pivot: Array,
    clouds: NDArray[np.int64],
    components: Sequence[int],
) -> list[list[Array]]:
    """Return derivatives of `cloud_residuals` by components of time offset and camera pose, by component and cloud.

    Args:
        recording: the clouds.
        trajectory: simulated motion.
        alignment: time offset and camera pose.
        pivot: centre of the camera's rotation [m], shape (3,).
        clouds: indices of the clouds.
        components: the unknowns, numbered as by `AlignmentModel.columns`.
    """
    numbers = np.array([alignment.offset, *alignment.rotation, *alignment.shift])
    derivatives = []
    for component in components:
        sides = []
        for sign in (1.0, -1.0):
            moved = numbers.copy()
            moved[component] += sign * _STEPS[component]
            changed = Alignment(offset=float(moved[0]), rotation=tuple(moved[1:4]), shift=tuple(moved[4:]))
            sides.append(cloud_residuals(recording, trajectory, changed, pivot, clouds))
        derivatives.append([(a - b) / (2.0 * _STEPS[component]) for a, b in zip(*sides, strict=True)])
    return derivatives


def search_alignment(
    recordings: Sequence[FitRecording],
    trajectories: Sequence[SimulatedMotion],
    clouds: Sequence[NDArray[np.int64]],
    model: AlignmentModel,
    offsets: tuple[float, float],
    *,
    is_refined: bool = False,
) -> tuple[Alignment, float]:
    """Return the alignment that fits all given recordings best, by a grid of time offsets, and its mean distance [m].

    Each time offset on a grid has its best camera pose in closed form. The cost is the mean of the points' distances
    after it. Bare points give no pose: their mean distance from the surface decides on the offset alone.

    Args:
        recordings: the recordings.
        trajectories: simulated motion of each.
        clouds: indices of the clouds of each.
        model: the unknowns.
        offsets: smallest and largest time offset [s].
        is_refined: true to minimise the cost between the neighbours of the best time offset on the grid. A fit needs
            only the grid, because its least squares refine the offset.
    """
    from scipy.optimize import minimize_scalar

    def align(offset: float) -> tuple[float, Alignment]:
        return _align(recordings, trajectories, clouds, model, offset)

    grid = np.linspace(*offsets, round((offsets[1] - offsets[0]) / _OFFSET_STEP) + 1).tolist()
    cost, best = min((align(offset) for offset in grid), key=lambda result: result[0])
    if is_refined and len(grid) > 1:
        bounds = max(best.offset - _OFFSET_STEP, offsets[0]), min(best.offset + _OFFSET_STEP, offsets[1])
        # Costs near 1 at any unit and noise of the clouds.
        scale = cost or 1.0
        minimum = minimize_scalar(
            lambda offset: align(offset)[0] / scale,
            bounds=bounds,
            method="bounded",
            options={"xatol": _OFFSET_TOLERANCE},
        )
        cost, best = min((cost, best), align(float(minimum.x)), key=lambda result: result[0])
    return best, cost


def _align(
    recordings: Sequence[FitRecording],
    trajectories: Sequence[SimulatedMotion],
    clouds: Sequence[NDArray[np.int64]],
    model: AlignmentModel,
    offset: float,
) -> tuple[float, Alignment]:
    """Return the cost [m] and the alignment with a time offset [s], see `search_alignment`."""
    if not all(recording.matched for recording in recordings):
        alignment, pivot = Alignment(offset=offset), np.array(model.pivot)
        parts = [
            cloud_residuals(recording, trajectory, alignment, pivot, indices)
            for recording, trajectory, indices in zip(recordings, trajectories, clouds, strict=True)
        ]
        distances = np.concatenate([np.abs(r).ravel() for part in parts for r in part])
        return float(distances.mean()), alignment
    simulated, measured = [], []
    for recording, trajectory, indices in zip(recordings, trajectories, clouds, strict=True):
        frames = _frames_from(recording, trajectory)[indices] - offset * recording.scene.rate
        for cloud, x in zip(_selected(recording, indices), trajectory.sample(frames), strict=True):
            seen = visible_mask(cloud)
            simulated.append(x[seen])
            measured.append(cloud[seen])
    return _register(np.concatenate(simulated), np.concatenate(measured), offset, model)


def _register(x: Array, y: Array, offset: float, model: AlignmentModel) -> tuple[float, Alignment]:
    """Return (mean distance [m], alignment) after a robust rigid registration of points x to y."""
    pivot, weights = np.array(model.pivot), np.ones(len(x))
    turn, shift = np.eye(3), np.zeros(3)
    for _ in range(_REGISTRATION_STEPS):
        total = weights.sum()
        mean_x, mean_y = weights @ x / total, weights @ y / total
        if model.camera != FIXED:
            turn = _turn(x - mean_x, y - mean_y, weights, 1.0)
        if model.camera != FIXED or model.has_shift:
            shift = mean_y - pivot - turn @ (mean_x - pivot)
        distances = np.linalg.norm(y - ((x - pivot) @ turn.T + pivot + shift), axis=1)
        weights = _robust_weights(distances)
    alignment = Alignment(offset=offset, rotation=rotation_vector(turn), shift=tuple(shift.tolist()))
    return float(distances.mean()), alignment


def _turn(x: Array, y: Array, weights: Array, determinant: float) -> Array:
    """Return the orthogonal matrix (3, 3) of a determinant, 1 or -1, that turns centred points x to y best."""
    u, _, vt = np.linalg.svd((weights[:, None] * y).T @ x)
    turn: Array = u @ np.diag([1.0, 1.0, determinant * float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    return turn


def _robust_weights(distances: Array) -> Array:
    """Return the weights of points for the next step of a registration, which minimises the sum of distances [m]."""
    return np.asarray(1.0 / np.maximum(distances, 0.2 * float(np.median(distances)) + 1e-9))


def moved_points(x: Array, y: Array, determinant: float = 1.0) -> Array:
    """Return points x after the motion that brings them nearest to points y, (n, 3) each [m]; mirrored for -1."""
    weights, moved = np.ones(len(x)), x
    for _ in range(_REGISTRATION_STEPS):
        total = weights.sum()
        mean_x, mean_y = weights @ x / total, weights @ y / total
        moved = (x - mean_x) @ _turn(x - mean_x, y - mean_y, weights, determinant).T + mean_y
        weights = _robust_weights(np.linalg.norm(y - moved, axis=1))
    return moved


def _selected(recording: FitRecording, clouds: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    return [recording.clouds[k] for k in clouds]


def _frames_from(recording: FitRecording, trajectory: SimulatedMotion) -> NDArray[np.float64]:
    """Return the clouds' times as frame numbers of a trajectory, which may have omitted settling frames."""
    return recording.frames - (recording.n_settle_frames - trajectory.n_settle_frames)
