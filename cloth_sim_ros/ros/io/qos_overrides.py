# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quality-of-service profiles of the node's topics with their overrides."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from cloth_sim_ros.ros.io.qos_rules import POLICIES, PUBLISHER, Override, faults
from cloth_sim_ros.scene.parameters.declare import Faults

#: Policies that rclpy declares as parameters of each topic.
OPTIONS = QoSOverridingOptions([QoSPolicyKind[policy.upper()] for policy in POLICIES])

_ENUMS: dict[str, Any] = {"reliability": ReliabilityPolicy, "history": HistoryPolicy, "durability": DurabilityPolicy}


def overridden_profile(node: Node, topic: str, qos: QoSProfile, *, endpoint_kind: str = PUBLISHER) -> QoSProfile:
    """Return a new profile of a topic with its overrides; rclpy would write them into the object that it is given.

    Overrides are validated here, because rclpy's errors name no parameter.

    Args:
        node: the node that owns the topic.
        topic: its name before remapping.
        qos: the defaults; not modified.
        endpoint_kind: one of `qos_rules.ENDPOINT_KINDS`.

    Raises:
        ParameterError: names each invalid parameter, its value and the allowed ones.
    """
    overrides: dict[str, tuple[str, Any]] = {}
    for policy in POLICIES:
        name = Override(node.resolve_topic_name(topic), endpoint_kind, policy).name
        if node.has_parameter(name):
            overrides[policy] = name, node.get_parameter(name).value
    defaults = {"reliability": qos.reliability.name.lower(), "durability": qos.durability.name.lower()}
    refused = Faults()
    refused.add(faults(dict(overrides.values()), defaults))
    refused.refuse()
    policies = {policy: getattr(qos, policy) for policy in POLICIES}
    for policy, (_, value) in overrides.items():
        policies[policy] = value if policy == "depth" else _ENUMS[policy][value.upper()]
    return QoSProfile(**policies)
