# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Snapshots of a simulation, taken in microseconds.

A snapshot holds everything that later frames read. Planners use it for rollouts, and a failed frame is undone with it.
Nothing is copied, because a frame replaces arrays and never writes to them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import attrs

from cloth_sim_ros.physics.model.controls import Controls
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.frame import Frame

if TYPE_CHECKING:
    from cloth_sim_ros.simulation import energy_watch
    from cloth_sim_ros.simulation.energy_watch import EnergyReport


# Without slots: then attrs sets a frozen class's members in half the time.
@attrs.frozen(kw_only=True, eq=False, slots=False)
class Snapshot:
    """Full content of a simulation between two frames, for `Simulation.restore`; it can be pickled.

    Do not change it: other snapshots and later frames share its arrays.
    """

    #: The configuration in force.
    scene: Scene
    #: The state, and the one that a reset restores.
    state: State
    initial: State
    #: Controls of the last frame.
    controls: Controls
    #: Integrals of the last frame, and the energy balance.
    accumulator: tuple[Array, float, float, float] | None
    energy: tuple[energy_watch.SavedBalance, EnergyReport | None] | None
    #: True if the rest of a sleeping cloth was verified, and the frame that it repeats.
    sleep: tuple[bool, Frame | None]

    @property
    def frame(self) -> int:
        """Index of the frame that the state has reached."""
        return self.state.frame

    @property
    def time(self) -> float:
        """Simulated time that the state has reached [s]."""
        return self.state.frame * self.scene.period

    @property
    def paused(self) -> bool:
        """True if time stands still, after the event `Pause`."""
        return bool(self.state.memory["paused"][0])

    @property
    def positions(self) -> Array:
        """Particle positions [m], a copy of shape (particle_count, 3)."""
        return self.state.positions

    def check_fits(self, scene: Scene) -> None:
        """Raise ValueError if a scene differs from the snapshot's in a parameter that is not live, or a file.

        Raises:
            ValueError: naming a parameter that differs.
        """
        if self.scene is scene or self.scene == scene:
            return
        live = {entry.name for entry in (*self.scene.entries, *scene.entries) if entry.live}
        old, new = self.scene.parameters(), scene.parameters()
        for name in (name for name in old if name not in live):
            current, recorded = new.get(name), old[name]
            if current != recorded or self._content(self.scene, recorded) != self._content(scene, current):
                mismatch = f"{name} is {recorded!r} there, {current!r} here"
                if current == recorded:
                    mismatch = "its file has other content"
                raise ValueError(
                    f"the snapshot is of another scene: {mismatch}; restore it in a simulation of its own scene"
                )

    @staticmethod
    def _content(scene: Scene, name: Any) -> bytes | None:
        return scene.files.get(name) if isinstance(name, str) else None
