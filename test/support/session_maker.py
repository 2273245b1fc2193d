# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded sessions without ROS and clock: a simulation with its frames, in the format of the node."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.scene.cameras import camera_pose
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import encode, encode_string, message_class
from cloth_sim_ros.session.channel_description import Qos
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.writer import SessionSnapshot, SessionWriter, WriterOptions
from cloth_sim_ros.simulation.bodies.bodies import solids_and_poses
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.simulation.events import Event, Grasp, Move, Target, to_dict
from cloth_sim_ros.simulation.simulation import Frame, Simulation

NODE = "/cloth_sim"
#: ROS time at the start of every session [ns], arbitrary.
START = 1_800_000_000_000_000_000

_CLOUD = "sensor_msgs/msg/PointCloud2"
_MESH = "shape_msgs/msg/Mesh"
_STRING = "std_msgs/msg/String"
_DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
_STATUS = "diagnostic_msgs/msg/DiagnosticStatus"
_WRENCH = "geometry_msgs/msg/WrenchStamped"
_POINT = "geometry_msgs/msg/PointStamped"
_BOOL = "std_msgs/msg/Bool"
_POSE = "geometry_msgs/msg/PoseStamped"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_MARKERS = "visualization_msgs/msg/MarkerArray"


Change = Callable[[str, bytes], bytes | None]


def _time(nanoseconds: int) -> Any:
    return message_class("builtin_interfaces/msg/Time")(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)


def _header(log_time: int, frame_id: str = "world") -> Any:
    return message_class("std_msgs/msg/Header")(stamp=_time(log_time), frame_id=frame_id)


def cloud_bytes(
    xyz: np.ndarray,
    log_time: int,
    resolution: Sequence[int],
    velocity: np.ndarray | None = None,
    *,
    double: bool = False,
) -> bytes:
    """Encode a cloud: positions (n, 3) [m], rows x columns; optional velocities [m/s]; float64 if `double`."""
    length, datatype = (8, 8) if double else (4, 7)
    names = ("x", "y", "z") if velocity is None else ("x", "y", "z", "vx", "vy", "vz")
    values = xyz if velocity is None else np.concatenate([xyz, velocity], axis=1)
    rows, columns = resolution
    field = message_class("sensor_msgs/msg/PointField")
    return encode(
        message_class(_CLOUD)(
            header=_header(log_time),
            height=rows,
            width=columns,
            fields=[field(name=name, offset=length * k, datatype=datatype, count=1) for k, name in enumerate(names)],
            is_bigendian=False,
            point_step=length * len(names),
            row_step=length * len(names) * columns,
            data=np.frombuffer(np.ascontiguousarray(values, dtype=f"<f{length}").tobytes(), np.uint8),
            is_dense=True,
        ),
        _CLOUD,
    )


def mesh_bytes(scene: Scene) -> bytes:
    """Encode the topology: triangles and rest shape, flat in its x-y plane."""
    triangle, point = message_class("shape_msgs/msg/MeshTriangle"), message_class("geometry_msgs/msg/Point")
    return encode(
        message_class(_MESH)(
            triangles=[triangle(vertex_indices=np.asarray(t, np.uint32)) for t in scene.sheet.triangles()],
            vertices=[point(x=float(x), y=float(y), z=float(z)) for x, y, z in scene.sheet.positions()],
        ),
        _MESH,
    )


def diagnostics_bytes(log_time: int, values: Mapping[str, str]) -> bytes:
    """Encode the node's diagnostics."""
    pair = message_class("diagnostic_msgs/msg/KeyValue")
    status = message_class("diagnostic_msgs/msg/DiagnosticStatus")(
        level=0,
        name="cloth_sim: simulation",
        message="running",
        hardware_id="",
        values=[pair(key=key, value=value) for key, value in values.items()],
    )
    return encode(message_class(_DIAGNOSTICS)(header=_header(log_time), status=[status]), _DIAGNOSTICS)


def status_bytes(name: str, values: Mapping[str, str]) -> bytes:
    """Encode the state of a gripper."""
    pair = message_class("diagnostic_msgs/msg/KeyValue")
    pairs = [pair(key=key, value=value) for key, value in values.items()]
    return encode(message_class(_STATUS)(level=0, name=name, message="", hardware_id="none", values=pairs), _STATUS)


def target_bytes(event: Target | Move, log_time: int) -> bytes:
    """Encode a commanded pose."""
    assert event.orientation is not None
    x, y, z = event.position
    qx, qy, qz, qw = event.orientation
    pose = message_class("geometry_msgs/msg/Pose")(
        position=message_class("geometry_msgs/msg/Point")(x=x, y=y, z=z),
        orientation=message_class("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
    )
    return encode(message_class(_POSE)(header=_header(log_time), pose=pose), _POSE)


def point_bytes(event: Target, log_time: int) -> bytes:
    """Encode a commanded position."""
    point = message_class("geometry_msgs/msg/Point")(**dict(zip("xyz", event.position, strict=True)))
    return encode(message_class(_POINT)(header=_header(log_time), point=point), _POINT)


def wrench_bytes(wrench: Sequence[float], log_time: int) -> bytes:
    """Encode a force [N] and torque [N m], 6 numbers."""
    vector = message_class("geometry_msgs/msg/Vector3")
    values = [float(value) for value in wrench]
    force, torque = (vector(**dict(zip("xyz", part, strict=True))) for part in (values[:3], values[3:]))
    both = message_class("geometry_msgs/msg/Wrench")(force=force, torque=torque)
    return encode(message_class(_WRENCH)(header=_header(log_time), wrench=both), _WRENCH)


class SessionMaker:
    """Writes a session of one or several files, one frame per call.

    Args:
        folder: folder of the files.
        scene: the scene.
        stem: prefix of the file names.
        options: format of the files.
        metadata: entries of the files' metadata that replace those of the current environment.
        topology: False to omit the topology.
        watch: receives each frame.
    """

    def __init__(
        self,
        folder: Path,
        scene: Scene,
        *,
        stem: str = "session",
        options: WriterOptions | None = None,
        metadata: Mapping[str, str] | None = None,
        topology: bool = True,
        watch: Callable[[Simulation, Frame], object] = lambda _simulation, _frame: None,
    ) -> None:
        self._with_topology, self._watch = topology, watch
        self._metadata = dict(metadata or {})
        self.simulation = Simulation(scene)
        self.paths: list[Path] = []
        self._folder, self._stem = folder, stem
        self._options = options or WriterOptions(sync_seconds=0.0, chunk_bytes=1 << 20)
        self._clock = 0
        self._sequences: dict[str, int] = {}
        self._marked: list[str] = []
        self._open()

    @property
    def log_time(self) -> int:
        """ROS time of the next frame [ns]."""
        return START + round(self._clock * self.simulation.scene.period * 1e9)

    def add(
        self,
        events: Sequence[Event] = (),
        *,
        extras: Mapping[str, Any] | None = None,
        diagnostics: Mapping[str, str] | None = None,
        change: Change = lambda _topic, data: data,
        states: bool = False,
    ) -> None:
        """Advance one frame and write it. `change` may alter a message's bytes, or return None to omit it.

        `states`: True to write the state of each gripper that was commanded to close or open.
        """
        self._clock += 1
        now = self.log_time
        for event in events:
            if isinstance(event, Target):
                leaf, kind, data = (
                    ("target", _POSE, target_bytes(event, now))
                    if event.orientation
                    else ("point", _POINT, point_bytes(event, now))
                )
                self._write(f"{NODE}/{event.gripper}/{leaf}", kind, change, data)
            elif isinstance(event, Move) and event.orientation:
                self._write(f"{NODE}/{event.obstacle}/target", _POSE, change, target_bytes(event, now))
            elif isinstance(event, Grasp):
                data = encode(message_class(_BOOL)(data=event.closed), _BOOL)
                self._write(f"{NODE}/{event.gripper}/grasp", _BOOL, change, data)
        frame = self.simulation.advance(events)
        self._watch(self.simulation, frame)
        record = FrameRecord(
            frame=frame.index,
            time=frame.time,
            events=tuple(to_dict(event) for event in frame.events),
            integrator=frame.integrator,
            tolerance=frame.tolerance,
            steps=frame.advance.steps if frame.advance else 0,
            digest=self.simulation.state.digest(),
            paused=self.simulation.paused,
            extras=frame.extras() | dict(extras or {}),
        )
        self._write(f"{NODE}/frame", _STRING, change, encode_string(record.to_json()))
        scene = self.simulation.scene
        velocity = self.simulation.velocities if scene.points.velocity else None
        cloud = cloud_bytes(self.simulation.positions, now, scene.shape, velocity, double=scene.points.double)
        self._write(f"{NODE}/points", _CLOUD, change, cloud)
        # Markers need ROS's messages; they are omitted without ROS.
        # As by the node, markers of the last bodies are deleted, too.
        has_bodies = self.simulation.obstacles or self.simulation.pinching or self._marked
        if has_bodies and importlib.util.find_spec("rclpy"):
            self._write(f"{NODE}/obstacles", _MARKERS, change, self._markers(now))
        for name, wrench in zip(self.simulation.scene.gripper_names, frame.wrenches, strict=True):
            self._write(f"{NODE}/{name}/wrench", _WRENCH, change, wrench_bytes(wrench, now))
        for name, load in zip(self.simulation.scene.obstacle_names, frame.obstacle_wrenches, strict=True):
            self._write(f"{NODE}/{name}/wrench", _WRENCH, change, wrench_bytes(load, now))
        for grasp in frame.grasps if states else ():
            index = scene.gripper_names.index(grasp.gripper)
            closed, grasped = self.simulation.grippers.is_closed(index), self.simulation.grasped_count(index)
            entries = {"closed": str(closed).lower(), "grasped_count": str(grasped)}
            said = status_bytes(grasp.gripper, old_keys.add_old_keys(entries, old_keys.GRIPPER_STATE))
            self._write(f"{NODE}/{grasp.gripper}/state", _STATUS, change, said)
        if scene.tf.publish:
            self._write("/tf", _TRANSFORMS, change, self._transforms(now))
        if diagnostics is not None:
            self._write("/diagnostics", _DIAGNOSTICS, change, diagnostics_bytes(now, diagnostics))

    def _transforms(self, now: int) -> bytes:
        """Encode the TF frames of the cloth, of the placed grippers and of the cameras."""
        simulation = self.simulation
        centre = (simulation.state.x * simulation.model.masses).sum(axis=1) / simulation.model.mass
        poses = {"cloth": [*centre.tolist(), 0.0, 0.0, 0.0, 1.0]}
        grippers = simulation.grippers
        poses |= {name: grippers.poses()[k].tolist() for k, name in enumerate(grippers.names) if grippers.is_placed(k)}
        poses |= {f"{name}_optical_frame": [*camera_pose(view)] for name, view in simulation.scene.views.items()}
        transform, quaternion = (
            message_class("geometry_msgs/msg/Transform"),
            message_class("geometry_msgs/msg/Quaternion"),
        )
        return encode(
            message_class(_TRANSFORMS)(
                transforms=[
                    message_class("geometry_msgs/msg/TransformStamped")(
                        header=_header(now),
                        child_frame_id=f"{NODE.strip('/')}/{name}",
                        transform=transform(
                            translation=message_class("geometry_msgs/msg/Vector3")(*pose[:3]),
                            rotation=quaternion(*pose[3:]),
                        ),
                    )
                    for name, pose in poses.items()
                ]
            ),
            _TRANSFORMS,
        )

    def _markers(self, now: int) -> bytes:
        """Encode the node's markers of obstacles and pads; needs ROS's messages."""
        from cloth_sim_ros.ros.io.obstacle_markers import ObstacleMarkers

        solids, poses = solids_and_poses(self.simulation.obstacles, self.simulation.pinching)
        names = [solid.name for solid in solids]
        gone, self._marked = [name for name in self._marked if name not in names], names
        return ObstacleMarkers(solids, frame_id="world", node=NODE, removed=gone).serialize(poses, now)

    def split(self) -> None:
        """Continue in a new file that opens with a snapshot of the current state."""
        self._writer.finish(reason="split")
        self._open()

    def finish(self) -> Path:
        """Close the last file; return the path of the first."""
        self._writer.finish(reason="stopped")
        return self.paths[0]

    def cut(self) -> Path:
        """Leave the last file unfinished, like a killed process; return the path of the first."""
        self._writer.abandon()
        return self.paths[0]

    def _open(self) -> None:
        simulation = self.simulation
        self._writer = SessionWriter(
            self._folder,
            snapshot=SessionSnapshot(
                scene_yaml=parameter_file.dump(simulation.scene.parameters()),
                state=simulation.state.to_bytes(),
                files=simulation.scene.files,
                metadata={**environment(), "node": NODE, "period": repr(simulation.scene.period), **self._metadata},
            ),
            stem=self._stem,
            part=len(self.paths),
            log_time=self.log_time,
            options=self._options,
        )
        self.paths.append(self._writer.path)
        if not self._with_topology:
            return
        latched = Qos(durability="transient_local", depth=1)
        self._writer.declare(f"{NODE}/topology", _MESH, latched)
        self._add(f"{NODE}/topology", mesh_bytes(simulation.scene))

    def _write(self, topic: str, kind: str, change: Change, data: bytes) -> None:
        if not self._writer.is_declared(topic):
            self._writer.declare(topic, kind)
        changed = change(topic, data)
        if changed is not None:
            self._add(topic, changed)

    def _add(self, topic: str, data: bytes) -> None:
        sequence = self._sequences.get(topic, 0)
        self._sequences[topic] = sequence + 1
        self._writer.add(topic, data, log_time=self.log_time, publish_time=self.log_time, sequence=sequence)


def carried_corner(scene: Scene, seconds: float) -> Iterable[list[Event]]:
    """Yield the events of a grasp by frame: the gripper grasps the bottom right corner, lifts it, releases it."""
    corner = scene.initial_positions()[-1]
    frames = round(seconds * scene.rate)
    away = np.array([-0.35, -0.45, 0.45]) * min(scene.cloth.size)
    for k in range(frames):
        t = k / frames
        progress = np.clip((t - 0.25) / 0.4, 0.0, 1.0)
        smooth = progress * progress * (3.0 - 2.0 * progress)
        angle = 1.2 * smooth
        approach = np.array([0.0, -0.25, 0.0]) * np.clip(1.0 - t / 0.15, 0.0, 1.0)
        events: list[Event] = [
            Target(
                "gripper", tuple(corner + approach + smooth * away), (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2))
            )
        ]
        if k == round(0.2 * frames):
            events.append(Grasp("gripper", True))
        if k == round(0.85 * frames):
            events.append(Grasp("gripper", False))
        yield events


def make_grasp(folder: Path, *, seconds: float = 4.0, stem: str = "grasp", **values: Any) -> Path:
    """Write a session: a cloth hung by one edge, its corner carried by the gripper; `values` by parameter name."""
    scene = Scene.from_parameters({name.replace("__", "."): value for name, value in values.items()})
    maker = SessionMaker(folder, scene, stem=stem)
    for k, events in enumerate(carried_corner(scene, seconds)):
        diagnostics = None
        if k % 60 == 59:
            diagnostics = {"real_time_factor": "1.0000", "late_frames": "0", "recording": "recording"}
        maker.add(events, diagnostics=diagnostics)
    return maker.finish()
