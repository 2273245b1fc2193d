# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of a cut-off or damaged session into a new, finished file."""

from __future__ import annotations

import contextlib
import zlib
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.part import RECOVERED, SessionPart
from cloth_sim_ros.session.storage import AppendFile
from cloth_sim_ros.session.writer import END_METADATA_NAME, METADATA_NAME, SUFFIX, metadata_checksum

if TYPE_CHECKING:
    from cloth_sim_ros.session.mcap_builder import McapBuilder, PackedChunk
    from cloth_sim_ros.session.mcap_scan import Chunk


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovery:
    """Result of the recovery of a session: new file, number of messages, and remaining deficits."""

    path: Path
    """The new file."""
    messages: int
    bytes_written: int
    missing: str
    """Deficits of the old file, which the new one shares."""


def recover(
    source: Path | str, target: Path | str | None = None, *, on_progress: Callable[[int, int], None] | None = None
) -> Recovery:
    """Copy an unfinished or damaged session's intact chunks into a new, finished file. Raises SessionError.

    Chunks are copied unchanged: every message keeps its bytes, times and order. The indexes are rebuilt. The new file
    (by default ``<name>_recovered.mcap`` beside the old one) appears when it is complete. No file is overwritten, and
    the old one does not change. `on_progress` receives the bytes read and the total size.

    Raises SessionError if nothing needs recovery or the file is still being recorded; OSError for the new file.
    """
    source = Path(source)
    with contextlib.closing(SessionPart(source)) as part:
        if part.is_being_written():
            raise SessionError(f"{source} is still being recorded; recover it when its recording has ended")
        _check_recoverable(part, on_progress)
        folder, stem = _target_name(source, target)
        file = AppendFile(folder, stem, SUFFIX)
        try:
            messages = _copy(part, file, on_progress)
            file.sync()
            path = file.publish()
            file.sync_name()
        finally:
            file.close()
        missing = part.missing()
        assert missing is not None
        return Recovery(path=path, messages=messages, bytes_written=file.size, missing=missing)


def _check_recoverable(part: SessionPart, on_progress: Callable[[int, int], None] | None) -> None:
    """Raise SessionError for a finished, undamaged file; to find damage, the file is read once."""
    if not part.finished:
        return
    for _ in part.messages():
        if on_progress is not None:
            on_progress(part.position, part.size())
    if not part.damage:
        raise SessionError(f"{part.path} is finished and undamaged; there is nothing to recover")
    part.rewind()


def _target_name(source: Path, target: Path | str | None) -> tuple[Path, str]:
    if target is None:
        return source.parent, f"{source.stem}_recovered"
    target = Path(target)
    if target.suffix != SUFFIX:
        raise SessionError(f"the recovered file {target} must be named *{SUFFIX}")
    if target.exists():
        raise SessionError(f"{target} exists; give another name")
    if not target.absolute().parent.is_dir():
        raise SessionError(f"there is no folder '{target.absolute().parent}' for {target.name}; create it first")
    return target.parent, target.stem


def _copy(part: SessionPart, file: AppendFile, on_progress: Callable[[int, int], None] | None) -> int:
    from mcap.records import Metadata

    from cloth_sim_ros.session.mcap_builder import McapBuilder

    builder = McapBuilder(compression="none")
    metadata = [Metadata(name=METADATA_NAME, metadata=dict(part.metadata))]
    attachments = list(part.attachments.values())
    file.append([builder.encode_opening(library="cloth_sim_ros", metadata=metadata, attachments=attachments)])
    messages = _copy_chunks(part, file, builder, on_progress)
    schemas, channels = part.declarations()
    builder.set_declarations(schemas, channels)
    # The file's name need not be UTF-8.
    missing = (part.missing_contents() or "").encode(errors="backslashreplace").decode()
    notes = {**part.end_notes, "reason": RECOVERED, "messages": str(messages), "missing": missing}
    notes["checksum"] = metadata_checksum(notes)
    end = builder.encode_metadata(Metadata(name=END_METADATA_NAME, metadata=notes), file.size)
    file.append([end, builder.encode_closing(file.size + len(end))])
    return messages


def _copy_chunks(
    part: SessionPart, file: AppendFile, builder: McapBuilder, on_progress: Callable[[int, int], None] | None
) -> int:
    messages = 0
    for chunk in part.chunks():
        packed = _reindex(part, chunk)
        offset = file.size
        file.append(packed.parts)
        builder.add_chunk_index(packed, offset)
        messages += sum(packed.counts.values())
        if on_progress is not None:
            on_progress(part.position, part.size())
    return messages


def _reindex(part: SessionPart, chunk: Chunk) -> PackedChunk:
    """Return a chunk with new indexes, without undeclared channels' messages; registers declarations in `part`."""
    from cloth_sim_ros.session.mcap_builder import compressor, pack_chunk_record
    from cloth_sim_ros.session.mcap_scan import RawMessage, chunk_records

    indexes: dict[int, list[int]] = defaultdict(list)
    times: list[int] = []
    spans: list[slice] = []
    undeclared = set()
    size = 0
    for span, record in chunk_records(chunk):
        if not isinstance(record, RawMessage):
            part.declare(record)
        elif part.channel(record.channel) is None:
            undeclared.add(record.channel)
            continue
        else:
            indexes[record.channel] += (record.log_time, size)
            times.append(record.log_time)
        spans.append(span)
        size += span.stop - span.start
    payload, content, crc = chunk.payload, chunk.raw, chunk.crc
    if undeclared:
        for channel_id in sorted(undeclared):
            part.report_undeclared(channel_id, chunk.location)
        raw = memoryview(chunk.raw)
        content = b"".join(raw[span] for span in spans)
        payload = compressor(chunk.compression)(content)
    if undeclared or not chunk.has_checksum:
        crc = zlib.crc32(content)
    return pack_chunk_record(
        payload=payload,
        compression=chunk.compression,
        raw_size=len(content),
        crc=crc,
        times=(min(times, default=0), max(times, default=0)),
        indexes=indexes,
    )
