# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Re-run of sessions: equal to the last bit; a single flipped bit is found."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.random_contact import threads
from support.random_sessions import make_random_session
from support.session_maker import NODE, Change, SessionMaker, carried_corner, make_grasp

from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session.cdr import decode_string, encode_string
from cloth_sim_ros.session.writer import WriterOptions
from cloth_sim_ros.simulation.environment import environment
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.verify.main import main
from cloth_sim_ros.verify.run import Verdict, verify

SMALL = {"cloth.resolution": [8, 9], "cloth.size": [0.4, 0.45], "material.stretch_modulus": 100.0,
         "material.shear_modulus": 10.0, "bending.stiffness": 0.5, "tolerance": 1e-4}  # fmt: skip
FRAMES = 40
POINTS, FRAME = f"{NODE}/points", f"{NODE}/frame"


def _make(
    folder: Path,
    *,
    change: Callable[[int], Change | None] = lambda _k: None,
    split_at: int = -1,
    options: WriterOptions | None = None,
    metadata: dict[str, str] | None = None,
    shown: dict[str, Any] | None = None,
) -> SessionMaker:
    """Write a grasp session of FRAMES frames; `change` returns the alteration of a frame's messages by frame index."""
    scene = Scene.from_parameters(SMALL | (shown or {}))
    maker = SessionMaker(folder, scene, options=options, metadata=metadata)
    for k, events in enumerate(carried_corner(scene, FRAMES / 60.0), start=1):
        spoil = change(k)
        maker.add(events, **({"change": spoil} if spoil else {}))
        if k == split_at:
            maker.split()
    return maker


def _verify(maker: SessionMaker) -> Verdict:
    maker.finish()
    return verify(maker.paths)


def _flip(data: bytes, byte: int, bit: int = 0) -> bytes:
    return data[:byte] + bytes([data[byte] ^ 1 << bit]) + data[byte + 1 :]


def _spoil_at(frame: int, topic: str, spoil: Callable[[bytes], bytes | None]) -> Callable[[int], Change | None]:
    def change(k: int) -> Change | None:
        return (lambda name, data: spoil(data) if name == topic else data) if k == frame else None

    return change


def test_session_reruns_to_the_last_bit(tmp_path: Path) -> None:
    verdict = _verify(_make(tmp_path))
    assert verdict.same
    assert not verdict.damaged
    assert (verdict.frames, verdict.clouds, verdict.different) == (FRAMES, FRAMES, 0)
    assert verdict.missing == []
    assert verdict.simulated == pytest.approx(FRAMES / 60.0)


@pytest.mark.parametrize("seed", range(10))
def test_random_sessions_rerun_to_the_last_bit(tmp_path: Path, seed: int) -> None:
    verdict = verify(make_random_session(tmp_path, seed, hinges=seed % 2 == 1))
    assert verdict.same, verdict.first_reason
    # A file that was cut off lacks its last chunk.
    assert verdict.frames == verdict.clouds == 60 or verdict.missing
    assert verdict.frames - 1 <= verdict.clouds <= verdict.frames
    assert verdict.frames > 0
    assert not verdict.damaged


@pytest.mark.parametrize("seed", [1, 2])
def test_random_contact_sessions_rerun_with_any_threads(tmp_path: Path, seed: int) -> None:
    paths = make_random_session(tmp_path, seed, frames=20, contact=True)
    for count in (1, 8):
        with threads(count):
            verdict = verify(paths)
        assert verdict.same, verdict.first_reason
        assert verdict.frames


def test_obstacles_changed_before_the_first_markers_verify(tmp_path: Path) -> None:
    # The first frame removes an obstacle: no marker of it was sent, and none is deleted.
    verdict = verify(make_random_session(tmp_path, 26, frames=8, contact=True))
    assert verdict.same, verdict.first_reason


@pytest.mark.parametrize("bit", [0, 22, 31])
def test_one_flipped_bit_in_a_cloud_is_found(tmp_path: Path, bit: int) -> None:
    # Last coordinate of the last point, from the lowest bit to the sign.
    spoil = _spoil_at(17, POINTS, lambda data: _flip(data, _end_of_points(data) - 4 + bit // 8, bit % 8))
    verdict = _verify(_make(tmp_path, change=spoil))
    assert (verdict.first_frame, verdict.different) == (17, 1)
    assert "cloud" in verdict.first_reason
    assert verdict.largest_deviation > 0.0


def _end_of_points(data: bytes) -> int:
    # Only is_dense, one byte, follows the points.
    return len(data) - 1


def test_one_flipped_bit_in_an_event_is_found(tmp_path: Path) -> None:
    def spoil(data: bytes) -> bytes:
        record = json.loads(decode_string(data))
        target = next(event for event in record["events"] if event["kind"] == "target")
        # Lowest bit of a coordinate.
        target["position"][1] = float.fromhex((target["position"][1]).hex()) * (1.0 + 2.0**-52)
        return encode_string(json.dumps(record))

    verdict = _verify(_make(tmp_path, change=_spoil_at(25, FRAME, spoil)))
    assert verdict.first_frame == 25
    # A different motion stays different.
    assert verdict.different == FRAMES - 25 + 1


@pytest.mark.parametrize("byte", [-9, -32, -48])
def test_one_flipped_bit_in_a_received_target_is_found(tmp_path: Path, byte: int) -> None:
    topic = f"{NODE}/gripper/target"
    spoil = _spoil_at(12, topic, lambda data: _flip(data, len(data) + byte))
    verdict = _verify(_make(tmp_path, change=spoil))
    assert (verdict.first_frame, verdict.different) == (12, 1)
    assert "not commanded" in verdict.first_reason


def test_one_flipped_bit_in_a_received_grasp_is_found(tmp_path: Path) -> None:
    spoil = _spoil_at(9, f"{NODE}/gripper/grasp", lambda data: _flip(data, 4))
    verdict = _verify(_make(tmp_path, change=spoil))
    assert verdict.first_frame == 9
    assert "commanded to open" in verdict.first_reason


def test_velocities_in_the_cloud_are_compared(tmp_path: Path) -> None:
    shown = {"points.velocity": True}
    assert _verify(_make(tmp_path / "plain", shown=shown)).same
    spoil = _spoil_at(20, f"{NODE}/points", lambda data: _flip(data, len(data) - 8))
    verdict = _verify(_make(tmp_path / "spoilt", shown=shown, change=spoil))
    assert (verdict.first_frame, verdict.different) == (20, 1)
    assert "by the velocity of particle" in verdict.first_reason


def test_one_flipped_bit_in_a_wrench_is_found(tmp_path: Path) -> None:
    spoil = _spoil_at(20, f"{NODE}/gripper/wrench", lambda data: _flip(data, len(data) - 8))
    verdict = _verify(_make(tmp_path, change=spoil))
    assert (verdict.first_frame, verdict.first_reason) == (20, "the wrench on gripper")


@pytest.mark.parametrize("key", ["digest", "steps", "time", "paused", "integrator", "tolerance"])
def test_changed_frame_record_is_found(tmp_path: Path, key: str) -> None:
    changed = {"digest": "0" * 32, "steps": 1, "time": 0.7, "paused": True, "integrator": "other", "tolerance": 1.0}

    def spoil(data: bytes) -> bytes:
        return encode_string(json.dumps({**json.loads(decode_string(data)), key: changed[key]}))

    verdict = _verify(_make(tmp_path, change=_spoil_at(30, FRAME, spoil)))
    assert (verdict.first_frame, verdict.different) == (30, 1)
    assert key in verdict.first_reason


def test_grasps_by_a_service_are_no_difference(tmp_path: Path) -> None:
    # A service call leaves no message, only the event.
    topic = f"{NODE}/gripper/grasp"
    verdict = _verify(_make(tmp_path, change=lambda _k: lambda name, data: None if name == topic else data))
    assert verdict.same


def test_later_recording_forgives_earlier_targets(tmp_path: Path) -> None:
    maker = _make(tmp_path, split_at=20)
    maker.finish()
    verdict = verify(maker.paths[1:])
    assert verdict.same
    assert verdict.frames == FRAMES - 20


def test_files_of_a_split_session_run_together_and_alone(tmp_path: Path) -> None:
    maker = _make(tmp_path, split_at=15)
    together = _verify(maker)
    assert together.same
    assert together.frames == FRAMES
    assert [verify([path]).frames for path in maker.paths] == [15, FRAMES - 15]


def test_killed_session_is_verified_to_its_end(tmp_path: Path) -> None:
    path = _make(tmp_path, options=WriterOptions(chunk_bytes=8192, sync_seconds=0.0)).cut()
    whole = path.read_bytes()
    for part, least in ((1.0, 30), (0.8, 10)):
        path.write_bytes(whole[: int(part * len(whole))])
        verdict = verify([path])
        assert verdict.same
        assert not verdict.damaged
        assert least < verdict.frames < FRAMES
        assert "cut off" in verdict.missing[0]


def test_missing_frames_end_the_rerun(tmp_path: Path) -> None:
    def leave_out(_topic: str, _data: bytes) -> None:
        return None

    verdict = _verify(_make(tmp_path, change=lambda k: leave_out if k in (21, 22) else None))
    assert verdict.damaged
    assert verdict.frames == 20
    assert "frames 21 to 22 are missing" in verdict.missing[0]


def test_frame_that_cannot_run_is_a_difference(tmp_path: Path) -> None:
    def spoil(data: bytes) -> bytes:
        record = json.loads(decode_string(data))
        record["events"] = [{"kind": "grasp", "gripper": "nobody", "closed": True}]
        return encode_string(json.dumps(record))

    verdict = _verify(_make(tmp_path, change=_spoil_at(5, FRAME, spoil)))
    assert verdict.first_frame == 5
    assert "nobody" in verdict.first_reason


def test_other_code_is_named(tmp_path: Path) -> None:
    verdict = _verify(_make(tmp_path, metadata={"source": "0", "python": "3.1"}))
    assert verdict.environment == [f"its code 0 -> {environment()['source']}"]


def test_verify_reports_an_equal_rerun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = make_grasp(tmp_path, seconds=0.2, cloth__resolution=[8, 8])
    assert main([str(path)]) == 0
    assert "grasp_000.mcap: 12 frames and 12 clouds came out the same to the last bit" in capsys.readouterr().out


def test_verify_reports_difference_and_continues(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = _make(tmp_path / "bad", change=_spoil_at(17, POINTS, lambda data: _flip(data, len(data) - 3)))
    bad.finish()
    good = _make(tmp_path / "good", split_at=20)
    good.finish()
    assert main([str(path) for path in (*bad.paths, *good.paths)]) == 1
    first, second = capsys.readouterr().out.strip().splitlines()
    assert "differs from frame 17 (0.283 s) on" in first
    assert "1 frame differs" in first
    # The two files of the other session form a group.
    assert f"{FRAMES} frames and {FRAMES} clouds came out the same" in second


def test_verify_refuses_files_that_are_no_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    foreign_file = tmp_path / "other.mcap"
    foreign_file.write_bytes(b"no session")
    assert main([str(foreign_file), str(tmp_path / "absent.mcap")]) == 2
    errors = capsys.readouterr().err
    assert "other.mcap is not an MCAP file" in errors
    assert "absent.mcap does not exist" in errors


def test_flipped_bit_on_disk_is_damage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maker = _make(tmp_path)
    path = maker.finish()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert main([str(path)]) == 2
    assert os.path.basename(path) in capsys.readouterr().out


def test_targets_in_another_frame_are_not_compared(tmp_path: Path) -> None:
    # They were transformed before they took effect; here an altered frame_id has the same result.
    def spoil(name: str, data: bytes) -> bytes:
        return data.replace(b"world", b"other", 1) if name == f"{NODE}/gripper/target" else data

    scene = Scene.from_parameters(SMALL)
    maker = SessionMaker(tmp_path, scene)
    corner = tuple(scene.initial_positions()[-1].tolist())
    events: list[Event] = [Target("gripper", corner, (0.0, 0.0, 0.0, 1.0)), Grasp("gripper", True)]
    maker.add(events, change=lambda name, data: _flip(spoil(name, data), len(data) - 9) if "target" in name else data)
    assert _verify(maker).same
