# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Anchored particles hold the place that they have: without a force on them, their velocity would last."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.sheets.raw import RawSprings
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene


def stop(state: State, particles: NDArray[np.int64]) -> None:
    """Let particles stand still."""
    if state.v[:, particles].any():
        state.v = state.v.copy()
        state.v[:, particles] = 0.0


def hold(scene: Scene, state: State) -> None:
    """Let the anchored particles of a scene stand still, at a start: a state may have been saved with other anchors.

    Those of raw springs move as their file has it.
    """
    if not isinstance(scene.sheet, RawSprings):
        stop(state, np.array(scene.anchored_particles(), dtype=np.int64))
