# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of recorded diagnostics with the re-run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import decode
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.simulation.events import Move, MoveObstacles, Reset, Target
from cloth_sim_ros.simulation.frame import Frame
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify.verdict import Findings

TOPIC, TYPE = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
#: Sums since the start of the node; unknown to a re-run from a later state.
_SUMS = (
    "energy_work_j",
    "energy_wind_j",
    "energy_dissipated_j",
    "energy_friction_j",
    "energy_recovered_j",
    "energy_balance_j",
)
#: Texts that another version may word differently.
_TEXTS = ("integrator", "integrator_reason", "stopped_bodies")
#: Entries that are exact up to printing.
_EXACT = frozenset({"frame", "simulated_time", "paused"})
#: Tolerances of printed numbers: they are rounded, and numpy's order of summation depends on the processor.
_RELATIVE, _ABSOLUTE = 2e-5, 2e-6
#: Maximum number of edges for which the node measures the strain.
_MAX_EDGES = 400_000


class DiagnosticsCheck:
    """Comparison of one node's recorded diagnostics with the re-run.

    Args:
        node: resolved name of the node.
        from_start: True if the recording began with the simulation's first frame.
        findings: collects the differences.
    """

    def __init__(self, node: str, *, from_start: bool, findings: Findings) -> None:
        self._name = f"{node.strip('/')}: cloth"
        self._from_start, self._findings = from_start, findings
        self._advance: Advance | None = None
        self._stopped: set[str] | None = set() if from_start else None
        self._gauge: _StrainGauge | None = None
        self._last = b""

    def observe_frame(self, frame: Frame, simulation: Simulation) -> None:
        """Update step control's report and the set of stopped bodies with a frame of the re-run."""
        self._advance = frame.advance or self._advance
        if any(isinstance(event, Reset) for event in frame.events):
            self._stopped = set()
        if self._stopped is None:
            return
        if self._stopped:
            scene = simulation.scene
            retargeted = {event.obstacle for event in frame.events if isinstance(event, Move)}
            retargeted.update(*(event.obstacles for event in frame.events if isinstance(event, MoveObstacles)))
            retargeted |= {event.gripper for event in frame.events if isinstance(event, Target)}
            self._stopped = (self._stopped - retargeted) & {*scene.obstacle_names, *scene.gripper_names}
        self._stopped |= set(frame.stopped)

    def next_file(self) -> None:
        """Begin another file of the session, whose energy sums restart: they are not compared from there on."""
        self._from_start = False

    def compare(self, message: Message, simulation: Simulation) -> None:
        """Compare a diagnostics message with the simulation after the last frame; report differences."""
        try:
            content = decode(message.data, TYPE)
        except SessionError as error:
            self._findings.add_difference("diagnostics message", f"the diagnostics cannot be read: {error}")
            return
        node_statuses = [status for status in content.status if status.name == self._name]
        if len(node_statuses) < len(content.status) or not node_statuses:
            self._findings.count_not_compared(message.topic, "of another name than the node's")
        if not node_statuses:
            return
        header_error = self._header_error(content, message, node_statuses)
        if header_error:
            self._findings.add_difference("diagnostics message", f"the diagnostics, by {header_error}")
        expected = self._expected(simulation)
        self._findings.count_compared("diagnostics message")
        # An old key is compared like the current one.
        recorded = [
            (old_keys.DIAGNOSTICS.get(pair.key, pair.key), pair.key, pair.value) for pair in node_statuses[0].values
        ]
        unchecked = {f"{key}, which is not there" for key in expected.keys() - {key for key, _, _ in recorded}}
        for key, recorded_key, text in recorded:
            if key == "paused" and text == "false" != expected["paused"]:
                # A node also reports a pause by its user.
                self._findings.count_not_compared(message.topic, "paused, though not by the user: /clock stands still")
            elif key not in expected or (key in _TEXTS and self._findings.verdict.environment):
                unchecked.add(key)
            elif text != expected[key] and (key in _EXACT or not _is_same_number(text, expected[key])):
                self._findings.add_difference(
                    "diagnostics message",
                    f"the diagnostics, by {recorded_key} ({text} is recorded, {expected[key]} came out)",
                    rounding=key not in _EXACT,
                )
                break
        for key in sorted(unchecked):
            self._findings.count_not_compared(message.topic, key)
        self._findings.count_not_compared(message.topic, "level, summary and hardware_id")
        if self._last == message.data:
            self._findings.count_not_compared(message.topic, "the same message once more")
        self._last = message.data

    @staticmethod
    def _header_error(content: Any, message: Message, node_statuses: Sequence[Any]) -> str:
        """Return the wrong part of stamp, frame_id, status and keys, as text; empty if none."""
        if content.header.stamp.sec * 10**9 + content.header.stamp.nanosec != message.publish_time:
            return "their stamp"
        if content.header.frame_id:
            return f"their frame_id ({content.header.frame_id} is recorded, none is due)"
        if len(node_statuses) > 1:
            return "a second status of the node"
        keys = [value.key for value in node_statuses[0].values]
        repeated = [key for key in keys if keys.count(key) > 1]
        return f"{repeated[0]}, which is there twice" if repeated else ""

    def _expected(self, simulation: Simulation) -> dict[str, str]:
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
        texts = {"energy_j": f"{energy.total:.9g}"}
        if simulation.plan.carries_air:
            texts["energy_air_j"] = f"{energy.air:.6g}"
        if self._from_start:
            contact = simulation.plan.contact
            # The energy balance is left out: it is rounding of numpy's sums.
            sums = dict(zip(_SUMS[:3], (energy.work, energy.wind, energy.dissipated), strict=True))
            if contact is not None and contact.force.has_self_friction:
                sums["energy_friction_j"] = energy.friction_work
            if energy.recovered:
                sums["energy_recovered_j"] = energy.recovered
            texts |= {key: f"{value:.6g}" for key, value in sums.items()}
        return texts

    @staticmethod
    def _step(advance: Advance | None) -> dict[str, str]:
        if advance is None:
            return {}
        return {
            "steps_per_frame": str(advance.steps),
            "integrator": advance.integrator,
            "integrator_reason": advance.reason,
            "error_estimate_m": "none" if advance.error is None else f"{advance.error:.3g}",
        }

    def _contacts(self, simulation: Simulation) -> dict[str, str]:
        gaps, contact, texts = simulation.gaps(), simulation.plan.contact, dict[str, str]()
        if gaps is not None and len(gaps):
            texts = {"contacts": str(int(gaps[:, 0].sum())), "smallest_gap_m": f"{gaps[:, 1].min():.6g}"}
            if self._stopped is not None:
                texts["stopped_bodies"] = ", ".join(sorted(self._stopped)) or "none"
        if contact is not None and contact.force.surface is not None:
            count, gap = contact.self_gaps(simulation.state.x)
            texts |= {"self_contacts": str(count), "self_smallest_gap_m": f"{gap:.6g}"}
        return texts


class _StrainGauge:
    """Gauge of the largest strain of a cloth's edges."""

    def __init__(self, scene: Scene) -> None:
        triangles, rest_positions = scene.sheet.triangles(), scene.sheet.positions()
        edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        edges = np.unique(np.sort(edges, axis=1), axis=0)
        lengths = np.linalg.norm(rest_positions[edges[:, 1]] - rest_positions[edges[:, 0]], axis=1)
        self._edges, self._lengths = edges[lengths > 0.0].T, lengths[lengths > 0.0]

    def largest(self, x: Array) -> float | None:
        """Return the largest strain of an edge at x [m], shape (3, n); None if the node does not measure this mesh."""
        if not 0 < len(self._lengths) <= _MAX_EDGES:
            return None
        edge_lengths = np.linalg.norm(x[:, self._edges[0]] - x[:, self._edges[1]], axis=0)
        return float((edge_lengths / self._lengths).max() - 1.0)


def _is_same_number(recorded: str, expected: str) -> bool:
    """Return True if two texts are numbers that differ by rounding only; False for two integers."""
    try:
        recorded_number, rerun_number = float(recorded), float(expected)
    except ValueError:
        return False
    are_integers = not set(recorded + expected) & set(".en")
    return not are_integers and math.isclose(recorded_number, rerun_number, rel_tol=_RELATIVE, abs_tol=_ABSOLUTE)
