# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Processor time of a depth camera's image and of its messages.

`python -m benchmarks ros-camera` renders a folded, waving sheet that fills most of the image. A plane lies behind it,
and one body of each other shape before it. The clock is the thread's processor time.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import time_interleaved
from cloth_sim_ros.camera.depth_camera import DepthCamera
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.surface import grid_triangles
from cloth_sim_ros.ros.camera.image_messages import ImageMessage, PointsMessage, millimetres
from cloth_sim_ros.scene.camera_section import CameraParameters
from validation.command import at_least

#: Largest time of an image with 10 thousand triangles [ms], and columns and rows of the image.
GOAL, _WIDTH, _HEIGHT = 8.0, 640, 480
_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def waving_sheet(resolution: int) -> tuple[Array, NDArray[np.int64]]:
    """Return positions (3, n) [m] and triangles of a sheet a metre away, whose right third is folded over."""
    s, t = np.meshgrid(np.linspace(-0.75, 1.25, resolution), np.linspace(-0.5, 0.5, resolution))
    is_folded = s > 0.75
    x = np.where(is_folded, 1.5 - s, s)
    z = 1.0 + 0.05 * np.sin(9.0 * s) * np.cos(7.0 * t) - np.where(is_folded, 0.03, 0.0)
    triangles = grid_triangles(resolution, resolution, "right")
    return np.ascontiguousarray(np.stack([x.ravel(), t.ravel(), z.ravel()])), triangles


def bodies() -> list[tuple[Obstacle, Array, int]]:
    """Return a plane behind the sheet, and one body of each other shape without a file, before it."""
    turned = (0.9238795325112867, 0.0, 0.0, 0.3826834323650898)
    listed = [
        (Obstacle(name="plane", shape="plane"), (0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0)),
        (Obstacle(name="box", shape="box", size=(0.2, 0.1, 0.1)), (-0.3, -0.2, 0.8, *turned)),
        (Obstacle(name="sphere", shape="sphere", size=(0.1,)), (0.3, -0.2, 0.8, *turned)),
        (Obstacle(name="capsule", shape="capsule", size=(0.05, 0.2)), (-0.3, 0.2, 0.8, *turned)),
        (Obstacle(name="cylinder", shape="cylinder", size=(0.05, 0.2)), (0.3, 0.2, 0.8, *turned)),
    ]
    return [(body, np.array(pose), index + 2) for index, (body, pose) in enumerate(listed)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--resolution", type=at_least(2), default=72, help="particles a side")
    parser.add_argument("--seconds", type=float, default=10.0, help="wall time of the measurement")


def figures(options: argparse.Namespace) -> dict[str, Any]:
    """Return the times; they are met if an image takes at most `GOAL`."""
    x, triangles = waving_sheet(options.resolution)
    parameters = CameraParameters(width=_WIDTH, height=_HEIGHT, fov=1.2)
    noise = attrs.evolve(parameters, disparity_noise=0.1, disparity_step=0.0625)
    plain, noisy = DepthCamera("plain", parameters, triangles), DepthCamera("noisy", noise, triangles)
    scene = bodies()
    depths, labels = plain.render(_POSE, x, scene)
    size: dict[str, Any] = {"frame_id": "camera", "width": _WIDTH, "height": _HEIGHT}
    metres, short = ImageMessage(**size, encoding="32FC1"), ImageMessage(**size, encoding="16UC1")
    cloud = PointsMessage(**size)
    times = time_interleaved(
        {
            "image": lambda: plain.render(_POSE, x, scene),
            "image_with_noise": lambda: noisy.render(_POSE, x, scene),
            "message_32FC1": lambda: metres.serialize(depths, 0),
            "message_16UC1": lambda: short.serialize(millimetres(depths), 0),
            "message_labels": lambda: short.serialize(labels, 0),
            "message_points": lambda: cloud.serialize(plain.points(depths), 0),
        },
        seconds=options.seconds,
        clock=time.thread_time,
    )
    medians = {f"{name}_ms": round(1e3 * times.median(name), 3) for name in times.seconds}
    met = medians["image_ms"] <= GOAL
    covered = round(float((labels == 1).mean()), 3)
    return {"triangles": len(triangles), **medians, "cloth_share": covered, "goal_ms": GOAL, "met": met}
