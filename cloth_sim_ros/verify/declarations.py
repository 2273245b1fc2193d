# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Comparison of the declared message types with those of the node.

Channel and schema define the meaning of the bytes: other tools decode a cloud by the declared fields.
"""

from __future__ import annotations

from cloth_sim_ros.session import messages
from cloth_sim_ros.session.channel_description import MESSAGE_ENCODING, SCHEMA_ENCODING, describe
from cloth_sim_ros.session.part import SessionPart
from cloth_sim_ros.verify import diagnostics, markers, states
from cloth_sim_ros.verify.verdict import Findings

#: Message types by the last part of the node's topics.
_TYPES = {
    "frame": messages.STRING,
    "points": messages.CLOUD,
    "ensemble": messages.CLOUD,
    "topology": messages.MESH,
    "wrench": messages.WRENCH,
    "obstacles": markers.MARKERS,
    "state": states.STATUS,
    "target": messages.POSE,
    "twist": messages.TWIST,
    "point": messages.POINT,
    "grasp": messages.BOOL,
    "tf": messages.TRANSFORMS,
    "diagnostics": diagnostics.TYPE,
}
#: Maximum ratio of the lengths of a definition with comments and one without.
_MAX_LENGTH_RATIO = 20


def compare_declarations(part: SessionPart, node: str, topics: frozenset[str], findings: Findings) -> None:
    """Compare a file's declared message types, encodings and definitions with the node's; report differences.

    Args:
        part: the file.
        node: resolved name of the node.
        topics: topics whose messages were compared.
        findings: collects the differences.
    """
    schemas, channels = part.declarations()
    for channel in channels.values():
        topic, schema = channel.topic, schemas.get(channel.schema_id)
        if topic not in topics or schema is None:
            continue
        expected_type = states.STATE if topic == f"{node}/state" else _TYPES[topic.rpartition("/")[2]]
        compared = (
            ("type", schema.name, expected_type),
            ("encoding", channel.message_encoding, MESSAGE_ENCODING),
            ("schema's encoding", schema.encoding, SCHEMA_ENCODING),
        )
        for quantity, recorded, expected in compared:
            if recorded != expected:
                reason = f"the {quantity} of {topic} ({recorded} is recorded, {expected} is due)"
                findings.add_difference("declaration", reason)
                break
        else:
            if not _is_same_definition(schema.data, expected_type):
                findings.add_difference("declaration", f"the message definition of {topic}")


def _is_same_definition(recorded: bytes, type_name: str) -> bool:
    """Return True if a recorded message definition has the fields of a standard type; comments may differ."""
    expected = describe(type_name).definition
    if recorded == expected.encode():
        return True
    if len(recorded) > _MAX_LENGTH_RATIO * len(expected):
        return False
    from rosbags.typesys import TypesysError, get_types_from_msg

    try:
        recorded_types = get_types_from_msg(recorded.decode(), type_name)
    except (TypesysError, ValueError):
        return False
    expected_types = get_types_from_msg(expected, type_name)
    # Only fields are compared: a tool may leave out constants.
    recorded_fields = {name: fields for name, (_, fields) in recorded_types.items()}
    return recorded_fields == {name: fields for name, (_, fields) in expected_types.items()}
