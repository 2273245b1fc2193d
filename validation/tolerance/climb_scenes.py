# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Families of scenes that the search for violations climbs over.

They are particles, springs, sheets and events, and two with references of their own: contact, and close save times.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np
from support.random_meshes import drawn_alike, outline_with_a_hole

from cloth_sim_ros import Advance, Drag, Gravity, Model, PairSprings, Scene, State, simulate
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.simulate import MAX_ADVANCE
from validation.tolerance.climb_motions import draw_prescribed, draw_shaken
from validation.tolerance.compiled_reference import ReferenceFailureError
from validation.tolerance.contact import (
    FINE,
    FRICTIONS,
    KINDS,
    PERTURBATION,
    Accuracy,
    draw_contact_scene,
    evaluate_contact_window,
    run_contact,
)
from validation.tolerance.random_scenes import (
    RandomGripScript,
    RandomScene,
    added_mass,
    bending_friction,
    fabric_membrane,
    initial_state,
    log_uniform,
    sheet_air,
    upright_orientation,
    with_cost,
)
from validation.tolerance.regimes import LinearMotion, Regime, regime_scene
from validation.tolerance.windows import MAX_FORCE_MISMATCH, RecordedRun, Window, evaluate_window, record_run

#: Simulated time of a scene [s]; its two windows of a second start at 0 and at the half second.
DURATION = 1.5
#: Largest cost of a scene in spring evaluations by the reference: about a second of one core.
MAX_TRIAL_COST = 1e8
GRAVITY = (0.0, 0.0, -9.81)


@attrs.frozen(kw_only=True)
class Trial:
    """Evaluated windows of one scene."""

    tolerance: float
    words: str
    #: Parameters of the scene by name, those of its springs among them.
    parameters: Mapping[str, Any]
    windows: tuple[Window, ...] = ()
    #: Reason why a window has no evaluation; empty if each has one.
    trouble: str = ""

    @property
    def worst(self) -> Window | None:
        """Unflagged window with the largest error ratio."""
        return max(self.unflagged, key=lambda window: window.ratio, default=None)

    @property
    def unflagged(self) -> list[Window]:
        """Unflagged windows that the reference can follow."""
        return [window for window in self.windows if window.is_known and not window.flagged]


def evaluate_trial(draw: RandomScene, parameters: Mapping[str, Any], *, linear: bool = False) -> Trial:
    """Evaluate the two windows of a scene; those of a linear one against the matrix exponential."""
    draw = with_cost(draw, windows=2)
    trial = Trial(tolerance=draw.scene.tolerance, words=draw.words, parameters=parameters)
    if draw.cost > MAX_TRIAL_COST:
        return attrs.evolve(trial, trouble="beyond the cap")
    run, second = record_run(draw), draw.frames_per_second
    evaluate = _evaluate_linear if linear else _evaluate_any
    if run.trouble or not run.mismatch <= MAX_FORCE_MISMATCH:
        return attrs.evolve(trial, trouble=run.trouble or "forces differ from the reference's")
    windows, trouble = list[Window](), ""
    for first in (0, second // 2):
        try:
            windows.append(evaluate(run, first, second))
        except ReferenceFailureError as failure:
            trouble = str(failure)
    return attrs.evolve(trial, windows=tuple(windows), trouble=trouble)


def _evaluate_any(run: RecordedRun, first: int, frames: int) -> Window:
    return evaluate_window(run, first, frames, seed=first)[0]


def _evaluate_linear(run: RecordedRun, first: int, frames: int) -> Window:
    end = first + frames
    start, advances = (run.positions[first], run.velocities[first]), [frame.advance for frame in run.frames[first:end]]
    motion = LinearMotion(run.system.model, *start)
    tolerance = run.draw.scene.tolerance
    return linear_window(motion, run.positions[first + 1 : end + 1], [run.period] * frames, advances, tolerance, first)


def linear_window(
    motion: LinearMotion,
    positions: Sequence[Array],
    durations: Sequence[float],
    advances: Sequence[Advance],
    tolerance: float,
    first: int = 0,
) -> Window:
    """Evaluate positions (3, n) [m] at the ends of successive durations [s] against the exact motion from the start."""
    exact = [motion.advance(duration) for duration in durations]
    amplification = motion.amplification(durations)
    return Window.of(
        advances,
        first=first,
        frames=len(durations),
        error=max(float(np.linalg.norm(a - b, axis=0).max()) for a, b in zip(positions, exact, strict=True)),
        amplification=amplification,
        error_bound=tolerance * max(1.0, amplification),
        reference_error=float(np.linalg.norm(exact[-1] - motion.positions_after(sum(durations)), axis=0).max()),
        reference_evaluations=0,
    )


def falling(rng: np.random.Generator) -> Trial:
    """Evaluate one particle that falls in air."""
    tables = {"positions": [[0.0, 0.0, 0.0]], "velocities": [rng.uniform(-3.0, 3.0, 3).tolist()], "springs": []}
    return _evaluate_springs(rng, {**tables, "masses": 1.0, "rest_lengths": 1.0, "stiffness": 1.0}, (), linear=True)


def network(rng: np.random.Generator, *, is_joint: bool) -> Trial:
    """Evaluate a chain of joints (S4) or of springs (S1) at rest, with at most one more of them."""
    count = int(rng.integers(2, 6))
    pairs = [[k, k + 1] for k in range(count - 1)]
    if count > 2 and rng.random() < 0.3:
        pairs.append([0, count - 1])
    damping = 0.0 if rng.random() < 0.2 else float(rng.uniform(0.0, 3.0))
    anchors = ("0", str(count - 1)) if count > 2 and rng.random() < 0.3 else ("0",)
    spacing = float(rng.uniform(0.01, 0.3))
    direction = np.array([math.sin(angle := float(rng.uniform(0.0, 1.6))), 0.0, -math.cos(angle)])
    positions = drawn_alike(spacing * np.arange(count)[:, None] * direction)
    slack = float(rng.uniform(0.7, 1.5))
    distances = [spacing * (b - a) for a, b in pairs]
    rest_lengths = [0.0 if is_joint else slack * distance for distance in distances]
    rigidity = [log_uniform(rng, 0.3, 1e4) for _ in pairs]
    lengths = [rest_length or 1.0 for rest_length in rest_lengths]
    tables = {
        "positions": positions.tolist(),
        "masses": [log_uniform(rng, 1e-3, 1.0) for _ in range(count)],
        "springs": pairs,
        "rest_lengths": rest_lengths,
        "stiffness": [k * length for k, length in zip(rigidity, lengths, strict=True)],
        "k_d0": damping,
    }
    return _evaluate_springs(rng, tables, anchors, linear=is_joint)


def thrown(rng: np.random.Generator) -> Trial:
    """Evaluate a weak spring without damping whose end is thrown past its anchor.

    The force of a spring (S1) that passes zero length at a small distance turns round at equal size.
    """
    speed, time, miss = log_uniform(rng, 0.05, 5.0), float(rng.uniform(0.3, 1.4)), log_uniform(rng, 1e-5, 1e-2)
    mass, rest_length, frequency = 1.0, log_uniform(rng, 0.01, 3.0), log_uniform(rng, 0.05, 10.0)
    tables = {
        "positions": [[0.0, 0.0, 0.0], [-speed * time, miss, 0.0]],
        "velocities": [[0.0, 0.0, 0.0], [speed, 0.0, 0.0]],
        "masses": mass,
        "springs": [[0, 1]],
        "rest_lengths": rest_length,
        "stiffness": mass * frequency**2 * rest_length,
    }
    return _evaluate_springs(rng, tables, ("0",), gravity=(0.0, 0.0, 0.0), air=False)


def snapping(rng: np.random.Generator) -> Trial:
    """Evaluate a light truss of two springs that snaps through while a heavy particle, which pulls it, swings."""
    half, rise, mass = log_uniform(rng, 1e-6, 0.1), float(rng.uniform(0.1, 0.5)), log_uniform(rng, 1e-6, 1e-3)
    frequency, swing, heavy = log_uniform(rng, 100.0, 2e4), float(rng.uniform(0.5, 8.0)), log_uniform(rng, 0.03, 3.0)
    amplitude, phase, sideways = (
        log_uniform(rng, 0.01, 0.5),
        float(rng.uniform(-1.6, 1.6)),
        float(rng.uniform(0.0, 1.0)),
    )
    height, rigidity = rise * half, mass * frequency**2 / 2.0
    # The truss carries about 0.4 k h^3 / a^2; the swing pulls by up to a few times that.
    pull = 0.4 * rigidity * rise**3 * half / amplitude * log_uniform(rng, 0.3, 4.0)
    lengths, speed = [math.hypot(half, height)] * 2 + [1.0, 1.0 + height], amplitude * swing
    stiffness = [rigidity, rigidity, heavy * swing**2, pull]
    swinging = [0.0, 0.0, -1.0 + amplitude * math.cos(phase)]
    tables = {
        "positions": [[-half, 0.0, 0.0], [half, 0.0, 0.0], [0.0, 0.0, height], [0.0, 0.0, -2.0], swinging],
        "velocities": [[0.0, 0.0, 0.0]] * 4 + [[sideways * speed, 0.0, -speed * math.sin(phase)]],
        "masses": [1.0, 1.0, mass, 1.0, heavy],
        "springs": [[0, 2], [1, 2], [3, 4], [2, 4]],
        "rest_lengths": lengths,
        "stiffness": [k * length for k, length in zip(stiffness, lengths, strict=True)],
        "k_d0": 0.0 if rng.random() < 0.2 else log_uniform(rng, 1e-3, 1.0),
    }
    return _evaluate_springs(rng, tables, ("0", "1", "3"), gravity=(0.0, 0.0, 0.0), air=False)


def _evaluate_springs(
    rng: np.random.Generator,
    tables: dict[str, Any],
    anchors: tuple[str, ...],
    *,
    linear: bool = False,
    gravity: tuple[float, float, float] = GRAVITY,
    air: bool = True,
) -> Trial:
    """Evaluate raw springs with a drawn tolerance, rate and drag."""
    tolerance, rate = log_uniform(rng, 1e-9, 1e-2), float(rng.integers(10, 121))
    drag = 0.0 if not air or (tables["springs"] and rng.random() < 0.5) else log_uniform(rng, 0.02, 5.0)
    words = f"{len(tables['springs'])} springs, drag {drag:.2g}/s, {rate:g} Hz"
    more: dict[str, Any] = {"linear": linear, "gravity": gravity, "duration": DURATION, "rate": rate, "drag": drag}
    draw = regime_scene(Regime(words, tables, anchors or ("",), **more), tolerance)
    parameters = {**tables, "anchors": anchors, "tolerance": tolerance, **more}
    return evaluate_trial(draw, parameters, linear=linear)


def hung(rng: np.random.Generator) -> Trial:
    """Evaluate a sheet that hangs from its upper edge, released from its rest shape in calm air."""
    return _evaluate_sheet(rng, _hung_sheet(rng))


def moving(rng: np.random.Generator, *, carries_air: bool = False) -> Trial:
    """Evaluate a sheet with initial velocities, bending, wind and gusts, which may carry air along."""
    values = _hung_sheet(rng) | _bending(rng, ["none", "axial", "opposite", "crossed", "altitude"])
    if carries_air:
        values["air.added_mass"] = added_mass(rng, values)
    return _evaluate_sheet(rng, values | sheet_air(rng), is_moving=True, gust=True)


def fabric(rng: np.random.Generator) -> Trial:
    """Evaluate a moving sheet of membrane triangles, with quadratic hinges or a shape operator."""
    values = _hung_sheet(rng)
    model = str(rng.choice(["none", "quadratic", "shape_operator"]))
    modulus = {} if model == "none" else {"material.bending_modulus": log_uniform(rng, 1e-6, 1e-3)}
    values |= {"bending.model": model, **modulus, **fabric_membrane(rng, values), **sheet_air(rng)}
    return _evaluate_sheet(rng, values, is_moving=True, gust=True)


def friction(rng: np.random.Generator) -> Trial:
    """Evaluate a moving sheet with internal friction of bending."""
    values = _hung_sheet(rng)
    modulus = log_uniform(rng, 1e-6, 1e-3)
    model = str(rng.choice(["quadratic", "crossed", "altitude"]))
    values |= {"bending.model": model, "material.bending_modulus": modulus}
    values |= {**bending_friction(rng, modulus), **sheet_air(rng)}
    return _evaluate_sheet(rng, values, is_moving=True, gust=True)


def mesh(rng: np.random.Generator, *, carries_air: bool = False) -> Trial:
    """Evaluate a triangle mesh that hangs from its highest vertices, and may carry air along."""
    values = _hung_sheet(rng) | _bending(rng, ["none", "opposite", "crossed", "altitude"])
    for name in ("cloth.size", "cloth.resolution", "cloth.shear_layout"):
        del values[name]
    del values["material.shear_modulus"]
    count, size, seed = int(rng.integers(12, 60)), log_uniform(rng, 0.3, 4.0), int(rng.integers(1000))
    content, points = outline_with_a_hole(np.random.default_rng(seed), count, size)
    highest = np.flatnonzero(points[:, 1] > points[:, 1].max() - 0.1 * np.ptp(points[:, 1]))
    values |= {"cloth.mesh": "sheet.obj", "cloth.anchors": [str(int(k)) for k in highest], **sheet_air(rng)}
    if carries_air:
        values["air.added_mass"] = added_mass(rng, values)
    return _evaluate_sheet(rng, values, files={"sheet.obj": content}, is_moving=True)


def events(rng: np.random.Generator) -> Trial:
    """Evaluate a hung sheet that a gripper grasps, moves and releases while parameters change."""
    values = _hung_sheet(rng)
    values |= {
        "grippers": ["gripper0"],
        "gripper.radius": float(rng.uniform(0.1, 0.6)) * max(values["cloth.size"]),
        "gripper.stiffness": log_uniform(rng, 10.0, 3000.0),
        "gripper.damping": float(rng.uniform(0.0, 2.0)),
        "gripper.max_speed": 0.0,
    }
    return _evaluate_sheet(rng, values, is_moving=True, gust=True, pace=log_uniform(rng, 0.01, 1.0))


def _hung_sheet(rng: np.random.Generator) -> dict[str, Any]:
    """Draw the parameters of a hung grid."""
    stretch = log_uniform(rng, 20.0, 5e3)
    return {
        "rate": float(rng.integers(10, 121)),
        "tolerance": log_uniform(rng, 1e-6, 1e-2),
        "cloth.resolution": [int(rng.integers(2, 9)), int(rng.integers(2, 9))],
        "cloth.size": [log_uniform(rng, 0.3, 8.0), log_uniform(rng, 0.3, 8.0)],
        "cloth.shear_layout": str(rng.choice(["both", "left", "right", "alternating"])),
        "cloth.orientation": upright_orientation(rng),
        "cloth.anchors": ["top"],
        "material.stretch_modulus": stretch,
        "material.shear_modulus": stretch * log_uniform(rng, 0.02, 0.4),
        "material.density": log_uniform(rng, 0.05, 3.0),
        "material.damping": 0.0 if rng.random() < 0.1 else float(rng.uniform(0.0, 2.0)),
        "air.drag": 0.0 if rng.random() < 0.3 else log_uniform(rng, 0.02, 2.0),
        "wind.normal_drag": 0.0,
        "bending.model": "none",
        "grippers": [""],
        "gravity": list(GRAVITY),
    }


def _bending(rng: np.random.Generator, models: list[str]) -> dict[str, Any]:
    model = str(rng.choice(models))
    if model in ("axial", "opposite"):
        return {"bending.model": model, "bending.stiffness": log_uniform(rng, 1e-3, 10.0)}
    if model == "none":
        return {"bending.model": model}
    return {"bending.model": model, "material.bending_modulus": log_uniform(rng, 1e-6, 1e-3)}


def _evaluate_sheet(
    rng: np.random.Generator,
    values: dict[str, Any],
    *,
    files: Mapping[str, bytes] | None = None,
    is_moving: bool = False,
    gust: bool = False,
    pace: float | None = None,
) -> Trial:
    """Evaluate a sheet or mesh.

    Args:
        rng: draws the start, the gust and the gripper's script.
        values: parameters of the scene.
        files: contents of its files by name.
        is_moving: draw initial positions and velocities.
        gust: change wind, gravity and drag once.
        pace: speed factor of the gripper; None without grippers.
    """
    scene = Scene.from_parameters(values, files=dict(files or {}))
    state = initial_state(rng, scene, log_uniform(rng, 0.01, 1.0)) if is_moving else scene.starting_state()
    frames = math.ceil(DURATION * scene.rate)
    changes: dict[int, dict[str, Any]] = {}
    if gust and rng.random() < 0.7:
        changed = {"wind.velocity": rng.uniform(-4.0, 4.0, 3).tolist(), "air.drag": log_uniform(rng, 0.02, 2.0)}
        changes[int(rng.integers(1, frames))] = changed
    script = RandomGripScript()
    if pace is not None:
        script = RandomGripScript.random(rng, scene, frames, pace=pace)
    kind = f"{values.get('cloth.resolution', 'mesh')}, {values['bending.model']}"
    words = f"{kind}, {scene.rate:g} Hz, {script.words}"
    draw = RandomScene(scene=scene, state=state, frames=frames, words=words, script=script, changes=changes)
    return evaluate_trial(draw, {**values, "changes": {str(frame): change for frame, change in changes.items()}})


#: Limits of the number of particles along a side of a sheet in contact.
_SIDES = (2, 4)
#: Kinds of contact; the reference takes minutes for a fold that lies on itself.
_KINDS = [kind for kind in KINDS if kind != "itself"]
#: Number of save times of a scene.
_MAX_SAVES = 4000


def contact(rng: np.random.Generator) -> Trial:
    """Evaluate a small sheet that falls on an obstacle, in its first second."""
    kind, friction = str(rng.choice(_KINDS)), float(rng.choice(FRICTIONS))
    draw = draw_contact_scene(rng, kind, friction, _SIDES)
    # Perturbations are a hundred times larger.
    fine = min(max(FINE, 1e-4 * draw.scene.tolerance), 1e-9)
    return evaluate_frames(attrs.evolve(draw, frames=round(draw.scene.rate)), fine, 10.0 * fine, PERTURBATION)


def evaluate_frames(draw: RandomScene, fine: Accuracy, rough: Accuracy, size: float) -> Trial:
    """Evaluate the last second of a scene, see `evaluate_contact_window`."""
    run = run_contact(draw)
    windows, trouble, second = list[Window](), run.trouble, len(run.frames) - draw.first
    if not trouble:
        rng = np.random.default_rng(0)
        try:
            windows.append(evaluate_contact_window(run, draw.first, second, rng, fine=fine, rough=rough, size=size))
        except ArithmeticError as error:
            trouble = str(error)
    parameters = {**draw.scene.parameters(), "positions": draw.state.positions.tolist()}
    return Trial(
        tolerance=draw.scene.tolerance, words=draw.words, parameters=parameters, windows=tuple(windows), trouble=trouble
    )


#: Step counts of the reference: of one run, since friction jumps, and of smooth motions.
_JUMP_STEPS, _SMOOTH_STEPS = ((2000,), (700,)), ((600, 800, 1000), (300, 400, 500))
#: Smallest perturbation relative to the tolerance: friction responds more to smaller ones than to errors.
_PERTURBATION_FRACTION = 0.01


def shaken(rng: np.random.Generator) -> Trial:
    """Evaluate particles on an obstacle that moves."""
    draw = draw_shaken(rng)
    return evaluate_frames(draw, *_JUMP_STEPS, max(PERTURBATION, _PERTURBATION_FRACTION * draw.scene.tolerance))


def prescribed(rng: np.random.Generator) -> Trial:
    """Evaluate particles in grippers that move and stop, which prescribe their motion or are springs."""
    return evaluate_frames(draw_prescribed(rng), *_SMOOTH_STEPS, PERTURBATION)


def save_times(rng: np.random.Generator) -> Trial:
    """Evaluate a mass on joints whose motion `simulate` saves more often than each frame, at unequal intervals."""
    count = int(rng.integers(2, 4))
    masses = [log_uniform(rng, 1e-3, 1.0) for _ in range(count)]
    frequencies = [log_uniform(rng, 0.3, 3000.0) for _ in range(count - 1)]
    rigidity = [mass * frequency**2 for mass, frequency in zip(masses[1:], frequencies, strict=True)]
    damping = [
        2.0 * float(rng.uniform(0.0, 1.0)) * mass * frequency if rng.random() < 0.7 else 0.0
        for mass, frequency in zip(masses[1:], frequencies, strict=True)
    ]
    joints = PairSprings([[k, k + 1] for k in range(count - 1)], 0.0, rigidity, damping)
    model = Model(masses, [joints, Gravity(GRAVITY), Drag(log_uniform(rng, 0.01, 3.0))], anchors=[0])
    spacing = log_uniform(rng, 1e-4, 0.3)
    state = State(np.array([[0.0, 0.0, -spacing * k] for k in range(count)]))
    state.v[:, 1:] = float(rng.uniform(0.0, 1.0)) * rng.normal(size=(3, count - 1))
    tolerance, interval = log_uniform(rng, 1e-9, 1e-2), log_uniform(rng, 1.0 / _MAX_SAVES, MAX_ADVANCE)
    # Alternate intervals differ.
    share = float(rng.uniform(0.1, 0.9))
    durations = [2.0 * interval * part for part in (share, 1.0 - share)] * math.ceil(0.5 / interval)
    parameters = {
        "masses": masses,
        "rigidity": rigidity,
        "damping": damping,
        "drag": float(model.forces[2].rate),  # type: ignore[attr-defined]
        "positions": state.positions.tolist(),
        "velocities": state.velocities.tolist(),
        "tolerance": tolerance,
        "intervals": durations[:2],
    }
    exact = LinearMotion(model, state.x.copy(), state.v.copy())
    times = np.cumsum(durations)
    motion = simulate(model, state, float(times[-1]), save_at=times, tolerance=tolerance)
    end = int(np.searchsorted(times, 1.0 + 1e-9))
    saved = [positions.T for positions in motion.positions[:end]]
    window = linear_window(exact, saved, durations[:end], motion.advances, tolerance)
    words = f"{count - 1} joints, saved each {interval:.2g} s"
    return Trial(tolerance=tolerance, words=words, parameters=parameters, windows=(window,))
