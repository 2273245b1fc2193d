# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Error bound in fixed regimes: single springs, chains and pendulums.

A matrix exponential gives the exact motion of linear systems: springs that stay taut on a line, and joints. The other
systems are compared with the reference of the random scenes. The amplification of perturbations enters everywhere.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros import Drag, Gravity, Model, PairSprings, Scene, Wind
from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.model.forces.force import Array
from validation.case_pool import CasePool
from validation.report import Report, Table
from validation.tolerance.random_scenes import RandomScene, chain_tables
from validation.tolerance.windows import (
    RecordedRun,
    Window,
    evaluate_window,
    record_run,
    run_reference,
    unit_perturbations,
)


class LinearMotion:
    """Motion of taut springs on a line, or of joints, under gravity, linear drag and wind.

    Args:
        model: springs, gravity, drag and wind only.
        x: initial positions [m], shape (3, n).
        v: initial velocities [m/s], shape (3, n).

    Raises:
        ValueError: for another force.
    """

    def __init__(self, model: Model, x: Array, v: Array) -> None:
        count = model.particle_count
        stiff, damped, force = np.zeros((count, count)), np.zeros((count, count)), np.zeros((count, 3))
        acceleration, drag = np.zeros(3), 0.0
        for term in model.forces:
            if isinstance(term, Gravity | Wind):
                acceleration += term.acceleration
            elif isinstance(term, Drag):
                drag += term.rate
            elif isinstance(term, PairSprings):
                difference = np.zeros((len(term.pairs), count))
                difference[np.arange(len(term.pairs)), term.pairs[:, 0]] = -1.0
                difference[np.arange(len(term.pairs)), term.pairs[:, 1]] = 1.0
                stiff += difference.T @ (term.rigidity[:, None] * difference)
                damped += difference.T @ (term.damping[:, None] * difference)
                separations = difference @ x.T
                # Stretch of a spring on a line: d - l0 d / |d|; of a joint: d.
                length = np.sqrt(np.sum(separations * separations, axis=1))
                stretch = separations * (1.0 - term.rest_length / np.where(length > 0.0, length, 1.0))[:, None]
                force -= difference.T @ (term.rigidity[:, None] * stretch)
            else:
                raise ValueError(f"the exact solution needs a linear model, but it has the force '{term.name}'")
        inverse = model.inverse_masses[:, None]
        self._x, self._free = x, np.flatnonzero(model.inverse_masses > 0.0)
        free, n = self._free, len(self._free)
        # State: deviation from the start, velocity, and 1; one column for each axis, because the axes are independent.
        matrix = np.zeros((2 * n + 3, 2 * n + 3))
        matrix[:n, n : 2 * n] = np.eye(n)
        matrix[n : 2 * n, :n] = -(inverse * stiff)[np.ix_(free, free)]
        matrix[n : 2 * n, n : 2 * n] = -(inverse * damped)[np.ix_(free, free)] - drag * np.eye(n)
        matrix[n : 2 * n, 2 * n :] = (inverse * force)[free] + acceleration
        self._matrix, self._propagators = matrix, dict[float, Array]()
        self._start = np.zeros((2 * n + 3, 3))
        self._start[n : 2 * n], self._start[2 * n :] = v.T[free], np.eye(3)
        self._state = self._start

    def advance(self, duration: float) -> Array:
        """Advance by a duration [s]; return the positions [m], shape (3, n)."""
        self._state = self.propagator(duration) @ self._state
        return self._positions(self._state)

    def positions_after(self, duration: float) -> Array:
        """Return the positions [m], shape (3, n), a duration [s] after the start."""
        return self._positions(self.propagator(duration) @ self._start)

    def _positions(self, state: Array) -> Array:
        positions = self._x.copy()
        positions[:, self._free] += state[: len(self._free)].T
        return positions

    def propagator(self, duration: float) -> Array:
        """Return the matrix that advances a state by a duration [s]."""
        from scipy.linalg import expm

        if duration not in self._propagators:
            self._propagators[duration] = expm(self._matrix * duration)
        return self._propagators[duration]

    def amplification(self, durations: Sequence[float]) -> float:
        """Return the largest amplification of a perturbation at the ends of successive durations [s].

        All particles are perturbed by one size, each in the worst direction.
        """
        n, product, largest = len(self._free), np.eye(2 * len(self._free)), 0.0
        for duration in durations:
            product = self.propagator(duration)[: 2 * n, : 2 * n] @ product
            response = np.abs(product[:n])
            largest = max(largest, *(float(part.sum(axis=1).max()) for part in (response[:, :n], response[:, n:])))
        return largest


TOLERANCES = tuple(10.0**-k for k in range(3, 11))
PENDULUM_TOLERANCES = (1e-3, 1e-5, 1e-7)
#: Simulated time of springs and chains, and of pendulums [s].
DURATION, PENDULUM_DURATION = 2.0, 60.0
RATE = 60.0
#: Largest error that counts as rounding [m].
ROUNDING_ERROR = 1e-12
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
    #: Frames per second [1/s], and linear drag [1/s].
    rate: float = RATE
    drag: float = 0.0


def all_regimes() -> list[Regime]:
    """Return springs without damping and in three regimes of damping, and chains."""
    spring_dampings = {"undamped": 0.0, "under-damped": 0.3, "critically damped": 2.0, "over-damped": 6.0}
    regimes = [_spring(name, damping) for name, damping in spring_dampings.items()]
    for count in _SIZES:
        for damping in (0.0, 0.3):
            regimes += [_taut(count, damping), _joints(count, damping), _slack(count, damping)]
    return regimes


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


def _chain(name: str, *table: Array, damping: float, **more: Any) -> Regime:
    """Return a chain, anchored at both ends; `table` has the arrays of `chain_tables`."""
    tables, count = chain_tables(*table, damping=damping), len(table[0])
    words = f"chain of {count}, {name}, {'damped' if damping else 'undamped'}"
    return Regime(words, tables, ("0", str(count - 1)), **more)


def _taut(count: int, damping: float) -> Regime:
    """Return a chain on a line, stretched by a half between its ends, with velocities along the line."""
    rng, masses, stiffness, rest_lengths = _mixed(count)
    # In equilibrium every spring has the same tension.
    tension = 0.5 * rest_lengths.sum() / (1.0 / stiffness).sum()
    positions = np.zeros((count, 3))
    positions[1:, 0] = np.cumsum(rest_lengths + tension / stiffness)
    velocities = np.zeros((count, 3))
    # Small enough that every spring stays taut.
    speed = 0.1 * rest_lengths.min() * np.sqrt(stiffness.min() / masses.max())
    velocities[1:-1, 0] = speed * rng.uniform(-1.0, 1.0, count - 2)
    return _chain(
        "taut", positions, velocities, masses, rest_lengths, stiffness * rest_lengths, damping=damping, linear=True
    )


def _joints(count: int, damping: float) -> Regime:
    """Return a chain of springs of zero rest length in space."""
    rng, masses, stiffness, rest_lengths = _mixed(count)
    positions = np.zeros((count, 3))
    positions[1:, 0] = np.cumsum(rest_lengths)
    positions[1:-1] += 0.01 * rng.normal(size=(count - 2, 3))
    velocities = np.zeros((count, 3))
    velocities[1:-1] = 0.2 * rng.normal(size=(count - 2, 3))
    return _chain("joints", positions, velocities, masses, 0.0 * rest_lengths, stiffness, damping=damping, linear=True)


def _slack(count: int, damping: float) -> Regime:
    """Return a zigzag chain between two points at a distance of three quarters of its length."""
    _, masses, stiffness, rest_lengths = _mixed(count)
    positions = np.zeros((count, 3))
    positions[1:, 0] = 0.75 * np.cumsum(rest_lengths)
    sides = np.sqrt(1.0 - 0.75**2) * rest_lengths * np.where(np.arange(count - 1) % 2, 1.0, -1.0)
    positions[1:, 2] = np.cumsum(sides)
    positions[1:, 1] = 0.1 * positions[1:, 2]
    more = {"linear": False, "gravity": (0.0, 0.0, -9.81)}
    rigidity = stiffness * rest_lengths
    return _chain("slack", positions, np.zeros((count, 3)), masses, rest_lengths, rigidity, damping=damping, **more)


def _pendulum(name: str, lengths: list[float], masses: list[float], stiffness: float, *, angle: float) -> Regime:
    along = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    positions, rest_lengths = np.concatenate([[0.0], np.cumsum(lengths)])[:, None] * along, np.array(lengths)
    rigidity, still = stiffness * rest_lengths, np.zeros_like(positions)
    tables = chain_tables(positions, still, np.array([1.0, *masses]), rest_lengths, rigidity, damping=0.0)
    return Regime(name, tables, ("0",), linear=False, gravity=(0.0, 0.0, -9.81), duration=PENDULUM_DURATION)


def regime_scene(regime: Regime, tolerance: float) -> RandomScene:
    """Return a regime as a scene without grippers."""
    values = {
        "rate": regime.rate,
        "tolerance": tolerance,
        "cloth.springs": "springs.yaml",
        "cloth.anchors": list(regime.anchors),
        "cloth.position": [0.0, 0.0, 0.0],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "bending.model": "none",
        "gravity": list(regime.gravity),
        "air.drag": regime.drag,
        "grippers": [""],
    }
    scene = Scene.from_parameters(values, files={"springs.yaml": json.dumps(regime.tables).encode()})
    frames = round(regime.duration * regime.rate)
    return RandomScene(scene=scene, state=scene.starting_state(), frames=frames, words=regime.name)


@attrs.frozen
class RegimeResult:
    """One regime at one tolerance."""

    #: Largest ratio of error to error bound of its windows; of a pendulum, at all times.
    ratio: float
    #: Error over the first second [m], and amplification in it; of a pendulum, over the whole run.
    error: float
    growth: float
    flagged: int
    #: Error of the reference, or its difference from the matrix exponential [m].
    reference: float


def evaluate_regime(case: tuple[Regime, float]) -> RegimeResult:
    """Evaluate one regime at one tolerance."""
    regime, tolerance = case
    run = record_run(regime_scene(regime, tolerance))
    flagged = sum(frame.advance.flagged > 0 for frame in run.frames)
    if regime.duration == PENDULUM_DURATION:
        return _evaluate_pendulum(run, tolerance, flagged)
    frames_per_second = run.draw.frames_per_second
    windows, reference = list[Window](), 0.0
    for first in (0, frames_per_second // 2, frames_per_second):
        window = evaluate_window(run, first, frames_per_second, seed=first)[0]
        if regime.linear:
            motion = LinearMotion(run.system.model, run.positions[first], run.velocities[first])
            engine_positions = run.positions[first + 1 : first + 1 + frames_per_second]
            error = max(largest_distance(x, motion.advance(run.period)) for x in engine_positions)
            reference = max(reference, abs(error - window.error))
            window = attrs.evolve(window, error=error)
        reference = max(reference, window.reference_error)
        windows.append(window)
    ratio = max(window.ratio for window in windows)
    return RegimeResult(ratio, windows[0].error, windows[0].amplification, flagged, reference)


def _evaluate_pendulum(run: RecordedRun, tolerance: float, flagged: int) -> RegimeResult:
    """Evaluate a pendulum; the bound at time t is max(1, t) x tolerance x amplification."""
    runs = [
        run_reference(run, 0, len(run.frames), unit_perturbations(run, 0, second=k == 1), local)
        for k, local in enumerate((1e-12, 1e-13))
    ]
    amplification, ratio, error, reference = 1.0, 0.0, 0.0, 0.0
    for frame, (coarse_positions, fine_positions) in enumerate(zip(runs[0].positions, runs[1].positions, strict=True)):
        amplifications = (float(reference_run.amplifications[frame].max()) for reference_run in runs)
        amplification = max(amplification, *amplifications)
        distance = largest_distance(run.positions[frame + 1], fine_positions)
        seconds = max(1.0, (frame + 1) * run.period)
        error, ratio = max(error, distance), max(ratio, distance / (seconds * tolerance * amplification))
        reference = max(reference, largest_distance(coarse_positions, fine_positions))
    return RegimeResult(ratio, error, amplification, flagged, reference)


def regimes(options: argparse.Namespace) -> Report:
    """Evaluate all regimes."""
    report = Report("Error bound in fixed regimes")
    cases = [(regime, tolerance) for regime in all_regimes() for tolerance in TOLERANCES]
    cases += [(regime, tolerance) for regime in pendulums() for tolerance in PENDULUM_TOLERANCES]
    done = CasePool(options.jobs, options.limit).report(
        evaluate_regime,
        cases,
        report,
        name=lambda case: f"{case[0].name} at {case[1]:.0e} m",
        describe=lambda result: (
            f"error {result.error:.2g} m, {result.ratio:.3g} of the error bound, g {result.growth:.3g}"
        ),
    )
    results = {(regime.name, tolerance): result for (regime, tolerance), result in done}
    names = [regime.name for regime in all_regimes()]
    report.tables += [
        _table(
            "Error / (tolerance x max(1, g)) over windows of a second, * with flagged frames", names, results, "ratio"
        ),
        _table("Error over the first second [m], ! if it does not fall with the tolerance", names, results, "error"),
    ]
    minutes = report.add_table(
        "Undamped for a minute", ["what", "tolerance m", "error m", "g", "ratio", "flagged", "reference m"]
    )
    for regime in pendulums():
        for tolerance in PENDULUM_TOLERANCES:
            result = results.get((regime.name, tolerance))
            if result:
                numbers = [result.error, result.growth, result.ratio, result.flagged, result.reference]
                minutes.rows.append([regime.name, tolerance, *numbers])
    violated = [(case_key, result) for case_key, result in results.items() if result.ratio > 1.0]
    points = [(name, tolerance) for name in names for tolerance in TOLERANCES]
    risen = [point for point in points if not _error_falls(*point, results)]
    report.notes += [
        f"{len(violated)} of {len(results)} violate the error bound, "
        f"{sum(not result.flagged for _, result in violated)} of them without a flagged frame",
        f"{len(risen)} whose error is above both that of the next looser tolerance and a tenth of their own",
        f"largest error of the reference {max((result.reference for result in results.values()), default=0.0):.2g} m",
    ]
    report.require(not violated, f"{len(violated)} regimes violate the error bound")
    report.require(not risen, f"in {len(risen)} regimes the error does not fall with the tolerance")
    return report


def _error_falls(name: str, tolerance: float, results: dict[tuple[str, float], RegimeResult]) -> bool:
    """Return true if the error is below one of: that of the next looser tolerance, tolerance / 10, rounding."""
    result = results.get((name, tolerance))
    looser_result = results.get((name, 10.0 ** (round(np.log10(tolerance)) + 1)))
    return not result or not looser_result or result.error <= max(looser_result.error, 0.1 * tolerance, ROUNDING_ERROR)


def _table(title: str, names: list[str], results: dict[tuple[str, float], RegimeResult], quantity: str) -> Table:
    table = Table(title, ["what", *(f"{tolerance:.0e}" for tolerance in TOLERANCES), "g", "reference m"])
    for name in names:
        row: list[Any] = [name]
        growth = reference = 0.0
        for tolerance in TOLERANCES:
            result = results.get((name, tolerance))
            if result is None:
                row.append("-")
                continue
            mark = "*" if quantity == "ratio" and result.flagged else ""
            mark = "!" if quantity == "error" and not _error_falls(name, tolerance, results) else mark
            row.append(f"{getattr(result, quantity):.2g}{mark}")
            growth, reference = max(growth, result.growth), max(reference, result.reference)
        table.rows.append([*row, growth, reference])
    return table
