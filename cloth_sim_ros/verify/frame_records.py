# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of a recorded frame record with the re-run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.simulation.simulation import Frame, Simulation
from cloth_sim_ros.verify.verdict import Findings

#: Parts of a frame record that other arithmetic can change.
_ROUNDING_AFFECTED = frozenset({"the digest of its state", "its steps", "its integrator"})
#: Entries of a frame record's extras from `Frame.extras`.
_FRAME_EXTRAS = frozenset({"poses", "halted"})
#: Entries that decide what a re-run computes, so that other messages show a wrong one; with their value.
_COMMANDS = {"ensemble": "start"}


def compare_record(
    record: FrameRecord,
    frame: Frame,
    simulation: Simulation,
    findings: Findings,
    *,
    topic: str,
    labels: Mapping[str, Any],
) -> None:
    """Compare number, time, steps, digest and extras of a recorded frame with the re-run's; report differences.

    Args:
        record: as recorded.
        frame: of the re-run.
        simulation: after the frame.
        findings: collects the difference.
        topic: topic of the record.
        labels: expected values of extras that place the record in the recording.
    """
    steps = frame.advance.steps if frame.advance else 0
    compared = (
        ("its number", record.frame, frame.index),
        ("its time", record.time, frame.time),
        ("whether it is paused", record.paused, simulation.paused),
        ("its tolerance", record.tolerance, frame.tolerance),
        ("the digest of its state", record.digest, simulation.state.digest()),
        ("its steps", record.steps, steps),
        ("its integrator", record.integrator, frame.integrator),
    )
    for quantity, recorded, rerun in compared:
        if recorded != rerun:
            reason = f"{quantity} ({recorded} was recorded, {rerun} came out)"
            findings.add_difference("frame", reason, rounding=quantity in _ROUNDING_AFFECTED)
            return
    _compare_extras(record, frame, simulation, findings, topic, labels)


def _compare_extras(
    record: FrameRecord,
    frame: Frame,
    simulation: Simulation,
    findings: Findings,
    topic: str,
    labels: Mapping[str, Any],
) -> None:
    energy, expected = simulation.energy_report, frame.extras()
    for key in (*expected, *(("energy",) if energy is not None else ())):
        if key not in record.extras:  # older sessions have no such entries
            findings.count_not_compared(topic, f"'{key}', absent from the record")
    for key, recorded in record.extras.items():
        rerun: Any
        if key in _COMMANDS and recorded == _COMMANDS[key]:
            continue
        if key in _FRAME_EXTRAS:
            rerun = expected.get(key)
            is_wrong = recorded != rerun
        elif key in labels:
            rerun = labels[key]
            is_wrong = recorded != rerun
        elif key == "flagged":
            rerun = frame.advance.flagged if frame.advance else 0
            is_wrong = recorded != rerun
        elif key == "energy" and energy is not None:
            rerun = energy.total
            is_number = isinstance(recorded, float)
            is_wrong = not is_number or not math.isclose(recorded, rerun, rel_tol=1e-9, abs_tol=1e-12)
        else:
            findings.count_not_compared(topic, f"'{key}' of the record")
            continue
        if is_wrong:
            reason = f"its {key} ({recorded} was recorded, {rerun} came out)"
            findings.add_difference("frame", reason, rounding=key not in labels)
