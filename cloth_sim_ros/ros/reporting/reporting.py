# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reporting part of the node: log lines, diagnostics and the accuracy monitor."""

from __future__ import annotations

import time
from functools import partial

from rclpy.node import Node

from cloth_sim_ros.ros.accuracy.accuracy_switch import AccuracySwitch
from cloth_sim_ros.ros.check.performance_estimate import PerformanceEstimator
from cloth_sim_ros.ros.io.inputs import Inputs
from cloth_sim_ros.ros.io.outputs import Outputs
from cloth_sim_ros.ros.process.failure import FailureGuard
from cloth_sim_ros.ros.recording.recording import SessionRecording
from cloth_sim_ros.ros.reporting.diagnostics import PERIOD, DiagnosticsPublisher
from cloth_sim_ros.ros.reporting.gripper_speed import GripperSpeedMonitor
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.reporting.report import DiagnosticsCollector
from cloth_sim_ros.ros.timing.frame_timing import FrameTiming
from cloth_sim_ros.simulation.events import SetParameters
from cloth_sim_ros.simulation.simulation import Frame

#: Period of the node's maintenance [s]; also the longest time until a signal is noticed.
MAINTENANCE_PERIOD = 0.25


class Reporting:
    """Reports of the node: its log lines on frames, /diagnostics, and the accuracy monitor.

    Args:
        node: the node.
        log: the node's throttled log.
        failure: knows whether the node is failed.
        timing: has the cloth, and knows the node's load, its late frames and its clock.
        inputs: counts commands.
        outputs: counts clouds, and describes obstacles.
        recording: records the diagnostics.
    """

    def __init__(
        self,
        node: Node,
        log: ThrottledLog,
        failure: FailureGuard,
        timing: FrameTiming,
        inputs: Inputs,
        outputs: Outputs,
        recording: SessionRecording,
    ) -> None:
        simulation = timing.stepper.simulation
        self._node, self.log, self._failure, self._inputs, self._outputs = node, log, failure, inputs, outputs
        self.performance = PerformanceEstimator(simulation, node.get_logger())
        self.accuracy = AccuracySwitch(simulation, log)
        self._gripper_speed = GripperSpeedMonitor(simulation, log)
        #: Integrator, reason and step limit of the last frame that was logged at DEBUG.
        self._choice: tuple[str, str, str] | None = None
        optional = tuple(part for part in (outputs.cameras, outputs.ensemble) if part is not None)
        sources = (timing.governor, self.performance, self.accuracy, outputs.obstacles, *optional)
        self.collector = DiagnosticsCollector(
            node, simulation, failure, timing, inputs.commands, outputs.cloth, recording, sources
        )
        self.diagnostics = DiagnosticsPublisher(node, recording, self.collector)
        self._next_report_time = time.monotonic()
        self._parameters_changed = False

    def start(self, *, is_live: bool) -> None:
        """Schedule the first diagnostics; if frames are due by wall time, log the expected real-time factor."""
        if is_live:
            self.performance.report()
        self._next_report_time = time.monotonic() + PERIOD

    def observe(self, frame: Frame, trouble: str) -> None:
        """Examine a frame before it is published: log that time is stopped, check speeds, feed the accuracy monitor."""
        if trouble and not self.collector.trouble:
            self._node.get_logger().error(
                f"time is stopped: {trouble}; set other parameters or call ~/reset, then ~/pause false"
            )
        self.collector.trouble = trouble
        self.accuracy.after_frame(frame)
        self._gripper_speed.check()
        self._parameters_changed |= any(isinstance(event, SetParameters) for event in frame.events)

    def log_frame(self, frame: Frame) -> None:
        """Log results of grasps and reduced contacts of a published frame, and at DEBUG its events and integrator."""
        self._inputs.commands.log_grasps(frame)
        if self.log.debugging:
            self._log_details(frame)
        self._outputs.obstacles.log_recovery(frame)
        self.collector.advance = frame.advance or self.collector.advance

    def publish_diagnostics(self) -> None:
        """Publish diagnostics if a second has passed since the last. Call it periodically, more often than that."""
        now = time.monotonic()
        if now >= self._next_report_time:
            self._next_report_time = max(self._next_report_time, now - MAINTENANCE_PERIOD) + PERIOD
            self.collector.check_duplicate_nodes()
            self._failure.attempt("diagnostics are not published", self.diagnostics.send)

    def report_changes(self) -> None:
        """Start or end the accuracy monitor; log messages of processes and a changed speed. Call it periodically."""
        self.accuracy.update()
        self._outputs.report_processes()
        if self._parameters_changed:
            self._parameters_changed = False
            self.performance.report()

    def _log_details(self, frame: Frame) -> None:
        """Log at DEBUG the events of a frame, and a change of integrator, reason or step limit."""
        for event in frame.events:
            self.log.debug(partial("frame {} applies {}".format, frame.index, event))
        advance = frame.advance
        if advance is None or self._choice == (advance.integrator, advance.reason, advance.limited_by):
            return
        self._choice = advance.integrator, advance.reason, advance.limited_by
        self.log.debug(
            lambda: (
                f"frame {frame.index}: integrator {advance.integrator}, {advance.steps} steps, limited by "
                f"{advance.limited_by}; {advance.reason}"
            )
        )
