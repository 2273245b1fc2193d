# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks peers` without a network and without peers: a stand-in engine in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from support.problems import Problem, corner_drop, curtain
from support.reference import Reference

from benchmarks.__main__ import main
from benchmarks.peers import environment as peer_environment
from benchmarks.peers import runner as peer_run
from benchmarks.peers import throughput as peers
from benchmarks.peers.environment import Attempt, EnvironmentUnusable, Peer, PeerFailed
from benchmarks.peers.solvers import PEERS, REQUIREMENTS
from benchmarks.speed import curtain as speed_curtain

# Its sheet grows with every step above the stability limit; variants are its faults.
ENGINE = """
import os
import signal
import time


class Engine:
    distributions = ("numpy",)

    def __init__(self, sheet, step, variant):
        print("engines talk", flush=True)
        if variant == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if variant == "raises":
            raise RuntimeError("no such solver")
        self.places = sheet["positions"].copy()
        if variant == "turned":
            self.places = self.places[::-1].copy()
        self.variant = variant
        self.grows = 1.02 if step > 1e-3 else 1.0

    def advance(self, steps):
        time.sleep(0.02 if self.variant == "slow" else 0.0)
        self.places *= self.grows**steps
        if self.variant == "nan":
            self.places[-1] = float("nan")

    def positions(self):
        return self.places

    def remarks(self):
        return ["was watched"]
"""


@pytest.fixture(scope="module", autouse=True)
def _one_reference() -> Iterator[None]:
    """Solve each scene's reference once for all tests of this file."""
    solve, solved = speed_curtain.trusted, {}

    def trusted(problem: Problem) -> Reference:
        key = problem.name, problem.frames
        if key not in solved:
            solved[key] = solve(problem)
        return solved[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed_curtain, "trusted", trusted)
        patch.setattr(speed_curtain, "SCORED_FRAMES", {16: 6})
        yield


@pytest.fixture(scope="module")
def sheet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("sheet") / "sheet.npz"
    np.savez(file, **peer_environment.sheet_tables(curtain(16)))
    return file


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
    return Peer("Stand-in", "newton", "good", "is no cloth at all", script=str(script), first_steps=lambda n: 8)


def attempt(peer: Peer, sheet: Path, environment: Path, steps: int, **options: Any) -> Attempt:
    return peer_environment.attempt(
        peer, sheet, steps, environment=environment, **{"frames": 3, "seconds": 60.0, "whole": 1.5, **options}
    )


def test_sheet_tables_match_the_product_sheet() -> None:
    tables = peer_environment.sheet_tables(curtain(16))
    assert tables["masses"].sum() == pytest.approx(0.2)
    assert tables["gravity"].tolist() == [0.0, 0.0, -9.81]
    assert tables["drag"] == 1.0
    assert np.flatnonzero(tables["anchored"]).tolist() == list(range(16))
    assert np.flatnonzero(peer_environment.sheet_tables(corner_drop(16))["anchored"]).tolist() == [0, 15]
    assert len(tables["pairs"]) == 2 * 16 * 15 + 2 * 15 * 15 + 2 * 16 * 14
    lengths = np.linalg.norm(np.subtract(*tables["positions"][tables["pairs"].T]), axis=1)
    assert lengths == pytest.approx(tables["rest_lengths"])
    # k_s/l0 of edge springs is their modulus; k_d = k_d0 sqrt(k m) by S2 of the model.
    assert tables["stiffness"][:480] == pytest.approx(1000.0)
    assert tables["damping"][0] == pytest.approx(0.2 * np.sqrt(1000.0 * 0.2 / 256))
    corners = tables["positions"][tables["triangles"]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0.0).all()
    assert 0.5 * normals[:, 2].sum() == pytest.approx(1.0)
    assert tables["edge_lengths"] == pytest.approx(1.0 / 15.0)


def test_largest_stretch_is_of_the_longest_edge() -> None:
    edges, rest_lengths = np.array([[0, 1], [1, 2]]), np.array([1.0, 0.5])
    positions = np.array([[0.0, 0.0, 0.0], [1.1, 0.0, 0.0], [1.1, 0.6, 0.0]])
    assert peer_run.largest_stretch(positions, edges, rest_lengths) == pytest.approx(1.2)
    positions[2, 1] = np.nan
    assert np.isnan(peer_run.largest_stretch(positions, edges, rest_lengths))


def test_attempt_reports_whether_the_sheet_is_whole(stand_in: Peer, sheet: Path, environment: Path) -> None:
    whole = attempt(stand_in, sheet, environment, 20)
    assert (whole.whole, whole.n_steps, whole.stretch) == (True, 60, pytest.approx(1.0))
    assert whole.remarks == ["was watched"]
    assert whole.versions == {"numpy": np.__version__}
    assert whole.factor == pytest.approx(3.0 / 60.0 / whole.wall)
    assert whole.cpu_factor == pytest.approx(3.0 / 60.0 / whole.cpu)
    # 1.02^8 is 1.17: at the third frame 1.61, too much.
    torn = attempt(stand_in, sheet, environment, 8, frames=10)
    assert (torn.whole, torn.n_steps, torn.stretch) == (False, 24, pytest.approx(1.02**24))
    not_finite = attempt(attrs.evolve(stand_in, variant="nan"), sheet, environment, 20)
    assert (not_finite.whole, not_finite.n_steps) == (False, 20)


def test_slow_engine_stops_at_the_time_limit(stand_in: Peer, sheet: Path, environment: Path) -> None:
    slow = attempt(attrs.evolve(stand_in, variant="slow"), sheet, environment, 20, frames=1000, seconds=0.05)
    assert slow.whole
    # The limit applies within the first frame.
    assert slow.n_steps < 20
    assert slow.simulated == pytest.approx(slow.n_steps / 20 / 60)
    # It sleeps, which is no processor time.
    assert slow.wall >= 0.05 > slow.cpu


@pytest.mark.parametrize(
    ("variant", "said"),
    [
        ("dies", "Stand-in: was killed by SIGKILL: engines talk"),
        ("raises", "ended with status 1: RuntimeError: no such solver"),
        ("turned", "the engine's sheet starts 1 m off"),
    ],
)
def test_failed_engine_reports_the_reason(
    variant: str, said: str, stand_in: Peer, sheet: Path, environment: Path
) -> None:
    with pytest.raises(PeerFailed, match=said):
        attempt(attrs.evolve(stand_in, variant=variant), sheet, environment, 20)


def search_longest_step(min_steps: int, first: int = 16, max_steps: int = 10**9) -> tuple[list[int], int | None]:
    """Search the longest step of an engine, valid from `min_steps` steps a frame on, too slow above `max_steps`."""
    tried: list[int] = []

    def is_valid(steps: int) -> bool | None:
        tried.append(steps)
        return None if steps > max_steps else steps >= min_steps

    return tried, peer_environment.longest_step(is_valid, first)


@pytest.mark.parametrize("first", [1, 16])
@pytest.mark.parametrize("bears", [1, 2, 3, 15, 16, 17, 40, 64, 100, 1000])
def test_longest_step_is_within_a_fifth(bears: int, first: int) -> None:
    tried, longest = search_longest_step(bears, first)
    assert longest in tried
    assert bears <= longest <= max(1.2 * bears, bears + 1)
    assert len(tried) == len(set(tried)) <= 13


def test_longest_step_is_none_if_every_step_tears() -> None:
    tried, longest = search_longest_step(10**9)
    assert longest is None
    assert max(tried) <= 4096


def test_search_of_steps_stops_at_the_first_late_run() -> None:
    assert search_longest_step(10, first=1, max_steps=6) == ([1, 2, 4, 8], None)
    # Bisections run at longer steps, which may be late by chance: they do not count as valid.
    tried: list[int] = []

    def is_valid(steps: int) -> bool | None:
        tried.append(steps)
        return None if steps == 6 else steps >= 5

    assert peer_environment.longest_step(is_valid, 1) == 7
    assert tried == [1, 2, 4, 8, 6, 7]


def test_peers_have_scripts_and_exact_versions() -> None:
    for peer in PEERS:
        assert Path(peers.__file__).with_name(peer.script).exists()
        assert peer.package in REQUIREMENTS
        assert all(peer.first_steps(n) >= 1 for n in (16, 128))
    assert all("==" in package for packages in REQUIREMENTS.values() for package in packages)


def test_peer_scripts_do_not_import_the_package(environment: Path) -> None:
    folder = Path(peers.__file__).parent
    for name in {"runner.py", *(peer.script for peer in PEERS)}:
        script = (
            f"import runpy, sys; runpy.run_path({str(folder / name)!r}); "
            "print(sorted(n for n in sys.modules if n.split('.')[0] in ('cloth_sim_ros', 'scipy', 'attrs')))"
        )
        command = [str(peer_environment.python_of(environment)), "-I", "-c", script]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        assert done.stdout == "[]\n", name


def test_clean_variables_drop_paths_of_this_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LD_LIBRARY_PATH", "/opt/ros/lib")
    monkeypatch.setenv("_ROS_WHEELS_BOOTSTRAP_COMPLETE", "1")
    monkeypatch.setenv("LANG", "C")
    variables = peer_environment.clean_variables(OMP_NUM_THREADS="1")
    assert not {"LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE"} & variables.keys()
    assert (variables["LANG"], variables["OMP_NUM_THREADS"]) == ("C", "1")


def test_foreign_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(SystemExit):
        main(["peers", "--environment", str(tmp_path)])
    assert "holds something, but no Python environment; name another folder" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_broken_environment_error_names_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "peers" / "bin").mkdir(parents=True)
    (tmp_path / "peers" / "bin" / "python").write_text("not a program")
    with pytest.raises(EnvironmentUnusable, match=r"does not run: .*; remove the folder"):
        peer_environment.prepare(tmp_path / "peers", {}, lambda _: None)


@pytest.fixture(scope="module")
def real_environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cache") / "peers"
    peer_environment.prepare(folder, {}, lambda _: None)
    return folder


def disconnect(monkeypatch: pytest.MonkeyPatch) -> None:
    """Point pip to an index that does not answer."""
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    for name in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL"):
        monkeypatch.delenv(name, raising=False)


def test_peers_are_absent_without_a_network(
    real_environment: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    disconnect(monkeypatch)
    file = tmp_path / "peers.json"
    options = ["--resolutions", "16", "--duration", "0.1", "--repeats", "1", "--peers", "pybullet", "pyPBD"]
    assert main(["peers", "--environment", str(real_environment), *options, "--json", str(file)]) == 0
    written = json.loads(file.read_text())
    assert [row[0] for row in written["tables"][0]["rows"]] == ["cloth_sim_ros, as shipped", "cloth_sim_ros, one core"]
    (row,) = written["tables"][1]["rows"]
    assert row[0] == 16
    assert row[2] < 1e-3
    assert row[4:] == ["-", "-", "-"]
    for name in ("pybullet", "pyPBD"):
        (note,) = [note for note in written["notes"] if note.startswith(f"ABSENT: {name}:")]
        assert "not installed, and the package index is out of reach" in note
    # After the first failure no second installation is tried.
    said = capsys.readouterr().err
    assert "installing pybullet==3.2.7" in said
    assert "installing pyPBD" not in said


def test_peer_without_a_wheel_is_absent(real_environment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    said: list[str] = []
    script = "import importlib.metadata as m; print(m.version('pip'))"
    python = str(peer_environment.python_of(real_environment))
    pip = subprocess.run([python, "-I", "-c", script], check=True, capture_output=True, text=True).stdout.strip()
    requirements = {"there": (f"pip=={pip}",), "none": ("cloth-sim-ros-has-no-such-peer==9.9",)}
    absent = peer_environment.prepare(real_environment, requirements, said.append)
    assert absent.keys() == {"none"}
    assert absent["none"].startswith("there is no wheel of cloth-sim-ros-has-no-such-peer==9.9 for Python 3.")
    assert len(said) == 1


def test_report_compares_with_the_fastest_peer(
    stand_in: Peer,
    environment: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
) -> None:
    slow = attrs.evolve(stand_in, name="Slow", variant="slow")
    dead = attrs.evolve(stand_in, name="Dead", variant="dies")
    monkeypatch.setattr(peers, "PEERS", (slow, stand_in, dead))
    monkeypatch.setattr(peer_environment, "prepare", lambda *_: {})
    monkeypatch.setattr(peers, "RATED_RESOLUTIONS", (16,))
    file = tmp_path / "peers.json"
    options = ["--resolutions", "16", "--duration", "0.1", "--repeats", "2", "--peers", "newton", "--json", str(file)]
    assert main(["peers", "--environment", str(environment), *options]) == 1
    written = json.loads(file.read_text())
    factors = {row[0]: row[1] for row in written["tables"][0]["rows"]}
    assert factors["Slow"] < factors["Stand-in"]
    (row,) = written["tables"][1]["rows"]
    assert row[4] == "Stand-in"
    assert row[5] == pytest.approx(factors["cloth_sim_ros, as shipped"] / factors["Stand-in"])
    assert row[6] == pytest.approx(factors["cloth_sim_ros, one core"] / factors["Stand-in"])
    steps = {row[1]: row[2] for row in written["tables"][2]["rows"]}
    assert steps["Stand-in"] in range(17, 21)
    assert "FAILED: N = 16: Dead: was killed by SIGKILL: engines talk" in written["notes"]
    assert "Stand-in: is no cloth at all" in written["notes"]
    assert "N = 16: Slow was watched" in written["notes"]
    (failure,) = written["failures"]
    assert failure.endswith("times as fast as Stand-in; target 15")
    assert "Stand-in, 8 steps a frame: torn" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--repeats", "--seconds", "--duration", "--peer-threads"])
def test_numbers_must_be_above_zero(option: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        main(["peers", option, "0"])
    assert f"{option}: 0; it must be" in capsys.readouterr().err


def test_torn_threshold_is_configurable(stand_in: Peer, sheet: Path, environment: Path) -> None:
    strict = attempt(stand_in, sheet, environment, 8, frames=10, whole=1.2)
    assert (strict.whole, strict.n_steps) == (False, 16)
    with pytest.raises(SystemExit):
        main(["peers", "--stretch", "1.0"])
