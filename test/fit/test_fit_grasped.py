# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Grasped particles of a real cloth that hands hide."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap")

from support.fit_samples import START, cloth, hands, random_truth, write_bag
from support.session_maker import cloud_bytes

from cloth_sim_ros.fit import main as fit_main
from cloth_sim_ros.fit.bag import read_bag
from cloth_sim_ros.fit.grasped import describe_grasped, find_grasped
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.recording import FitRecording
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

TRUTH = random_truth(3)
LAST = 5


def scene_of(resolution: int = 6) -> Scene:
    return cloth({**START, "rate": 60.0}, resolution=resolution)


def hidden(
    seed: int, *, noise: float, reach: float = 0.05, missing: float = 1 / 3
) -> Callable[[np.ndarray, int], bytes]:
    """Return a camera whose clouds lack the particles near the hands, within `reach` [m], and a fraction of others."""
    random = np.random.default_rng(seed)

    def see(x: np.ndarray, stamp: int) -> bytes:
        seen = x + random.normal(scale=noise, size=x.shape)
        for hand in hands(0.0):
            seen[np.linalg.norm(x - hand, axis=1) < reach] = np.nan
        seen[random.random(len(x)) < missing] = np.nan
        return cloud_bytes(seen, stamp, (1, len(x)))

    return see


def grasped_particles(recording: FitRecording) -> list[list[int]]:
    """Return the indices of the grasped particles of each gripper in the first frame."""
    simulation = Simulation(recording.scene, recording.state)
    simulation.advance(recording.events[0])
    return [simulation.grippers.grasped_particles(k).tolist() for k in range(2)]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("held") / "hidden.mcap"
    return write_bag(path, TRUTH, seconds=0.4, see=hidden(0, noise=0.002))


@pytest.mark.parametrize("noise", [0.002, 0.005])
def test_hidden_grasped_corners_are_found(tmp_path: Path, noise: float) -> None:
    path = write_bag(tmp_path / "hidden.mcap", TRUTH, seconds=0.4, see=hidden(1, noise=noise))
    recording = read_bag([path], scene_of())
    assert grasped_particles(recording) == [[0], [LAST]]
    assert [selection.particles for selection in recording.grasped] == [(0,), (LAST,)]
    assert not any(selection.is_seen for selection in recording.grasped)
    left = describe_grasped(recording.grasped[0], recording.scene)
    assert left.startswith("Gripper 'left' holds particle 0 (top_left) (hidden, by its neighbours' positions): ")


def sagging(resolution: int) -> tuple[Scene, np.ndarray]:
    """Return a scene, and the positions of its sheet on a cylinder, like a bulging sheet between two corners."""
    scene = scene_of(resolution)
    x, _, z = scene.initial_positions().T
    bulge = 0.25
    return scene, np.stack([bulge * np.sin(x / bulge), 0.4 * (1.2 - z) + bulge * np.cos(x / bulge), z], axis=1)


@pytest.mark.parametrize("noise", [0.002, 0.005])
@pytest.mark.parametrize("grip", [0, 4, 44])
def test_hidden_particle_is_found_or_refused(noise: float, grip: int) -> None:
    # Particles 0, 4 and 44 are a corner, an edge and the middle of 10 x 10. In 100 random recordings of 8 clouds, each
    # grasp is found or refused.
    scene, x = sagging(10)
    random, refused = np.random.default_rng(grip), 0
    for _ in range(100):
        clouds = []
        for _ in range(8):
            cloud = x + random.normal(scale=noise, size=x.shape)
            cloud[(np.linalg.norm(x - x[grip], axis=1) < 0.05) | (random.random(len(x)) < 1 / 3)] = np.nan
            clouds.append(cloud)
        pose = [*(x[grip] + random.normal(scale=0.001, size=3)).tolist(), 0.0, 0.0, 0.0, 1.0]
        try:
            selection, places = find_grasped(scene, "left", clouds, [pose] * 8)
        except FitError as error:
            refused += "--held left=" in str(error)
            continue
        assert selection.particles == (grip,)
        assert places[grip] == pytest.approx([0.0, 0.0, 0.0])
    assert refused <= (5 if noise == 0.002 else 40)


def test_ambiguous_grasp_is_refused(tmp_path: Path) -> None:
    # Both upper rows are hidden, and the recording has only one cloud.
    see = hidden(2, noise=0.005, reach=0.2, missing=0.5)
    path = write_bag(tmp_path / "far.mcap", TRUTH, seconds=0.0, see=see)
    with pytest.raises(FitError, match=r"gripper '\w+' may hold particle \d+ or \d+: .* --held \w+=\d+"):
        read_bag([path], scene_of())
    recording = read_bag([path], scene_of(), grasped={"left": "0", "right": "top_right"})
    assert grasped_particles(recording) == [[0], [LAST]]
    assert all(selection.is_named for selection in recording.grasped)


def test_named_particles_are_grasped(bag: Path) -> None:
    recording = read_bag([bag], scene_of(), grasped={"left": "0, 6"})
    assert grasped_particles(recording) == [[0, 6], [LAST]]
    assert recording.state is not None
    # The gripper's origin is the mean of the two.
    middle = recording.state.positions[[0, 6]].mean(axis=0)
    assert middle == pytest.approx(hands(0.0)[0], abs=1e-9)


def test_poses_away_from_cloth_are_refused(bag: Path) -> None:
    poses = {"left": "/robot/left/pose", "right": "/robot/left/pose"}
    with pytest.raises(FitError, match="would both hold particle 0"):
        read_bag([bag], scene_of(), poses=poses)
    scene, x = sagging(6)
    pose = [*(x[0] + np.array([0.0, 0.0, 0.2])), 0.0, 0.0, 0.0, 1.0]
    with pytest.raises(FitError, match="200 mm from the nearest particle, 0: its poses do not touch the cloth"):
        find_grasped(scene, "left", [x] * 3, [pose] * 3)


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ("left=36", "names particle 36; there are 36"),
        ("left=top_middle", "no edge or corner"),
        ("middle=0", "grippers are left, right"),
        ("left", "write NAME=VALUE"),
    ],
)
def test_wrong_grasped_particles_are_refused(
    bag: Path, tmp_path: Path, known: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from cloth_sim_ros.scene.parameters import parameter_file

    scene = tmp_path / "scene.yaml"
    scene.write_text(parameter_file.dump(scene_of().parameters()))
    options = ["--scene", str(scene), "--parameters", "stretch", "--held", known]
    assert fit_main.main([str(bag), *options]) == fit_main.REFUSED
    assert words in capsys.readouterr().err
