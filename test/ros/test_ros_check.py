# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_sim --check scene.yaml`: cloth, speed and step limit; refusals with the node's messages."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.ros import main as node_main
from cloth_sim_ros.ros.check.step_limiters import describe_step_limiters, find_step_limiters
from cloth_sim_ros.scene.parameters import parameter_file

#: The environment of a machine without ROS.
WITHOUT_ROS = (
    "import sys; sys.modules['rclpy'] = None; from cloth_sim_ros.ros.main import main; sys.exit(main(sys.argv[1:]))"
)


def written(folder: Path, values: dict[str, Any]) -> str:
    path = folder / "scene.yaml"
    path.write_text(parameter_file.dump(values))
    return str(path)


def check(*arguments: str) -> int:
    return node_main.main(["--check", *arguments])


def sliver_mesh(folder: Path, *, moved: float) -> str:
    """A mesh of 21 x 21 particles 50 mm apart; particle 220 is displaced along its row."""
    x, y = np.meshgrid(np.arange(21) * 0.05, np.arange(21) * 0.05)
    x[10, 10] += moved
    lines = [f"v {a} {b} 0.0" for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    for row in range(20):
        for column in range(20):
            a = 21 * row + column + 1
            lines += [f"f {a} {a + 1} {a + 22}", f"f {a} {a + 22} {a + 21}"]
    path = folder / "mesh.obj"
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_check_prints_cloth_and_speed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, {"cloth.resolution": [12, 10], "rate": 50.0, "grippers": ["left", "right"]})
    assert check(path) == 0
    said = capsys.readouterr().out
    for words in (
        "a grid of 12 x 10: 120 particles, 10 anchored; forces: structural, shear, bend, gravity, drag, air, grips",
        "50 frames a second; tolerance 0.001 m; grippers: left, right",
        "expected real-time factor: ",
        "steps a frame by the stability limit",
        "integrator: extrapolated, ",
        "auto: explicit steps are affordable",
        "tried here: the first 50 frames took ",
        "where 'structural' has ",
        "no small group sets it",
    ):
        assert words in said, words
    assert "warning" not in said


def test_check_needs_no_ros(tmp_path: Path) -> None:
    path = written(tmp_path, {"cloth.resolution": [5, 5]})
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_ROS, "--check", path], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "a grid of 5 x 5: 25 particles" in done.stdout


def test_closed_output_pipe_is_no_failure(tmp_path: Path) -> None:
    path = written(tmp_path, {"cloth.resolution": [5, 5]})
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-c", WITHOUT_ROS, "--check", path]
    try:
        for unbuffered in ("", "1"):
            done = subprocess.run(
                command,
                stdout=writing,
                stderr=subprocess.PIPE,
                check=False,
                env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
            )
            assert (done.returncode, done.stderr) == (0, b"")
    finally:
        os.close(writing)


def test_another_nodes_parameters_are_read_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cloths.yaml"
    path.write_text("/left/towel:\n  ros__parameters:\n    cloth: {resolution: [4, 6]}\n")
    assert check(str(path), "--node", "/left/towel") == 0
    assert "a grid of 4 x 6" in capsys.readouterr().out
    assert check(str(path), "--node", "towel") == 1
    assert "sets nothing for the node /towel, but for /left/towel: give the node's full name" in capsys.readouterr().err
    assert check(str(path)) == 0
    assert (
        "warning: " + f"'{path}' sets nothing for the node /cloth_sim: all has its default" in capsys.readouterr().out
    )


def test_check_and_node_warn_alike_of_ineffective_parameters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values = {
        "cloth.resolution": [5, 5],
        "cloth.sizes": [1.0, 1.0],
        "use_sim_time": True,
        "qos_overrides./cloth_sim/points.publisher.depth": 3,
        "bending.model": "none",
        "bending.stiffness": 1.0,
    }
    assert check(written(tmp_path, values)) == 0
    warnings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == 2
    assert warnings[0].endswith(
        "there is no parameter 'cloth.sizes', what sets it has no effect; did you mean 'cloth.size'?"
    )
    assert "bending.stiffness" in warnings[1]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"rate": -1.0}, "rate is -1.0 Hz; it must be at least 0.1 Hz"),
        ({"cloth.anchors": ["middle"]}, "'middle' is no edge or corner of a grid"),
        ({"step": 0.01}, "step 0.01 s is above the stability limit"),
        ({"step": 1e-8}, "(step is 1e-08 s), at most 22222 are taken live: set a larger step, or 0.0 with a tolerance"),
        # An implicit step takes some hundred times as long.
        ({"integrator": "implicit", "step": 1e-5}, "a frame would take 1.67e+03 steps (step is 1e-05 s), at most 1"),
        ({"material.stretch_modulus": 1e9, "material.density": 1e-6, "integrator": "leapfrog"}, "a frame would take"),
        # Implicit steps may find no solution, and nothing then bounds the explicit ones.
        ({"material.stretch_modulus": 1e9, "material.density": 1e-9, "work_limit": 1e6}, "a work_limit of 1e+06), at"),
        ({"material.stretch_modulus": 1e9, "material.density": 1e-9, "work_limit": 0.0}, "s, with no work_limit), at"),
        ({"cloth.mesh": "nowhere.obj"}, "cannot read 'nowhere.obj'"),
        ({"initial_state": "nowhere.mcap@3"}, "nowhere.mcap"),
        ({"grippers": []}, "grippers is an empty list, [], whose type ROS can't know; for none write ['']"),
        (
            {"table.size": [], "table.shape": "box"},
            "table.size is an empty list, [], whose type ROS can't know; it must",
        ),
        ({"foo": []}, "foo is an empty list, [], whose type ROS can't know; leave it out"),
        ({"use_sim_time": []}, "use_sim_time is an empty list, [], whose type ROS can't know; it must be bool"),
        ({"use_sim_time": "false"}, "use_sim_time is 'false'; it must be true or false, without quotes"),
        ({"frame_id": "\0"}, "frame_id is empty"),
        (
            {"record.enabled": True, "record.folder": __file__},
            "test_ros_check.py: it is, or lies under, a file; set rec",
        ),
        (
            {"record.enabled": True, "record.folder": f"{__file__}/sub/one"},
            "sub/one: it is, or lies under, a file; set",
        ),
        ({"record.enabled": True, "record.folder": "n" * 300}, "File name too long"),
        ({"grippers": ["a" * 230]}, "has 230 letters; the topics of /cloth_sim leave room for 229: shorten it"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_check_refuses_what_the_node_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], values: dict[str, Any], words: str
) -> None:
    assert check(written(tmp_path, values)) == 1
    said = capsys.readouterr()
    assert said.err.startswith("cloth_sim: ")
    assert words in said.err
    assert said.out == ""


def test_longest_topic_name_is_accepted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "not" / "there"
    values = {"cloth.resolution": [3, 3], "grippers": ["a" * 229], "record.enabled": True, "record.folder": str(folder)}
    assert check(written(tmp_path, values)) == 0
    # The recording folder is not created.
    assert not folder.parent.exists()
    assert "grippers: aaa" in capsys.readouterr().out


def test_relative_file_names_resolve_as_in_the_node(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config, folder = Path(__file__).parents[2] / "config", tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert check(str(config / "stack.yaml")) == 1
    assert capsys.readouterr().err.endswith(
        f"; the node resolves relative names in its working directory, {folder}: start it in {config}, or "
        f"give cloth.mesh as {config / 'stack.obj'}\n"
    )
    assert check(written(tmp_path, {"cloth.mesh": "nowhere.obj"})) == 1
    assert capsys.readouterr().err.endswith(f" in its working directory, {folder}: give the whole path\n")
    # Another fault has no hint.
    assert check(written(tmp_path, {"cloth.mesh": "nowhere.obj", "rate": -1.0})) == 1
    assert "the node resolves" not in capsys.readouterr().err


def test_missing_or_invalid_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(str(tmp_path / "nowhere.yaml")) == 1
    assert "cannot read parameter file" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        check(str(tmp_path / "nowhere.yaml"), "--nodes", "towel")
    assert ended.value.code == 2


def test_cost_of_few_short_edges_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = sliver_mesh(tmp_path, moved=0.048)
    values = {"cloth.mesh": mesh, "bending.model": "none", "cloth.anchors": ["0", "20"]}
    assert check(written(tmp_path, values)) == 0
    said = capsys.readouterr().out
    assert "220-221 (2 mm)" in said
    assert "set it: without them steps would be" in said
    assert "median of the mesh 50 mm" in said
    # Without the sliver no few particles limit the step, and the limit is larger by the printed ratio.
    simulation = Simulation(Scene.from_parameters(values))
    limiters = find_step_limiters(simulation.plan, simulation.state.x)
    whole = Simulation(Scene.from_parameters(values | {"cloth.mesh": sliver_mesh(tmp_path, moved=0.0)}))
    without = find_step_limiters(whole.plan, whole.state.x)
    assert {220, 221} <= set(limiters.stiff_particles) | {limiters.particle}
    assert limiters.gain > 2.0
    assert without.limit / limiters.limit == pytest.approx(limiters.gain, rel=0.25)
    assert without.gain < 1.2
    assert "no small group sets it" in describe_step_limiters(without, whole.scene.sheet)[1]


def test_step_limit_equals_that_of_the_plan() -> None:
    values = {"cloth.resolution": [9, 9], "material.damping": 0.0, "wind.normal_drag": 0.0}
    simulation = Simulation(Scene.from_parameters(values))
    limiters = find_step_limiters(simulation.plan, simulation.state.x)
    omega2, _ = simulation.plan.spectral_bounds(simulation.state.x)
    assert limiters.limit == pytest.approx(2.0 / np.sqrt(omega2), rel=1e-3)


def test_without_springs_nothing_bounds_the_step() -> None:
    anchored = [str(k) for k in range(4)]
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [2, 2], "cloth.anchors": anchored}))
    limiters = find_step_limiters(simulation.plan, simulation.state.x)
    assert describe_step_limiters(limiters, simulation.scene.sheet) == ["nothing bounds the step by its stability"]


def test_check_prints_obstacles_and_gaps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = {
        "cloth.resolution": [6, 6],
        "obstacles": ["pole"],
        "pole.shape": "cylinder",
        "pole.size": [0.05, 2.0],
        "pole.position": [0.5, 0.1, 0.5],
        "spare.shape": "plane",
    }
    assert check(written(tmp_path, values)) == 0
    said = capsys.readouterr().out
    assert "obstacle 'pole': cylinder of 0.05 x 2 m, friction 0 at rest and 0 in motion" in said
    assert "starts 0.05 m away; it pushes from 0.003 m on" in said
    assert "warning: spare.shape is set and has no effect: obstacles does not name 'spare'" in said
    assert check(written(tmp_path, {**values, "pole.position": [0.5, 0.0, 0.5]})) == 1
    assert "the cloth is inside obstacle 'pole': particle " in capsys.readouterr().err
    assert check(written(tmp_path, {**values, "pole.size": [0.05]})) == 1
    assert "a cylinder has 2: radius, length" in capsys.readouterr().err
