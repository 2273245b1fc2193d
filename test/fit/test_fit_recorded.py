# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded poses of a gripper between their times."""

from __future__ import annotations

import numpy as np
import pytest

from cloth_sim_ros.fit.recorded import RecordedGripper

LEVEL = [0.0, 0.0, 0.0, 1.0]


def positions_at(times: np.ndarray) -> np.ndarray:
    """A swing at up to 0.8 m/s, shape (times, 3) [m]."""
    return np.stack([0.08 * np.sin(10.0 * times), 0.05 * np.cos(8.0 * times), 0.1 * times], axis=-1)


def orientation(times: np.ndarray) -> np.ndarray:
    """Turns about x by up to 0.4 rad, shape (times, 4)."""
    half, zero = 0.2 * np.sin(6.0 * times), 0.0 * times
    return np.stack([np.sin(half), zero, zero, np.cos(half)], axis=-1)


def track(times: np.ndarray) -> RecordedGripper:
    turns = orientation(times)
    # A quaternion and its negative are one rotation.
    turns[::2] *= -1.0
    return RecordedGripper(times=times, positions=positions_at(times), quaternions=turns)


def test_poses_at_50_hz_follow_a_smooth_swing() -> None:
    gripper, times = track(np.arange(0.0, 2.0, 0.02)), np.random.default_rng(1).uniform(0.04, 1.94, 300)
    poses = [gripper.pose_at(time) for time in times.tolist()]
    errors = np.linalg.norm(np.array([position for position, _ in poses]) - positions_at(times), axis=1)
    # Straight lines miss by an eighth of the acceleration times the squared interval: 0.4 mm.
    assert errors.max() < 2e-5
    likeness = np.abs((np.array([turn for _, turn in poses]) * orientation(times)).sum(axis=1))
    assert likeness.min() > 1.0 - 1e-9


def test_uneven_poses_give_half_the_error_of_lines() -> None:
    random = np.random.default_rng(2)
    stamps = np.cumsum(0.02 * random.uniform(0.6, 1.4, 100))
    times = random.uniform(stamps[1], stamps[-2], 300)
    gripper = track(stamps)
    errors = np.array([gripper.pose_at(time)[0] for time in times.tolist()]) - positions_at(times)
    lines = np.stack([np.interp(times, stamps, column) for column in gripper.positions.T], axis=-1) - positions_at(
        times
    )
    assert np.linalg.norm(errors, axis=1).mean() < 0.5 * np.linalg.norm(lines, axis=1).mean()


def test_gripper_is_straight_in_gaps_and_still_outside() -> None:
    times, x = [0.0, 0.02, 5.0, 5.02, 5.02, 5.04], [0.0, 0.1, 0.1, 0.2, 0.2, 0.3]
    gripper = RecordedGripper(
        times=times, positions=[[coordinate, 0.0, 1.0] for coordinate in x], quaternions=[LEVEL] * 6
    )
    at = [-1.0, 0.0, 0.01, 0.02, 2.0, 4.9, 5.0, 5.01, 5.02, 5.03, 5.04, 9.0]
    expected = [0.0, 0.0, 0.05, 0.1, 0.1, 0.1, 0.1, 0.15, 0.2, 0.25, 0.3, 0.3]
    assert [gripper.pose_at(time)[0][0] for time in at] == pytest.approx(expected, abs=1e-12)


def test_single_pose_holds_at_all_times() -> None:
    gripper = RecordedGripper(times=[1.0], positions=[[1.0, 2.0, 3.0]], quaternions=[LEVEL])
    assert {tuple(gripper.pose_at(time)[0]) for time in (0.0, 1.0, 2.0)} == {(1.0, 2.0, 3.0)}
    assert gripper.pose_at(2.0)[1] == LEVEL
