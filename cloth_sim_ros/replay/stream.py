# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stream of a session's messages into the viewer, in batches."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.replay import colours, deviations
from cloth_sim_ros.replay.accuracy import MeasuredAccuracy, draw_curves
from cloth_sim_ros.replay.gripper_view import GripperView
from cloth_sim_ros.replay.grippers import GripperTracks
from cloth_sim_ros.replay.obstacle_view import ObstacleView
from cloth_sim_ros.replay.plots import DIAGNOSTICS_TOPIC, diagnostic_numbers, extra_numbers
from cloth_sim_ros.replay.pre_scan import PreScan, check_fit
from cloth_sim_ros.replay.rows import MAX_TIME, Moment, Rows
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import decode, decode_cloud
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.frame_record import FrameRecord
from cloth_sim_ros.session.part import Message
from cloth_sim_ros.session.reader import read_frame

if TYPE_CHECKING:
    import rerun as rr

#: Batch size of an entity [bytes]: large enough to hide the cost of a call, small enough for the processor's cache.
_BATCH_BYTES = 2 << 20
#: Maximum number of rows in a batch of an entity.
_MAX_ROWS = 4096
#: Maximum size of the batches sent without a flush to the disk or the viewer [bytes].
_MAX_UNFLUSHED = 64 << 20
_WRENCH, _STATUS = "geometry_msgs/msg/WrenchStamped", "diagnostic_msgs/msg/DiagnosticStatus"

CLOTH, ANCHORS, PLOTS, LOG = "/world/cloth", "/world/anchors", "/plots", "/log"


class _ShownCloud(NamedTuple):
    """Cloud with its normals, strains or errors, and grasped particles, ready to be drawn."""

    moment: Moment
    xyz: NDArray[np.float32]
    normals: NDArray[np.float32]
    #: Quantity that determines the colour: strain, or error [m].
    shade: NDArray[np.float32]
    grasped: dict[str, NDArray[np.float32]]


class ReplayStream:
    """Stream of one session's messages into Rerun, in batches.

    Args:
        recording: Rerun stream.
        scan: pre-scan of the session.
        node: resolved name of its node.
        every: show every n-th cloud; plots and grippers keep every frame.
        last_time: show only the last cloud at or before this simulated time [s].
        accuracy: colour by this error instead of strain, and plot it.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        scan: PreScan,
        *,
        node: str,
        every: int = 1,
        last_time: float | None = None,
        accuracy: MeasuredAccuracy | None = None,
    ) -> None:
        import rerun as rr

        self._accuracy = accuracy
        self._recording = recording
        self._scan = scan
        self._points, self._frame, self._obstacles = f"{node}/points", f"{node}/frame", f"{node}/obstacles"
        wrench_sources = [*(start.name for start in scan.opening.grippers), *scan.opening.obstacles]
        self._wrenches = {f"{node}/{name}/wrench": name for name in wrench_sources}
        self._states = {f"{node}/{start.name}/state": start.name for start in scan.opening.grippers}
        self._ensemble = deviations.ensemble_topic(node) if scan.opening.has_ensemble else ""
        self._recent = deviations.RecentMoments()
        #: Number of messages of the ensemble.
        self._n_deviations = 0
        self._every, self._last_time = every, last_time
        self._anchored = scan.opening.anchored_particles(scan.rows, scan.columns)
        self._grippers = GripperTracks(scan.opening, self._anchored)
        #: True if any particle was anchored so far.
        self._has_anchors = len(self._anchored) > 0
        self._last_cloud: Message | None = None
        #: Frame indices of the newest record and of the newest cloud; None before the first.
        self._recorded_frame: int | None = None
        self._cloud_frame: int | None = None
        #: Events of the newest frame: time, event, number of grasped particles by a cloud. Logged after the node has
        #: sent the states of its grippers.
        self._events: list[tuple[Moment, Any, int | None]] = []
        self._moment = Moment(0.0, 0, 0)
        self._tables: dict[str, Rows] = {}
        self._view = GripperView(self._grippers, self._table)
        self._solids = ObstacleView(recording, self._table)
        self._cloth_rows = self._table(CLOTH, rr.Mesh3D)
        self._anchor_rows = self._table(ANCHORS, rr.Points3D, ragged=("positions",))
        self._pending_cloud: _ShownCloud | None = None
        self._unflushed = 0
        #: Number of clouds in the messages, and of those shown.
        self.clouds_seen = self.clouds_shown = 0
        #: Simulated time of the first cloud that is shown, or of the only one [s].
        self.shown_time = 0.0
        self._start()

    @property
    def topics(self) -> frozenset[str]:
        """Topics whose messages are shown."""
        fixed = (self._points, self._frame, self._obstacles, DIAGNOSTICS_TOPIC, "/rosout")
        ensemble = [self._ensemble] if self._ensemble else []
        return frozenset({*fixed, *ensemble, *self._wrenches, *self._states})

    @property
    def time(self) -> float:
        """Simulated time of the newest message [s]."""
        return self._moment.sim_time

    @property
    def ros_time(self) -> int:
        """ROS time of the newest frame [ns]."""
        return self._moment.ros_time

    def add(self, message: Message) -> None:
        """Show a recorded message of one of `topics`; rows are sent in batches. Raises SessionError for other bytes.

        Raises:
            SessionError: if its bytes do not fit the topic's type.
        """
        topic = message.topic
        if topic == self._frame:
            self.add_record(read_frame(message), message.log_time)
        elif topic == self._points:
            self._add_cloud(message)
        elif topic == self._ensemble:
            self._add_deviations(message)
        elif topic == self._obstacles:
            self._solids.show(self._moment._replace(ros_time=message.log_time), message.data)
        elif topic in self._wrenches:
            self._add_wrench(message)
        elif topic in self._states:
            self._add_gripper_state(message)
        elif topic == DIAGNOSTICS_TOPIC:
            moment = self._moment._replace(ros_time=message.log_time)
            for path, value in diagnostic_numbers(message.data):
                self._scalar(path, moment, value)
        elif topic == "/rosout":
            entry = decode(message.data, "rcl_interfaces/msg/Log")
            # Entries below a warning repeat the events.
            if entry.level in _LEVELS:
                self._log_text(self._moment._replace(ros_time=message.log_time), entry.msg, _LEVELS[entry.level])

    def add_record(self, record: FrameRecord, ros_time: int) -> None:
        """Show the events and numbers of a frame's record at a ROS time [ns]. Raises SessionError if one is invalid.

        Raises:
            SessionError: if one of its events is invalid.
        """
        if not abs(record.time) <= MAX_TIME:
            raise SessionError(f"frame {record.frame} has the time {record.time:g} s, the limit is {MAX_TIME:g} s")
        self._send_large_tables()
        moment = self._moment = Moment(record.time, ros_time, record.frame)
        self._recent.add(moment)
        self._log_events()
        try:
            counts = self._grippers.advance(record, lambda: self._positions_before(record))
            self._recorded_frame = record.frame
            self._update_anchors(record)
        except (TypeError, ValueError, OverflowError, AttributeError) as error:
            # A file may hold parameters of any type.
            raise SessionError(f"the record of frame {record.frame} has an invalid event: {error}") from error
        if "plots/steps" in self._scan.plots:
            self._scalar("plots/steps/steps", moment, float(record.steps))
        for path, value in extra_numbers(record.extras):
            self._scalar(path, moment, value)
        if self._accuracy is not None:
            for path, value in self._accuracy.curves(record.frame):
                self._scalar(path, moment, value)
        self._events = [(moment, event, count) for event, count in zip(record.events, counts, strict=True)]
        self._view.show(moment)

    def add_all(self, messages: Iterable[Message]) -> None:
        """Show all messages, and finish. Raises SessionError for one whose bytes do not fit its topic."""
        for message in messages:
            self.add(message)
        self.finish()

    def flush(self) -> None:
        """Send the collected rows to Rerun, and wait until it has them."""
        for table in self._tables.values():
            table.send(self._recording)
        self._recording.flush()

    def finish(self) -> None:
        """Show the last pending cloud, and send the collected rows to Rerun."""
        self._log_events()
        if self._pending_cloud is not None:
            self._show(self._pending_cloud)
            self._pending_cloud = None
        self.flush()

    def _start(self) -> None:
        import rerun as rr

        recording = self._recording
        recording.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log(CLOTH, rr.Mesh3D.from_fields(triangle_indices=self._scan.triangles), static=True)
        size = float(np.linalg.norm(self._scan.high - self._scan.low))
        anchors = rr.Points3D.from_fields(colors=np.array([colours.ANCHOR], np.uint32), radii=[0.0035 * size])
        recording.log(ANCHORS, anchors, static=True)
        self._view.start(recording, size)
        if self._accuracy is not None:
            draw_curves(recording)

    def _add_gripper_state(self, message: Message) -> None:
        """Correct the number of particles of the newest grasp by the state that the node sends after the frame."""
        name = self._states[message.topic]
        pairs = ((pair.key, pair.value) for pair in decode(message.data, _STATUS).values)
        state_texts = dict(old_keys.current_entries(pairs, old_keys.GRIPPER_STATE))
        if state_texts.get("closed") != "true" or not state_texts.get("grasped_count", "").isdecimal():
            return  # A reset of the same frame has opened it again.
        for k, (moment, event, _) in reversed(list(enumerate(self._events))):
            if event.get("kind") == "grasp" and event["gripper"] == name:
                self._events[k] = moment, event, int(state_texts["grasped_count"])
                return

    def _log_events(self) -> None:
        for moment, event, count in self._events:
            track = self._grippers.tracks.get(str(event.get("gripper", "")))
            text = _describe_event(event, count, pinches=track is not None and track.pinches)
            if text:
                self._log_text(moment, text, "INFO")
        self._events = []

    def _update_anchors(self, record: FrameRecord) -> None:
        """Update the anchored particles that a frame's events have changed, after its grasps."""
        for event in record.events:
            anchors = event["values"].get("cloth.anchors") if event.get("kind") == "set_parameters" else None
            if anchors is not None:
                scan = self._scan
                self._anchored = scan.opening.anchored_particles(scan.rows, scan.columns, anchors)
                self._grippers.set_anchored(self._anchored)
                self._has_anchors = self._has_anchors or len(self._anchored) > 0

    def _add_cloud(self, message: Message) -> None:
        self._last_cloud, self._cloud_frame = message, self._recorded_frame
        self.clouds_seen += 1
        if (self.clouds_seen - 1) % self._every:
            return
        cloud = decode_cloud(message.data)
        check_fit(cloud, len(self._scan.opening.positions))
        xyz = np.ascontiguousarray(cloud.xyz, dtype=np.float32)
        normals, strain = np.empty_like(xyz), np.empty(len(xyz), np.float32)
        # Strains use double precision if available: far from the origin, single precision is too coarse.
        self._scan.geometry.compute(xyz if cloud.xyz.itemsize == 4 else cloud.xyz, normals, strain)
        # A cloud without a frame record is shown at the last known simulated time.
        moment = self._moment._replace(ros_time=message.log_time)
        self._scalar("plots/strain/largest_strain", moment, 100.0 * float(strain.max()))
        if self.clouds_seen == 1:
            self._show_deviations(moment, np.zeros(len(xyz), np.float32))
        shade = strain if self._accuracy is None else self._accuracy.errors(moment.frame)
        shown = _ShownCloud(moment, xyz, normals, shade, self._view.grasped_positions(xyz))
        if self._last_time is None:
            self._show(shown)
        elif self._pending_cloud is None or moment.sim_time <= self._last_time:
            self._pending_cloud = shown

    def _send_large_tables(self) -> None:
        """Send the tables that have reached the size of a batch."""
        for table in self._tables.values():
            if table.size >= _BATCH_BYTES or len(table) >= _MAX_ROWS:
                self._unflushed += table.size
                table.send(self._recording)
        if self._unflushed >= _MAX_UNFLUSHED:
            # Wait here, otherwise a slow disk or viewer would let the memory grow.
            self._unflushed = 0
            self._recording.flush()

    def _add_deviations(self, message: Message) -> None:
        """Colour the cloth by the deviations of an earlier frame, at the time of that frame."""
        moment = self._recent.find(message.publish_time)
        values = deviations.read_deviations(message.data, len(self._scan.opening.positions))
        if moment is None:
            return
        self._scalar("plots/deviation/largest_deviation", moment, float(values.max()))
        self._n_deviations += 1
        is_shown = (self._n_deviations - 1) % self._every == 0
        if is_shown and (self._last_time is None or moment.sim_time <= self._last_time):
            self._show_deviations(moment, np.asarray(values, dtype=np.float32))

    def _show_deviations(self, moment: Moment, values: NDArray[np.float32]) -> None:
        import rerun as rr

        limit = self._scan.deviation_limit
        if limit is not None and self._accuracy is None:
            colour = np.empty(len(values), np.uint32)
            colours.strain_colours(values, limit, colour)
            # Rows of their own, because few frames of a slow ensemble have deviations.
            self._table(CLOTH, rr.Mesh3D, part="colours").add(moment, vertex_colors=colour)

    def _show(self, shown: _ShownCloud) -> None:

        moment, xyz, normals, shade, grasped = shown
        if not self.clouds_shown:
            self.shown_time = moment.sim_time
        if self._accuracy is None and self._scan.deviation_limit is not None:
            self._cloth_rows.add(moment, vertex_positions=xyz, vertex_normals=normals)
        else:
            colour = np.empty(len(xyz), np.uint32)
            limit = self._scan.strain_limit if self._accuracy is None else self._accuracy.limit
            colours.strain_colours(shade, limit, colour)
            self._cloth_rows.add(moment, vertex_positions=xyz, vertex_normals=normals, vertex_colors=colour)
        if self._has_anchors:
            self._anchor_rows.add(moment, positions=xyz[self._anchored])
        self._view.show_grasped(moment, grasped)
        self.clouds_shown += 1

    def _add_wrench(self, message: Message) -> None:
        name = self._wrenches[message.topic]
        force = decode(message.data, _WRENCH).wrench.force
        size = float(np.linalg.norm([force.x, force.y, force.z]))
        self._scalar(f"plots/force/{name}", self._moment._replace(ros_time=message.log_time), size)

    def _positions_before(self, record: FrameRecord) -> NDArray[np.floating] | None:
        """Return the positions before a frame (n, 3) [m], from the state or the last cloud; None if unknown."""
        if self._recorded_frame is None:
            return self._scan.opening.positions
        has_gap = self._cloud_frame != self._recorded_frame or record.frame > self._recorded_frame + 1
        if self._last_cloud is None or has_gap:
            return None
        return decode_cloud(self._last_cloud.data).xyz

    def _scalar(self, path: str, moment: Moment, value: float) -> None:
        import rerun as rr

        self._table(f"/{path}", rr.Scalars).add(moment, scalars=value)

    def _log_text(self, moment: Moment, text: str, level: str) -> None:
        import rerun as rr

        self._table(LOG, rr.TextLog).add(moment, text=text, level=level)

    def _table(self, path: str, archetype: Any, *, ragged: tuple[str, ...] = (), part: str = "") -> Rows:
        # An entity may have several archetypes, and parts of one, each with separate rows.
        key = f"{path} {archetype.__name__} {part}"
        rows = self._tables.get(key)
        if rows is None:
            rows = self._tables[key] = Rows(path, archetype, ragged=ragged)
        return rows


#: Levels of rcl_interfaces/Log that are shown.
_LEVELS = {30: "WARN", 40: "ERROR", 50: "CRITICAL"}


def _describe_event(event: Any, count: int | None, *, pinches: bool) -> str:
    """Return a recorded event as text; empty for targets, which are drawn.

    Args:
        event: the recorded event.
        count: number of particles that its gripper holds after it; None if unknown.
        pinches: True if its gripper closes pads.
    """
    kind = event.get("kind")
    if kind == "grasp":
        name = event["gripper"]
        if not event["closed"]:
            return f"{name} opens"
        if pinches:
            return f"{name} closes its pads"
        return f"{name} closes" if count is None else f"{name} closes, holds {count} particles"
    if kind == "set_parameters":
        return ", ".join(f"{name} = {value}" for name, value in event["values"].items())
    if kind == "relax":
        return f"tolerance times {event['factor']:g}"
    if kind == "pause":
        return "paused" if event["paused"] else "resumed"
    return {"step": "one step", "reset": "reset"}.get(str(kind), "")
