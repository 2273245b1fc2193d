# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small recordings of one cloth in several motions, by a camera that is late and turned."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.fit.alignment import Alignment
from cloth_sim_ros.fit.recorded import RecordedGripper, Recording
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Target
from cloth_sim_ros.simulation.simulation import Simulation
from support.fit_samples import SIZE, cloth, hung

#: Particles along an edge, rate of the frames [Hz], frames per cloud, and duration of a motion [s].
RESOLUTION, RATE, STRIDE, DURATION = 5, 30.0, 2, 1.1
TRUTH = {
    "material.stretch_modulus": 100.0,
    "material.shear_modulus": 20.0,
    "material.bending_modulus": 3e-4,
    "material.damping": 0.1,
    "wind.normal_drag": 0.4,
}
#: Error of the camera: the clouds are late, turned by 4 degrees and shifted.
CAMERA = Alignment(offset=0.3, rotation=(0.04, 0.03, 0.049), shift=(0.01, -0.02, 0.015))
#: Centre of the camera's rotation [m].
PIVOT = np.array([0.0, 0.0, 1.0])
HELD = {"left": (0,), "right": (RESOLUTION - 1,)}


def scene_of(**values: float) -> Scene:
    """Return the scene of the cloth with other values by full name, `.` written as `__`."""
    changed = {name.replace("__", "."): value for name, value in values.items()}
    return cloth({"rate": RATE, "gripper.radius": 0.01, **TRUTH, **changed}, resolution=RESOLUTION)


def hands_at(times: np.ndarray, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of the left and the right hand of a motion, shape (times, 3) each [m]."""
    random = np.random.default_rng([7, index])
    amplitude, frequency = random.normal(size=3) * [0.05, 0.1, 0.05], random.uniform(0.8, 1.6, size=3)
    t = np.clip(times - 0.1, 0.0, None)[:, None]
    ramp = np.clip(t / 0.3, 0.0, 1.0)
    both = ramp * ramp * (3.0 - 2.0 * ramp) * amplitude * np.sin(2.0 * np.pi * frequency * t)
    corner = np.array([0.5 * SIZE * 0.9, 0.0, 1.0 + 0.5 * SIZE])
    return corner * [-1.0, 1.0, 1.0] + both, corner + both


def record_motions(
    count: int, *, noise: float = 0.002, camera: Alignment = CAMERA, show_held: bool = False, seed: int = 0
) -> list[Recording]:
    """Return recordings of different motions.

    Args:
        count: number of motions.
        noise: standard deviation of each coordinate [m].
        camera: time offset and pose of the camera.
        show_held: true to show the held corners.
        seed: seed of the noise.
    """
    scene, random = scene_of(), np.random.default_rng(seed)
    state = hung(scene, 8.0)
    recordings = []
    late = round(camera.offset * RATE)
    stamps = np.arange(0, round(DURATION * RATE) + 1, STRIDE)
    for index in range(count):
        simulation = Simulation(scene, state.copy())
        times = np.arange(round(DURATION * RATE) + 1) / RATE
        left, right = hands_at(times, index)
        frames = [simulation.positions]
        for k in range(1, len(times)):
            simulation.advance([Target("left", left[k]), Target("right", right[k])])
            frames.append(simulation.positions)
        clouds = []
        for stamp in stamps:
            x = camera.to_camera(frames[max(stamp - late, 0)], PIVOT)
            x = x + random.normal(scale=noise, size=x.shape) if noise else x
            x[random.random(len(x)) < 0.2] = np.nan
            if not show_held:
                x[[0, RESOLUTION - 1]] = np.nan
            clouds.append(x)
        level = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        recordings.append(
            Recording(
                name=f"motion_{index}",
                times=stamps / RATE,
                clouds=clouds,
                grippers={
                    "left": RecordedGripper(times=times, positions=left, quaternions=level),
                    "right": RecordedGripper(times=times, positions=right, quaternions=level),
                },
            )
        )
    return recordings
