# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files cut off at any byte or with flipped bits: intact messages are read, corrupt ones never."""

from __future__ import annotations

import contextlib
import itertools
import os
import random
from pathlib import Path
from typing import get_args

import pytest
from mcap.reader import NonSeekingReader, SeekingReader
from rosbags.highlevel import AnyReader
from support import session_samples as samples

from cloth_sim_ros.session.errors import DamagedSessionError, NotASessionError, SessionError
from cloth_sim_ros.session.mcap_builder import Compression
from cloth_sim_ros.session.mcap_scan import RawMessage, chunk_records
from cloth_sim_ros.session.part import SessionPart
from cloth_sim_ros.session.reader import SessionReader
from cloth_sim_ros.session.recover import recover
from cloth_sim_ros.session.writer import WriterOptions

CONTENT = list(samples.samples(40))
EXPECTED = samples.plain(CONTENT)
COMPRESSIONS = get_args(Compression)


def _write(folder: Path, compression: Compression = "lz4") -> Path:
    options = WriterOptions(chunk_bytes=4096, compression=compression, sync_seconds=0)
    return samples.write_session(folder, CONTENT, options=options)


def _chunk_ends(path: Path) -> list[tuple[int, int]]:
    """Return for each chunk its end offset and the number of messages up to there."""
    messages, ends = 0, []
    part = SessionPart(path)
    for chunk in part.chunks():
        messages += sum(isinstance(item, RawMessage) for _, item in chunk_records(chunk))
        ends.append((chunk.location.end, messages))
    part.close()
    assert messages == len(CONTENT)
    return ends


def _opening(path: Path) -> int:
    """Return the size before the first chunk [bytes]."""
    with path.open("rb") as file:
        return int(SeekingReader(file).get_summary().chunk_indexes[0].chunk_start_offset)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_cut_at_any_byte_loses_open_chunk_at_most(tmp_path: Path, compression: Compression) -> None:
    whole = _write(tmp_path, compression)
    data = whole.read_bytes()
    ends = _chunk_ends(whole)
    opening = _opening(whole)
    generator = random.Random(1)
    borders = [end + shift for end, _ in ends for shift in (-1, 0, 1)]
    cuts = [*borders, *range(len(data) - 45, len(data)), *(generator.randrange(len(data)) for _ in range(150))]
    cut = tmp_path / "cut.mcap"
    for length in cuts:
        cut.write_bytes(data[:length])
        written = max((count for end, count in ends if end <= length), default=0)
        try:
            reader = SessionReader(cut)
        except (DamagedSessionError, NotASessionError):
            # Such a file is never visible: it gets its name after its opening is complete.
            assert length < opening
            continue
        with reader:
            assert samples.plain(list(reader.messages())) == EXPECTED[:written]
            assert not reader.complete
            assert reader.missing is not None
            assert "cut off" in reader.missing or "indexes are missing" in reader.missing


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_flipped_bits_never_pass_as_good(tmp_path: Path, compression: Compression) -> None:
    data = _write(tmp_path, compression).read_bytes()
    generator = random.Random(2)
    damaged = tmp_path / "damaged.mcap"
    known = set(EXPECTED)
    refused = reported = harmless = 0
    for _ in range(400):
        position = generator.randrange(len(data))
        changed = bytearray(data)
        changed[position] ^= 1 << generator.randrange(8)
        damaged.write_bytes(changed)
        try:
            reader = SessionReader(damaged)
        except SessionError:
            refused += 1
            continue
        with reader:
            got = samples.plain(list(reader.messages()))
            assert set(got) <= known
            assert len(set(got)) == len(got)
            if got == EXPECTED:
                harmless += reader.missing is None
            else:
                assert not reader.complete
                assert reader.missing is not None
                reported += 1
            assert reader.state == samples.SNAPSHOT.state
            assert reader.scene_yaml == samples.SNAPSHOT.scene_yaml
            assert reader.metadata["period"] == samples.SNAPSHOT.metadata["period"]
    # Bits in message indexes and chunk headers are harmless: this reader does not use them.
    assert refused > 20
    assert reported > 100
    assert refused + reported + harmless <= 400


def test_strict_reading_raises_at_the_first_damage(tmp_path: Path) -> None:
    path = _write(tmp_path)
    data = bytearray(path.read_bytes())
    ends = _chunk_ends(path)
    data[ends[1][0] - 10] ^= 1
    path.write_bytes(data)
    with SessionReader(path, strict=True) as reader:
        messages = reader.messages()
        good = list(itertools.islice(messages, ends[0][1]))
        with pytest.raises(DamagedSessionError, match="chunk at byte"):
            next(messages)
    assert samples.plain(good) == EXPECTED[: len(good)]


def test_after_a_damaged_chunk_reading_goes_on(tmp_path: Path) -> None:
    path = _write(tmp_path)
    ends = _chunk_ends(path)
    damaged_span = slice(ends[2][1], ends[3][1])
    for cut in (None, ends[-2][0]):
        data = bytearray(_write(tmp_path / str(cut)).read_bytes()[:cut])
        data[ends[3][0] - 100] ^= 1
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(data)
        expected = EXPECTED[: None if cut is None else ends[-2][1]]
        del expected[damaged_span]
        with SessionReader(damaged) as reader:
            assert samples.plain(list(reader.messages())) == expected
            assert reader.missing is not None
            assert "fails its checksum" in reader.missing or "does not decompress" in reader.missing


def test_torn_record_of_unfinished_file_loses_no_other_record(tmp_path: Path) -> None:
    whole = _write(tmp_path)
    path = tmp_path / "torn.mcap"
    ends = _chunk_ends(whole)
    data = whole.read_bytes()[: ends[-1][0]]
    # The first message index after chunk 2 has a wrong opcode or length, or the next chunk has a length beyond the end:
    # the following chunks are found by their checksums.
    with whole.open("rb") as file:
        third = SeekingReader(file).get_summary().chunk_indexes[3].chunk_start_offset
    for offset, value, damaged_span in [
        (ends[2][0], 0x33, None),
        (ends[2][0] + 1, 0xFF, None),
        (ends[2][0] + 5, 0x01, None),
        (third, 0x07, 3),
        (third, 0x02, 3),
        (third + 5, 0x01, 3),
        (third + 8, 0x80, 3),
    ]:
        changed = bytearray(data)
        changed[offset] = value
        path.write_bytes(changed)
        expected = EXPECTED[: ends[-1][1]]
        if damaged_span is not None:
            del expected[ends[damaged_span - 1][1] : ends[damaged_span][1]]
        with SessionReader(path) as reader:
            assert samples.plain(list(reader.messages())) == expected
            assert reader.missing is not None
            assert not reader.complete


def test_messages_of_lost_declaration_are_skipped(tmp_path: Path) -> None:
    path = _write(tmp_path)
    ends = _chunk_ends(path)
    data = bytearray(path.read_bytes()[: ends[-1][0]])
    data[ends[0][0] - 100] ^= 1
    path.write_bytes(data)
    first = CONTENT[: ends[0][1]]
    declared_later = {item.topic for item in CONTENT[ends[0][1] :]} - {item.topic for item in first}
    assert declared_later
    expected = [item for item in EXPECTED[ends[0][1] :] if item[0] in declared_later]
    with SessionReader(path) as reader:
        assert samples.plain(list(reader.messages())) == expected
        assert "never declared" in str(reader.missing)
    mended = recover(path).path
    with SessionReader(mended, strict=True) as reader:
        assert samples.plain(list(reader.messages())) == expected
        assert reader.complete
    _check_with_other_readers(mended, expected)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_recovered_file_is_finished_and_holds_intact_chunks(tmp_path: Path, compression: Compression) -> None:
    whole = _write(tmp_path, compression)
    ends = _chunk_ends(whole)
    cut = tmp_path / "cut.mcap"
    for chunk_index in (0, 3, len(ends) - 1):
        end, count = ends[chunk_index]
        cut.write_bytes(whole.read_bytes()[: end + 7])
        mended = recover(cut, tmp_path / f"mended_{chunk_index}.mcap")
        assert mended.messages == count
        assert "cut off" in mended.missing
        with SessionReader(mended.path, strict=True) as reader:
            assert samples.plain(list(reader.messages())) == EXPECTED[:count]
            assert reader.complete
            assert reader.state == samples.SNAPSHOT.state
            assert reader.parts[0].end_notes["reason"] == "recovered"
        _check_with_other_readers(mended.path, EXPECTED[:count])
    assert not [path for path in tmp_path.iterdir() if "unfinished" in path.name]


def test_file_whose_name_is_not_utf_8_is_recovered(tmp_path: Path) -> None:
    named = tmp_path / os.fsdecode(b"d\xe9.mcap")
    try:
        named.write_bytes(_write(tmp_path).read_bytes()[:-100])
    except OSError:
        pytest.skip("the file system has UTF-8 names alone")
    with contextlib.closing(SessionPart(recover(named).path)) as part:
        assert part.end_notes["reason"] == "recovered"


def test_recover_refuses_unrecoverable_files(tmp_path: Path) -> None:
    whole = _write(tmp_path)
    with pytest.raises(SessionError, match="nothing to recover"):
        recover(whole)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-100])
    with pytest.raises(SessionError, match="exists"):
        recover(cut, whole)
    with pytest.raises(SessionError, match="must be named"):
        recover(cut, tmp_path / "mended.bag")
    with pytest.raises(SessionError, match=r"there is no folder .*nowhere' for mended\.mcap"):
        recover(cut, tmp_path / "nowhere" / "mended.mcap")
    first, second = recover(cut).path, recover(cut).path
    assert (first.name, second.name) == ("cut_recovered.mcap", "cut_recovered-2.mcap")


def _check_with_other_readers(path: Path, expected: list[tuple[str, str, bytes, int]]) -> None:
    samples.check_structure(path)
    for kind in (SeekingReader, NonSeekingReader):
        with path.open("rb") as file:
            got = [
                (channel.topic, schema.name, message.data, message.log_time)
                for schema, channel, message in kind(file, validate_crcs=True).iter_messages(log_time_order=False)
            ]
            assert got == expected
    with AnyReader([path]) as bag:
        assert [(c.topic, c.msgtype, bytes(data), time) for c, time, data in bag.messages()] == expected
