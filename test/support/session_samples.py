# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Synthetic sessions with all topics, without simulation and ROS."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, MessageIndex, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from cloth_sim_ros.session import cdr
from cloth_sim_ros.session.channel_description import Qos
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.writer import SessionSnapshot, SessionWriter, WriterOptions

NODE = "/cloth_sim"
FRAME = f"{NODE}/frame"
POINTS = f"{NODE}/points"
TOPOLOGY = f"{NODE}/topology"
TARGET = f"{NODE}/gripper/target"
START = 1_795_000_000_000_000_000
PERIOD = 16_666_667
LATCHED = Qos(durability="transient_local", depth=1)
SNAPSHOT = SessionSnapshot(
    scene_yaml="/**:\n  ros__parameters:\n    rate: 60.0\n",
    state=bytes(range(256)) * 20,
    metadata={"node": NODE, "period": "0.016666666666666666", "package": "0.1.0"},
    files={"cloth.springs": b"springs"},
)
SMALL_CHUNKS = WriterOptions(chunk_bytes=8192, sync_seconds=0)


class Sample(NamedTuple):
    """A message for a recording."""

    topic: str
    type_name: str
    data: bytes
    log_time: int
    droppable: bool


def message(type_name: str, **fields: Any) -> Any:
    """Return a message object of a standard type."""
    return cdr.message_class(type_name)(**fields)


def header(stamp: int, frame_id: str = "world") -> Any:
    time = message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return message("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def cloud(
    xyz: np.ndarray[Any, Any], stamp: int, *, frame_id: str = "world", names: Sequence[str] = ("x", "y", "z")
) -> bytes:
    """Encode a cloud; xyz (n, fields) float32."""
    fields = [
        message("sensor_msgs/msg/PointField", name=name, offset=4 * index, datatype=7, count=1)
        for index, name in enumerate(names)
    ]
    step = 4 * len(names)
    content = message(
        "sensor_msgs/msg/PointCloud2",
        header=header(stamp, frame_id),
        height=1,
        width=len(xyz),
        fields=fields,
        is_bigendian=False,
        point_step=step,
        row_step=step * len(xyz),
        data=np.frombuffer(np.ascontiguousarray(xyz, "<f4").tobytes(), np.uint8),
        is_dense=True,
    )
    return cdr.encode(content, "sensor_msgs/msg/PointCloud2")


def positions(frame: int, points: int) -> np.ndarray[Any, Any]:
    """Return a waving line of points [m], (points, 3) float32."""
    along = np.linspace(0.0, 1.0, points)
    wave = 0.1 * np.sin(7.0 * along + 0.2 * frame)
    return np.stack([along, wave, 1.0 - 0.001 * frame * along], axis=1).astype(np.float32)


def frame_record(frame: int, events: tuple[dict[str, Any], ...] = ()) -> FrameRecord:
    return FrameRecord(
        frame=frame,
        time=frame / 60,
        events=events,
        integrator="leapfrog",
        tolerance=1e-4 if frame % 2 else None,
        steps=5 + frame % 3,
        digest=f"{frame * 0x9E3779B97F4A7C15 % 2**128:032x}",
        paused=False,
    )


def _pose(stamp: int, height: float) -> bytes:
    pose = message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=0.5, y=0.0, z=height),
        orientation=message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    return cdr.encode(
        message("geometry_msgs/msg/PoseStamped", header=header(stamp), pose=pose), "geometry_msgs/msg/PoseStamped"
    )


def _wrench(stamp: int) -> bytes:
    vector = message("geometry_msgs/msg/Vector3", x=0.25, y=-1.5, z=math.pi)
    wrench = message("geometry_msgs/msg/Wrench", force=vector, torque=vector)
    content = message("geometry_msgs/msg/WrenchStamped", header=header(stamp), wrench=wrench)
    return cdr.encode(content, "geometry_msgs/msg/WrenchStamped")


def _diagnostics(stamp: int) -> bytes:
    pair = message("diagnostic_msgs/msg/KeyValue", key="real-time factor", value="1.0")
    status = message(
        "diagnostic_msgs/msg/DiagnosticStatus", level=0, name="cloth_sim", message="", hardware_id="", values=[pair]
    )
    content = message("diagnostic_msgs/msg/DiagnosticArray", header=header(stamp), status=[status])
    return cdr.encode(content, "diagnostic_msgs/msg/DiagnosticArray")


def topology(points: int) -> bytes:
    triangles = [
        message("shape_msgs/msg/MeshTriangle", vertex_indices=np.array([i, i + 1, i + 2], np.uint32))
        for i in range(points - 2)
    ]
    vertices = [
        message("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z)) for x, y, z in positions(0, points)
    ]
    return cdr.encode(message("shape_msgs/msg/Mesh", triangles=triangles, vertices=vertices), "shape_msgs/msg/Mesh")


def samples(frames: int, *, points: int = 40, first: int = 0) -> Iterator[Sample]:
    """Return the messages of a node over some frames: every kind of topic, in the order of recording."""
    if first == 0:
        yield Sample(TOPOLOGY, "shape_msgs/msg/Mesh", topology(points), START, False)
    for frame in range(first, first + frames):
        stamp = START + frame * PERIOD
        events: tuple[dict[str, Any], ...] = ()
        if frame % 3 == 0:
            yield Sample(TARGET, "geometry_msgs/msg/PoseStamped", _pose(stamp, frame / 60), stamp, False)
            events = ({"kind": "target", "gripper": "gripper", "position": [0.5, 0.0, frame / 60]},)
        if frame % 20 == 10:
            content = message("std_msgs/msg/Bool", data=True)
            yield Sample(
                f"{NODE}/gripper/grasp", "std_msgs/msg/Bool", cdr.encode(content, "std_msgs/msg/Bool"), stamp, False
            )
            events += ({"kind": "grasp", "gripper": "gripper", "closed": True},)
        text = frame_record(frame, events).to_json()
        yield Sample(FRAME, "std_msgs/msg/String", cdr.encode_string(text), stamp, False)
        yield Sample(POINTS, "sensor_msgs/msg/PointCloud2", cloud(positions(frame, points), stamp), stamp, True)
        yield Sample(f"{NODE}/gripper/wrench", "geometry_msgs/msg/WrenchStamped", _wrench(stamp), stamp, False)
        if frame % 30 == 0:
            yield Sample("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", _diagnostics(stamp), stamp, False)


def write_session(
    folder: Path, content: Sequence[Sample], *, options: WriterOptions = SMALL_CHUNKS, stem: str = "session"
) -> Path:
    """Write messages with a SessionWriter and finish the file."""
    writer = SessionWriter(folder, snapshot=SNAPSHOT, stem=stem, log_time=START, options=options)
    numbers: dict[str, int] = {}
    for sample in content:
        if not writer.is_declared(sample.topic):
            writer.declare(sample.topic, sample.type_name)
        sequence = numbers.get(sample.topic, 0)
        numbers[sample.topic] = sequence + 1
        writer.add(sample.topic, sample.data, log_time=sample.log_time, publish_time=sample.log_time, sequence=sequence)
    writer.finish(reason="stopped", notes={"dropped": "0"})
    return writer.path


def read_all(*paths: Path) -> list[Message]:
    """Return all messages of a session."""
    with SessionReader(list(paths)) as reader:
        return list(reader.messages())


def plain(messages: Sequence[Message | Sample]) -> list[tuple[str, str, bytes, int]]:
    """Return the fields on which two readers must agree: topic, type, bytes, time."""
    return [(item.topic, item.type_name, item.data, item.log_time) for item in messages]


def check_structure(path: Path) -> None:
    """Check indexes, counts and declarations of a finished file against its records, like MCAP's official checker."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    times: list[int] = []
    size = path.stat().st_size
    with path.open("rb") as file:
        summary = SeekingReader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        for index in summary.chunk_indexes:
            file.seek(index.chunk_start_offset)
            head = file.read(9)
            assert head[0] == Opcode.CHUNK
            assert index.chunk_length == 9 + int.from_bytes(head[1:], "little")
            chunk = Chunk.read(ReadDataStream(file))
            assert (chunk.message_start_time, chunk.message_end_time) == (
                index.message_start_time,
                index.message_end_time,
            )
            assert (chunk.compression, len(chunk.data), chunk.uncompressed_size) == (
                index.compression,
                index.compressed_size,
                index.uncompressed_size,
            )
            entries_by_channel: dict[int, list[tuple[int, int]]] = {}
            stream, length = get_chunk_data_stream(chunk, validate_crc=True)
            while stream.count < length:
                position, opcode, body = stream.count, stream.read1(), stream.read8()
                if opcode == Opcode.MESSAGE:
                    item = McapMessage.read(stream, body)
                    assert item.channel_id in channels
                    entries_by_channel.setdefault(item.channel_id, []).append((item.log_time, position))
                    times.append(item.log_time)
                elif opcode == Opcode.SCHEMA:
                    schema = Schema.read(stream)
                    assert schema.id not in schemas, "declared twice"
                    schemas[schema.id] = schema
                else:
                    assert opcode == Opcode.CHANNEL
                    channel = Channel.read(stream)
                    assert channel.id not in channels, "declared twice"
                    assert channel.schema_id in schemas
                    channels[channel.id] = channel
            assert index.message_index_offsets.keys() == entries_by_channel.keys()
            for channel_id, entries in entries_by_channel.items():
                offset = index.message_index_offsets[channel_id]
                assert index.chunk_start_offset + index.chunk_length <= offset < size
                file.seek(offset + 9)
                message_index = MessageIndex.read(ReadDataStream(file))
                assert message_index.channel_id == channel_id
                assert message_index.records == entries
            logged = [time for entries in entries_by_channel.values() for time, _ in entries]
            assert (min(logged), max(logged)) == (index.message_start_time, index.message_end_time)
        assert summary.schemas == schemas
        assert summary.channels == channels
        statistics = summary.statistics
        assert statistics.chunk_count == len(summary.chunk_indexes)
        assert statistics.message_count == len(times) == sum(statistics.channel_message_counts.values())
        if times:
            assert (statistics.message_start_time, statistics.message_end_time) == (min(times), max(times))
        assert statistics.attachment_count == len(summary.attachment_indexes)
        assert statistics.metadata_count == len(summary.metadata_indexes)
        # The indexes name every chunk.
        file.seek(0)
        assert sum(isinstance(item, Chunk) for item in StreamReader(file, emit_chunks=True).records) == len(
            summary.chunk_indexes
        )
