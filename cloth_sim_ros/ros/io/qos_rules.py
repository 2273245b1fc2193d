# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Validation of quality-of-service overrides, without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import attrs

from cloth_sim_ros.scene.parameters.unknown_parameters import QOS_PREFIX

if TYPE_CHECKING:
    from cloth_sim_ros.scene.scene import Scene

#: Topics of a depth camera, below its name.
CAMERA_LEAVES = DEPTH, CAMERA_INFO, LABELS, LABEL_NAMES, POINTS = (
    "depth/image_rect_raw",
    "depth/camera_info",
    "labels",
    "label_names",
    "points",
)
PUBLISHER, SUBSCRIPTION = ENDPOINT_KINDS = ("publisher", "subscription")
#: Named values of each policy, in rclpy's order.
_WORDS = {
    "reliability": ("system_default", "reliable", "best_effort", "best_available"),
    "history": ("system_default", "keep_last", "keep_all"),
    "durability": ("system_default", "transient_local", "volatile", "best_available"),
}
#: Policies of a profile that may be overridden.
POLICIES = (*_WORDS, "depth")
#: Largest depth of a queue: the middleware's length has 32 bits.
_MAX_DEPTH = 2**31 - 1


@attrs.frozen
class Override:
    """Topic, endpoint kind and policy in the name of a quality-of-service override."""

    topic: str
    #: One of ENDPOINT_KINDS.
    endpoint_kind: str
    #: One of POLICIES.
    policy: str

    @property
    def endpoint(self) -> str:
        """Common start of the names of this endpoint's overrides: `qos_overrides.<topic>.<kind>`."""
        return f"{QOS_PREFIX}{self.topic}.{self.endpoint_kind}"

    @property
    def name(self) -> str:
        """Name of the override's ROS parameter."""
        return f"{self.endpoint}.{self.policy}"


def topics_of(scene: Scene) -> dict[str, list[str]]:
    """Return a scene's topics whose quality of service may be overridden, before remapping, by endpoint kind."""
    out = ["~/points", "~/topology", "~/mesh", "~/state", "~/clock", "/diagnostics", "/tf"]
    out += [f"~/{name}/{leaf}" for name in scene.gripper_names for leaf in ("wrench", "state")]
    out += ["~/obstacles"] if scene.described or scene.pinching else []
    out += [f"~/{name}/wrench" for name in scene.unlinked_names]
    out += ["~/frame", "~/snapshot"] if scene.record.topics else []
    out += ["~/keypoints"] if any(scene.keypoints) else []
    out += ["~/coverage"] if scene.coverage.obstacle else []
    out += ["~/ensemble"] if scene.ensemble.file else []
    out += [f"~/{name}/{leaf}" for name in scene.camera_names for leaf in CAMERA_LEAVES]
    into = [f"~/{name}/{leaf}" for name in scene.gripper_names for leaf in ("target", "point", "grasp")]
    into += [f"~/{name}/twist" for name in scene.gripper_names if scene.gripper.twist_max_speed]
    out += [f"~/{name}/ft_sensor_wrench" for name in scene.gripper_names if scene.gripper.sensor_frame]
    into += [f"~/{name}/target" for name in scene.unlinked_names]
    into += [scene.robot.joint_states_topic] if scene.robot.enabled else []
    return {PUBLISHER: out, SUBSCRIPTION: into}


def overridable(scene: Scene) -> Iterator[tuple[str, str, str]]:
    """Yield endpoint kind, topic before remapping, and policy of each override that a scene's node reads."""
    for endpoint_kind, topics in topics_of(scene).items():
        for topic in topics:
            for policy in POLICIES:
                yield endpoint_kind, topic, policy


def read_name(name: str) -> Override | None:
    """Parse the name of a quality-of-service override; return None for another name, or a policy that is fixed."""
    if not name.startswith(QOS_PREFIX):
        return None
    topic, _, end = name.removeprefix(QOS_PREFIX).rpartition(".")
    topic, _, endpoint_kind = topic.rpartition(".")
    return (
        Override(topic, endpoint_kind, end) if topic and endpoint_kind in ENDPOINT_KINDS and end in POLICIES else None
    )


def faults(values: Mapping[str, Any], defaults: Mapping[str, str] | None = None) -> Iterator[str]:
    """Yield a sentence for each quality-of-service override that is invalid by itself or together with others.

    Args:
        values: parameters by full name; other parameters are ignored.
        defaults: values of the policies that are not overridden, if they are known.
    """
    endpoints: dict[str, dict[str, str]] = {}
    for name, value in values.items():
        if (override := read_name(name)) is None:
            continue
        if words := _allowed_values(override, value):
            yield f"{name} is {value!r}; it must be {words}"
        elif isinstance(value, str):
            endpoints.setdefault(override.endpoint, {})[override.policy] = value.lower()
    for endpoint, chosen in endpoints.items():
        policies = {**(defaults or {}), **chosen}
        if policies.get("reliability") == "best_effort" and policies.get("durability") == "transient_local":
            yield (
                f"{endpoint} has reliability best_effort and durability transient_local; best effort does not repeat "
                "messages for late subscribers: set reliability reliable or durability volatile"
            )


def foreign_owners(names: Iterable[str], topics: Iterable[str], node: str) -> dict[str, list[str]]:
    """Group names of overrides for other nodes' topics by that node's full name; parameter dumps contain such ones.

    Args:
        names: names of overrides that this node does not read.
        topics: full names of this node's topics.
        node: the full name of this node.
    """
    leaves = [topic.removeprefix(node) for topic in topics if topic.startswith(f"{node}/")]
    owned: dict[str, list[str]] = {}
    for name in names:
        topic = override.topic if (override := read_name(name)) is not None else ""
        # The longest leaf gives the shortest node name: ~/left/wrench belongs to this leaf, not to a node 'left'.
        owners = sorted((topic.removesuffix(leaf) for leaf in leaves if topic.endswith(leaf)), key=len)
        if owners and owners[0] not in ("", node):
            owned.setdefault(owners[0], []).append(name)
    return owned


def _allowed_values(override: Override, value: Any) -> str:
    """Return the allowed values of a policy as text if the value is invalid; otherwise an empty text."""
    if override.policy == "depth":
        is_valid = isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _MAX_DEPTH
        waits = "for slow subscribers" if override.endpoint_kind == PUBLISHER else "for the node"
        return "" if is_valid else f"a whole number from 0 to {_MAX_DEPTH}, how many messages wait {waits}"
    words = _WORDS[override.policy]
    is_valid = isinstance(value, str) and value.lower() in words
    return "" if is_valid else f"{', '.join(words[:-1])} or {words[-1]}"
