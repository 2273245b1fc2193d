# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""When frames are due: by wall time on a steady clock, or when `/clock` reaches them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from fractions import Fraction
from typing import Protocol

import attrs
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.timer import Timer

from cloth_sim_ros.ros.sim_time import ClockSilence, SimTimeNode

_SECOND = 1_000_000_000
#: A difference of stamps and ROS time above this is a jump of the clock, not its drift [ns].
_JUMP = 100_000_000
#: Stamps are left alone while they are this close to ROS time: reading two clocks is no more exact [ns].
_DEAD_BAND = 200_000
#: Reading the clocks took longer than this: the thread was interrupted in between, the reading says nothing [ns].
_READING = 50_000
#: How long a frame under way is waited for at the end [s].
_PATIENCE = 0.2
#: Longest time that frames wait for a requested turn of the executor, from the request or its last turn since [s].
EXECUTOR_TIMEOUT = 0.5
#: When /clock goes ahead by more than this, older frames are left out [s].
CATCH_UP = 1.0
#: /clock stands when its time has not changed for so long, or for so many times its own last interval, within bounds
#: [s].
STANDS_AFTER, _INTERVALS, _MAX_STANDS_AFTER = 2.0, 3.0, 4.0
#: Longest time between two looks at /clock that counts: what lies beyond it the executor was busy [s].
_MAX_INTERVAL = 0.5
#: Shortest period of frames while /clock stands [s]: they only take commands.
_MIN_STANDING_PERIOD = 0.01


@attrs.frozen(kw_only=True)
class Due:
    """A frame that is due."""

    #: ROS time at which it was due [ns].
    stamp: int
    #: How long ago that was, by a steady clock [ns]. Where time is simulated: how much later it begins than real time
    #: allows, one period for each frame since /clock made it due.
    lateness: int
    #: Due times since the frame before that passed without a frame.
    skipped: int
    #: ROS time at which it begins [ns]; when it was due, where that is simulated. One that is late takes what came
    #: since.
    now: int
    #: Whether /clock stands, so that no time is to pass.
    stands: bool = False


class Pacer(Protocol):
    """Calls for frames."""

    def start(self) -> None:
        """Begin; the first frame is due one period later, or at the next multiple of the period of /clock."""

    def stop(self) -> bool:
        """Call for no more frames; return whether none is under way."""

    @property
    def period(self) -> int:
        """Time between two frames [ns], rounded."""


class WallPacer:
    """Frames due by wall time. Where one takes longer than the period the next due times are left out: no spiral.

    A thread of its own waits for their times and asks the executor for a turn: it takes the commands that have arrived,
    then runs the frame. A turn looks at all that the node waits for, and takes as long as the frame of a small cloth.
    So frames may run beside the executor, in that thread, if nothing is to be taken first: no command has come since
    the frame before, that frame was not late, and no turn is pending.

    A turn is pending from the request until the executor begins a frame, however many due times pass meanwhile: the
    executor is late, and frames wait for it. If it takes no turn for `EXECUTOR_TIMEOUT`, it does not spin: frames run
    without it until it takes a turn again.

    Args:
        node: has the guard condition that the executor is asked by.
        rate: frames a second.
        on_due: called for each frame.
        settled: whether all messages that have arrived were taken. In each turn an executor runs timers first, then
            takes one message of each topic, the oldest. If frames take all the time there is, a frame that did not wait
            for `settled` would only see commands that are as old as the middleware's queue is long.
        beside: whether frames may run beside the executor.
    """

    def __init__(
        self,
        node: Node,
        *,
        rate: float,
        on_due: Callable[[Due], None],
        settled: Callable[[], bool],
        beside: bool = False,
    ) -> None:
        self._node = node
        self._beside = beside
        self._on_due = on_due
        self._settled = settled
        self._guard = node.create_guard_condition(self._serve)
        self._clock = node.get_clock()
        self.period = round(_SECOND / rate)
        self._start = 0
        #: Number of the last frame, and of the last due time that was seen to.
        self._last = self._rung = 0
        self._stamp: int | None = None
        self._bell: threading.Thread | None = None
        # Held by the thread that a frame runs in.
        self._running = threading.Lock()
        #: When the pending turn was requested, or the executor's last turn since, by a steady clock [ns]; None if none
        #: is pending. Set before the guard condition is triggered, cleared by the executor only.
        self._pending_since: int | None = None
        self._trouble: BaseException | None = None

    def start(self) -> None:
        self._start = time.monotonic_ns()
        # Held until the end: to wait for a lock costs half of what an event does.
        self._ended = threading.Lock()
        self._ended.acquire()
        self._bell = threading.Thread(target=self._ring, name="due", daemon=True)
        self._bell.start()

    def stop(self) -> bool:
        if self._bell is None:
            return True
        if self._ended.locked():
            self._ended.release()
        self._bell.join(_PATIENCE)
        if self._bell.is_alive():
            return False
        self._bell = None
        self._node.destroy_guard_condition(self._guard)
        return True

    def _number(self) -> int:
        """Number of the newest frame that is due."""
        return (time.monotonic_ns() - self._start) // self.period

    def _ring(self) -> None:
        while True:
            late = self._number() > self._rung
            wait = 0 if late else self._start + (self._rung + 1) * self.period - time.monotonic_ns()
            if self._ended.acquire(timeout=max(0, wait) / _SECOND):
                return
            self._rung = self._number()
            is_concurrent = self._beside and not late and not self._waits_for_executor() and self._settled()
            # While a frame is under way in the executor that one takes no commands, and this one will be late.
            if not is_concurrent or not self._running.acquire(blocking=False):
                self._request_turn()
                continue
            try:
                self._run()
            except BaseException as error:
                # The executor's to raise, whatever it is.
                self._trouble = error
                self._guard.trigger()
                return
            finally:
                self._running.release()

    def _request_turn(self) -> None:
        if self._pending_since is None:
            self._pending_since = time.monotonic_ns()
        self._guard.trigger()

    def _waits_for_executor(self) -> bool:
        """Whether a turn is pending, and the executor has been silent for less than its time limit."""
        since = self._pending_since
        return since is not None and time.monotonic_ns() - since < EXECUTOR_TIMEOUT * _SECOND

    def _note_turn(self) -> None:
        """Note that the executor spins: the time limit of a pending turn begins anew."""
        if self._pending_since is not None:
            self._pending_since = time.monotonic_ns()

    def _serve(self) -> None:
        if self._trouble is not None:
            raise self._trouble
        if self._bell is None:
            return
        self._note_turn()
        if not self._settled():
            self._request_turn()
            return
        # A frame under way that waits for nobody: the next one is rung for.
        if self._running.acquire(blocking=False):
            try:
                self._pending_since = None
                self._run()
            finally:
                # A turn that was requested during the frame could not begin before its end.
                self._note_turn()
                self._running.release()

    def _run(self) -> None:
        now = time.monotonic_ns()
        number = (now - self._start) // self.period
        if number <= self._last:
            return
        skipped = number - self._last - 1
        self._last = number
        due = self._start + number * self.period
        stamp, ros = self._stamped(due, skipped + 1)
        self._on_due(Due(stamp=stamp, lateness=now - due, skipped=skipped, now=ros))

    def _stamped(self, due: int, periods: int) -> tuple[int, int]:
        """ROS time of a steady time: evenly spaced, led slowly where clocks drift apart, jumping where they jump; and
        that of now.
        """
        before = time.monotonic_ns()
        ros = self._clock.now().nanoseconds
        after = time.monotonic_ns()
        measured = ros - (before + after) // 2 + due
        if self._stamp is None:
            self._stamp = measured
            return measured, ros
        even = self._stamp + periods * self.period
        away = measured - even
        if after - before < _READING and abs(away) > _DEAD_BAND:
            most = self.period // 100
            even = measured if abs(away) > _JUMP else even + max(-most, min(most, away))
        self._stamp = even
        return even, ros


class ClockPacer:
    """Frames due when `/clock` reaches multiples of the period: the same stamps however often `/clock` is published.

    When it jumps back, frames begin again from there; when it jumps ahead, those of the last second are made up for.
    When it stands, frames without a motion are called for by wall time, stamped with the time at which it stands.
    """

    def __init__(
        self,
        node: SimTimeNode,
        *,
        rate: float,
        on_due: Callable[[Due], None],
        settled: Callable[[], bool],
        on_jump_back: Callable[[int, int], None],
        on_jump_ahead: Callable[[int], None],
    ) -> None:
        self._node = node
        self._rate = Fraction(rate)
        self._on_due = on_due
        self._settled = settled
        self._on_jump_back = on_jump_back
        self._on_jump_ahead = on_jump_ahead
        self.period = round(_SECOND / rate)
        self._most = max(1, int(CATCH_UP * rate))
        self._next: int | None = None
        self._reached = 0
        self._guard = node.create_guard_condition(self._serve)
        self._jump: object | None = None
        #: Newest time of /clock [ns], and when real time lets the next frame begin, by a steady clock [ns].
        self._now, self._allowed = 0, 0
        #: Whether its time changed since the last look; since when it has not, and the interval before that [s].
        self._changed, self._idle, self._interval = False, 0.0, 0.0
        self._looked = time.monotonic()
        self._silence = ClockSilence(node.get_logger())
        self._standing: Timer | None = None

    def start(self) -> None:
        threshold = JumpThreshold(
            min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1), on_clock_change=True
        )
        self._jump = self._node.get_clock().create_jump_callback(threshold, post_callback=self._moved)
        self._guard.trigger()

    def stop(self) -> bool:
        if self._jump is not None:
            self._jump.unregister()  # type: ignore[attr-defined]
            self._jump = None
            self._end_standing()
            self._node.destroy_guard_condition(self._guard)
        return True

    @property
    def has_clock(self) -> bool:
        """Whether /clock has said anything yet."""
        return self._next is not None or self._node.has_clock_time

    def describe(self) -> tuple[bytes, str] | None:
        """Return level and summary of diagnostics while /clock does not move; None while it does."""
        if not self.has_clock:
            return DiagnosticStatus.WARN, f"waiting for /clock since {self._silence.seconds:.0f} s"
        if self._standing is None:
            return None
        return DiagnosticStatus.OK, f"/clock stands at {self._reached / _SECOND:.3f} s"

    def check(self) -> None:
        """Notice that /clock stands; call it some times a second, from the executor that hears /clock."""
        now = time.monotonic()
        # What an executor that was busy has not taken yet is no sign that nothing came.
        elapsed, self._looked = min(now - self._looked, _MAX_INTERVAL), now
        if not self.has_clock:
            self._silence.look()
            return
        if self._changed:
            self._interval = max(self._idle, 0.5 * self._interval)
            self._changed, self._idle = False, 0.0
            return
        self._idle += elapsed
        patience = min(max(STANDS_AFTER, _INTERVALS * self._interval), _MAX_STANDS_AFTER)
        if self._standing is None and self._jump is not None and self._idle >= patience:
            period = max(self.period / _SECOND, _MIN_STANDING_PERIOD)
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            self._standing = self._node.create_timer(period, self._stand, clock=steady)

    def _stand(self) -> None:
        if self._standing is not None and self._settled():
            self._on_due(Due(stamp=self._reached, lateness=0, skipped=0, now=self._reached, stands=True))

    def _end_standing(self) -> None:
        if self._standing is not None:
            self._node.destroy_timer(self._standing)
            self._standing = None

    def _moved(self, _jump: TimeJump) -> None:
        # Called from within the clock's own update: only say that there is something to do.
        self._changed = True
        self._guard.trigger()

    def _due(self, number: int) -> int:
        return int(number * _SECOND / self._rate)

    def _first_from(self, time: int) -> int:
        """Number of the first due time at or after a time [ns]."""
        number = int(time * self._rate / _SECOND)
        while self._due(number) < time:
            number += 1
        return number

    def _serve(self) -> None:
        now = self._node.get_clock().now().nanoseconds
        if now == 0 and not self._node.has_clock_time:
            return
        if now != self._now:
            if self._next is None or self._due(self._next) > self._now:
                # No frame waits that an earlier message made due.
                self._allowed = time.monotonic_ns()
            self._now = now
        if self._next is None:
            self._next = self._first_from(max(now, 1))
        elif now < self._reached - self.period:
            # A step back of less than a frame needs nothing: no frame is due until /clock is where it was.
            self._next = self._first_from(max(now, 1))
            self._allowed = time.monotonic_ns()
            self._on_jump_back(self._reached, now)
            self._reached = now
        self._reached = max(self._reached, now)
        if self._due(self._next) > now:
            return
        if not self._settled():
            # A turn later: see WallPacer.
            self._guard.trigger()
            return
        behind = self._first_from(now + 1) - self._next
        skipped = max(0, behind - self._most)
        if skipped:
            self._next += skipped
            self._on_jump_ahead(skipped)
        self._end_standing()
        number = self._next
        self._next += 1
        # Each frame may take its period, those of one step of /clock as well.
        lateness = max(0, time.monotonic_ns() - self._allowed)
        self._allowed += self.period
        self._on_due(Due(stamp=self._due(number), lateness=lateness, skipped=skipped, now=self._due(number)))
        if self._due(self._next) <= now:
            # One frame a call, so that commands and services are heard while many are made up for.
            self._guard.trigger()
