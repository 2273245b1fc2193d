# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording of frames, messages and snapshots of one node into a session."""

from __future__ import annotations

import datetime
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from cloth_sim_ros.ros.recording.errors import RecordingNotInstalledError, RecordingUnavailableError
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.simulation import events
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.ros.recording.bag_topics import BagTopics
    from cloth_sim_ros.scene.sections import RecordParameters as RecordSettings
    from cloth_sim_ros.session.recorder import Recorder, RecorderStatus
    from cloth_sim_ros.session.writer import SessionSnapshot

_NO_MEMORY = "no memory is left"
_FRAME_TYPE = "std_msgs/msg/String"
#: Libraries of each compression.
_COMPRESSION = {"none": (), "lz4": ("lz4.frame",), "zstd": ("zstandard",)}


class SessionRecording:
    """Recording of one node's frames and messages into session files; at most one runs at a time.

    Args:
        node_name: the node's full name, e.g. ``/cloth_sim``.
        simulation: the recorded simulation.
        settings: returns the settings when a recording starts; by default those in force in the simulation.
    """

    def __init__(
        self, *, node_name: str, simulation: Simulation, settings: Callable[[], RecordSettings] | None = None
    ) -> None:
        self._node_name, self._simulation = node_name, simulation
        #: Prefix of file names.
        self._stem = node_name.strip("/").replace("/", "_")
        self._settings = settings or (lambda: simulation.scene.record)
        self._recorder: Recorder | None = None
        self._closing: Recorder | None = None
        self._last: RecorderStatus | None = None
        self._listeners: list[Callable[[RecorderStatus], None]] = []
        #: Records of the running frame; None between frames.
        self._pending: list[Callable[[Recorder], object]] | None = None
        #: Entries of the next frame record besides its own, by name.
        self.extras: dict[str, Any] = {}
        #: Topics for bags; None without `record.topics`.
        self.bag_topics: BagTopics | None = None
        #: The missing library if a recording failed to start because of it; otherwise empty.
        self.missing = ""

    @property
    def running(self) -> bool:
        """True while messages are recorded."""
        return self._recorder is not None

    @property
    def busy(self) -> bool:
        """True while a recording runs or the previous one is still being closed."""
        return self._recorder is not None or self._closing is not None

    def prepare(self) -> None:
        """Load the libraries for recording, if they are installed, so that they do not delay a frame."""
        try:
            self._check_libraries()
        except RecordingNotInstalledError:
            return
        from cloth_sim_ros.session import cdr, channel_description, frame_record, recorder, writer  # noqa: F401

        channel_description.describe(_FRAME_TYPE)

    def begin(self, stamp: int) -> None:
        """Start a recording with a snapshot at a ROS time [ns]. Its file is created in the background, see `status`.

        Raises:
            RecordingNotInstalledError: if its libraries are missing.
            RecordingUnavailableError: if a recording runs already, the folder can't be used, or memory, threads or
                files run out.
        """
        if self._recorder is not None:
            path = self._recorder.status().path
            raise RecordingUnavailableError(
                "recording already; its file is being opened" if path is None else f"recording already, into {path}"
            )
        if self._closing is not None:
            raise RecordingUnavailableError("the previous recording is still being closed; try again")
        try:
            self._recorder = self._new_recorder(stamp)
        except (OSError, MemoryError) as error:
            reason = getattr(error, "strerror", None) or _NO_MEMORY
            raise RecordingUnavailableError(
                f"cannot start recording: {reason}; end other processes, or raise this one's limits (ulimit -a)"
            ) from error

    def _new_recorder(self, stamp: int) -> Recorder:
        self._check_libraries()
        from cloth_sim_ros.session.errors import RecordingError
        from cloth_sim_ros.session.recorder import Recorder, RecorderOptions, session_stem
        from cloth_sim_ros.session.writer import WriterOptions

        settings = self._settings()
        compression: Any = settings.compression
        writer = WriterOptions(compression=compression, min_free_space=settings.least_free_space)
        try:
            return Recorder(
                _folder(settings),
                snapshot=self.snapshot(),
                log_time=stamp,
                stem=session_stem(self._stem, datetime.datetime.now(datetime.UTC)),
                options=RecorderOptions(writer=writer, split_bytes=settings.split),
            )
        except RecordingError as error:
            raise RecordingUnavailableError(str(error)) from error

    def _check_libraries(self) -> None:
        """Import the libraries for recording; set `missing`, empty if all are installed.

        The session's modules import them late, in the recorder's thread, which could not report a missing one.

        Raises:
            RecordingNotInstalledError: if one of them is missing.
        """
        libraries = ["mcap.records", "rosbags.typesys", *_COMPRESSION[self._settings().compression]]
        for library in libraries:
            try:
                importlib.import_module(library)
            except ImportError as error:
                name = library.partition(".")[0]
                self.missing = f"recording needs {name}, which is not installed: pip install mcap rosbags zstandard lz4"
                raise RecordingNotInstalledError(self.missing) from error
        self.missing = ""

    def wait_until_open(self) -> Path:
        """Wait, blocking, until the file of the started recording exists, and return its path.

        Raises:
            RecordingUnavailableError: if the file can't be created; then nothing is recorded.
        """
        from cloth_sim_ros.session.errors import RecordingError

        assert self._recorder is not None
        try:
            return self._recorder.wait_until_open()
        except RecordingError as error:
            self._recorder = None
            raise RecordingUnavailableError(str(error)) from error

    def status(self) -> RecorderStatus | None:
        """Return the status of the present or the last recording; None before the first."""
        recorder = self._recorder or self._closing
        return recorder.status() if recorder is not None else self._last

    def notify(self, listener: Callable[[RecorderStatus], None]) -> None:
        """Register a listener for one call, when the recording's file exists or the ended recording's is closed."""
        self._listeners.append(listener)

    def poll(self) -> str:
        """Call listeners whose event has come; return an error of the recording once, or "". Call it periodically."""
        recorder = self._recorder or self._closing
        if recorder is None:
            return ""
        status = recorder.status()
        if status.state == "opening" or (self._closing is not None and status.state == "recording"):
            return ""
        reason = ""
        if status.state in ("failed", "closed"):
            if status.error:
                effect = "nothing is recorded" if status.path is None else "the recording ended"
                reason = f"{effect}: {status.error}"
            self._recorder = self._closing = None
            self._last = status
        listeners, self._listeners = self._listeners, []
        for listener in listeners:
            listener(status)
        return reason

    def begin_close(self, *, reason: str = "stopped") -> None:
        """End the recording, and close its file in the background; `notify` reports when it is closed.

        Raises:
            RecordingUnavailableError: if no recording runs.
        """
        if self._recorder is None:
            raise RecordingUnavailableError("nothing is being recorded")
        self._recorder.close(timeout=0.0, reason=reason)
        self._recorder, self._closing = None, self._recorder

    def end(self, *, reason: str, timeout: float) -> RecorderStatus | None:
        """Close the recording, blocking for a time [s] at most; return its final status, or None if none runs."""
        recorder = self._recorder or self._closing
        if recorder is None:
            return None
        self._recorder = self._closing = None
        self._last = recorder.close(reason=reason, timeout=timeout)
        return self._last

    def before_frame(self, stamp: int) -> None:
        """Prepare for a frame at a ROS time [ns]: split the file at its size limit, and buffer records until `commit`.

        The recording ends if memory runs out.
        """
        if self.bag_topics is not None:
            self.bag_topics.before_frame(stamp)
        if self._recorder is not None and self._recorder.wants_split:
            try:
                snapshot = self.snapshot()
            except (OSError, MemoryError) as error:
                self._recorder.fail(f"cannot begin the next file: {getattr(error, 'strerror', None) or _NO_MEMORY}")
            else:
                self._recorder.split(snapshot, log_time=stamp)
        self._pending = []

    def commit(self) -> None:
        """Write the buffered records of a frame, because the frame succeeded."""
        pending, self._pending = self._pending, None
        if self._recorder is not None:
            for record in pending or ():
                record(self._recorder)

    def discard(self) -> None:
        """Drop the buffered records of a frame, because the frame failed."""
        self._pending = None
        if self.bag_topics is not None:
            self.bag_topics.restart()

    def add(self, topic: str, kind: Any, data: bytes, *, stamp: int, qos: QoSProfile, droppable: bool) -> None:
        """Record a message's bytes at a ROS time [ns], if a recording runs; within a frame, buffer until `commit`."""
        if self._recorder is not None:
            self._record(topic, _type_name(kind), data, log_time=stamp, droppable=droppable, qos=_session_qos(qos))

    def add_frame(self, frame: Frame, stamp: int) -> None:
        """Write a frame's record (events, steps, digest) before its messages, and to ~/frame; consume `extras`."""
        extras, self.extras = self.extras, {}
        numbering = {} if self.bag_topics is None else self.bag_topics.next_record_extras(stamp)
        if self._recorder is None and not numbering:
            return
        extras |= numbering
        if (energy := self._simulation.energy_report) is not None:
            extras |= {"energy": energy.total, "energy balance": energy.residual}
        from cloth_sim_ros.session.cdr import encode_string
        from cloth_sim_ros.session.frame_record import FrameRecord

        record = FrameRecord(
            frame=frame.index,
            time=frame.time,
            events=tuple(events.to_dict(event) for event in frame.events),
            integrator=frame.integrator,
            tolerance=frame.tolerance,
            steps=frame.advance.steps if frame.advance else 0,
            digest=self._simulation.state.digest(),
            paused=self._simulation.paused,
            extras=extras | frame.extras(),
        )
        data = encode_string(record.to_json())
        if self.bag_topics is not None and numbering:
            self.bag_topics.publish(data)
        self._record(f"{self._node_name}/frame", _FRAME_TYPE, data, log_time=stamp, droppable=False)

    def _record(self, *message: Any, **options: Any) -> None:
        if self._recorder is None:
            return
        if self._pending is None:
            self._recorder.record(*message, **options)
        else:
            self._pending.append(lambda recorder: recorder.record(*message, **options))

    def save_state(self) -> Path:
        """Write the cloth's state as .npz into the recording folder; return its path, or RecordingUnavailableError.

        Raises:
            RecordingUnavailableError: if the file can't be written; the message has the cause and the remedy.
        """
        from cloth_sim_ros.session.errors import RecordingError
        from cloth_sim_ros.session.storage import AppendFile, make_folder, remove_leftovers

        folder = _folder(self._settings())
        time_of_day = datetime.datetime.now(datetime.UTC)
        stem, suffix = f"{self._stem}_{time_of_day:%Y-%m-%dT%H-%M-%S.%f}", ".npz"
        try:
            data = self._simulation.state.to_bytes()
            make_folder(folder)
            remove_leftovers(folder, suffix)
            file = AppendFile(folder, stem, suffix)
            try:
                file.append([data])
                file.sync()
                path = file.publish()
                file.sync_name()
            except BaseException:
                file.discard()
                raise
            file.close()
        except RecordingError as error:
            raise RecordingUnavailableError(str(error)) from error
        except (OSError, MemoryError) as error:
            reason = getattr(error, "strerror", None) or _NO_MEMORY
            raise RecordingUnavailableError(
                f"cannot write {folder / stem}{suffix}: {reason}; set record.folder"
            ) from error
        return path

    def snapshot(self) -> SessionSnapshot:
        """Return parameters, files and state of the cloth between two frames, with which a session begins."""
        from cloth_sim_ros.session.writer import SessionSnapshot

        return SessionSnapshot(
            scene_yaml=parameter_file.dump(self._simulation.scene.parameters()),
            state=self._simulation.state.to_bytes(),
            files=self._simulation.scene.files,
            metadata={"node": self._node_name, "period": repr(self._simulation.scene.period), **environment()},
        )


def _folder(settings: RecordSettings) -> Path:
    """Return the recording folder, which need not exist.

    Raises:
        RecordingUnavailableError: if it is in the home folder of a user without one.
    """
    try:
        return Path(settings.folder).expanduser()
    except RuntimeError as error:
        raise RecordingUnavailableError(
            f"cannot find {settings.folder}: there is no such home folder; set record.folder"
        ) from error


def log_end(logger: Any, status: RecorderStatus) -> None:
    """Log file and size of a closed recording, or the error of a failed one."""
    if status.state == "closed":
        moved = "" if status.path is None or status.path.exists() else ", which was renamed or moved since"
        logger.info(
            f"recorded {pluralize(status.messages, 'message')}, {status.bytes_written} bytes, into {status.path}{moved}"
        )
    else:
        logger.error(f"the recording failed: {status.error}")


def _type_name(kind: Any) -> str:
    """Return the full name of a message class, e.g. ``sensor_msgs/msg/PointCloud2``."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def _session_qos(qos: QoSProfile) -> Any:
    from cloth_sim_ros.session.channel_description import Qos

    return Qos(
        reliability="best_effort" if qos.reliability == ReliabilityPolicy.BEST_EFFORT else "reliable",
        durability="transient_local" if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL else "volatile",
        depth=qos.depth,
        history="keep_all" if qos.history == HistoryPolicy.KEEP_ALL else "keep_last",
    )
