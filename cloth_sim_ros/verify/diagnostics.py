# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of recorded diagnostics with the re-run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.events import Move, Reset, Target
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.verdict import Findings

TOPIC, TYPE = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
#: Sums since the start of the node; unknown to a re-run from a later state.
_SUMS = (
    "energy_work_j",
    "energy_wind_j",
    "energy_dissipated_j",
    "energy_rubbed_j",
    "energy_recovered_j",
    "energy_balance_j",
)
#: Texts that another version may word differently.
_TEXTS = ("integrator", "integrator_why", "halted")
#: Entries that are exact up to printing.
_EXACT = frozenset({"frame", "simulated_time", "paused"})
#: Tolerances of printed numbers: they are rounded, and numpy's order of summation depends on the processor.
_RELATIVE, _ABSOLUTE = 2e-5, 2e-6
#: Maximum number of edges for which the node measures the strain.
_MOST_EDGES = 400_000


class DiagnosticsCheck:
    """Compares the diagnostics of one node.

    Args:
        node: resolved name of the node.
        from_start: True if the recording began with the simulation's first frame.
        findings: collects the differences.
    """

    def __init__(self, node: str, *, from_start: bool, findings: Findings) -> None:
        self._name = f"{node.strip('/')}: cloth"
        self._from_start, self._findings = from_start, findings
        self._advance: Advance | None = None
        self._halted: set[str] | None = set() if from_start else None
        self._gauge: _StrainGauge | None = None
        self._last = b""

    def follow(self, frame: Frame, simulation: Simulation) -> None:
        """Update the state with a frame of the re-run."""
        self._advance = frame.advance or self._advance
        if any(isinstance(event, Reset) for event in frame.events):
            self._halted = set()
        if self._halted is None:
            return
        if self._halted:
            scene = simulation.scene
            anew = {event.obstacle for event in frame.events if isinstance(event, Move)}
            anew |= {event.gripper for event in frame.events if isinstance(event, Target)}
            self._halted = (self._halted - anew) & {*scene.obstacle_names, *scene.gripper_names}
        self._halted |= set(frame.halted)

    def next_file(self) -> None:
        """Continue from a snapshot: the energy sums restart."""
        self._from_start = False

    def compare(self, message: Message, simulation: Simulation) -> None:
        """Compare diagnostics with the simulation after the last frame."""
        try:
            content = decode(message.data, TYPE)
        except SessionError as error:
            self._findings.difference("diagnostics message", f"the diagnostics cannot be read: {error}")
            return
        own = [status for status in content.status if status.name == self._name]
        if len(own) < len(content.status) or not own:
            self._findings.not_compared(message.topic, "of another name than the node's")
        if not own:
            return
        wrong = self._wrong_frame(content, message, own)
        if wrong:
            self._findings.difference("diagnostics message", f"the diagnostics, by {wrong}")
        again = self._again(simulation)
        self._findings.compared("diagnostics message")
        keys = {value.key for value in own[0].values}
        left = {f"{key}, which is not there" for key in again.keys() - keys}
        for value in own[0].values:
            if value.key == "paused" and value.value == "false" != again["paused"]:
                # A node also reports a pause by its user.
                self._findings.not_compared(message.topic, "paused, though not by the user: /clock stands still")
            elif value.key not in again or (value.key in _TEXTS and self._findings.verdict.environment):
                left.add(value.key)
            elif value.value != again[value.key] and (value.key in _EXACT or not _same(value.value, again[value.key])):
                self._findings.difference(
                    "diagnostics message",
                    f"the diagnostics, by {value.key} ({value.value} is recorded, {again[value.key]} came out)",
                    rounding=value.key not in _EXACT,
                )
                break
        for key in sorted(left):
            self._findings.not_compared(message.topic, key)
        self._findings.not_compared(message.topic, "level, summary and hardware_id")
        if self._last == message.data:
            self._findings.not_compared(message.topic, "the same message once more")
        self._last = message.data

    @staticmethod
    def _wrong_frame(content: Any, message: Message, own: Sequence[Any]) -> str:
        """Return the wrong part of stamp, frame_id, status and keys, as text; empty if none."""
        if content.header.stamp.sec * 10**9 + content.header.stamp.nanosec != message.publish_time:
            return "their stamp"
        if content.header.frame_id:
            return f"their frame_id ({content.header.frame_id} is recorded, none is due)"
        if len(own) > 1:
            return "a second status of the node"
        keys = [value.key for value in own[0].values]
        twice = [key for key in keys if keys.count(key) > 1]
        return f"{twice[0]}, which is there twice" if twice else ""

    def _again(self, simulation: Simulation) -> dict[str, str]:
        values = {
            "frame": str(simulation.frame),
            "simulated_time": f"{simulation.time:.6f}",
            "paused": str(simulation.paused).lower(),
        }
        if self._gauge is None:
            self._gauge = _StrainGauge(simulation.scene)
        strain = self._gauge.largest(simulation.state.x)
        if strain is not None:
            values["largest_strain"] = f"{strain:.6f}"
        return values | self._energies(simulation) | self._step(self._advance) | self._contacts(simulation)

    def _energies(self, simulation: Simulation) -> dict[str, str]:
        energy = simulation.energy_report
        if energy is None:
            return {} if simulation.scene.diagnostics.energy else {"energy_j": "off"}
        found = {"energy_j": f"{energy.total:.9g}"}
        if self._from_start:
            contact = simulation.plan.contact
            # The energy balance is left out: it is rounding of numpy's sums.
            sums = dict(zip(_SUMS[:3], (energy.work, energy.wind, energy.dissipated), strict=True))
            if contact is not None and contact.force.layered:
                sums["energy_rubbed_j"] = energy.rubbed
            if energy.recovered:
                sums["energy_recovered_j"] = energy.recovered
            found |= {key: f"{value:.6g}" for key, value in sums.items()}
        return found

    @staticmethod
    def _step(advance: Advance | None) -> dict[str, str]:
        if advance is None:
            return {}
        return {
            "steps_per_frame": str(advance.steps),
            "integrator": advance.integrator,
            "integrator_why": advance.reason,
            "error_estimate_m": "none" if advance.error is None else f"{advance.error:.3g}",
        }

    def _contacts(self, simulation: Simulation) -> dict[str, str]:
        gaps, contact, found = simulation.gaps(), simulation.plan.contact, dict[str, str]()
        if gaps is not None and len(gaps):
            found = {"contacts": str(int(gaps[:, 0].sum())), "smallest_gap_m": f"{gaps[:, 1].min():.6g}"}
            if self._halted is not None:
                found["halted"] = ", ".join(sorted(self._halted)) or "none"
        if contact is not None and contact.force.surface is not None:
            count, gap = contact.own_gaps(simulation.state.x)
            found |= {"self_contacts": str(count), "self_smallest_gap_m": f"{gap:.6g}"}
        return found


class _StrainGauge:
    """Largest strain of a cloth's edges."""

    def __init__(self, scene: Scene) -> None:
        triangles, rest = scene.sheet.triangles(), scene.sheet.positions()
        edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        edges = np.unique(np.sort(edges, axis=1), axis=0)
        lengths = np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)
        self._edges, self._lengths = edges[lengths > 0.0].T, lengths[lengths > 0.0]

    def largest(self, x: Array) -> float | None:
        """Return the largest relative elongation at x [m], shape (3, n); None if the node does not measure it."""
        if not 0 < len(self._lengths) <= _MOST_EDGES:
            return None
        away = np.linalg.norm(x[:, self._edges[0]] - x[:, self._edges[1]], axis=0)
        return float((away / self._lengths).max() - 1.0)


def _same(recorded: str, again: str) -> bool:
    """Return True if two printed numbers differ by rounding only."""
    try:
        one, other = float(recorded), float(again)
    except ValueError:
        return False
    whole = not set(recorded + again) & set(".en")
    return not whole and math.isclose(one, other, rel_tol=_RELATIVE, abs_tol=_ABSOLUTE)
