# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Warnings of grippers at their speed limit."""

from __future__ import annotations

from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.simulation.simulation import Simulation


class GripperSpeedMonitor:
    """Monitor that warns when a gripper begins to lag because its target moves faster than its speed limit.

    Args:
        simulation: the cloth.
        log: receives the warnings.
    """

    def __init__(self, simulation: Simulation, log: ThrottledLog) -> None:
        self._simulation, self._log = simulation, log
        self._limit: set[str] = set()

    def check(self) -> None:
        """Warn of grippers that the newest frame limited in speed, unless the one before it did. Call it after each."""
        grippers = self._simulation.grippers
        limited = grippers.speed_limited
        if not limited and not self._limit:
            return
        for name in limited.keys() - self._limit:
            self._log.warn(f"speed {name}", self._warning(name, limited[name]))
        self._limit = set(limited)

    def _warning(self, name: str, requested: float) -> str:
        """Return the warning for a gripper whose target asks for a speed [m/s] above its limit."""
        scene, grippers = self._simulation.scene, self._simulation.grippers
        parameter = individual if (individual := f"{name}.max_speed") in scene.individual else "gripper.max_speed"
        speed = scene.of_gripper(name, "max_speed")
        limit = grippers.max_speed(grippers.names.index(name), speed)
        why, remedy = (parameter, f", or raise {parameter}") if limit == speed else ("the limit of pads", "")
        return (
            f"'{name}' follows its target at {limit:g} m/s, {why}: the target asks for {requested:.3g} m/s; send "
            f"targets that are nearer to each other{remedy}"
        )
