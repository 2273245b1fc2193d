# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks peers-contact` without peers: synthetic motions, short product runs, a stand-in engine."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from support.problems import PERIOD

from benchmarks.__main__ import main
from benchmarks.peers import contact as peers_contact
from benchmarks.peers import contact_scenes as peer_scenes
from benchmarks.peers import environment as peer_environment
from benchmarks.peers.contact import ContactResult, EngineRecording
from benchmarks.peers.contact_scenes import ContactScene
from benchmarks.peers.environment import Peer, PeerFailed
from benchmarks.peers.solvers import CONTACT_PEERS
from cloth_sim_ros.physics.contact.obstacles import Obstacle
from cloth_sim_ros.physics.model.sheets.grid import grid_triangles
from validation.report import Report

TRIANGLE = np.array([[0, 1, 2]])
RESOLUTION = 8

# It sinks by 60 mm/s, if it is coarse only with steps of over 3 ms. Held particles follow their path. Other variants
# are its faults.
ENGINE = """
import time

import numpy as np


class ContactEngine:
    distributions = ("numpy",)

    def __init__(self, sheet, step, variant):
        if variant == "raises":
            raise RuntimeError("no such solver")
        self.places, self.held = sheet["positions"].copy(), sheet["held"]
        self.pad_places, self.step, self.variant = sheet["pad_places"], step, variant
        self.sinks = 0.0 if variant == "coarse" and step < 3e-3 else 0.06 * step
        self.way, self.n_calls = None, 0

    def lead(self, begin, end, steps):
        self.way = [begin + (k + 1) / steps * (end - begin) for k in range(steps)]

    def let_go(self):
        self.way = None

    def advance(self, steps):
        self.n_calls += 1
        time.sleep(2.2 if self.variant == "slow" and self.n_calls == 3 else 0.0)
        for _ in range(steps):
            self.places[:, 2] -= self.sinks
            if self.way:
                self.places[self.held] = self.way[0]
                self.way = self.way[1:] or self.way
        if self.variant == "nan":
            self.places[0] = float("nan")

    def positions(self):
        return self.places.copy()

    def pads(self):
        return self.pad_places

    def remarks(self):
        return ["was watched"]
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment whose Python is this one."""
    folder = tmp_path_factory.mktemp("environment")
    (folder / "bin").mkdir()
    python = folder / "bin" / "python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    python.chmod(0o755)
    return folder


@pytest.fixture
def stand_in(tmp_path: Path) -> Peer:
    script = tmp_path / "engine.py"
    script.write_text(ENGINE)
    apart = {"fold": "its layers are one"}
    return Peer("Stand-in", "newton", "good", "is no cloth at all", script=str(script), apart=apart, comparable=False)


def shortened_scene(name: str, frames: int) -> ContactScene:
    """Return a scene cut to some frames."""
    return attrs.evolve(peer_scenes.CONTACT_SCENES[name](RESOLUTION), duration=frames * PERIOD)


def synthetic_recording(contact_scene: ContactScene, frames: np.ndarray, **run: Any) -> EngineRecording:
    """Return a recording of given positions with static pads."""
    pads = np.broadcast_to(contact_scene.pad_positions, (len(frames), *contact_scene.pad_positions.shape))
    run = {"steps": 1, "whole": True, "stretch": 1.0, "n_steps": len(frames) - 1, "wall": 1.0, "cpu": 0.5, **run}
    return EngineRecording(frames=frames, pads=pads, **run)


def test_ball_depth_includes_triangle_interiors() -> None:
    # Corners 3 mm outside a ball of 0.1 m, the triangle's middle 0.1 m from the centre less 4 mm.
    height, around = 0.096, math.sqrt(0.103**2 - 0.096**2)
    angles = 2.0 * np.pi * np.arange(3) / 3.0
    deep = np.stack([around * np.cos(angles), around * np.sin(angles), np.full(3, height)], axis=1)
    outside = deep + np.array([0.0, 0.0, 0.1])
    depth = peers_contact.depth_in_ball(np.array([outside, deep, outside]), TRIANGLE, 0.1)
    assert depth == pytest.approx(0.004)
    assert peers_contact.depth_in_ball(np.array([outside]), TRIANGLE, 0.1) == 0.0
    # Without area the nearest edge counts, here its far end. A triangle that is a point is ignored.
    flat = np.array([[0.0, 0.0, 0.2], [0.0, 0.0, 0.15], [0.0, 0.0, 0.09]])
    both = np.array([[0, 1, 2], [0, 0, 0]])
    assert peers_contact.depth_in_ball(flat[None], both, 0.1) == pytest.approx(0.01)


def test_depth_is_of_the_worst_frame() -> None:
    table = Obstacle(name="table", shape="plane")
    frames = np.zeros((3, 2, 3))
    frames[:, :, 2] = [[0.1, 0.2], [-0.003, 0.2], [0.1, -0.001]]
    assert peers_contact.depth(frames, table, np.zeros(3)) == pytest.approx(0.003)
    assert peers_contact.depth(frames[:1], table, np.zeros(3)) == 0.0
    # A moving solid: its position in each frame counts.
    places = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.005], [0.0, 0.0, 0.0]])
    assert peers_contact.depth(frames, table, places) == pytest.approx(0.001)


def test_crossings_list_self_intersecting_frames() -> None:
    plane = np.stack(np.meshgrid(np.arange(6), np.arange(6), indexing="ij"), axis=-1).reshape(-1, 2) * 0.02
    flat = np.column_stack([plane, np.zeros(36)])
    triangles = grid_triangles(6, 6, "both")
    folded = flat.copy()
    over = folded[:, 0] > 0.05
    folded[over, 0] = 0.0999 - folded[over, 0]
    folded[over, 1] += 0.003
    folded[over, 2] = 0.002
    through = folded.copy()
    through[33, 2] = -0.002
    assert peers_contact.crossings(np.array([flat, folded, through, folded]), triangles, flat) == [2]


def test_ball_creep_is_of_the_fastest_particle() -> None:
    first = np.array([[0.0, 0.0, 0.102], [0.102, 0.0, 0.0], [0.0, 0.0, 0.12], [0.0, 0.102, 0.0]])
    last = first + np.array([[1e-6, 0.0, 0.0], [0.0, 3e-6, 0.0], [1e-3, 0.0, 0.0], [0.0, 0.01, 0.0]])
    # Of the last two particles one was never on the ball, and one left it.
    creep = peers_contact.creep_on_ball(np.array([first, first, last]), 0.5, 0.1, 0.003)
    assert creep == pytest.approx(6e-6, rel=1e-3)
    assert math.isnan(peers_contact.creep_on_ball(np.array([first, last])[:, 2:3], 0.5, 0.1, 0.003))


def test_pinch_result_uses_the_clamped_particles() -> None:
    contact_scene = peer_scenes.pinch(RESOLUTION)
    start, pad, places = contact_scene.start, contact_scene.pads[0], contact_scene.pad_positions
    between = peers_contact.between_pads(start, pad, places)
    assert (start[between, 2] >= -peer_scenes.CLAMPED_HEIGHT).all()
    assert (np.abs(start[between, 0]) <= 0.5 * peer_scenes.PAD_SIZE[0]).all()
    assert between.sum() == 4
    frames = np.repeat(start[None], 601, axis=0)
    seconds = np.arange(601) * PERIOD
    # The clamped part settles by 1 mm and then creeps by 5 um/s; the hanging part swings.
    frames[:, between, 2] -= (1e-3 * (seconds > 1.0) + 5e-6 * np.clip(seconds - 2.0, 0.0, None))[:, None]
    frames[:, ~between, 2] += 0.01 * np.sin(seconds)[:, None]
    result = peers_contact.evaluate(contact_scene, "made up", synthetic_recording(contact_scene, frames))
    assert result.creep == pytest.approx(5e-6)
    assert (result.depth, result.outcome, result.violations) == (0.0, "", [])
    assert result.recording.cpu_factor == pytest.approx(20.0)
    # From 0.5 s on all particles are below the pads: the creep is unknown.
    frames[31:, :, 2] -= 0.06
    dropped = peers_contact.evaluate(contact_scene, "made up", synthetic_recording(contact_scene, frames))
    assert dropped.outcome == "dropped at 0.52 s"
    assert math.isnan(dropped.creep)
    early = peers_contact.evaluate(contact_scene, "made up", synthetic_recording(contact_scene, frames[:31]))
    assert (early.outcome, math.isnan(early.creep)) == ("ended at 0.50 s of 10", True)
    into = frames[:31].copy()
    into[7, :, 1] += 0.003
    assert peers_contact.evaluate(
        contact_scene, "made up", synthetic_recording(contact_scene, into)
    ).depth == pytest.approx(6e-4)


def test_product_failures_are_violated_guarantees() -> None:
    contact_scene = peer_scenes.fold(RESOLUTION)
    report = Report("", "")
    frames = np.repeat(contact_scene.start[None], 181, axis=0)
    peers_contact.check_product(
        peers_contact.evaluate(contact_scene, "ours", synthetic_recording(contact_scene, frames)), report
    )
    assert report.failures == []
    frames[5, 20, 2] = -1e-4
    # The carried edge ends below the other, the next row above it.
    frames[9, :RESOLUTION] = frames[9, -2 * RESOLUTION : -RESOLUTION] + [0.01, -0.01, -0.001]
    frames[9, RESOLUTION : 2 * RESOLUTION, 2] += 0.005
    result = peers_contact.evaluate(contact_scene, "ours", synthetic_recording(contact_scene, frames))
    assert (result.depth, result.crossed) == (pytest.approx(1e-4), 1)
    peers_contact.check_product(result, report)
    assert report.failures == [
        "fold: a particle of the product is 0.1 mm inside an obstacle",
        "fold: the product intersects itself in 1 frames",
    ]
    held = attrs.evolve(result, scene="pinch", inside=0.0, crossed=None, creep=0.9e-6)
    for creep, count in ((0.9e-6, 2), (math.nan, 2), (1.1e-6, 3), (-1.1e-6, 4)):
        peers_contact.check_product(attrs.evolve(held, creep=creep), report)
        assert len(report.failures) == count
    assert report.failures[2] == "pinch: the product creeps by 1.1 um/s; at most 1"
    peers_contact.check_product(attrs.evolve(held, outcome="dropped at 1.00 s"), report)
    assert report.failures[4] == "pinch: the product is dropped at 1.00 s"
    # On a ball only particles are guaranteed to stay outside; the depth of triangles is only reported.
    peers_contact.check_product(attrs.evolve(held, scene="drape", depth=1e-3), report)
    assert len(report.failures) == 5


def fake_attempt(valid_from: int, late_from: int, **invalid: Any) -> Callable[[int], ContactResult]:
    """Return an engine that violates a limit below `valid_from` steps a frame and is late from `late_from` on."""

    def attempt(steps: int) -> ContactResult:
        fault = invalid if steps < valid_from else {}
        late = steps >= late_from
        fields = {"complete": not late, "outcome": "ended at 0.50 s of 3" if late else "", **fault}
        run = {name: fields.pop(name) for name in ("stretch", "whole") if name in fields}
        recording = synthetic_recording(peer_scenes.drape(RESOLUTION), np.zeros((2, 64, 3)), steps=steps, **run)
        result = ContactResult(scene="drape", engine="made up", recording=recording, depth=0.0, inside=0.0)
        return attrs.evolve(result, **fields)

    return attempt


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ({"depth": 2.1e-4}, "sinks by 0.21 mm"),
        ({"stretch": 1.021}, "stretches by 2.1 %"),
        ({"crossed": 7}, "crosses itself in 7 frames"),
        ({"whole": False, "complete": False, "outcome": "torn after 0.10 s"}, "torn after 0.10 s"),
        ({"outcome": "dropped at 0.10 s"}, "dropped at 0.10 s"),
    ],
)
def test_search_ends_at_the_longest_valid_step(fault: dict[str, Any], text: str) -> None:
    chosen, tried = peers_contact.search(fake_attempt(6, 1000, **fault))
    assert [result.recording.steps for result in tried] == [1, 2, 4, 8, 6, 5]
    assert [result.violations for result in tried] == [[text], [text], [text], [], [], [text]]
    assert (chosen.step, chosen.violations) == ("1/360 s", [])


def test_values_at_the_limits_are_valid() -> None:
    chosen, tried = peers_contact.search(fake_attempt(5, 1000, depth=2e-4, stretch=1.02, crossed=0))
    assert (chosen.step, len(tried)) == ("1/60 s", 1)


def test_search_without_a_valid_step_shows_the_shortest() -> None:
    chosen, tried = peers_contact.search(fake_attempt(1000, 8, depth=3e-4, crossed=2))
    assert [result.recording.steps for result in tried] == [1, 2, 4, 8]
    assert (chosen.step, chosen.violations) == ("1/240 s", ["crosses itself in 2 frames", "sinks by 0.3 mm"])
    assert tried[-1].violations[-1] == "ended at 0.50 s of 3"
    # Nothing ran the whole motion.
    chosen, tried = peers_contact.search(fake_attempt(1, 1))
    assert (chosen.step, chosen.violations, len(tried)) == ("1/60 s", ["ended at 0.50 s of 3"], 1)


def test_fold_reference_precedes_contact_of_layers() -> None:
    frames = peers_contact.fold_reference(20, peer_scenes.TOLERANCE)
    contact_scene = peer_scenes.fold(20, **peer_scenes.PEER_MATERIAL, **{"contact.self": False})
    apart = peers_contact.run_product(attrs.evolve(contact_scene, duration=peers_contact.ERROR_TIMES[-1]), 60.0)
    assert np.abs(frames - apart.frames).max() < 1e-5
    assert 0.0 < peers_contact.deviation(frames, 20) < 1e-6
    moved = frames.copy()
    moved[45, 7, 2] += 1e-3
    assert peers_contact.deviation(moved, 20) == pytest.approx(1e-3, rel=1e-3)
    assert math.isnan(peers_contact.deviation(frames[:60], 20))


def test_edge_path_leads_to_the_opposite_edge() -> None:
    path = peer_scenes.edge_path()
    # The edge is grasped in the first frame.
    assert len(path) == 122
    assert not path[:2].any()
    assert path[-1] == pytest.approx([0.0, -0.3 + peer_scenes.FOLD_SHORTFALL, 1.5 * peer_scenes.THICKNESS])
    assert path[61] == pytest.approx([0.0, 0.5 * path[-1, 1], -0.5 * path[-1, 1] + 0.5 * path[-1, 2]])
    speeds = np.linalg.norm(np.diff(path, axis=0), axis=1) / PERIOD
    assert speeds.max() < 0.5
    assert speeds[[0, 1, -1]].max() < 1e-3


@pytest.mark.parametrize("name", peer_scenes.CONTACT_SCENES)
def test_scene_tables_match_the_product_scene(name: str) -> None:
    contact_scene = peer_scenes.CONTACT_SCENES[name](RESOLUTION)
    tables = contact_scene.tables()
    masses = {"drape": 0.2 * 0.5**2, "fold": 0.2 * 0.3**2, "pinch": 0.2 * 0.18 * 0.09}
    assert tables["masses"].sum() == pytest.approx(masses[name])
    assert (tables["positions"] == contact_scene.scene.starting_state().positions).all()
    assert np.flatnonzero(tables["anchored"]).tolist() == (list(range(56, 64)) if name == "fold" else [])
    assert tables["held"].tolist() == (list(range(8)) if name == "fold" else [])
    assert tables["path"].shape == ((122, 8, 3) if name == "fold" else (1, 0, 3))
    assert len(np.unique(tables["triangles"])) == len(tables["positions"])
    # The product gives bending a share of the stiffness along the threads, which peers' membranes keep.
    springs = contact_scene.scene.model().force("structural").pair_springs
    assert tables["retardation"] == pytest.approx(np.median(springs.damping / springs.rigidity), rel=0.06)


def test_product_carries_and_releases_the_edge() -> None:
    contact_scene = peer_scenes.fold(RESOLUTION)
    path = contact_scene.path[:20] if contact_scene.hold else contact_scene.path
    contact_scene = attrs.evolve(contact_scene, path=path, duration=24 * PERIOD)
    recording = peers_contact.run_product(contact_scene, 60.0)
    assert recording.frames.shape == (25, 64, 3)
    assert recording.simulated == pytest.approx(0.4)
    # Grips of 1000 N/m deflect by far less than the displacement per frame, near the end 0.8 mm.
    off = np.abs(recording.frames[:20, contact_scene.held] - path).max()
    assert off < 0.3 * np.linalg.norm(path[-1] - path[-2], axis=1).min()
    assert recording.frames[19, contact_scene.held, 2].min() > 0.009
    sinking = recording.frames[24, contact_scene.held, 2] - recording.frames[19, contact_scene.held, 2]
    assert sinking.max() < -1e-3
    result = peers_contact.evaluate(contact_scene, "ours", recording)
    assert (result.crossed, result.inside) == (0, 0.0)


def test_product_runs_the_drape_and_the_pinch() -> None:
    drape = shortened_scene("drape", 25)
    drape_recording = peers_contact.run_product(drape, 60.0)
    result = peers_contact.evaluate(drape, "ours", drape_recording)
    assert result.inside == 0.0
    assert np.linalg.norm(drape_recording.frames, axis=2).min() < 0.1 + peer_scenes.THICKNESS
    pinch = shortened_scene("pinch", 12)
    pinch_recording = peers_contact.run_product(pinch, 60.0)
    # The pads are closed and symmetric; the gap is the thickness on either side, less the compression by 4 N.
    assert pinch_recording.pads[0] == pytest.approx(pinch.pad_positions)
    half = pinch_recording.pads[-1, 0, 1] - 0.5 * peer_scenes.PAD_SIZE[1]
    assert 0.5 * peer_scenes.THICKNESS < half < peer_scenes.THICKNESS
    assert pinch_recording.pads[-1, 1] == pytest.approx(pinch_recording.pads[-1, 0] * [1.0, -1.0, 1.0])
    assert pinch_recording.frames[-1, :, 2].max() > -2e-3


def test_product_run_stops_at_the_time_limit() -> None:
    recording = peers_contact.run_product(shortened_scene("drape", 1000), 1e-9)
    assert (len(recording.frames), recording.simulated) == (2, pytest.approx(PERIOD))


def test_product_run_never_sleeps() -> None:
    contact_scene = shortened_scene("pinch", 150)
    contact_scene = attrs.evolve(contact_scene, scene=contact_scene.scene.changed({"air.drag": 50.0}))
    recording = peers_contact.run_product(contact_scene, 60.0)
    # Each frame differs from the one before.
    assert (np.diff(recording.frames, axis=0) != 0.0).any(axis=(1, 2)).all()


def test_peer_is_recorded_frame_by_frame(stand_in: Peer, environment: Path) -> None:
    contact_scene = attrs.evolve(peer_scenes.fold(RESOLUTION), duration=4 * PERIOD)
    contact_scene = attrs.evolve(contact_scene, path=contact_scene.path[20:23])
    recording = peers_contact.run_peer(stand_in, contact_scene, 4, 60.0, environment=environment)
    sunk = recording.frames - contact_scene.start
    assert sunk[:, -1, 2] == pytest.approx([0.0, -1e-3, -2e-3, -3e-3, -4e-3])
    held = recording.frames[:, contact_scene.held]
    assert held[1:3] == pytest.approx(contact_scene.path[1:])
    # After the release it sinks like the others.
    assert held[4] == pytest.approx(contact_scene.path[2] - [0.0, 0.0, 2e-3])
    assert (recording.simulated, recording.whole) == (pytest.approx(4 * PERIOD), True)
    longest = np.linalg.norm(np.diff(recording.frames[2, [0, RESOLUTION]], axis=0)) / (0.3 / (RESOLUTION - 1))
    assert recording.stretch == pytest.approx(longest)
    assert recording.remarks == ["was watched"]
    assert recording.versions == {"numpy": np.__version__}


def test_peer_stops_at_time_limit_or_nan_positions(stand_in: Peer, environment: Path) -> None:
    contact_scene = shortened_scene("drape", 100)
    slow_peer = attrs.evolve(stand_in, variant="slow")
    slow = peers_contact.run_peer(slow_peer, contact_scene, 4, 2.0, environment=environment)
    # Three of the four steps of the first frame.
    assert len(slow.frames) == 1
    assert slow.simulated == pytest.approx(0.75 * PERIOD)
    assert peers_contact.evaluate(contact_scene, "slow", slow).outcome == "ended at 0.00 s of 1.66667"
    not_finite = peers_contact.run_peer(
        attrs.evolve(stand_in, variant="nan"), contact_scene, 4, 60.0, environment=environment
    )
    assert (not_finite.whole, len(not_finite.frames)) == (False, 1)
    assert peers_contact.evaluate(contact_scene, "lost", not_finite).outcome == "torn after 0.00 s"
    with pytest.raises(PeerFailed, match="Stand-in: ended with status 1: RuntimeError: no such solver"):
        peers_contact.run_peer(
            attrs.evolve(stand_in, variant="raises"), contact_scene, 4, 60.0, environment=environment
        )


@pytest.fixture
def shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    def cut(make: Callable[[int], ContactScene]) -> Callable[[int], ContactScene]:
        return lambda resolution: attrs.evolve(make(resolution), duration=3 * PERIOD)

    cuts = {name: cut(make) for name, make in peer_scenes.CONTACT_SCENES.items()}
    monkeypatch.setattr(peers_contact, "CONTACT_SCENES", cuts)


def test_report_lists_failed_and_absent_engines(
    stand_in: Peer, environment: Path, shortened: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    coarse = attrs.evolve(stand_in, variant="coarse")
    sinking = attrs.evolve(stand_in, name="Sinking")
    broken = attrs.evolve(stand_in, name="Broken", variant="raises")
    absent = attrs.evolve(stand_in, name="Absent", package="mujoco")
    monkeypatch.setattr(peers_contact, "CONTACT_PEERS", (coarse, sinking, broken, absent))
    monkeypatch.setattr(peer_environment, "prepare", lambda *_: {"mujoco": "there is no wheel of it"})
    monkeypatch.setattr(peer_environment, "_MAX_STEPS", 8)
    file = tmp_path / "report.json"
    options = ["--resolution", str(RESOLUTION), "--environment", str(environment), "--json", str(file)]
    assert main(["peers-contact", *options, "--peers", "newton", "mujoco", "--scenes", "drape", "fold"]) == 0
    written = json.loads(file.read_text())
    table, tried = written["tables"]
    rows = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
    names = ["cloth_sim_ros", "Stand-in", "Sinking", "Broken", "Absent"]
    assert [(row["scene"], row["engine"]) for row in rows] == [
        (scene, name) for scene in ("drape", "fold") for name in names
    ]
    assert [row["outcome"] for row in rows[:5]] == ["", "", "", "FAILED", "ABSENT"]
    assert rows[3].keys() == rows[0].keys()
    assert [row["seconds"] for row in rows[:3]] == [pytest.approx(0.05)] * 3
    # The table is at 0, the sheet starts a thickness above.
    product_row, stand_in_row, sinking_row = rows[5:8]
    assert (product_row["step"], product_row["deepest mm"], product_row["frames crossed"]) == ("tolerance 1 mm", 0, 0)
    assert product_row["error mm"] < 0.1
    assert (stand_in_row["step"], stand_in_row["deepest mm"], stand_in_row["outcome"]) == ("1/360 s", 0, "")
    assert (sinking_row["step"], sinking_row["deepest mm"]) == ("1/480 s", pytest.approx(1.0))
    assert sinking_row["outcome"] == "no valid step in 60 s: sinks by 1 mm"
    assert stand_in_row["error mm"] == "-"
    steps = [(row[2], row[-1]) for row in tried["rows"] if row[:2] == ["fold", "Stand-in"]]
    deep = "sinks by 1 mm"
    assert steps == [*((f"1/{60 * n} s", deep) for n in (1, 2, 4)), ("1/480 s", ""), ("1/360 s", ""), ("1/300 s", deep)]
    notes = written["notes"]
    assert "ABSENT: mujoco: there is no wheel of it" in notes
    assert "FAILED: fold: Broken: ended with status 1: RuntimeError: no such solver" in notes
    assert "Stand-in: is no cloth at all" in notes
    assert "fold: Stand-in: its layers are one" in notes
    assert "drape: Stand-in was watched" in notes
    assert written["failures"] == []


def test_without_peers_nothing_is_installed(
    shortened: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def refuse(*_: object) -> dict[str, str]:
        raise AssertionError("nothing is to be installed")

    monkeypatch.setattr(peer_environment, "prepare", refuse)
    assert main(["peers-contact", "--resolution", str(RESOLUTION), "--peers", "--scenes", "pinch"]) == 0
    assert "| pinch | cloth_sim_ros |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--seconds", "0"], "--seconds: 0; it must be above 0"),
        (["--resolution", "7"], "--resolution: 7; it must be an integer of at least 8"),
    ],
)
def test_numbers_out_of_range_are_refused(options: list[str], said: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        main(["peers-contact", *options])
    assert said in capsys.readouterr().err


def test_contact_peer_scripts_do_not_import_the_package(environment: Path) -> None:
    folder = Path(peers_contact.__file__).parent
    assert {peer.package for peer in CONTACT_PEERS} == {*peers_contact.PACKAGES}
    for name in {peer.script for peer in CONTACT_PEERS}:
        script = (
            f"import runpy, sys; runpy.run_path({str(folder / name)!r}); "
            "print(sorted(n for n in sys.modules if n.split('.')[0] in ('cloth_sim_ros', 'scipy', 'attrs')))"
        )
        command = [str(peer_environment.python_of(environment)), "-I", "-c", script]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        assert done.stdout == "[]\n", name
    for peer in CONTACT_PEERS:
        assert peer.apart.keys() <= peer_scenes.CONTACT_SCENES.keys()
