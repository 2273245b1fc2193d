# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a bag of ROS 1, in the types of ROS 2."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from cloth_sim_ros.session.channel_description import standard_types
from cloth_sim_ros.session.errors import DamagedSessionError, SessionError
from cloth_sim_ros.session.opening import open_file

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc
    from rosbags.typesys.store import Typestore

#: Ending of the files.
ENDING = ".bag"


def ros1_messages(path: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield (topic, ROS 2 type, log time [ns], CDR bytes) of a ROS 1 bag's messages, by time. Raises SessionError.

    Messages of other types, and of types whose definition differs between ROS 1 and ROS 2, are left out.

    Raises:
        SessionError: if the file can't be read, or is damaged.
    """
    try:
        from rosbags.rosbag1 import Reader
    except ImportError as error:
        raise SessionError(f"{path} needs {error.name}, which is not installed: pip install rosbags") from error

    # Refuses pipes and devices.
    open_file(path).close()
    count = 0
    try:
        with Reader(path) as reader:
            connections = [entry for entry in reader.connections if _digest(entry.msgtype) == entry.digest]
            # An empty list would select all messages.
            for connection, log_time, data in reader.messages(connections) if connections else ():
                message = standard_types().ros1_to_cdr(data, connection.msgtype)
                yield connection.topic, connection.msgtype, log_time, bytes(message)
                count += 1
    except Exception as error:  # Errors of several libraries.
        error_class = DamagedSessionError if count else SessionError
        raise error_class(f"{path} can't be read as a bag of ROS 1: {error}; try `rosbag reindex`") from error


@functools.cache
def _digest(type_name: str) -> str | None:
    """Return the digest (MD5 sum) of a type of ROS 1 whose fields are those of ROS 2; None for any other type."""
    if not _has_same_fields(type_name):
        return None
    return str(_ros1_types().generate_msgdef(type_name, ros_version=1)[1])


def _has_same_fields(type_name: str) -> bool:
    first, second = _ros1_types().fielddefs.get(type_name), standard_types().fielddefs.get(type_name)
    if type_name == "std_msgs/msg/Header":
        # The conversion leaves out the counter of ROS 1.
        return True
    if first is None or second is None or first[1] != second[1]:
        return False
    return all(_has_same_fields(name) for _, field in first[1] if (name := _message_type(field)) is not None)


def _message_type(field: FieldDesc) -> str | None:
    """Return the message type of a field, or of its elements; None for numbers and texts."""
    from rosbags.interfaces import Nodetype

    kind, description = field
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return _message_type(description[0])
    return str(description) if kind == Nodetype.NAME else None


@functools.cache
def _ros1_types() -> Typestore:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC)
