# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several cloths in one graph, and restarts of all processes in any order."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Bool
from std_srvs.srv import SetBool
from support.ros_client import LIMIT, Client, pose, positions, start_cloth

from cloth_sim_ros.ros.node import ClothNode

CORNER = (0.5, 0.0, 0.5)
SUBSCRIBER = Path(__file__).parents[1] / "support" / "plain_subscriber.py"


def test_two_cloths_in_one_process(ros_domain: int) -> None:
    with Client() as client:
        size = Parameter("cloth.resolution", value=[5, 5])
        cloths = [
            ClothNode(
                "towel",
                namespace=namespace,
                context=client.context,
                parameter_overrides=[size, Parameter("grippers", value=[gripper])],
            )
            for namespace, gripper in (("one", "left"), ("two", "right"))
        ]
        clouds: dict[str, PointCloud2] = {}
        for cloth in cloths:
            name = cloth.node.get_fully_qualified_name()
            client.node.create_subscription(
                PointCloud2, f"{name}/points", lambda cloud, name=name: clouds.__setitem__(name, cloud), 10
            )
            cloth.start()
            client.executor.add_node(cloth.node)
        client.spin_until(lambda: len(clouds) == 2, description="both clouds")
        client.publisher(PoseStamped, "/one/towel/left/target").publish(pose(*CORNER))
        client.publisher(Bool, "/one/towel/left/grasp").publish(Bool(data=True))
        client.spin_until(lambda: len(cloths[0].simulation.grippers.grasped_particles(0)), description="the grasp")
        client.publisher(PoseStamped, "/one/towel/left/target").publish(pose(0.5, -0.4, 0.8))
        client.spin_until(lambda: positions(clouds["/one/towel"])[-1][2] > 0.7, description="one cloth lifted")
        assert positions(clouds["/two/towel"])[-1][2] < 0.55
        assert cloths[1].simulation.grippers.names == ["right"]
        for cloth in cloths:
            assert cloth.close()
            client.executor.remove_node(cloth.node)
            cloth.node.destroy_node()


def test_remapped_node_and_duplicate_name(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader

    parameters = tmp_path / "towel.yaml"
    parameters.write_text(
        yaml.safe_dump(
            {
                "/**": {"ros__parameters": {"cloth": {"resolution": [5, 6]}}},
                "/robot/towel": {
                    "ros__parameters": {"record": {"enabled": True, "folder": str(tmp_path)}, "rate": 30.0}
                },
            }
        )
    )
    arguments = ["-m", "cloth_sim_ros.ros.main", "--ros-args", "--params-file", parameters]
    arguments += ["-r", "__ns:=/robot", "-r", "__node:=towel"]
    first = start_process([*arguments, "-r", "~/points:=/cloud"])
    first.wait_for_output("at 30 Hz of wall time")
    with Client() as client:
        client.node.create_subscription(PointCloud2, "/cloud", client.clouds.append, 10)
        assert client.wait_for_clouds(3).width == 6
    second = start_process(arguments)
    first.wait_for_output("there are several nodes /robot/towel")
    second.wait_for_output("there are several nodes /robot/towel")
    assert first.interrupt() == 0
    assert second.interrupt() == 0
    for path in tmp_path.glob("*.mcap"):
        with SessionReader(path) as reader:
            assert reader.node == "/robot/towel"
            assert len(list(reader.clouds())) > 3


def test_processes_may_die_during_a_grasp(ros_domain: int, start_process: Callable[..., Any], tmp_path: Path) -> None:
    script = tmp_path / "script.yaml"
    steps = [
        {"time": 0.0, "position": list(CORNER)},
        {"time": 1.0, "position": list(CORNER), "close": True},
        {"time": 2.0, "position": [0.4, -0.4, 0.9]},
        {"time": 60.0, "close": False},
    ]
    script.write_text(yaml.safe_dump({"steps": steps}))
    cloth = start_cloth(start_process)
    subscriber = start_process([sys.executable, SUBSCRIBER, "/cloth_sim/points", tmp_path / "received"])

    def start_gripper() -> Any:
        # The waits below do not include the start, which takes long on a busy machine. If it fails, its own
        # message says why.
        started = start_process(["-m", "cloth_sim_ros.ros.gripper_main", script])
        started.wait_for_output("playing")
        return started

    def is_lifted() -> bool:
        return bool(np.linalg.norm(positions(client.clouds[-1])[-1] - (0.4, -0.4, 0.9)) < 0.03)

    with Client() as client:
        client.watch()
        gripper = start_gripper()
        client.spin_until(is_lifted, description="the corner lifted")
        gripper.send_signal(signal.SIGKILL)
        subscriber.send_signal(signal.SIGKILL)
        client.wait_for_clouds(30)
        assert is_lifted(), "a gripper that went silent keeps its last target"
        answer = client.call(SetBool, "/cloth_sim/gripper/close", SetBool.Request(data=False))
        assert answer.success
        cloth.send_signal(signal.SIGKILL)
        cloth.wait()
        again = start_cloth(start_process)
        client.clouds.clear()
        client.wait_for_clouds(3)
        assert abs(positions(client.clouds[-1])[-1][2] - 0.5) < 0.02, "a new cloth hangs where it starts"
        gripper = start_gripper()
        client.spin_until(is_lifted, description="the corner lifted again")
    assert again.interrupt() == 0
    assert gripper.interrupt() == 130


def test_recording_is_complete_after_context_shutdown(ros_domain: int, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.session.reader import SessionReader

    values = {"cloth.resolution": [5, 5], "record.enabled": True, "record.folder": str(tmp_path)}
    context = rclpy.Context()
    context.init()
    cloth = ClothNode(
        context=context, parameter_overrides=[Parameter(name, value=value) for name, value in values.items()]
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(cloth.node)
    cloth.start()
    end = time.monotonic() + LIMIT
    while cloth.simulation.frame <= 5 and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    context.shutdown()
    assert cloth.close()
    cloth.node.destroy_node()
    (path,) = tmp_path.glob("*.mcap")
    with SessionReader(path, strict=True) as reader:
        assert len(list(reader.frames())) > 5
        assert reader.complete
