# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error bound in fixed regimes: single springs, chains and pendulums.

A matrix exponential gives the exact solution of linear systems: springs that stay taut on a line, and joints. The other
systems are compared with the reference of the random scenes. The amplification of perturbations enters everywhere.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.physics.arrays import largest_distance
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.scene.scene import Scene
from validation.case_pool import run_cases, shown
from validation.report import Report, Table
from validation.tolerance.random_grips import Script
from validation.tolerance.random_scenes import Draw, frequency_of
from validation.tolerance.recording import Recording, record
from validation.tolerance.windows import Window, follow, judge_window, kicks

TOLERANCES = tuple(10.0**-k for k in range(3, 11))
PENDULUM_TOLERANCES = (1e-3, 1e-5, 1e-7)
#: Simulated time of springs and chains, and of pendulums [s].
DURATION, MINUTE = 2.0, 60.0
RATE = 60.0
#: Largest error that counts as rounding [m].
FLOOR = 1e-12
_SIZES = (7, 33, 101)


@attrs.frozen
class Regime:
    """One system of springs."""

    name: str
    tables: dict[str, Any]
    anchors: tuple[str, ...]
    linear: bool
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    duration: float = DURATION


def every_regime() -> list[Regime]:
    """Return springs without damping and in three regimes of damping, and chains."""
    found = [
        _spring("undamped", 0.0),
        _spring("under-damped", 0.3),
        _spring("critically damped", 2.0),
        _spring("over-damped", 6.0),
    ]
    for count in _SIZES:
        for damping in (0.0, 0.3):
            found += [_taut(count, damping), _joints(count, damping), _slack(count, damping)]
    return found


def pendulums() -> list[Regime]:
    """Return undamped pendulums, which run for a minute."""
    return [
        _pendulum("pendulum of 0.5 m", [0.5], [0.2], 2000.0, angle=1.0),
        _pendulum("pendulum of 4 m", [4.0], [0.5], 5000.0, angle=0.5),
        _pendulum("pendulum of 25 m", [25.0], [1.0], 500.0, angle=0.2),
        _pendulum("pendulum of two, small", [0.5, 0.3], [0.2, 0.1], 2000.0, angle=0.1),
        _pendulum("weight that bobs", [0.5], [0.2], 50.0, angle=0.0),
    ]


def _spring(name: str, damping: float) -> Regime:
    tables = {
        "positions": [[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]],
        "masses": 0.1,
        "springs": [[0, 1]],
        "rest_lengths": 0.5,
        "stiffness": 500.0,
        # The mass of a spring with one fixed end is that of the other end, as in the lecture.
        "k_d": damping * (0.1 * 1000.0) ** 0.5,
    }
    return Regime(f"spring, {name}", tables, ("0",), linear=True)


def _mixed(count: int) -> tuple[np.random.Generator, Array, Array, Array]:
    """Draw one chain: masses [kg], stiffness [N/m], rest lengths [m]."""
    rng = np.random.default_rng(count)
    masses = 0.01 * 10.0 ** rng.uniform(0.0, 1.0, count)
    return rng, masses, 100.0 * 30.0 ** rng.uniform(0.0, 1.0, count - 1), rng.uniform(0.02, 0.06, count - 1)


def _chain(
    name: str, places: Array, speeds: Array, masses: Array, rest: Array, stiffness: Array, damping: float, **more: Any
) -> Regime:
    count = len(places)
    tables = {
        "positions": places.tolist(),
        "velocities": speeds.tolist(),
        "masses": masses.tolist(),
        "springs": [[k, k + 1] for k in range(count - 1)],
        "rest_lengths": rest.tolist(),
        "stiffness": stiffness.tolist(),
        "k_d0": damping,
    }
    words = f"chain of {count}, {name}, {'damped' if damping else 'undamped'}"
    return Regime(words, tables, ("0", str(count - 1)), **more)


def _taut(count: int, damping: float) -> Regime:
    """Return a chain on a line, stretched by a half between its ends, with velocities along the line."""
    rng, masses, stiffness, rest = _mixed(count)
    # In equilibrium every spring has the same tension.
    tension = 0.5 * rest.sum() / (1.0 / stiffness).sum()
    places = np.zeros((count, 3))
    places[1:, 0] = np.cumsum(rest + tension / stiffness)
    speeds = np.zeros((count, 3))
    # Small enough that every spring stays taut.
    speeds[1:-1, 0] = 0.1 * rest.min() * np.sqrt(stiffness.min() / masses.max()) * rng.uniform(-1.0, 1.0, count - 2)
    return _chain("taut", places, speeds, masses, rest, stiffness * rest, damping, linear=True)


def _joints(count: int, damping: float) -> Regime:
    """Return a chain of springs of zero rest length in space."""
    rng, masses, stiffness, rest = _mixed(count)
    places = np.zeros((count, 3))
    places[1:, 0] = np.cumsum(rest)
    places[1:-1] += 0.01 * rng.normal(size=(count - 2, 3))
    speeds = np.zeros((count, 3))
    speeds[1:-1] = 0.2 * rng.normal(size=(count - 2, 3))
    return _chain("joints", places, speeds, masses, 0.0 * rest, stiffness, damping, linear=True)


def _slack(count: int, damping: float) -> Regime:
    """Return a zigzag chain between two points at a distance of three quarters of its length."""
    _, masses, stiffness, rest = _mixed(count)
    places = np.zeros((count, 3))
    places[1:, 0] = 0.75 * np.cumsum(rest)
    sides = np.sqrt(1.0 - 0.75**2) * rest * np.where(np.arange(count - 1) % 2, 1.0, -1.0)
    places[1:, 2] = np.cumsum(sides)
    places[1:, 1] = 0.1 * places[1:, 2]
    more = {"linear": False, "gravity": (0.0, 0.0, -9.81)}
    return _chain("slack", places, np.zeros((count, 3)), masses, rest, stiffness * rest, damping, **more)


def _pendulum(name: str, lengths: list[float], masses: list[float], stiffness: float, *, angle: float) -> Regime:
    along = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    places = np.concatenate([[0.0], np.cumsum(lengths)])[:, None] * along
    count = len(places)
    tables = {
        "positions": places.tolist(),
        "masses": [1.0, *masses],
        "springs": [[k, k + 1] for k in range(count - 1)],
        "rest_lengths": lengths,
        "stiffness": [stiffness * length for length in lengths],
    }
    return Regime(name, tables, ("0",), linear=False, gravity=(0.0, 0.0, -9.81), duration=MINUTE)


def drawn(regime: Regime, tolerance: float) -> Draw:
    """Return a regime as a scene without grippers."""
    values = {
        "rate": RATE,
        "tolerance": tolerance,
        "cloth.springs": "springs.yaml",
        "cloth.anchors": list(regime.anchors),
        "cloth.position": [0.0, 0.0, 0.0],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "bending.model": "none",
        "gravity": list(regime.gravity),
        "air.drag": 0.0,
        "grippers": [""],
    }
    scene = Scene.from_parameters(values, files={"springs.yaml": json.dumps(regime.tables).encode()})
    state = scene.starting_state()
    return Draw(
        seed=0,
        index=0,
        scene=scene,
        state=state,
        script=Script(holds=()),
        frames=round(regime.duration * RATE),
        words=regime.name,
        cost=0.0,
        frequency=frequency_of(scene, state.x),
    )


def exact(model: Model, x: Array, v: Array, period: float, frames: int) -> list[Array]:
    """Return positions (3, n) [m] at the end of each frame of a linear system, by a matrix exponential.

    The system has no gravity.
    """
    from scipy.linalg import expm

    count = model.particle_count
    springs = model.forces[0]
    if len(model.forces) != 1 or not isinstance(springs, PairSprings):
        raise ValueError("the model has other forces than springs; the exact solution needs a linear model")
    difference = np.zeros((len(springs.pairs), count))
    difference[np.arange(len(springs.pairs)), springs.pairs[:, 0]] = -1.0
    difference[np.arange(len(springs.pairs)), springs.pairs[:, 1]] = 1.0
    stiff = difference.T @ (springs.rigidity[:, None] * difference)
    damped = difference.T @ (springs.damping[:, None] * difference)
    away = difference @ x.T
    # Stretch of a spring on a line: d - l0 d / |d|; of a joint: d.
    length = np.sqrt(np.sum(away * away, axis=1))
    stretch = away * (1.0 - springs.rest_length / np.where(length > 0.0, length, 1.0))[:, None]
    push = -difference.T @ (springs.rigidity[:, None] * stretch)
    inverse = model.inverse_masses[:, None]
    free = np.flatnonzero(model.inverse_masses > 0.0)
    many = len(free)
    # State: deviation from the start, velocity, and 1; one column for each axis, because the axes are independent.
    matrix = np.zeros((2 * many + 3, 2 * many + 3))
    matrix[:many, many : 2 * many] = np.eye(many)
    matrix[many : 2 * many, :many] = -(inverse * stiff)[np.ix_(free, free)]
    matrix[many : 2 * many, many : 2 * many] = -(inverse * damped)[np.ix_(free, free)]
    matrix[many : 2 * many, 2 * many :] = (inverse * push)[free]
    step = expm(matrix * period)
    state = np.zeros((2 * many + 3, 3))
    state[many : 2 * many], state[2 * many :] = v.T[free], np.eye(3)
    found = []
    for _ in range(frames):
        state = step @ state
        place = x.copy()
        place[:, free] += state[:many].T
        found.append(place)
    return found


@attrs.frozen
class Outcome:
    """One regime at one tolerance."""

    #: Largest ratio of error to error bound of its windows; of a pendulum, at all times.
    ratio: float
    #: Error over the first second [m], and amplification in it; of a pendulum, over the whole run.
    error: float
    growth: float
    flagged: int
    #: Error of the reference, or its difference from the matrix exponential [m].
    reference: float


def judge_regime(case: tuple[Regime, float]) -> Outcome:
    """Evaluate one regime at one tolerance."""
    regime, tolerance = case
    run = record(drawn(regime, tolerance))
    flagged = sum(frame.advance.flagged > 0 for frame in run.frames)
    if regime.duration == MINUTE:
        return _minute(run, tolerance, flagged)
    second = run.draw.frames_a_second
    windows: list[Window] = []
    reference = 0.0
    for first in (0, second // 2, second):
        window = judge_window(run, first, second, seed=first)[0]
        if regime.linear:
            places = exact(run.system.model, run.positions[first], run.velocities[first], run.period, second)
            there = run.positions[first + 1 : first + 1 + second]
            error = max(largest_distance(a, b) for a, b in zip(there, places, strict=True))
            reference = max(reference, abs(error - window.error))
            window = attrs.evolve(window, error=error)
        reference = max(reference, window.reference_error)
        windows.append(window)
    ratio = max(window.ratio for window in windows)
    return Outcome(ratio, windows[0].error, windows[0].growth, flagged, reference)


def _minute(run: Recording, tolerance: float, flagged: int) -> Outcome:
    """Evaluate a pendulum; the bound at time t is max(1, t) x tolerance x amplification."""
    runs = [
        follow(run, 0, len(run.frames), kicks(run, 0, second=k == 1), local) for k, local in enumerate((1e-12, 1e-13))
    ]
    growth, ratio, error, reference = 1.0, 0.0, 0.0, 0.0
    for frame, (rough, fine) in enumerate(zip(runs[0].positions, runs[1].positions, strict=True)):
        growth = max(growth, *(float(each.growths[frame].max()) for each in runs))
        here = largest_distance(run.positions[frame + 1], fine)
        seconds = max(1.0, (frame + 1) * run.period)
        error, ratio = max(error, here), max(ratio, here / (seconds * tolerance * growth))
        reference = max(reference, largest_distance(rough, fine))
    return Outcome(ratio, error, growth, flagged, reference)


def regimes(options: argparse.Namespace) -> Report:
    """Evaluate all regimes."""
    from tqdm import tqdm

    report = Report("Error bound in fixed regimes", "python -m validation tolerance --regimes")
    cases = [(regime, tolerance) for regime in every_regime() for tolerance in TOLERANCES]
    cases += [(regime, tolerance) for regime in pendulums() for tolerance in PENDULUM_TOLERANCES]
    found: dict[tuple[str, float], Outcome] = {}
    done_cases = run_cases(judge_regime, cases, workers=options.jobs, limit=options.limit)
    for done in shown(done_cases, len(cases), "case"):
        regime, tolerance = done.case
        if done.result is None:
            report.failures.append(f"{regime.name} at {tolerance:.0e} m: {done.trouble}")
        else:
            found[regime.name, tolerance] = outcome = done.result
            says = f"{outcome.ratio:.3g} of the error bound, g {outcome.growth:.3g}, {outcome.flagged} frames flagged"
            tqdm.write(f"{regime.name} at {tolerance:.0e} m: error {outcome.error:.2g} m, {says}")
    names = [regime.name for regime in every_regime()]
    report.tables += [
        _table(
            "Error / (tolerance x max(1, g)) over windows of a second, * with flagged frames", names, found, "ratio"
        ),
        _table("Error over the first second [m], ! if it does not fall with the tolerance", names, found, "error"),
    ]
    minutes = Table("Undamped for a minute", ["what", "tolerance m", "error m", "g", "ratio", "flagged", "reference m"])
    for regime in pendulums():
        for tolerance in PENDULUM_TOLERANCES:
            each = found.get((regime.name, tolerance))
            if each:
                numbers = [each.error, each.growth, each.ratio, each.flagged, each.reference]
                minutes.rows.append([regime.name, tolerance, *numbers])
    report.tables.append(minutes)
    broken = [(what, outcome) for what, outcome in found.items() if outcome.ratio > 1.0]
    risen = [(name, tolerance) for name in names for tolerance in TOLERANCES if not _falls(name, tolerance, found)]
    report.notes += [
        f"{len(broken)} of {len(found)} violate the error bound, "
        f"{sum(not outcome.flagged for _, outcome in broken)} of them without a flagged frame",
        f"{len(risen)} whose error is above both that of the next looser tolerance and a tenth of their own",
        f"largest error of the reference {max((outcome.reference for outcome in found.values()), default=0.0):.2g} m",
    ]
    if broken:
        report.failures.append(f"{len(broken)} regimes violate the error bound")
    if risen:
        report.failures.append(f"in {len(risen)} regimes the error does not fall with the tolerance")
    return report


def _falls(name: str, tolerance: float, found: dict[tuple[str, float], Outcome]) -> bool:
    """Return true if the error is below one of: that of the next looser tolerance, tolerance / 10, rounding."""
    this, looser = found.get((name, tolerance)), found.get((name, 10.0 ** (round(np.log10(tolerance)) + 1)))
    return not this or not looser or this.error <= max(looser.error, 0.1 * tolerance, FLOOR)


def _table(title: str, names: list[str], found: dict[tuple[str, float], Outcome], what: str) -> Table:
    table = Table(title, ["what", *(f"{tolerance:.0e}" for tolerance in TOLERANCES), "g", "reference m"])
    for name in names:
        row: list[Any] = [name]
        growth = reference = 0.0
        for tolerance in TOLERANCES:
            outcome = found.get((name, tolerance))
            if outcome is None:
                row.append("-")
                continue
            mark = "*" if what == "ratio" and outcome.flagged else ""
            mark = "!" if what == "error" and not _falls(name, tolerance, found) else mark
            row.append(f"{getattr(outcome, what):.2g}{mark}")
            growth, reference = max(growth, outcome.growth), max(reference, outcome.reference)
        table.rows.append([*row, growth, reference])
    return table
