# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fits to several motions of a real cloth, seen by a camera that is late and turned."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from support.motion_samples import CAMERA, HELD, TRUTH, record_motions, scene_of

from cloth_sim_ros.fit import hypotheses, rest_shapes
from cloth_sim_ros.fit.alignment import MAX_OFFSET, Alignment, moved_points
from cloth_sim_ros.fit.grasped import particles_within
from cloth_sim_ros.fit.hypotheses import GraspChoice, Hypothesis, plausible_particles
from cloth_sim_ros.fit.main import grasped_of_groups
from cloth_sim_ros.fit.motions import held_out_indices
from cloth_sim_ros.fit.motions_files import write_json
from cloth_sim_ros.fit.motions_result import MotionFit
from cloth_sim_ros.fit.motions_text import describe_choice, describe_motions
from cloth_sim_ros.fit.parameters import FitError
from cloth_sim_ros.fit.real import fit_real
from cloth_sim_ros.fit.recorded import RecordedGripper, Recording
from cloth_sim_ros.fit.screening import screen_clouds
from cloth_sim_ros.fit.start import motion_recording
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene

#: A short settling time, in this process.
QUICK: dict[str, Any] = {"settle_time": 1.5, "workers": 1}
NAMED = {"left": "top_left", "right": "top_right"}


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return record_motions(5)


@pytest.fixture(scope="module")
def fitted(recordings: list[Recording]) -> MotionFit:
    wrong = attrs.evolve(recordings[2], clouds=[3.0 * recordings[2].clouds[0], *recordings[2].clouds[1:]])
    scene = scene_of(wind__normal_drag=0.5)
    return fit_real([*recordings[:2], wrong, *recordings[3:]], scene, ["normal_drag"], grasped=NAMED, **QUICK)


def test_late_turned_clouds_give_right_drag(fitted: MotionFit) -> None:
    (estimate,) = fitted.estimates
    # One motion informs more than the others together. The jackknife's deviation is of one freedom then, and may be
    # small by chance; that of the noise is not.
    noise = float(np.linalg.inv(fitted.solution.equations.information.sum(axis=0))[0, 0]) ** 0.5
    assert abs(np.log(estimate.value / TRUTH["wind.normal_drag"])) < 3.0 * noise
    assert noise < 0.01
    assert estimate.bound < 0.1
    assert estimate.freedom is not None
    assert 1.0 <= estimate.freedom <= 4.0
    assert not estimate.is_identified
    assert fitted.alignments[0] is not None
    assert fitted.alignments[0].offset == pytest.approx(CAMERA.offset, abs=0.005)
    assert fitted.alignments[0].angle == pytest.approx(CAMERA.angle, abs=0.01)


def test_motion_scores_lie_between_floor_and_rigid(fitted: MotionFit) -> None:
    assert fitted.held_out is not None
    assert fitted.held_out.rms < 0.006 < fitted.rigid.rms
    assert all(entry.model.rms < entry.rigid.rms for entry in fitted.motions)
    assert fitted.floor is not None
    assert fitted.floor.rms == pytest.approx(np.sqrt(3.0) * 0.002, rel=0.4)
    assert fitted.floor_basis == "neighbours of the driven particles"


def test_cloud_of_other_scale_is_left_out(fitted: MotionFit) -> None:
    assert fitted.left_out.wrong_scale == 1
    assert fitted.left_out.total == 1
    assert fitted.n_clouds == fitted.n_recorded_clouds - fitted.left_out.total


def test_report_states_alignment_and_intervals(fitted: MotionFit, tmp_path: Path) -> None:
    text = describe_motions(fitted)
    assert "Held particles, as named: left 0, right 4." in text
    assert "Clouds are late by 0.3" in text
    assert "left out: 1 of another scale" in text
    assert "Intervals treat each of 5 motions as one independent observation" in text
    write_json(fitted, tmp_path / "fit.json")
    written = json.loads((tmp_path / "fit.json").read_text())
    assert written["parameters"][0]["freedom"] == fitted.estimates[0].freedom
    assert written["left_out"]["wrong_scale"] == 1


def test_report_states_misfit_beyond_floor(fitted: MotionFit) -> None:
    assert "Misfit" not in describe_motions(attrs.evolve(fitted, excess=None))
    assert "Misfit: 4.2 mm" in describe_motions(attrs.evolve(fitted, excess=0.0042))


def test_rotation_beyond_a_camera_error_is_doubted(fitted: MotionFit) -> None:
    assert "more than an error of the camera's pose" not in describe_motions(fitted)
    alignments = [attrs.evolve(alignment, rotation=(0.0, 0.0, 2.82)) for alignment in fitted.alignments if alignment]
    text = describe_motions(attrs.evolve(fitted, alignments=tuple(alignments)))
    assert "162 degrees are more than an error of the camera's pose, 35 at most: check the order" in text


def test_recording_of_another_cloth_is_named(recordings: list[Recording]) -> None:
    curtain = attrs.evolve(recordings[2], name="curtain", clouds=[2.5 * cloud for cloud in recordings[2].clouds])
    fit = fit_real([*recordings[:2], curtain], scene_of(), ["normal_drag"], grasped=NAMED, **QUICK)
    assert fit.unused == ("curtain",)
    assert "curtain is not used: none of its clouds can be this cloth" in describe_motions(fit)
    assert fit.left_out.wrong_scale == len(curtain.clouds)


def test_few_clean_motions_give_drag_without_interval() -> None:
    scene = scene_of(wind__normal_drag=0.45)
    # Without noise a cloth that still swings a little at the start would decide.
    settled = {**QUICK, "settle_time": 3.0}
    fit = fit_real(record_motions(2, noise=1e-5), scene, ["normal_drag"], grasped=NAMED, **settled)
    assert fit.values["wind.normal_drag"] == pytest.approx(TRUTH["wind.normal_drag"], rel=1e-3)
    assert not fit.estimates[0].has_interval
    assert not fit.all_identified
    assert "No intervals: fewer than 5 motions" in describe_motions(fit)


def test_exchanged_particles_are_named_and_do_no_harm(recordings: list[Recording]) -> None:
    first = recordings[0]
    clouds = [cloud.copy() for cloud in first.clouds]
    for cloud in clouds:
        cloud[[8, 16]] = cloud[[16, 8]]
    scene = scene_of(wind__normal_drag=0.5)
    fit = fit_real([attrs.evolve(first, clouds=clouds)], scene, ["normal_drag"], grasped=NAMED, **QUICK)
    # A cloth that settled from the first cloud would be tangled.
    assert fit.values["wind.normal_drag"] == pytest.approx(TRUTH["wind.normal_drag"], rel=0.1)
    assert fit.doubt == "the points of particles 8, 16 lie at each other: correct their order in the recording"
    assert not fit.all_identified


def test_order_of_rest_shapes_does_not_turn_the_camera(
    recordings: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    settle, n_shapes = rest_shapes.settle, list[int]()

    def settle_in_reverse(*arguments: Any) -> dict[int, list[State]]:
        shapes = {k: states[::-1] for k, states in settle(*arguments).items()}
        n_shapes.extend(len(states) for states in shapes.values())
        return shapes

    # The sheet bulges to one side. With the other side a turned camera fits best.
    monkeypatch.setattr(rest_shapes, "settle", settle_in_reverse)
    fit = fit_real(recordings[:1], scene_of(wind__normal_drag=0.5), ["normal_drag"], grasped=NAMED, **QUICK)
    assert min(n_shapes) > 1
    assert fit.alignments[0] is not None
    assert np.abs(np.subtract(fit.alignments[0].rotation, CAMERA.rotation)).max() < 0.01


def test_mirrored_axis_is_doubted(recordings: list[Recording]) -> None:
    mirrored = attrs.evolve(recordings[0], clouds=[cloud * [1.0, -1.0, 1.0] for cloud in recordings[0].clouds])
    fit = fit_real([mirrored], scene_of(wind__normal_drag=0.5), ["normal_drag"], grasped=NAMED, **QUICK)
    assert fit.alignments[0] is not None
    assert fit.alignments[0].offset == MAX_OFFSET
    assert "the time offset of motion_0 is at its limit, 0.600 s: correct the stamps" in fit.doubt


@pytest.mark.parametrize("axes", [[1.0, 1.0, -1.0], [-1.0, -1.0, -1.0]])
def test_points_that_fit_when_mirrored_are_told(recordings: list[Recording], axes: list[float]) -> None:
    x = recordings[0].clouds[0][np.isfinite(recordings[0].clouds[0]).all(axis=1)]
    bent = x + np.outer(x[:, 0] * x[:, 2], [0.0, 1.0, 0.0])
    assert np.abs(moved_points(bent, bent * axes, -1.0) - bent * axes).max() < 1e-12
    assert np.abs(moved_points(bent, bent * axes) - bent * axes).max() > 0.01


def test_held_out_motion_states_its_own_time_offset(tmp_path: Path) -> None:
    # Between two offsets of the search's grid.
    late = Alignment(offset=0.1, rotation=(0.0,) * 3, shift=(0.0,) * 3)
    options: dict[str, Any] = {"time_offset": "each", "camera_pose": "no", "held_out": 1, "grasped": NAMED, **QUICK}
    recordings = record_motions(3, camera=late)
    empty = attrs.evolve(recordings[0], clouds=[9.0 * cloud for cloud in recordings[0].clouds])
    fit = fit_real([*recordings, empty], scene_of(), ["normal_drag"], **options)
    assert [entry.is_held_out for entry in fit.motions] == [False, False, True]
    assert [entry and entry.offset for entry in fit.alignments] == [*[pytest.approx(0.1, abs=0.003)] * 3, None]
    assert "Clouds are late by 0.0" not in describe_motions(fit)
    write_json(fit, tmp_path / "fit.json")
    assert json.loads((tmp_path / "fit.json").read_text())["alignment"][3] is None


def test_particles_are_named_for_each_recording(recordings: list[Recording]) -> None:
    fit = fit_real(recordings[:2], scene_of(), ["normal_drag"], grasped=[NAMED, {"left": "0", "right": "3"}], **QUICK)
    held = [{entry.gripper: entry.particles for entry in recording.grasped} for recording in fit.recordings]
    assert held == [{"left": (0,), "right": (4,)}, {"left": (0,), "right": (3,)}]
    assert f"Held particles of {fit.recordings[1].name}: left 0, right 3." in describe_motions(fit)
    with pytest.raises(FitError, match="no particles of gripper 'right'"):
        fit_real(recordings[:2], scene_of(), ["normal_drag"], grasped=[NAMED, {"left": "0"}], **QUICK)


def test_held_particles_of_files_are_told_apart() -> None:
    paths = [Path("a/swing_1.mcap"), Path("a/swing_2.mcap")]
    assert grasped_of_groups({"left": "0"}, paths) == {"left": "0"}
    expected = [{"left": "0"}, {"left": "0", "right": "4"}]
    assert grasped_of_groups({"left": "0", "swing_2:right": "4"}, paths) == expected
    with pytest.raises(FitError, match="names 0 files"):
        grasped_of_groups({"swing_3:right": "4"}, paths)


def test_motion_chooses_right_corners(recordings: list[Recording]) -> None:
    fit = fit_real(recordings[:2], scene_of(), ["normal_drag"], **QUICK)
    assert fit.grasp is not None
    assert dict(fit.grasp.best.particles) == HELD
    lines = list(describe_choice(fit.grasp))
    assert lines[0].startswith("Held particles, of ")
    assert len(lines) > 2


def hanging_from(particles: dict[str, int], resolution: int) -> tuple[Scene, Recording]:
    """Return a sheet of 0.3 m, and a recording of it at rest with shifted grippers at some of its particles."""
    values = {"cloth.size": [0.3, 0.3], "cloth.resolution": [resolution] * 2, "cloth.anchors": [""]}
    scene = Scene.from_parameters({**values, "grippers": list(particles)})
    x, times = scene.initial_positions(), np.arange(5) / 30.0
    shift, random = np.array([0.03, 0.01, -0.02]), np.random.default_rng(6)
    tracks = {}
    for name, particle in particles.items():
        position = x[particle] + shift + 0.005 * random.normal(size=3)
        quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
        tracks[name] = RecordedGripper(times=times, positions=np.tile(position, (5, 1)), quaternions=quaternions)
    return scene, Recording(name="still", times=times, clouds=[x] * 5, grippers=tracks)


def test_few_of_many_combinations_are_ranked(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, recording = hanging_from({"a": 0, "b": 12, "c": 168}, 13)
    x, ranked = scene.sheet.positions(), list[Sequence[int]]()
    offsets = np.array([scene.initial_positions() - recording.grippers[name].positions[0] for name in "abc"])
    # private: the combinations that are ranked are counted.
    rank = hypotheses._implausibility

    def count(vectors: np.ndarray, combination: Sequence[int]) -> float:
        ranked.append(combination)
        return rank(vectors, combination)

    monkeypatch.setattr(hypotheses, "_implausibility", count)
    chosen = plausible_particles([recording], scene, {}, 0.0)
    assert len(ranked) <= 4096
    limit = scene.gripper.radius + hypotheses.PLAUSIBLE_DISTANCE
    candidates = [np.flatnonzero(np.linalg.norm(part, axis=1) <= limit).tolist() for part in offsets]
    assert np.prod([len(part) for part in candidates]) > 30000
    best = sorted(itertools.product(*candidates), key=lambda combination: rank(offsets, combination))[:16]
    radius = scene.gripper.radius
    expected = [{name: particles_within(x, k, radius) for name, k in zip("abc", ks, strict=True)} for ks in best]
    assert chosen == expected


def test_four_grippers_at_one_corner_hold_different_particles() -> None:
    scene, recording = hanging_from({"a": 0, "b": 0, "c": 1, "d": 13}, 13)
    (first, *_) = plausible_particles([recording], scene, {}, 0.0)
    assert len({particles[0] for particles in first.values()}) == 4


def test_grippers_at_one_particle_alone_are_refused() -> None:
    scene, recording = hanging_from({"a": 0, "b": 0}, 2)
    with pytest.raises(FitError, match="grippers a, b are near the same particle alone"):
        plausible_particles([recording], scene, {}, 0.0)


def test_tie_of_hypotheses_is_reported() -> None:
    def hypothesis(particle: int, distance: float) -> Hypothesis:
        return Hypothesis(particles={"left": (particle,)}, distances={k: distance + 1e-3 * k for k in range(6)})

    choice = GraspChoice(hypotheses=(hypothesis(0, 0.01), hypothesis(1, 0.02)), is_named=False, grippers=("left",))
    assert not choice.is_tie
    tie = attrs.evolve(choice, hypotheses=(hypothesis(0, 0.01), hypothesis(1, 0.01005)))
    assert tie.is_tie
    assert "tie" in "\n".join(describe_choice(tie))


def test_clouds_in_millimetres_are_refused(recordings: list[Recording]) -> None:
    wrong = attrs.evolve(recordings[0], clouds=[1e3 * cloud for cloud in recordings[0].clouds])
    with pytest.raises(FitError, match="millimetres"):
        screen_clouds([motion_recording(wrong, scene_of(), [])])


def test_unusable_options_are_refused(recordings: list[Recording]) -> None:
    with pytest.raises(FitError, match="--held-out is 2; it must be from 0 to 1"):
        fit_real(recordings[:2], scene_of(), ["normal_drag"], grasped=NAMED, held_out=2, **QUICK)
    with pytest.raises(FitError, match="the camera pose is 'some'"):
        fit_real(recordings[:2], scene_of(), ["normal_drag"], grasped=NAMED, camera_pose="some", **QUICK)
    with pytest.raises(FitError, match="workers is -1; at least 1"):
        fit_real(recordings[:2], scene_of(), ["normal_drag"], grasped=NAMED, **(QUICK | {"workers": -1}))
    runs: list[int] = []
    with pytest.raises(FitError, match="within is 2"):
        fit_real(recordings[:2], scene_of(), ["normal_drag"], within=2.0, on_progress=runs.append, **QUICK)
    assert not runs
    with pytest.raises(FitError, match="times for"):
        attrs.evolve(recordings[0], times=recordings[0].times[1:])
    moving = recordings[0].since(0.7)
    tracks = {
        name: attrs.evolve(
            track, times=track.times[20:], positions=track.positions[20:], quaternions=track.quaternions[20:]
        )
        for name, track in moving.grippers.items()
    }
    with pytest.raises(FitError, match=r"moves at .* start by --from"):
        motion_recording(attrs.evolve(moving, grippers=tracks), scene_of(), [], max_offset=0.1)


def test_held_out_recordings_are_spread() -> None:
    assert held_out_indices(40, 4) == [5, 15, 25, 35]
    assert held_out_indices(3, 0) == []
