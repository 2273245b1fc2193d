# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A frame put together by hand from just the engine's calls that it needs: what a simulation is held against."""

from __future__ import annotations

import ctypes

import numpy as np
from support.feature_variants import swinging

from cloth_sim_ros.engine.binding import SUMMARY_NUMBERS, Frame, check, library
from cloth_sim_ros.physics.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.fixed import steps_for
from cloth_sim_ros.physics.integrators.limit import leapfrog_limit
from cloth_sim_ros.scene.scene import Scene


class HandMadeLoop:
    """Frames of a bare grid: at most axial bending, no grippers, no tolerance, no diagnostics.

    The only choice it makes is the number of steps, by the stability limit at the end of the frame before. It uses one
    thread and one call of the engine a frame, whose request is made once. A simulation of such a scene makes the same
    motion, to the last bit.

    Args:
        scene: configuration.

    Raises:
        ValueError: for a scene that it is not made for.
    """

    def __init__(self, scene: Scene) -> None:
        if scene.gripper_names or scene.cloth.mesh or scene.cloth.springs or scene.tolerance:
            raise ValueError("the loop made by hand has no grippers, mesh, raw springs or tolerance")
        if scene.bending.model not in ("none", "axial"):
            raise ValueError(f"the loop made by hand has no bending model '{scene.bending.model}'")
        # Kept: the engine's side of it goes when it does.
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
        #: Positions and velocities of the run that is made, and of the one before, which the next one starts from.
        self._ends = np.empty((1, 2, *self.x.shape)), np.empty((1, 2, *self.x.shape))
        self._frame = Frame(duration=self._period, runs=1, steps=self._counts.ctypes.data, bands=1, combined=1)

    def frame(self) -> None:
        """One frame: its start kept, as many steps as stability asks for, their end looked at.

        Raises:
            ValueError: if the motion does not stay finite.
        """
        self._frame.summary, self._frame.bounds_level = self._summary.ctypes.data, 1
        self.bare_frame()
        if not self._summary[0] < np.inf:
            raise ValueError("the motion did not stay finite")
        self._limit = leapfrog_limit(float(self._summary[1]), float(self._summary[2]))

    def bare_frame(self) -> None:
        """The steps alone: nothing is kept, nothing is looked at."""
        self._counts[0] = self.steps = steps_for(self._period, CONSTANTS.stability_safety * self._limit)
        frame = self._frame
        frame.x0, frame.v0, frame.out = self.x.ctypes.data, self.v.ctypes.data, self._ends[0].ctypes.data
        check(self._library.cloth_frame(self._handle, ctypes.byref(frame)))
        self.x, self.v = self._ends[0][0]
        self._ends = self._ends[1], self._ends[0]
