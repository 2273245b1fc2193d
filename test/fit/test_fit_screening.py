# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Screening of clouds before a fit: lengths along the sheet."""

import numpy as np
import pytest

from cloth_sim_ros.fit.hypotheses import selections
from cloth_sim_ros.fit.recorded import RecordedGripper, Recording
from cloth_sim_ros.fit.screening import length_ratios, screen_clouds
from cloth_sim_ros.fit.start import motion_recording
from cloth_sim_ros.scene.scene import Scene

SCENE = Scene.from_parameters({"cloth.resolution": [8, 8], "cloth.anchors": [""], "grippers": ["left", "right"]})
FLAT = SCENE.sheet.positions()


def bent(radius):
    """The sheet on a cylinder: lengths along it stay."""
    x = FLAT.copy()
    x[:, 0], x[:, 2] = radius * np.sin(FLAT[:, 0] / radius), radius * np.cos(FLAT[:, 0] / radius)
    return x


def screened(clouds):
    held = {name: k for name, k in zip(SCENE.gripper_names, (0, 7), strict=False)}
    grippers = {
        name: RecordedGripper(times=[0.0, 9.0], positions=[clouds[0][k]] * 2, quaternions=[[0.0, 0.0, 0.0, 1.0]] * 2)
        for name, k in held.items()
    }
    recording = Recording(name="real", times=0.1 * np.arange(len(clouds)), clouds=clouds, grippers=grippers)
    return screen_clouds([motion_recording(recording, SCENE, selections({name: (k,) for name, k in held.items()}))])


def test_bending_keeps_the_lengths():
    assert length_ratios([FLAT], SCENE)[0] == pytest.approx([1.0, 1.0])
    assert length_ratios([bent(0.4)], SCENE)[0] == pytest.approx([1.0, 1.0], abs=0.01)
    compressed = FLAT * [0.9, 1.0, 1.0]
    assert sorted(length_ratios([compressed], SCENE)[0]) == pytest.approx([0.9, 1.0], abs=0.01)
    hidden = FLAT.copy()
    hidden[8:] = np.nan
    assert np.isnan(length_ratios([hidden], SCENE)).any(), "a row shows no length across"


def test_cloud_that_misses_a_part_is_left_out():
    low = FLAT * [1.0, 0.9, 1.0]
    result = screened([FLAT, FLAT, low, bent(0.4), bent(0.4)])
    assert result.used[0].tolist() == [0, 1, 3, 4]
    assert result.left_out().shortened == 1
    assert result.left_out().total == 1


def test_noise_and_stretch_shorten_no_cloud():
    rng = np.random.default_rng(3)
    noisy = [FLAT + 0.005 * rng.standard_normal(FLAT.shape) for _ in range(8)]
    stretched = [FLAT * [1.0, 1.0 + 0.02 * k, 1.0] for k in range(8)]
    assert screened(noisy).n_shortened == 0
    assert screened(stretched).n_shortened == 0


def test_folds_of_all_clouds_are_the_usual_length():
    """Particles too far apart for the folds between them have short distances in every cloud."""
    folded = [FLAT * [0.8, 1.0, 1.0]] * 6
    assert screened([*folded, FLAT * [0.7, 1.0, 1.0]]).used[0].tolist() == list(range(6))
