# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of a real cloth that begin at rest or in motion."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap")

from support.fit_samples import START, cloth, random_truth, write_bag
from support.session_maker import cloud_bytes

from cloth_sim_ros.fit import main as fit_main
from cloth_sim_ros.fit.bag import read_bag
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.scene.scene import Scene

TRUTH = random_truth(3)


def scene_of() -> Scene:
    return cloth({**START, "rate": 60.0}, resolution=6)


def noisy(noise: float, missing: float = 1 / 3) -> Callable[[np.ndarray, int], bytes]:
    random = np.random.default_rng(3)

    def see(x: np.ndarray, stamp: int) -> bytes:
        seen = x + random.normal(scale=noise, size=x.shape)
        seen[random.random(len(x)) < missing] = np.nan
        return cloud_bytes(seen, stamp, (1, len(x)))

    return see


@pytest.mark.parametrize("rate", [30, 60])
@pytest.mark.parametrize("noise", [0.0, 0.002, 0.005])
def test_recording_from_rest_is_read(tmp_path: Path, rate: int, noise: float) -> None:
    # The hands start to move at the first cloud.
    path = write_bag(tmp_path / "rest.mcap", TRUTH, seconds=0.5, see=noisy(noise), rate=rate)
    assert read_bag([path], scene_of()).seconds[0] == 0.0


@pytest.mark.parametrize("rate", [30, 60])
@pytest.mark.parametrize("noise", [0.0, 0.002, 0.005])
@pytest.mark.parametrize("begin", [0.2, 0.4])
def test_recording_from_motion_is_refused(tmp_path: Path, rate: int, noise: float, begin: float) -> None:
    path = write_bag(tmp_path / "moving.mcap", TRUTH, seconds=1.0, see=noisy(noise), rate=rate, begin=begin)
    with pytest.raises(FitError, match=r"moves at \d+ mm/s at the first cloud.* Begin the recording before"):
        read_bag([path], scene_of())


@pytest.mark.parametrize("noise", [0.002, 0.005])
def test_swinging_cloth_under_still_hands_is_refused(tmp_path: Path, noise: float) -> None:
    path = write_bag(tmp_path / "swings.mcap", TRUTH, seconds=1.6, see=noisy(noise), begin=0.85, still=0.8)
    with pytest.raises(FitError, match=r"the cloth moves .* though its grippers stand still"):
        read_bag([path], scene_of())


def test_refused_recording_is_read_from_suggested_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Thick air damps the swing quickly.
    values = {**TRUTH, "air.drag": 6.0}
    path = write_bag(tmp_path / "stops.mcap", values, seconds=3.0, see=noisy(0.002), begin=0.3, still=2.4)
    scene = cloth({**START, "rate": 60.0, "air.drag": 6.0}, resolution=6)
    with pytest.raises(FitError, match=r"--from \d\.\d\d") as caught:
        read_bag([path], scene)
    begin = float(str(caught.value).rsplit("--from ", 1)[1])
    assert 0.3 < begin < 2.5
    recording = read_bag([path], scene, first_time=begin)
    assert recording.seconds[0] == 0.0
    assert len(recording.clouds) < 82
    out = tmp_path / "scene.yaml"
    out.write_text(parameter_file.dump(scene.parameters()))
    options = ["--scene", str(out), "--parameters", "stretch"]
    assert fit_main.main([str(path), *options]) == fit_main.REFUSED
    assert "moves at" in capsys.readouterr().err
    assert fit_main.main([str(path), *options, "--from", "9"]) == fit_main.REFUSED
    assert "--from is 9 s; it must be from 0 to 2.70" in capsys.readouterr().err
