# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Colours: perceptually uniform ramp for strain, from light linen to deep red."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

#: Vertices of the ramp in OKLCH: lightness, chroma, hue [degrees]. They stay distinct under shading.
_RAMP = ((0.86, 0.045, 235.0), (0.85, 0.105, 95.0), (0.70, 0.165, 55.0), (0.50, 0.190, 22.0))

#: RGBA colours of the other objects.
ANCHOR = 0x3D7EFFFF
OPEN_GRIPPER = 0xE8E8E8FF
CLOSED_GRIPPER = 0x25C26EFF
GRASPED = 0x25C26EFF
TRAIL = 0x7BE0AAFF


def strain_colours(strain: NDArray[np.float32], limit: float, out: NDArray[np.uint32]) -> None:
    """Write the colours 0xRRGGBBAA of strains (n,) into `out` (n,): light up to 0, red from `limit`, and for nan."""
    table = _table()
    # The minimum of nan and a number is the number.
    index = np.maximum(np.fmin(strain * (len(table) / limit), len(table) - 1.0), 0.0)
    np.take(table, index.astype(np.intp), out=out, mode="clip")


@functools.cache
def _table() -> NDArray[np.uint32]:
    """Return the 256 colours of the ramp, equidistant in the colour space OKLab: equal steps look equal."""
    lightness, chroma, hue = np.array(_RAMP).T
    corners = np.stack([lightness, chroma * np.cos(np.radians(hue)), chroma * np.sin(np.radians(hue))], axis=1)
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    even = np.linspace(0.0, along[-1], 256)
    lab = np.stack([np.interp(even, along, corners[:, k]) for k in range(3)], axis=1)
    rgb = np.round(255.0 * _srgb(lab)).astype(np.uint8)
    rgba = np.concatenate([rgb, np.full((256, 1), 255, np.uint8)], axis=1)
    return np.ascontiguousarray(rgba).view(">u4")[:, 0].astype(np.uint32)


def _srgb(lab: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert OKLab colours to sRGB in 0..1, shape (n, 3) (B. Ottosson, 2020)."""
    to_cones = np.array(
        [[1.0, 0.3963377774, 0.2158037573], [1.0, -0.1055613458, -0.0638541728], [1.0, -0.0894841775, -1.2914855480]]
    )
    to_linear = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    )
    linear = np.clip((lab @ to_cones.T) ** 3 @ to_linear.T, 0.0, 1.0)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.asarray(curve, dtype=np.float64)
