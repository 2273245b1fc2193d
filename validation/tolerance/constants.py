# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of tuned numbers, and what half and double of each does to error and work."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from support.problems import PERIOD, problem
from support.raw_sheet import RawSheet
from support.reference import Reference, reference
from support.reference_runs import measure

from cloth_sim_ros.physics.constants import CONSTANTS, Constants
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation
from validation.report import Report, Table

#: Scenes whose errors are known, with their tolerances [m], and the integrator.
HELD = (
    ("chain", (1e-3, 1e-5, 1e-7), "auto"),
    ("drumhead", (1e-2, 1e-4, 1e-6), "auto"),
    ("carried16", (1e-2, 1e-3, 1e-4, 1e-6), "auto"),
    ("mesh", (1e-2, 1e-4, 1e-6), "auto"),
    ("chain", (1e-3,), "implicit"),
)
#: Scenes through the simulation's door that bring in what those don't: single precision, the automatic choice of
#: implicit steps, frames that reach their work limit, an impact. Frames, few enough that a change of rounding does not
#: grow to the tolerance; and by how much the target jumps in each [m].
DRIVEN: dict[str, tuple[dict[str, Any], int, float]] = {
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
#: Numbers that a change of direction or size makes no sense of: parts of a limit can't be doubled beyond it.
_MOST = {"safety": 1.0, "share": 1.0, "aim": 1.0, "far": 0.5}


@attrs.frozen
class Effect:
    """What the scenes gave by one set of constants."""

    #: Largest error over its tolerance.
    error: float
    #: Force evaluations of each scene.
    evaluations: tuple[int, ...]
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
    report = Report("Constants", "python -m validation constants", tables=[table])
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
        f"By the table as it is: error {usual.error:.3g} of the tolerance at most, {sum(usual.evaluations)} "
        f"evaluations, {usual.flagged} flagged frames, energy gain {usual.gain:.2g}, {usual.awake} frames until a "
        f"sheet sleeps for good, {usual.left_out:.2g} of the tolerance left out by sleep",
        "error: largest over the tolerance, of all scenes; work: force evaluations, relative to the table as it is, in "
        "the scene in which they change most",
        f"scenes: {', '.join(name for name, _, _ in HELD)}, {', '.join(DRIVEN)}, an undamped sheet with an inverted "
        "cell, a sheet that comes to rest; what sets threads or time alone (own, call) changes none of the columns",
    ]
    return report


def _cells(effect: Effect, usual: Effect) -> list[object]:
    ratios = [new / old for new, old in zip(effect.evaluations, usual.evaluations, strict=True)]
    work = max(ratios, key=lambda ratio: abs(math.log(ratio)))
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
        error, evaluations, flagged = 0.0, [], 0
        for name, tolerances, integrator in HELD:
            for tolerance in tolerances:
                done = measure(problem(name), self._known[name], integrator, tolerance, energy=False)
                error = max(error, done.error / tolerance)
                evaluations.append(done.evaluations)
                flagged += done.flagged
        for name in DRIVEN:
            positions, spent, missed = _driven(name)
            off = np.linalg.norm(positions - _known(name), axis=-1).max() / DRIVEN[name][0]["tolerance"]
            # Frames that were ended by force have no share of the tolerance to keep.
            error = max(error, float(off) if not missed else 0.0)
            evaluations.append(spent)
            flagged += missed
        awake, left_out = _rest()
        return Effect(error, tuple(evaluations), flagged, _pushed_to_a_point(), awake, left_out)


def _driven(name: str, **changes: Any) -> tuple[NDArray[np.float64], int, int]:
    """Positions after each frame, evaluations and flagged frames of one of the scenes that a gripper drives."""
    values, frames, jump = DRIVEN[name]
    simulation = Simulation(
        Scene.from_parameters({**values, "gripper.max_speed": 0.0, "wind.normal_drag": 0.0, **changes})
    )
    corner, places, spent, missed = simulation.positions[-1].copy(), [], 0, 0
    for frame in range(frames):
        aside = np.array([0.0, -1.0, 0.5]) * (jump * frame if jump < 0.1 else jump * (frame % 3))
        events: list[Event] = [Target("gripper", tuple(float(number) for number in corner + aside), None)]
        if frame == 0:
            events.append(Grasp("gripper", True))
        done = simulation.advance(events).advance
        if done is not None:
            spent, missed = spent + done.evaluations, missed + done.flagged
        places.append(simulation.positions.copy())
    return np.array(places), spent, missed


@cache
def _known(name: str) -> NDArray[np.float64]:
    """The positions at a thousandth of the tolerance."""
    return _driven(name, tolerance=1e-3 * DRIVEN[name][0]["tolerance"], work_limit=0.0)[0]


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
    values = {"cloth.resolution": [5, 6], "wind.normal_drag": 0.0, "air.drag": 5.0, "tolerance": 1e-3, "rate": 30.0}
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
