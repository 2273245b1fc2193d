# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Timing part of the node: pacer, pauses, deadlines and tolerance governor."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from cloth_sim_ros.ros.io.messages import SECOND
from cloth_sim_ros.ros.reporting.diagnostics import FrameTally
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.clock_pause import ClockPause
from cloth_sim_ros.ros.timing.deadline_monitor import DeadlineMonitor, FirstContact
from cloth_sim_ros.ros.timing.pacer import ClockPacer, FrameTick, WallPacer
from cloth_sim_ros.ros.timing.sim_time import SIM_TIME, SimTimeNode
from cloth_sim_ros.ros.timing.stepper import Stepper
from cloth_sim_ros.ros.timing.tolerance_governor import ToleranceGovernor
from cloth_sim_ros.simulation.simulation import Frame

if TYPE_CHECKING:
    from cloth_sim_ros.ros.timing.clock_publisher import ClockPublisher


class FrameTiming:
    """Timing of a node's frames: starts them when due, counts late ones, and governs the tolerance.

    Args:
        node: the node.
        stepper: computes the frames.
        log: receives warnings of late frames.
        in_timer_thread: allow frames without commands in the timer thread.
    """

    def __init__(self, node: SimTimeNode, stepper: Stepper, log: ThrottledLog, *, in_timer_thread: bool) -> None:
        simulation = stepper.simulation
        self._node, self._in_timer_thread, self.stepper = node, in_timer_thread, stepper
        #: True if frames are due by /clock, false if by wall time.
        self.follows_clock = bool(node.get_parameter(SIM_TIME).value)
        self.clock_pause = ClockPause(simulation, stepper.queue)
        self.governor = ToleranceGovernor(simulation, log, live=not self.follows_clock)
        self.tally = FrameTally()
        #: Publisher of /clock; None if the scene publishes none.
        self.clock_publisher: ClockPublisher | None = None
        if simulation.scene.publish_clock:
            from cloth_sim_ros.ros.timing.clock_publisher import ClockPublisher

            self.clock_publisher = ClockPublisher(node, log, simulation.time)
        self._deadlines = DeadlineMonitor(period=simulation.scene.period, log=log)
        self._first_contact = FirstContact(simulation)
        #: Source of the frame ticks; None before `start`.
        self.pacer: WallPacer | ClockPacer | None = None

    def start(
        self,
        *,
        on_tick: Callable[[FrameTick], None],
        is_drained: Callable[[], bool],
        on_jump_back: Callable[[int, int], None],
        on_jump_forward: Callable[[int], None],
    ) -> None:
        """Create and start the pacer; from then on it calls `on_tick` for each frame that is due.

        Args:
            on_tick: computes a frame.
            is_drained: returns true if all arrived commands were taken.
            on_jump_back: takes the times of /clock before and after it went back [ns].
            on_jump_forward: takes the number of frames that a jump of /clock skipped.
        """
        rate = self.stepper.simulation.scene.rate
        if self.follows_clock:
            self.pacer = ClockPacer(
                self._node,
                rate=rate,
                on_tick=on_tick,
                is_drained=is_drained,
                on_jump_back=on_jump_back,
                on_jump_forward=on_jump_forward,
            )
        else:
            self.pacer = WallPacer(
                self._node, rate=rate, on_tick=on_tick, is_drained=is_drained, in_timer_thread=self._in_timer_thread
            )
        self.tally.begin()
        self.pacer.start()

    def stop(self) -> bool:
        """Stop the pacer, and wait at most 0.2 s; return true if no frame is running."""
        return self.pacer is None or self.pacer.stop()

    def count(self, frame: Frame, tick: FrameTick, seconds: float) -> None:
        """Count a frame with its wall time [s] and missed ticks, for diagnostics, deadlines and the governor."""
        self.tally.add(moved=frame.moved, seconds=seconds)
        self.governor.add(frame, seconds)
        if not self.follows_clock and (contacts := self._first_contact.new_contacts(frame)):
            self._deadlines.begin_contact(contacts)
        self.tally.late += self._deadlines.count(
            lateness=tick.lateness, skipped=tick.skipped, seconds=seconds, follows_clock=self.follows_clock
        )

    def check_clock(self) -> None:
        """Check if a followed /clock stands, or if others publish /clock too. Call it a few times a second."""
        if isinstance(self.pacer, ClockPacer):
            self.pacer.check()
        if self.clock_publisher is not None:
            self.clock_publisher.check()

    def stamps(self, tick: FrameTick) -> tuple[int, int]:
        """Return the stamp of a frame's messages, and the ROS time up to which it takes queued events [ns]."""
        if self.clock_publisher is None:
            return tick.stamp, max(tick.stamp, tick.now)
        return self.clock_publisher.now, self.clock_publisher.now + round(SECOND / self.stepper.simulation.scene.rate)

    def publish_clock(self, frame: Frame, stamp: int) -> int:
        """Publish /clock if `publish_clock` is set; return the stamp of a frame's messages [ns].

        Args:
            frame: the frame.
            stamp: the stamp without /clock [ns].
        """
        return stamp if self.clock_publisher is None else self.clock_publisher.send(frame.time)

    def describe_clock(self) -> tuple[bytes, str] | None:
        """Return level and summary for diagnostics while a followed /clock does not advance; otherwise None."""
        return self.pacer.describe() if isinstance(self.pacer, ClockPacer) else None
