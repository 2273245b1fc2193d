# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Description of an MCAP channel in the ``ros2`` profile.

A channel carries its message definition, type hash and quality of service. Definitions and hashes of the standard types
come from rosbags; no ROS installation is needed.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from cloth_sim_ros.session.errors import SessionError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

SCHEMA_ENCODING = "ros2msg"
MESSAGE_ENCODING = "cdr"


@dataclass(frozen=True, slots=True, kw_only=True)
class TypeDescription:
    """Message type as stored in an MCAP schema: full name, text of its definition, and REP 2016 hash."""

    name: str
    """Full name, e.g. ``std_msgs/msg/String``."""
    definition: str
    """The .msg text, followed by the texts of all types it uses (schema encoding ``ros2msg``)."""
    type_hash: str
    """REP 2016 hash, ``RIHS01_`` and 64 hexadecimal digits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Qos:
    """Offered quality of service of a topic: reliability, durability, history, depth; otherwise the defaults.

    The deadline, the lifespan and the lease are infinite; liveliness is automatic.
    """

    reliability: Literal["reliable", "best_effort"] = "reliable"
    durability: Literal["volatile", "transient_local"] = "volatile"
    depth: int = 10
    history: Literal["keep_last", "keep_all"] = "keep_last"

    def to_yaml(self) -> str:
        """Return the text of a channel's ``offered_qos_profiles`` in rosbag2 (metadata version 9, Jazzy)."""
        infinite = "    sec: 9223372036\n    nsec: 854775807\n"
        return (
            f"- history: {self.history}\n  depth: {self.depth}\n  reliability: {self.reliability}\n"
            f"  durability: {self.durability}\n  deadline:\n{infinite}  lifespan:\n{infinite}  liveliness: automatic\n"
            f"  liveliness_lease_duration:\n{infinite}  avoid_ros_namespace_conventions: false"
        )


@functools.cache
def standard_types() -> Typestore:
    """Return rosbags' store of ROS 2 Jazzy's message types, cached; the first call takes about 70 ms."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


@functools.cache
def describe(type_name: str) -> TypeDescription:
    """Return name, definition and hash of a standard message type, cached. Raises SessionError for any other type.

    Raises SessionError for a type that is not standard.
    """
    store = standard_types()
    if type_name not in store.fielddefs:
        standard = "a standard ROS 2 Jazzy type; a session holds standard types only"
        raise SessionError(f"message type {type_name!r} is not {standard}")
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return TypeDescription(name=type_name, definition=definition, type_hash=store.hash_rihs01(type_name))


def channel_metadata(type_name: str, qos: Qos) -> dict[str, str]:
    """Return an MCAP channel's metadata as rosbag2 writes them: QoS as YAML, and type hash. Raises SessionError."""
    return {"offered_qos_profiles": qos.to_yaml(), "topic_type_hash": describe(type_name).type_hash}
