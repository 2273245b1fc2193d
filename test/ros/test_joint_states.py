# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Joint positions from joint states: order of stamps, several publishers, refusals."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest

from cloth_sim_ros.ros.io.joint_states import JointStates
from cloth_sim_ros.ros.io.stamps import OldStampError, StampError

SECOND = 1_000_000_000
NOW = 100 * SECOND


def test_states_of_two_publishers_are_combined() -> None:
    states = JointStates(["a", "b", "finger"])
    assert states.add(["b", "other", "a"], [2.0, 9.0, 1.0], 0, NOW)
    assert states.apply(NOW)
    assert states.missing == ["finger"]
    assert states.add(["finger"], [0.1], NOW - 5, NOW)
    assert states.apply(NOW)
    assert states.positions.tolist() == [1.0, 2.0, 0.1]
    assert states.missing == []
    assert not states.apply(NOW)


def test_newest_stamp_counts_and_future_ones_wait() -> None:
    states = JointStates(["a"])
    states.add(["a"], [1.0], NOW, NOW)
    states.add(["a"], [3.0], NOW + 2, NOW)
    states.apply(NOW + 1)
    assert states.positions.tolist() == [1.0]
    assert states.stamp == NOW
    with pytest.raises(OldStampError, match="older than that of the newest"):
        states.add(["a"], [2.0], NOW + 1, NOW)
    assert states.apply(NOW + 2)
    assert states.positions.tolist() == [3.0]
    with pytest.raises(StampError, match="ahead"):
        states.add(["a"], [4.0], NOW + 2 * SECOND, NOW)
    states.restart_time(np.array([2.5]))
    assert states.positions.tolist() == [2.5]
    assert states.add(["a"], [5.0], 7, 7)
    assert states.apply(7)


def test_states_count_after_wall_time_is_set_back() -> None:
    states = JointStates(["a"])
    states.add(["a"], [1.0], NOW, NOW)
    states.apply(NOW)
    states.add(["a"], [9.0], NOW + SECOND // 2, NOW)
    now = NOW - 60 * SECOND
    states.limit_times(now)
    assert states.stamp == now
    for k in range(3):
        now += SECOND // 10
        states.add(["a"], [2.0 + k], now, now)
        assert states.apply(now)
        assert states.positions.tolist() == [2.0 + k]
    # The state that was stamped ahead does not come a minute later.
    assert not states.apply(NOW + SECOND)


def test_joint_falls_silent_after_wall_time_is_set_back() -> None:
    states = JointStates(["a"])
    states.add(["a"], [1.0], NOW, NOW)
    states.limit_times(NOW - 60 * SECOND)
    assert states.silent_since(NOW - 60 * SECOND) == []
    assert states.silent_since(NOW - 59 * SECOND) == ["a"]


def test_states_count_if_the_clock_restarts_at_the_start() -> None:
    states = JointStates(["a", "b"])
    states.add(["a"], [1.0], NOW, NOW)
    # The start applies all states at once.
    states.apply(2**63 - 1)
    states.add(["a", "b"], [2.0, 3.0], SECOND, SECOND)
    states.apply(2**63 - 1)
    assert states.positions.tolist() == [2.0, 3.0]


def test_late_state_replaces_no_newer_position() -> None:
    states = JointStates(["a", "b"])
    states.add(["a"], [2.0], NOW, NOW)
    assert states.apply(NOW)
    states.add(["a", "b"], [1.0, 5.0], NOW - 3, NOW)
    assert states.apply(NOW)
    assert states.positions.tolist() == [2.0, 5.0]
    states.restart_time(states.positions)
    states.add(["a"], [7.0], 7, 7)
    assert states.apply(7)
    assert states.positions.tolist() == [7.0, 5.0]


@pytest.mark.parametrize("names", [["a", "b"], ["b", "a"]], ids=["same list", "another list"])
def test_older_stamps_count_after_a_silence(names: list[str]) -> None:
    """A bag that is played again, or a robot that restarts with another clock, moves its joints."""
    states = JointStates(["a", "b"])
    states.add(["a", "b"], [1.0, 2.0], NOW, NOW)
    states.apply(NOW)
    with contextlib.suppress(OldStampError):
        states.add(names, [7.0, 7.0], NOW - 9 * SECOND, NOW + 1)
    assert not states.apply(NOW + 1)
    later = NOW + 2 * SECOND
    assert states.add(names, [3.0, 3.0], NOW - 8 * SECOND, later)
    assert states.apply(later)
    assert states.positions.tolist() == [3.0, 3.0]
    assert states.stamp == NOW - 8 * SECOND


def test_state_without_a_known_joint_is_ignored() -> None:
    states = JointStates(["a"])
    assert not states.add(["wheel"], [math.nan], 0, NOW)
    assert not states.apply(NOW)


@pytest.mark.parametrize(
    ("names", "positions", "reason"),
    [
        (["a", "b"], [1.0], "names 2 joints and gives 1 positions"),
        (["b", "a", "a"], [0.0, 1.0, 2.0], "names joint 'a' twice"),
        (["a"], [math.nan], "position of joint 'a' is nan"),
        (["a"], [math.inf], "position of joint 'a' is inf"),
    ],
)
def test_invalid_state_is_refused(names: list[str], positions: list[float], reason: str) -> None:
    states = JointStates(["a", "b"])
    with pytest.raises(ValueError, match=reason):
        states.add(names, positions, 0, NOW)
    assert not states.apply(NOW)


def test_flood_of_waiting_states_is_bounded() -> None:
    states = JointStates(["a"])
    for k in range(6000):
        states.add(["a"], [float(k)], NOW + k, NOW)
        states.add([f"x{k}", "a"], [0.0, float(k)], NOW, NOW)
    assert states.apply(NOW + 6000)
    assert states.positions.tolist() == [5999.0]


def test_huge_position_is_refused() -> None:
    states = JointStates(("shoulder", "finger"))
    with pytest.raises(ValueError, match=r"joint 'finger' is 1e\+308; it must be finite, and at most 1e\+09"):
        states.add(["shoulder", "finger"], [0.1, 1e308], 0, 1)
    states.apply(2)
    assert not states.is_known.any()
