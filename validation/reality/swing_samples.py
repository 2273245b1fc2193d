# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Synthetic copy of a recorded set of swings: one cloth, many motions, a poor camera.

The set: a cloth of 0.3 m that an arm holds at two corners, swung at up to 0.8 m/s. A camera sees it at 9 Hz. Its clouds
are 0.32 s late and turned by 4 degrees. Two thirds of them are lost, the held corners are hidden. Its errors are
correlated in space and time. They have the quantiles of the real camera: median 8.8, 95 % 29, rms 15 mm.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros import Grasp, Scene, SetParameters, Simulation, Target
from cloth_sim_ros.fit.alignment import rotation_of
from cloth_sim_ros.fit.recorded import RecordedGripper, Recording
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import Event

#: Number of this set of motions. The fit was developed on set 39. This set was drawn afterwards, and stays as it is.
SET = 53
#: Edge of the cloth [m], particles along it, and distance of the grippers relative to it.
SIZE, RESOLUTION, NEARER = 0.3, 8, 0.98
#: Held particles, by gripper.
HELD = {"left": (0,), "right": (RESOLUTION - 1,)}
#: Ranges of the true values. The middle of each is the start of a complete fit.
RANGES = {
    "material.stretch_modulus": (150.0, 600.0),
    "material.shear_modulus": (40.0, 160.0),
    "material.bending_modulus": (5e-5, 4e-4),
    "material.damping": (0.05, 0.2),
    "wind.normal_drag": (0.25, 1.0),
    "wind.tangential_drag": (0.05, 0.2),
}


def draw_truth(seed: int) -> dict[str, float]:
    """Return true values by full name, uniform in their logarithms."""
    random = np.random.default_rng([SET, seed, 2])
    return {name: float(np.exp(random.uniform(*np.log(limits)))) for name, limits in RANGES.items()}


def starting_values() -> dict[str, float]:
    """Return the start of a complete fit by full name: the middle of the ranges."""
    return {name: float(np.sqrt(low * high)) for name, (low, high) in RANGES.items()}


#: True values of linear fits.
TRUTH = draw_truth(0)
#: Rate of the clouds [Hz], of the poses [Hz] and of the simulation [Hz].
CLOUD_RATE, POSE_RATE, FRAME_RATE = 9.0, 50.0, 60.0
#: Duration of a motion, and its still beginning [s].
DURATION, STILL = 2.1, 0.25
#: Delay of the clouds [s]. Rotation of the camera about its place [degrees], its axis and its place [m].
DELAY, TURN, AXIS, CAMERA = 0.32, 4.0, (0.6, 0.3, 0.74), (0.1, -1.0, 0.95)
#: Fraction of lost clouds, and of hidden points of the others.
LOSS_FRACTION, HIDDEN = 2.0 / 3.0, 0.1
#: Root mean square of the camera's error [m]; its correlated part: share of the variance, length [m] and time [s].
NOISE, CORRELATED, LENGTH, TIME = 0.015, 0.5, 0.1, 0.25
#: Standard deviation of the logarithm of a cloud's error: it makes the median 8.8 mm of 15 mm.
SPREAD = 0.64
#: Largest speed of the grippers [m/s].
SPEED = 0.8
SETTLE = 6.0


def swing_scene(values: dict[str, float]) -> Scene:
    """Return the scene of the cloth with two grippers; `values` are by full name."""
    return Scene.from_parameters(
        {
            "rate": FRAME_RATE,
            "cloth.size": [SIZE, SIZE],
            "cloth.resolution": [RESOLUTION, RESOLUTION],
            "cloth.anchors": [""],
            "grippers": ["left", "right"],
            "gripper.radius": 0.01,
            "bending.model": "crossed",
            "material.density": 0.2,
            "tolerance": 1e-5,
            "work_limit": 0.0,
            **TRUTH,
            **values,
        }
    )


def gripper_positions(index: int, times: Array) -> tuple[Array, Array]:
    """Return the positions of the left and the right gripper of a motion, shape (times, 3) each [m].

    An arm moves both by sines of random amplitudes and turns them by a few degrees. The swing starts and ends smoothly.
    """
    random = np.random.default_rng([SET, index])
    amplitudes = random.normal(size=(3, 3)) * np.array([0.5, 1.0, 0.5])[:, None]
    frequencies, phases = random.uniform(0.4, 1.6, size=(3, 3)), random.uniform(0.0, 2.0 * np.pi, size=(3, 3))
    turns = random.normal(scale=0.15, size=2)
    grid = np.linspace(0.0, DURATION, 400)

    def path(at: Array) -> Array:
        t = np.clip(at - STILL, 0.0, None)
        ramp = np.clip(t / 0.4, 0.0, 1.0)
        ramp = ramp * ramp * (3.0 - 2.0 * ramp)
        waves = amplitudes * np.sin(2.0 * np.pi * frequencies * t[:, None, None] + phases)
        return ramp[:, None] * (waves - amplitudes * np.sin(phases)).sum(axis=2)

    speed = np.linalg.norm(np.gradient(path(grid), grid, axis=0), axis=1).max()
    factor = SPEED * random.uniform(0.5, 1.0) / speed
    centre = factor * path(times) + np.array([0.0, 0.0, 1.0])
    ramp = np.clip((times - STILL) / 1.0, 0.0, 1.0)
    angle = turns[0] * ramp * np.sin(4.0 * (times - STILL)) + turns[1] * ramp**2
    half = 0.5 * SIZE * NEARER
    arm = np.stack([half * np.cos(angle), half * np.sin(angle), np.zeros(len(times))], axis=1)
    return centre - arm, centre + arm


def exact_motion(index: int, values: dict[str, float]) -> Array:
    """Return true positions at every frame of a motion [m], shape (frames, particles, 3).

    Args:
        index: index of the motion.
        values: true parameters by full name.
    """
    scene = swing_scene(values)
    n_settle, n = round(SETTLE * FRAME_RATE), round(DURATION * FRAME_RATE)
    left, right = gripper_positions(index, np.arange(n + 1) / FRAME_RATE)
    start = scene.initial_positions()
    shift = (left[0] + right[0]) / 2.0 - (start[0] + start[RESOLUTION - 1]) / 2.0
    state = scene.starting_state()
    state.x += shift[:, None]
    simulation = Simulation(scene, state)
    for k in range(n_settle):
        events = _targets(left[0], right[0])
        if not k:
            events = _targets(start[0] + shift, start[RESOLUTION - 1] + shift)
            events += [Grasp("left", True), Grasp("right", True)]
            events.append(SetParameters({"air.drag": 6.0, "wind.velocity": [0.0, 1.5, 0.0]}))
        if k == n_settle // 3:
            events.append(SetParameters({"wind.velocity": [0.0, 0.0, 0.0]}))
        simulation.advance(events)
    frames = [simulation.positions]
    for k in range(n):
        events = _targets(left[k + 1], right[k + 1])
        if not k:
            events.append(SetParameters({"air.drag": scene.air.drag}))
        simulation.advance(events)
        frames.append(simulation.positions)
    return np.array(frames)


def _targets(left: Array, right: Array) -> list[Event]:
    level = (0.0, 0.0, 0.0, 1.0)
    return [Target("left", left, level), Target("right", right, level)]


def camera_pose() -> tuple[Array, Array]:
    """Return the rotation (3, 3) and the centre [m] of the camera's error."""
    axis = np.array(AXIS) / np.linalg.norm(AXIS)
    return rotation_of((np.deg2rad(TURN) * axis).tolist()), np.array(CAMERA)


def record_motion(index: int, frames: Array, seed: int) -> Recording:
    """Return the recording of a motion: late, turned, noisy and lossy clouds, and poses.

    Args:
        index: index of the motion.
        frames: true positions at every frame [m].
        seed: seed of the camera's errors and losses.
    """
    random = np.random.default_rng([SET, seed, index, 0])
    times = cloud_times()
    turn, centre = camera_pose()
    exact = (show(frames, times) - centre) @ turn.T + centre
    noise = camera_noise(times, random, noise_amplitudes(index, seed))
    clouds = exact + noise
    clouds[random.random(clouds.shape[:2]) < HIDDEN] = np.nan
    clouds[:, [0, RESOLUTION - 1]] = np.nan
    used = np.flatnonzero(random.random(len(times)) >= LOSS_FRACTION)
    if len(used) < 3:
        used = np.sort(random.permutation(len(times))[:3])
    return _recording(index, times[used], [clouds[k] for k in used])


def complete_recording(index: int, frames: Array) -> Recording:
    """Return the recording of a motion by a perfect camera that is late and turned: all clouds and particles."""
    turn, centre = camera_pose()
    return _recording(index, cloud_times(), (show(frames, cloud_times()) - centre) @ turn.T + centre)


def _recording(index: int, times: Array, clouds: Sequence[Array] | Array) -> Recording:
    """Return the recording of clouds and of the level grippers' poses."""
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(_pose_times()), 1))
    grippers = {
        name: RecordedGripper(times=_pose_times(), positions=positions, quaternions=level)
        for name, positions in zip(("left", "right"), gripper_positions(index, _pose_times()), strict=True)
    }
    return Recording(name=f"swing_{index:02d}", times=times, clouds=clouds, grippers=grippers)


def cloud_times() -> Array:
    """Return the stamps of all clouds of a motion, also of the lost ones [s]."""
    return np.arange(int(DURATION * CLOUD_RATE) + 1) / CLOUD_RATE


def show(frames: Array, times: Array) -> Array:
    """Return true positions at the stamps of late clouds [m], shape (times, particles, 3).

    A real cloth moves continuously: positions between frames are cubic splines.
    """
    from scipy.interpolate import CubicSpline

    at = np.clip((times - DELAY) * FRAME_RATE, 0.0, len(frames) - 1.0)
    return np.asarray(CubicSpline(np.arange(len(frames)), frames)(at))


def noise_factor() -> Array:
    """Return a factor L of the covariance L L' of one coordinate of all particles at unit variance, (n, n)."""
    u = np.linspace(0.0, SIZE, RESOLUTION)
    x, y = (grid.ravel() for grid in np.meshgrid(u, u))
    squares = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    smooth = np.exp(-0.5 * squares / LENGTH**2)
    return np.asarray(np.linalg.cholesky(CORRELATED * smooth + 1e-9 * np.eye(len(x))))


def noise_amplitudes(index: int, seed: int) -> Array:
    """Return the relative size of each cloud's error, shape (clouds,)."""
    random = np.random.default_rng([SET, seed, index, 1])
    return np.asarray(np.exp(SPREAD * random.normal(size=len(cloud_times())) - SPREAD**2))


def noise_covariance(stamps: NDArray[np.int64], particles: NDArray[np.int64], amplitudes: Array) -> Array:
    """Return the covariance of one coordinate of points [m²], shape (points, points).

    Args:
        stamps: index of each point's cloud among all clouds.
        particles: particle of each point.
        amplitudes: relative size of each cloud's error.
    """
    factor, times = noise_factor(), cloud_times()
    space = (factor @ factor.T)[np.ix_(particles, particles)]
    time = np.exp(-np.abs(times[stamps][:, None] - times[stamps]) / TIME)
    white = (1.0 - CORRELATED) * np.eye(len(stamps))
    sizes = NOISE / np.sqrt(3.0) * amplitudes[stamps]
    return np.asarray(sizes[:, None] * (space * time + white) * sizes)


def camera_noise(times: Array, random: np.random.Generator, amplitude: Array) -> Array:
    """Return the camera's errors [m], shape (times, particles, 3), with a relative size for each cloud."""
    factor, n = noise_factor(), RESOLUTION**2
    smooth = random.normal(size=(len(times), n, 3))
    decay = np.exp(-np.diff(times) / TIME)
    for k, share in enumerate(decay, start=1):
        smooth[k] = share * smooth[k - 1] + np.sqrt(1.0 - share**2) * smooth[k]
    white = np.sqrt(1.0 - CORRELATED) * random.normal(size=smooth.shape)
    return np.asarray(NOISE / np.sqrt(3.0) * amplitude[:, None, None] * (factor @ smooth + white))


def _pose_times() -> Array:
    return np.arange(-0.3, DURATION + 0.1, 1.0 / POSE_RATE)
