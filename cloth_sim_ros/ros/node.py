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

from cloth_sim_ros.ros import diagnostics, parameters
from cloth_sim_ros.ros.accuracy import Accuracy
from cloth_sim_ros.ros.aside import Turn, at_once
from cloth_sim_ros.ros.broadcast import FrameBroadcaster
from cloth_sim_ros.ros.clock import ClockPacer, Due, Pacer, WallPacer
from cloth_sim_ros.ros.clock_pause import ClockPause
from cloth_sim_ros.ros.cloth_clock import ClothClock
from cloth_sim_ros.ros.commands import Commands
from cloth_sim_ros.ros.companions import Companions
from cloth_sim_ros.ros.event_queue import EventQueue
from cloth_sim_ros.ros.failure import FailureGuard
from cloth_sim_ros.ros.first_contact import FirstContact
from cloth_sim_ros.ros.forecast import Forecaster, try_frames
from cloth_sim_ros.ros.frame_log import FrameLog
from cloth_sim_ros.ros.frames import FrameTransformer
from cloth_sim_ros.ros.gripper_speed import GripperSpeedMonitor
from cloth_sim_ros.ros.initial_state import begins_anew
from cloth_sim_ros.ros.lateness import Lateness
from cloth_sim_ros.ros.log import ThrottledLog
from cloth_sim_ros.ros.obstacles import ObstacleTopics
from cloth_sim_ros.ros.outputs import Outputs
from cloth_sim_ros.ros.overheard import Overheard
from cloth_sim_ros.ros.recording import SessionRecording
from cloth_sim_ros.ros.recording_control import RecordingControl
from cloth_sim_ros.ros.relief import Relief
from cloth_sim_ros.ros.report import Latest, Report, log_start
from cloth_sim_ros.ros.services import Services
from cloth_sim_ros.ros.shut_down import unless_shut_down
from cloth_sim_ros.ros.sim_time import SIM_TIME
from cloth_sim_ros.ros.states import States
from cloth_sim_ros.ros.stepper import Stepper
from cloth_sim_ros.ros.stopping import StopRequestedError
from cloth_sim_ros.ros.workload import refuse_endless_frames
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.words import counted
from cloth_sim_ros.simulation.events import Reset, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

#: Period of maintenance [s]; also the longest time until a signal is noticed.
_HOUSEKEEPING = 0.25
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
        aside: Callable[[Callable[[], Any]], Any] = at_once,
        stopped: Callable[[], str] | None = None,
        **options: Any,
    ) -> None:
        self._serves_parameters = options.pop("start_parameter_services", True)
        self._serves_levels = options.pop("enable_logger_service", True)
        self.node = parameters.SceneNode(name, start_parameter_services=False, **options)
        scene = parameters.declare(self.node)
        self._aside = aside
        self._log = ThrottledLog(self.node.get_logger())
        self._log.settle()
        self._simulation = Simulation(scene)
        refuse_endless_frames(scene, self._simulation)
        if self._simulation.state.left_out:
            self._log.info("initial state", begins_anew(self._simulation))
        # Protects the cloth and the queue. With several executor threads, services run concurrently with frames, and
        # any thread may set parameters.
        self._turn, self._beside = Turn(stopped or str), stopped is not None
        self._queue = EventQueue()
        self._frames = FrameTransformer(self.node, scene.frame_id)
        self._stepper = Stepper(self._simulation, self._queue, aside=aside)
        self._failure = FailureGuard(self.node, self._simulation, self._queue, self._stepper, lock=self._turn)
        self._clock_pause = ClockPause(self._simulation, self._queue)
        self._recording = SessionRecording(
            node_name=self.node.get_fully_qualified_name(),
            simulation=self._simulation,
            settings=lambda: self._parameters.accepted.record,
        )
        self._outputs = Outputs(self.node, scene, self._recording)
        self._cloth_clock = ClothClock(self.node, self._recording)
        self._states = States(self.node, self._simulation, self._recording)
        self._broadcaster = FrameBroadcaster(self.node, self._simulation, self._recording)
        self._commands = Commands(
            self.node,
            grippers=scene.gripper_names,
            queue=self._queue,
            check=self._simulation.check,
            frames=self._frames,
            tape=self._recording,
            log=self._log,
            turn=self._failure.callback_lock,
        )
        self._gripper_speed = GripperSpeedMonitor(self._simulation, self._log)
        self._companions = Companions(self._simulation, self._frames, self._commands.heard, self._log)
        self._obstacles = ObstacleTopics(self.node, self._simulation, self._commands, self._recording, self._log)
        self._services = Services(
            self.node,
            grippers=scene.gripper_names,
            queue=self._queue,
            paused=lambda: self._clock_pause.user_paused,
            record=lambda begin, answer: self._record(begin, answer),
            save_state=self._recording.save_state,
            seconds=time.monotonic,
            turn=self._turn,
            refusal=lambda: self._failure.answer,
        )
        self._parameters = parameters.LiveParameters(
            self.node,
            scene,
            lambda values: self._queue.put(SetParameters(values), promised=True),
            self._check_parameters,
            self._turn,
        )
        self.tally = diagnostics.Tally()
        self._relief = Relief(self._simulation, self._log)
        self._forecaster = Forecaster(self._simulation, self.node.get_logger())
        self._accuracy = Accuracy(self._simulation, self._log)
        self._changed = self._follows_clock = False
        self._lateness = Lateness(period=scene.period, log=self._log)
        self._frame_log = FrameLog(self._log)
        self._first_contact = FirstContact(self._simulation)
        self._latest = Latest()
        further = (self._relief, self._forecaster, self._accuracy, self._obstacles)
        self._report = Report(
            self.node,
            self._simulation,
            self._latest,
            tally=self.tally,
            commands=self._commands,
            outputs=self._outputs,
            recording=self._recording,
            further=lambda: {name: value for one in further for name, value in one.describe().items()},
            user_paused=lambda: self._clock_pause.user_paused,
            clock=lambda: self._pacer.describe() if isinstance(self._pacer, ClockPacer) else None,
        )
        self._diagnostics = diagnostics.Diagnostics(self.node, self._recording, self._report)
        self._overheard = Overheard(self.node, self._recording, self._failure.callback_lock)
        self._recording_control = RecordingControl(
            self.node,
            self._recording,
            self._overheard,
            latched=(self._outputs.record_topology, self._obstacles.record, self._states.record),
            refusal=lambda: self._failure.answer,
        )
        self._record = self._recording_control.switch
        self._failure.report_by(
            {
                "recording": lambda *_: self._recording.discard(),
                "parameters": lambda *_: self._parameters.return_to(self._simulation.scene),
                "diagnostics.accuracy": lambda *_: self._accuracy.close(),
                "~/state": self._states.fail,
                "services": self._services.fail,
                "/diagnostics": lambda reason, _: self._report_failure(reason),
                "the session": self._recording_control.fail,
            },
            recover=self._latest.clear_exception,
        )
        self._pacer: Pacer | None = None
        self._report_due = time.monotonic()
        self._shown: float | None = None
        self._extras: dict[str, Any] = {}
        #: True if a signal came before a frame ended. The frame goes on, and the cloth must not be read.
        self.cut_off = False
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
        self._forecaster.calibrate(self._aside(lambda: try_frames(self._simulation.scene)))
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
        self._commands.listen()
        self._services.serve()
        if self._serves_parameters:
            ParameterService(self.node)
        if self._serves_levels:
            LoggingService(self.node)
        self._follows_clock = bool(self.node.get_parameter(SIM_TIME).value)
        self._relief.live = not self._follows_clock
        if self._follows_clock:
            self._pacer = ClockPacer(
                self.node,
                rate=scene.rate,
                on_due=self._on_due,
                settled=self._commands.settled,
                on_jump_back=self._on_jump_back,
                on_jump_ahead=self._on_jump_ahead,
            )
        else:
            settled, beside = self._commands.settled, self._beside
            self._pacer = WallPacer(self.node, rate=scene.rate, on_due=self._on_due, settled=settled, beside=beside)
        self.node.create_timer(_HOUSEKEEPING, self._keep_house, clock=Clock(clock_type=ClockType.STEADY_TIME))
        if not self._follows_clock:
            self._forecaster.tell()
        self._report_due = time.monotonic() + diagnostics.PERIOD
        self.tally.begin()
        # Last: a subscriber of ~/state may rely on everything else.
        self._states.start(now, waits=self._follows_clock)
        self._pacer.start()
        log_start(self.node.get_logger(), self._simulation, follows_clock=self._follows_clock)
        self._log.debug(lambda: f"Poisson's ratio, which follows from the moduli: {scene.poisson_ratio}")

    def stop(self) -> bool:
        """Stop the pacer; return true if no frame is running."""
        ended = self._pacer is None or self._pacer.stop()
        self.cut_off |= not ended
        return ended

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
                with self._turn if self.stop() else nullcontext():
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
        self._accuracy.close()
        self._recording.discard()
        self._queue.clear("the node stops")
        # If a signal aborted a frame, there is no consistent state to report.
        if self._pacer is not None and not self.cut_off and self.node.context.ok():
            with unless_shut_down(self.node):
                self._states.end(self.node.get_clock().now().nanoseconds)
                self._diagnostics.send()
                self._outputs.flush()
                self._diagnostics.flush()
        return self._recording_control.end(timeout=timeout)

    # Frames

    def _on_due(self, due: Due) -> None:
        with self._turn, unless_shut_down(self.node):
            # An aborted frame still works on the cloth.
            if not self.cut_off:
                self._failure.run(lambda: self._frame(due), due.stamp)

    def _frame(self, due: Due) -> None:
        begun = time.monotonic()
        first, last = self._clock_pause.events(stands=due.stands)
        self._recording.before_frame(due.stamp)
        self._accuracy.before_frame()
        try:
            frame = self._stepper.advance(
                max(due.stamp, due.now),
                [*first, *self._companions.events(due.stamp), *self._relief.events()],
                last=last,
            )
        except StopRequestedError:
            self.cut_off = True
        if self.cut_off:
            return
        if self._stepper.refused_parameters:
            self.node.get_logger().error(f"parameters are set back: {self._stepper.refused_parameters}")
            self._parameters.return_to(self._simulation.scene)
        if self._stepper.trouble and not self._latest.failure:
            self.node.get_logger().error(
                f"time is stopped: {self._stepper.trouble}; set other parameters or call ~/reset, then ~/pause false"
            )
        self._latest.failure = self._stepper.trouble
        self._accuracy.after_frame(frame)
        self._gripper_speed.check()
        self._changed |= any(isinstance(event, SetParameters) for event in frame.events)
        shown = self._shown is not None and begun - self._shown < _PAUSED_PERIOD
        if frame.moved or frame.events or not shown:
            self._shown = begun
            if (energy := self._simulation.energy_report) is not None:
                self._extras |= {"energy": energy.total, "energy balance": energy.residual}
            self._recording.add_frame(frame, due.stamp, self._extras)
            self._extras = {}
            state, points = self._simulation.state, self._simulation.scene.points
            velocities = state.v if points.velocity else None
            self._outputs.send(state.x, frame.wrenches, due.stamp, velocities=velocities, double=points.double)
            self._states.show(frame, due.stamp)
            self._cloth_clock.send(frame.time)
            self._obstacles.send(frame, due.stamp)
            self._broadcaster.send(due.stamp)
        self._recording.commit()
        # Last, because an answer is final.
        self._stepper.answer()
        self._services.show(frame)
        self._commands.show(frame)
        self._frame_log.show(frame)
        self._obstacles.log_recovery(frame)
        self._clock_pause.settle(frame, stands=due.stands)
        self._latest.advance = frame.advance or self._latest.advance
        taken = time.monotonic() - begun
        self.tally.add(moved=frame.moved, seconds=taken)
        self._relief.add(frame, taken)
        if not self._follows_clock and (contacts := self._first_contact.new_contacts(frame)):
            self._lateness.begin_contact(contacts)
        self.tally.late += self._lateness.count(
            lateness=due.lateness, skipped=due.skipped, seconds=taken, follows_clock=self._follows_clock
        )

    def _on_jump_back(self, before: int, now: int) -> None:
        self.node.get_logger().warning(
            f"/clock went back from {before / 1e9:.3f} s to {now / 1e9:.3f} s: the cloth is reset"
        )
        with self._turn:
            self._commands.forget_stamps()
            self._frames.forget()
            self._queue.clear("/clock went back")
            self._queue.put(Reset())
            self._extras = {"clock_jump": [before, now]}

    def _on_jump_ahead(self, skipped: int) -> None:
        left = counted(skipped, "frame")
        self._log.warn("ahead", f"/clock jumped forward by more than can be caught up: {left} skipped")
        with self._turn:
            self._extras = {"skipped": skipped}

    def _report_failure(self, reason: str) -> None:
        self._latest.exception = reason
        self._diagnostics.send()

    def _check_parameters(self, values: dict[str, Any], wanted: Scene) -> None:
        refuse_endless_frames(wanted, self._simulation)
        self._simulation.check_scene(wanted)
        self._queue.make_room(SetParameters(values))

    # Maintenance

    def _keep_house(self) -> None:
        with self._turn:
            # No timer of its own: the executor would check it in each spin.
            now = time.monotonic()
            if now >= self._report_due:
                self._report_due = max(self._report_due, now - _HOUSEKEEPING) + diagnostics.PERIOD
                self._report.look_for_namesakes()
                self._failure.attempt("diagnostics are not published", self._diagnostics.send)
            self._services.give_up_waiting()
            self._log.settle()
            self._overheard.listen()
            trouble = self._recording.poll()
            self._recording_control.follow()
            self._accuracy.follow()
            if self._changed:
                self._changed = False
                self._forecaster.tell()
        if trouble:
            self.node.get_logger().error(trouble)
        self._failure.check_exit()
        if isinstance(self._pacer, ClockPacer):
            self._pacer.check()
