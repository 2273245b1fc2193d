# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages from the node to its camera process: its set-up, and frames to be rendered."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.camera_section import CameraParameters


@attrs.frozen(eq=False)
class CameraTopics:
    """Optical frame of one camera; by the names of its topics below the camera's: remapped full names, QoS policies."""

    frame_id: str
    names: dict[str, str]
    #: Value of each policy in `qos_rules.POLICIES`, by that name.
    profiles: dict[str, dict[str, Any]]


@attrs.frozen(eq=False)
class CameraSetup:
    """First message to the camera process: cameras, their topics, and the triangles of the cloth."""

    node: str
    namespace: str
    #: Frame of the cloth.
    frame_id: str
    cameras: dict[str, CameraParameters]
    topics: dict[str, CameraTopics]
    #: Particles of each triangle, shape (m, 3).
    triangles: NDArray[np.int64]


@attrs.frozen(eq=False)
class CameraFrame:
    """Message to the camera process: geometry of one frame, and the cameras that are due to render it."""

    index: int
    #: ROS time at which it was due [ns].
    stamp: int
    cameras: frozenset[str]
    #: Position [m] and orientation x, y, z, w of each camera without a TF frame.
    poses: dict[str, tuple[float, ...]]
    #: Positions of the particles [m], shape (3, n).
    x: Array
    #: Obstacles and pads; None if they are those of the frame before.
    bodies: tuple[Obstacle, ...] | None
    #: Their poses, shape (count, 7).
    body_poses: Array
    #: Labels of the cloth and the bodies by name.
    labels: dict[str, int]
