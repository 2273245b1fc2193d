# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hand-written frame loop of the necessary engine calls, as a baseline."""

from __future__ import annotations

import ctypes

import numpy as np
from support.feature_variants import swinging

from cloth_sim_ros.engine.binding import SUMMARY_NUMBERS, FrameRequest, check, library
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit, steps_for
from cloth_sim_ros.scene.scene import Scene


class HandWrittenLoop:
    """Hand-written loop for a bare grid: at most axial bending, no grippers, no tolerance, no diagnostics.

    Its only choice is the number of steps, by the stability limit at the end of the previous frame. It uses one thread
    and one engine call per frame, with a reused request. A simulation of such a scene gives the same bits.

    Args:
        scene: configuration.

    Raises:
        ValueError: for an unsupported scene.
    """

    def __init__(self, scene: Scene) -> None:
        if scene.gripper_names or scene.cloth.mesh or scene.cloth.springs or scene.tolerance:
            raise ValueError("the hand-written loop has no grippers, mesh, raw springs or tolerance")
        if scene.bending.model not in ("none", "axial"):
            raise ValueError(f"the hand-written loop has no bending model '{scene.bending.model}'")
        # The plan owns the engine's data and must stay alive.
        self._plan = scene.plan()
        self._handle = self._plan._handle
        self._library = library()
        self._period = scene.period
        state = swinging(scene)
        self.x, self.v = state.x, state.v
        self._limit = leapfrog_limit(*self._plan.spectral_bounds(self.x))
        #: Steps of the newest frame.
        self.steps = 0
        self._counts = np.zeros(1, dtype=np.int64)
        self._summary = np.zeros(SUMMARY_NUMBERS)
        #: Positions and velocities [m, m/s] of the current run and of the previous one, from which the next starts.
        self._ends = np.empty((1, 2, *self.x.shape)), np.empty((1, 2, *self.x.shape))
        self._frame = FrameRequest(duration=self._period, runs=1, steps=self._counts.ctypes.data, bands=1, combined=1)

    def frame(self) -> None:
        """Run one frame with the stable number of steps, and check its end.

        Raises:
            ValueError: if the motion does not stay finite.
        """
        self._frame.summary, self._frame.bounds_level = self._summary.ctypes.data, 1
        self.bare_frame()
        if not self._summary[0] < np.inf:
            raise ValueError("the motion did not stay finite")
        self._limit = leapfrog_limit(float(self._summary[1]), float(self._summary[2]))

    def bare_frame(self) -> None:
        """Run the steps of a frame without the check."""
        self._counts[0] = self.steps = steps_for(self._period, CONSTANTS.stability_safety * self._limit)
        frame = self._frame
        frame.x0, frame.v0, frame.out = self.x.ctypes.data, self.v.ctypes.data, self._ends[0].ctypes.data
        check(self._library.cloth_frame(self._handle, ctypes.byref(frame)))
        self.x, self.v = self._ends[0][0]
        self._ends = self._ends[1], self._ends[0]
