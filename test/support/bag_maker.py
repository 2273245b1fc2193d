# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of a node with `record.topics`, and bags of them, without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import messages
from cloth_sim_ros.session.bag import SNAPSHOT_TYPE
from cloth_sim_ros.session.cdr import encode_string
from cloth_sim_ros.session.channel_description import describe
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.snapshot_message import snapshot_bytes
from cloth_sim_ros.session.writer import SessionSnapshot
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.simulation.events import Event, to_dict
from cloth_sim_ros.simulation.simulation import Simulation

START = 1_700_000_000_000_000_000


class BagMessage(NamedTuple):
    """A message of a bag."""

    topic: str
    type_name: str
    data: bytes


class MessageMaker:
    """Simulates a cloth and returns the messages of its node.

    Args:
        scene: the cloth.
        node: name of the node.
        session: identifier of the node's run.
    """

    def __init__(self, scene: Scene, *, node: str = "/cloth_sim", session: str = "0f") -> None:
        self.simulation, self.node, self.session = Simulation(scene), node, session
        self.sequence = 0

    @property
    def stamp(self) -> int:
        """ROS time of the next frame [ns]."""
        return START + round((self.sequence + 1) * self.simulation.scene.period * 1e9)

    def topology(self) -> BagMessage:
        """Return the latched topology."""
        sheet = self.simulation.scene.sheet
        data = messages.mesh_bytes(sheet.triangles(), sheet.positions())
        return BagMessage(f"{self.node}/topology", messages.MESH, data)

    def snapshot(self) -> BagMessage:
        """Return the snapshot before the next frame."""
        simulation = self.simulation
        content = SessionSnapshot(
            scene_yaml=parameter_file.dump(simulation.scene.parameters()),
            state=simulation.state.to_bytes(),
            files=simulation.scene.files,
            metadata={**environment(), "node": self.node, "period": repr(simulation.scene.period)},
        )
        data = snapshot_bytes(content, session=self.session, sequence=self.sequence, stamp=self.stamp)
        return BagMessage(f"{self.node}/snapshot", SNAPSHOT_TYPE, data)

    def frame(self, events: Sequence[Event] = ()) -> list[BagMessage]:
        """Advance one frame; return its record, cloud and wrenches."""
        simulation, stamp = self.simulation, self.stamp
        frame = simulation.advance(events)
        record = FrameRecord(
            frame=frame.index,
            time=frame.time,
            events=tuple(to_dict(event) for event in frame.events),
            integrator=frame.integrator,
            tolerance=frame.tolerance,
            steps=frame.advance.steps if frame.advance else 0,
            digest=simulation.state.digest(),
            paused=simulation.paused,
            extras={"session": self.session, "sequence": self.sequence, "stamp": stamp, **frame.extras()},
        )
        self.sequence += 1
        scene = simulation.scene
        rows, columns = scene.shape
        cloud = messages.CloudEncoder(frame_id=scene.frame_id, height=rows, width=columns)
        result = [
            BagMessage(f"{self.node}/frame", messages.STRING, encode_string(record.to_json())),
            BagMessage(f"{self.node}/points", messages.CLOUD, cloud.encode(simulation.state.x, stamp)),
        ]
        for name, wrench in zip(scene.gripper_names, frame.wrenches, strict=True):
            data = messages.wrench_bytes(wrench, frame_id=scene.frame_id, stamp=stamp)
            result.append(BagMessage(f"{self.node}/{name}/wrench", messages.WRENCH, data))
        return result


def write_bag(path: Path, stream: Iterable[BagMessage]) -> Path:
    """Write messages into an MCAP file as rosbag2 does; return the file."""
    from mcap.writer import Writer

    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=20_000)
        writer.start(profile="ros2", library="libmcap 1.3.0")
        for index, (topic, kind, data) in enumerate(stream):
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", describe(kind).definition.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], START + index, data, START + index, 0)
        writer.finish()
    return path
