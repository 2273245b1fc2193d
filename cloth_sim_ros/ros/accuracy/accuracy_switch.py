# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Switch of the accuracy monitor.

The parameter `diagnostics.accuracy` starts and ends the monitor. While it is false, nothing is loaded or started.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.ros.accuracy.accuracy_monitor import AccuracyMonitor


class AccuracySwitch:
    """Switch of the accuracy monitor by the parameter `diagnostics.accuracy`; it passes frames on to the monitor.

    Args:
        simulation: the cloth.
        log: receives the monitor's warnings.
    """

    def __init__(self, simulation: Simulation, log: ThrottledLog) -> None:
        self._simulation, self._log = simulation, log
        self._monitor: AccuracyMonitor | None = None

    def update(self) -> None:
        """Start or end the monitor as `diagnostics.accuracy` requests; log its warnings. Call it periodically."""
        enabled, monitor = self._simulation.scene.diagnostics.accuracy, self._monitor
        if enabled and monitor is None:
            from cloth_sim_ros.ros.accuracy.accuracy_monitor import AccuracyMonitor

            self._monitor = AccuracyMonitor()
        elif monitor is not None:
            for warning in monitor.take_warnings():
                self._log.warn("accuracy", warning)
            if not enabled:
                self.close()

    def before_frame(self) -> None:
        """Let the accuracy monitor, if it runs, copy the state before a frame as the start of a window."""
        if self._monitor is not None:
            self._monitor.before_frame(self._simulation)

    def after_frame(self, frame: Frame) -> None:
        """Pass a computed frame on to the accuracy monitor, if it runs."""
        if self._monitor is not None:
            self._monitor.after_frame(self._simulation, frame)

    def describe(self) -> dict[str, str]:
        """Return the accuracy monitor's diagnostics entries; `accuracy: off` if it does not run."""
        return {"accuracy": "off"} if self._monitor is None else self._monitor.describe(self._simulation.time)

    def close(self) -> None:
        """Kill the accuracy monitor's process if it runs; `update` starts another while the parameter is true."""
        if self._monitor is not None:
            self._monitor.close()
            self._monitor = None
