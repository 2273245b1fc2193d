# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth images have the same bits on every instruction set."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from cloth_sim_ros.engine import build, instruction_set

SCRIPT = """
import hashlib, numpy as np
from cloth_sim_ros.camera.depth_camera import DepthCamera
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.scene.camera_section import CameraParameters

s, t = np.meshgrid(np.linspace(-1.0, 1.0, 30), np.linspace(-1.0, 1.0, 30))
x = np.stack([s.ravel(), t.ravel(), (1.0 + 0.3 * s * t - 0.9 * s * s).ravel()])
cells = np.arange(900).reshape(30, 30)
triangles = np.stack([cells[:-1, :-1].ravel(), cells[:-1, 1:].ravel(), cells[1:, :-1].ravel()], axis=1)
sizes = {"plane": (), "box": (0.3, 0.2, 0.1), "sphere": (0.2,), "capsule": (0.1, 0.2), "cylinder": (0.1, 0.2)}
bodies = [
    (
        Obstacle(name=shape, shape=shape, size=size),
        np.array([0.25 * k - 0.6, 0.1, 0.6 if k else 3.0, 0.9, 0.3, 0.1, 0.2]),
        k + 2,
    )
    for k, (shape, size) in enumerate(sizes.items())
]
camera = DepthCamera("wrist", CameraParameters(width=101, height=67, min_depth=0.001), triangles)
depths, labels = camera.render((0.0, 0.0, -0.3, 0.02, 0.01, 0.1, 0.9), x, bodies)
print(sorted(set(labels.ravel().tolist())), hashlib.sha256(depths.tobytes() + labels.tobytes()).hexdigest())
"""


def test_images_are_equal_on_every_instruction_set() -> None:
    names = [name for name in instruction_set.libraries() if (build.ENGINE / build.file_name(name)).exists()]
    if len(names) < 2:
        pytest.skip("one library is built: run make engines")
    images = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={**os.environ, "CLOTH_SIM_ROS_ENGINE": name},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for name in names
    }
    (image,) = images
    assert image.startswith("[0, 1, 2, 3, 4, 5, 6]") or image.startswith("[1, 2, 3, 4, 5, 6]"), image
