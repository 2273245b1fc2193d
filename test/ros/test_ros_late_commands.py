# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands during late frames, and executors that are late or do not spin."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from cloth_sim_ros.ros.timing import pacer
from cloth_sim_ros.ros.timing.pacer import EXECUTOR_TIMEOUT, FrameTick, WallPacer

RATE = 50.0


class Executor:
    """Serves the pacer's guard condition one spin at a time and delivers commands first, like an executor."""

    def __init__(self, *, delay: float = 0.0) -> None:
        """Delay: time before each spin [s]."""
        self._delay = delay
        self.sent = self.received = 0
        self._seen = 0
        self._requested = threading.Event()
        self._serve: Callable[[], None] = lambda: None
        self.node: Any = SimpleNamespace(
            create_guard_condition=self._guard,
            destroy_guard_condition=lambda _: None,
            get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=time.time_ns() - self.set_back)),
        )
        #: Time by which the wall clock was set back [ns].
        self.set_back = 0

    def settled(self) -> bool:
        """Return whether no command was received since the last call."""
        received, self._seen = self.received > self._seen, self.received
        return not received

    def spin(self, until: Callable[[], bool]) -> None:
        limit = time.monotonic() + 60.0
        while not until():
            assert time.monotonic() < limit
            if self._requested.wait(0.002):
                self._requested.clear()
                threading.Event().wait(self._delay)
                self.received = self.sent
                self._serve()

    def _guard(self, serve: Callable[[], None]) -> Any:
        self._serve = serve
        return SimpleNamespace(trigger=self._requested.set)


@pytest.fixture
def start_pacer(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """`start_pacer(executor, on_frame_tick)`: frames in the timer thread until the test ends, however busy the
    machine.
    """
    monkeypatch.setattr(pacer, "_STOP_TIMEOUT", 30.0)
    pacers = list[WallPacer]()

    def start(executor: Executor, on_frame_tick: Callable[[FrameTick], None]) -> None:
        pacers.append(
            WallPacer(
                executor.node, rate=RATE, on_tick=on_frame_tick, is_drained=executor.settled, in_timer_thread=True
            )
        )
        pacers[-1].start()

    yield start
    for started in pacers:
        assert started.stop()


@pytest.mark.parametrize(
    ("frame", "delay", "timeout", "count"),
    [
        (1.3 / RATE, 0.0, 30.0, 12),
        (2.6 / RATE, 0.0, 30.0, 12),
        (1.3 / RATE, 1.4 / RATE, 30.0, 12),
        (2.6 / RATE, 1.4 / RATE, 30.0, 12),
        # Each frame, or two spins together, take longer than the timeout.
        (1.8, 1.4 / RATE, 1.5, 4),
        (1.3 / RATE, 0.9, 1.5, 4),
    ],
    ids=["long", "longer", "long-late", "longer-late", "longest-late", "long-latest"],
)
def test_frame_after_a_long_one_takes_waiting_commands(
    start_pacer: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    frame: float,
    delay: float,
    timeout: float,
    count: int,
) -> None:
    monkeypatch.setattr(pacer, "EXECUTOR_TIMEOUT", timeout)
    executor = Executor(delay=delay)
    left = list[int]()

    def on_frame_tick(_tick: FrameTick) -> None:
        left.append(executor.sent - executor.received)
        # The frame takes longer than its period; a command comes meanwhile.
        threading.Event().wait(frame)
        executor.sent += 1

    start_pacer(executor, on_frame_tick)
    executor.spin(lambda: len(left) >= count)
    # The first frame after a silence may run in the timer thread.
    assert left[2:count] == [0] * (count - 2)


def test_frames_wait_for_a_stopped_executor_once_at_most(
    start_pacer: Callable[..., None], wait_until: Callable[..., object]
) -> None:
    executor = Executor(delay=1.4 / RATE)
    threads, skipped = list[int](), list[int]()

    def on_frame_tick(tick: FrameTick) -> None:
        threads.append(threading.get_ident())
        skipped.append(tick.skipped)
        # Late frames: each requests the next spin of the executor.
        threading.Event().wait(1.3 / RATE)

    def is_executors_frame() -> bool:
        return threads[-1:] == [threading.get_ident()]

    start_pacer(executor, on_frame_tick)
    executor.spin(is_executors_frame)
    # A tick came while that frame ran, and the executor does not spin any more.
    count = len(threads)
    wait_until(lambda: len(threads) >= count + 150, description="frames without the executor")
    assert threading.get_ident() not in threads[count:]
    assert skipped[count] >= EXECUTOR_TIMEOUT * RATE - 2
    # The executor spins again, and frames wait for it again.
    executor.spin(is_executors_frame)
    count = len(threads)
    executor.spin(lambda: len(threads) >= count + 10)
    assert threads[count:] == [threading.get_ident()] * 10


def test_frame_after_wall_time_is_set_back_says_so(start_pacer: Callable[..., None]) -> None:
    executor = Executor()
    ticks = list[FrameTick]()

    def on_frame_tick(tick: FrameTick) -> None:
        ticks.append(tick)
        executor.set_back = 60_000_000_000 if len(ticks) >= 5 else 0

    start_pacer(executor, on_frame_tick)
    executor.spin(lambda: len(ticks) >= 10)
    assert [tick.is_set_back for tick in ticks[:10]] == [False] * 5 + [True] + [False] * 4
