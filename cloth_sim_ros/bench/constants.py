# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of tuned numbers, and what half and double of each does to error and work."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager

import attrs
import numpy as np

from cloth_sim_ros.bench.problems import PERIOD, problem
from cloth_sim_ros.bench.raw_sheet import RawSheet
from cloth_sim_ros.bench.reference import Reference, reference
from cloth_sim_ros.bench.report import Report, Table
from cloth_sim_ros.bench.tolerance_sweep import measure
from cloth_sim_ros.physics.constants import CONSTANTS, Constants
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation

#: Scenes whose errors are known, with their tolerances [m], and the integrator.
HELD = (
    ("chain", (1e-3, 1e-5, 1e-7), "auto"),
    ("drumhead", (1e-2, 1e-4, 1e-6), "auto"),
    ("carried16", (1e-2, 1e-3, 1e-4, 1e-6), "auto"),
    ("mesh", (1e-2, 1e-4, 1e-6), "auto"),
    ("chain", (1e-3,), "implicit"),
)
#: Numbers that a change of direction or size makes no sense of: parts of a limit can't be doubled beyond it.
_MOST = {"safety": 1.0, "share": 1.0, "aim": 1.0, "far": 0.5}


@attrs.frozen
class Effect:
    """What the scenes gave by one set of constants."""

    #: Largest error over its tolerance.
    error: float
    evaluations: int
    flagged: int
    #: Largest gain of energy from nowhere, relative to what there was, of a sheet that nothing holds or drives.
    gain: float
    #: Frames of a sheet that comes to rest that had to be computed, and how far sleep left it from where it would be
    #: [m], over its tolerance.
    awake: int
    left_out: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    names = [field.name for field in attrs.fields(Constants)]
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", default=names, help="of the table (all)")


def run(options: argparse.Namespace) -> Report:
    """Measure the table."""
    from tqdm import tqdm

    columns = ["name", "value", "meaning"]
    for change in ("half", "double"):
        columns += [f"{change}: error", "work", "flagged", "gain", "awake", "left out"]
    table = Table("Tuned numbers", columns)
    report = Report("Constants", "cloth_bench constants", tables=[table])
    scenes = Scenes()
    usual = scenes.effect()
    for field in tqdm([each for each in attrs.fields(Constants) if each.name in options.only], unit="constant"):
        value = float(getattr(CONSTANTS, field.name))
        row: list[object] = [field.name, value, field.metadata["meaning"]]
        for factor in (0.5, 2.0):
            changed = min(factor * value, _MOST.get(field.name, math.inf))
            with _set_to(field.name, 1.0 + (value - 1.0) * factor if field.name == "stiffened" else changed):
                row += _cells(scenes.effect(), usual)
        table.rows.append(row)
    report.notes += [
        f"By the table as it is: error {usual.error:.3g} of the tolerance at most, {usual.evaluations} evaluations, "
        f"{usual.flagged} flagged frames, energy gain {usual.gain:.2g}, {usual.awake} frames until a sheet sleeps for "
        f"good, {usual.left_out:.2g} of the tolerance left out by sleep",
        "error: largest over the tolerance, of all scenes; work: force evaluations, relative to the table as it is",
    ]
    return report


def _cells(effect: Effect, usual: Effect) -> list[object]:
    work = effect.evaluations / usual.evaluations
    return [effect.error, work, effect.flagged, effect.gain, effect.awake, effect.left_out]


@contextmanager
def _set_to(name: str, value: float) -> Iterator[None]:
    before = getattr(CONSTANTS, name)
    setattr(CONSTANTS, name, value)
    try:
        yield
    finally:
        setattr(CONSTANTS, name, before)


class Scenes:
    """What is run again and again; references are calculated once."""

    def __init__(self) -> None:
        self._known: dict[str, Reference] = {}
        for name, _, _ in HELD:
            if name not in self._known:
                self._known[name] = reference(problem(name))

    def effect(self) -> Effect:
        """Run everything by the constants in force."""
        error, evaluations, flagged = 0.0, 0, 0
        for name, tolerances, integrator in HELD:
            for tolerance in tolerances:
                done = measure(problem(name), self._known[name], integrator, tolerance, energy=False)
                error = max(error, done.error / tolerance)
                evaluations, flagged = evaluations + done.evaluations, flagged + done.flagged
        awake, left_out = _rest()
        return Effect(error, evaluations, flagged, _pushed_to_a_point(), awake, left_out)


def _pushed_to_a_point() -> float:
    """Energy that fixed steps make of an undamped sheet with an inverted cell, relative to what there was."""
    sheet = RawSheet(resolution=8, k_d0=0.0, gravity=(0.0, 0.0, 0.0))
    plan, state = sheet.plan([]), State(sheet.flat(hung=True))
    state.x[:, [27, 36]] = state.x[:, [36, 27]]
    before, integrator = plan.energy(0.0, state.x, state.v), make_integrator("leapfrog")
    gain = 0.0
    for frame in range(24):
        integrator.advance(plan, state, frame * PERIOD, PERIOD)
        gain = max(gain, plan.energy(0.0, state.x, state.v) / before - 1.0)
    return gain


def _rest() -> tuple[int, float]:
    """Frames that were computed of a sheet that comes to rest, and what sleep left out over the tolerance."""
    values = {"cloth.resolution": [5, 6], "air.drag": 5.0, "tolerance": 1e-3, "rate": 30.0}
    values |= {"material.stretch_modulus": 100.0, "material.shear_modulus": 20.0}
    sleeping = Simulation(Scene.from_parameters(values))
    computed = 0
    for _ in range(600):
        done = sleeping.advance().advance
        computed += done is not None and done.steps > 0
    moving = Simulation(Scene.from_parameters({**values, "tolerance": 1e-7}))
    for _ in range(600):
        moving.advance()
    away = np.linalg.norm(moving.positions - sleeping.positions, axis=1).max()
    return computed, float(away) / 1e-3
