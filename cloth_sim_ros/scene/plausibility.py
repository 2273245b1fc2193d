# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plausibility checks of a cloth's extent, mass and cloud resolution.

A file in millimetres makes a cloth of hundreds of metres, which runs like any other. At map coordinates the single
precision of clouds is coarser than the motion. Neither is an error, but both are usually mistakes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.arithmetic.deterministic_math import ordered_sum
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene

#: Extents [m] and masses [kg] of cloth that a robot handles: from a patch of a centimetre to a sail.
EXTENTS, MASSES = (0.01, 20.0), (1e-6, 50.0)
#: Extents of obstacles' meshes [m]: from a pin to a hall.
OBSTACLE_EXTENTS = (0.001, 20.0)


def cloth_size(scene: Scene, x: Array, masses: Array) -> str:
    """Return a text with extent [m], mass [kg] and the cloud's resolution [m], as part of a sentence.

    Args:
        scene: scene of the cloth.
        x: positions [m], (3, n).
        masses: masses [kg], (n,).
    """
    return (
        f"extent {_extent(x.T):.3g} m, mass {ordered_sum(masses.tolist()):.3g} kg, "
        f"clouds resolve {cloud_resolution(x, double=scene.points.double):.2g} m"
    )


def implausible_sizes(scene: Scene, x: Array, masses: Array) -> list[str]:
    """Return a sentence with cause and remedy on each implausible size; arguments as those of `cloth_size`."""
    cloth = scene.cloth
    name = f"the mesh '{cloth.mesh}'" if cloth.mesh else "the cloth"
    sentences: list[str] = []
    extent, mass = _extent(x.T), ordered_sum(masses.tolist())
    if not EXTENTS[0] <= extent <= EXTENTS[1]:
        if cloth.mesh:
            remedy = f"if its file is not in metres, set cloth.scale ({_scale_hint(extent)})"
        else:
            remedy = f"look at {'the file of cloth.springs' if cloth.springs else 'cloth.size'}, which is in metres"
        sentences.append(
            f"{name} has an extent of {extent:.3g} m and a mass of {mass:.3g} kg, beyond the usual {EXTENTS[0]:g} to "
            f"{EXTENTS[1]:g} m: {remedy}"
        )
    elif not MASSES[0] <= mass <= MASSES[1]:
        source = "the file of cloth.springs" if cloth.springs else "material.density, which is in kg/m^2"
        sentences.append(
            f"{name} has a mass of {mass:.3g} kg, beyond the usual {MASSES[0]:g} to {MASSES[1]:g} kg: look at {source}"
        )
    resolution = cloud_resolution(x, double=scene.points.double)
    if resolution > scene.tolerance > 0.0 and not scene.step:
        remedy = "" if scene.points.double else ", or set points.double: true"
        sentences.append(
            f"clouds resolve {resolution:.2g} m at {float(np.abs(x).max()):.4g} m from the origin of "
            f"'{scene.frame_id}', coarser than the tolerance of {scene.tolerance:g} m: choose a nearer frame "
            f"(frame_id){remedy}"
        )
    return [*sentences, *_obstacle_sizes(scene)]


def cloud_resolution(x: Array, *, double: bool) -> float:
    """Return the distance [m] of adjacent floating-point numbers in a cloud, at its largest coordinate.

    Args:
        x: positions [m], (3, n).
        double: True for double precision.
    """
    farthest = np.abs(x).max()
    return float(np.spacing(farthest if double else np.float32(farthest)))


def _obstacle_sizes(scene: Scene) -> list[str]:
    """Return a sentence on each obstacle whose mesh has an implausible extent."""
    sentences: list[str] = []
    for solid in scene.solids:
        if solid.vertices is None:
            continue
        extent = _extent(solid.vertices)
        if not OBSTACLE_EXTENTS[0] <= extent <= OBSTACLE_EXTENTS[1]:
            sentences.append(
                f"obstacle '{solid.name}' has an extent of {extent:.3g} m, beyond the usual {OBSTACLE_EXTENTS[0]:g} to "
                f"{OBSTACLE_EXTENTS[1]:g} m: if its file is not in metres, set {solid.name}.scale "
                f"({_scale_hint(extent)})"
            )
    return sentences


def _extent(points: NDArray[np.float64]) -> float:
    """Return the diagonal of the bounding box of points (n, 3) [m]."""
    x, y, z = np.ptp(points, axis=0).tolist()
    return math.sqrt(x * x + y * y + z * z)


def _scale_hint(extent: float) -> str:
    """Return, for a message, an example of the scale that corrects an implausible extent [m]."""
    return "0.001 for millimetres" if extent > 1.0 else "e.g. 1000"
