# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A frame put together by hand from just the kernels that it needs: what a general simulation is held against."""

from __future__ import annotations

from cloth_sim_ros.bench.skip_scenes import swinging
from cloth_sim_ros.physics.integrators.fixed import SAFETY, steps_for
from cloth_sim_ros.physics.integrators.march import leapfrog_limit
from cloth_sim_ros.physics.kernels.grid_bounds import GridBounds
from cloth_sim_ros.physics.kernels.grid_leapfrog import GridLeapfrog
from cloth_sim_ros.physics.kernels.grid_springs import GridSprings
from cloth_sim_ros.physics.kernels.leapfrog import all_finite
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.scene_physics import grid_threads_of


class HandMadeLoop:
    """The frames of a grid without grippers, bending beyond axial springs, tolerance or anything that looks on.

    Nothing is chosen while it runs but the number of steps: as many as the stability limit at the end of the frame
    before asks for. One thread. A simulation of such a scene makes the same motion, to the last bit.

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
        sheet, material = scene.sheet, scene.material
        families = sheet.families(  # type: ignore[union-attr]
            grid_threads_of(scene, sheet),  # type: ignore[arg-type]
            k_d0=material.damping,
            density=material.density,
            retardation=material.viscosity / material.stretch_modulus,
        )
        springs = GridSprings(*scene.shape, [family for part in families.values() for family in part])
        masses = sheet.masses(material.density)
        self._drag = scene.air.drag
        self._inverse = 1.0 / masses
        self._inverse[scene.anchored_particles()] = 0.0
        gravity = scene.gravity if any(scene.gravity) else None
        self._leapfrog = GridLeapfrog(springs, self._inverse, gravity=gravity, drag=self._drag)
        self._bounds = GridBounds(springs, self._inverse)
        self._period = scene.period
        state = swinging(scene)
        self.x, self.v = state.x, state.v
        self._start = self.x.copy(), self.v.copy()
        self._limit = self._stable_step()
        #: Steps of the newest frame.
        self.steps = 0

    def frame(self) -> None:
        """One frame: its start kept, as many steps as stability asks for, their end looked at.

        Raises:
            ValueError: if the motion does not stay finite.
        """
        self._start[0][:], self._start[1][:] = self.x, self.v
        self.bare_frame()
        if not all_finite(self.x, self.v):
            raise ValueError("the motion did not stay finite")
        self._limit = self._stable_step()

    def bare_frame(self) -> None:
        """The steps alone: nothing is kept, nothing is looked at."""
        self.steps = steps_for(self._period, SAFETY * self._limit)
        self._leapfrog.advance(self.x, self.v, self.steps, self._period / self.steps)

    def _stable_step(self) -> float:
        omega2, damping = self._bounds.rates(self.x)
        return leapfrog_limit(omega2, damping + self._drag)
