# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands that come while a frame takes too long: the next frame takes them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from cloth_sim_ros.ros.clock import Due, WallPacer

RATE = 50.0


class Executor:
    """Serves the pacer's guard condition, a turn at a time, and hands over commands first, as an executor does."""

    def __init__(self) -> None:
        self.sent = self.received = 0
        self._seen = 0
        self._requested = threading.Event()
        self._serve: Callable[[], None] = lambda: None
        self.node: Any = SimpleNamespace(
            create_guard_condition=self._guard,
            destroy_guard_condition=lambda _: None,
            get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=time.time_ns())),
        )

    def settled(self) -> bool:
        """Return whether no command was received since the last call."""
        received, self._seen = self.received > self._seen, self.received
        return not received

    def spin(self, until: Callable[[], bool]) -> None:
        while not until():
            if self._requested.wait(0.002):
                self._requested.clear()
                self.received = self.sent
                self._serve()

    def _guard(self, serve: Callable[[], None]) -> Any:
        self._serve = serve
        return SimpleNamespace(trigger=self._requested.set)


@pytest.mark.parametrize("factor", [1.3, 2.6])
def test_frame_after_a_long_one_takes_what_came_meanwhile(factor: float) -> None:
    executor = Executor()
    left = list[int]()

    def on_frame_tick(_tick: Due) -> None:
        left.append(executor.sent - executor.received)
        # The frame takes longer than its period; a command comes meanwhile.
        threading.Event().wait(factor / RATE)
        executor.sent += 1

    pacer = WallPacer(executor.node, rate=RATE, on_due=on_frame_tick, settled=executor.settled, beside=True)
    pacer.start()
    executor.spin(lambda: len(left) >= 12)
    assert pacer.stop()
    # The first of a silence may run beside the executor.
    assert left[2:12] == [0] * 10
