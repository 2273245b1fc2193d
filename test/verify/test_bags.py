# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of other recorders: run again from frame records and snapshots, with each kind of loss."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import struct
import tracemalloc
from pathlib import Path

import pytest
from support.bag_maker import BagMessage, MessageMaker, write_bag

from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode_string, encode_string
from cloth_sim_ros.session.main import main as session_main
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Reset, SetParameters, Step, Target
from cloth_sim_ros.verify.bag import verify_bag
from cloth_sim_ros.verify.main import main, status_of
from cloth_sim_ros.verify.verdict import Verdict

#: Frame of each snapshot after the first one.
SNAPSHOTS = (40, 80)
COUNT = 100
EVENTS: dict[int, list[Event]] = {
    5: [Target("gripper", (0.1, 0.0, 0.6)), Grasp("gripper", True)],
    6: [Target("gripper", (0.1, 0.1, 0.6))],
    12: [Pause(True)],
    13: [Target("gripper", (0.2, 0.1, 0.6))],
    14: [Step()],
    15: [Pause(False)],
    30: [SetParameters({"air.drag": 0.3, "cloth.anchors": ["top_left"]})],
    60: [Reset()],
    70: [Grasp("gripper", False)],
}


def scene(**values: object) -> Scene:
    """Return a small cloth."""
    return Scene.from_parameters({"cloth.resolution": [5, 6], **values})


def stream(node: str = "/cloth_sim", session: str = "0f") -> list[BagMessage]:
    """Return the messages of a node from its start: snapshots, frames, and events of each kind."""
    maker = MessageMaker(scene(), node=node, session=session)
    result = [maker.topology(), maker.snapshot()]
    for index in range(COUNT):
        if index in SNAPSHOTS:
            result.append(maker.snapshot())
        result += maker.frame(EVENTS.get(index, []))
    return result


@pytest.fixture(scope="module")
def recorded() -> list[BagMessage]:
    return stream()


def verify_one(path: Path) -> Verdict:
    (verdict,) = verify_bag(path)
    return verdict


def without(entries: list[BagMessage], leaf: str, *indices: int) -> list[BagMessage]:
    """Return the messages without some of one topic, by their index on it."""
    positions = [position for position, entry in enumerate(entries) if entry.topic.endswith(leaf)]
    absent = {positions[index] for index in indices}
    return [entry for position, entry in enumerate(entries) if position not in absent]


def test_whole_bag_is_the_same_to_the_last_bit(recorded: list[BagMessage], tmp_path: Path) -> None:
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", recorded))
    assert (verdict.frames, verdict.clouds, status_of(verdict)) == (COUNT, COUNT, 0)
    assert verdict.compared == {"cloud": COUNT, "wrench": COUNT, "topology": 1, "snapshot": 2}
    assert not (verdict.missing or verdict.absent or verdict.not_compared or verdict.environment)


def test_command_verifies_a_bag(recorded: list[BagMessage], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_bag(tmp_path / "bag.mcap", recorded)
    assert main([str(path)]) == 0
    assert f"bag.mcap: {COUNT} frames and {COUNT} clouds came out the same to the last bit" in capsys.readouterr().out
    assert main([str(path), "--accuracy"]) == 2
    assert "is a bag; --accuracy takes a session" in capsys.readouterr().err
    assert session_main(["info", str(path)]) == 2
    assert "is a bag of another recorder; cloth_verify alone reads it" in capsys.readouterr().err


def test_bag_from_the_middle_begins_at_its_first_snapshot(recorded: list[BagMessage], tmp_path: Path) -> None:
    middle = [position for position, entry in enumerate(recorded) if entry.topic.endswith("/frame")][25]
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", recorded[middle:]))
    assert (verdict.frames, status_of(verdict), verdict.missing) == (COUNT - 40, 0, [])
    assert verdict.not_compared["/cloth_sim/frame", "without a snapshot before it"] == 15
    assert verdict.not_compared["/cloth_sim/points", "of no frame that was run"] == 15


def test_lost_frame_is_named_and_the_next_snapshot_resumes(recorded: list[BagMessage], tmp_path: Path) -> None:
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", without(recorded, "/frame", 50)))
    assert verdict.same
    assert (verdict.frames, status_of(verdict)) == (50 + 20, 2)
    # Two frames passed no time: 12 and 13 are paused.
    assert verdict.missing == ["1 record between frames 48 and 50; the run goes on with frame 79"]
    assert verdict.not_compared["/cloth_sim/frame", "without a snapshot before it"] == 29


def test_lost_frame_without_later_snapshot_ends_the_run(recorded: list[BagMessage], tmp_path: Path) -> None:
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", without(recorded, "/frame", 90, 91)))
    assert (verdict.frames, status_of(verdict)) == (90, 2)
    assert verdict.missing == ["2 records between frames 88 and 91; nothing behind them is run"]


def test_lost_record_of_a_paused_frame_is_noticed(recorded: list[BagMessage], tmp_path: Path) -> None:
    # The numbers of the frames around it do not show it.
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", without(recorded, "/frame", 13)))
    assert verdict.missing == ["1 record between frames 12 and 13; the run goes on with frame 39"]


def test_lost_cloud_and_lost_snapshot_are_no_difference(recorded: list[BagMessage], tmp_path: Path) -> None:
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", without(without(recorded, "/points", 3, 4), "/snapshot", 1)))
    assert (verdict.frames, verdict.clouds, status_of(verdict)) == (COUNT, COUNT - 2, 0)
    assert verdict.missing == ["2 messages of /cloth_sim/points"]


def test_order_of_topics_in_the_bag_is_free(recorded: list[BagMessage], tmp_path: Path) -> None:
    # Each topic has its own delay, up to 40 frames.
    delays = {"/points": 120, "/wrench": -60, "/snapshot": 90, "/frame": 0, "/topology": 30}
    shuffled = sorted(enumerate(recorded), key=lambda entry: entry[0] + delays[f"/{entry[1].topic.rpartition('/')[2]}"])
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", [entry for _, entry in shuffled]))
    assert (verdict.frames, verdict.clouds, status_of(verdict), verdict.missing) == (COUNT, COUNT, 0, [])
    assert verdict.compared["snapshot"] == 2


@pytest.mark.parametrize(
    ("leaf", "kind"), [("/points", "cloud"), ("/frame", "frame"), ("/wrench", "wrench"), ("/topology", "topology")]
)
def test_changed_bit_is_a_difference(recorded: list[BagMessage], tmp_path: Path, leaf: str, kind: str) -> None:
    changed = list(recorded)
    position = [k for k, entry in enumerate(recorded) if entry.topic.endswith(leaf)][-1]
    data = bytearray(recorded[position].data)
    at = data.find(b'"digest":"') + 10 if leaf == "/frame" else -9
    data[at] = ord("0") + (data[at] == ord("0")) if leaf == "/frame" else data[at] ^ 1
    changed[position] = recorded[position]._replace(data=bytes(data))
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", changed))
    assert (dict(verdict.differing), status_of(verdict)) == ({kind: 1}, 1)


def test_snapshot_of_another_state_is_a_difference(recorded: list[BagMessage], tmp_path: Path) -> None:
    changed = list(recorded)
    _, second, _ = (k for k, entry in enumerate(recorded) if entry.topic.endswith("/snapshot"))
    maker = MessageMaker(scene())
    maker.sequence = 40
    changed[second] = maker.snapshot()
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", changed))
    assert (dict(verdict.differing), status_of(verdict)) == ({"snapshot": 1}, 1)


def test_two_cloths_in_one_bag_have_a_verdict_each(recorded: list[BagMessage], tmp_path: Path) -> None:
    second = stream(node="/left/cloth", session="1e")
    both = [entry for pair in zip(recorded, without(second, "/frame", 95), strict=False) for entry in pair]
    foreign = BagMessage("/camera/frame", "std_msgs/msg/String", b"\x00\x01\x00\x00\x03\x00\x00\x00{}\x00")
    verdicts = verify_bag(write_bag(tmp_path / "bag.mcap", [foreign, *both, *recorded[len(both) // 2 :]]))
    assert [verdict.name for verdict in verdicts] == ["bag.mcap, /cloth_sim", "bag.mcap, /left/cloth"]
    assert [status_of(verdict) for verdict in verdicts] == [0, 2]
    assert verdicts[1].missing == ["1 record between frames 93 and 95; nothing behind them is run"]


def test_restarted_node_begins_with_its_own_snapshot(recorded: list[BagMessage], tmp_path: Path) -> None:
    middle = len(recorded) // 3
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", [*recorded[:middle], *stream(session="ab")]))
    assert verdict.frames > COUNT
    assert (status_of(verdict), verdict.missing) == (0, [])


def test_repeated_messages_are_run_once(recorded: list[BagMessage], tmp_path: Path) -> None:
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", [entry for entry in recorded for _ in range(2)]))
    assert (verdict.frames, verdict.clouds, status_of(verdict)) == (COUNT, COUNT, 0)
    assert verdict.not_compared["/cloth_sim/frame", "a second message of one frame"] == COUNT


def test_folder_of_a_split_bag_is_read_in_order(
    recorded: list[BagMessage], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cloth_sim_ros.verify.bag._LAG", 4)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    cuts = [len(recorded) * k // 11 for k in range(12)]
    for k in range(11):
        write_bag(tmp_path / f"bag_{k}.mcap", recorded[cuts[k] : cuts[k + 1]])
    assert main([str(tmp_path)]) == 0
    assert verify_one(tmp_path).frames == COUNT


def write_sqlite(folder: Path, entries: list[BagMessage]) -> Path:
    """Write a bag of SQLite; return its file."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from cloth_sim_ros.session.channel_description import standard_types

    with rosbag2.Writer(folder, version=9) as writer:
        connections = {}
        for index, (topic, kind, data) in enumerate(entries):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=standard_types())
            writer.write(connections[topic], index, data)
    (path,) = folder.glob("*.db3")
    return path


def test_bag_of_sqlite_is_verified(recorded: list[BagMessage], tmp_path: Path) -> None:
    path = write_sqlite(tmp_path / "bag", recorded)
    assert main([str(tmp_path / "bag")]) == 0
    assert verify_one(path).frames == COUNT


@pytest.mark.parametrize("value", [10**12, "text", 1.5, -3])
def test_value_of_sqlite_without_bytes_is_damage(recorded: list[BagMessage], tmp_path: Path, value: object) -> None:
    path = write_sqlite(tmp_path / "bag", recorded)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE messages SET data = ? WHERE id = 50", (value,))
        connection.commit()
    verdict = verify_one(path)
    assert (verdict.same, status_of(verdict)) == (True, 2)
    assert "whose topic, type or data is of a wrong type" in verdict.missing[0]


def test_topic_of_sqlite_without_text_is_damage(
    recorded: list[BagMessage], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_sqlite(tmp_path / "bag", recorded)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE topics SET name = ? WHERE id = 1", (b"\xff",))
        connection.commit()
    assert main([str(path)]) == 2
    assert "whose topic, type or data is of a wrong type" in capsys.readouterr().err


def test_unread_log_of_sqlite_is_named(recorded: list[BagMessage], tmp_path: Path) -> None:
    path = write_sqlite(tmp_path / "bag", recorded)
    path.with_name(f"{path.name}-wal").write_bytes(b"later messages")
    verdict = verify_one(path)
    assert (verdict.frames, status_of(verdict)) == (COUNT, 2)
    assert "-wal holds messages that are not read" in verdict.missing[0]


def test_cut_bag_is_verified_up_to_the_cut(recorded: list[BagMessage], tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag.mcap", recorded)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    verdict = verify_one(path)
    assert verdict.same
    assert 20 < verdict.frames < 80
    assert status_of(verdict) == 2
    assert "without the end of its data" in verdict.missing[0]


def test_bag_without_snapshots_names_the_topic(recorded: list[BagMessage], tmp_path: Path) -> None:
    entries = [entry for entry in recorded if not entry.topic.endswith("/snapshot")]
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", entries))
    assert (verdict.frames, status_of(verdict)) == (0, 2)
    assert verdict.missing == ["no message of /cloth_sim/snapshot, from which the frames could be run"]


def test_clouds_without_frames_are_counted(recorded: list[BagMessage], tmp_path: Path) -> None:
    first = recorded[0]
    clouds = [entry for entry in stream(session="77") if entry.topic.endswith("/points")]
    stamps = [k.to_bytes(4, "little") for k in range(400)]
    more = [clouds[0]._replace(data=clouds[0].data[:8] + stamp + clouds[0].data[12:]) for stamp in stamps]
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", [first, *more, *recorded[1:]]))
    assert (verdict.frames, verdict.clouds, status_of(verdict)) == (COUNT, COUNT, 0)
    assert verdict.not_compared["/cloth_sim/points", "of no frame that was run"] == 400


def test_snapshots_alone_are_refused_with_the_remedy(
    recorded: list[BagMessage], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_bag(tmp_path / "bag.mcap", [entry for entry in recorded if not entry.topic.endswith("/frame")])
    assert main([str(path)]) == 2
    assert "start the node with record.topics: true" in capsys.readouterr().err


@pytest.mark.parametrize("leaf", ["/snapshot", "/frame"])
def test_damaged_message_is_reported(recorded: list[BagMessage], tmp_path: Path, leaf: str) -> None:
    position = next(k for k, entry in enumerate(recorded) if entry.topic.endswith(leaf))
    for cut in (0, 3, 20, len(recorded[position].data) // 2):
        changed = list(recorded)
        changed[position] = recorded[position]._replace(data=recorded[position].data[:cut])
        verdict = verify_one(write_bag(tmp_path / "bag.mcap", changed))
        assert (verdict.same, status_of(verdict)) == (True, 2)
        assert f"1 message of /cloth_sim{leaf} cannot be read" in verdict.missing[0]
        assert verdict.frames == COUNT - 40


def test_text_that_is_no_bag_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bag.db3").write_bytes(b"SQLite format 3\x00 and no more")
    assert main([str(tmp_path / "bag.db3")]) == 2
    assert "can't be read as a bag of SQLite" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert main([str(tmp_path / "empty")]) == 2
    assert "is a folder" in capsys.readouterr().err


def change_record(entry: BagMessage, *, digest: str | None = None, **extras: object) -> BagMessage:
    """Return a frame record with another digest or other extras."""
    content = json.loads(decode_string(entry.data))
    content["digest"] = digest or content["digest"]
    content["extras"] |= extras
    return entry._replace(data=encode_string(json.dumps(content)))


def with_stamp(entry: BagMessage, stamp: int) -> BagMessage:
    """Return a message with a header of another stamp [ns]."""
    data = entry.data[:4] + struct.pack("<iI", *divmod(stamp, 10**9)) + entry.data[12:]
    return entry._replace(data=data)


def positions_of(entries: list[BagMessage], leaf: str) -> list[int]:
    return [position for position, entry in enumerate(entries) if entry.topic.endswith(leaf)]


@pytest.mark.parametrize(
    "extras",
    [
        {"stamp": 10**30},
        {"stamp": -1},
        {"stamp": (2**31 - 1) * 10**9 + 2**32 - 1},
        {"sequence": 10**4299},
        {"sequence": True},
    ],
)
def test_number_out_of_range_is_unreadable(
    recorded: list[BagMessage], tmp_path: Path, extras: dict[str, object]
) -> None:
    changed = list(recorded)
    position = positions_of(recorded, "/frame")[5]
    changed[position] = change_record(recorded[position], **extras)
    # Its cloud has the largest stamp of a header, whose seconds overflow.
    cloud = changed[position + 1]
    changed[position + 1] = cloud._replace(
        data=cloud.data[:4] + struct.pack("<iI", 2**31 - 1, 2**32 - 1) + cloud.data[12:]
    )
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", changed))
    assert (verdict.same, status_of(verdict)) == (True, 2)
    assert "1 message of /cloth_sim/frame cannot be read: its " in verdict.missing[0]


def test_restarted_node_without_snapshot_is_not_the_same(recorded: list[BagMessage], tmp_path: Path) -> None:
    second = without(stream(session="ab"), "/snapshot", 0, 1, 2)
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", [*recorded, *second]))
    assert (verdict.frames, verdict.same, status_of(verdict)) == (COUNT, True, 2)
    sentence = "no snapshot before frame 1, with which the node began anew; nothing behind them is run"
    assert verdict.missing == [sentence]


def test_two_nodes_of_one_name_are_not_the_same(recorded: list[BagMessage], tmp_path: Path) -> None:
    both = [entry for pair in zip(recorded, stream(session="ab"), strict=True) for entry in pair]
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", both))
    assert status_of(verdict) == 2
    assert any("late or with another node's of this name, and were not run" in entry for entry in verdict.missing)


def test_cloud_of_another_stamp_is_not_passed(recorded: list[BagMessage], tmp_path: Path) -> None:
    for leaf in ("/points", "/wrench"):
        changed = list(recorded)
        for position in positions_of(recorded, leaf)[10:20]:
            stamp = struct.unpack_from("<iI", recorded[position].data, 4)
            changed[position] = with_stamp(recorded[position], stamp[0] * 10**9 + stamp[1] + 1)
        verdict = verify_one(write_bag(tmp_path / "bag.mcap", changed))
        assert (verdict.frames, verdict.same, status_of(verdict)) == (COUNT, True, 2)
        assert any("the frames of 10 messages of /cloth_sim" in entry for entry in verdict.missing)


@pytest.mark.parametrize("leaf", ["/points", "/wrench"])
@pytest.mark.parametrize("size", [0, 3, 11])
def test_message_without_a_stamp_is_not_passed(
    recorded: list[BagMessage], tmp_path: Path, leaf: str, size: int
) -> None:
    changed = list(recorded)
    position = positions_of(recorded, leaf)[50]
    changed[position] = recorded[position]._replace(data=recorded[position].data[:size])
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", changed))
    assert (verdict.frames, verdict.same, status_of(verdict)) == (COUNT, True, 2)


def test_clouds_that_all_have_other_stamps_are_not_passed(recorded: list[BagMessage], tmp_path: Path) -> None:
    changed = [with_stamp(entry, 17) if entry.topic.endswith("/points") else entry for entry in recorded]
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", changed))
    assert (verdict.frames, verdict.clouds, status_of(verdict)) == (COUNT, 0, 2)


@pytest.mark.parametrize("leaf", ["/points", "/wrench", "/frame"])
def test_second_message_with_another_content_is_not_passed(
    recorded: list[BagMessage], tmp_path: Path, leaf: str
) -> None:
    changed = list(recorded)
    position = positions_of(recorded, leaf)[7]
    entry = recorded[position]
    is_frame = leaf == "/frame"
    repetition = change_record(entry, digest="0" * 32) if is_frame else entry._replace(data=entry.data[:-9] + b"!" * 9)
    changed.insert(position + 1, repetition)
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", changed))
    assert (verdict.frames, verdict.same, status_of(verdict)) == (COUNT, True, 2)


def test_snapshot_behind_the_last_frame_is_compared(recorded: list[BagMessage], tmp_path: Path) -> None:
    maker = MessageMaker(scene())
    maker.sequence = COUNT
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", [*recorded, maker.snapshot()]))
    assert (dict(verdict.differing), status_of(verdict)) == ({"snapshot": 1}, 1)


def test_snapshot_of_other_parameters_is_a_difference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maker = MessageMaker(scene())
    entries = [maker.snapshot(), *(entry for _ in range(5) for entry in maker.frame())]
    dump = parameter_file.dump
    monkeypatch.setattr(parameter_file, "dump", lambda values: dump({**values, "air.drag": 0.7}))
    entries.append(maker.snapshot())
    monkeypatch.undo()
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", [*entries, *maker.frame()]))
    assert (dict(verdict.differing), status_of(verdict)) == ({"snapshot": 1}, 1)
    assert verdict.first_reason == "the snapshot behind it, by its air.drag"


@pytest.mark.parametrize("is_first", [True, False])
def test_each_topology_is_compared(recorded: list[BagMessage], tmp_path: Path, is_first: bool) -> None:
    data = bytearray(recorded[0].data)
    data[-9] ^= 1
    changed = recorded[0]._replace(data=bytes(data))
    entries = [changed, *recorded] if is_first else [*recorded, changed]
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", entries))
    assert (dict(verdict.differing), status_of(verdict)) == ({"topology": 1}, 1)


def test_many_gaps_are_reported_in_few_sentences(recorded: list[BagMessage], tmp_path: Path) -> None:
    first = recorded[positions_of(recorded, "/frame")[0]]
    gaps = [change_record(first, sequence=2 * k) for k in range(500)]
    verdict = verify_one(write_bag(tmp_path / "bag.mcap", [recorded[1], *gaps]))
    assert len(verdict.missing) == 21
    assert verdict.missing[-1] == "479 further gaps of the records"


def test_messages_that_wait_for_frames_need_bounded_memory(
    recorded: list[BagMessage], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cloth_sim_ros.verify.bag._MAX_WAITING_BYTES", 300_000)
    maker = MessageMaker(scene())
    snapshots = []
    for sequence in range(1000, 1400):
        maker.sequence = sequence
        snapshots.append(maker.snapshot())
    cloud = recorded[positions_of(recorded, "/points")[0]]
    # Clouds of one stamp, and snapshots of frames that do not come.
    clouds = [with_stamp(cloud, 5)._replace(data=cloud.data + bytes(10_000)) for _ in range(1000)]
    path = write_bag(tmp_path / "bag.mcap", [*snapshots, *clouds, *recorded])
    tracemalloc.start()
    try:
        verdict = verify_one(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (verdict.frames, verdict.clouds) == (COUNT, COUNT)
    assert peak < 4e6
