# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ensembles of cloths with uncertain parameters: statistics, events, snapshots, threads, failures."""

from __future__ import annotations

import json
import pickle
from typing import Any

import numpy as np
import pytest

from cloth_sim_ros.scene.distribution import Distribution
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.ensemble import Ensemble, EnsembleError
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Reset, SetParameters, Step, Target
from cloth_sim_ros.simulation.simulation import Simulation

SWING = {"cloth.resolution": [5, 6], "cloth.size": [0.4, 0.5], "cloth.anchors": ["top_left"], "rate": 30.0}


def scene_of(**values: Any) -> Scene:
    return Scene.from_parameters({**SWING, **values})


def vary(**deviations: float) -> Distribution:
    entries = [{"name": name.replace("__", "."), "deviation": value} for name, value in deviations.items()]
    return Distribution.from_bytes(json.dumps({"parameters": entries}).encode(), "test")


TWO = vary(air__drag=0.3, material__stretch_modulus=0.2)


def script(scene: Scene) -> list[list[Event]]:
    corner = tuple(scene.initial_positions()[-1].tolist())
    frames: list[list[Event]] = [[] for _ in range(24)]
    frames[2] = [Target("gripper", corner), Grasp("gripper", True)]
    frames[5] = [Target("gripper", (corner[0], corner[1] - 0.1, corner[2] + 0.1))]
    frames[9] = [SetParameters({"air.drag": 0.5, "gravity": [0.0, 1.0, -9.0]})]
    frames[12] = [Grasp("gripper", False)]
    frames[14], frames[15], frames[17] = [Pause(True)], [Step()], [Pause(False)]
    return frames


def test_members_are_cloths_with_scaled_parameters() -> None:
    scene, factors = scene_of(), TWO.factors()
    references = [Simulation(scene) for _ in factors]
    drag, modulus = scene.air.drag, scene.material.stretch_modulus
    with Ensemble(scene, TWO, threads=1) as ensemble:
        for k, events in enumerate(script(scene)):
            frame = ensemble.advance(events)
            for reference, (drag_factor, modulus_factor) in zip(references, factors, strict=True):
                first = {"air.drag": drag * drag_factor, "material.stretch_modulus": modulus * modulus_factor}
                scaled: list[Event] = [SetParameters(first)] if k == 0 else []
                later = {"air.drag": 0.5 * drag_factor, "gravity": [0.0, 1.0, -9.0]}
                scaled += [SetParameters(later)] if k == 9 else events
                reference.advance(scaled)
        x = np.stack([reference.positions for reference in references])
        assert ensemble.positions.tobytes() == x.tobytes()
        assert ensemble.size == 4
        assert (frame.index, frame.time) == (references[0].frame, references[0].time)
    mean = x.mean(axis=0)
    assert frame.mean == pytest.approx(mean, abs=1e-15)
    distances = np.linalg.norm(x - mean, axis=2)
    assert frame.deviation == pytest.approx(np.sqrt(np.square(distances).mean(axis=0)), abs=1e-15)
    assert frame.largest == frame.deviation.max() > 0.001
    assert frame.root_mean_square == pytest.approx(float(np.sqrt(np.square(frame.deviation).mean())))


def test_anchored_particle_has_no_deviation() -> None:
    with Ensemble(scene_of(**{"cloth.position": [0.1, 0.2, 0.3]}), TWO, threads=1) as ensemble:
        for _ in range(6):
            frame = ensemble.advance()
    assert frame.deviation[0] == 0.0
    assert frame.deviation[1:].min() > 0.0


def test_small_deviations_follow_the_derivatives() -> None:
    # First order: the variance is the sum over parameters of (derivative times deviation), squared.
    scene, small = scene_of(tolerance=1e-6), vary(air__drag=0.02, material__density=0.01)
    derivatives = []
    for name, value in (("air.drag", 0.2), ("material.density", 0.2)):
        ends = [Simulation(scene_of(**{name: value * np.exp(step)}, tolerance=1e-6)) for step in (0.01, -0.01)]
        for _ in range(20):
            for end in ends:
                end.advance()
        derivatives.append((ends[0].positions - ends[1].positions) / 0.02)
    expected = np.sqrt(sum(np.square(d * s).sum(axis=1) for d, s in zip(derivatives, (0.02, 0.01), strict=True)))
    with Ensemble(scene, small, threads=1) as ensemble:
        for _ in range(20):
            frame = ensemble.advance()
    assert frame.deviation == pytest.approx(expected, rel=0.02, abs=2e-6)


def test_threads_and_snapshots_keep_the_bits() -> None:
    scene = scene_of()
    with Ensemble(scene, TWO, threads=1) as single, Ensemble(scene, TWO, threads=3) as several:
        frames = script(scene)
        for events in frames[:8]:
            single.advance(events)
        saved = pickle.loads(pickle.dumps(single.snapshot()))
        for events in frames[8:]:
            single.advance(events)
        several.restore(saved)
        assert several.frame == 8
        for events in frames[8:]:
            frame = several.advance(events)
        assert several.positions.tobytes() == single.positions.tobytes()
        assert frame.deviation.tobytes() == single.statistics().deviation.tobytes()


def test_fresh_snapshot_still_varies_the_members() -> None:
    with Ensemble(scene_of(), TWO, threads=1) as ensemble:
        fresh = ensemble.snapshot()
        first = ensemble.advance()
        ensemble.restore(fresh)
        assert ensemble.advance().deviation.tobytes() == first.deviation.tobytes()
        for scene, members, reason in ((scene_of(), 3, "has 3 members"), (scene_of(rate=60.0), 0, "rate is 60")):
            with Ensemble(scene, TWO, members=members, threads=1) as stranger, pytest.raises(ValueError, match=reason):
                ensemble.restore(stranger.snapshot())


def test_ensemble_starts_in_the_middle_of_a_motion() -> None:
    scene = scene_of()
    simulation = Simulation(scene)
    for _ in range(10):
        simulation.advance()
    with Ensemble(scene, TWO, state=simulation.state, threads=1) as ensemble:
        assert ensemble.statistics().largest == 0.0
        frame = ensemble.advance()
        assert frame.index == 11
        early = frame.largest
        for _ in range(10):
            frame = ensemble.advance()
        assert 0.0 < early < 0.1 * frame.largest


def test_reset_returns_the_members_to_the_start() -> None:
    with Ensemble(scene_of(), TWO, threads=1) as ensemble:
        first = ensemble.advance().largest
        for _ in range(10):
            last = ensemble.advance().largest
        assert ensemble.advance([Reset()]).largest == pytest.approx(first, rel=0.1)
        assert last > 10.0 * first


def test_sample_depends_on_its_seed_alone() -> None:
    results = []
    for seed in (5, 5, 6):
        with Ensemble(scene_of(), TWO, members=4, seed=seed, threads=2) as ensemble:
            assert ensemble.size == 4
            results.append(ensemble.advance().deviation.tobytes())
    assert results[0] == results[1] != results[2]
    with pytest.raises(ValueError, match="members is 1"):
        Ensemble(scene_of(), TWO, members=1)


def test_failing_member_leaves_all_as_they_were() -> None:
    scene = scene_of(**{"contact.thickness": 0.01})
    with Ensemble(scene, vary(contact__thickness=0.1, air__drag=0.1), threads=1) as ensemble:
        ensemble.advance()
        before = ensemble.positions.tobytes()
        # 0.95 m is in range, and 0.95 m times a factor above 1.06 is not.
        with pytest.raises(EnsembleError, match=r"member 0 of the ensemble \(contact\.thickness = 0\.0115"):
            ensemble.advance([SetParameters({"contact.thickness": 0.95})])
        assert (ensemble.frame, ensemble.positions.tobytes()) == (1, before)
        assert ensemble.advance().index == 2


def test_snapshot_of_other_distribution_is_refused() -> None:
    scene = scene_of()
    with Ensemble(scene, vary(air__drag=0.3), threads=1) as ensemble:
        ensemble.advance()
        saved = pickle.loads(pickle.dumps(ensemble.snapshot()))
        ensemble.restore(saved)
    for distribution, options in ((vary(air__drag=0.2), {}), (vary(material__density=0.3), {}), (TWO, {"members": 2})):
        with Ensemble(scene, distribution, threads=1, **options) as ensemble:
            before = ensemble.positions.tobytes()
            with pytest.raises(
                ValueError, match="restore it in an ensemble of the same distribution, members and seed"
            ):
                ensemble.restore(saved)
            assert ensemble.positions.tobytes() == before


@pytest.mark.parametrize("members", [2.5, True, "4", -1, 1])
def test_bad_number_of_members_is_refused(members: Any) -> None:
    with pytest.raises(ValueError, match="it must be 0 for sigma points, or at least 2"):
        Ensemble(scene_of(), TWO, members=members)


def test_numpy_value_scales_as_its_double() -> None:
    ends = []
    for drag in (np.float32(0.3), float(np.float32(0.3))):
        with Ensemble(scene_of(), TWO, threads=1) as ensemble:
            ensemble.advance([SetParameters({"air.drag": drag})])
            ensemble.advance()
            ends.append(ensemble.positions.tobytes())
    assert ends[0] == ends[1]
