# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Discoverable entities of a node are served: services and subscriptions exist from the start on."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import Parameter
from support.ros_client import Client

from cloth_sim_ros.ros.node import ClothNode

NAME = "/cloth_sim"
COMMANDS = {f"{NAME}/gripper/{leaf}" for leaf in ("target", "point", "grasp")}
SERVICES = {
    *(f"{NAME}/{leaf}" for leaf in ("reset", "pause", "step", "record", "save_state", "gripper/close")),
    *(f"{NAME}/{leaf}_parameters" for leaf in ("describe", "get", "list", "set")),
}
#: Entities that rclpy creates with the node itself.
RCLPY = {f"{NAME}/get_type_description"}


@pytest.fixture
def client(ros_domain: int) -> Iterator[Client]:
    with Client() as client:
        yield client


def offered(client: Client) -> set[str]:
    """Names of the node's services and subscriptions in the graph."""
    services = client.node.get_service_names_and_types_by_node("cloth_sim", "/")
    subscriptions = client.node.get_subscriber_names_and_types_by_node("cloth_sim", "/")
    return {name for name, _ in [*services, *subscriptions] if name.startswith(NAME)}


def test_discoverable_services_are_served(client: Client) -> None:
    cloth = ClothNode(context=client.context, parameter_overrides=[Parameter("cloth.resolution", value=[5, 5])])
    try:
        client.spin_until(lambda: "cloth_sim" in client.node.get_node_names(), description="the node")
        # rclpy's entity appears after the node's would.
        client.spin_until(lambda: offered(client) >= RCLPY, description="the node's services")
        assert offered(client) == RCLPY
        client.executor.add_node(cloth.node)
        cloth.start()
        client.spin_until(lambda: offered(client) >= COMMANDS | SERVICES, description="commands and services")
        request = GetParameters.Request(names=["rate"])
        assert client.call(GetParameters, f"{NAME}/get_parameters", request).values[0].double_value == 60.0
    finally:
        client.executor.remove_node(cloth.node)
        cloth.close()
        cloth.node.destroy_node()


def test_parameter_services_can_be_disabled(client: Client) -> None:
    cloth = ClothNode(
        context=client.context,
        start_parameter_services=False,
        parameter_overrides=[Parameter("cloth.resolution", value=[5, 5])],
    )
    cloth.start()
    client.spin_until(lambda: offered(client) >= COMMANDS, description="commands")
    assert f"{NAME}/set_parameters" not in offered(client)
    cloth.close()
    cloth.node.destroy_node()
