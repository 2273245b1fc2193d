# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Warnings of parameters without effect."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import TYPE_CHECKING

from cloth_sim_ros.ros.io.qos_rules import Override, foreign_owners, overridable
from cloth_sim_ros.scene.parameters.unknown_parameters import QOS_PREFIX, ROS_PARAMETERS, suggestion

if TYPE_CHECKING:
    from cloth_sim_ros.scene.scene import Scene

#: Largest number of parameters with a sentence each; more share one.
_MAX_SINGLE = 3


def unknown_sentences(
    names: Iterable[str], known: Iterable[str], scene: Scene, *, node: str, resolve: Callable[[str], str] | None = None
) -> list[str]:
    """Return a warning for each parameter that is set but that the node does not read.

    Overrides of another node's topics, as in a parameter dump of that node, share one sentence.

    Args:
        names: names of the parameters that are set, known ones included.
        known: names of the existing parameters, without overrides of quality of service.
        scene: the scene of the node.
        node: the full name of the node.
        resolve: returns a topic's full name after remapping. By default topics may be remapped to any name, and every
            override counts as read.
    """
    full = resolve or (lambda topic: topic.replace("~", node, 1))
    topics = {full(topic) for _, topic, _ in overridable(scene)}
    profiles = [
        Override(full(topic), endpoint_kind, policy).name for endpoint_kind, topic, policy in overridable(scene)
    ]
    declared = [*known, *ROS_PARAMETERS, *profiles]
    unknown = [name for name in names if name not in set(declared)]
    owners = foreign_owners(unknown, topics, node)
    dumps = {owner: overrides for owner, overrides in owners.items() if len(overrides) > _MAX_SINGLE}
    grouped = {name for overrides in dumps.values() for name in overrides}
    single = [name for name in unknown if name not in grouped]
    if resolve is None:
        single = [name for name in single if not name.startswith(QOS_PREFIX)]
    of_dumps = [_describe_dump(owner, len(overrides), node) for owner, overrides in dumps.items()]
    return of_dumps + _describe_unknown(single, declared)


def _describe_dump(owner: str, count: int, node: str) -> str:
    return (
        f"{count} parameters qos_overrides.{owner}/... are of topics of {owner}, as in a parameter dump of that node, "
        f"and have no effect in {node}: write {node}/ for {owner}/ in their names, or leave them out"
    )


def _describe_unknown(names: list[str], known: Collection[str]) -> list[str]:
    if len(names) <= _MAX_SINGLE:
        return [
            f"there is no parameter '{name}', what sets it has no effect{suggestion(name, known)}" for name in names
        ]
    listed = ", ".join(f"'{name}'" for name in names[:_MAX_SINGLE])
    return [
        f"there are no parameters {listed} and {len(names) - _MAX_SINGLE} more, what sets them has no effect; is the "
        "file another node's?"
    ]
