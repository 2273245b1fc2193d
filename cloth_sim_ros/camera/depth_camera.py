# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Depth camera: depths and labels of what each pixel sees."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.engine.camera import DepthImage
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import normalized, rotation_matrix
from cloth_sim_ros.scene.camera_section import CameraParameters

#: Labels of pixels without a depth, and of the cloth.
NO_LABEL, CLOTH_LABEL = 0, 1


def intrinsics(camera: CameraParameters) -> tuple[float, float, float, float]:
    """Return a camera's fx, fy, cx, cy [pixels], as set or by its field of view; centres of pixels are integers."""
    if any(camera.intrinsics):
        fx, fy, cx, cy = camera.intrinsics
        return fx, fy, cx, cy
    focal_length = 0.5 * camera.width / math.tan(0.5 * camera.fov)
    return focal_length, focal_length, 0.5 * (camera.width - 1), 0.5 * (camera.height - 1)


class DepthCamera:
    """Renderer of depth and label images of a cloth and bodies: a pinhole camera with z forward, x right and y down.

    Args:
        name: its name, a part of the seed.
        parameters: image, range and noise.
        triangles: particles of the cloth's triangles, shape (m, 3).
    """

    def __init__(self, name: str, parameters: CameraParameters, triangles: NDArray[np.int64]) -> None:
        self.parameters, self._triangles = parameters, triangles
        self.intrinsics = intrinsics(parameters)
        self._seed = (parameters.seed, zlib.crc32(name.encode()))
        self._image = DepthImage(parameters.width, parameters.height, self.intrinsics)
        # Rays of the pixels at depth 1.
        fx, fy, cx, cy = self.intrinsics
        self._rays = (
            ((np.arange(parameters.width) - cx) / fx).astype(np.float32),
            ((np.arange(parameters.height) - cy) / fy).astype(np.float32)[:, None],
        )

    def render(
        self, pose: ArrayLike, x: Array, bodies: Iterable[tuple[Obstacle, Array, int]], *, frame: int = 0
    ) -> tuple[NDArray[np.float32], NDArray[np.uint16]]:
        """Return depths [m], NaN without a surface, and labels, (height, width) each; the next call changes the labels.

        Args:
            pose: its position [m] and orientation x, y, z, w.
            x: positions of the particles [m], shape (3, n).
            bodies: obstacles with poses and labels.
            frame: number of the frame, a part of the seed of the noise.

        Returns:
            Depths [m], NaN without a surface in the range, and labels, shape (height, width) each. The next view
            changes the labels.
        """
        image, to_camera = self._image, _inverse(_motion(pose))
        image.clear()
        image.draw_triangles(_placement(to_camera), x, self._triangles, CLOTH_LABEL, solid=False)
        for body, body_pose, label in bodies:
            placement = _placement(_composed(to_camera, _motion(body_pose)))
            if body.vertices is not None and body.triangles is not None:
                vertices = np.ascontiguousarray(body.vertices.T)
                image.draw_triangles(placement, vertices, body.triangles, label, solid=True)
            else:
                size = np.zeros(3)
                size[: len(body.size)] = body.size
                image.draw_solid(placement, body.shape, size, body.bounding_radius, label)
        labels = image.labels
        with np.errstate(divide="ignore"):
            depths = np.reciprocal(image.inverse_depths)
        self._remove_out_of_range(depths, labels)
        if self.parameters.disparity_noise or self.parameters.disparity_step:
            depths = self._with_noise(depths, frame)
            self._remove_out_of_range(depths, labels)
        return depths, labels

    def points(self, depths: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the points of depths [m] (height, width) in the optical frame, shape (height, width, 3) [m]."""
        points = np.empty((*depths.shape, 3), np.float32)
        np.multiply(depths, self._rays[0], out=points[..., 0])
        np.multiply(depths, self._rays[1], out=points[..., 1])
        points[..., 2] = depths
        return points

    def _remove_out_of_range(self, depths: NDArray[np.float32], labels: NDArray[np.uint16]) -> None:
        """Set depths [m] out of the camera's range to NaN, and their labels to 0, in place."""
        out_of_range = ~((depths >= self.parameters.min_depth) & (depths <= self.parameters.max_depth))
        depths[out_of_range] = np.nan
        labels[out_of_range] = NO_LABEL

    def _with_noise(self, depths: NDArray[np.float32], frame: int) -> NDArray[np.float32]:
        """Return depths [m] with noise and steps of a stereo camera's disparity fx baseline / z; changes `depths`."""
        camera = self.parameters
        scale = np.float32(self.intrinsics[0] * camera.baseline)
        disparities = np.divide(scale, depths, out=depths)
        if camera.disparity_noise:
            normal = np.random.default_rng((*self._seed, frame)).standard_normal(depths.shape, np.float32)
            normal *= np.float32(camera.disparity_noise)
            disparities += normal
        if camera.disparity_step:
            step = np.float32(camera.disparity_step)
            disparities /= step
            np.rint(disparities, out=disparities)
            disparities *= step
        # Without a disparity above 0 the depth is infinite or negative, out of range.
        with np.errstate(divide="ignore"):
            return np.divide(scale, disparities, out=disparities)


_Motion = tuple[Array, Array]


def _motion(pose: ArrayLike) -> _Motion:
    """Return rotation matrix (3, 3) and translation [m] of a pose: position [m] and quaternion x, y, z, w (7,)."""
    numbers = np.asarray(pose, dtype=np.float64)
    return rotation_matrix(normalized(numbers[3:])), numbers[:3]


def _rotate(rotation: Array, columns: Array) -> Array:
    """Return the product of a rotation matrix (3, 3) with columns (3, ...), with a fixed order of sums."""
    first, second, third = (np.multiply.outer(rotation[:, k], columns[k]) for k in range(3))
    return np.asarray(first + second + third)


def _inverse(motion: _Motion) -> _Motion:
    rotation, translation = motion
    return rotation.T, -_rotate(rotation.T, translation)


def _composed(outer: _Motion, inner: _Motion) -> _Motion:
    return _rotate(outer[0], inner[0]), _rotate(outer[0], inner[1]) + outer[1]


def _placement(motion: _Motion) -> Array:
    return np.concatenate([motion[0].ravel(), motion[1]])


def label_numbers(names: Sequence[str], known: dict[str, int]) -> dict[str, int]:
    """Return {name: label} of the cloth (1) and all bodies: known labels stay, new names take the next numbers.

    Args:
        names: names of the present bodies.
        known: labels so far.
    """
    labels = known or {"cloth": CLOTH_LABEL}
    new = [name for name in names if name not in labels]
    return {**labels, **{name: len(labels) + 1 + index for index, name in enumerate(new)}} if new else labels
