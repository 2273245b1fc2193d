# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One published topic: quality of service, publication and recording."""

from __future__ import annotations

import time
from typing import Any, Protocol

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from cloth_sim_ros.ros.io.qos_rules import POLICIES, PUBLISHER, Override, faults
from cloth_sim_ros.ros.reporting.log import ThrottledLog
from cloth_sim_ros.ros.timing.sim_time import same_topic_text
from cloth_sim_ros.scene.parameters.declare import Faults, ParameterError

#: Reliable, because RViz's displays request it; a subscriber that only needs the newest message requests best effort.
STREAM_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
#: For large messages: only the newest unread cloud is kept for a slow subscriber.
NEWEST_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
#: For messages that are published once: late subscribers receive them (transient local).
LATCHED_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
#: Longest wait at the node's end until subscribers have received the last messages.
_FLUSH_TIMEOUT = Duration(seconds=0.2)
#: A publication that takes longer than the first is warned of, at most once in the second [s].
_SLOW_PUBLICATION, _WARNING_PERIOD = 0.5, 60.0
#: Policies that rclpy declares as parameters of each topic.
OPTIONS = QoSOverridingOptions([QoSPolicyKind[policy.upper()] for policy in POLICIES])

_ENUMS: dict[str, Any] = {"reliability": ReliabilityPolicy, "history": HistoryPolicy, "durability": DurabilityPolicy}


class RecordSink(Protocol):
    """Protocol of a consumer that records the bytes of messages."""

    @property
    def running(self) -> bool:
        """True while messages are recorded."""

    def add(self, topic: str, kind: Any, data: bytes, *, stamp: int, qos: QoSProfile, droppable: bool) -> None:
        """Record a message's bytes at a ROS time [ns]; droppable ones may be dropped if the disk is too slow."""


class Output:
    """Publisher of one topic, with overridable quality of service, whose messages are also recorded.

    Raises:
        ParameterError: if the overrides of its quality of service form no valid profile.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        topic: str,
        sink: RecordSink,
        *,
        qos: QoSProfile = STREAM_QOS,
        droppable: bool = False,
    ) -> None:
        self._kind, self._node = kind, node
        self._sink, self._droppable = sink, droppable
        self._log = ThrottledLog(node.get_logger(), seconds=_WARNING_PERIOD)
        profile = overridden_profile(node, topic, qos)
        # The subscriber's side reports incompatible profiles. An event of the publisher would cost time in each spin of
        # the executor.
        events = PublisherEventCallbacks(use_default_callbacks=False)
        try:
            self._publisher = node.create_publisher(
                kind, topic, profile, qos_overriding_options=OPTIONS, event_callbacks=events
            )
        except RuntimeError as error:
            name = node.resolve_topic_name(topic)
            fault = f"qos_overrides.{name}.publisher: {error}; the middleware takes no such profile"
            if profile == qos:
                fault = f"no publisher {same_topic_text(node, topic, kind, error)}"
            raise ParameterError(fault) from error
        #: Topic name below the node's name, before remapping, so that sessions do not depend on remappings.
        self.topic = node.resolve_topic_name(topic, only_expand=True)

    @property
    def subscription_count(self) -> int:
        """Number of matched subscribers, counted at each access."""
        return int(self._publisher.get_subscription_count())

    @property
    def has_subscribers(self) -> bool:
        """True if the topic has subscribers."""
        return bool(self.subscription_count)

    @property
    def has_consumers(self) -> bool:
        """True if the topic has subscribers or a recording runs."""
        return self._sink.running or self.has_subscribers

    def publish(self, data: bytes) -> None:
        """Publish bytes without recording them, and warn if the middleware blocks the node for more than 0.5 s."""
        begun = time.monotonic()
        self._publisher.publish(data)
        if (elapsed := time.monotonic() - begun) > _SLOW_PUBLICATION:
            self._log.warn(
                "slow",
                f"{self.topic}: publishing took {elapsed:.2g} s, and the frame waited for the middleware: a subscriber "
                f"starts, is suspended, or was killed; if this repeats, resume or end it",
            )

    def send(self, data: bytes, stamp: int) -> None:
        """Publish bytes, and record them at a ROS time [ns] if a recording runs."""
        self.publish(data)
        self.record(data, stamp)

    def flush(self) -> None:
        """Wait at most 0.2 s until reliable subscribers have received all messages."""
        self._publisher.wait_for_all_acked(_FLUSH_TIMEOUT)

    def close(self) -> None:
        """Destroy the publisher."""
        self._node.destroy_publisher(self._publisher)

    def record(self, data: bytes, stamp: int) -> None:
        """Record bytes at a ROS time [ns] if a recording runs, without publishing them."""
        if self._sink.running:
            self._sink.add(
                self.topic, self._kind, data, stamp=stamp, qos=self._publisher.qos_profile, droppable=self._droppable
            )


def overridden_profile(node: Node, topic: str, qos: QoSProfile, *, endpoint_kind: str = PUBLISHER) -> QoSProfile:
    """Return a topic's quality of service with the node's overrides applied, as a new profile, or ParameterError.

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
