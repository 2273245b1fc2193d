# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node in a multi-threaded executor: services run concurrently with frames and see only complete ones."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger
from support.ros_client import Client

from cloth_sim_ros import State
from cloth_sim_ros.ros.io.parameters import LiveParameters, declare
from cloth_sim_ros.ros.node import ClothNode
from cloth_sim_ros.scene.scene import Scene


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


@contextlib.contextmanager
def threaded(client: Client, values: dict[str, Any]) -> Iterator[ClothNode]:
    """A cloth in a multi-threaded executor that a further thread spins."""
    cloth = ClothNode(
        context=client.context,
        parameter_overrides=[Parameter(name, value=value) for name, value in values.items()],
    )
    executor = MultiThreadedExecutor(num_threads=4, context=client.context)
    executor.add_node(cloth.node)
    cloth.start()
    ending = threading.Event()

    def spin() -> None:
        while not ending.is_set():
            executor.spin_once(timeout_sec=0.1)

    spinning = threading.Thread(target=spin)
    spinning.start()
    try:
        yield cloth
    finally:
        ending.set()
        spinning.join()
        executor.shutdown()
        cloth.close()
        cloth.node.destroy_node()


def test_a_service_waits_for_the_frame_under_way(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    requested, saved = threading.Event(), threading.Event()
    with threaded(client, {"cloth.resolution": [5, 5], "record.folder": str(tmp_path)}) as cloth:
        advance, save = cloth.simulation.advance, cloth.recording.session.save_state

        def slow(*arguments: Any) -> Any:
            if not requested.is_set():
                return advance(*arguments)
            done.append("begins")
            # Long enough for the service, which the client calls from here on, to collide with the frame.
            saved.wait(0.3)
            frame = advance(*arguments)
            done.append("ends")
            return frame

        def record_save() -> Any:
            done.append("saved")
            saved.set()
            return save()

        monkeypatch.setattr(cloth.simulation, "advance", slow)
        monkeypatch.setattr(cloth.recording.session, "save_state", record_save)
        service = client.node.create_client(Trigger, "/cloth_sim/save_state")
        client.spin_until(service.service_is_ready, description="the service")
        requested.set()
        client.spin_until(lambda: "begins" in done, description="a frame")
        future = service.call_async(Trigger.Request())
        client.spin_until(future.done, description="the answer")
        assert future.result().success
    before = done[: done.index("saved")]
    assert before.count("begins") == before.count("ends")


def test_concurrent_service_callers_are_all_answered(client: Client, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from cloth_sim_ros.verify.run import verify

    with threaded(client, {"cloth.resolution": [8, 8], "rate": 200.0, "record.folder": str(tmp_path)}) as cloth:
        kinds = {
            "gripper/close": SetBool, "reset": Trigger, "save_state": Trigger, "record": SetBool, "pause": SetBool,
            "step": Trigger,
        }  # fmt: skip
        clients = {name: client.node.create_client(kind, f"/cloth_sim/{name}") for name, kind in kinds.items()}
        client.spin_until(
            lambda: all(service.service_is_ready() for service in clients.values()), description="the services"
        )
        answers: list[Any] = []
        for round_index in range(20):
            futures = []
            for name, service in clients.items():
                request = kinds[name].Request()
                if kinds[name] is SetBool:
                    request.data = round_index % 2 == 0
                futures.append((name, service.call_async(request)))
            client.spin_until(
                lambda futures=futures: all(future.done() for _, future in futures), description="the answers"
            )
            answers += [(name, future.result()) for name, future in futures]
        assert cloth.simulation.frame > 0
    assert len(answers) == 120
    for name, answer in answers:
        assert answer.message, name
        if name == "save_state":
            State.from_bytes(Path(answer.message).read_bytes())
    for path in sorted(tmp_path.glob("*.mcap")):
        verdict = verify([path])
        assert verdict.same, verdict.first_reason


def test_change_refused_by_another_callback_is_not_applied(client: Client) -> None:
    node = Node(
        "cloth_sim",
        context=client.context,
        automatically_declare_parameters_from_overrides=True,
        parameter_overrides=[Parameter("cloth.resolution", value=[4, 4])],
    )
    scene = declare(node)
    refusing = [True]
    # rclpy calls the callback that was added first last.
    node.add_on_set_parameters_callback(
        lambda _: SetParametersResult(successful=not refusing[0], reason="not by my leave")
    )
    changes: list[dict[str, Any]] = []

    def check(_values: dict[str, Any], _scene: Scene) -> None:
        return

    LiveParameters(node, scene, changes.append, check, threading.RLock())
    (result,) = node.set_parameters([Parameter("material.density", value=0.5)])
    assert (result.successful, result.reason) == (False, "not by my leave")
    assert changes == []
    assert node.get_parameter("material.density").value == scene.material.density
    refusing[0] = False
    assert node.set_parameters_atomically(
        [Parameter("material.density", value=0.5), Parameter("air.drag", value=0.1)]
    ).successful
    assert changes == [{"material.density": 0.5, "air.drag": 0.1}]
    node.destroy_node()
