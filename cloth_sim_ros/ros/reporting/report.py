# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the node: level, summary and values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import attrs
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node

from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.ros.io.commands import CommandSubscriptions
from cloth_sim_ros.ros.io.outputs import ClothTopics
from cloth_sim_ros.ros.process.failure import FailureGuard
from cloth_sim_ros.ros.recording.recording import SessionRecording
from cloth_sim_ros.ros.reporting.strain import StrainGauge
from cloth_sim_ros.ros.timing.frame_timing import FrameTiming
from cloth_sim_ros.scene.plausibility import cloth_size, implausible_sizes
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.simulation import Simulation

#: Level, summary, values.
DiagnosticsReport = tuple[bytes, str, dict[str, str]]


def start_summary(simulation: Simulation, *, follows_clock: bool) -> str:
    """Return the node's first log line: particles, rate, grippers, obstacles and size of the cloth."""
    scene, count = simulation.scene, simulation.state.particle_count
    names = f"grippers: {', '.join(scene.gripper_names) or 'none'}"
    if scene.obstacle_names:
        names += f"; obstacles: {', '.join(scene.obstacle_names)}"
    size = cloth_size(scene, simulation.state.x, simulation.model.masses)
    air = f"; air across the sheet {scene.wind.normal_drag:g} N s/m^3" if scene.wind.normal_drag else ""
    clock = "/clock" if follows_clock else "wall time"
    return f"{count} particles at {scene.rate:g} Hz of {clock}, {names}; {size}{air}"


def log_start(logger: RcutilsLogger, simulation: Simulation, *, follows_clock: bool) -> None:
    """Log the node's first line, and warnings of implausible sizes and of a reduced contact thickness."""
    logger.info(start_summary(simulation, follows_clock=follows_clock))
    for sentence in implausible_sizes(simulation.scene, simulation.state.x, simulation.model.masses):
        logger.warning(sentence)
    if (recovery := simulation.contact_recovery) is not None:
        logger.warning(f"the cloth starts {recovery.describe()}")


class DiagnosticsSource(Protocol):
    """Protocol of a part of the node that adds entries to the diagnostics."""

    def describe(self) -> dict[str, str]:
        """Return this part's diagnostics entries by key."""


@attrs.define(eq=False)
class DiagnosticsCollector:
    """Collector of level, summary and key-value pairs of one message on /diagnostics.

    Args:
        node: the node.
        simulation: the cloth.
        failure: knows whether the node is failed.
        timing: counts of frames, the user's pause, and the state of /clock.
        commands: counts of commands.
        outputs: counts of clouds.
        recording: the recording.
        sources: describe themselves by further values.
    """

    _node: Node
    _simulation: Simulation
    _failure: FailureGuard
    _timing: FrameTiming
    _commands: CommandSubscriptions
    _outputs: ClothTopics
    _recording: SessionRecording
    _sources: Sequence[DiagnosticsSource]
    #: The reason if time is stopped; otherwise empty.
    trouble: str = attrs.field(default="", init=False)
    #: Steps of the newest frame in which time advanced; None before the first.
    advance: Advance | None = attrs.field(default=None, init=False)
    gauge: StrainGauge = attrs.field(init=False)
    _has_duplicates: bool = attrs.field(default=False, init=False)

    def __attrs_post_init__(self) -> None:
        self.gauge = StrainGauge(self._simulation.scene)

    def __call__(self, has_consumers: bool = True) -> DiagnosticsReport:
        """Return level, summary and {key: text}, with rates since the last call; measure strain only for a consumer."""
        period = self._simulation.scene.period
        rates = self._timing.tally.report(period)
        values = {
            "frame": str(self._simulation.frame),
            "simulated_time": f"{self._simulation.time:.6f}",
            "paused": str(self._timing.clock_pause.user_paused).lower(),
            "real_time_factor": f"{rates['real_time_factor']:.4f}",
            "real_time_factor_overall": f"{self._timing.tally.overall_factor(period):.4f}",
            "late_frames": str(self._timing.tally.late),
            "load": f"{rates['load']:.4f}",
            "longest_frame_ms": f"{rates['longest'] * 1e3:.3f}",
            **self._describe_motion(has_consumers),
            **{name: value for source in self._sources for name, value in source.describe().items()},
            "commands_received": str(self._commands.received),
            "commands_refused": str(self._commands.refused),
            "commands_stale": str(self._commands.outdated),
            "clouds_published": str(self._outputs.published),
        }
        status = self._recording.status()
        values["recording"] = (self._recording.missing or "off") if status is None else status.state
        if status is not None:
            values["recording_file"] = str(status.path)
            values["recording_dropped"] = str(status.dropped)
        values = old_keys.add_old_keys(values, old_keys.DIAGNOSTICS)
        if self._failure.reason:
            return DiagnosticStatus.ERROR, f"failed: {self._failure.reason}", values
        if self.trouble:
            return DiagnosticStatus.ERROR, f"stopped: {self.trouble}", values
        if status is not None and status.state == "failed":
            return DiagnosticStatus.ERROR, f"recording failed: {status.error}", values
        clock = self._timing.describe_clock()
        if clock is not None and clock[0] != DiagnosticStatus.OK:
            return *clock, values
        if rates["late"]:
            return DiagnosticStatus.WARN, f"{pluralize(rates['late'], 'frame')} late in the last second", values
        if self._timing.clock_pause.user_paused:
            return DiagnosticStatus.OK, "paused" if clock is None else f"paused; {clock[1]}", values
        if clock is not None:
            return *clock, values
        if self._simulation.asleep:
            return DiagnosticStatus.OK, "asleep: the cloth is at rest", values
        return DiagnosticStatus.OK, "running", values

    def _describe_motion(self, has_consumers: bool) -> dict[str, str]:
        """Return the entries on strain, energy and steps of the newest frame."""
        advance = self.advance
        strain = self.gauge.largest(self._simulation.state.x) if has_consumers else None
        energy = self._simulation.energy_report
        values = {
            "largest_strain": "not measured" if strain is None else f"{strain:.6f}",
            "energy_j": "off" if energy is None else f"{energy.total:.9g}",
        }
        if energy is not None:
            values["energy_work_j"] = f"{energy.work:.6g}"
            values["energy_wind_j"] = f"{energy.wind:.6g}"
            values["energy_dissipated_j"] = f"{energy.dissipated:.6g}"
            if self._simulation.plan.carries_air:
                values["energy_air_j"] = f"{energy.air:.6g}"
            contact = self._simulation.plan.contact
            if contact is not None and contact.force.has_self_friction:
                values["energy_friction_j"] = f"{energy.friction_work:.6g}"
            if energy.recovered:
                values["energy_recovered_j"] = f"{energy.recovered:.6g}"
            values["energy_balance_j"] = f"{energy.residual:.3g}"
        if advance is not None:
            values["steps_per_frame"] = str(advance.steps)
            values["integrator"] = advance.integrator
            values["integrator_reason"] = advance.reason
            values["error_estimate_m"] = "none" if advance.error is None else f"{advance.error:.3g}"
        return values

    def check_duplicate_nodes(self) -> None:
        """Warn once if another node has the same name: services and parameters would reach either of them.

        Separate from the report, because the last report is made while the node stops.
        """
        full_name = (self._node.get_name(), self._node.get_namespace())
        has_duplicates = self._node.get_node_names_and_namespaces().count(full_name) > 1
        if has_duplicates and not self._has_duplicates:
            self._node.get_logger().warning(
                f"there are several nodes {self._node.get_fully_qualified_name()}: give each its own name or "
                "namespace (--ros-args -r __node:=other)"
            )
        self._has_duplicates = has_duplicates
