# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cloth node, which connects a simulation to the graph."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Self

from rclpy.clock import Clock, ClockType

from cloth_sim_ros.ros.check.feasibility import check_feasibility
from cloth_sim_ros.ros.check.performance_estimate import measure_step_cost
from cloth_sim_ros.ros.io import parameters
from cloth_sim_ros.ros.io.follower_start import FollowerStart
from cloth_sim_ros.ros.io.inputs import Inputs, start_reset
from cloth_sim_ros.ros.io.outputs import Outputs
from cloth_sim_ros.ros.process.failure import FailureGuard, ignore_errors_after_shutdown
from cloth_sim_ros.ros.process.worker_thread import InterruptibleLock, run_inline
from cloth_sim_ros.ros.recording.errors import RecordingNotInstalledError
from cloth_sim_ros.ros.recording.initial_state import describe_left_out
from cloth_sim_ros.ros.recording.recording import SessionRecording
from cloth_sim_ros.ros.recording.recording_control import RecordingControl, RosoutRecorder
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.reporting.report import log_start
from cloth_sim_ros.ros.reporting.reporting import MAINTENANCE_PERIOD, Reporting
from cloth_sim_ros.ros.timing.event_queue import EventQueue
from cloth_sim_ros.ros.timing.frame_timing import FrameTiming
from cloth_sim_ros.ros.timing.pacer import FrameTick
from cloth_sim_ros.ros.timing.stepper import Stepper
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.events import Reset, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.ros.io.robot_start import RobotStart


class ClothNode:
    """A live cloth in the ROS graph: takes commands, computes a frame at each tick, and publishes it.

    Add `node` to an executor; `start` starts time, and `close` ends the recording.
    The ROS node is an attribute, not a base class, so that names can't clash with rclpy's. The parts of a cloth node
    are attributes too: `stepper`, `timing`, `failure`, `recording`, `inputs`, `outputs` and `reporting`.

    Args:
        name: node name, before remapping.
        run_job: runs a long computation and returns its result. It may raise StopRequestedError and abandon the
            computation.
        signal_name: returns the name of the signal that has come; empty if none has. If given, frames without commands
            run in the timer thread, and threads that wait for it poll this function.
        options: further arguments of rclpy's Node: namespace, context, parameter_overrides, ... `start` creates
            subscriptions and services, those for parameters included: everything that is discovered is served.

    Raises:
        ParameterError: if the parameters define no valid cloth.
    """

    def __init__(
        self,
        name: str = "cloth_sim",
        *,
        run_job: Callable[[Callable[[], Any]], Any] = run_inline,
        signal_name: Callable[[], str] | None = None,
        **options: Any,
    ) -> None:
        self.node = parameters.SceneNode(name, **options)
        robot = self._robot_start(signal_name or str)
        followers = FollowerStart(self.node, signal_name or str, robot)
        scene = parameters.declare(self.node, extend=followers.extend)
        log = ThrottledLog(self.node.get_logger())
        log.flush()
        with followers.naming_frames():
            simulation = Simulation(scene)
            placed = [*scene.link_names, *followers.placed]
            if placed and scene.initial_state:
                # The file has them where they were, and the scene where they are.
                simulation.restart(start_reset(scene, placed))
        check_feasibility(scene, simulation)
        if simulation.state.dropped_memory:
            log.info("initial state", describe_left_out(simulation))
        # Protects the cloth and the queue. With several executor threads, services run concurrently with frames, and
        # any thread may set parameters.
        self._lock = InterruptibleLock(signal_name or str)
        self.stepper = Stepper(simulation, EventQueue(), run_job=run_job)
        self.timing = FrameTiming(self.node, self.stepper, log, in_timer_thread=signal_name is not None)
        self.failure = FailureGuard(self.node, self.stepper, self._lock)
        session = SessionRecording(
            node_name=self.node.get_fully_qualified_name(),
            simulation=simulation,
            settings=lambda: self.inputs.parameters.accepted.record,
        )
        self.recording = RecordingControl(
            self.node,
            session,
            RosoutRecorder(self.node, session, self.failure.callback_lock),
            record_latched=lambda stamp: self.outputs.record_latched(stamp),
            refusal=lambda: self.failure.refusal,
        )
        self.inputs = Inputs(self.node, self.timing, self.failure, self.recording, log, robot, followers.frames)
        self.outputs = Outputs(self.node, simulation, self.inputs.commands, session, log)
        if scene.record.topics:
            self._add_bag_topics(session)
        self.reporting = Reporting(self.node, log, self.failure, self.timing, self.inputs, self.outputs, session)
        self.failure.reports = {
            "recording": lambda *_: session.discard(),
            "parameters": lambda *_: self.inputs.parameters.return_to(simulation.scene),
            "diagnostics.accuracy": lambda *_: self.reporting.accuracy.close(),
            "~/state": self.outputs.states.fail,
            "services": self.inputs.fail,
            "/diagnostics": lambda *_: self.reporting.diagnostics.send(),
            "the session": self.recording.fail,
        }

    def _robot_start(self, signal_name: Callable[[], str]) -> RobotStart | None:
        """Return the object that waits for the robot's description and poses; None without `robot.enabled`."""
        if self.node.get_parameter_or("robot.enabled").value is not True:
            return None
        from cloth_sim_ros.ros.io.robot_start import RobotStart

        return RobotStart(self.node, signal_name)

    @property
    def simulation(self) -> Simulation:
        """Live simulation of the cloth, no copy: frames change it."""
        return self.stepper.simulation

    @property
    def published(self) -> int:
        """Number of clouds published on ~/points for subscribers or a recording."""
        return self.outputs.cloth.published

    @property
    def frame_aborted(self) -> bool:
        """True if a signal came before a frame ended. The frame goes on, and the cloth must not be read."""
        return self.stepper.aborted

    def warm_up(self) -> None:
        """Before `start`, measure the step cost with a temporary cloth, and load the libraries for recording.

        Raises:
            ValueError: if the scene can't be stepped.
            StopRequestedError: if a signal came meanwhile.
        """
        self.reporting.performance.calibrate(self.stepper.run_job(lambda: measure_step_cost(self.simulation.scene)))
        self.recording.session.prepare()

    def start(self) -> None:
        """Start the recording if `record.enabled`, then publishers, subscriptions, services and, last, the pacer.

        Raises:
            RecordingUnavailableError: if the recording can't start although its libraries are installed.
        """
        scene, follows_clock = self.simulation.scene, self.timing.follows_clock
        now = self.node.get_clock().now().nanoseconds
        if scene.record.enabled:
            self.recording.begin_with_node(now)
        self.outputs.start(now)
        self.inputs.start()
        self.node.serve()
        self.node.create_timer(MAINTENANCE_PERIOD, self._maintain, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.reporting.start(is_live=not follows_clock)
        # Last: a subscriber of ~/state may rely on everything else.
        self.outputs.states.start(now, waits=follows_clock)
        self.timing.start(
            on_tick=self._on_tick,
            is_drained=self.inputs.commands.is_drained,
            on_jump_back=self._on_jump_back,
            on_jump_forward=self._on_jump_forward,
        )
        log_start(self.node.get_logger(), self.simulation, follows_clock=follows_clock)
        self.reporting.log.debug(lambda: f"Poisson's ratio, which follows from the moduli: {scene.poisson_ratio}")

    def stop(self) -> bool:
        """Stop the pacer, so that no frame begins; if one still runs after 0.2 s, set `frame_aborted`, return false."""
        has_ended = self.timing.stop()
        self.stepper.aborted |= not has_ended
        return has_ended

    def close(self, *, timeout: float = 1.5) -> bool:
        """End recording, child processes and node; return true if no recording ran or its file holds everything.

        All entities in the graph and all threads end. If the context was shut down before, as rclpy's signal handlers
        do, nothing is published. A further call returns the same.

        Args:
            timeout: longest wait for the recording's file [s].
        """
        if self.recording.saved is None:
            try:
                # An aborted frame never releases the lock.
                with self._lock if self.stop() else nullcontext():
                    self._close(timeout)
            finally:
                self.inputs.close()
                self.node.destroy_node()
        return bool(self.recording.saved)

    def __enter__(self) -> Self:
        """Return the cloth without starting it; the context closes it at its end."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _close(self, timeout: float) -> None:
        self.reporting.accuracy.close()
        self.outputs.close_processes()
        self.recording.session.discard()
        self.stepper.queue.refuse("the node stops")
        # If a signal aborted a frame, there is no consistent state to report.
        if self.timing.pacer is not None and not self.frame_aborted and self.node.context.ok():
            with ignore_errors_after_shutdown(self.node):
                self.outputs.states.end(self.node.get_clock().now().nanoseconds)
                self.reporting.diagnostics.send()
                self.outputs.cloth.flush()
                self.reporting.diagnostics.flush()
        self.recording.end(timeout=timeout)

    def _add_bag_topics(self, session: SessionRecording) -> None:
        from cloth_sim_ros.ros.recording.bag_topics import BagTopics

        try:
            session.bag_topics = BagTopics(self.node, self.simulation, session, session.snapshot)
        except RecordingNotInstalledError as error:
            self.node.get_logger().error(str(error))

    def _on_tick(self, tick: FrameTick) -> None:
        with self._lock, ignore_errors_after_shutdown(self.node):
            # An aborted frame still works on the cloth.
            if not self.frame_aborted:
                stamp, last_command = self.timing.stamps(tick)
                if tick.is_set_back:
                    self.inputs.limit_times(last_command)
                self.failure.run(lambda: self._frame(tick), stamp)

    def _frame(self, tick: FrameTick) -> None:
        """Compute one frame with the waiting events, publish it, answer the events and report it."""
        start = time.monotonic()
        first, last = self.timing.clock_pause.events(stands=tick.stands)
        stamp, last_command = self.timing.stamps(tick)
        self.recording.session.before_frame(stamp)
        self.reporting.accuracy.before_frame()
        self.outputs.before_frame()
        first += [*self.inputs.events(stamp, last_command), *self.timing.governor.events()]
        frame = self.stepper.advance(last_command, first, last=last, build_reset=self.inputs.build_reset)
        if frame is None:
            return
        stamp = self.timing.publish_clock(frame, stamp)
        if self.stepper.refused_parameters:
            self.inputs.return_parameters(self.stepper.refused_parameters)
        self.inputs.observe(frame)
        self.reporting.observe(frame, self.stepper.trouble)
        if self.outputs.must_publish(frame, start):
            self.recording.session.extras |= self.outputs.record_extras(frame)
            self.recording.session.add_frame(frame, stamp)
            self.outputs.send(frame, stamp)
        self.outputs.send_late(stamp)
        self.recording.session.commit()
        # Last, because an answer is final.
        self.stepper.answer()
        self.inputs.answer(frame)
        self.reporting.log_frame(frame)
        self.timing.clock_pause.commit(frame, stands=tick.stands)
        self.timing.count(frame, tick, time.monotonic() - start)

    def _on_jump_back(self, before: int, now: int) -> None:
        self.node.get_logger().warning(
            f"/clock went back from {before / 1e9:.3f} s to {now / 1e9:.3f} s: the cloth is reset"
        )
        with self._lock:
            self.inputs.restart_time()
            # Their setters have had the answer that the values are accepted.
            self.stepper.queue.refuse("/clock went back, and the cloth is reset: call again", keep=(SetParameters,))
            self.stepper.queue.put(Reset())
            self.recording.session.extras = {"clock_jump": [before, now]}

    def _on_jump_forward(self, skipped: int) -> None:
        frames = pluralize(skipped, "frame")
        self.reporting.log.warn("ahead", f"/clock jumped forward by more than can be caught up: {frames} skipped")
        with self._lock:
            self.recording.session.extras = {"skipped": skipped}

    def _maintain(self) -> None:
        with self._lock:
            self.reporting.publish_diagnostics()
            self.inputs.expire()
            self.reporting.log.flush()
            trouble = self.recording.update()
            self.reporting.report_changes()
        if trouble:
            self.node.get_logger().error(trouble)
        self.failure.check_exit()
        self.timing.check_clock()
