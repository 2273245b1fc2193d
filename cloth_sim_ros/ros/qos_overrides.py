# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters that override the quality of service of a topic that the node publishes."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, ReliabilityPolicy

from cloth_sim_ros.scene.parameters import ParameterError

_NAME = "qos_overrides.{topic}.publisher.{policy}"
_WORDS = {
    "reliability": [policy.name.lower() for policy in ReliabilityPolicy if policy.name != "UNKNOWN"],
    "history": [policy.name.lower() for policy in HistoryPolicy if policy.name != "UNKNOWN"],
}
#: What of a profile may be overridden.
_POLICIES = (*_WORDS, "depth")
#: Deepest queue that a middleware takes: the length has 32 bits there.
_DEEPEST = 2**31 - 1


def override_names(node: Node, topic: str) -> list[str]:
    """Return the names of the overrides that a publisher of a topic looks at, after remapping."""
    return [_NAME.format(topic=node.resolve_topic_name(topic), policy=policy) for policy in _POLICIES]


def check_overrides(node: Node, topic: str) -> None:
    """Check the overrides of a topic before rclpy takes them, whose errors name none.

    Raises:
        ParameterError: names the parameter, its value and what is allowed.
    """
    for policy, name in zip(_POLICIES, override_names(node, topic), strict=True):
        if not node.has_parameter(name):
            continue
        value = node.get_parameter(name).value
        if reason := _wrong(policy, value):
            raise ParameterError(f"{name} is {value!r}; it must be {reason}")


def _wrong(policy: str, value: Any) -> str:
    """Say what a policy's value must be, where it is not."""
    if policy == "depth":
        right = isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _DEEPEST
        return "" if right else f"a whole number from 0 to {_DEEPEST}, how many messages wait for slow subscribers"
    words = _WORDS[policy]
    right = isinstance(value, str) and value.lower() in words
    return "" if right else f"{', '.join(words[:-1])} or {words[-1]}"
