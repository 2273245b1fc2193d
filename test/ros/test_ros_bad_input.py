# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bad input: a clear message for each; the node goes on or refuses to start."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PointStamped, PoseStamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import serialize_message
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger
from support.ros_client import Client, pose, positions, start_cloth

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.ros.io.output import LATCHED_QOS

TARGET = "/cloth_sim/gripper/target"


#: Arguments of the node, and its message.
REFUSED = [
    (["-p", "cloth.size:=[-1.0, 1.0]"], "cloth.size is -1.0 m; it must be at least 1e-06 m"),
    (["-p", "cloth.resolution:=[1, 1]"], "cloth.resolution is 1; it must be at least 2"),
    (["-p", "rate:=60"], "write 60.0"),
    (["-p", "grippers:=[left, left]"], "two grippers are named 'left'"),
    (["-p", "initial_state:=nowhere.npz"], "nowhere.npz"),
    (["-p", "initial_state:=nowhere.mcap@12"], "nowhere.mcap"),
    (["-p", "cloth.anchors:=[]"], "cloth.anchors is an empty list, [], whose type ROS can't know; for none write ['']"),
    (["-p", "cloth.size:=[]"], "cloth.size is an empty list, [], whose type ROS can't know; it must be double[]"),
    (["-p", "cloth.sizes:=[]"], "cloth.sizes is an empty list, [], whose type ROS can't know; leave it out"),
    (
        ["-p", "table.shape:=box", "-p", "table.size:=[]"],
        "table.size is an empty list, [], whose type ROS can't know; it",
    ),
    (["-p", "use_sim_time:='false'"], "use_sim_time is 'false'; it must be true or false, without quotes"),
    (["-p", "use_sim_time:=1"], "use_sim_time is 1; it must be true or false"),
    (["-p", "use_sim_time:=[]"], "use_sim_time is an empty list, [], whose type ROS can't know; it must be bool"),
    (["-p", "qos_overrides./cloth_sim/points.publisher.depth:=-1"], "points.publisher.depth is -1; it must be a whole"),
    (["-p", "material.stretch_modulus:=1e9", "-p", "integrator:=leapfrog"], "are taken live: lower stiffness"),
    (["-p", "step:=0.5"], "above the stability limit"),
    (["-p", "record.enabled:=true", "-p", "record.folder:=FILE/folder"], "record.folder"),
    (["--params-file", "/no/such/file.yaml"], "/no/such/file.yaml"),
]


def test_node_refuses_to_start(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    arguments = [
        ["--ros-args", *(word.replace("FILE", str(tmp_path / "file")) for word in words)] for words, _ in REFUSED
    ]
    # In one process, because its start takes long.
    script = (
        "import sys\nfrom cloth_sim_ros.ros.main import main\n"
        f"for arguments in {arguments!r}:\n    print('status', main(arguments), flush=True)"
    )
    process = start_process([sys.executable, "-c", script])
    assert process.wait() == 0, process.output
    parts = process.output.split("status 1\n")
    assert len(parts) == len(REFUSED) + 1
    for part, (_, message) in zip(parts, REFUSED, strict=False):
        assert message in part
        # No other line: no messages of libraries.
        assert len(part.strip().splitlines()) == 1, part
    assert "Traceback" not in process.output


def test_misspelt_parameter_gives_a_warning(ros_domain: int, start_process: Callable[..., Any]) -> None:
    process = start_cloth(start_process, "cloth.sizes:=[1.0, 1.0]")
    assert "did you mean 'cloth.size'?" in process.output


def test_gripper_error_lists_known_grippers(ros_domain: int, start_process: Callable[..., Any]) -> None:
    start_cloth(start_process, "grippers:=[left, right]")
    gripper = start_process(["-m", "cloth_sim_ros.ros.gripper_main", "--gripper", "middle"])
    assert gripper.wait() == 1
    assert "/cloth_sim has no gripper 'middle'; it has left, right" in gripper.output


def test_gripper_finds_the_node_beside_another_of_its_name(ros_domain: int, start_process: Callable[..., Any]) -> None:
    # A killed node stays in the graph for some seconds, as a name without services.
    with Client("cloth_sim"):
        start_cloth(start_process, "grippers:=[left, right]")
        gripper = start_process(["-m", "cloth_sim_ros.ros.gripper_main", "--gripper", "middle"])
        assert gripper.wait() == 1
    assert "/cloth_sim has no gripper 'middle'; it has left, right" in gripper.output


def test_gripper_without_a_node_gives_up(ros_domain: int, start_process: Callable[..., Any]) -> None:
    # A name that no other test uses, because killed nodes stay in the graph for some seconds.
    gripper = start_process(["-m", "cloth_sim_ros.ros.gripper_main", "--node", "/nowhere", "--wait", "0.5"])
    assert gripper.wait() == 1
    assert "no node /nowhere came within 0.5 s" in gripper.output


def test_commands_refuse_wrong_names_and_times(start_process: Callable[..., Any]) -> None:
    cases = {
        ("gripper_main", "--gripper", "grüp"): "gripper name 'grüp' is no ROS name",
        ("gripper_main", "--node", "1a"): "'1a' is no name of a node",
        ("gripper_main", "--wait", "nan"): "'nan' is no time to wait; give a number of seconds, at least 0",
        ("viewer_main", "--node", "a.b", "--save", "x.rrd"): "'a.b' is no name of a node",
    }
    started = {
        words: start_process(["-m", f"cloth_sim_ros.ros.{name}", *options]) for (name, *options), words in cases.items()
    }
    for words, process in started.items():
        assert process.wait() > 0
        assert words in process.output
        assert "Traceback" not in process.output


def test_gripper_plays_one_script_for_each_gripper(start_process: Callable[..., Any], tmp_path: Path) -> None:
    script = tmp_path / "script.yaml"
    script.write_text("steps: [{time: 0.0, position: [0.0, 0.0, 0.0]}]")
    command = ["-m", "cloth_sim_ros.ros.gripper_main", script, script]
    twice, renamed = start_process(command), start_process([*command, "--gripper", "left"])
    assert (twice.wait(), renamed.wait()) == (1, 1)
    assert "2 scripts are for the gripper 'gripper'; a gripper plays one" in twice.output
    assert "--gripper is for one file; 2 files name their own grippers" in renamed.output


def test_gripper_waits_for_the_node_and_not_for_its_middleware(
    ros_domain: int, start_process: Callable[..., Any]
) -> None:
    # A node with the right subscriptions that never spins: its middleware matches publishers and acknowledges.
    with Client("cloth_sim") as idle:
        idle.node.create_subscription(PoseStamped, TARGET, lambda _: None, 10)
        idle.node.create_subscription(Bool, "/cloth_sim/gripper/grasp", lambda _: None, 10)
        gripper = start_process(["-m", "cloth_sim_ros.ros.gripper_main", "--wait", "6.0"])
        gripper.wait_for_output("waiting for")
        # A latched message reaches the gripper although the node does not spin.
        said = idle.node.create_publisher(DiagnosticStatus, "/cloth_sim/gripper/state", LATCHED_QOS)
        said.publish(DiagnosticStatus(values=[KeyValue(key="closed", value="false")]))
        assert gripper.wait() == 1
    assert "/cloth_sim serves the gripper 'gripper', but does not say that it is open" in gripper.output
    assert "playing" not in gripper.output


def test_gripper_waits_for_a_node_without_messages(ros_domain: int, start_process: Callable[..., Any]) -> None:
    with Client("cloth_sim") as silent:
        silent.node.create_subscription(PoseStamped, TARGET, lambda _: None, 10)
        silent.node.create_subscription(Bool, "/cloth_sim/gripper/grasp", lambda _: None, 10)
        gripper = start_process(["-m", "cloth_sim_ros.ros.gripper_main", "--wait", "6.0"])
        assert gripper.wait() == 1
    assert "/cloth_sim is there, but was not ready within 6 s" in gripper.output


def test_a_grasp_of_nothing_is_a_failure(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> None:
    process = start_cloth(start_process, "cloth.resolution:=[5, 5]")
    script = tmp_path / "script.yaml"
    script.write_text("steps: [{time: 0.0, position: [3.0, 3.0, 3.0]}, {time: 0.2, close: true}]")
    gripper = start_process(["-m", "cloth_sim_ros.ros.gripper_main", script])
    assert gripper.wait() == 1
    assert "gripper 'gripper' of /cloth_sim: held nothing (the node's log says why)" in gripper.output
    assert gripper.output.count("held nothing") == 1, "said once, by the log or by the command"
    process.wait_for_output("is closed and holds nothing: no particle within 0.05 m of it")


def test_running_node_refuses_with_reasons_and_goes_on(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    process = start_cloth(start_process, f"record.folder:={tmp_path / 'file' / 'x'}")
    with Client() as client:
        client.watch()
        check_commands(client, process)
        check_parameters(client)
        answer = client.call(SetBool, "/cloth_sim/record", SetBool.Request(data=True))
        assert not answer.success
        assert "record.folder" in answer.message
        answer = client.call(Trigger, "/cloth_sim/step")
        assert (answer.success, answer.message) == (False, "the cloth is running; pause it first")
        assert not client.call(Trigger, "/cloth_sim/save_state").success
        cloud = client.wait_for_clouds(3)
    assert np.isfinite(positions(cloud)).all()
    assert process.interrupt() == 0
    assert "Traceback" not in process.output


def check_commands(client: Client, process: Any) -> None:
    def far_future() -> int:
        return client.node.get_clock().now().nanoseconds + 5_000_000_000

    target = client.publisher(PoseStamped, TARGET)
    point = PointStamped()
    point.point.z = math.inf
    grasp = client.publisher(Bool, "/cloth_sim/gripper/grasp")
    for send, message in (
        (lambda: target.publish(pose(math.nan, 0.0, 0.0)), "it must be 3 finite numbers"),
        (lambda: target.publish(pose(0.0, 0.0, 1e9)), "no coordinate may be beyond 10000 m"),
        (lambda: target.publish(pose(0.0, 0.0, 0.0, w=0.0)), "is no quaternion"),
        (lambda: target.publish(pose(0.0, 0.0, 0.0, frame_id="base")), "'base' is not the cloth's frame 'world'"),
        (lambda: target.publish(pose(0.0, 0.0, 0.0, stamp=far_future())), "at most 1 s can wait"),
        (lambda: target.publish(serialize_message(pose(0.0, 0.0, 0.0))[:20]), "20 bytes are no PoseStamped"),
        (lambda: client.publisher(PointStamped, "/cloth_sim/gripper/point").publish(point), "point of 'gripper' is"),
        (lambda: grasp.publish(b"\x00\x01\x00\x00"), "4 bytes are no Bool"),
    ):
        # Each kind is logged at most once a second.
        def is_logged(send: Callable[[], None] = send, message: str = message) -> bool:
            send()
            return message in process.output

        client.spin_until(is_logged, description=f"'{message}' in the log")


def check_parameters(client: Client) -> None:
    def refusal(name: str, **value: Any) -> str:
        kinds = {"double_value": ParameterType.PARAMETER_DOUBLE, "string_value": ParameterType.PARAMETER_STRING}
        parameter = Parameter(name=name, value=ParameterValue(type=kinds[next(iter(value))], **value))
        answer = client.call(SetParameters, "/cloth_sim/set_parameters", SetParameters.Request(parameters=[parameter]))
        assert not answer.results[0].successful
        return str(answer.results[0].reason)

    assert "rate can't change while the cloth runs; set it at start" in refusal("rate", double_value=30.0)
    assert "out of range" in refusal("material.density", double_value=-1.0)
    assert "above 0.0 N/m" in refusal("material.stretch_modulus", double_value=0.0)
    assert "Wrong parameter type" in refusal("material.density", string_value="heavy")


def test_unstable_motion_stops_time_and_not_the_node(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    # The state of a diverging cloth: its frame reports the instability; a reset would start the same state again.
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": (6, 7)}))
    simulation.advance()
    simulation.state.v[:] = 1e200
    path = tmp_path / "apart.npz"
    path.write_bytes(simulation.state.to_bytes())
    process = start_cloth(start_process, "cloth.resolution:=[6, 7]", f"initial_state:={path}")
    process.wait_for_output("time is stopped")
    with Client() as client:
        client.watch()
        for kind, name in ((SetBool, "pause"), (Trigger, "step"), (Trigger, "step")):
            answer = client.call(kind, f"/cloth_sim/{name}")
            assert not answer.success
            assert "time is stopped: " in answer.message
        cloud = client.wait_for_clouds(2)
        assert np.isfinite(positions(cloud)).all()
        assert client.call(Trigger, "/cloth_sim/save_state").success
    assert process.interrupt() == 0
    assert "Traceback" not in process.output
