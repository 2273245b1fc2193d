# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services, parameters and the smaller outputs of a running node."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Task
from shape_msgs.msg import Mesh
from std_srvs.srv import SetBool, Trigger
from support.ros_client import Client, pose, positions, start_cloth
from visualization_msgs.msg import Marker

from cloth_sim_ros import Scene, Simulation, State
from cloth_sim_ros.ros.node import ClothNode
from cloth_sim_ros.ros.timing.event_queue import EventResult
from cloth_sim_ros.simulation.events import Pause

CORNER = (0.5, 0.0, 0.5)


def test_running_node(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> None:
    process = start_cloth(
        start_process, f"record.folder:={tmp_path}", "cloth.resolution:=[10, 12]", "gravity:=[0.0, 0.0, -9.81]"
    )
    with Client() as client:
        client.watch()
        assert (client.clouds[0].height, client.clouds[0].width) == (10, 12)
        check_grasp(client)
        check_pause_and_step(client)
        check_recording(client, tmp_path)
        check_state(client, tmp_path)
        check_reset(client)
        check_parameters(client)
        check_surface(client)
        check_diagnostics(client)
    assert process.interrupt() == 0
    assert "Traceback" not in process.output


def check_grasp(client: Client) -> None:
    close = "/cloth_sim/gripper/close"
    answer = client.call(SetBool, close, SetBool.Request(data=True))
    assert (answer.success, answer.message) == (
        False, "holds 0 particles: it has had no target yet, so it is nowhere",
    )  # fmt: skip
    assert client.call(SetBool, close, SetBool.Request(data=False)).success
    target = client.publisher(PoseStamped, "/cloth_sim/gripper/target")
    wrenches: list[WrenchStamped] = []
    client.node.create_subscription(WrenchStamped, "/cloth_sim/gripper/wrench", wrenches.append, 10)

    def closes(where: tuple[float, float, float], expected: str) -> bool:
        # Best effort: messages before the publisher is matched are missed, so the target is sent again.
        target.publish(pose(*where))
        client.wait_for_clouds(3)
        answer = client.call(SetBool, close, SetBool.Request(data=True))
        if expected in answer.message:
            return True
        client.call(SetBool, close, SetBool.Request(data=False))
        return False

    client.spin_until(lambda: closes((9.0, 9.0, 9.0), "the nearest is"), description="a grasp at nothing")
    client.call(SetBool, close, SetBool.Request(data=False))
    client.spin_until(lambda: closes(CORNER, "holds 1 particle"), description="a grasp of the corner")
    again = client.call(SetBool, close, SetBool.Request(data=True))
    assert "closed already" in again.message
    target.publish(pose(0.5, -0.3, 0.9))
    client.spin_until(
        lambda: np.linalg.norm(positions(client.clouds[-1])[-1] - (0.5, -0.3, 0.9)) < 0.05,
        description="the corner lifted",
    )
    # The cloth hangs from the gripper too and pulls down by less than its weight of 2 N.
    client.spin_until(
        lambda: wrenches and -2.0 < wrenches[-1].wrench.force.z < -0.05, description="a wrench of the weight"
    )
    assert wrenches[-1].header.frame_id == "world"


def check_pause_and_step(client: Client) -> None:
    answer = client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=True))
    assert answer.success
    frame = frame_of(answer)
    still = positions(client.wait_for_clouds(1))
    stepped = client.call(Trigger, "/cloth_sim/step")
    assert stepped.success
    assert frame_of(stepped) == frame + 1
    assert frame_of(client.call(Trigger, "/cloth_sim/step")) == frame + 2
    client.spin_until(lambda: not np.array_equal(positions(client.clouds[-1]), still), description="a step to be seen")
    # Commands take effect without time passing.
    answer = client.call(SetBool, "/cloth_sim/gripper/close", SetBool.Request(data=False))
    assert answer.success
    answer = client.call(SetBool, "/cloth_sim/pause", SetBool.Request(data=False))
    assert frame_of(answer) == frame + 3


def frame_of(answer: Any) -> int:
    assert answer.success, answer.message
    return int(answer.message.rsplit("frame ", 1)[1])


def check_recording(client: Client, folder: Path) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader

    answer = client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=True))
    assert answer.success, answer.message
    path = Path(answer.message)
    assert "recording already" in client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=True)).message
    client.wait_for_clouds(10)
    ended = client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=False))
    assert (ended.success, ended.message) == (True, str(path))
    assert not client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=False)).success
    assert path.parent == folder
    # The next recording goes into another folder.
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(folder / "other"))
    request = SetParameters.Request(parameters=[Parameter(name="record.folder", value=value)])
    assert client.call(SetParameters, "/cloth_sim/set_parameters", request).results[0].successful
    client.wait_for_clouds(3)
    answer = client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=True))
    assert Path(answer.message).parent == folder / "other"
    assert client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=False)).success
    with SessionReader(path, strict=True) as reader:
        assert len(list(reader.clouds())) >= 10
        assert reader.topology() is not None
        assert reader.complete


def check_state(client: Client, folder: Path) -> None:
    answer = client.call(Trigger, "/cloth_sim/save_state")
    assert answer.success, answer.message
    scene = Scene.from_parameters({"cloth.resolution": (10, 12), "initial_state": answer.message})
    simulation = Simulation(scene)
    saved = State.from_bytes(Path(answer.message).read_bytes())
    np.testing.assert_array_equal(simulation.positions, saved.positions)
    assert simulation.frame == 0
    assert saved.frame > 10


def check_reset(client: Client) -> None:
    before = frame_of(client.call(Trigger, "/cloth_sim/reset"))
    flat = np.float32(0.5)
    client.spin_until(
        lambda: abs(positions(client.clouds[-1])[-1][2] - flat) < 0.01, description="the cloth where it started"
    )
    assert frame_of(client.call(Trigger, "/cloth_sim/reset")) > before


def check_parameters(client: Client) -> None:
    names = client.call(ListParameters, "/cloth_sim/list_parameters").result.names
    declared = {entry.name: entry for entry in Scene.declared()}
    assert declared.keys() <= set(names)
    request = DescribeParameters.Request(names=list(declared))
    descriptors = client.call(DescribeParameters, "/cloth_sim/describe_parameters", request).descriptors
    for descriptor, entry in zip(descriptors, declared.values(), strict=True):
        assert descriptor.description
        assert descriptor.read_only == (not entry.live)
        if entry.kind == "double" and entry.max is not None:
            (limits,) = descriptor.floating_point_range
            assert (limits.from_value, limits.to_value) == (entry.min_accepted, entry.max)
    rate = next(descriptor for descriptor in descriptors if descriptor.name == "rate")
    assert rate.description.endswith("[Hz]")
    # Gravity is reversed: the cloth falls up from the next frame on.
    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=[0.0, 0.0, 9.81])
    request = SetParameters.Request(parameters=[Parameter(name="gravity", value=value)])
    assert client.call(SetParameters, "/cloth_sim/set_parameters", request).results[0].successful
    client.spin_until(lambda: positions(client.clouds[-1])[-1][2] > 1.0, description="the cloth falling up")
    request = GetParameters.Request(names=["gravity"])
    assert list(client.call(GetParameters, "/cloth_sim/get_parameters", request).values[0].double_array_value) == [
        0.0, 0.0, 9.81,
    ]  # fmt: skip
    for kind, service in ((SetParameters, "set_parameters"), (SetParametersAtomically, "set_parameters_atomically")):
        request = kind.Request(parameters=[Parameter(name="gravitation", value=value)])
        answer = client.call(kind, f"/cloth_sim/{service}", request)
        result = answer.results[0] if kind is SetParameters else answer.result
        assert not result.successful
        assert result.reason == "there is no parameter 'gravitation'; did you mean 'gravity'?"
    # Valid by itself, invalid for this cloth.
    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=0.5)
    request = SetParameters.Request(parameters=[Parameter(name="step", value=value)])
    (result,) = client.call(SetParameters, "/cloth_sim/set_parameters", request).results
    assert not result.successful
    assert "step 0.5 s is above the stability limit" in result.reason
    request = GetParameters.Request(names=["step"])
    assert client.call(GetParameters, "/cloth_sim/get_parameters", request).values[0].double_value == 0.0


def check_surface(client: Client) -> None:
    meshes: list[Mesh] = []
    markers: list[Marker] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client.node.create_subscription(Mesh, "/cloth_sim/topology", meshes.append, latched)
    client.node.create_subscription(Marker, "/cloth_sim/mesh", markers.append, 10)
    client.spin_until(lambda: meshes and markers, description="topology and mesh")
    assert len(meshes[0].vertices) == 10 * 12
    assert len(meshes[0].triangles) == 2 * 9 * 11
    assert len(markers[0].points) == 3 * len(meshes[0].triangles)
    assert {tuple(triangle.vertex_indices) for triangle in meshes[0].triangles} <= {
        tuple(row) for row in Scene.from_parameters({"cloth.resolution": (10, 12)}).sheet.triangles()
    }


def check_diagnostics(client: Client) -> None:
    seen: list[DiagnosticStatus] = []
    received = len(client.clouds)
    client.node.create_subscription(DiagnosticArray, "/diagnostics", lambda message: seen.extend(message.status), 10)
    status = client.spin_until(lambda: seen and seen[-1], description="diagnostics")
    values = {entry.key: entry.value for entry in status.values}
    assert status.name == "cloth_sim: cloth"
    assert status.hardware_id == "none"
    assert values["energy_j"] == "off"
    assert values["recording"] == "closed"
    assert 0.0 < float(values["real_time_factor"]) < 1.2
    assert float(values["largest_strain"]) > 0.0
    assert values["integrator_reason"]
    assert int(values["clouds_published"]) >= received


def test_request_waits_for_slow_frame(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"cloth.resolution": [4, 4], "rate": 0.1}
    overrides = [RosParameter(name, value=value) for name, value in values.items()]
    with Client() as client, ClothNode("cloth_sim", context=client.context, parameter_overrides=overrides) as cloth:
        now, answers = [100.0], list[EventResult]()
        monkeypatch.setattr(time, "monotonic", lambda: now[0])

        async def ask() -> None:
            answers.append(await cloth.inputs.services.enqueue(Pause(True)))

        task = Task(ask)
        task()
        for seconds in (14.0, 2.0):
            assert not answers
            now[0] += seconds
            cloth.inputs.expire()
            task()
    assert [answer.reason for answer in answers] == [
        "no frame was due within 15 s: frames are late; the next one applies it"
    ]
