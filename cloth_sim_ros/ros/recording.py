# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recording of what the node publishes and hears: frames, bytes and snapshots, handed to the session's recorder."""

from __future__ import annotations

import datetime
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from cloth_sim_ros.scene import parameter_file
from cloth_sim_ros.session.words import counted
from cloth_sim_ros.simulation import events
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.simulation.simulation import Frame, Simulation

if TYPE_CHECKING:
    from cloth_sim_ros.scene.sections import Record as RecordSettings
    from cloth_sim_ros.session.recorder import Recorder, RecorderOptions, RecorderStatus
    from cloth_sim_ros.session.writer import Snapshot

_NO_MEMORY = "no memory is left"
_FRAME_TYPE = "std_msgs/msg/String"
#: Libraries that a recording's compression takes.
_COMPRESSION = {"none": (), "lz4": ("lz4.frame",), "zstd": ("zstandard",)}


class RecordingUnavailableError(RuntimeError):
    """Nothing can be recorded; the message says why."""


class RecordingNotInstalledError(RecordingUnavailableError):
    """The libraries that recording needs are not there."""


class SessionRecording:
    """One node's recording: at most one at a time, begun and ended at frame boundaries.

    Args:
        node_name: the node's full name, e.g. ``/cloth_sim``.
        simulation: what is recorded.
        settings: how and where to, asked for when a recording begins; by default what is in force in the simulation.
    """

    def __init__(
        self, *, node_name: str, simulation: Simulation, settings: Callable[[], RecordSettings] | None = None
    ) -> None:
        self._node_name = node_name
        self._simulation = simulation
        self._settings = settings or (lambda: simulation.scene.record)
        self._recorder: Recorder | None = None
        self._closing: Recorder | None = None
        self._last: RecorderStatus | None = None
        self._told: list[Callable[[RecorderStatus], None]] = []
        #: What a frame under way records; None between frames.
        self._held: list[Callable[[Recorder], object]] | None = None
        #: Why nothing can be recorded at all, once that was tried; else empty.
        self.missing = ""

    @property
    def running(self) -> bool:
        """Whether messages are recorded."""
        return self._recorder is not None

    @property
    def busy(self) -> bool:
        """True while a recording runs or the one before is still being closed."""
        return self._recorder is not None or self._closing is not None

    def prepare(self) -> None:
        """Load what recording needs, so that no frame is late because of it; nothing where it is not installed."""
        try:
            self._check_libraries()
        except RecordingNotInstalledError:
            return
        from cloth_sim_ros.session import cdr, frame_record, layouts, recorder, writer  # noqa: F401

        layouts.describe(_FRAME_TYPE)

    def begin(self, stamp: int) -> None:
        """Begin a recording with a snapshot, at a ROS time [ns]; its file is made in the background, see `status`.

        Raises:
            RecordingNotInstalledError: if the libraries for it are missing.
            RecordingUnavailableError: if one runs already, the folder has no place, or memory, threads, files run out.
        """
        if self._recorder is not None:
            raise RecordingUnavailableError(f"recording already, into {self._recorder.status().path}")
        if self._closing is not None:
            raise RecordingUnavailableError("the recording before is still being closed; ask again")
        try:
            self._recorder = self._new_recorder(stamp)
        except (OSError, MemoryError) as error:
            reason = getattr(error, "strerror", None) or _NO_MEMORY
            raise RecordingUnavailableError(
                f"cannot begin to record: {reason}; end other processes, or raise this one's limits (ulimit -a)"
            ) from error

    def _new_recorder(self, stamp: int) -> Recorder:
        self._check_libraries()
        from cloth_sim_ros.session.errors import RecordingError
        from cloth_sim_ros.session.recorder import Recorder, session_stem

        try:
            return Recorder(
                _folder(self._settings()),
                snapshot=self._snapshot(),
                log_time=stamp,
                stem=session_stem(self._stem(), datetime.datetime.now(datetime.UTC)),
                options=self._options(),
            )
        except RecordingError as error:
            raise RecordingUnavailableError(str(error)) from error

    def _check_libraries(self) -> None:
        """Import the libraries that recording needs.

        The session's modules import them late, in the recorder's thread, where a missing one could not be reported.

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
        """Wait until the file exists, and return its path.

        Raises:
            RecordingUnavailableError: if it can't be made; nothing is recorded then.
        """
        from cloth_sim_ros.session.errors import RecordingError

        assert self._recorder is not None
        try:
            return self._recorder.wait_until_open()
        except RecordingError as error:
            self._recorder = None
            raise RecordingUnavailableError(str(error)) from error

    def status(self) -> RecorderStatus | None:
        """What the recording does, or how the last one ended; None if there was none."""
        recorder = self._recorder or self._closing
        return recorder.status() if recorder is not None else self._last

    def tell(self, listener: Callable[[RecorderStatus], None]) -> None:
        """Have a listener told, once, when the recording just begun has its file, or the one ended is closed."""
        self._told.append(listener)

    def poll(self) -> str:
        """Tell listeners what they wait for; return what went wrong with the recording, once, else an empty text."""
        recorder = self._recorder or self._closing
        if recorder is None:
            return ""
        status = recorder.status()
        if status.state == "opening" or (self._closing is not None and status.state == "recording"):
            return ""
        reason = ""
        if status.state in ("failed", "closed"):
            if status.error:
                what = "nothing is recorded" if status.path is None else "the recording ended"
                reason = f"{what}: {status.error}"
            self._recorder = self._closing = None
            self._last = status
        told, self._told = self._told, []
        for listener in told:
            listener(status)
        return reason

    def end_soon(self, *, reason: str = "stopped") -> None:
        """Let what is recorded be written and the file be closed, without waiting for it; see `tell`.

        Raises:
            RecordingUnavailableError: if nothing is being recorded.
        """
        if self._recorder is None:
            raise RecordingUnavailableError("nothing is being recorded")
        self._recorder.close(timeout=0.0, reason=reason)
        self._recorder, self._closing = None, self._recorder

    def end(self, *, reason: str, timeout: float) -> RecorderStatus | None:
        """Close the recording, if there is one, within a time [s], and return how it went."""
        recorder = self._recorder or self._closing
        if recorder is None:
            return None
        self._recorder = self._closing = None
        self._last = recorder.close(reason=reason, timeout=timeout)
        return self._last

    def before_frame(self, stamp: int) -> None:
        """Go on in a new file where the present one has reached its limit; without memory for that, end here."""
        if self._recorder is not None and self._recorder.wants_split:
            try:
                snapshot = self._snapshot()
            except (OSError, MemoryError) as error:
                self._recorder.give_up(f"cannot begin the next file: {getattr(error, 'strerror', None) or _NO_MEMORY}")
            else:
                self._recorder.split(snapshot, log_time=stamp)
        self._held = []

    def commit(self) -> None:
        """Record what a frame had to record: it succeeded."""
        held, self._held = self._held, None
        if self._recorder is not None:
            for record in held or ():
                record(self._recorder)

    def discard(self) -> None:
        """Forget what a frame had to record: it failed."""
        self._held = None

    def add(self, topic: str, kind: Any, data: bytes, *, stamp: int, qos: QoSProfile, droppable: bool) -> None:
        """Record a message's bytes at a ROS time [ns]."""
        if self._recorder is not None:
            self._put(topic, _type_name(kind), data, log_time=stamp, droppable=droppable, qos=_session_qos(qos))

    def add_frame(self, frame: Frame, stamp: int, extras: dict[str, Any]) -> None:
        """Record what a frame did, before the messages that show it."""
        if self._recorder is None:
            return
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
        self._put(
            f"{self._node_name}/frame", _FRAME_TYPE, encode_string(record.to_json()), log_time=stamp, droppable=False
        )

    def _put(self, *message: Any, **options: Any) -> None:
        if self._recorder is None:
            return
        if self._held is None:
            self._recorder.record(*message, **options)
        else:
            self._held.append(lambda recorder: recorder.record(*message, **options))

    def save_state(self) -> Path:
        """Write the cloth's state into the folder for recordings, and return the file.

        Raises:
            RecordingUnavailableError: if it can't be written; the message says why, and the remedy.
        """
        from cloth_sim_ros.session.errors import RecordingError
        from cloth_sim_ros.session.storage import AppendFile, make_folder, remove_leftovers

        folder = _folder(self._settings())
        time_of_day = datetime.datetime.now(datetime.UTC)
        stem, suffix = f"{self._stem()}_{time_of_day:%Y-%m-%dT%H-%M-%S.%f}", ".npz"
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

    def _stem(self) -> str:
        """Return what files' names begin with."""
        return self._node_name.strip("/").replace("/", "_")

    def _options(self) -> RecorderOptions:
        from cloth_sim_ros.session.recorder import RecorderOptions
        from cloth_sim_ros.session.writer import WriterOptions

        record = self._settings()
        writer = WriterOptions(
            compression=record.compression,  # type: ignore[arg-type]
            least_free_space=record.least_free_space,
        )
        return RecorderOptions(writer=writer, split_bytes=record.split)

    def _snapshot(self) -> Snapshot:
        from cloth_sim_ros.session.writer import Snapshot

        return Snapshot(
            scene_yaml=parameter_file.dump(self._simulation.scene.parameters()),
            state=self._simulation.state.to_bytes(),
            files=self._simulation.scene.files,
            metadata={
                "node": self._node_name,
                "period": repr(self._simulation.scene.period),
                **environment(),
            },
        )


def _folder(settings: RecordSettings) -> Path:
    """Return the folder for recordings; it need not be there.

    Raises:
        RecordingUnavailableError: if it is in the home folder of someone who has none.
    """
    try:
        return Path(settings.folder).expanduser()
    except RuntimeError as error:
        raise RecordingUnavailableError(
            f"cannot find {settings.folder}: there is no such home folder; set record.folder"
        ) from error


def tell_end(logger: Any, status: RecorderStatus) -> None:
    """Say how a recording ended."""
    if status.state == "closed":
        logger.info(f"recorded {counted(status.messages, 'message')}, {status.bytes_written} bytes, into {status.path}")
    else:
        logger.error(f"the recording did not end well: {status.error}")


def _type_name(kind: Any) -> str:
    """Return the full name of a message class, e.g. ``sensor_msgs/msg/PointCloud2``."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def _session_qos(qos: QoSProfile) -> Any:
    from cloth_sim_ros.session.layouts import Qos

    return Qos(
        reliability="best_effort" if qos.reliability == ReliabilityPolicy.BEST_EFFORT else "reliable",
        durability="transient_local" if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL else "volatile",
        depth=qos.depth,
        history="keep_all" if qos.history == HistoryPolicy.KEEP_ALL else "keep_last",
    )
