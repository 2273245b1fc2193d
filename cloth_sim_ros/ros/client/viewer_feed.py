# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of the live viewer: forwards a node's messages as bytes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped, PoseStamped, WrenchStamped
from rcl_interfaces.msg import Log, ParameterEvent
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from visualization_msgs.msg import MarkerArray

from cloth_sim_ros.ros.io.output import LATCHED_QOS

#: Only the newest message is wanted, and the node never waits for it.
_NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
#: Parameters that the view needs, and those of each gripper.
_PARAMETERS = [
    *("grippers", "gripper.radius", "gripper.mode", "cloth.anchors", "obstacles", "frame_id", "rate"),
    "diagnostics.energy",
]
_GRIPPER_PARAMETERS = ["mode"]
#: Longest wait for the parameters after a topology [s]: without their service, as of a bag, and with it. A busy
#: machine's node may take seconds to answer.
_PARAMETERS_TIMEOUT, _SERVICE_TIMEOUT = 2.0, 10.0
#: Time after which a request without an answer is repeated [s].
_REQUEST_PERIOD = 0.5
#: Time without a topology after which a warning is logged [s].
_SILENCE = 5.0


class ViewerFeed:
    """Subscriber of a cloth node's topics, whose bytes and the node's parameters it forwards to `send`.

    A topology restarts the feed: the node may have other grippers now. Then the parameters are read, and the
    other topics are subscribed to, so that their latched messages come after them.

    Args:
        node: the caller's node.
        target: full name of the cloth's node, e.g. ``/cloth_sim``.
        send: receives topic and contents. Topics have their names before remapping; `parameters` has the parameters as
            JSON, `changed` those that have changed.
    """

    def __init__(self, node: Node, target: str, send: Callable[[str, bytes], object]) -> None:
        self._node, self._target, self._send = node, target, send
        self._log = node.get_logger()
        self._subscriptions: list[Any] = []
        self._client = node.create_client(GetParameters, f"{target}/get_parameters")
        #: Steady time at which the topology came [s]; None before it, and once the other topics are subscribed to.
        self._topology_time: float | None = None
        #: Steady time of the next request for parameters [s], and the number of topologies so far.
        self._next_request = 0.0
        self._n_topologies = 0
        #: Names in the newest request.
        self._requested: set[str] = set()
        self._start = time.monotonic()
        self._has_warned = False
        node.create_subscription(Mesh, f"{target}/topology", self._on_topology, LATCHED_QOS, raw=True)
        self._log.info(f"waiting for {target}")
        self._timer = node.create_timer(0.05, self._on_timer)

    def _on_topology(self, data: bytes) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        self._send(f"{self._target}/topology", data)
        self._topology_time, self._next_request = time.monotonic(), 0.0
        self._n_topologies += 1
        self._on_timer()

    def _on_timer(self) -> None:
        now = time.monotonic()
        if self._topology_time is not None:
            has_service = self._client.service_is_ready()
            if now - self._topology_time > (_SERVICE_TIMEOUT if has_service else _PARAMETERS_TIMEOUT):
                self._log.warning(
                    f"{self._target} does not answer with its parameters: grippers, anchors and forces are not shown"
                )
                self._subscribe({})
            elif has_service and now > self._next_request:
                # Again if it is lost: the service may still be that of a node that was killed.
                self._next_request = now + _REQUEST_PERIOD
                self._request(
                    [*_PARAMETERS, *self._gripper_parameters(self._discovered_grippers())], self._on_parameters
                )
        elif not (self._n_topologies or self._has_warned) and now - self._start > _SILENCE:
            self._has_warned = True
            topics = self._topics()
            cloths = sorted(
                name
                for name in (topic.removesuffix("/points") for topic in topics if topic.endswith("/points"))
                if f"{name}/topology" in topics and name != self._target
            )
            listed = f"; there are {', '.join(cloths)} (--node)" if cloths else "; does the node run?"
            self._log.warning(f"nothing has come on {self._target}/topology for {_SILENCE:g} s{listed}")

    def _request(self, names: Sequence[str], receive: Callable[[dict[str, Any]], object]) -> None:
        """Request parameters of the node; later pass them to `receive`, unless a newer topology has come meanwhile."""
        topology_count, self._requested = self._n_topologies, {*names}

        def done(future: Any) -> None:
            if topology_count != self._n_topologies or self._topology_time is None or future.result() is None:
                return
            entries = zip(names, future.result().values, strict=False)
            receive({name: value for name, entry in entries if (value := parameter_value_to_python(entry)) is not None})

        self._client.call_async(GetParameters.Request(names=list(names))).add_done_callback(done)

    def _on_parameters(self, values: dict[str, Any]) -> None:
        names = self._gripper_parameters(values.get("grippers", ()))
        if set(names) <= self._requested:
            self._subscribe(values)
        else:
            # A gripper was not discovered yet.
            self._request([*_PARAMETERS, *names], self._subscribe)

    def _gripper_parameters(self, grippers: Iterable[str]) -> list[str]:
        return [f"{name}.{leaf}" for name in grippers if name for leaf in _GRIPPER_PARAMETERS]

    def _discovered_grippers(self) -> list[str]:
        """Return the names of the grippers whose topics are discovered, without a request to the node."""
        topics = (topic.removeprefix(f"{self._target}/").split("/") for topic in self._topics())
        return [parts[0] for parts in topics if parts[1:] == ["state"]]

    def _topics(self) -> set[str]:
        return {name for name, _ in self._node.get_topic_names_and_types()}

    def _subscribe(self, parameters: dict[str, Any]) -> None:
        self._topology_time = None
        self._send("parameters", json.dumps(parameters, default=list).encode())
        grippers = [name for name in parameters.get("grippers", ()) if name]
        obstacles = [name for name in parameters.get("obstacles", ()) if name]
        topics: list[tuple[str, Any, QoSProfile]] = [
            ("obstacles", MarkerArray, LATCHED_QOS),
            ("clock", Clock, _NEWEST),
            ("points", PointCloud2, _NEWEST),
            *((f"{name}/wrench", WrenchStamped, _NEWEST) for name in [*grippers, *obstacles]),
            *((f"{name}/state", DiagnosticStatus, LATCHED_QOS) for name in grippers),
            *((f"{name}/target", PoseStamped, _NEWEST) for name in grippers),
            *((f"{name}/point", PointStamped, _NEWEST) for name in grippers),
        ]
        named = [(f"{self._target}/{leaf}", kind, qos) for leaf, kind, qos in topics]
        named += [("/diagnostics", DiagnosticArray, _STREAM), ("/rosout", Log, _STREAM)]
        for topic, kind, qos in named:
            forward = partial(self._send, topic)
            self._subscriptions.append(self._node.create_subscription(kind, topic, forward, qos, raw=True))
        events = self._node.create_subscription(ParameterEvent, "/parameter_events", self._on_event, _STREAM)
        self._subscriptions.append(events)
        self._log.info(f"showing {self._target}")

    def _on_event(self, event: Any) -> None:
        if event.node == self._target:
            entries = [*event.new_parameters, *event.changed_parameters]
            changed = {entry.name: parameter_value_to_python(entry.value) for entry in entries}
            self._send("changed", json.dumps(changed, default=list).encode())
