# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The stability scan: thousands of attacks, and the step limits found beside those predicted."""

from __future__ import annotations

import argparse
import itertools
import math
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros.bench.attacks import ATTACKS, DURATION, WatchedSimulation, scene, start_of
from cloth_sim_ros.bench.raw_sheet import RawSheet
from cloth_sim_ros.bench.report import Report, Table
from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.integrators.implicit import Implicit
from cloth_sim_ros.physics.integrators.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.march import leapfrog
from cloth_sim_ros.physics.kernels.leapfrog import all_finite
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.physics.terms.base import Array

STIFFNESSES = (1.0, 10.0, 1e2, 1e3, 1e4, 1e5, 1e6)
RATES = (30.0, 60.0, 120.0, 240.0)
DAMPINGS = (0.0, 0.1, 0.5, 1.0, 3.0)
STEPPINGS = ("auto", "fixed")
#: Energy that a case may gain over what was put in, relative to the energy turned over.
LARGEST_GAIN = 0.01
#: A fixed explicit step that would need more steps is replaced by the implicit method at half a frame.
_MOST_STEPS = 40_000
#: How far the limits found may be from those predicted.
LARGEST_DEVIATION = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--every", type=int, default=1, metavar="N", help="run every N-th case only")
    parser.add_argument("--workers", type=int, default=2, help="processes")


@attrs.frozen
class Case:
    """One combination."""

    attack: str
    stiffness: float
    damping: float
    rate: float
    stepping: str


@attrs.frozen
class Verdict:
    """What became of it."""

    case: Case
    integrator: str
    finite: bool
    #: Largest strain of a spring at the end of any frame.
    strain: float
    #: Largest gain of energy over what was put in, relative to the energy turned over.
    gain: float
    #: Why it was given up; empty if it was not.
    trouble: str = ""


def run_case(case: Case) -> Verdict:
    """Run one case to its end."""
    built = scene(stiffness=case.stiffness, damping=case.damping, rate=case.rate, integrator="auto")
    if case.stepping == "fixed":
        attack_state = start_of(ATTACKS[case.attack], built)
        limit = Leapfrog().step_limit(*built.dynamics().rates(attack_state.x))
        if DURATION / limit <= _MOST_STEPS:
            built = built.changed({"integrator": "leapfrog", "step": 0.5 * limit})
        else:
            built = built.changed({"integrator": "implicit", "step": 0.5 / case.rate})
    attack = ATTACKS[case.attack]
    simulation = WatchedSimulation(built, start_of(attack, built))
    corner = np.array(simulation.positions[-1])
    springs = [term for term in simulation.model.terms if hasattr(term, "rest_length")]
    start = simulation.energy()
    work = gain = strain = kinetic = 0.0
    # Below the tolerance motion is not resolved: what the weight does over that distance is the least energy that
    # counts.
    turned = 9.81 * float(simulation.model.masses.sum()) * built.tolerance
    names: set[str] = set()
    for frame in range(round(DURATION * case.rate)):
        try:
            done = simulation.advance(attack.events(frame / case.rate, 1.0 / case.rate, corner))
        except (UnstableError, ValueError) as error:
            return Verdict(case, ", ".join(sorted(names)), False, strain, gain, str(error))
        names.add(done.integrator)
        work += simulation.work
        energy = simulation.energy()
        now = _kinetic(simulation)
        turned += abs(now - kinetic) + abs(simulation.work)
        kinetic = now
        turned = max(turned, abs(start - energy))
        gain = max(gain, (energy - start - work) / turned)
        strain = max(strain, max(_strain(term, simulation.state.x) for term in springs))
    finite = bool(all_finite(simulation.state.x, simulation.state.v))
    return Verdict(case, ", ".join(sorted(names)), finite, strain, gain)


def _kinetic(simulation: WatchedSimulation) -> float:
    v = simulation.state.v
    return 0.5 * float(np.sum(simulation.model.masses * v * v))


def _strain(term: Any, x: Array) -> float:
    away = x[:, term.pairs[:, 1]] - x[:, term.pairs[:, 0]]
    length = np.sqrt(np.sum(away * away, axis=0))
    return float(np.max(length / term.rest_length)) - 1.0


def run(options: argparse.Namespace) -> Report:
    """Run the scan, the limits and the sixteen cases that the other engines were put to."""
    report = Report("Stability", "cloth_bench stability")
    every = [Case(*combination) for combination in itertools.product(ATTACKS, STIFFNESSES, DAMPINGS, RATES, STEPPINGS)]
    cases = every[:: options.every]
    with ProcessPoolExecutor(options.workers) as pool:
        verdicts = list(pool.map(run_case, cases, chunksize=4))
    report.tables.append(_summary(verdicts))
    for verdict in verdicts:
        if not verdict.finite:
            report.failures.append(f"{verdict.case}: {verdict.trouble or 'not finite'}")
        elif verdict.gain > LARGEST_GAIN:
            report.failures.append(
                f"{verdict.case} by {verdict.integrator}: gains {verdict.gain:.2g} of the energy turned over"
            )
    report.notes.append(f"{len(cases)} cases of {len(every)}")
    report.tables += [_limits(report), _sixteen(report)]
    return report


def _summary(verdicts: list[Verdict]) -> Table:
    table = Table(
        "Scan by attack",
        ["attack", "stepping", "cases", "not finite", "largest strain", "largest energy gain", "integrators"],
    )
    groups: dict[tuple[str, str], list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        groups[verdict.case.attack, verdict.case.stepping].append(verdict)
    for (attack, stepping), group in groups.items():
        names = ", ".join(sorted({verdict.integrator for verdict in group}))
        lost = sum(not verdict.finite for verdict in group)
        worst = [max(getattr(verdict, what) for verdict in group) for what in ("strain", "gain")]
        table.rows.append([attack, stepping, len(group), lost, *worst, names])
    return table


def _limits(report: Report) -> Table:
    """Limits of fixed steps about stretched states."""
    table = Table(
        "Step limit of the leapfrog about stretched states",
        ["stretch", "k_d0", "predicted s", "found s", "found / predicted"],
    )
    for stretch, k_d0 in itertools.product((1.0, 1.2, 1.5, 2.0, 3.0), (0.0, 0.2, 1.0)):
        sheet = RawSheet(resolution=12, k_d0=k_d0, rest=1.0 / stretch, gravity=(0.0, 0.0, 0.0))
        index = sheet.index
        border = np.unique(np.concatenate([index[0], index[-1], index[:, 0], index[:, -1]]))
        dynamics = Dynamics(sheet.model(border))
        x = State(sheet.flat(hung=False)).x
        predicted = Leapfrog().step_limit(*dynamics.rates(x))
        found = _limit_found(dynamics, x, predicted)
        table.rows.append([stretch, k_d0, predicted, found, found / predicted])
        if abs(found / predicted - 1.0) > LARGEST_DEVIATION:
            report.failures.append(
                f"limit at stretch {stretch}, k_d0 {k_d0}: found {found:.3g} s, predicted {predicted:.3g} s"
            )
    return table


def _limit_found(dynamics: Dynamics, x: Array, predicted: float) -> float:
    """Largest step at which a kick of 1e-9 m does not grow, by bisection."""
    low, high = 0.5 * predicted, 2.0 * predicted
    kick = 1e-9 * np.random.default_rng(1).normal(size=x.shape) * (dynamics.model.inverse_masses > 0.0)
    while high / low > 1.002:
        step = math.sqrt(low * high)
        ends = []
        for start in (x, x + kick):
            moved, v = start.copy(), np.zeros_like(x)
            leapfrog(dynamics, 0.0, moved, v, step, 1500)
            ends.append(moved)
        away = float(np.abs(ends[1] - ends[0]).max())
        if math.isfinite(away) and away < 1e-7:
            low = step
        else:
            high = step
    return low


def _sixteen(report: Report) -> Table:
    """Scene A, N = 16, 2 s: the steps and stiffnesses that other engines were put to."""
    table = Table(
        "Scene A, 16 x 16, 2 s, one step of the stated length",
        ["moduli x", "step s", "by", "largest stretch", "estimated error m"],
    )
    for stiffness, step in itertools.product((1.0, 10.0, 100.0, 1000.0), (1 / 60, 1 / 240, 1 / 1000, 1 / 4000)):
        sheet = RawSheet(resolution=16, stiffness=stiffness, k_d0=0.05)
        dynamics, state = sheet.dynamics(sheet.index[0, [0, -1]]), State(sheet.flat(hung=False))
        fits = step <= 0.9 * Leapfrog().step_limit(*dynamics.rates(state.x))
        integrator = Leapfrog(step) if fits else Implicit(step)
        worst, error = 0.0, 0.0
        try:
            for frame in range(120):
                done = integrator.advance(dynamics, state, frame / 60, 1 / 60)
                error += done.error or 0.0
                worst = max(worst, max(_strain(term, state.x) for term in sheet.springs()[:2]) + 1.0)
        except (UnstableError, ValueError) as trouble:
            report.failures.append(f"scene A, moduli x {stiffness:g}, step {step:.3g} s: {trouble}")
            worst = math.inf
        if worst > 1.5:
            report.failures.append(f"scene A, moduli x {stiffness:g}, step {step:.3g} s: stretched {worst:.3g} times")
        table.rows.append([stiffness, step, integrator.name, worst, error or "none"])
    return table
