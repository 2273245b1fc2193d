# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detection of first contacts with obstacles, pinching grippers and the cloth itself."""

from __future__ import annotations

from cloth_sim_ros.simulation.simulation import Frame, Simulation

#: Name of self-contact.
_ITSELF = "itself"


class FirstContact:
    """Detects contacts that begin, once for each.

    Args:
        simulation: the cloth.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._reported: set[str] = set()

    def new_contacts(self, frame: Frame) -> str:
        """Return the names of the contacts that a frame began for the first time, as text; empty if none."""
        contact = self._simulation.plan.contact
        if contact is None or not frame.moved or frame.advance is None or not frame.advance.steps:
            return ""
        scene = self._simulation.scene
        loads = zip(scene.obstacle_names, frame.obstacle_wrenches, strict=False)
        pressed = [name for name, load in loads if name not in self._reported and load.any()]
        if len(self._reported) < len(scene.pinching) + len(scene.obstacle_names):
            wrenches = zip(scene.gripper_names, frame.wrenches, strict=True)
            pressed += [name for name, load in wrenches if self._is_pinched(name) and load.any()]
        new = [f"'{name}'" for name in pressed]
        # Self-contact takes longer to detect: once a second.
        is_sampled = contact.force.surface is not None and not frame.index % max(1, round(scene.rate))
        if is_sampled and _ITSELF not in self._reported and contact.self_gaps(self._simulation.state.x)[0]:
            pressed.append(_ITSELF)
            new.append(_ITSELF)
        self._reported.update(pressed)
        return ", ".join(new)

    def _is_pinched(self, name: str) -> bool:
        return name not in self._reported and self._simulation.scene.pinches(name)
