# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pacers: sources of frame ticks, from wall time or from `/clock`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from fractions import Fraction

import attrs
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.timer import Timer

from cloth_sim_ros.ros.timing.sim_time import ClockSilence, SimTimeNode

_SECOND = 1_000_000_000
#: A difference of stamps and ROS time above this is a jump of the clock, not its drift [ns].
_MIN_JUMP = 100_000_000
#: Stamps are not corrected if they are this close to ROS time: reading two clocks is no more exact [ns].
_DEAD_BAND = 200_000
#: If reading the clocks takes longer than this, the thread was interrupted, and the reading is dropped [ns].
_MAX_READING_TIME = 50_000
#: Longest wait for a running frame when the pacer stops [s].
_STOP_TIMEOUT = 0.2
#: Longest time that frames wait for a requested spin of the executor, from the request or its last spin since [s].
EXECUTOR_TIMEOUT = 0.5
#: If /clock jumps forward by more than this, older frames are skipped [s].
MAX_CATCH_UP = 1.0
#: /clock stands if its time has not changed for the first [s], or for so many times its last interval, at most the
#: third [s].
STANDING_TIMEOUT, _STANDING_INTERVALS, _MAX_STANDING_TIMEOUT = 2.0, 3.0, 4.0
#: Longest counted time between two checks of /clock: beyond it the executor was busy [s].
_MAX_CHECK_INTERVAL = 0.5
#: Shortest period of frames while /clock stands [s]; these frames only apply commands.
_MIN_STANDING_PERIOD = 0.01


@attrs.frozen(kw_only=True)
class FrameTick:
    """Request to compute one frame: its stamp and start in ROS time [ns], lateness [ns], and ticks skipped before."""

    #: ROS time of the tick [ns].
    stamp: int
    #: Delay of the frame's start behind the tick, by a steady clock [ns]. With /clock: delay behind the time that real
    #: time allows, one period for each frame since /clock reached the tick.
    lateness: int
    #: Ticks since the previous frame that passed without a frame.
    skipped: int
    #: ROS time at which the frame starts [ns], so that a late frame takes the commands that came since its tick. With
    #: /clock: equal to `stamp`.
    now: int
    #: True if /clock stands; then the frame advances no time.
    stands: bool = False
    #: True if wall time was set back since the previous frame, by more than the time between them.
    is_set_back: bool = False


class WallPacer:
    """Source of a frame tick at each period of wall time; a frame that takes longer skips the ticks that it missed.

    A timer thread waits for each tick and requests a spin of the executor. The executor drains the command queues, then
    runs the frame. A spin checks every entity of the node, which costs as much time as the frame of a small cloth.
    Therefore a frame may run in the timer thread, without the executor. Three conditions must hold: no command has come
    since the previous frame, that frame was not late, and no spin is pending.

    A spin is pending from its request until the executor starts a frame, even if further ticks pass. Frames wait for
    it. If the executor does not spin for `EXECUTOR_TIMEOUT`, frames run in the timer thread until it spins again.

    Args:
        node: owns the guard condition that wakes the executor.
        rate: frames per second [Hz].
        on_tick: called for each frame.
        is_drained: returns true if all arrived messages were taken. In each spin an executor runs timers first, then
            takes the oldest message of each topic. If frames take all the time, the queues stay full. A frame that did
            not wait for `is_drained` would then see old commands only.
        in_timer_thread: allow frames in the timer thread.
    """

    def __init__(
        self,
        node: Node,
        *,
        rate: float,
        on_tick: Callable[[FrameTick], None],
        is_drained: Callable[[], bool],
        in_timer_thread: bool = False,
    ) -> None:
        self._node, self._in_timer_thread, self._on_tick, self._is_drained = node, in_timer_thread, on_tick, is_drained
        self._guard = node.create_guard_condition(self._serve)
        self._clock = node.get_clock()
        self.period = round(_SECOND / rate)
        self._start = 0
        #: Tick index of the last frame, and of the last tick that was handled.
        self._last_frame = self._last_tick = 0
        self._stamp: int | None = None
        #: ROS time at which the previous frame started [ns].
        self._last_start = 0
        self._timer_thread: threading.Thread | None = None
        # Held by the thread that runs a frame.
        self._running = threading.Lock()
        #: Steady time of the pending request, or of the executor's last spin since [ns]; None if no spin is pending.
        #: Set before the guard condition is triggered, cleared by the executor only.
        self._pending_since: int | None = None
        self._error: BaseException | None = None

    def start(self) -> None:
        """Start the timer thread. The first tick comes one period later."""
        self._start = time.monotonic_ns()
        # Held until the end: waiting for a lock costs half as much as waiting for an event.
        self._ended = threading.Lock()
        self._ended.acquire()
        self._timer_thread = threading.Thread(target=self._timer_loop, name="due", daemon=True)
        self._timer_thread.start()

    def stop(self) -> bool:
        """Stop the ticks, and wait at most 0.2 s; return true if no frame is running."""
        if self._timer_thread is None:
            return True
        if self._ended.locked():
            self._ended.release()
        self._timer_thread.join(_STOP_TIMEOUT)
        if self._timer_thread.is_alive():
            return False
        self._timer_thread = None
        self._node.destroy_guard_condition(self._guard)
        return True

    def _tick_index(self) -> int:
        """Return the index of the newest tick: number of periods since the start."""
        return (time.monotonic_ns() - self._start) // self.period

    def _timer_loop(self) -> None:
        """Wait for each tick; run its frame in this thread, or request a spin of the executor."""
        while True:
            is_late = self._tick_index() > self._last_tick
            wait = 0 if is_late else self._start + (self._last_tick + 1) * self.period - time.monotonic_ns()
            if self._ended.acquire(timeout=max(0, wait) / _SECOND):
                return
            self._last_tick = self._tick_index()
            is_concurrent = (
                self._in_timer_thread and not is_late and not self._waits_for_executor() and self._is_drained()
            )
            # While the executor runs a frame it takes no commands, and this frame will be late.
            if not is_concurrent or not self._running.acquire(blocking=False):
                self._request_spin()
                continue
            try:
                self._run()
            except BaseException as error:
                # The executor raises it, whatever it is.
                self._error = error
                self._guard.trigger()
                return
            finally:
                self._running.release()

    def _request_spin(self) -> None:
        if self._pending_since is None:
            self._pending_since = time.monotonic_ns()
        self._guard.trigger()

    def _waits_for_executor(self) -> bool:
        """Return true if a spin is pending and the executor has been silent for less than `EXECUTOR_TIMEOUT`."""
        since = self._pending_since
        return since is not None and time.monotonic_ns() - since < EXECUTOR_TIMEOUT * _SECOND

    def _note_spin(self) -> None:
        """Restart the timeout of a pending spin, because the executor has spun."""
        if self._pending_since is not None:
            self._pending_since = time.monotonic_ns()

    def _serve(self) -> None:
        """Run the due frame in the executor if all commands were taken, else request a spin; raise a timer's error."""
        if self._error is not None:
            raise self._error
        if self._timer_thread is None:
            return
        self._note_spin()
        if not self._is_drained():
            self._request_spin()
            return
        # If the timer thread runs a frame, the next tick requests a spin.
        if self._running.acquire(blocking=False):
            try:
                self._pending_since = None
                self._run()
            finally:
                # A spin that was requested during the frame could not begin before its end.
                self._note_spin()
                self._running.release()

    def _run(self) -> None:
        """Call `on_tick` for the newest tick, unless its frame was already computed."""
        now = time.monotonic_ns()
        index = (now - self._start) // self.period
        if index <= self._last_frame:
            return
        skipped = index - self._last_frame - 1
        self._last_frame = index
        tick_time = self._start + index * self.period
        stamp, start_stamp = self._stamp_of(tick_time, skipped + 1)
        is_set_back, self._last_start = start_stamp < self._last_start, start_stamp
        self._on_tick(
            FrameTick(stamp=stamp, lateness=now - tick_time, skipped=skipped, now=start_stamp, is_set_back=is_set_back)
        )

    def _stamp_of(self, tick_time: int, periods: int) -> tuple[int, int]:
        """Return the ROS time of a tick, evenly spaced, and the present ROS time [ns].

        Stamps are evenly spaced. If the clocks drift apart, stamps are corrected by at most 1 % of the period. They
        jump if the ROS clock jumps.
        """
        before = time.monotonic_ns()
        ros_time = self._clock.now().nanoseconds
        after = time.monotonic_ns()
        measured = ros_time - (before + after) // 2 + tick_time
        if self._stamp is None:
            self._stamp = measured
            return measured, ros_time
        stamp = self._stamp + periods * self.period
        drift = measured - stamp
        if after - before < _MAX_READING_TIME and abs(drift) > _DEAD_BAND:
            max_step = self.period // 100
            stamp = measured if abs(drift) > _MIN_JUMP else stamp + max(-max_step, min(max_step, drift))
        self._stamp = stamp
        return stamp, ros_time


class ClockPacer:
    """Source of a frame tick at each multiple of the period on /clock, however often /clock is published.

    After a jump back, ticks start again from there. After a jump forward, the ticks of the last second are caught up.
    While `/clock` stands, ticks come by wall time with the standing time as stamp; their frames advance no time.
    """

    def __init__(
        self,
        node: SimTimeNode,
        *,
        rate: float,
        on_tick: Callable[[FrameTick], None],
        is_drained: Callable[[], bool],
        on_jump_back: Callable[[int, int], None],
        on_jump_forward: Callable[[int], None],
    ) -> None:
        self._node = node
        self._rate = Fraction(rate)
        self._on_tick, self._is_drained = on_tick, is_drained
        self._on_jump_back, self._on_jump_forward = on_jump_back, on_jump_forward
        self.period = round(_SECOND / rate)
        self._max_catch_up = max(1, int(MAX_CATCH_UP * rate))
        self._next_index: int | None = None
        self._max_stamp = 0
        self._guard = node.create_guard_condition(self._serve)
        self._jump_callback: object | None = None
        #: Newest time of /clock [ns], and earliest start of the next frame in real time, by a steady clock [ns].
        self._now, self._earliest_start = 0, 0
        #: Whether /clock changed since the last check, for how long it has not, and the interval before that [s].
        self._changed, self._idle, self._interval = False, 0.0, 0.0
        self._last_check = time.monotonic()
        self._silence = ClockSilence(node.get_logger())
        self._standing_timer: Timer | None = None

    def start(self) -> None:
        """Start the ticks. The first comes at the next multiple of the period on /clock."""
        threshold = JumpThreshold(
            min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1), on_clock_change=True
        )
        self._jump_callback = self._node.get_clock().create_jump_callback(
            threshold, post_callback=self._on_clock_change
        )
        self._guard.trigger()

    def stop(self) -> bool:
        """Stop the ticks; return true: no frame runs outside the executor."""
        if self._jump_callback is not None:
            self._jump_callback.unregister()  # type: ignore[attr-defined]
            self._jump_callback = None
            self._stop_standing_timer()
            self._node.destroy_guard_condition(self._guard)
        return True

    @property
    def has_clock(self) -> bool:
        """True once a message has come on /clock."""
        return self._next_index is not None or self._node.has_clock_time

    def describe(self) -> tuple[bytes, str] | None:
        """Return level and summary for diagnostics while /clock does not advance; None while it does."""
        if not self.has_clock:
            return DiagnosticStatus.WARN, f"waiting for /clock since {self._silence.seconds:.0f} s"
        if self._standing_timer is None:
            return None
        return DiagnosticStatus.OK, f"/clock stands at {self._max_stamp / _SECOND:.3f} s"

    def check(self) -> None:
        """Detect that /clock stands, and start the ticks by wall time for that case. Call it a few times a second."""
        now = time.monotonic()
        # A busy executor may not have taken the messages that came.
        elapsed, self._last_check = min(now - self._last_check, _MAX_CHECK_INTERVAL), now
        if not self.has_clock:
            self._silence.check()
            return
        if self._changed:
            self._interval = max(self._idle, 0.5 * self._interval)
            self._changed, self._idle = False, 0.0
            return
        self._idle += elapsed
        timeout = min(max(STANDING_TIMEOUT, _STANDING_INTERVALS * self._interval), _MAX_STANDING_TIMEOUT)
        if self._standing_timer is None and self._jump_callback is not None and self._idle >= timeout:
            period = max(self.period / _SECOND, _MIN_STANDING_PERIOD)
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            self._standing_timer = self._node.create_timer(period, self._on_standing_timer, clock=steady)

    def _on_standing_timer(self) -> None:
        if self._standing_timer is not None and self._is_drained():
            self._on_tick(FrameTick(stamp=self._max_stamp, lateness=0, skipped=0, now=self._max_stamp, stands=True))

    def _stop_standing_timer(self) -> None:
        if self._standing_timer is not None:
            self._node.destroy_timer(self._standing_timer)
            self._standing_timer = None

    def _on_clock_change(self, _jump: TimeJump) -> None:
        # Called within the update of the clock: only wake the executor.
        self._changed = True
        self._guard.trigger()

    def _tick_time(self, index: int) -> int:
        return int(index * _SECOND / self._rate)

    def _first_index_from(self, time: int) -> int:
        """Return the index of the first tick at or after a time on /clock [ns]."""
        index = int(time * self._rate / _SECOND)
        while self._tick_time(index) < time:
            index += 1
        return index

    def _serve(self) -> None:
        now = self._node.get_clock().now().nanoseconds
        if now == 0 and not self._node.has_clock_time:
            return
        if now != self._now:
            if self._next_index is None or self._tick_time(self._next_index) > self._now:
                # No tick of an earlier message waits.
                self._earliest_start = time.monotonic_ns()
            self._now = now
        if self._next_index is None:
            self._next_index = self._first_index_from(max(now, 1))
        elif now < self._max_stamp - self.period:
            # A step back of less than a period needs no action: no tick comes until /clock has returned.
            self._next_index = self._first_index_from(max(now, 1))
            self._earliest_start = time.monotonic_ns()
            self._on_jump_back(self._max_stamp, now)
            self._max_stamp = now
        self._max_stamp = max(self._max_stamp, now)
        if self._tick_time(self._next_index) > now:
            return
        if not self._is_drained():
            # One spin later: see WallPacer.
            self._guard.trigger()
            return
        backlog = self._first_index_from(now + 1) - self._next_index
        skipped = max(0, backlog - self._max_catch_up)
        if skipped:
            self._next_index += skipped
            self._on_jump_forward(skipped)
        self._stop_standing_timer()
        index = self._next_index
        self._next_index += 1
        # Each frame may take its period, also if one step of /clock makes several due.
        lateness = max(0, time.monotonic_ns() - self._earliest_start)
        self._earliest_start += self.period
        self._on_tick(
            FrameTick(stamp=self._tick_time(index), lateness=lateness, skipped=skipped, now=self._tick_time(index))
        )
        if self._tick_time(self._next_index) <= now:
            # One frame a call, so that commands and services are served while many frames are caught up.
            self._guard.trigger()
