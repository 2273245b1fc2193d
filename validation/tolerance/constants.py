# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `constants`: effect of halving and doubling each tuned constant."""

from __future__ import annotations

import argparse
import math
from functools import cache
from typing import Any
from unittest import mock

import attrs
import numpy as np
from numpy.typing import NDArray
from support.problems import PERIOD, problem
from support.raw_sheet import RawSheet
from support.reference import reference
from support.reference_runs import measure

from cloth_sim_ros import Grasp, Scene, Simulation, State, Target
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.control.constants import CONSTANTS, Constants
from cloth_sim_ros.simulation.events import Event
from validation.report import Report, Table

#: Scenes with a reference, their tolerances [m], and the integrator.
REFERENCE_SCENES = (
    ("chain", (1e-3, 1e-5, 1e-7), "auto"),
    ("drumhead", (1e-2, 1e-4, 1e-6), "auto"),
    ("carried16", (1e-2, 1e-3, 1e-4, 1e-6), "auto"),
    ("mesh", (1e-2, 1e-4, 1e-6), "auto"),
    ("chain", (1e-3,), "implicit"),
)
#: Scenes of `Simulation` for features that the others lack: single precision, the automatic choice of implicit steps,
#: frames at their work limit, an impact. Each has parameters, a number of frames, and the jump of the target in each
#: frame [m]. The frames are so few that a change of rounding does not grow to the tolerance.
SIMULATED_SCENES: dict[str, tuple[dict[str, Any], int, float]] = {
    "carried30": ({"tolerance": 1e-3, "cloth.resolution": [30, 30]}, 20, 0.005),
    "stiff": (
        {
            "tolerance": 1e-2,
            "cloth.resolution": [14, 14],
            "material.stretch_modulus": 1e8,
            "material.shear_modulus": 1e7,
        },
        12,
        0.0005,
    ),
    "violent": (
        {"tolerance": 1e-5, "cloth.resolution": [12, 12], "material.stretch_modulus": 2e4, "work_limit": 0.2},
        30,
        0.3,
    ),
    "falls": (
        {
            "tolerance": 1e-4,
            "cloth.resolution": [12, 12],
            "cloth.size": [0.3, 0.3],
            "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
            "cloth.position": [0.0, 0.0, 0.4],
            "cloth.anchors": [""],
            "contact.thickness": 1e-3,
            "obstacles": ["table"],
            "table.shape": "plane",
            "table.friction": [0.0],
        },
        18,
        0.0,
    ),
}
#: Upper limits of constants: a fraction can't be doubled beyond the whole.
MAX_VALUES = {"stability_safety": 1.0, "error_budget_fraction": 1.0, "error_target_fraction": 1.0}
MAX_VALUES["low_error_fraction"] = 0.5


@attrs.frozen
class ConstantsEffect:
    """Error and work of all scenes with one set of constants."""

    #: Largest error over its tolerance.
    error: float
    #: Force evaluations of each scene.
    evaluations: tuple[int, ...]
    flagged: int
    #: Largest relative energy gain of a free sheet.
    gain: float
    #: Computed frames of a sheet that comes to rest, and the position error from sleep over its tolerance.
    awake_frames: int
    sleep_error: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    names = [field.name for field in attrs.fields(Constants)]
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", default=names, help="constants to vary")


def run(options: argparse.Namespace) -> Report:
    """Measure the effect of each selected constant."""
    from tqdm import tqdm

    columns = ["name", "value", "meaning"]
    for change in ("half", "double"):
        columns += [f"{change}: {column}" for column in ("error", "work", "flagged", "gain", "awake", "left out")]
    table = Table("Tuned numbers", columns)
    report = Report("Constants", tables=[table])
    scenes = ConstantsScenes()
    baseline = scenes.effect()
    for field in tqdm([field for field in attrs.fields(Constants) if field.name in options.only], unit="constant"):
        value = float(getattr(CONSTANTS, field.name))
        row: list[object] = [field.name, value, field.metadata["meaning"]]
        for factor in (0.5, 2.0):
            with mock.patch.object(CONSTANTS, field.name, scaled_constant(field.name, factor)):
                row += _cells(scenes.effect(), baseline)
        table.rows.append(row)
    report.notes += [
        f"With the default constants: error {baseline.error:.3g} of the tolerance at most, "
        f"{sum(baseline.evaluations)} evaluations, {baseline.flagged} flagged frames, "
        f"energy gain {baseline.gain:.2g}, "
        f"{baseline.awake_frames} frames until the sheet sleeps, {baseline.sleep_error:.2g} of the tolerance as "
        f"error from sleep",
        "error: largest error over the tolerance of all scenes; work: force evaluations relative to the default "
        "constants, in the scene with the largest change",
        f"scenes: {', '.join(name for name, _, _ in REFERENCE_SCENES)}, {', '.join(SIMULATED_SCENES)}, "
        "an undamped sheet with an inverted cell, a sheet that comes to rest; "
        "constants for threads or time only (python_force_time, engine_call_time) change none of the columns",
    ]
    return report


def scaled_constant(name: str, factor: float) -> float:
    """Return a constant times a factor, within its upper limit; of a ratio to 1 the excess is scaled."""
    value: float = getattr(CONSTANTS, name)
    if name == "energy_check_stiffening":
        return 1.0 + (value - 1.0) * factor
    return min(factor * value, MAX_VALUES.get(name, math.inf))


def _cells(effect: ConstantsEffect, baseline: ConstantsEffect) -> list[object]:
    ratios = [new / old for new, old in zip(effect.evaluations, baseline.evaluations, strict=True)]
    work = max(ratios, key=lambda ratio: abs(math.log(ratio)))
    return [effect.error, work, effect.flagged, effect.gain, effect.awake_frames, effect.sleep_error]


class ConstantsScenes:
    """Scenes that run with each set of constants; their references are calculated once."""

    def __init__(self) -> None:
        names = {name for name, _, _ in REFERENCE_SCENES}
        self._references = {name: reference(problem(name)) for name in names}

    def effect(self) -> ConstantsEffect:
        """Run all scenes with the current constants."""
        error, evaluations, flagged = 0.0, [], 0
        for name, tolerances, integrator in REFERENCE_SCENES:
            for tolerance in tolerances:
                done = measure(problem(name), self._references[name], integrator, tolerance, energy=False)
                error = max(error, done.error / tolerance)
                evaluations.append(done.evaluations)
                flagged += done.flagged
        for name in SIMULATED_SCENES:
            positions, scene_evaluations, scene_flagged = _run_scene(name)
            error = np.linalg.norm(positions - _fine_positions(name), axis=-1).max()
            error_ratio = error / SIMULATED_SCENES[name][0]["tolerance"]
            # Frames that exceed their work limit need not meet the tolerance.
            error = max(error, float(error_ratio) if not scene_flagged else 0.0)
            evaluations.append(scene_evaluations)
            flagged += scene_flagged
        awake_frames, sleep_error = _sleep_effect()
        return ConstantsEffect(error, tuple(evaluations), flagged, _inverted_cell_gain(), awake_frames, sleep_error)


def _run_scene(name: str, **changes: Any) -> tuple[NDArray[np.float64], int, int]:
    """Run a scene that a gripper drives; return positions after each frame, evaluations and flagged frames."""
    values, frames, jump = SIMULATED_SCENES[name]
    values = {**values, "gripper.max_speed": 0.0, "wind.normal_drag": 0.0, **changes}
    simulation = Simulation(Scene.from_parameters(values))
    corner, positions, evaluations, flagged = simulation.positions[-1].copy(), [], 0, 0
    for frame in range(frames):
        displacement = np.array([0.0, -1.0, 0.5]) * (jump * frame if jump < 0.1 else jump * (frame % 3))
        events: list[Event] = [Target("gripper", tuple((corner + displacement).tolist()), None)]
        if frame == 0:
            events.append(Grasp("gripper", True))
        done = simulation.advance(events).advance
        if done is not None:
            evaluations, flagged = evaluations + done.evaluations, flagged + done.flagged
        positions.append(simulation.positions.copy())
    return np.array(positions), evaluations, flagged


@cache
def _fine_positions(name: str) -> NDArray[np.float64]:
    """Return the positions (frames, n, 3) [m] at a thousandth of the tolerance."""
    return _run_scene(name, tolerance=1e-3 * SIMULATED_SCENES[name][0]["tolerance"], work_limit=0.0)[0]


def _inverted_cell_gain() -> float:
    """Return the relative energy gain of an undamped sheet with an inverted cell at fixed steps."""
    sheet = RawSheet(resolution=8, k_d0=0.0, gravity=(0.0, 0.0, 0.0))
    plan, state = sheet.plan([]), State(sheet.flat(hung=True))
    state.x[:, [27, 36]] = state.x[:, [36, 27]]
    before, integrator = plan.energy(0.0, state.x, state.v), make_integrator("leapfrog")
    gain = 0.0
    for frame in range(24):
        integrator.advance(plan, state, frame * PERIOD, PERIOD)
        gain = max(gain, plan.energy(0.0, state.x, state.v) / before - 1.0)
    return gain


def _sleep_effect() -> tuple[int, float]:
    """Return the computed frames of a sheet that comes to rest, and its error from sleep over the tolerance."""
    values = {"cloth.resolution": [5, 6], "wind.normal_drag": 0.0, "air.drag": 5.0, "tolerance": 1e-3, "rate": 30.0}
    values |= {"material.stretch_modulus": 100.0, "material.shear_modulus": 20.0}
    sleeping = Simulation(Scene.from_parameters(values))
    computed = 0
    for _ in range(600):
        done = sleeping.advance().advance
        computed += done is not None and done.steps > 0
    reference = Simulation(Scene.from_parameters({**values, "tolerance": 1e-7}))
    for _ in range(600):
        reference.advance()
    distance = np.linalg.norm(reference.positions - sleeping.positions, axis=1).max()
    return computed, float(distance) / 1e-3
