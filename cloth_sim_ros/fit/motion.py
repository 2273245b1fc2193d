# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Test of a recording for rest at its first cloud.

A fit to a real cloth's clouds starts from rest. A recording that starts in motion is refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.physics.model.forces.force import Array

#: Length of the examined beginning [s], and the least number of its clouds.
SPAN, MIN_CLOUDS = 0.27, 7
#: Significance level: probability that a cloth at rest is reported as moving.
_SIGNIFICANCE = 1e-4
#: Largest gripper speed at the first cloud [m/s].
_MAX_GRIPPER_SPEED = 0.02
#: Largest displacement of a gripper that stands still [m].
_STILL_DISTANCE = 1e-3
#: Powers of time at the onset of motion: a cloth at rest has neither velocity nor acceleration.
_ONSET_POWERS = (3, 4, 5)
#: Least displacement of a moving cloth within the span [standard deviations of the residuals].
_MIN_TRAVEL_SIGMAS = 2.0
#: Largest gripper velocity that noise explains [standard deviations].
_SPEED_DEVIATIONS = 4.0
#: Number of clouds that are tested as the start of a rest period.
_MAX_STARTS = 200


@attrs.frozen(kw_only=True, eq=False)
class GripperPath:
    """Recorded positions of a gripper over the time since a start."""

    #: Times since the first cloud [s], ascending, shape (n,).
    times: NDArray[np.float64]
    #: Positions [m], shape (n, 3).
    positions: Array

    def position_at(self, seconds: float) -> Array:
        """Return the position at a time [s] as an array [m], shape (3,): linear between poses, constant outside."""
        return np.array([np.interp(seconds, self.times, column) for column in self.positions.T])

    @property
    def noise(self) -> float:
        """Standard deviation of the noise of a coordinate [m], by third differences near the first cloud."""
        early = self.positions[np.abs(self.times) <= 2.0 * SPAN]
        third = np.diff(early, n=3, axis=0)
        # The third difference of independent numbers with variance 1 has the variance 1 + 9 + 9 + 1.
        return float(np.sqrt(np.square(third).mean() / 20.0)) if len(third) else 0.0


@attrs.frozen(kw_only=True)
class _Velocity:
    """Velocity of the cloth at a cloud, with the largest one that noise explains [m/s]."""

    #: Root mean square over the particles, and its standard deviation from noise [m/s].
    speed: float
    error: float
    #: True if noise alone explains the velocity.
    is_noise: bool


def check_rest(
    clouds: Sequence[Array], seconds: NDArray[np.float64], rest_shape: Array, paths: Mapping[str, GripperPath]
) -> None:
    """Raise FitError if a recording begins while the cloth or a closed gripper moves.

    Args:
        clouds: matched clouds [m], shape (n, 3) each; empty for bare points, which show no velocity.
        seconds: time of each cloud since the first one [s], shape (clouds,).
        rest_shape: particle positions in the rest shape [m], shape (n, 3).
        paths: paths of the closed grippers, by name.

    Raises:
        FitError: if the cloth or a gripper moves; the text names the velocity and the remedy.
    """
    try:
        check_grippers_rest(paths)
    except FitError as error:
        raise FitError(f"{error}. {_remedy(clouds, seconds, rest_shape, paths)}") from None
    if paths and not any(_is_moving(path, 0.0) for path in paths.values()):
        velocity = _test_velocity(clouds, seconds, 0, rest_shape, (1, 2, *_ONSET_POWERS))
        if velocity is not None and not velocity.is_noise:
            raise FitError(
                f"the cloth moves in the first {SPAN} s though its grippers stand still, and the fit starts from a "
                f"cloth at rest. {_remedy(clouds, seconds, rest_shape, paths)}"
            )
    velocity = _test_velocity(clouds, seconds, 0, rest_shape, (1,))
    if velocity is not None and not velocity.is_noise:
        raise FitError(
            f"the cloth moves at {1e3 * velocity.speed:.0f} mm/s at the first cloud (noise explains "
            f"{1e3 * velocity.error:.0f} mm/s), and the fit starts from a cloth at rest. "
            f"{_remedy(clouds, seconds, rest_shape, paths)}"
        )


def check_grippers_rest(paths: Mapping[str, GripperPath]) -> None:
    """Raise FitError, with the speed, if a gripper moves at time 0 of its path.

    Raises:
        FitError: if a gripper moves; the text names its speed.
    """
    for name, path in paths.items():
        speed = moving_speed(path)
        if speed:
            raise FitError(
                f"gripper '{name}' moves at {1e3 * speed:.0f} mm/s at the first cloud, and the fit starts from a cloth "
                "at rest"
            )


def moving_speed(path: GripperPath) -> float:
    """Return the speed of a gripper at time 0 of its path [m/s]; 0 if it stands still, or noise explains its speed."""
    speed, speed_bound = _gripper_speed(path)
    return speed if speed > max(_MAX_GRIPPER_SPEED, speed_bound) else 0.0


def _remedy(
    clouds: Sequence[Array], seconds: NDArray[np.float64], rest_shape: Array, paths: Mapping[str, GripperPath]
) -> str:
    advice = "Begin the recording before the robot moves"
    for first in range(1, min(len(clouds), _MAX_STARTS)):
        start = float(seconds[first])
        if any(_is_moving(path, start) for path in paths.values()):
            continue
        velocity = _test_velocity(clouds, seconds, first, rest_shape, (1, 2, *_ONSET_POWERS))
        if velocity is not None and velocity.is_noise:
            return f"{advice}, or start when the cloth hangs still: --from {start:.2f}"
    return f"{advice}: in this recording the cloth never hangs still for {SPAN} s"


def _gripper_speed(path: GripperPath) -> tuple[float, float]:
    """Return the gripper's speed at the first cloud, and the largest speed that noise explains [m/s].

    Speeds before and after the cloud are computed separately, because the acceleration may begin there.
    """
    step = max(0.02, float(np.median(np.diff(path.times))) if len(path.times) > 1 else 0.0)
    start, middle, end = (path.position_at(fraction * step) for fraction in (0.0, 1.0, 2.0))
    after = (4.0 * middle - end - 3.0 * start) / (2.0 * step)
    # The path is constant before its first pose.
    before = (start - path.position_at(-step)) / step
    error = _SPEED_DEVIATIONS * path.noise * math.sqrt(4.0**2 + 1.0 + 3.0**2) / (2.0 * step)
    return float(max(np.linalg.norm(after), np.linalg.norm(before))), error


def _is_moving(path: GripperPath, start: float) -> bool:
    """Return true if a gripper moves near a time [s]: from half a span before it to one span after it."""
    origin, fractions = path.position_at(start), (-0.5, 0.25, 0.5, 0.75, 1.0)
    travel = max(float(np.linalg.norm(path.position_at(start + fraction * SPAN) - origin)) for fraction in fractions)
    return travel > max(_STILL_DISTANCE, 5.0 * path.noise)


def _test_velocity(
    clouds: Sequence[Array], seconds: NDArray[np.float64], first: int, rest_shape: Array, tested_powers: Sequence[int]
) -> _Velocity | None:
    """Return the cloth's velocity after a cloud, and True if noise explains it; None if there are too few clouds.

    Each coordinate's displacement is a polynomial of time with coefficients that are linear in the rest shape. Particle
    positions at the first cloud are free.

    Args:
        clouds: matched clouds [m], shape (n, 3) each.
        seconds: time of each cloud [s], shape (clouds,).
        first: index of the first examined cloud.
        rest_shape: particle positions in the rest shape [m], shape (n, 3).
        tested_powers: powers of time that are tested; the first one gives the velocity.
    """
    from scipy.stats import chi2

    last = int(np.searchsorted(seconds, seconds[first] + SPAN + 1e-9, side="right")) if len(seconds) else 0
    last = max(last, min(first + MIN_CLOUDS + 1, len(seconds)))
    used = [k for k in range(first, last) if len(clouds) > k and len(clouds[k]) == len(rest_shape)]
    if len(used) < MIN_CLOUDS or seconds[used[-1]] - seconds[first] > 1.0:
        return None
    stack = np.array([clouds[k] for k in used])
    times = np.array([seconds[k] - seconds[first] for k in used])
    span = float(times[-1])
    seen = np.isfinite(stack).all(axis=2)
    modes = _linear_modes(rest_shape)
    powers = [*tested_powers, *(power for power in _ONSET_POWERS if power not in tested_powers)]
    in_time = [np.power(times / span, power) for power in powers]
    count, coefficients = modes.shape[1], []
    statistic, squares, n_free, blocks = 0.0, 0.0, 0, []
    for axis in range(3):
        design = np.concatenate([column[:, None, None] * modes[None] for column in in_time], axis=2)
        matrix, values = _centre_rows(design, stack[..., axis], seen)
        inverse = np.linalg.pinv(matrix.T @ matrix, rcond=1e-10)
        solution = inverse @ (matrix.T @ values)
        squares += float(np.square(values - matrix @ solution).sum())
        n_free += len(values) - int((seen.sum(axis=0) > 0).sum()) - matrix.shape[1]
        n_tested = len(tested_powers) * count
        coefficients.append(solution[:n_tested])
        blocks.append(inverse[:n_tested, :n_tested])
        tested = solution[:n_tested]
        statistic += float(tested @ np.linalg.pinv(inverse[:n_tested, :n_tested], rcond=1e-10) @ tested)
    if n_free < 30:
        return None
    variance = squares / n_free
    velocities = np.array([modes @ block[:count] for block in coefficients]) / span
    errors = sum(variance * np.einsum("im,mk,ik->i", modes, block[:count, :count], modes) for block in blocks) / span**2
    speed = float(np.sqrt(np.square(velocities).sum(axis=0).mean()))
    # A displacement below the residuals of this model may be an error of the model.
    is_small = tuple(tested_powers) == (1,) and speed * span < _MIN_TRAVEL_SIGMAS * float(np.sqrt(3.0 * variance))
    is_likely = chi2.sf(statistic / max(variance, 1e-18), 3 * len(tested_powers) * count) > _SIGNIFICANCE
    return _Velocity(speed=speed, error=float(np.sqrt(np.mean(errors))), is_noise=bool(is_small or is_likely))


def _linear_modes(rest_shape: Array) -> Array:
    """Return linear functions over the sheet, a constant and both in-plane coordinates from -1 to 1, shape (n, 3)."""
    centred = rest_shape - rest_shape.mean(axis=0)
    plane_coordinates = centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
    size = max(float(np.abs(plane_coordinates).max()), 1e-12)
    return np.column_stack([np.ones(len(rest_shape)), plane_coordinates / size])


def _centre_rows(design: Array, values: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return rows of visible particles minus each particle's mean over time, because its position is free."""
    counts = np.maximum(seen.sum(axis=0), 1)
    shown = np.where(seen[..., None], design, 0.0)
    shown = shown - (shown.sum(axis=0) / counts[:, None])[None]
    measured = np.where(seen, values, 0.0)
    measured = measured - (measured.sum(axis=0) / counts)[None]
    return shown[seen], measured[seen]
