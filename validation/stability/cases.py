# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the stability scan and their results."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import attrs
import numpy as np
from support.problems import irregular_sheet

from cloth_sim_ros.physics.control.energy import leapfrog_energy
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, SetParameters
from cloth_sim_ros.simulation.simulation import Simulation
from validation.stability.limits import stretch_of
from validation.stability.stress_cases import ATTACKS, Moment
from validation.stability.stress_cases_contact import CONTACT_ATTACKS

RESOLUTION = 12
#: Simulated time of a case [s].
DURATION = 0.5
STIFFNESSES = (1.0, 10.0, 1e2, 1e3, 1e4, 1e5, 1e6)
RATES = (30.0, 60.0, 120.0, 240.0)
DAMPINGS = (0.0, 0.1, 0.5, 1.0, 3.0)
STEPPINGS = ("auto", "fixed")
#: Sheets besides the grid with axial bending, and their part of the scan.
MORE_SHEETS = ("mesh", "opposite", "crossed", "altitude")
SHEETS = ("grid", *MORE_SHEETS)
MORE_STIFFNESSES, MORE_RATES, MORE_DAMPINGS = (1.0, 1e2, 1e4), (60.0,), (0.0, 0.5)
_EVERY = {**ATTACKS, **CONTACT_ATTACKS}
#: Target of the position error [m].
TOLERANCE = 1e-3
#: Fixed explicit steps are this fraction of the stability limit at the start.
FIXED_SHARE = 0.5
#: If a fixed explicit step needs more steps, the implicit method at half a frame replaces it.
_MOST_STEPS = 200_000


@attrs.frozen
class Case:
    """One combination of sheet, stress case, material and stepping."""

    sheet: str
    attack: str
    #: Factor of the moduli.
    stiffness: float
    #: k_d0.
    damping: float
    #: Frames a second [1/s].
    rate: float
    stepping: str


@attrs.frozen
class Verdict:
    """Stability and energy gain of one case."""

    #: Names of the integrators that ran.
    integrators: tuple[str, ...]
    finite: bool
    #: Largest strain of a spring at the end of any frame.
    strain: float
    #: Largest rise of the energy, less the grippers' work, above its value at the end of any earlier frame, relative
    #: to the energy turned over.
    gain: float
    #: Steps that were accepted with an error above the error budget.
    flagged: int = 0
    #: Rejected attempts.
    rejected: int = 0
    #: Reason why it was aborted; empty if it was not.
    trouble: str = ""


def every_case() -> list[Case]:
    """Return all cases of the scan."""
    grids = itertools.product(("grid",), ATTACKS, STIFFNESSES, DAMPINGS, RATES, STEPPINGS)
    more = itertools.product(MORE_SHEETS, ATTACKS, MORE_STIFFNESSES, MORE_DAMPINGS, MORE_RATES, STEPPINGS)
    return [Case(*combination) for combination in (*grids, *more)]


def random_cases(seed: int, count: int) -> list[Case]:
    """Draw `count` cases from the whole range of the scan, also between its points."""
    rng = np.random.default_rng(seed)
    cases = []
    for _ in range(count):
        sheet = str(rng.choice(["grid", "grid", *MORE_SHEETS]))
        stiffnesses, dampings, rates = (
            (STIFFNESSES, DAMPINGS, RATES) if sheet == "grid" else (MORE_STIFFNESSES, MORE_DAMPINGS, MORE_RATES)
        )
        low, high = np.log10(min(stiffnesses)), np.log10(max(stiffnesses))
        damping = 0.0 if rng.random() < 0.2 else float(rng.uniform(min(dampings), max(dampings)))
        rate = float(rng.integers(round(min(rates)), round(max(rates)) + 1))
        attack, stepping = str(rng.choice(list(ATTACKS))), str(rng.choice(STEPPINGS))
        cases.append(Case(sheet, attack, float(10.0 ** rng.uniform(low, high)), damping, rate, stepping))
    return cases


def contact_cases(seed: int, count: int) -> list[Case]:
    """Draw `count` contact stress cases of sheets within the stiffness range of explicit steps."""
    rng = np.random.default_rng(seed)
    cases = []
    for k in range(count):
        attack = list(CONTACT_ATTACKS)[k % len(CONTACT_ATTACKS)]
        damping = 0.0 if rng.random() < 0.2 else float(rng.uniform(0.0, 1.0))
        rate = float(rng.integers(round(min(RATES)), round(max(RATES)) + 1))
        cases.append(Case("grid", attack, float(10.0 ** rng.uniform(0.0, 2.0)), damping, rate, "auto"))
    return cases


def scene(case: Case) -> Scene:
    """Return a sheet of 1 m x 1 m and 0.2 kg, hung by its upper edge, with the integrator `auto`."""
    values: dict[str, Any] = {
        "rate": case.rate,
        "material.damping": case.damping,
        "gripper.stiffness": 1000.0 * min(case.stiffness, 1e4),
        "gripper.radius": _EVERY[case.attack].radius,
        "gripper.max_speed": 0.0,
        "wind.normal_drag": 0.0,
        "tolerance": TOLERANCE,
        **_moduli(case),
    }
    if case.sheet == "mesh":
        mesh, anchors = _mesh()
        return Scene.from_parameters(
            {**values, "cloth.mesh": "sheet.obj", "cloth.anchors": anchors, "bending.model": "opposite"},
            files={"sheet.obj": mesh},
        )
    model = "axial" if case.sheet == "grid" else case.sheet
    values |= {"cloth.resolution": [RESOLUTION, RESOLUTION], "bending.model": model}
    return Scene.from_parameters({**values, **_EVERY[case.attack].values})


def _moduli(case: Case) -> dict[str, float]:
    values = {"material.stretch_modulus": 1000.0 * case.stiffness, "material.shear_modulus": 100.0 * case.stiffness}
    if case.sheet == "mesh":
        del values["material.shear_modulus"]  # that of a mesh follows from its triangles
    if case.sheet in ("crossed", "altitude"):
        values["material.bending_modulus"] = 1e-4 * case.stiffness
    else:
        values["bending.stiffness"] = 2.0 * case.stiffness
    return values


@cache
def _mesh() -> tuple[bytes, list[str]]:
    """Return an irregular mesh as the content of an OBJ file, and the particles of its upper edge."""
    sheet = irregular_sheet()
    rest = sheet.positions()
    lines = [f"v {x} {y} {z}" for x, y, z in rest.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in sheet.surface.triangles.tolist()]
    top = np.flatnonzero(rest[:, 2] > rest[:, 2].max() - 1e-9)
    return "\n".join(lines).encode(), [str(particle) for particle in top]


class WatchedSimulation(Simulation):
    """Simulation that reports the grippers' work over its last frame."""

    @property
    def work(self) -> float:
        """Work of grippers and recovering contacts on the cloth [J], including what grips store and dissipate."""
        return self._accumulator.work + self._accumulator.recovery_work if self._accumulator is not None else 0.0

    def work_of_parameters(self, events: list[Event]) -> float:
        """Return the energy that a change of parameters will add [J]: same positions, other springs."""
        values = {
            name: value for event in events if isinstance(event, SetParameters) for name, value in event.values.items()
        }
        if not values:
            return 0.0
        plan = self.scene.changed(values).plan()
        return plan.energy(self.time, self.state.x, self.state.v) - self.energy()


class EnergyAccount:
    """Energy account of a run and its spurious energy gain."""

    def __init__(self, simulation: WatchedSimulation) -> None:
        self._simulation = simulation
        self._kinetic = _kinetic(simulation)
        self._start = simulation.energy()
        self._least = self._least_own = self._start
        self._put_in = 0.0
        # Motion below the tolerance is not resolved: the scale of gains is at least the weight's work over it.
        self._turned = 9.81 * simulation.model.mass * TOLERANCE
        #: See `StabilityResult.gain`.
        self.gain = 0.0

    def close(self, work: float, step: float | None) -> None:
        """Account for a frame.

        With a fixed step the leapfrog conserves the modified energy E - h^2/8 v'Kv, and E itself oscillates about it.
        When the step changes, E stays and the modified energy jumps. An energy gain is real only if both show it.

        Args:
            work: external work over the frame [J].
            step: length of fixed leapfrog steps [s]; None for any other stepping.
        """
        self._put_in += work
        run = self._simulation
        energy = own = run.energy()
        if step is not None:
            own = leapfrog_energy(run.plan, run.time, run.state.x, run.state.v, step)
        energy, own = energy - self._put_in, own - self._put_in
        kinetic = _kinetic(self._simulation)
        self._turned += abs(kinetic - self._kinetic) + abs(work)
        self._turned = max(self._turned, self._start - energy)
        self._kinetic = kinetic
        self.gain = max(self.gain, min(energy - self._least, own - self._least_own) / self._turned)
        self._least, self._least_own = min(self._least, energy), min(self._least_own, own)


def run_case(case: Case) -> Verdict:
    """Run one case to its end."""
    attack = _EVERY[case.attack]
    built = scene(case)
    start = State(attack.start(built.initial_positions(), np.random.default_rng(3)))
    if case.stepping == "fixed":
        built = built.changed(_fixed(case, built, start))
    simulation = WatchedSimulation(built, start)
    rest = built.initial_positions()
    corner = rest[np.argmax(rest[:, 0] - rest[:, 2])]
    springs = _springs(simulation.model)
    account = EnergyAccount(simulation)
    strain, flagged, rejected = 0.0, 0, 0
    names: dict[str, None] = {}
    trouble = ""
    for frame in range(round(DURATION * case.rate)):
        events = attack.events(Moment(frame / case.rate, 1.0 / case.rate, corner, _moduli(case)))
        try:
            put_in = simulation.work_of_parameters(events)
            done = simulation.advance(events).advance
        except (UnstableError, ValueError) as error:
            trouble = f"at {frame / case.rate:.3g} s: {error}"
            break
        if done is not None:
            names[done.integrator] = None
            flagged, rejected = flagged + done.flagged, rejected + done.rejected
        own = done is not None and done.error is None and done.integrator == "leapfrog"
        account.close(put_in + simulation.work, done.step if done is not None and own else None)
        stretches = (stretch_of(each.pairs, each.rest_length, simulation.state.x) for each in springs)
        strain = max(strain, *(stretch - 1.0 for stretch in stretches))
    finite = not trouble and bool(np.isfinite(simulation.state.x).all() and np.isfinite(simulation.state.v).all())
    return Verdict(tuple(names), finite, strain, account.gain, flagged, rejected, trouble)


def _fixed(case: Case, built: Scene, start: State) -> dict[str, Any]:
    """Return parameters of a fixed step: a fraction of the stability limit at the start."""
    step = FIXED_SHARE * Leapfrog().step_limit(*built.plan().spectral_bounds(start.x))
    if DURATION / step <= _MOST_STEPS:
        return {"integrator": "leapfrog", "step": step}
    return {"integrator": "implicit", "step": 0.5 / case.rate}


def _springs(model: Model) -> list[PairSprings]:
    """Return the springs of a model between two particles."""
    forces = [force.pair_springs if isinstance(force, GridSprings) else force for force in model.forces]
    return [force for force in forces if isinstance(force, PairSprings)]


def _kinetic(simulation: WatchedSimulation) -> float:
    v = simulation.state.v
    return 0.5 * float(np.sum(simulation.model.masses * v * v))
