# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Engine pyPBD: springs as compliant distance constraints (XPBD), without damping and drag."""

from __future__ import annotations

from typing import Any

import numpy as np


class PyPbdEngine:
    """See `runner`; one variant."""

    distributions = ("pyPBD",)

    def __init__(self, sheet: dict[str, Any], step: float, variant: str) -> None:
        import pypbd

        simulation = pypbd.Simulation.getCurrent()
        simulation.initDefault()
        self._model = simulation.getModel()
        self._particles = self._model.getParticles()
        masses = np.where(sheet["anchored"], 0.0, sheet["masses"])
        # Its gravity is fixed to 9.81 m/s^2 along -y: the sheet is rotated instead, z to y.
        if sheet["gravity"].tolist() != [0.0, 0.0, -9.81]:
            raise ValueError(f"gravity is {sheet['gravity'].tolist()}; this engine has (0, 0, -9.81) m/s^2")
        for particle, (position, mass) in enumerate(zip(sheet["positions"], masses.tolist(), strict=True)):
            self._particles.addVertex([position[0], position[2], -position[1]])
            self._particles.setMass(particle, mass)
        for (first, second), stiffness in zip(sheet["pairs"].tolist(), sheet["stiffness"].tolist(), strict=True):
            self._model.addDistanceConstraint_XPBD(first, second, stiffness)
        # Colours the constraints before the first step.
        self._model.initConstraintGroups()
        self._stepper = simulation.getTimeStep()
        self._stepper.setValueUInt(pypbd.TimeStepController.NUM_SUB_STEPS, 1)
        self._stepper.setValueUInt(pypbd.TimeStepController.MAX_ITERATIONS, 1)
        pypbd.TimeManager.getCurrent().setTimeStepSize(step)

    def advance(self, steps: int) -> None:
        """Take some steps."""
        for _ in range(steps):
            self._stepper.step(self._model)

    def positions(self) -> Any:
        """Positions [m], (n, 3)."""
        turned = np.array(self._particles.getVertices()).reshape(-1, 3)
        return np.stack([turned[:, 0], -turned[:, 2], turned[:, 1]], axis=1)
