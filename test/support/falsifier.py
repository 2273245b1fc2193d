# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Falsified sessions: messages altered, removed, repeated or moved, with valid indexes, counts and checksums."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Metadata

from cloth_sim_ros.session.cdr import decode, decode_cloud, encode
from cloth_sim_ros.session.channel_description import MESSAGE_ENCODING, SCHEMA_ENCODING, describe
from cloth_sim_ros.session.mcap_builder import McapBuilder
from cloth_sim_ros.session.part import Message, SessionPart
from cloth_sim_ros.session.writer import END_METADATA_NAME, METADATA_NAME, metadata_checksum
from cloth_sim_ros.verify.main import describe as verdict_in_words
from cloth_sim_ros.verify.run import Verdict

NODE = "/cloth_sim"
POINTS, FRAME, TOPOLOGY, STATE = f"{NODE}/points", f"{NODE}/frame", f"{NODE}/topology", f"{NODE}/state"
MARKERS, DIAGNOSTICS, ROSOUT, TF = f"{NODE}/obstacles", "/diagnostics", "/rosout", "/tf"

Messages = list[Message]
Change = Callable[[Messages], Messages]


@dataclasses.dataclass(frozen=True)
class Falsification:
    """A falsification of a session."""

    change: Change = lambda messages: messages
    needs: str = FRAME
    """Topic that the session must have."""
    end: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Changed entries of the end record."""
    ended: bool = True
    """False to omit the end record."""
    redefined: tuple[str, str] = ("", "")
    """Text of the message definitions and its replacement."""
    counted: bool = True
    """True to update the message count of the end record."""
    listed: str = ""
    """Text in the list of omissions, if the falsification can only be listed."""
    absent: str = ""
    """Topic that is reported as absent, if nothing else can be found."""

    def is_shown(self, verdict: Verdict) -> bool:
        """Return True if a verdict shows the falsification."""
        if self.absent:
            return verdict.same and self.absent in verdict.absent
        if self.listed:
            return verdict.same and self.listed in verdict_in_words(verdict)
        return verdict.damaged or not verdict.same


def falsify(source: Path, target: Path, falsification: Falsification) -> Path:
    """Write a falsified copy of a session of one file."""
    part = SessionPart(source)
    messages = falsification.change(list(part.messages()))
    builder = McapBuilder(compression="lz4")
    opening = builder.encode_opening(
        library="cloth_sim_ros",
        metadata=[Metadata(name=METADATA_NAME, metadata=dict(part.metadata))],
        attachments=list(part.attachments.values()),
    )
    channels: dict[str, int] = {}
    for message in messages:
        if message.topic not in channels:
            definition = describe(message.type_name).definition.replace(*falsification.redefined).encode()
            channels[message.topic] = builder.add_channel(
                topic=message.topic,
                schema=(message.type_name, SCHEMA_ENCODING, definition),
                encoding=MESSAGE_ENCODING,
                metadata={},
            )
        builder.add_message(
            channels[message.topic],
            message.data,
            log_time=message.log_time,
            publish_time=message.publish_time,
            sequence=message.sequence,
        )
    packed = builder.pack_chunk()
    content = opening + b"".join(packed.parts)
    builder.commit(packed, len(opening))
    notes = dict(part.end_notes)
    if falsification.counted:
        notes["messages"] = str(len(messages))
    notes |= falsification.end
    notes["checksum"] = metadata_checksum(notes)
    end = builder.encode_metadata(Metadata(name=END_METADATA_NAME, metadata=notes), len(content))
    end = end if falsification.ended else b""
    target.write_bytes(content + end + builder.encode_closing(len(content) + len(end)))
    part.close()
    return target


def renumbered(change: Change) -> Change:
    """Return a change that also renumbers the messages of each topic from 0."""

    def changed(messages: Messages) -> Messages:
        numbers: dict[str, int] = defaultdict(int)
        renumbered_messages = []
        for message in change(messages):
            renumbered_messages.append(message._replace(sequence=numbers[message.topic]))
            numbers[message.topic] += 1
        return renumbered_messages

    return changed


def alter_messages(
    topic: str, alter: Callable[[Message], Message | None], *, only: Sequence[int] | None = None
) -> Change:
    """Alter the messages of a topic, or only those with the given indices; None removes a message."""

    def changed(messages: Messages) -> Messages:
        places = [k for k, message in enumerate(messages) if message.topic == topic]
        chosen = set(places if only is None else [places[k] for k in only])
        altered = [alter(message) if k in chosen else message for k, message in enumerate(messages)]
        return [message for message in altered if message is not None]

    return changed


def drop(topic: str, *, only: Sequence[int] | None = None) -> Change:
    """Remove messages."""
    return alter_messages(topic, lambda _message: None, only=only)


def double(topic: str, index: int) -> Change:
    """Repeat one message of a topic."""

    def changed(messages: Messages) -> Messages:
        position = [k for k, message in enumerate(messages) if message.topic == topic][index]
        return [*messages[: position + 1], messages[position], *messages[position + 1 :]]

    return changed


def insert(
    topic: str, index: int, after: str, at: int, alter: Callable[[Message], Message] = lambda message: message
) -> Change:
    """Insert an altered copy of a message after another one, with the times of that one."""

    def changed(messages: Messages) -> Messages:
        copied = [message for message in messages if message.topic == topic][index]
        position = [k for k, message in enumerate(messages) if message.topic == after][at]
        neighbour = messages[position]
        copied = alter(copied)._replace(log_time=neighbour.log_time, publish_time=neighbour.publish_time)
        return [*messages[: position + 1], copied, *messages[position + 1 :]]

    return changed


def swap(topic: str, first_index: int, second_index: int, *, whole: bool) -> Change:
    """Exchange two messages of a topic, or only their bytes."""

    def changed(messages: Messages) -> Messages:
        places = [k for k, message in enumerate(messages) if message.topic == topic]
        a, b = places[first_index], places[second_index]
        first, second = messages[a], messages[b]
        if whole:
            messages[a], messages[b] = second, first
        else:
            messages[a], messages[b] = first._replace(data=second.data), second._replace(data=first.data)
        return messages

    return changed


def cut_frames(count: int) -> Change:
    """Remove the last frames and all following messages."""

    def changed(messages: Messages) -> Messages:
        places = [k for k, message in enumerate(messages) if message.topic == FRAME]
        return messages[: places[-count]]

    return changed


def rename(topic: str, new_topic: str) -> Change:
    """Move the messages of a topic to another topic."""
    return alter_messages(topic, lambda message: message._replace(topic=new_topic))


def edit(alter: Callable[[Any], object]) -> Callable[[Message], Message]:
    """Alter the fields of a message in rosbags' form."""

    def altered(message: Message) -> Message:
        content = decode(message.data, message.type_name)
        alter(content)
        return message._replace(data=encode(content, message.type_name))

    return altered


def moved(away: float) -> Callable[[Message], Message]:
    """Move every point of a cloud along z [m]."""

    def altered(message: Message) -> Message:
        # A bytearray is writable, unlike the message.
        data = bytearray(message.data)
        view = decode_cloud(data).xyz
        view.flags.writeable = True
        view[:, 2] += np.float32(away)
        return message._replace(data=bytes(data))

    return altered


def later(nanoseconds: int) -> Callable[[Message], Message]:
    """Shift the publish time."""
    return lambda message: message._replace(publish_time=message.publish_time + nanoseconds)


def both(*alters: Callable[[Message], Message]) -> Callable[[Message], Message]:
    """Apply several changes in turn."""

    def altered(message: Message) -> Message:
        for alter in alters:
            message = alter(message)
        return message

    return altered


def _set(name: str, value: Any) -> Callable[[Any], None]:
    def alter(content: Any) -> None:
        *parents, last = name.split(".")
        for step in parents:
            content = content[int(step)] if step.isdigit() else getattr(content, step)
        setattr(content, last, value)

    return alter


def _turn_grid(content: Any) -> None:
    content.height, content.width = content.width, content.height
    content.row_step = content.width * content.point_step


def _stamp_now(content: Any) -> None:
    content.header.stamp.sec = content.header.stamp.nanosec = 0


def _value(key: str, value: str) -> Callable[[Any], None]:
    def alter(content: Any) -> None:
        statuses = content.status if hasattr(content, "status") else [content]
        for entry in statuses[0].values:
            if entry.key == key:
                entry.value = value

    return alter


def _flip_triangle(content: Any) -> None:
    content.triangles[0].vertex_indices = content.triangles[0].vertex_indices[::-1].copy()


def falsifications(gripper: str, *, busy: bool) -> dict[str, Falsification]:
    """Return falsifications of a session by description. `busy`: True if every frame has one target."""
    wrench, grasp = f"{NODE}/{gripper}/wrench", f"{NODE}/{gripper}/grasp"
    target, state = f"{NODE}/{gripper}/target", f"{NODE}/{gripper}/state"
    shift = both(moved(0.5), later(1))
    after = (target, 2) if busy else (wrench, -3)
    cases = {
        "clouds moved and published 1 ns later": Falsification(alter_messages(POINTS, shift)),
        "one cloud published 1 ns later": Falsification(alter_messages(POINTS, later(1), only=[3])),
        "cloud moved by one bit": Falsification(alter_messages(POINTS, moved(1e-7), only=[3])),
        "cloud of another frame_id": Falsification(alter_messages(POINTS, edit(_set("header.frame_id", "map")))),
        "cloud of another stamp": Falsification(
            alter_messages(POINTS, edit(_set("header.stamp.nanosec", 1)), only=[4])
        ),
        "cloud with rows and columns exchanged": Falsification(alter_messages(POINTS, edit(_turn_grid))),
        "cloud that is not dense": Falsification(alter_messages(POINTS, edit(_set("is_dense", False)))),
        "cloud with its fields renamed": Falsification(
            alter_messages(POINTS, edit(_set("fields.0.count", 2)), only=[2]), needs=POINTS
        ),
        "one cloud left out": Falsification(drop(POINTS, only=[5])),
        "one cloud left out, numbers made anew": Falsification(renumbered(drop(POINTS, only=[5]))),
        "first cloud left out, numbers made anew": Falsification(renumbered(drop(POINTS, only=[0]))),
        "last cloud left out": Falsification(drop(POINTS, only=[-1])),
        "one cloud left out and told to be dropped": Falsification(
            drop(POINTS, only=[5]), end={"dropped": "1"}, listed="1 cloud was dropped"
        ),
        "all clouds left out": Falsification(drop(POINTS), absent=POINTS),
        "one cloud twice": Falsification(double(POINTS, 4)),
        "one cloud twice, numbers made anew": Falsification(renumbered(double(POINTS, 4))),
        "every cloud twice": Falsification(
            renumbered(lambda messages: [message for message in messages for _ in range(1 + (message.topic == POINTS))])
        ),
        "bytes of two clouds exchanged": Falsification(swap(POINTS, 2, 5, whole=False)),
        "two clouds exchanged": Falsification(swap(POINTS, 2, 5, whole=True)),
        "cloud between two frames": Falsification(renumbered(insert(POINTS, 2, wrench, 6))),
        "topology with a triangle turned": Falsification(alter_messages(TOPOLOGY, edit(_flip_triangle))),
        "topology with a point moved": Falsification(alter_messages(TOPOLOGY, edit(_set("vertices.0.x", 0.123)))),
        "topology left out": Falsification(drop(TOPOLOGY)),
        "topology twice": Falsification(renumbered(double(TOPOLOGY, 0))),
        "wrenches published 1 ns later, and altered": Falsification(
            alter_messages(wrench, both(edit(_set("wrench.force.x", 9.0)), later(1)))
        ),
        "wrench of another frame_id": Falsification(alter_messages(wrench, edit(_set("header.frame_id", "map")))),
        "wrench of another stamp": Falsification(alter_messages(wrench, edit(_set("header.stamp.sec", 1)), only=[2])),
        "one wrench left out, numbers made anew": Falsification(renumbered(drop(wrench, only=[3]))),
        "all wrenches left out": Falsification(drop(wrench), absent=wrench),
        "received targets left out": Falsification(renumbered(drop(target))),
        "received target inserted": Falsification(renumbered(insert(target, 0, *after, edit(_stamp_now)))),
        "older target inserted": Falsification(renumbered(insert(target, 0, target, 2)), listed="too old"),
        "received grasp inserted": Falsification(renumbered(insert(grasp, 0, wrench, 2))),
        "received grasps left out": Falsification(renumbered(drop(grasp)), listed="grasp without a message"),
        "frame records' log times altered": Falsification(
            alter_messages(FRAME, lambda message: message._replace(log_time=message.log_time + 1))
        ),
        "log time of one cloud altered": Falsification(
            alter_messages(POINTS, lambda message: message._replace(log_time=message.log_time - 5), only=[3])
        ),
        "sequence number altered": Falsification(
            alter_messages(POINTS, lambda message: message._replace(sequence=message.sequence + 1), only=[3])
        ),
        "sequence numbers shifted": Falsification(
            alter_messages(POINTS, lambda message: message._replace(sequence=message.sequence + 7))
        ),
        "sequence numbers gone": Falsification(
            alter_messages(POINTS, lambda message: message._replace(sequence=0)), listed="without sequence numbers"
        ),
        "last frames cut out": Falsification(cut_frames(5), counted=False),
        "end record of another count": Falsification(end={"messages": "3"}),
        "end record left out": Falsification(cut_frames(5), ended=False, listed="its end record"),
        "end record without a count": Falsification(
            cut_frames(5), end={"messages": "many"}, listed="the number of its messages"
        ),
        "clouds declared as another type": Falsification(
            alter_messages(POINTS, lambda message: message._replace(type_name="std_msgs/msg/String"))
        ),
        "frames declared as another type": Falsification(
            alter_messages(FRAME, lambda message: message._replace(type_name="std_msgs/msg/Bool"))
        ),
        "rows and columns exchanged in the definition": Falsification(
            redefined=("uint32 height\nuint32 width", "uint32 width\nuint32 height")
        ),
        "clouds under another topic": Falsification(rename(POINTS, f"{NODE}/pts"), absent=POINTS),
        "wrenches under another topic": Falsification(
            rename(wrench, "/other/wrench"), counted=False, listed="/other/wrench"
        ),
        "bytes that are no cloud": Falsification(
            alter_messages(POINTS, both(lambda message: message._replace(data=message.data[:40]), later(1)), only=[2])
        ),
        # Only sessions of a node have these.
        "state left out": Falsification(renumbered(drop(STATE, only=[1])), needs=STATE),
        "state altered": Falsification(alter_messages(STATE, edit(_set("id", 2)), only=[-2]), needs=STATE),
        "first active state left out": Falsification(renumbered(drop(STATE, only=[1])), needs=STATE),
        "state twice": Falsification(renumbered(double(STATE, 1)), needs=STATE),
        "gripper state with a key twice": Falsification(
            alter_messages(state, edit(lambda message: message.values.append(message.values[0])), only=[1]), needs=state
        ),
        "states left out": Falsification(drop(STATE), needs=STATE, absent=STATE),
        "gripper state left out": Falsification(renumbered(drop(state, only=[1])), needs=state),
        "gripper states left out": Falsification(drop(state), needs=state, absent=state),
        "gripper state that holds more": Falsification(
            alter_messages(state, edit(_value("grasped_count", "99"))), needs=state
        ),
        "gripper state that holds more by its old key": Falsification(
            alter_messages(state, edit(_value("held", "99"))), needs=state
        ),
        "gripper state of other words": Falsification(
            alter_messages(state, edit(_set("message", "open")), only=[1]), needs=state
        ),
        "markers left out": Falsification(renumbered(drop(MARKERS, only=[2])), needs=MARKERS),
        "all markers left out": Falsification(drop(MARKERS), needs=MARKERS, absent=MARKERS),
        "marker moved": Falsification(
            alter_messages(MARKERS, edit(_set("markers.0.pose.position.x", 5.0))), needs=MARKERS
        ),
        "first marker moved": Falsification(
            alter_messages(MARKERS, edit(_set("markers.0.pose.position.x", 5.0)), only=[0]), needs=MARKERS
        ),
        "marker of another size": Falsification(
            alter_messages(MARKERS, edit(_set("markers.0.scale.x", 5.0))), needs=MARKERS
        ),
        "marker of another colour": Falsification(
            alter_messages(MARKERS, edit(_set("markers.0.color.r", 0.9))), needs=MARKERS
        ),
        "marker of another frame_id": Falsification(
            alter_messages(MARKERS, edit(_set("markers.0.header.frame_id", "map"))), needs=MARKERS
        ),
        "transforms left out": Falsification(drop(TF), needs=TF, absent=TF),
        "one transform left out": Falsification(renumbered(drop(TF, only=[3])), needs=TF),
        "transform moved": Falsification(
            alter_messages(TF, edit(_set("transforms.0.transform.translation.x", 5.0)), only=[3]), needs=TF
        ),
        "diagnostics of another frame": Falsification(
            alter_messages(DIAGNOSTICS, edit(_value("frame", "7777"))), needs=DIAGNOSTICS
        ),
        "diagnostics of another strain": Falsification(
            alter_messages(DIAGNOSTICS, edit(_value("largest_strain", "9.000000"))), needs=DIAGNOSTICS
        ),
        "diagnostics of another integrator": Falsification(
            alter_messages(DIAGNOSTICS, edit(_value("integrator", "other"))), needs=DIAGNOSTICS
        ),
        "diagnostics of another reason": Falsification(
            alter_messages(DIAGNOSTICS, edit(_value("integrator_reason", "other"))), needs=DIAGNOSTICS
        ),
        "diagnostics of another reason by its old key": Falsification(
            alter_messages(DIAGNOSTICS, edit(_value("integrator_why", "other"))), needs=DIAGNOSTICS
        ),
        "diagnostics 1 us later": Falsification(
            alter_messages(DIAGNOSTICS, edit(_value("simulated_time", "0.533334"))), needs=DIAGNOSTICS
        ),
        "diagnostics of another frame_id": Falsification(
            alter_messages(DIAGNOSTICS, edit(_set("header.frame_id", "map"))), needs=DIAGNOSTICS
        ),
        "diagnostics with a key twice": Falsification(
            alter_messages(
                DIAGNOSTICS, edit(lambda message: message.status[0].values.append(message.status[0].values[0]))
            ),
            needs=DIAGNOSTICS,
        ),
        "diagnostics with a status twice": Falsification(
            alter_messages(DIAGNOSTICS, edit(lambda message: message.status.append(message.status[0]))),
            needs=DIAGNOSTICS,
        ),
        "diagnostics without values": Falsification(
            alter_messages(DIAGNOSTICS, edit(lambda message: message.status[0].values.clear())),
            needs=DIAGNOSTICS,
            listed="is not there",
        ),
        "diagnostics twice": Falsification(
            renumbered(double(DIAGNOSTICS, 0)), needs=DIAGNOSTICS, listed="the same message once more"
        ),
        "diagnostics of another real-time factor": Falsification(
            alter_messages(DIAGNOSTICS, edit(_value("real_time_factor", "99.0"))),
            needs=DIAGNOSTICS,
            listed="real_time_factor",
        ),
        "log altered": Falsification(
            alter_messages(ROSOUT, edit(_set("msg", "all well"))), needs=ROSOUT, listed="/rosout"
        ),
        "one line of the log left out": Falsification(drop(ROSOUT, only=[0]), needs=ROSOUT),
    }
    return cases
