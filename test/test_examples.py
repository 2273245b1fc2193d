# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Examples run unchanged in their own processes and do what they describe."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cloth_sim_ros import Scene, Simulation
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted(path for path in (ROOT / "examples").iterdir() if path.is_file())
SESSION = ROOT / "test" / "data" / "session_0.1.0.mcap"


def run(name: str, *arguments: object, cwd: Path) -> str:
    """Run an example; return what it printed."""
    command = [sys.executable, ROOT / "examples" / name, *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, check=False, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(pattern: str, text: str) -> list[float]:
    return [float(value) for value in re.findall(pattern, text)]


def test_every_example_is_short_and_tested() -> None:
    tests = Path(__file__).read_text()
    for path in EXAMPLES:
        assert len(path.read_text().splitlines()) < 60, path.name
        assert f'"{path.name}"' in tests, f"nothing runs {path.name}"


def test_chain_hangs_between_its_ends(tmp_path: Path) -> None:
    heights = numbers(r"lowest point (\S+) m", run("chain.py", cwd=tmp_path))
    # In half a second a free fall is 1.2 m; the springs hold it within a tenth of that.
    assert len(heights) == 3
    assert all(-0.2 < height < 0.0 for height in heights)


def test_frames_run_again_to_the_last_bit(tmp_path: Path) -> None:
    output = run("frames.py", cwd=tmp_path)
    assert output.endswith("the same to the last bit\n")
    # The raised corner pulls the gripper down.
    assert numbers(r" (\S+)\] N", output)[0] < -0.1


def test_mesh_cloth_hangs_over_its_held_middle(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    output = run("mesh_cloth.py", cwd=tmp_path)
    assert numbers(r"hangs (\S+) m", output)[0] == pytest.approx(0.44, abs=0.05)
    # A user's mesh is used unchanged.
    assert run("mesh_cloth.py", tmp_path / "table_cloth.obj", cwd=tmp_path) == output


def test_read_session_prints_grasps_and_digests(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    pytest.importorskip("rosbags")
    output = run("read_session.py", SESSION, cwd=tmp_path)
    assert output.count("'kind': 'grasp'") == 2
    assert re.search(r"digest [0-9a-f]{32}\n", output)


def test_custom_force_carries_the_weight(tmp_path: Path) -> None:
    output = run("custom_force.py", cwd=tmp_path)
    (expected,) = numbers(r"sink by m g / k = (\S+) mm", output)
    assert numbers(r"lowest bead (\S+) mm", output)[-1] == pytest.approx(-expected, abs=0.02)


def test_mppi_brings_the_corner_to_the_mark(tmp_path: Path) -> None:
    distances = numbers(r"corner is (\S+) m", run("mppi.py", cwd=tmp_path))
    # The corner starts 0.4 m away.
    assert len(distances) == 3
    assert distances[-1] < 0.03


def test_every_towel_parameter_has_an_effect() -> None:
    path = ROOT / "examples" / "towel.yaml"
    assert path.name == "towel.yaml"
    scene = Scene.from_file(path, node="towel")
    assert ineffective_parameters(scene, scene.parameters()) == ineffective_parameters(Scene(), Scene().parameters())
    assert scene.gripper_names == ["left", "right"]
    assert Simulation(scene).advance().moved


def test_lift_study_lifts_as_fast_as_its_run_says(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    pytest.importorskip("rosbags")
    import attrs

    from cloth_sim_ros.studies import study_file
    from cloth_sim_ros.studies.folder import StudyFolder
    from cloth_sim_ros.studies.study_estimate import sample_and_estimate
    from cloth_sim_ros.studies.study_run import perform

    assert (ROOT / "examples" / "lift_policy.py").is_file()
    study = attrs.evolve(study_file.read(ROOT / "examples" / "lift_study.yaml"), runs=2, duration=1.0)
    study_folder = StudyFolder(tmp_path / "lift")
    samples, _ = sample_and_estimate(study, 1)
    study_folder.create(study, samples, "")
    for run, values in enumerate(samples):
        row = perform(study_folder, study, run, values)
        # The targets are shaken by a millimetre, and springs hold the corner's particles.
        assert row["outcomes"]["lifted"] == pytest.approx(row["values"]["policy.speed"], abs=0.02), row["error"]


def test_grasp_node_lifts_the_corner_of_a_live_cloth(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    from support.ros_client import start_cloth

    cloth = start_cloth(start_process)
    robot = start_process([sys.executable, ROOT / "examples" / "grasp_node.py"], cwd=tmp_path)
    assert robot.wait() == 0, robot.output
    held, released = numbers(r"holds (\d+) particle", robot.output)
    assert held > 0
    assert released == 0
    assert cloth.interrupt() == 0, cloth.output


def test_depth_picture_shows_cloth_and_obstacles(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    from support.ros_client import start_cloth

    cloth = start_cloth(start_process, arguments=["--params-file", str(ROOT / "config" / "camera.yaml")])
    robot = start_process([sys.executable, ROOT / "examples" / "depth_picture.py"], cwd=tmp_path)
    assert robot.wait() == 0, robot.output
    tutorial = (ROOT / "docs" / "tutorials" / "camera.md").read_text()
    assert all(
        line in tutorial for line in robot.output.splitlines() if line.startswith(("cloth", "ball", "wall", "640"))
    )
    assert numbers(r"ball: (\S+) to", robot.output) == [1.55]
    assert (tmp_path / "depth.png").stat().st_size > 1000
    assert cloth.interrupt() == 0, cloth.output


def test_arm_takes_the_edge_and_pulls_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy")
    import numpy as np

    from cloth_sim_ros import MoveObstacles
    from cloth_sim_ros.scene.parameters import parameter_file
    from cloth_sim_ros.scene.robot.links import scene_with_links, without_links
    from cloth_sim_ros.scene.robot.pad_stops import PadStops

    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    assert (ROOT / "examples" / "arm.py").name == "arm.py"
    import arm

    values = parameter_file.read(ROOT / "config" / "robot_arm.yaml", strict=True)
    alone = Scene.from_parameters(without_links(values), folder=ROOT / "config")
    scene, links = scene_with_links(alone, values, folder=ROOT / "config")
    assert not links.notes
    simulation, stops = Simulation(scene), PadStops(scene, links)
    # From where the open fingers are about the edge; the arm stands still before.
    for t in np.arange(3.0, 4.5, scene.period):
        positions = stops.limit_positions(np.array(arm.joints(t)))
        frame = simulation.advance([MoveObstacles(links.names, links.poses(positions))])
        assert not frame.stopped
    closed, pulled = (links.link_pose("left_finger", np.array(arm.joints(t)))[0] for t in (4.0, 4.5))
    assert simulation.positions[:, 0].max() > 0.25 + 0.7 * (pulled - closed)


def play_arms(example: Any, config: str) -> tuple[Simulation, Any, Any]:
    """Play an example of arms on its scene; return the cloth at the end, the links and their joints over time."""
    import numpy as np
    from support.arm_examples import START, arm_events, arm_scene

    scene, links, joints = arm_scene(example, config)
    assert not links.notes
    assert (
        np.abs(joints(np.arange(START, joints.x[-1], scene.period), 1)).max() < 2.2
    )  # the slowest joint's limit [rad/s]
    simulation = Simulation(scene)
    for events in arm_events(scene, links, joints):
        assert not simulation.advance(events).stopped
    return simulation, links, joints


def test_arm_of_seven_joints_folds_the_towel(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy")
    import numpy as np

    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    assert all((ROOT / "examples" / name).exists() for name in ("arm_path.py", "arm_states.py"))
    import fold_towel

    simulation, _, _ = play_arms(fold_towel, "robot_fold.yaml")
    start = simulation.scene.initial_positions()
    right, left = (start[:, 0] * sign > 0.149 for sign in (1.0, -1.0))
    # One edge lies on the other one, and nobody holds it.
    edges = [simulation.positions[edge].mean(axis=0) for edge in (right, left)]
    assert abs(edges[0] - edges[1])[:2].max() < 0.03
    assert edges[0][2] > edges[1][2] + 0.5 * simulation.scene.contact.thickness
    assert np.abs(simulation.velocities).max() < 0.2


def test_arm_of_seven_joints_drapes_the_towel(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy")
    import numpy as np

    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import drape_towel

    simulation, links, joints = play_arms(drape_towel, "robot_drape.yaml")
    bar, positions = simulation.scene.described["bar"], simulation.positions
    (x, _, z), radius = bar.position, bar.size[0]
    # Both edges hang at their sides of the bar, and a layer lies on it. The hand is below the towel.
    start = simulation.scene.initial_positions()
    for sign in (1.0, -1.0):
        edge = positions[start[:, 0] * sign > 0.149]
        assert ((edge[:, 0] - x) * sign > 0.5 * radius).all()
        assert (edge[:, 2] < z - radius).all()
    assert 0.0 < positions[:, 2].max() - z - radius < 2.0 * simulation.scene.contact.thickness
    assert links.link_pose("left_finger", joints(joints.x[-1]))[2] + 0.06 < positions[:, 2].min()
    assert np.abs(simulation.velocities).max() < 0.2


def test_two_arms_lift_the_towel_by_its_corners(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy")
    import numpy as np

    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import lift_towel

    simulation, links, joints = play_arms(lift_towel, "robot_lift.yaml")
    scene = simulation.scene
    frictions = [
        scene.described[name].friction for name in links.names if scene.described[name].link in scene.robot.pads
    ]
    assert frictions == 4 * [scene.gripper.friction]
    # Each hand holds its corner, and the whole towel hangs above the table.
    start = scene.initial_positions()
    for arm, sign in (("left", 1.0), ("right", -1.0)):
        corner = simulation.positions[(start[:, 0] > 0.149) & (start[:, 1] * sign > 0.149)]
        hand = links.link_pose(f"{arm}_hand", joints(joints.x[-1]))[:3]
        assert np.linalg.norm(corner - hand) < 0.12
    assert simulation.positions[:, 2].min() > 0.05
    assert np.abs(simulation.velocities).max() < 0.2


@pytest.mark.parametrize(
    ("example", "done"),
    [("fold_towel.py", "has folded"), ("drape_towel.py", "has hung"), ("lift_towel.py", "have lifted")],
)
def test_arm_example_publishes_its_path(
    ros_domain: int, start_process: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, example: str, done: str
) -> None:
    pytest.importorskip("rclpy")
    import importlib

    from sensor_msgs.msg import JointState
    from support.ros_client import Client

    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    waypoints = importlib.import_module(example.removesuffix(".py")).WAYPOINTS
    with Client() as client:
        states: list[JointState] = []
        client.node.create_subscription(JointState, "/joint_states", states.append, 1000)
        arm = start_process([sys.executable, ROOT / "examples" / example, "--slower", "0.05"])
        client.spin_until(lambda: done in arm.output, description="the end of the path")
        assert arm.wait() == 0, arm.output
    fingers = [k for k, name in enumerate(states[0].name) if name.endswith("finger")]
    assert {len(state.position) for state in states} == {8 * len(fingers)}
    openings = [state.position[k] for state in states for k in fingers]
    assert openings[-1] == pytest.approx(waypoints[-1, 4], abs=2e-3)
    assert min(openings) == pytest.approx(0.0, abs=2e-3)


def test_pick_node_holds_the_towel_until_it_opens(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    from support.interface_packages import CONTROL_MSGS, build_package
    from support.ros_client import start_cloth

    folder, reason = build_package("control_msgs", CONTROL_MSGS)
    if folder is None:
        pytest.skip(reason)
    environment, scene = {"PYTHONPATH": str(folder)}, str(ROOT / "config" / "pinch_action.yaml")
    cloth = start_cloth(start_process, arguments=["--params-file", scene], env=environment)
    robot = start_process([sys.executable, ROOT / "examples" / "pick_node.py"], cwd=tmp_path, env=environment)
    assert robot.wait() == 0, robot.output
    assert re.findall(r"stalled (\w+), reached (\w+)", robot.output) == [("True", "False"), ("False", "True")]
    assert cloth.interrupt() == 0, cloth.output


def test_twist_node_leads_the_corner_of_a_live_cloth(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    from support.ros_client import start_cloth

    recording = ["record.enabled:=true", f"record.folder:={tmp_path}"]
    cloth = start_cloth(start_process, "gripper.twist_max_speed:=0.5", *recording)
    robot = start_process([sys.executable, ROOT / "examples" / "twist_node.py"], cwd=tmp_path)
    assert robot.wait() == 0, robot.output
    held, released = numbers(r"holds (\d+) particle", robot.output)
    assert held > 0
    assert released == 0
    assert cloth.interrupt() == 0, cloth.output
    (session,) = tmp_path.glob("*.mcap")
    from cloth_sim_ros.session.reader import SessionReader

    with SessionReader(session) as reader:
        events = [event for frame in reader.frames() for event in frame.events]
    heights = [event["position"][2] for event in events if event["kind"] == "target"]
    # It rises by 0.25 m/s for 1.5 s, and then goes sideways.
    assert max(heights) - heights[0] == pytest.approx(0.375, abs=0.08)


def test_mujoco_arm_lifts_and_pushes_a_towel(
    ros_domain: int, start_process: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("rclpy")
    pytest.importorskip("mujoco")
    from support.ros_client import start_cloth

    assert (ROOT / "examples" / "mujoco_arm.xml").exists()
    scene = ["--params-file", ROOT / "config" / "mujoco_towel.yaml"]
    cloth = start_cloth(start_process, arguments=scene, wait="Hz of /clock")
    arm = start_process([sys.executable, ROOT / "examples" / "mujoco_arm.py"], cwd=tmp_path)
    assert arm.wait() == 0, arm.output
    wrist = dict(zip(("lifts", "holds", "turns", "pushes"), numbers(r"wrist (\S+) N", arm.output), strict=True))
    forearm = numbers(r"forearm (\S+) N", arm.output)
    weight = 0.2 * 0.4 * 0.4 * 9.81
    assert wrist["holds"] == pytest.approx(weight, rel=0.02)
    assert forearm[:2] == [0.0, 0.0]
    assert forearm[3] > 1e-3
    assert wrist["pushes"] == pytest.approx(weight, rel=0.1)
    assert cloth.interrupt() == 0, cloth.output
