# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Certificates of sessions, compared with an independent integrator, and with injected errors."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.bounded_loops import rounds_until
from support.random_sessions import make_random_session
from support.session_maker import NODE, Change, SessionMaker, carried_corner, cloud_bytes

from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import decode_cloud, decode_string, encode_string
from cloth_sim_ros.simulation.events import Event, Grasp, Pause, Reset, Step, Target
from cloth_sim_ros.simulation.simulation import Simulation
from cloth_sim_ros.verify import accuracy
from cloth_sim_ros.verify.accuracy import certify, is_sampled
from cloth_sim_ros.verify.certificate import AccuracyWindow, Certificate, FrameAccuracy
from cloth_sim_ros.verify.independent_integrator import dop853, frame_by_dop853
from cloth_sim_ros.verify.main import BOUND_VIOLATED, main
from cloth_sim_ros.verify.reference_integrator import (
    CHECK_STEP_COUNTS,
    STEP_COUNTS,
    MotionState,
    ReferenceIntegrator,
    integrate_intervals,
    max_distance,
    weights,
)
from cloth_sim_ros.verify.reference_motion import (
    Equations,
    FrameCapture,
    ReferenceMotion,
    SimulatedFrame,
    starting_state,
)
from cloth_sim_ros.verify.reference_solution import (
    PERTURBATION,
    ReferenceSolution,
    later_amplification,
    random_perturbation,
)

SMALL = {"cloth.resolution": [8, 9], "cloth.size": [0.4, 0.45], "material.stretch_modulus": 100.0,
         "material.shear_modulus": 10.0, "bending.stiffness": 0.5, "tolerance": 1e-4}  # fmt: skip
POINTS = f"{NODE}/points"


def _make(
    folder: Path,
    *,
    frames: int = 70,
    change: Callable[[int], Change | None] = lambda _k: None,
    split_at: int = -1,
    **values: object,
) -> SessionMaker:
    """Write a grasp session; `change` returns the alteration of a frame's messages by frame index."""
    scene = Scene.from_parameters(SMALL | {name.replace("__", "."): value for name, value in values.items()})
    maker = SessionMaker(folder, scene)
    for k, events in enumerate(carried_corner(scene, frames / 60.0), start=1):
        spoil = change(k)
        maker.add(events, **({"change": spoil} if spoil else {}))
        if k == split_at:
            maker.split()
    maker.finish()
    return maker


def _moved(scene: Scene, frame: int, metres: float) -> Callable[[int], Change | None]:
    """Return a change that moves one particle of one frame's cloud."""

    def spoil(topic: str, data: bytes) -> bytes:
        if topic != POINTS:
            return data
        xyz = decode_cloud(data).xyz.copy()
        xyz[40, 2] += metres
        return cloud_bytes(xyz, 0, scene.shape)

    return lambda k: spoil if k == frame else None


def _run_frames(simulation: Simulation, script: list[list[Event]]) -> list[SimulatedFrame]:
    watch, frames = FrameCapture(), []
    for events in script:
        was, before = simulation.scene, simulation.state.shallow_copy()
        simulated = watch.capture(simulation, was, before, simulation.advance(events))
        if simulated is not None:
            frames.append(simulated)
    return frames


@pytest.mark.parametrize("counts", [STEP_COUNTS, CHECK_STEP_COUNTS])
def test_extrapolation_weights_cancel_stated_orders(counts: tuple[int, ...]) -> None:
    w = weights(counts)
    assert math.fsum(w) == pytest.approx(1.0, abs=1e-12)
    for power in range(2, len(counts) + 1):
        assert math.fsum(a * n**-power for a, n in zip(w, counts, strict=True)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("damping", [0.0, 0.4])
def test_reference_error_rate_agrees_with_independent_integrator(damping: float) -> None:
    scene = Scene.from_parameters(SMALL | {"material.damping": damping, "cloth.anchors": ["top_left"]})
    simulation = Simulation(scene)
    _run_frames(simulation, [[]] * 20)
    start, t = MotionState(simulation.state.x, simulation.state.v), simulation.time
    exact = dop853(scene.plan(), t, 0.1, start).x
    errors = []
    for rate in (1e-5, 1e-7, 1e-9):
        now, lengths = ReferenceIntegrator(rate).integrate_frame(scene.plan(), t, 0.1, start, math.inf)
        errors.append(max_distance(now.x, exact))
        finer = integrate_intervals(scene.plan(), t, lengths, start, CHECK_STEP_COUNTS).x
        assert errors[-1] <= rate
        # The check is closer, or both are at the rounding level.
        assert max_distance(finer, exact) < max(0.5 * errors[-1], 1e-12)
    assert errors[2] <= errors[0]


def test_reference_steps_are_at_most_half_the_simulation_steps() -> None:
    scene = Scene.from_parameters(SMALL)
    simulation = Simulation(scene)
    start = MotionState(simulation.state.x, simulation.state.v)
    for step in (1e-3, 1e-4):
        _, lengths = ReferenceIntegrator(1.0).integrate_frame(scene.plan(), 0.0, 1.0 / 60.0, start, step)
        assert max(lengths) / STEP_COUNTS[0] <= 0.5 * step * (1.0 + 1e-9)
        assert sum(lengths) == pytest.approx(1.0 / 60.0, rel=1e-12)


def test_rate_below_rounding_does_not_shrink_intervals_forever() -> None:
    scene = Scene.from_parameters(SMALL | {"material.damping": 0.0})
    simulation = Simulation(scene)
    _run_frames(simulation, [[]] * 20)
    start, counts = MotionState(simulation.state.x, simulation.state.v), []
    for rate in (1e-9, 1e-14, 1e-20):
        _, lengths = ReferenceIntegrator(rate).integrate_frame(
            scene.plan(), simulation.time, 1.0 / 60.0, start, math.inf
        )
        counts.append(len(lengths))
    assert counts[0] <= counts[1] <= counts[2] <= 20 * counts[0]


def test_reference_motion_equals_simulation_under_same_commands() -> None:
    # Grasps, turns, a grasp while paused, a release, a reset and sleep: the reference motion follows each of them.
    scene = Scene.from_parameters(SMALL | {"grippers": ["a", "b"], "gripper.radius": 0.08, "tolerance": 1e-7})
    simulation = Simulation(scene)
    corner, neighbour = (tuple(simulation.positions[k].tolist()) for k in (71, 63))
    turned = (0.0, 0.0, math.sin(0.2), math.cos(0.2))
    lifted = (corner[0], corner[1] - 0.02, corner[2] + 0.01)
    script: list[list[Event]] = [
        [Target("a", corner), Target("b", neighbour)],
        [Grasp("a", True)],
        *[[Target("a", lifted, turned)]] * 4,
        [Pause(True)],
        [Grasp("b", True)],
        [Step()],
        [Pause(False), Target("b", (neighbour[0], neighbour[1], neighbour[2] + 0.02))],
        *[[]] * 4,
        [Grasp("a", False)],
        *[[]] * 4,
        [Reset()],
        *[[]] * 3,
    ]
    frames, equations = _run_frames(simulation, script), Equations()
    assert sum(bool(frame.newly_closed) for frame in frames) == 2
    motion = ReferenceMotion(frames[0].before)
    for frame in frames:
        if frame.reset:
            motion = ReferenceMotion(starting_state(frame))
        motion.apply_grasps(frame)
        steps = ReferenceIntegrator(1e-9)
        motion.state, _ = steps.integrate_frame(
            equations.plan(frame, motion), frame.t, frame.duration, motion.state, frame.step
        )
        assert max_distance(motion.x, frame.after.x) < 1e-6, frame.index


def test_grip_points_follow_from_reference_positions() -> None:
    scene = Scene.from_parameters(SMALL | {"gripper.radius": 0.08})
    simulation = Simulation(scene)
    corner = tuple(simulation.positions[71].tolist())
    turn = (0.0, 0.6, 0.0, 0.8)
    (_, frame) = _run_frames(simulation, [[Target("gripper", corner, turn)], [Grasp("gripper", True)]])
    assert frame.controls.grips is not None
    motion = ReferenceMotion(frame.before)
    motion.perturb(np.full_like(motion.x, 1e-3), np.zeros_like(motion.x))
    motion.apply_grasps(frame)
    simulation_offsets = simulation.state.memory["grip.offsets"]
    # A particle displaced by 1 mm keeps this offset in the gripper's frame.
    assert np.linalg.norm(motion.offsets - simulation_offsets, axis=1) == pytest.approx(
        np.full(len(simulation_offsets), 1e-3 * math.sqrt(3.0))
    )
    assert not np.allclose(motion.offsets - simulation_offsets, 1e-3)


@pytest.mark.parametrize("smooth", [False, True])
def test_perturbations_have_stated_size_and_skip_anchors(smooth: bool) -> None:
    x = np.random.default_rng(1).normal(size=(3, 50))
    free = np.arange(50) > 4
    perturbation = random_perturbation(x, free, np.random.default_rng(2), smooth=smooth)
    lengths = np.linalg.norm(perturbation, axis=0)
    assert lengths.max() == pytest.approx(PERTURBATION)
    assert not perturbation[:, :5].any()
    assert lengths[5:].min() > 0.0


@pytest.mark.parametrize("seed", [2, 4, 7])
def test_frame_errors_agree_with_independent_integrator(tmp_path: Path, seed: int) -> None:
    # test/soak_accuracy.py runs thirty of them.
    _, certificate = certify(make_random_session(tmp_path, seed, frames=25), every_sample=True)
    assert len(certificate.samples) == len(certificate.frames) > 0
    assert all(sample.agrees for sample in certificate.samples)
    # Much closer than required: the largest difference was 2e-10 m.
    assert max(sample.difference for sample in certificate.samples) < 1e-8
    assert max(sample.independent for sample in certificate.samples) > 1e-7


def test_frame_without_independent_solution_is_undecided(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    maker, calls = _make(tmp_path, frames=70), list[int]()

    def give_up_once(equations: Equations, frame: SimulatedFrame, state: State) -> np.ndarray:
        calls.append(frame.index)
        if len(calls) == 1:
            raise ArithmeticError("DOP853 gave up at 0.5 s: the step is too small")
        return frame_by_dop853(equations, frame, state)

    monkeypatch.setattr(accuracy, "frame_by_dop853", give_up_once)
    output = tmp_path / "numbers.json"
    assert main(["--accuracy", "--json", str(output), str(maker.paths[0])]) == BOUND_VIOLATED
    printed = capsys.readouterr()
    assert f"Undecided, because scipy's DOP853 has no solution: 1 frame ({calls[0]})." in printed.out
    assert f"On {len(calls) - 1} frame" in printed.out
    assert f"frame {calls[0]}: DOP853 gave up at 0.5 s: the step is too small" in printed.err
    content = json.loads(output.read_text())
    assert [entry["frame"] for entry in content["unsolved_samples"]] == calls[:1]
    assert not content["satisfied"]


def test_window_errors_agree_with_independent_integrator(tmp_path: Path) -> None:
    maker = _make(tmp_path, frames=20)
    _, certificate = certify(maker.paths)
    simulation = Simulation(Scene.from_parameters(SMALL))
    frames, equations = _run_frames(simulation, list(carried_corner(simulation.scene, 20 / 60.0))), Equations()
    motion = ReferenceMotion(frames[0].before)
    for frame, stated in zip(frames, certificate.frames, strict=True):
        motion.apply_grasps(frame)
        motion.state = dop853(equations.plan(frame, motion), frame.t, frame.duration, motion.state)
        error = max_distance(frame.after.x, motion.x)
        assert stated.error == pytest.approx(error, rel=0.01, abs=2.0 * stated.uncertainty + 1e-12)
        assert stated.session_error == stated.error
    alone = frame_by_dop853(equations, frames[-1], frames[-1].before)
    assert certificate.frames[-1].error_of_frame == pytest.approx(max_distance(frames[-1].after.x, alone), rel=0.01)


def test_frame_changed_by_a_millimetre_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = Scene.from_parameters(SMALL)
    maker = _make(tmp_path, frames=30, change=_moved(scene, 17, 1e-3))
    _, certificate = certify(maker.paths)
    assert certificate.altered == 1
    assert [frame.frame for frame in certificate.frames if frame.violates_bound] == [17]
    assert certificate.frames[16].error == pytest.approx(1e-3, rel=0.02)
    assert not certificate.frames[16].exact
    assert not certificate.is_satisfied
    # Differing bits are more severe than a violated bound.
    assert main(["--accuracy", str(maker.paths[0])]) == 1
    said = capsys.readouterr().out
    assert "VIOLATED" in said
    assert "17" in said


def test_session_of_other_arithmetic_uses_recorded_positions(tmp_path: Path) -> None:
    # Every digest differs, as after other rounding: only the recorded positions can be assessed.
    def with_other_arithmetic(topic: str, data: bytes) -> bytes:
        if topic != f"{NODE}/frame":
            return data
        record = json.loads(decode_string(data))
        record["digest"] = "0" * 32
        return encode_string(json.dumps(record))

    maker = _make(tmp_path, frames=70, change=lambda _k: with_other_arithmetic)
    verdict, certificate = certify(maker.paths)
    assert verdict.different == 70
    assert not any(frame.exact for frame in certificate.frames)
    assert certificate.altered == 0
    assert [window.verdict for window in certificate.windows] == ["kept", "kept"]
    # Recorded positions are float32: their rounding adds to the floor and to the error of a window's start.
    assert all(frame.floor > 1e-8 for frame in certificate.frames)
    assert certificate.frames[-1].own > 1e-8


def test_windows_begin_each_second_and_span_files(tmp_path: Path) -> None:
    maker = _make(tmp_path, frames=130, split_at=30)
    _, certificate = certify(maker.paths)
    assert [(window.frames, window.index) for window in certificate.windows] == [(60, 0), (60, 1), (10, 2)]
    assert [window.start for window in certificate.windows] == pytest.approx([0.0, 1.0, 2.0])
    # A window starts from the simulation's state: the error of its first frame is that of this frame alone.
    for first in (0, 60, 120):
        first_frame = certificate.frames[first]
        assert first_frame.error == pytest.approx(first_frame.error_of_frame, rel=1e-3)
        assert first_frame.amplification < 3.0
    assert certificate.frames[60].session_error > 2.0 * certificate.frames[60].error


def test_reset_restarts_windows(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL))
    for k in range(40):
        maker.add([Reset()] if k == 25 else [])
    maker.finish()
    _, certificate = certify(maker.paths)
    assert [window.frames for window in certificate.windows] == [25, 15]
    begun = certificate.frames[25]
    assert begun.session_error == begun.error == pytest.approx(begun.error_of_frame, rel=1e-3)
    assert begun.session_amplification < 3.0


def test_certificate_without_tolerance_states_error_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maker = _make(tmp_path, frames=20, tolerance=0.0, step=1e-3)
    assert main(["--accuracy", str(maker.paths[0])]) == 0
    assert "there is no error bound" in capsys.readouterr().out
    _, certificate = certify(maker.paths)
    assert [window.verdict for window in certificate.windows] == ["no promise"]
    assert certificate.windows[0].error > 1e-6
    assert math.isnan(certificate.frames[0].error_bound)


def test_sleeping_frames_are_measured(tmp_path: Path) -> None:
    maker = SessionMaker(tmp_path, Scene.from_parameters(SMALL | {"tolerance": 1e-2, "air.drag": 2.0}))
    for _ in rounds_until(lambda: maker.simulation.asleep):
        maker.add([])
    slept = maker.simulation.frame
    for _ in range(70):
        maker.add([])
    maker.finish()
    _, certificate = certify(maker.paths)
    asleep = [frame for frame in certificate.frames if frame.frame > slept]
    assert len(asleep) == 70
    # The position at the beginning of sleep is not the equilibrium: the difference is the error.
    assert max(frame.error for frame in asleep) > 1e-9
    assert certificate.is_satisfied


def test_samples_thin_out_in_long_sessions() -> None:
    sampled = [window for window in range(3600) if is_sampled(window)]
    assert sampled[:10] == [0, 1, 2, 3, 4, 5, 6, 7, 8, 10]
    assert len(sampled) < 60
    assert sampled[-1] > 3000


@pytest.mark.parametrize(
    ("error", "uncertainty", "flagged", "verdict"),
    [
        (1e-5, 1e-9, 0, "kept"),
        (1e-5, 1e-4, 0, "undecided"),
        (9e-3, 1e-9, 0, "not kept"),
        (9e-3, 1e-9, 3, "flagged"),
        (4e-4, 3e-4, 0, "undecided"),
        (math.nan, 1e-9, 0, "undecided"),
    ],
)
def test_verdicts(error: float, uncertainty: float, flagged: int, verdict: str) -> None:
    window = AccuracyWindow(index=0, start=0.0)
    window.add(_frame(error=error, uncertainty=uncertainty, flagged=flagged > 0))
    assert window.verdict == verdict
    certificate = Certificate(name="", windows=[window])
    assert certificate.is_satisfied == (verdict in ("kept", "flagged"))


def _frame(*, error: float, uncertainty: float, flagged: bool) -> FrameAccuracy:
    return FrameAccuracy(
        frame=1,
        time=0.1,
        window=0,
        tolerance=1e-4,
        flagged=flagged,
        exact=True,
        error_of_frame=1e-6,
        error_bound_of_frame=1e-4,
        error=error,
        amplification=2.0,
        uncertainty=uncertainty,
        floor=1e-14,
        session_error=error,
        session_amplification=2.0,
        session_uncertainty=uncertainty,
    )


def test_later_perturbations_count_for_unexplained_errors() -> None:
    window = AccuracyWindow(index=0, start=0.0)
    window.add(_frame(error=9e-3, uncertainty=1e-9, flagged=False))
    assert (window.verdict, window.error_bound) == ("not kept", pytest.approx(2e-4))
    window.later_amplification = 100.0
    assert (window.verdict, window.error_bound) == ("kept", pytest.approx(1e-2))


def test_later_amplification_is_maximum_over_eighths() -> None:
    """Sheet that falls and is pulled taut: a perturbation at the start decays more than a later one."""
    simulation = Simulation(Scene.from_parameters(SMALL | {"material.damping": 1.0, "air.drag": 20.0}))
    frames, equations = _run_frames(simulation, [[]] * 8), Equations()
    expected = 0.0
    for begin in range(1, 8):
        reference = ReferenceSolution(frames[begin].before, seed=frames[begin].index)
        expected = max(expected, *(reference.advance(equations, frame).amplification for frame in frames[begin:]))
    assert later_amplification(equations, frames) == expected > 0.0
    assert later_amplification(equations, frames[:1]) == 0.0


def test_window_explained_by_later_perturbations_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cloth_sim_ros.scene import scene as scene_module
    from cloth_sim_ros.verify import accuracy

    real, calls = scene_module.make_integrator, []

    def grown(_equations: Equations, frames: list[SimulatedFrame]) -> float:
        calls.append([frame.index for frame in frames])
        return 1e9

    monkeypatch.setattr(
        scene_module, "make_integrator", lambda name, *, tolerance, **more: real(name, tolerance=1e-2, **more)
    )
    monkeypatch.setattr(accuracy, "WINDOW", 0.1)
    monkeypatch.setattr(accuracy, "later_amplification", grown)
    # Only the windows matter in this test.
    monkeypatch.setattr(FrameAccuracy, "violates_bound", property(lambda _frame: False))
    maker = _make(tmp_path, frames=9, tolerance=1e-6)
    _, certificate = certify(maker.paths)
    assert calls == [list(range(1, 7)), list(range(7, 10))]
    assert [window.later_amplification for window in certificate.windows] == [1e9, 1e9]
    assert certificate.is_satisfied


def test_loose_simulation_with_tight_tolerance_is_violated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Recording and re-run use 1000 times the stated tolerance.
    from cloth_sim_ros.scene import scene as scene_module

    real = scene_module.make_integrator
    monkeypatch.setattr(
        scene_module, "make_integrator", lambda name, *, tolerance, **more: real(name, tolerance=1e-2, **more)
    )
    maker = _make(tmp_path, frames=40, tolerance=1e-6)
    assert main(["--accuracy", str(maker.paths[0])]) == BOUND_VIOLATED
    assert "VIOLATED, unflagged: 0.000 to 0.667 s" in capsys.readouterr().out


def test_numbers_are_written_as_json_plot_and_particles(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    maker = _make(tmp_path, frames=12)
    files = {name: tmp_path / name for name in ("json", "plot", "particles")}
    options = [text for name, path in files.items() for text in (f"--{name}", str(path))]
    assert main(["--accuracy", str(maker.paths[0]), *options]) == 0
    content = json.loads(files["json"].read_text())
    assert [frame["frame"] for frame in content["frames"]] == list(range(1, 13))
    assert content["satisfied"] is True
    assert old_keys.add_old_keys(content, old_keys.CERTIFICATE) == content
    assert content["windows"][0]["verdict"] == "kept"
    particles = np.fromfile(files["particles"], dtype="<f4").reshape(12, 72)
    assert particles.max(axis=1) == pytest.approx([frame["error"] for frame in content["frames"]], rel=1e-6)
    assert files["plot"].read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("options", [["--json", "x.json"], ["--accuracy", "--plot", "x.png", "SECOND"]])
def test_options_that_make_no_sense_are_refused(
    tmp_path: Path, options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    maker = _make(tmp_path, frames=3)
    (tmp_path / "other").mkdir()
    second = _make(tmp_path / "other", frames=3)
    arguments = [str(second.paths[0]) if text == "SECOND" else text for text in options]
    with pytest.raises(SystemExit) as stopped:
        main([str(maker.paths[0]), *arguments])
    assert stopped.value.code == 2
    assert "accuracy" in capsys.readouterr().err


def test_certificate_leaves_state_unchanged() -> None:
    scene = Scene.from_parameters(SMALL)
    simulation = Simulation(scene)
    (frame,) = _run_frames(simulation, [[]])
    before, after = frame.before.digest(), frame.after.digest()
    ReferenceSolution(frame.before, seed=1).advance(Equations(), frame)
    assert (frame.before.digest(), frame.after.digest()) == (before, after)
    assert isinstance(frame.before, State)
