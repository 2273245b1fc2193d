# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""View of a running node: from its messages to recordings in Rerun."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from cloth_sim_ros.replay.opening import GripperStart, Opening
from cloth_sim_ros.replay.plots import DIAGNOSTICS_TOPIC, PLOTS
from cloth_sim_ros.replay.pre_scan import FOLLOWED_LIMIT, PreScan, check_fit
from cloth_sim_ros.replay.stream import ReplayStream
from cloth_sim_ros.replay.surface_geometry import make_surface_geometry
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import Cloud, MeshMessage, decode, decode_cloud, decode_mesh
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message

if TYPE_CHECKING:
    import rerun as rr

#: Names in the pipe that are no topics: parameters of the node at its start, and those that have changed.
PARAMETERS, CHANGED = "parameters", "changed"
_SECOND = 1_000_000_000
#: Margin around the cloth in which obstacles are in view at the start, as a fraction of its diagonal.
_MARGIN = 0.6
_COMMANDS = {"target": "geometry_msgs/msg/PoseStamped", "point": "geometry_msgs/msg/PointStamped"}


class LiveView:
    """View of a running node's messages in Rerun as they come; each start of the node begins a new recording.

    Args:
        node: resolved name of the node.
        start_recording: begins a recording for a scan.
        on_message: receives a sentence about messages that are not shown.
        every: show every n-th cloud.
        strain_limit: strain of the last colour.
    """

    def __init__(
        self,
        node: str,
        start_recording: Callable[[PreScan], rr.RecordingStream],
        *,
        on_message: Callable[[str], object],
        every: int = 1,
        strain_limit: float = FOLLOWED_LIMIT,
    ) -> None:
        self._node, self._start_recording, self._on_message = node, start_recording, on_message
        self._every, self._strain_limit = every, strain_limit
        self._reported: set[str] = set()
        self._reset()

    def _reset(self) -> None:
        self._surface: MeshMessage | None = None
        self._parameters: dict[str, Any] | None = None
        self._recording: rr.RecordingStream | None = None
        self._stream: ReplayStream | None = None
        #: Newest messages that have no partner yet: the simulated time of a frame [s], and its cloud.
        self._time: float | None = None
        self._cloud: bytes | None = None
        self._has_clock = False
        self._first_stamp: int | None = None
        self._obstacles: bytes | None = None
        #: Newest target of each gripper, other events, and gripper states since the last frame.
        self._targets: dict[str, dict[str, Any]] = {}
        self._events: list[dict[str, Any]] = []
        self._states: list[tuple[str, bytes]] = []
        self._closed: dict[str, bool] = {}

    @property
    def is_showing(self) -> bool:
        """True once the cloth of the present node is shown."""
        return self._stream is not None

    def add(self, topic: str, data: bytes) -> None:
        """Show a message of the pipe (CDR bytes, or JSON of parameters); one that does not fit is left out."""
        try:
            self._add(topic, data)
        except SessionError as error:
            self._report(topic, f"a message on {topic} is not shown: {error}")

    def finish(self) -> None:
        """Send pending rows to Rerun, end the recording, and forget the node; another topology begins a new one."""
        if self._stream is not None:
            self._stream.finish()
        if self._recording is not None:
            self._recording.disconnect()
        self._reset()

    def _report(self, subject: str, sentence: str) -> None:
        """Pass a sentence to `on_message`, once for each subject."""
        if subject not in self._reported:
            self._reported.add(subject)
            self._on_message(sentence)

    def _add(self, topic: str, data: bytes) -> None:
        leaf = topic.removeprefix(f"{self._node}/")
        name, _, kind = leaf.rpartition("/")
        if leaf == "topology":
            self.finish()
            self._surface = decode_mesh(data)
        elif topic == PARAMETERS:
            self._parameters = json.loads(data)
        elif topic == CHANGED:
            self._events.append({"kind": "set_parameters", "values": json.loads(data)})
        elif leaf == "clock":
            stamp = decode(data, "rosgraph_msgs/msg/Clock").clock
            self._time, self._has_clock = stamp.sec + 1e-9 * stamp.nanosec, True
            self._show_frame()
        elif leaf == "points":
            if self._cloud is not None and not self._has_clock:
                # A bag holds no ~/clock: the stamps replace it.
                stamp_ns = decode_cloud(self._cloud).stamp
                self._first_stamp = stamp_ns if self._first_stamp is None else self._first_stamp
                self._time = 1e-9 * (stamp_ns - self._first_stamp)
                self._show_frame()
            self._cloud = data
            self._show_frame()
        elif kind in _COMMANDS and name:
            self._add_target(name, kind, data)
        elif kind == "state" and name:
            self._add_state(name, topic, data)
        elif leaf == "obstacles" and self._stream is None:
            self._obstacles = data
        elif self._stream is not None and self._is_of_node(topic, data):
            self._stream.add(self._message(topic, data))

    def _message(self, topic: str, data: bytes) -> Message:
        stamp = 0 if self._stream is None else self._stream.ros_time
        return Message(topic, "", data, stamp, stamp, 0)

    def _is_of_node(self, topic: str, data: bytes) -> bool:
        """Return true unless the message is another node's, on a topic that nodes share."""
        name = self._node.strip("/")
        if topic == DIAGNOSTICS_TOPIC:
            message = decode(data, "diagnostic_msgs/msg/DiagnosticArray")
            return any(status.name == f"{name}: cloth" for status in message.status)
        if topic == "/rosout":
            return bool(decode(data, "rcl_interfaces/msg/Log").name == name.replace("/", "."))
        return True

    def _add_target(self, gripper: str, kind: str, data: bytes) -> None:
        message = decode(data, _COMMANDS[kind])
        frame = message.header.frame_id
        known = "" if self._parameters is None else str(self._parameters.get("frame_id", ""))
        if frame and frame != known:
            self._report(gripper, f"targets of '{gripper}' are in frame '{frame}', not in '{known}': it is not shown")
            return
        at = message.point if kind == "point" else message.pose.position
        q = None if kind == "point" else message.pose.orientation
        position, orientation = [at.x, at.y, at.z], None if q is None else [q.x, q.y, q.z, q.w]
        # The node refuses such targets.
        if np.isfinite([*position, *(orientation or ())]).all() and (orientation is None or any(orientation)):
            event = {"kind": "target", "gripper": gripper, "position": position, "orientation": orientation}
            self._targets[gripper] = event

    def _add_state(self, gripper: str, topic: str, data: bytes) -> None:
        pairs = ((pair.key, pair.value) for pair in decode(data, "diagnostic_msgs/msg/DiagnosticStatus").values)
        closed = dict(old_keys.current_entries(pairs, old_keys.GRIPPER_STATE)).get("closed") == "true"
        if closed != self._closed.get(gripper, False):
            self._events.append({"kind": "grasp", "gripper": gripper, "closed": closed})
        self._closed[gripper] = closed
        self._states.append((topic, data))

    def _show_frame(self) -> None:
        """Show a cloud of the node with its simulated time, once both have come."""
        if self._time is None or self._cloud is None or self._surface is None or self._parameters is None:
            return
        data, time = self._cloud, self._time
        self._cloud = self._time = None
        try:
            cloud = decode_cloud(data)
            check_fit(cloud, len(self._surface.vertices))
            if self._stream is None:
                self._start(cloud, self._surface, self._parameters)
        except SessionError as error:
            self._report("cloud", f"a cloud is not shown: {error}")
            return
        assert self._stream is not None
        events, self._targets, self._events = [*self._targets.values(), *self._events], {}, []
        frame = round(time * float(self._parameters.get("rate", 0.0)))
        record = FrameRecord(
            frame=max(frame, 0), time=time, events=tuple(events), integrator="", tolerance=None, steps=0, digest="",
            paused=False,
        )  # fmt: skip
        self._stream.add_record(record, cloud.stamp)
        if self._obstacles is not None:
            self._stream.add(self._message(f"{self._node}/obstacles", self._obstacles))
            self._obstacles = None
        self._stream.add(Message(f"{self._node}/points", "", data, cloud.stamp, cloud.stamp, 0))
        for topic, state in self._states:
            self._stream.add(self._message(topic, state))
        self._states = []
        self._stream.flush()

    def _start(self, cloud: Cloud, surface: MeshMessage, parameters: Mapping[str, Any]) -> None:
        scan = live_scan(cloud, surface, parameters, obstacles=self._obstacles, strain_limit=self._strain_limit)
        self._recording = self._start_recording(scan)
        self._stream = ReplayStream(self._recording, scan, node=self._node, every=self._every)


def live_scan(
    cloud: Cloud,
    surface: MeshMessage,
    parameters: Mapping[str, Any],
    *,
    obstacles: bytes | None = None,
    strain_limit: float = FOLLOWED_LIMIT,
) -> PreScan:
    """Return bounds, geometry and plots of a running node for the viewer, from its first cloud. Raises SessionError.

    Args:
        cloud: first cloud.
        surface: triangles and rest positions.
        parameters: the node's parameters by full name; those that are missing have their defaults.
        obstacles: newest MarkerArray of the obstacles; those near the cloth are in view.
        strain_limit: strain of the last colour.

    Raises:
        SessionError: if the surface names particles that it does not have.
    """
    rest_positions = np.asarray(surface.vertices, dtype=np.float64)
    if len(surface.triangles) and int(surface.triangles.max()) >= len(rest_positions):
        raise SessionError(
            f"a triangle of the topology names particle {surface.triangles.max()}, and there are {len(rest_positions)}"
        )
    positions = np.asarray(cloud.xyz, dtype=np.float64)
    names = [str(name) for name in parameters.get("grippers", ()) if name]
    mode = parameters.get("gripper.mode", "attach")
    nowhere, none = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), np.zeros(0, dtype=np.int64)
    opening = Opening(
        frame_id=cloud.frame_id,
        anchors=tuple(parameters.get("cloth.anchors", ())),
        gripper_radius=float(parameters.get("gripper.radius", 0.05)),
        grippers=tuple(
            GripperStart(
                name=name,
                pose=None,
                target=nowhere,
                closed=False,
                grasped=none,
                pinches=(parameters.get(f"{name}.mode") or mode) == "pinch",
            )
            for name in names
        ),
        obstacles=tuple(str(name) for name in parameters.get("obstacles", ()) if name),
        positions=positions,
    )
    geometry = make_surface_geometry(surface.triangles, rest_positions, positions, cloud.height, cloud.width)
    normals, strain = np.empty((len(rest_positions), 3), np.float32), np.empty(len(rest_positions), np.float32)
    geometry.compute(np.ascontiguousarray(positions, dtype=np.float32), normals, strain)
    low, high = positions.min(axis=0), positions.max(axis=0)
    margin = _MARGIN * float(np.linalg.norm(high - low))
    for point in _marker_positions(obstacles):
        low, high = np.minimum(low, np.maximum(point, low - margin)), np.maximum(high, np.minimum(point, high + margin))
    shown = {"plots/strain", "plots/pace", "plots/late"}
    shown |= {"plots/force"} if names or opening.obstacles else set()
    shown |= {"plots/energy"} if parameters.get("diagnostics.energy") else set()
    return PreScan(
        opening=opening,
        rows=cloud.height,
        columns=cloud.width,
        triangles=surface.triangles,
        geometry=geometry,
        normal=np.asarray(normals.mean(axis=0), dtype=np.float64),
        low=low,
        high=high,
        gripper_targets=np.zeros((0, 3)),
        strain_limit=strain_limit,
        plots=tuple(path for path in PLOTS if path in shown),
    )


def _marker_positions(data: bytes | None) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
    """Return the positions of the markers in a MarkerArray [m]."""
    markers = [] if data is None else decode(data, "visualization_msgs/msg/MarkerArray").markers
    at = [marker.pose.position for marker in markers if marker.action == 0]
    return [np.array([p.x, p.y, p.z]) for p in at]
