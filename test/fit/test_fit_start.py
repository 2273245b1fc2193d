# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Initial shape of a cloth in its grippers, by noisy clouds."""

from __future__ import annotations

import attrs
import numpy as np
import pytest
from support.motion_samples import RESOLUTION, scene_of

from cloth_sim_ros.fit.hypotheses import selections
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recorded import RecordedGripper, Recording
from cloth_sim_ros.fit.start import hanging_state, motion_recording

CORNERS = (0, RESOLUTION - 1)
#: Noise of a coordinate, and travel of the gripper after its still beginning [m].
NOISE, TRAVEL = 0.01, 0.3


def recording_of(n_still: int, *, shows_corners: bool = True) -> Recording:
    """A bar that holds both upper corners, turned by 0.3 rad, and moves after some clouds."""
    random, times = np.random.default_rng(4), 0.1 * np.arange(20)
    turn = np.array([[np.cos(0.3), -np.sin(0.3), 0.0], [np.sin(0.3), np.cos(0.3), 0.0], [0.0, 0.0, 1.0]])
    shape = scene_of().initial_positions() @ turn.T
    moved = TRAVEL * (times > times[n_still - 1])[:, None] * np.array([1.0, 0.0, 0.0])
    clouds = shape + moved[:, None] + random.normal(scale=NOISE, size=(len(times), *shape.shape))
    if not shows_corners:
        clouds[:, CORNERS[0]] = np.nan
    bar = shape[list(CORNERS)].mean(axis=0) + moved
    track = RecordedGripper(times=times, positions=bar, quaternions=[[0.0, 0.0, 0.0, 1.0]] * len(times))
    return Recording(name="bar", times=times, clouds=list(clouds), grippers={"left": track})


def held_line(recording: Recording) -> np.ndarray:
    """Return the vector between both corners in the initial state [m]."""
    state = hanging_state(recording, scene_of(), selections({"left": CORNERS}), 0.0)
    places = state.positions[list(CORNERS)]
    assert places.mean(axis=0) == pytest.approx(recording.grippers["left"].positions[0])
    return np.asarray(places[1] - places[0])


@pytest.mark.parametrize("shows_corners", [True, False])
def test_bar_keeps_the_distance_of_the_rest_shape(shows_corners: bool) -> None:
    x = scene_of().sheet.positions()
    rest_length = float(np.linalg.norm(x[CORNERS[1]] - x[CORNERS[0]]))
    line = held_line(recording_of(6, shows_corners=shows_corners))
    assert np.linalg.norm(line) == pytest.approx(rest_length, rel=1e-12)


def test_bar_direction_is_the_mean_of_its_still_clouds() -> None:
    recording = recording_of(9)
    corners = np.array([cloud[list(CORNERS)] for cloud in recording.clouds[:9]])
    mean = np.subtract(*corners.mean(axis=0)[::-1])
    line = held_line(recording)
    assert line / np.linalg.norm(line) == pytest.approx(mean / np.linalg.norm(mean), abs=1e-12)


@pytest.mark.parametrize(
    ("used", "reason"),
    [
        (slice(50, None), r"'right' begin 0\.50 s after the first cloud, and it moves at 200 mm/s .* by --from"),
        (slice(0, 150), r"'right' end 0\.51 s before the last cloud, and it moves at 200 mm/s .* by --until"),
    ],
)
def test_poses_that_lack_a_motion_are_refused(used: slice, reason: str) -> None:
    scene = scene_of()
    times = 0.01 * np.arange(201)
    positions = np.array([0.2, 0.0, 0.0]) * np.maximum(times - 0.3, 0.0)[:, None]
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    track = RecordedGripper(times=times, positions=positions, quaternions=turns)
    part = RecordedGripper(times=times[used], positions=positions[used], quaternions=turns[used])
    clouds = [scene.initial_positions()] * len(times)
    whole = Recording(name="swing", times=times, clouds=clouds, grippers={"left": track, "right": track})
    assert motion_recording(whole, scene, []).n_settle_frames
    with pytest.raises(FitError, match=reason):
        motion_recording(attrs.evolve(whole, grippers={"left": track, "right": part}), scene, [])


@pytest.mark.parametrize("n_points", [0, RESOLUTION**2])
def test_first_cloud_without_points_is_held(n_points: int) -> None:
    recording, scene = recording_of(6), scene_of()
    recording = attrs.evolve(recording, clouds=[np.full((n_points, 3), np.nan), *recording.clouds[1:]])
    held_line(recording)
    state = hanging_state(recording, scene, selections({"left": CORNERS}), 0.0)
    shift = recording.grippers["left"].positions[0] - scene.initial_positions()[list(CORNERS)].mean(axis=0)
    free = np.setdiff1d(np.arange(RESOLUTION**2), CORNERS)
    assert state.positions[free] == pytest.approx((scene.initial_positions() + shift)[free])
