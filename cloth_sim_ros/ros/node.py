# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cloth node, which connects a simulation to the graph."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, Self

from rclpy.clock import Clock, ClockType
from rclpy.logging_service import LoggingService
from rclpy.parameter_service import ParameterService

from cloth_sim_ros.ros.accuracy.accuracy_switch import AccuracySwitch
from cloth_sim_ros.ros.check.feasibility import check_feasibility
from cloth_sim_ros.ros.check.performance_estimate import PerformanceEstimator, measure_step_cost
from cloth_sim_ros.ros.io import parameters
from cloth_sim_ros.ros.io.commands import CommandSubscriptions
from cloth_sim_ros.ros.io.obstacles import ObstacleTopics
from cloth_sim_ros.ros.io.outputs import ClothTopics
from cloth_sim_ros.ros.io.services import Services
from cloth_sim_ros.ros.io.states import States
from cloth_sim_ros.ros.io.tf_broadcaster import TfBroadcaster
from cloth_sim_ros.ros.io.tf_follower import TfFollower
from cloth_sim_ros.ros.io.tf_frames import FrameTransformer
from cloth_sim_ros.ros.process.failure import FailureGuard
from cloth_sim_ros.ros.process.shut_down import ignore_errors_after_shutdown
from cloth_sim_ros.ros.process.stopping import StopRequestedError
from cloth_sim_ros.ros.process.worker_thread import InterruptibleLock, run_inline
from cloth_sim_ros.ros.recording.initial_state import describe_left_out
from cloth_sim_ros.ros.recording.recording import SessionRecording
from cloth_sim_ros.ros.recording.recording_control import RecordingControl
from cloth_sim_ros.ros.recording.rosout_recorder import RosoutRecorder
from cloth_sim_ros.ros.reporting import diagnostics
from cloth_sim_ros.ros.reporting.first_contact import FirstContact
from cloth_sim_ros.ros.reporting.frame_log import FrameLog
from cloth_sim_ros.ros.reporting.gripper_speed import GripperSpeedMonitor
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.reporting.report import DiagnosticsCollector, LatestFrame, log_start
from cloth_sim_ros.ros.timing.clock_pause import ClockPause
from cloth_sim_ros.ros.timing.cloth_clock import ClothClock
from cloth_sim_ros.ros.timing.deadline_monitor import DeadlineMonitor
from cloth_sim_ros.ros.timing.event_queue import EventQueue
from cloth_sim_ros.ros.timing.pacer import ClockPacer, FrameTick, Pacer, WallPacer
from cloth_sim_ros.ros.timing.sim_time import SIM_TIME
from cloth_sim_ros.ros.timing.stepper import Stepper
from cloth_sim_ros.ros.timing.tolerance_governor import ToleranceGovernor
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation.events import Reset, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

#: Period of maintenance [s]; also the longest time until a signal is noticed.
_MAINTENANCE_PERIOD = 0.25
#: Publication period of a paused cloth [s]: late subscribers receive it, and recordings stay small.
_PAUSED_PERIOD = 1.0


class ClothNode:
    """A live cloth. `node` is added to an executor, `start` starts time, `close` ends the recording.

    The ROS node is an attribute, not a base class, so that names can't clash with rclpy's.

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
        self._serves_parameters = options.pop("start_parameter_services", True)
        self._serves_log_levels = options.pop("enable_logger_service", True)
        self.node = parameters.SceneNode(name, start_parameter_services=False, **options)
        scene = parameters.declare(self.node)
        self._run_job = run_job
        self._log = ThrottledLog(self.node.get_logger())
        self._log.flush()
        self._simulation = Simulation(scene)
        check_feasibility(scene, self._simulation)
        if self._simulation.state.dropped_memory:
            self._log.info("initial state", describe_left_out(self._simulation))
        # Protects the cloth and the queue. With several executor threads, services run concurrently with frames, and
        # any thread may set parameters.
        self._lock, self._in_timer_thread = InterruptibleLock(signal_name or str), signal_name is not None
        self._queue = EventQueue()
        self._frames = FrameTransformer(self.node, scene.frame_id)
        self._stepper = Stepper(self._simulation, self._queue, run_job=run_job)
        self._failure = FailureGuard(self.node, self._simulation, self._queue, self._stepper, lock=self._lock)
        self._clock_pause = ClockPause(self._simulation, self._queue)
        self._recording = SessionRecording(
            node_name=self.node.get_fully_qualified_name(),
            simulation=self._simulation,
            settings=lambda: self._parameters.accepted.record,
        )
        self._outputs = ClothTopics(self.node, scene, self._recording)
        self._cloth_clock = ClothClock(self.node, self._recording)
        self._states = States(self.node, self._simulation, self._recording)
        self._broadcaster = TfBroadcaster(self.node, self._simulation, self._recording)
        self._commands = CommandSubscriptions(
            self.node,
            grippers=scene.gripper_names,
            queue=self._queue,
            check=self._simulation.check,
            frames=self._frames,
            sink=self._recording,
            log=self._log,
            lock=self._failure.callback_lock,
        )
        self._gripper_speed = GripperSpeedMonitor(self._simulation, self._log)
        self._tf_follower = TfFollower(self._simulation, self._frames, self._commands.last_target_time, self._log)
        self._obstacles = ObstacleTopics(self.node, self._simulation, self._commands, self._recording, self._log)
        self._services = Services(
            self.node,
            grippers=scene.gripper_names,
            queue=self._queue,
            paused=lambda: self._clock_pause.user_paused,
            record=lambda begin, answer: self._record(begin, answer),
            save_state=self._recording.save_state,
            seconds=time.monotonic,
            lock=self._lock,
            refusal=lambda: self._failure.refusal,
        )
        self._parameters = parameters.LiveParameters(
            self.node,
            scene,
            lambda values: self._queue.put(SetParameters(values), reserved=True),
            self._check_parameters,
            self._lock,
        )
        self.tally = diagnostics.FrameTally()
        self._governor = ToleranceGovernor(self._simulation, self._log)
        self._performance = PerformanceEstimator(self._simulation, self.node.get_logger())
        self._accuracy_switch = AccuracySwitch(self._simulation, self._log)
        self._parameters_changed = self._follows_clock = False
        self._deadlines = DeadlineMonitor(period=scene.period, log=self._log)
        self._frame_log = FrameLog(self._log)
        self._first_contact = FirstContact(self._simulation)
        self._latest = LatestFrame()
        sources = (self._governor, self._performance, self._accuracy_switch, self._obstacles)
        self._report = DiagnosticsCollector(
            self.node,
            self._simulation,
            self._latest,
            tally=self.tally,
            commands=self._commands,
            outputs=self._outputs,
            recording=self._recording,
            additional=lambda: {name: value for source in sources for name, value in source.describe().items()},
            user_paused=lambda: self._clock_pause.user_paused,
            clock=lambda: self._pacer.describe() if isinstance(self._pacer, ClockPacer) else None,
        )
        self._diagnostics = diagnostics.DiagnosticsPublisher(self.node, self._recording, self._report)
        self._rosout_recorder = RosoutRecorder(self.node, self._recording, self._failure.callback_lock)
        self._recording_control = RecordingControl(
            self.node,
            self._recording,
            self._rosout_recorder,
            latched=(self._outputs.record_topology, self._obstacles.record, self._states.record),
            refusal=lambda: self._failure.refusal,
        )
        self._record = self._recording_control.switch
        self._failure.set_reports(
            {
                "recording": lambda *_: self._recording.discard(),
                "parameters": lambda *_: self._parameters.return_to(self._simulation.scene),
                "diagnostics.accuracy": lambda *_: self._accuracy_switch.close(),
                "~/state": self._states.fail,
                "services": self._services.fail,
                "/diagnostics": lambda reason, _: self._report_failure(reason),
                "the session": self._recording_control.fail,
            },
            recover=self._latest.clear_exception,
        )
        self._pacer: Pacer | None = None
        self._next_report_time = time.monotonic()
        self._last_published: float | None = None
        self._extras: dict[str, Any] = {}
        #: True if a signal came before a frame ended. The frame goes on, and the cloth must not be read.
        self.frame_aborted = False
        #: After `close`: true if the file holds everything recorded.
        self._saved: bool | None = None

    @property
    def simulation(self) -> Simulation:
        """The cloth."""
        return self._simulation

    @property
    def published(self) -> int:
        """Number of clouds published."""
        return self._outputs.published

    def warm_up(self) -> None:
        """Measure the step cost with a temporary copy of the cloth, and load the libraries for recording.

        Raises:
            ValueError: if the scene can't be stepped.
            StopRequestedError: if a signal came meanwhile.
        """
        self._performance.calibrate(self._run_job(lambda: measure_step_cost(self._simulation.scene)))
        self._recording.prepare()

    def start(self) -> None:
        """Start the recording if `record.enabled`, then publishers, subscriptions, services and the pacer.

        Raises:
            RecordingUnavailableError: if the recording can't start although its libraries are installed.
        """
        scene = self._simulation.scene
        now = self.node.get_clock().now().nanoseconds
        if scene.record.enabled:
            self._recording_control.begin_with_node(now)
        self._outputs.start(now)
        self._obstacles.start(now)
        self._commands.subscribe()
        self._services.serve()
        if self._serves_parameters:
            ParameterService(self.node)
        if self._serves_log_levels:
            LoggingService(self.node)
        self._follows_clock = bool(self.node.get_parameter(SIM_TIME).value)
        self._governor.live = not self._follows_clock
        if self._follows_clock:
            self._pacer = ClockPacer(
                self.node,
                rate=scene.rate,
                on_tick=self._on_tick,
                is_drained=self._commands.is_drained,
                on_jump_back=self._on_jump_back,
                on_jump_forward=self._on_jump_forward,
            )
        else:
            is_drained, in_timer_thread = self._commands.is_drained, self._in_timer_thread
            self._pacer = WallPacer(
                self.node,
                rate=scene.rate,
                on_tick=self._on_tick,
                is_drained=is_drained,
                in_timer_thread=in_timer_thread,
            )
        self.node.create_timer(_MAINTENANCE_PERIOD, self._maintain, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if not self._follows_clock:
            self._performance.report()
        self._next_report_time = time.monotonic() + diagnostics.PERIOD
        self.tally.begin()
        # Last: a subscriber of ~/state may rely on everything else.
        self._states.start(now, waits=self._follows_clock)
        self._pacer.start()
        log_start(self.node.get_logger(), self._simulation, follows_clock=self._follows_clock)
        self._log.debug(lambda: f"Poisson's ratio, which follows from the moduli: {scene.poisson_ratio}")

    def stop(self) -> bool:
        """Stop the pacer; return true if no frame is running."""
        has_ended = self._pacer is None or self._pacer.stop()
        self.frame_aborted |= not has_ended
        return has_ended

    def close(self, *, timeout: float = 1.5) -> bool:
        """End the recording and the node; return true if the file holds everything recorded.

        All entities in the graph and all threads end. If the context was shut down before, as rclpy's signal handlers
        do, nothing is published. A further call returns the same.

        Args:
            timeout: longest wait for the recording's file [s].
        """
        if self._saved is None:
            try:
                # An aborted frame never releases the lock.
                with self._lock if self.stop() else nullcontext():
                    self._saved = self._close(timeout)
            finally:
                self.node.destroy_node()
        return self._saved

    def __enter__(self) -> Self:
        """Return the cloth; the context closes it at its end."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _close(self, timeout: float) -> bool:
        self._accuracy_switch.close()
        self._recording.discard()
        self._queue.clear("the node stops")
        # If a signal aborted a frame, there is no consistent state to report.
        if self._pacer is not None and not self.frame_aborted and self.node.context.ok():
            with ignore_errors_after_shutdown(self.node):
                self._states.end(self.node.get_clock().now().nanoseconds)
                self._diagnostics.send()
                self._outputs.flush()
                self._diagnostics.flush()
        return self._recording_control.end(timeout=timeout)

    # Frames

    def _on_tick(self, tick: FrameTick) -> None:
        with self._lock, ignore_errors_after_shutdown(self.node):
            # An aborted frame still works on the cloth.
            if not self.frame_aborted:
                self._failure.run(lambda: self._frame(tick), tick.stamp)

    def _frame(self, tick: FrameTick) -> None:
        start = time.monotonic()
        first, last = self._clock_pause.events(stands=tick.stands)
        self._recording.before_frame(tick.stamp)
        self._accuracy_switch.before_frame()
        try:
            frame = self._stepper.advance(
                max(tick.stamp, tick.now),
                [*first, *self._tf_follower.events(tick.stamp), *self._governor.events()],
                last=last,
            )
        except StopRequestedError:
            self.frame_aborted = True
        if self.frame_aborted:
            return
        if self._stepper.refused_parameters:
            self.node.get_logger().error(f"parameters are set back: {self._stepper.refused_parameters}")
            self._parameters.return_to(self._simulation.scene)
        if self._stepper.trouble and not self._latest.failure:
            self.node.get_logger().error(
                f"time is stopped: {self._stepper.trouble}; set other parameters or call ~/reset, then ~/pause false"
            )
        self._latest.failure = self._stepper.trouble
        self._accuracy_switch.after_frame(frame)
        self._gripper_speed.check()
        self._parameters_changed |= any(isinstance(event, SetParameters) for event in frame.events)
        is_recent = self._last_published is not None and start - self._last_published < _PAUSED_PERIOD
        if frame.moved or frame.events or not is_recent:
            self._last_published = start
            if (energy := self._simulation.energy_report) is not None:
                self._extras |= {"energy": energy.total, "energy balance": energy.residual}
            self._recording.add_frame(frame, tick.stamp, self._extras)
            self._extras = {}
            state, points = self._simulation.state, self._simulation.scene.points
            velocities = state.v if points.velocity else None
            self._outputs.send(state.x, frame.wrenches, tick.stamp, velocities=velocities, double=points.double)
            self._states.show(frame, tick.stamp)
            self._cloth_clock.send(frame.time)
            self._obstacles.send(frame, tick.stamp)
            self._broadcaster.send(tick.stamp)
        self._recording.commit()
        # Last, because an answer is final.
        self._stepper.answer()
        self._services.answer_grasps(frame)
        self._commands.log_grasps(frame)
        self._frame_log.log(frame)
        self._obstacles.log_recovery(frame)
        self._clock_pause.commit(frame, stands=tick.stands)
        self._latest.advance = frame.advance or self._latest.advance
        elapsed = time.monotonic() - start
        self.tally.add(moved=frame.moved, seconds=elapsed)
        self._governor.add(frame, elapsed)
        if not self._follows_clock and (contacts := self._first_contact.new_contacts(frame)):
            self._deadlines.begin_contact(contacts)
        self.tally.late += self._deadlines.count(
            lateness=tick.lateness, skipped=tick.skipped, seconds=elapsed, follows_clock=self._follows_clock
        )

    def _on_jump_back(self, before: int, now: int) -> None:
        self.node.get_logger().warning(
            f"/clock went back from {before / 1e9:.3f} s to {now / 1e9:.3f} s: the cloth is reset"
        )
        with self._lock:
            self._commands.reset_stamps()
            self._frames.clear()
            self._queue.clear("/clock went back")
            self._queue.put(Reset())
            self._extras = {"clock_jump": [before, now]}

    def _on_jump_forward(self, skipped: int) -> None:
        frames = pluralize(skipped, "frame")
        self._log.warn("ahead", f"/clock jumped forward by more than can be caught up: {frames} skipped")
        with self._lock:
            self._extras = {"skipped": skipped}

    def _report_failure(self, reason: str) -> None:
        self._latest.exception = reason
        self._diagnostics.send()

    def _check_parameters(self, values: dict[str, Any], scene: Scene) -> None:
        check_feasibility(scene, self._simulation)
        self._simulation.check_scene(scene)
        self._queue.evict_target(SetParameters(values))

    # Maintenance

    def _maintain(self) -> None:
        with self._lock:
            # No timer of its own: the executor would check it in each spin.
            now = time.monotonic()
            if now >= self._next_report_time:
                self._next_report_time = max(self._next_report_time, now - _MAINTENANCE_PERIOD) + diagnostics.PERIOD
                self._report.check_duplicate_nodes()
                self._failure.attempt("diagnostics are not published", self._diagnostics.send)
            self._services.expire_requests()
            self._log.flush()
            self._rosout_recorder.update()
            trouble = self._recording.poll()
            self._recording_control.resume()
            self._accuracy_switch.update()
            if self._parameters_changed:
                self._parameters_changed = False
                self._performance.report()
        if trouble:
            self.node.get_logger().error(trouble)
        self._failure.check_exit()
        if isinstance(self._pacer, ClockPacer):
            self._pacer.check()
