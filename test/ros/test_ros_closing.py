# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A closed node: its graph entities, threads and descriptors end at once, without garbage collection."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from support.ros_client import Client

from cloth_sim_ros.ros.node import ClothNode

SMALL = {"cloth.resolution": [5, 5]}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


@pytest.fixture
def _no_collection() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def make(context: rclpy.Context, **values: object) -> ClothNode:
    overrides = [Parameter(name, value=value) for name, value in (SMALL | values).items()]
    return ClothNode(context=context, parameter_overrides=overrides)


def count(kind: str) -> int:
    return len(os.listdir(f"/proc/self/{kind}"))


@pytest.mark.usefixtures("_no_collection")
@pytest.mark.parametrize("sim_time", [False, True])
def test_closed_nodes_leave_nothing_behind(
    client: Client, wait_until: Callable[..., object], tmp_path: Path, sim_time: bool
) -> None:
    logs: list[Log] = []
    client.node.create_subscription(Log, "/rosout", logs.append, 100)
    before = (0, 0)
    for attempt in range(5):
        context = rclpy.Context()
        context.init()
        with make(context, use_sim_time=sim_time, **{"record.folder": str(tmp_path)}) as cloth:
            cloth.start()
            if attempt % 2:
                client.executor.add_node(cloth.node)
                client.executor.spin_once(timeout_sec=0.1)
                client.executor.remove_node(cloth.node)
            logs.clear()

            def is_published(cloth: ClothNode = cloth, attempt: int = attempt) -> bool:
                cloth.node.get_logger().info(f"node {attempt}")
                return any(log.msg == f"node {attempt}" for log in logs)

            client.spin_until(is_published, description=f"/rosout of node {attempt}")
        client.spin_until(lambda: "cloth_sim" not in client.node.get_node_names(), description="its end in the graph")
        context.shutdown()
        del cloth, is_published
        if attempt == 0:
            before = count("fd"), count("task")
        most = before
        wait_until(
            lambda most=most: count("fd") <= most[0] and count("task") <= most[1],
            limit=10.0,
            description="its descriptors",
        )


def test_node_that_never_started_is_closed(client: Client) -> None:
    with make(client.context) as cloth:
        pass
    assert "cloth_sim" not in client.node.get_node_names()
    assert cloth.close(), "again"


def test_node_whose_start_failed_is_closed(client: Client, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    values = {"record.enabled": True, "record.folder": str(tmp_path / "file")}
    with pytest.raises(RuntimeError), make(client.context, **values) as cloth:
        cloth.start()
    assert "cloth_sim" not in client.node.get_node_names()


def test_node_is_closed_after_its_context(ros_domain: int) -> None:
    context = rclpy.Context()
    context.init()
    cloth = make(context)
    cloth.start()
    context.shutdown()
    assert cloth.close()
    assert cloth.close()
