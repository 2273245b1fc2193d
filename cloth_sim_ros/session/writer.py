# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writer of one session file in the MCAP format."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from cloth_sim_ros.session.channel_description import MESSAGE_ENCODING, SCHEMA_ENCODING, Qos, channel_metadata, describe
from cloth_sim_ros.session.errors import RecordingError
from cloth_sim_ros.session.storage import AppendFile, make_folder, remove_leftovers

if TYPE_CHECKING:
    from cloth_sim_ros.session.mcap_builder import Compression, McapBuilder

FORMAT_VERSION = "1"
METADATA_NAME = "cloth_sim"
END_METADATA_NAME = "cloth_sim_end"
SCENE_NAME = "scene.yaml"
STATE_NAME = "state.npz"
FILE_PREFIX = "file:"
"""Prefix of the name of an attachment with a file that a parameter names."""
SUFFIX = ".mcap"


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionSnapshot:
    """Opening of a session file: parameters, state, metadata and files; enough to run the following frames again."""

    scene_yaml: str
    """ROS parameter file with all effective parameters."""
    state: bytes
    """Full state before the file's first frame, as the bytes of an .npz."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Versions, machine, node (its resolved name, e.g. ``/cloth_sim``), period [s]; all as text."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Contents of the files that parameters name (a mesh, springs), by that name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WriterOptions:
    """Options of a session file: compression, chunks, synchronisation, minimum free space. Invalid: RecordingError."""

    compression: Compression = "lz4"
    chunk_bytes: int = 1 << 20
    """Size before compression at which a chunk is closed [bytes] ..."""
    chunk_seconds: float = 0.5
    """... or age of its oldest message [s]. A killed process loses at most this much."""
    sync_seconds: float = 1.0
    """Interval of synchronisation [s]: a power loss costs at most this plus `chunk_seconds`. 0: the system decides."""
    min_free_space: int = 0
    """Free space of the file system below which writing stops [bytes]."""

    def __post_init__(self) -> None:
        if self.chunk_bytes < 1 or self.min_free_space < 0:
            sizes = f"a chunk of {self.chunk_bytes} bytes with {self.min_free_space} bytes kept free"
            raise RecordingError(f"{sizes}: the first must be positive, the second must not be negative")
        if not (0 < self.chunk_seconds < 60 and 0 <= self.sync_seconds < 3600):
            times = f"chunks of {self.chunk_seconds} s, synchronised every {self.sync_seconds} s"
            raise RecordingError(f"{times}: the first must be within (0, 60), the second within [0, 3600)")


class SessionWriter:
    """Writer of one session file, which it creates, for one thread. Methods may raise OSError or RecordingError.

    After an error in `add` or `maintain` the file still ends on a whole record. `finish` then completes the file
    without the chunk that could not be written.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        snapshot: SessionSnapshot,
        stem: str,
        session: str | None = None,
        part: int = 0,
        log_time: int,
        options: WriterOptions | None = None,
        open_file: Callable[[Path, str, str], AppendFile] = AppendFile,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Create ``<folder>/<stem>_<part>.mcap`` (or, if that exists, ``...-2.mcap``) with its snapshot.

        `log_time` [ns since the epoch]: time of the snapshot. `session`: identifier that the files of a split session
        share (by default `stem`). Raises RecordingError or OSError if the file cannot be created.
        """
        from cloth_sim_ros.session.mcap_builder import McapBuilder

        self._options = options or WriterOptions()
        self._clock = clock
        self._builder = McapBuilder(compression=self._options.compression)
        self._channels: dict[str, int] = {}
        self._chunk_since: float | None = None
        self._unsynced_since: float | None = None
        self._finished = False
        self.message_count = 0
        """Number of messages in the file."""
        folder = Path(folder)
        make_folder(folder)
        remove_leftovers(folder, SUFFIX)
        opening = encode_opening(self._builder, snapshot, session=session or stem, part=part, log_time=log_time)
        self._file = open_file(folder, f"{stem}_{part:03d}", SUFFIX)
        try:
            self._check_free_space()
            self._file.append([opening])
            if self._options.sync_seconds:
                self._file.sync()
            self._file.publish()
            if self._options.sync_seconds:
                self._file.sync_name()
        except BaseException:
            # If the opening fails, the file is removed, even after it got its name.
            self._file.discard()
            raise

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._file.path

    @property
    def bytes_written(self) -> int:
        """Size of the file [bytes]."""
        return self._file.size

    @property
    def session_seconds(self) -> float:
        """Span of the log times in the file [s]."""
        times = self._builder.message_times
        return 0.0 if times is None else (times[1] - times[0]) * 1e-9

    def declare(self, topic: str, type_name: str, qos: Qos | None = None) -> None:
        """Declare a topic's channel, once and before `add`. Raises SessionError for a type that is not standard."""
        description = describe(type_name)
        self._channels[topic] = self._builder.add_channel(
            topic=topic,
            schema=(type_name, SCHEMA_ENCODING, description.definition.encode()),
            encoding=MESSAGE_ENCODING,
            metadata=channel_metadata(type_name, qos or Qos()),
        )

    def is_declared(self, topic: str) -> bool:
        """Return True if the topic has a channel."""
        return topic in self._channels

    def add(self, topic: str, data: bytes, *, log_time: int, publish_time: int, sequence: int) -> None:
        """Append a message (CDR bytes) to a declared topic, and write a full chunk. Times in ns since the epoch."""
        if self._chunk_since is None:
            self._chunk_since = self._clock()
        self._builder.add_message(
            self._channels[topic], data, log_time=log_time, publish_time=publish_time, sequence=sequence & 0xFFFFFFFF
        )
        if self._builder.chunk_size >= self._options.chunk_bytes:
            self._write_chunk()

    def seconds_until_due(self) -> float | None:
        """Return the time until `maintain` is due [s], negative if overdue; None if no data waits."""
        due = []
        if self._chunk_since is not None:
            due.append(self._chunk_since + self._options.chunk_seconds)
        if self._unsynced_since is not None and self._options.sync_seconds:
            due.append(self._unsynced_since + self._options.sync_seconds)
        return min(due) - self._clock() if due else None

    def maintain(self) -> None:
        """Close a chunk that is old enough, and synchronise the file if that is due; call it regularly."""
        now = self._clock()
        if self._chunk_since is not None and now - self._chunk_since >= self._options.chunk_seconds:
            self._write_chunk()
        sync = self._options.sync_seconds
        if sync and self._unsynced_since is not None and now - self._unsynced_since >= sync:
            self._file.sync()
            self._unsynced_since = None

    def finish(self, *, reason: str, notes: Mapping[str, str] | None = None) -> None:
        """Write last chunk, end record with the reason, and indexes; close the file. A second call does nothing.

        After an OSError the file is closed, intact but unfinished.
        """
        if self._finished:
            return
        self._finished = True
        try:
            write_error: OSError | MemoryError | RecordingError | None = None
            try:
                self._write_chunk()
            except (OSError, MemoryError, RecordingError) as error:
                write_error = error
            self._close_file(reason, notes or {})
            if write_error is not None:
                raise write_error
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without indexes, unfinished but intact."""
        self._finished = True
        self._file.close()

    def _close_file(self, reason: str, notes: Mapping[str, str]) -> None:
        from mcap.records import Metadata

        end_notes = {**notes, "reason": reason, "messages": str(self.message_count)}
        end_notes["checksum"] = metadata_checksum(end_notes)
        end = self._builder.encode_metadata(Metadata(name=END_METADATA_NAME, metadata=end_notes), self._file.size)
        self._file.append([end, self._builder.encode_closing(self._file.size + len(end))])
        if self._options.sync_seconds:
            self._file.sync()

    def _write_chunk(self) -> None:
        if not self._builder.chunk_messages:
            return
        self._check_space()
        packed = self._builder.pack_chunk()
        offset = self._file.size
        self._file.append(packed.parts)
        self._builder.commit(packed, offset)
        self.message_count += sum(packed.counts.values())
        self._chunk_since = None
        if self._unsynced_since is None:
            self._unsynced_since = self._clock()

    def _check_space(self) -> None:
        if not self._file.is_linked():
            raise RecordingError(f"{self.path} was removed while it was being recorded")
        self._check_free_space()

    def _check_free_space(self) -> None:
        min_free = self._options.min_free_space
        free_bytes = self._file.free_space() if min_free else 0
        if free_bytes < min_free:
            raise RecordingError(
                f"{free_bytes // 1_000_000} MB are left on the disk of {self.path.parent}, record.least_free_space is "
                f"{min_free // 1_000_000} MB; make room or lower it"
            )


def encode_opening(builder: McapBuilder, snapshot: SessionSnapshot, *, session: str, part: int, log_time: int) -> bytes:
    """Return the bytes of a file's opening (header, metadata, attachments), and register them in `builder`.

    Args:
        builder: encoder of the file.
        snapshot: the contents.
        session: identifier that the files of a split session share.
        part: index of the file in its session.
        log_time: time of the snapshot [ns since the epoch].
    """
    from mcap.records import Attachment, Metadata

    metadata = {**snapshot.metadata, "format": FORMAT_VERSION, "session": session, "part": str(part)}
    metadata["checksum"] = metadata_checksum(metadata)
    return builder.encode_opening(
        library="cloth_sim_ros",
        metadata=[Metadata(name=METADATA_NAME, metadata=metadata)],
        attachments=[
            Attachment(create_time=log_time, log_time=log_time, name=name, media_type=media_type, data=data)
            for name, media_type, data in (
                (SCENE_NAME, "application/yaml", snapshot.scene_yaml.encode()),
                (STATE_NAME, "application/octet-stream", snapshot.state),
                *((FILE_PREFIX + name, "application/octet-stream", data) for name, data in snapshot.files.items()),
            )
        ],
    )


def metadata_checksum(metadata: Mapping[str, str]) -> str:
    """Return the CRC-32, 8 hexadecimal digits, of the entries but `checksum`; MCAP has none for metadata."""
    entries = sorted((key, value) for key, value in metadata.items() if key != "checksum")
    text = "\x00".join(f"{key}\x01{value}" for key, value in entries)
    return f"{zlib.crc32(text.encode()):08x}"
