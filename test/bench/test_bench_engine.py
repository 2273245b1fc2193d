# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_bench engine` and `cloth_bench adds`: tiny sheets, a stand-in for the older tree, no network."""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros.bench import adds, engine, engine_jobs, engine_side, garment, old_tree
from cloth_sim_ros.bench.adds import Cost
from cloth_sim_ros.bench.engine_side import Pair, Side, SideFailed, in_turns
from cloth_sim_ros.bench.main import main
from cloth_sim_ros.bench.old_tree import OldTree
from cloth_sim_ros.bench.peer_environment import EnvironmentUnusable
from cloth_sim_ros.bench.report import Report
from cloth_sim_ros.physics.sheets.surface import Surface
from cloth_sim_ros.scene.scene import Scene

ROOT = Path(__file__).resolve().parents[2]

# Speaks as the worker does, of a tree whose every job takes a second.
STAND_IN = """
import json, sys
for line in sys.stdin:
    request = json.loads(line)
    if request.get("measure") == "dies":
        sys.exit(3)
    if request.get("measure") == "fails":
        print(json.dumps({"error": "ValueError: no such sheet"}), flush=True)
    else:
        vertices = request.get("vertices", 0)
        figures = {"seconds": 1.0, "processor": 1.0, "p99": 2.0, "steps": 5.0, "vertices": vertices}
        print(json.dumps(figures), flush=True)
"""
SIZES = {
    "sheets": 6,
    "meshes": 100,
    "bendings": 6,
    "carried": 6,
    "curtains": 6,
    "garments": 120,
    "rounds": 1,
    "updates": 1000,
}
TINY = [part for name, value in SIZES.items() for part in (f"--{name}", str(value))] + ["--frames", "10"]


@pytest.fixture
def stand_in(tmp_path: Path) -> Path:
    script = tmp_path / "stand_in.py"
    script.write_text(STAND_IN)
    return script


@pytest.fixture
def older(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, stand_in: Path) -> None:
    """An older tree that is a stand-in."""
    found = OldTree("0123456789abcdef", tmp_path, Path(sys.executable))
    monkeypatch.setattr(old_tree, "prepare", lambda *arguments, **options: found)
    plain = Side.__init__

    def init(self: Side, name: str, **options: Any) -> None:
        if options.get("tree") == tmp_path:
            options["worker"] = stand_in
        plain(self, name, **options)

    monkeypatch.setattr(Side, "__init__", init)


@pytest.mark.usefixtures("older")
def test_every_row_is_measured_of_both_trees(tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    # Some promises may not hold on a sheet of six by six; that is not what is looked at.
    main(["engine", *TINY, "--engines", "baseline", "--json", str(file)])
    said = json.loads(file.read_text())
    times, shares, shirts = said["tables"]
    told = [row[0] for row in times["rows"]]
    assert len(told) == len(set(told)) == 10
    for part in ("step float32", "forces", "mesh", "altitude", "crossed", "carried", "scene C", "T-shirt"):
        assert any(part in what for what in told)
    column = {name: i for i, name in enumerate(times["columns"])}
    for row in times["rows"]:
        assert row[column["engine"]] == "baseline"
        assert 0.0 < row[column["least"]] <= row[column["new/old"]] <= row[column["most"]] < np.inf
    assert [0.0 < row[2] < 1.0 for row in shares["rows"]] == [True, True]
    assert [row[1] for row in shirts["rows"]] == ["old", "new"]
    assert all(row[-1] > 0.0 for row in shirts["rows"])
    assert "0123456789ab" in said["notes"][0]


def test_a_ratio_is_that_of_fair_rounds() -> None:
    # The machine was twice as slow in the second round; the third was disturbed for one of them.
    seconds = [(1.0, 0.5), (2.0, 1.0), (1.0, 4.0)]
    pair = Pair(old=[{"seconds": a} for a, _ in seconds], new=[{"seconds": b} for _, b in seconds])
    assert pair.ratio() == 0.5
    assert pair.ratios() == [0.5, 0.5, 4.0]


def test_sides_take_turns_and_the_first_round_is_not_counted() -> None:
    asked: list[str] = []

    class Told:
        def __init__(self, name: str) -> None:
            self.name = name

        def measure(self, job: str, **options: Any) -> dict[str, Any]:
            asked.append(self.name)
            return {"seconds": float(len(asked))}

        def forget(self) -> None:
            asked.append(f"{self.name} forgets")

    found = in_turns([Told("a"), Told("b")], "step", {}, rounds=3, say=lambda text: None)  # type: ignore[list-item]
    assert "".join(asked[:8]) == "ab" + "ab" + "ba" + "ab"
    assert asked[8:] == ["a forgets", "b forgets"]
    assert [len(figures) for figures in found] == [3, 3]
    assert found[0][0] == {"seconds": 3.0}


@pytest.mark.parametrize(
    ("job", "words"), [("fails", "can't do 'fails': ValueError: no such sheet"), ("dies", "status 3")]
)
def test_a_side_that_can_not_says_which_and_why(stand_in: Path, job: str, words: str) -> None:
    with Side("the old tree", worker=stand_in) as side, pytest.raises(SideFailed, match=words) as caught:
        side.measure(job)
    assert "the old tree" in str(caught.value)


def test_the_worker_tells_of_an_unknown_job() -> None:
    with Side("this tree") as side:
        with pytest.raises(SideFailed, match="no job 'leap'; there are step"):
            side.measure("leap")
        # And goes on.
        assert side.measure("forces", resolution=4, updates=1000)["seconds"] > 0.0


def test_what_was_promised_and_missed_is_told() -> None:
    class Fixed:
        def __init__(self, seconds: float) -> None:
            self.seconds = seconds

        def measure(self, job: str, **options: Any) -> dict[str, Any]:
            return {
                "seconds": self.seconds,
                "processor": 1.0,
                "python": 0.3,
                "p99": 0.1,
                "steps": 3.0,
                "vertices": 3000,
            }

        def forget(self) -> None:
            pass

    parser = argparse.ArgumentParser()
    engine.add_arguments(parser)
    options = parser.parse_args(["--sheets", "64", "128", "--curtains", "16", "--garments", "3000", "--rounds", "1"])
    report = Report("", "", environment={})
    # A tenth more than before: within the bound of float32 at N = 64, and of AVX-512 at N = 128, and of nothing else.
    old = Fixed(1.0)
    engine.measure({"avx2": old, "avx512": old}, {"avx2": Fixed(1.1), "avx512": Fixed(1.1)}, options, report)  # type: ignore[arg-type, dict-item]
    missed = {tuple(text.partition(":")[0].rsplit(", ", 1)) for text in report.failures}
    assert ("whole step float64, N = 64", "avx2") in missed
    assert ("whole step float32, N = 64", "avx2") not in missed
    assert ("whole step float32, N = 128", "avx2") in missed
    assert ("whole step float32, N = 128", "avx512") not in missed
    assert ("T-shirt of 3000, altitude, frame", "avx2") in missed
    assert any("Python's share is 0.3" in text for text in report.failures)


@pytest.mark.parametrize(
    ("options", "words"),
    [("--rounds 0", "--rounds is 0"), ("--frames 0", "--frames is 0"), ("--engines fast", "no engine fast runs")],
)
def test_bad_options_are_refused_with_the_value(options: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["engine", *options.split()])
    assert words in capsys.readouterr().err


# The older tree.


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A checkout with a commit of a package that needs nothing."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    folder = tmp_path / "repository"
    (folder / "cloth_sim_ros").mkdir(parents=True)
    (folder / "cloth_sim_ros" / "__init__.py").write_text("")
    (folder / "constraints.txt").write_text("")
    identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    for command in (["init", "--quiet"], ["add", "."], [*identity, "commit", "--quiet", "-m", "first"]):
        subprocess.run(["git", "-C", str(folder), *command], check=True)
    return folder


def test_an_older_tree_is_made_once_and_anew_where_it_was_interrupted(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed: list[Path] = []

    def install(tree: Path, environment: Path, say: Any) -> None:
        installed.append(tree)
        python = environment / "bin" / "python"
        python.parent.mkdir(parents=True, exist_ok=True)
        python.unlink(missing_ok=True)
        python.symlink_to(sys.executable)

    monkeypatch.setattr(old_tree, "_install", install)
    said: list[str] = []
    found = old_tree.prepare("HEAD", said.append, folder=tmp_path / "kept", repository=repository)
    assert (found.tree / "cloth_sim_ros" / "__init__.py").exists()
    assert found.commit in (found.tree.parent / "ready").read_text()
    assert old_tree.prepare(found.commit, said.append, folder=tmp_path / "kept", repository=repository) == found
    assert len(installed) == 1
    assert any("once" in text for text in said)
    # It was interrupted before it was whole.
    (found.tree.parent / "ready").unlink()
    assert old_tree.prepare("HEAD", said.append, folder=tmp_path / "kept", repository=repository) == found
    assert len(installed) == 2
    # The user has cleared the cache by hand; git still believes that there is a worktree.
    shutil.rmtree(tmp_path / "kept")
    assert old_tree.prepare("HEAD", said.append, folder=tmp_path / "kept", repository=repository) == found
    assert len(installed) == 3


def test_without_the_history_the_error_says_how_to_get_it(repository: Path, tmp_path: Path) -> None:
    with pytest.raises(EnvironmentUnusable, match=r"no commit bd9f05d.*--unshallow.*--against"):
        old_tree.prepare("bd9f05d", lambda text: None, folder=tmp_path / "kept", repository=repository)
    # Nor is a plain folder a checkout, whatever git finds above it.
    (tmp_path / "plain").mkdir()
    with pytest.raises(EnvironmentUnusable, match="has no commit bd9f05d"):
        old_tree.prepare("bd9f05d", lambda text: None, folder=tmp_path / "kept", repository=tmp_path / "plain")


def test_without_a_network_the_error_says_so(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = old_tree._run

    def run(command: list[str]) -> subprocess.CompletedProcess[str]:
        if command[0] == "git":
            return plain(command)
        if "pip" in command:
            return subprocess.CompletedProcess(command, 1, "", "WARNING: ... Temporary failure in name resolution\nno")
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(old_tree, "_run", run)
    with pytest.raises(EnvironmentUnusable, match="package index is out of reach"):
        old_tree.prepare("HEAD", lambda text: None, folder=tmp_path / "kept", repository=repository)
    assert not list((tmp_path / "kept").glob("*/ready"))


def test_the_cache_is_where_the_variable_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CLOTH_SIM_ROS_BENCH_CACHE", str(tmp_path))
    assert old_tree.default_folder() == tmp_path
    monkeypatch.delenv("CLOTH_SIM_ROS_BENCH_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert old_tree.default_folder().is_relative_to(tmp_path / "cache")


# The scenes.


def test_the_default_cloth_is_that_of_the_configuration() -> None:
    file = ROOT / "config" / "cloth_sim.yaml"
    if not file.exists():
        pytest.skip("not in a checkout")
    # But for the air across the sheet, which older figures are without.
    still = Scene.from_file(file).changed({"wind.normal_drag": 0.0})
    assert Scene.from_parameters(engine_jobs.DEFAULT_CLOTH) == still


@pytest.mark.parametrize("vertices", [150, 1460])
def test_the_shirt_is_one_clean_sheet_of_the_size_asked_for(vertices: int) -> None:
    places, triangles = garment.mesh(vertices)
    assert abs(len(places) - vertices) <= 0.03 * vertices
    surface = Surface.from_triangles(triangles, particle_count=len(places))
    assert surface.pieces().max() == 0
    # One border, no hole: vertices - edges + faces is that of a disc.
    assert len(places) - len(surface.edges) + len(triangles) == 1
    x, y = garment.outline().T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))
    a, b, c = (places[triangles[:, k]][:, [0, 2]] for k in range(3))
    (ux, uy), (wx, wy) = (b - a).T, (c - a).T
    assert 0.5 * float(np.abs(ux * wy - uy * wx).sum()) == pytest.approx(area, rel=0.03)


def test_the_shirt_is_the_same_every_time() -> None:
    garment.mesh.cache_clear()
    first = garment.obj_file(200)
    garment.mesh.cache_clear()
    assert garment.obj_file(200) == first


# Costs that add up.


def cost(both: float) -> Cost:
    times = {frozenset(["air"]): 1.5, frozenset(["numpy"]): 2.0, frozenset(["air", "numpy"]): both}
    return Cost(base=1e-3, steps=50, times=times)


@pytest.mark.parametrize(("both", "holds"), [(2.6, True), (2.68, False)])
def test_together_costs_what_each_costs_alone_and_a_little(both: float, holds: bool) -> None:
    report = Report("", "", environment={})
    adds.add("grid", cost(both), report)
    # 1.1 (0.5 + 1.0) + 0.02 = 1.67
    (row,) = report.tables[1].rows
    assert row[:2] == ["air", "numpy"]
    assert row[5] == pytest.approx((both - 1.0) / 1.5)
    assert row[-1] == ("yes" if holds else "no")
    assert bool(report.failures) is not holds


def test_no_cloth_bends_in_two_ways() -> None:
    pairs = adds.pairs(adds.FEATURES)
    assert len(pairs) == len(set(pairs)) == 18
    assert ("opposite", "crossed") not in pairs
    assert ("altitude", "energy") in pairs


@pytest.mark.parametrize("sheet", adds.SHEETS)
def test_pairs_are_measured(sheet: str, tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    options = [
        "--sheets",
        sheet,
        "--features",
        "opposite",
        "gripper",
        "numpy",
        "--resolution",
        "8",
        "--seconds",
        "0.01",
    ]
    main(["adds", *options, "--json", str(file)])
    alone, together = json.loads(file.read_text())["tables"]
    assert [row[0] for row in alone["rows"]] == ["base", "opposite", "gripper", "numpy"]
    assert [row[:2] for row in together["rows"]] == [
        ["opposite", "gripper"],
        ["opposite", "numpy"],
        ["gripper", "numpy"],
    ]


def test_features_are_what_they_say() -> None:
    names = frozenset(["altitude", "air", "gripper", "numpy", "energy"])
    scene = adds.scene("mesh", 8, names, step=1e-4)
    assert {"altitude", "air", "grips", "floor"} <= {force.name for force in scene.plan().model.forces}
    assert scene.diagnostics.energy
    assert {force.name for force in adds.scene("mesh", 8, frozenset()).plan().model.forces}.isdisjoint(
        {"altitude", "air", "grips", "floor"}
    )


def test_a_user_s_floor_is_the_gradient_of_its_energy() -> None:
    floor = adds.Floor(0.7, 3.0)
    x = np.array([[0.0, 0.0], [0.0, 0.0], [0.5, 0.9]])
    f = np.zeros_like(x)
    floor.add_force(0.0, x, np.zeros_like(x), f)
    kick = np.zeros_like(x)
    kick[2] = 1e-6
    slope = (floor.energy(0.0, x + kick) - floor.energy(0.0, x - kick)) / 2e-6
    assert float(f[2].sum()) == pytest.approx(-slope, rel=1e-6)


def test_the_script_that_runs_elsewhere_is_beside_its_parts() -> None:
    for name in ("engine_jobs.py", "engine_side_new.py", "engine_side_old.py", "garment.py"):
        assert (engine_side.WORKER.parent / name).exists()
