# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Warnings of stopped bodies, once each, and detection of first contacts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np
from support.line_log import LineLog

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.ros.io.obstacles import ObstacleTopics
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.deadline_monitor import FirstContact

FALLING: dict[str, Any] = {
    "cloth.resolution": [5, 5],
    "cloth.anchors": [""],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.02],
    "obstacles": ["floor"],
    "floor.shape": "plane",
}


def test_repeated_stop_is_warned_of_once() -> None:
    cloth, log = Simulation(Scene.from_parameters({"cloth.resolution": [5, 5]})), LineLog()
    frame = cloth.advance()
    node, nothing = SimpleNamespace(), SimpleNamespace()
    topics = ObstacleTopics(node, cloth, nothing, nothing, ThrottledLog(log, seconds=0.0))  # type: ignore[arg-type]
    # Two bodies are stopped together; commands push them into the cloth in every or every other frame.
    for index in range(1, 200):
        stopped = ("iron", "gripper") if index % 2 else ()
        topics.send(attrs.evolve(frame, index=index, stopped=stopped), 0)
    assert log.lines == ["'iron', 'gripper' are stopped: they would crush the cloth; send a new target to resume them"]
    topics.send(attrs.evolve(frame, index=400, stopped=("iron",)), 0)
    assert log.lines[1:] == ["'iron' is stopped: it would crush the cloth; send a new target to resume it"]


def test_contact_is_noticed_once_when_it_begins() -> None:
    cloth = Simulation(Scene.from_parameters({**FALLING, "contact.self": True}))
    watch = FirstContact(cloth)
    seen = [(cloth.frame, contacts) for _ in range(60) if (contacts := watch.new_contacts(cloth.advance()))]
    assert [contacts for _, contacts in seen] == ["'floor'"]
    assert 2 < seen[0][0] < 20
    free = Simulation(Scene.from_parameters({"cloth.resolution": [5, 5]}))
    assert not any(FirstContact(free).new_contacts(free.advance()) for _ in range(5))


def test_each_gripper_that_pinches_is_a_contact_of_its_own() -> None:
    cloth = Simulation(Scene.from_parameters({**FALLING, "gripper.mode": "pinch"}))
    watch, frame = FirstContact(cloth), cloth.advance()
    pressing = attrs.evolve(frame, wrenches=np.ones((1, 6)), obstacle_wrenches=np.ones((1, 6)))
    assert watch.new_contacts(pressing) == "'floor', 'gripper'"
    assert not watch.new_contacts(pressing)
