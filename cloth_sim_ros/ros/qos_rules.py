# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parameters that override quality of service: their names and values, judged without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import attrs

from cloth_sim_ros.scene.unknown import PROFILES

if TYPE_CHECKING:
    from cloth_sim_ros.scene.scene import Scene

PUBLISHER, SUBSCRIPTION = ENDPOINT_KINDS = ("publisher", "subscription")
#: Values of each policy that has words for values, in rclpy's order.
_WORDS = {
    "reliability": ("system_default", "reliable", "best_effort", "best_available"),
    "history": ("system_default", "keep_last", "keep_all"),
    "durability": ("system_default", "transient_local", "volatile", "best_available"),
}
#: Parts of a profile that may be overridden.
POLICIES = (*_WORDS, "depth")
#: Deepest queue that a middleware takes: the length has 32 bits there.
_DEEPEST = 2**31 - 1


@attrs.frozen
class Override:
    """The name of an override, taken apart."""

    topic: str
    #: One of ENDPOINT_KINDS.
    endpoint_kind: str
    #: One of POLICIES.
    policy: str

    @property
    def endpoint(self) -> str:
        """The beginning of the name, the same for all policies."""
        return f"{PROFILES}{self.topic}.{self.endpoint_kind}"

    @property
    def name(self) -> str:
        """The parameter's name."""
        return f"{self.endpoint}.{self.policy}"


def topics_of(scene: Scene) -> dict[str, list[str]]:
    """Return the topics of a scene's node whose profiles may be overridden, by endpoint_kind."""
    out = ["~/points", "~/topology", "~/mesh", "~/state", "~/clock", "/diagnostics", "/tf"]
    out += [f"~/{name}/{leaf}" for name in scene.gripper_names for leaf in ("wrench", "state")]
    out += ["~/obstacles"] if scene.described or scene.pinching else []
    out += [f"~/{name}/wrench" for name in scene.described]
    into = [f"~/{name}/{leaf}" for name in scene.gripper_names for leaf in ("target", "point", "grasp")]
    into += [f"~/{name}/target" for name in scene.described]
    return {PUBLISHER: out, SUBSCRIPTION: into}


def overridable(scene: Scene) -> Iterator[tuple[str, str, str]]:
    """Yield the kind of endpoint, topic before remapping, and policy of each override that a scene's node looks at."""
    for endpoint_kind, topics in topics_of(scene).items():
        for topic in topics:
            for policy in POLICIES:
                yield endpoint_kind, topic, policy


def read_name(name: str) -> Override | None:
    """Return the parts of an override's name; None if it is none, or of a policy that can't be overridden."""
    if not name.startswith(PROFILES):
        return None
    topic, _, end = name.removeprefix(PROFILES).rpartition(".")
    topic, _, endpoint_kind = topic.rpartition(".")
    return (
        Override(topic, endpoint_kind, end) if topic and endpoint_kind in ENDPOINT_KINDS and end in POLICIES else None
    )


def faults(values: Mapping[str, Any], defaults: Mapping[str, str] | None = None) -> Iterator[str]:
    """Yield a sentence for each override whose value, or whose combination with others, is senseless.

    Args:
        values: parameters by full name; those that are no overrides are passed over.
        defaults: words of the policies that are not overridden, where they are known.
    """
    endpoints: dict[str, dict[str, str]] = {}
    for name, value in values.items():
        if (override := read_name(name)) is None:
            continue
        if words := _wrong(override, value):
            yield f"{name} is {value!r}; it must be {words}"
        elif isinstance(value, str):
            endpoints.setdefault(override.endpoint, {})[override.policy] = value.lower()
    for endpoint, chosen in endpoints.items():
        policies = {**(defaults or {}), **chosen}
        if policies.get("reliability") == "best_effort" and policies.get("durability") == "transient_local":
            yield (
                f"{endpoint} has reliability best_effort and durability transient_local; what is published by best "
                "effort is not repeated for those who come later: take reliable, or durability volatile"
            )


def foreign_owners(names: Iterable[str], topics: Iterable[str], node: str) -> dict[str, list[str]]:
    """Return the overrides that are of another node's topics, as in a parameter dump of it, by that node's full name.

    Args:
        names: of overrides that this node does not look at.
        topics: of this node, by full name.
        node: its full name.
    """
    leaves = [topic.removeprefix(node) for topic in topics if topic.startswith(f"{node}/")]
    owned: dict[str, list[str]] = {}
    for name in names:
        topic = override.topic if (override := read_name(name)) is not None else ""
        # The longest leaf leaves the shortest name of a node: that of ~/left/wrench, not that of a node 'left'.
        owners = sorted((topic.removesuffix(leaf) for leaf in leaves if topic.endswith(leaf)), key=len)
        if owners and owners[0] not in ("", node):
            owned.setdefault(owners[0], []).append(name)
    return owned


def _wrong(override: Override, value: Any) -> str:
    """Return what a policy's value must be; empty if it is."""
    if override.policy == "depth":
        right = isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _DEEPEST
        waits = "for slow subscribers" if override.endpoint_kind == PUBLISHER else "for the node"
        return "" if right else f"a whole number from 0 to {_DEEPEST}, how many messages wait {waits}"
    words = _WORDS[override.policy]
    right = isinstance(value, str) and value.lower() in words
    return "" if right else f"{', '.join(words[:-1])} or {words[-1]}"
