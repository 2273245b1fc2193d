# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The gripper client's player, on a clock that stands still where the test says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from cloth_sim_ros.ros import gripper_player
from cloth_sim_ros.ros.gripper_script import GripperScript

SCRIPT = GripperScript.from_dict(
    {
        "rate": 50.0,
        "steps": [
            {"time": 0.0, "position": [0.0, 0.0, 0.0]},
            {"time": 1.0, "position": [0.0, 0.0, 0.0], "close": True},
            {"time": 2.0, "position": [1.0, 0.0, 0.0], "close": False},
        ],
    }
)


def played(monkeypatch: pytest.MonkeyPatch, *, held_up_at: float, for_long: float) -> list[tuple[float, Any]]:
    """What is sent and when [s], by a player that the system puts aside once: x of targets, and grasps."""
    sent: list[tuple[float, Any]] = []
    now = [0.0]

    def spin_once(timeout_sec: float) -> None:
        before, now[0] = now[0], now[0] + timeout_sec
        if before < held_up_at <= now[0]:
            now[0] += for_long

    def publish(message: Any) -> None:
        sent.append((now[0], message.data if hasattr(message, "data") else message.pose.position.x))

    publisher = SimpleNamespace(publish=publish, wait_for_all_acked=lambda _: True)
    clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(now[0] * 1e9)))
    node = SimpleNamespace(create_publisher=lambda *_: publisher, get_clock=lambda: clock)
    executor = SimpleNamespace(add_node=lambda _: None, spin_once=spin_once)
    monkeypatch.setattr(gripper_player, "SingleThreadedExecutor", lambda: executor)
    monkeypatch.setattr(gripper_player, "time", SimpleNamespace(monotonic=lambda: now[0]))
    assert gripper_player.GripperPlayer(node, SCRIPT, target="/cloth_sim").play()  # type: ignore[arg-type]
    return sent


@pytest.mark.parametrize(("at", "for_long"), [(0.5, 0.0), (0.95, 0.7), (0.3, 30.0), (1.8, 5.0)])
def test_grasps_happen_where_the_script_has_them(monkeypatch: pytest.MonkeyPatch, at: float, for_long: float) -> None:
    sent = played(monkeypatch, held_up_at=at, for_long=for_long)
    grasps = [k for k, (_, what) in enumerate(sent) if isinstance(what, bool)]
    assert [sent[k][1] for k in grasps] == [True, False]
    for k, place in zip(grasps, (0.0, 1.0), strict=True):
        # The target before it, and those of the tenth of a second before that.
        assert sent[k - 1][1] == pytest.approx(place, abs=1e-3)
        near = [what for when, what in sent[:k] if sent[k][0] - 0.08 < when and not isinstance(what, bool)]
        assert len(near) >= 4
        assert near == pytest.approx([place] * len(near), abs=0.01)
