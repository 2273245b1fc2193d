# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a shadow says how accurate the cloth is: begun and ended as `diagnostics.accuracy` says.

Without it nothing is loaded, started or kept.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.ros.shadow import Shadow

_OFF = {"accuracy": "off"}


class Accuracy:
    """Holds the shadow, while one is wanted.

    Args:
        simulation: the cloth.
        log: is told what the shadow finds wrong.
    """

    def __init__(self, simulation: Simulation, log: ThrottledLog) -> None:
        self._simulation, self._log = simulation, log
        self._shadow: Shadow | None = None

    def follow(self) -> None:
        """Begin or end as the parameter says, and pass on what the shadow found wrong."""
        wanted, shadow = self._simulation.scene.diagnostics.accuracy, self._shadow
        if wanted and shadow is None:
            from cloth_sim_ros.ros.shadow import Shadow

            self._shadow = Shadow()
        elif shadow is not None:
            for complaint in shadow.complaints():
                self._log.warn("accuracy", complaint)
            if not wanted:
                self.close()

    def before_frame(self) -> None:
        """The next frame begins with the state as it is."""
        if self._shadow is not None:
            self._shadow.before_frame(self._simulation)

    def after_frame(self, frame: Frame) -> None:
        """It ended."""
        if self._shadow is not None:
            self._shadow.after_frame(self._simulation, frame)

    def describe(self) -> dict[str, str]:
        """What there is to say in diagnostics."""
        return _OFF if self._shadow is None else self._shadow.describe(self._simulation.time)

    def close(self) -> None:
        """End the shadow, if there is one."""
        if self._shadow is not None:
            self._shadow.close()
            self._shadow = None
