# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changes of what acts on all particles alike, after which steps need not be judged anew: gusts come many a second."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.scene.scene import Scene

#: Change of velocity from one frame to the next [m/s] from which a motion counts as jumping.
JUMP = 0.5
_LOADS = frozenset(("gravity", "air.drag", "wind.velocity", "material.damping"))
#: Largest changes for which the step limit is not computed again, since it changes by less than a quarter: of the drag
#: rate times the period [1], and of the springs' damping k_d0 [1].
_THICKER, _DAMPED = 0.04, 0.01


def is_gentle(names: Collection[str], before: Scene, scene: Scene, v: Array) -> bool:
    """Whether a change of parameters adds so little acceleration that the motion does not jump.

    Args:
        names: of the parameters.
        before: the scene in force.
        scene: the one that is to be.
        v: velocities [m/s], shape (3, n).
    """
    if not _LOADS.issuperset(names) or scene.step:
        return False
    thicker = abs(scene.air.drag - before.air.drag)
    damped = abs(scene.material.damping - before.material.damping)
    if thicker * scene.period > _THICKER or damped > _DAMPED:
        return False
    # Acceleration for each m/s of wind that panels add [1/s]: drag over mass, both by area.
    panels = (scene.wind.normal_drag + scene.wind.tangential_drag) / scene.material.density
    speeds = np.abs(v).max(axis=1).tolist() if thicker else (0.0, 0.0, 0.0)
    pushes = zip(scene.gravity, before.gravity, scene.wind.velocity, before.wind.velocity, speeds, strict=True)
    return all(
        abs(new - old)
        + abs(scene.air.drag * wind - before.air.drag * blew)
        + panels * abs(wind - blew)
        + thicker * speed
        <= JUMP / scene.period
        for new, old, wind, blew, speed in pushes
    )
