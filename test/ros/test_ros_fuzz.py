# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random and malformed commands over real topics, random parameters: no crash, nothing non-finite, no flood."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PointStamped, PoseStamped
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from support.ros_client import Client, positions, start_cloth

from cloth_sim_ros import Scene, SetParameters, Simulation
from cloth_sim_ros.ros.check.feasibility import check_feasibility
from cloth_sim_ros.ros.io.parameters import LiveParameters, declare
from cloth_sim_ros.ros.timing.event_queue import EventQueue
from cloth_sim_ros.ros.timing.stepper import Stepper

#: Commands of a short run; the long one sends the hundred thousand.
SHORT, LONG = 3000, 100_000
_BATCH = 15
NUMBERS = [0.0, -0.0, 0.5, -0.5, 1.0, 1e-300, 9999.0, 1e4, 1e9, 1e308, np.inf, -np.inf, np.nan]


def random_pose(random: np.random.Generator, kind: Any) -> Any:
    """A pose or point, near the cloth or invalid."""
    message = kind()
    message.header.frame_id = str(random.choice(["", "world", "base", "/world", "ü" * 50]))
    stamp = int(random.choice([0, 0, 1, 2**31 - 1, -5]))
    message.header.stamp.sec = stamp
    message.header.stamp.nanosec = int(random.choice([0, 1, 999_999_999, 2**32 - 1]))
    sane = random.random() < 0.5
    values = random.uniform(-1.0, 1.0, 7) if sane else random.choice(NUMBERS, 7)
    position = message.point if kind is PointStamped else message.pose.position
    position.x, position.y, position.z = values[:3].tolist()
    if kind is PoseStamped:
        q = message.pose.orientation
        q.x, q.y, q.z, q.w = values[3:].tolist()
    return message


def random_bytes(random: np.random.Generator, message: Any) -> bytes:
    """The bytes of a message: some changed, or truncated, or all random."""
    data = bytearray(serialize_message(message))
    for index in random.integers(0, len(data), random.integers(1, 6)):
        data[index] = random.integers(0, 256)
    choice = random.random()
    if choice < 0.3:
        return bytes(data[: random.integers(4, len(data) + 1)])
    # No longer than the message: a type of fixed size is not sent beyond it.
    return random.bytes(len(data)) if choice < 0.4 else bytes(data)


def send_commands(client: Client, count: int) -> None:
    random = np.random.default_rng(20261121)
    topics = [(PoseStamped, "target"), (PointStamped, "point"), (Bool, "grasp")]
    publishers = [(kind, client.publisher(kind, f"/cloth_sim/gripper/{leaf}")) for kind, leaf in topics]
    for sent in range(count):
        kind, publisher = publishers[int(random.integers(3))]
        message = Bool(data=bool(random.integers(2))) if kind is Bool else random_pose(random, kind)
        publisher.publish(random_bytes(random, message) if random.random() < 0.4 else message)
        if sent % _BATCH == 0:
            # Not faster than the node: a full queue would only drop messages.
            client.wait_for_clouds(1)


@pytest.mark.parametrize("count", [SHORT, pytest.param(LONG, marks=[pytest.mark.soak, pytest.mark.timeout(1800)])])
def test_random_commands(ros_domain: int, start_process: Callable[..., Any], count: int) -> None:
    process = start_cloth(start_process, "cloth.resolution:=[8, 8]", "rate:=200.0")
    with Client() as client:
        client.watch()
        send_commands(client, count)
        assert client.call(Trigger, "/cloth_sim/reset").success
        for cloud in client.clouds:
            assert np.isfinite(positions(cloud)).all()
        client.wait_for_clouds(3)
    assert process.interrupt() == 0
    assert "Traceback" not in process.output
    # The first refusal of each kind is always logged.
    for reason in (
        "(finite numbers|no coordinate may|is no quaternion)",
        "is not the cloth's frame",
        # Both reasons count as one kind of refusal, logged once a second at most: either may be the one logged.
        "(s ahead|a time is not negative)",
        "no Po.*Stamped",
    ):
        assert re.search(reason, process.output)
    # A few kinds of message, each at most once a second; the run takes longer on a busy machine.
    assert len(process.output.splitlines()) < count / 5


#: Live parameters, and values of all kinds for them.
LIVE = [entry for entry in Scene.declared() if entry.live]
VALUES = {
    "double": st.floats() | st.sampled_from([0.0, 1e-9, 1e9, 1.0]),
    "double[]": st.lists(st.floats(), max_size=4),
    "string": st.text(max_size=8) | st.sampled_from(["auto", "leapfrog", "none"]),
    "int": st.integers(-(2**63), 2**63 - 1),
    "bool": st.booleans(),
}


def allowed(entry: Any) -> st.SearchStrategy[Any]:
    """Values that the entry's own check accepts."""
    if entry.choices:
        return st.sampled_from(entry.choices)
    if entry.element == "double":
        numbers = st.floats(entry.min, entry.max, exclude_min=entry.excludes_min)
        # Without a length of its own an array takes any number of entries, or its section refuses it.
        return st.lists(numbers, min_size=entry.length or 0, max_size=entry.length or 3) if entry.is_array else numbers
    if entry.kind == "string[]":
        return st.lists(st.sampled_from(["top", "bottom_left", "", "3", "15", "16", "middle"]), min_size=1, max_size=3)
    return st.booleans()


CHANGES = st.sampled_from(LIVE).flatmap(
    lambda entry: st.tuples(
        st.just(entry), allowed(entry) | VALUES.get(entry.kind, st.just([])) | st.one_of(*VALUES.values())
    )
)


@pytest.fixture
def running(ros_domain: int) -> Any:
    with Client() as client:
        node = Node(
            "cloth_sim",
            context=client.context,
            automatically_declare_parameters_from_overrides=True,
            parameter_overrides=[Parameter("cloth.resolution", value=[4, 4])],
        )
        scene = declare(node)
        queue = EventQueue()
        simulation = Simulation(scene)
        stepper = Stepper(simulation, queue)
        live = LiveParameters(
            node,
            scene,
            lambda values: queue.put(SetParameters(values)),
            lambda _, wanted: check_feasibility(wanted, simulation),
            contextlib.nullcontext(),
        )
        yield node, simulation, stepper, live
        node.destroy_node()


@given(changes=st.lists(CHANGES, min_size=1, max_size=3))
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_random_parameters(running: Any, changes: list[tuple[Any, Any]]) -> None:
    node, simulation, stepper, live = running
    for entry, value in changes:
        try:
            parameter = Parameter(entry.name, value=value)
        except (TypeError, AssertionError):
            # rclpy itself has no such parameter: [] of no type, texts that are no UTF-8.
            continue
        (result,) = node.set_parameters([parameter])
        if not result.successful:
            assert result.reason
    stepper.advance(0)
    stepper.answer()
    if stepper.refused_parameters:
        live.return_to(simulation.scene)
    assert np.isfinite(simulation.positions).all()
    shown = {entry.name: node.get_parameter(entry.name).value for entry in LIVE}
    for name, value in shown.items():
        in_force = simulation.scene.parameters()[name]
        assert in_force == (tuple(value) if isinstance(in_force, tuple) else value)
