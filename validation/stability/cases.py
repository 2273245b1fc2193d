# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Cases of the stability scan, their energy account, and their results."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import attrs
import numpy as np
from support.garment import as_obj
from support.problems import irregular_sheet

from cloth_sim_ros import (
    GridSprings,
    Leapfrog,
    Model,
    PairSprings,
    Scene,
    SetParameters,
    Simulation,
    State,
    UnstableError,
)
from cloth_sim_ros.physics.control.energy import leapfrog_energy
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import Event
from validation.stability.stress_cases import CONTACT_STRESS_CASES, STRESS_CASES, StressFrame


class EnergyAccount:
    """Energy account from the current state on.

    Args:
        simulation: the simulation, which is advanced elsewhere.
        turned_over: energy that counts as turned over at the start [J]; gains are relative to it and later changes.
    """

    def __init__(self, simulation: Simulation, turned_over: float) -> None:
        self._simulation = simulation
        self._kinetic = kinetic_energy(simulation)
        self._start = simulation.energy()
        self._min_energy = self._min_modified_energy = self._start
        self._external_work = 0.0
        self._energy_turned_over = turned_over
        #: Largest rise of the energy, less external work, above its value at the end of any earlier frame, relative to
        #: the energy turned over.
        self.gain = 0.0

    def add_frame(self, work: float = 0.0, step: float | None = None) -> None:
        """Account for a frame.

        With a fixed step the leapfrog conserves the modified energy E - h^2/8 v'Kv, and E itself oscillates about it.
        When the step changes, E stays and the modified energy jumps. An energy gain is real only if both show it.

        Args:
            work: external work over the frame [J].
            step: length of fixed leapfrog steps [s]; None for any other stepping.
        """
        self._external_work += work
        simulation = self._simulation
        energy = modified_energy = simulation.energy()
        if step is not None:
            modified_energy = leapfrog_energy(simulation.plan, simulation.time, simulation.state, step)
        energy, modified_energy = energy - self._external_work, modified_energy - self._external_work
        kinetic = kinetic_energy(simulation)
        self._energy_turned_over += abs(kinetic - self._kinetic) + abs(work)
        self._energy_turned_over = max(self._energy_turned_over, self._start - energy)
        self._kinetic = kinetic
        gain = min(energy - self._min_energy, modified_energy - self._min_modified_energy)
        self.gain = max(self.gain, gain / self._energy_turned_over)
        self._min_energy = min(self._min_energy, energy)
        self._min_modified_energy = min(self._min_modified_energy, modified_energy)


def kinetic_energy(simulation: Simulation) -> float:
    """Return the kinetic energy of a simulation's cloth [J]."""
    v = simulation.state.v
    return 0.5 * float(np.sum(simulation.model.masses * v * v))


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
_ALL_STRESS_CASES = {**STRESS_CASES, **CONTACT_STRESS_CASES}
#: Target of the position error [m].
TOLERANCE = 1e-3
#: Fixed explicit steps are this fraction of the stability limit at the start.
FIXED_STEP_FRACTION = 0.5
#: If a fixed explicit step needs more steps, the implicit method at half a frame replaces it.
_MAX_FIXED_STEPS = 200_000


@attrs.frozen
class Case:
    """One combination of sheet, stress case, material and stepping."""

    sheet: str
    stress_case: str
    #: Factor of the moduli.
    stiffness: float
    #: k_d0.
    damping: float
    #: Frames a second [1/s].
    rate: float
    stepping: str


@attrs.frozen
class StabilityResult:
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


def all_cases() -> list[Case]:
    """Return all cases of the scan."""
    grid_cases = itertools.product(("grid",), STRESS_CASES, STIFFNESSES, DAMPINGS, RATES, STEPPINGS)
    sheet_cases = itertools.product(MORE_SHEETS, STRESS_CASES, MORE_STIFFNESSES, MORE_DAMPINGS, MORE_RATES, STEPPINGS)
    return [Case(*combination) for combination in (*grid_cases, *sheet_cases)]


def random_cases(seed: int, count: int) -> list[Case]:
    """Draw `count` cases from the whole range of the scan, also between its points."""
    rng = np.random.default_rng(seed)
    cases = []
    for _ in range(count):
        sheet = str(rng.choice(["grid", "grid", *MORE_SHEETS]))
        grids = (STIFFNESSES, DAMPINGS, RATES)
        stiffnesses, dampings, rates = grids if sheet == "grid" else (MORE_STIFFNESSES, MORE_DAMPINGS, MORE_RATES)
        low, high = np.log10(min(stiffnesses)), np.log10(max(stiffnesses))
        damping = 0.0 if rng.random() < 0.2 else float(rng.uniform(min(dampings), max(dampings)))
        rate = float(rng.integers(round(min(rates)), round(max(rates)) + 1))
        stress_case, stepping = str(rng.choice(list(STRESS_CASES))), str(rng.choice(STEPPINGS))
        cases.append(Case(sheet, stress_case, float(10.0 ** rng.uniform(low, high)), damping, rate, stepping))
    return cases


def contact_cases(seed: int, count: int) -> list[Case]:
    """Draw `count` contact stress cases of sheets within the stiffness range of explicit steps."""
    rng = np.random.default_rng(seed)
    cases = []
    for k in range(count):
        stress_case = list(CONTACT_STRESS_CASES)[k % len(CONTACT_STRESS_CASES)]
        damping = 0.0 if rng.random() < 0.2 else float(rng.uniform(0.0, 1.0))
        rate = float(rng.integers(round(min(RATES)), round(max(RATES)) + 1))
        cases.append(Case("grid", stress_case, float(10.0 ** rng.uniform(0.0, 2.0)), damping, rate, "auto"))
    return cases


def scene(case: Case) -> Scene:
    """Return a sheet of 1 m x 1 m and 0.2 kg, hung by its upper edge, with the integrator `auto`."""
    parameters: dict[str, Any] = {
        "rate": case.rate,
        "material.damping": case.damping,
        "gripper.stiffness": 1000.0 * min(case.stiffness, 1e4),
        "gripper.radius": _ALL_STRESS_CASES[case.stress_case].radius,
        "gripper.max_speed": 0.0,
        "wind.normal_drag": 0.0,
        "tolerance": TOLERANCE,
        **_moduli(case),
    }
    if case.sheet == "mesh":
        mesh, anchors = _mesh()
        parameters = {**parameters, "cloth.mesh": "sheet.obj", "cloth.anchors": anchors, "bending.model": "opposite"}
        return Scene.from_parameters(parameters, files={"sheet.obj": mesh})
    model = "axial" if case.sheet == "grid" else case.sheet
    parameters |= {"cloth.resolution": [RESOLUTION, RESOLUTION], "bending.model": model}
    return Scene.from_parameters({**parameters, **_ALL_STRESS_CASES[case.stress_case].values})


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
    rest_positions = sheet.positions()
    top = np.flatnonzero(rest_positions[:, 2] > rest_positions[:, 2].max() - 1e-9)
    return as_obj(rest_positions, sheet.surface.triangles), [str(particle) for particle in top]


class WatchedSimulation(Simulation):
    """Simulation that reports the grippers' work over its last frame."""

    @property
    def work(self) -> float:
        """Work of grippers and recovering contacts on the cloth [J], including what grips store and dissipate."""
        return self._accumulator.work + self._accumulator.recovery_work if self._accumulator is not None else 0.0

    def work_of_parameters(self, events: list[Event]) -> float:
        """Return the energy that a change of parameters will add [J]: same positions, other springs."""
        settings = [event for event in events if isinstance(event, SetParameters)]
        values = {name: value for event in settings for name, value in event.values.items()}
        if not values:
            return 0.0
        plan = self.scene.changed(values).plan()
        return plan.energy(self.time, self.state.x, self.state.v, {}) - self.energy()


def run_case(case: Case) -> StabilityResult:
    """Run one case to its end."""
    stress_case = _ALL_STRESS_CASES[case.stress_case]
    case_scene = scene(case)
    start = State(stress_case.start(case_scene.initial_positions(), np.random.default_rng(3)))
    if case.stepping == "fixed":
        case_scene = case_scene.changed(_fixed_step_values(case, case_scene, start))
    simulation = WatchedSimulation(case_scene, start)
    rest_positions = case_scene.initial_positions()
    corner = rest_positions[np.argmax(rest_positions[:, 0] - rest_positions[:, 2])]
    springs = _springs(simulation.model)
    # Motion below the tolerance is not resolved: the scale of gains is at least the weight's work over it.
    account = EnergyAccount(simulation, 9.81 * simulation.model.mass * TOLERANCE)
    strain, flagged, rejected = 0.0, 0, 0
    names: dict[str, None] = {}
    trouble = ""
    for frame in range(round(DURATION * case.rate)):
        events = stress_case.events(StressFrame(frame / case.rate, 1.0 / case.rate, corner, _moduli(case)))
        try:
            parameter_work = simulation.work_of_parameters(events)
            advance = simulation.advance(events).advance
        except (UnstableError, ValueError) as error:
            trouble = f"at {frame / case.rate:.3g} s: {error}"
            break
        if advance is not None:
            names[advance.integrator] = None
            flagged, rejected = flagged + advance.flagged, rejected + advance.rejected
        has_fixed_step = advance is not None and advance.error is None and advance.integrator == "leapfrog"
        step = advance.step if advance is not None and has_fixed_step else None
        account.add_frame(parameter_work + simulation.work, step)
        x = simulation.state.x
        max_stretches = (max_stretch(spring_group.pairs, spring_group.rest_length, x) for spring_group in springs)
        strain = max(strain, *(stretch - 1.0 for stretch in max_stretches))
    finite = not trouble and bool(np.isfinite(simulation.state.x).all() and np.isfinite(simulation.state.v).all())
    return StabilityResult(tuple(names), finite, strain, account.gain, flagged, rejected, trouble)


def _fixed_step_values(case: Case, case_scene: Scene, start: State) -> dict[str, Any]:
    """Return parameters of a fixed step: a fraction of the stability limit at the start."""
    step = FIXED_STEP_FRACTION * Leapfrog().step_limit(*case_scene.plan().spectral_bounds(start.x))
    if DURATION / step <= _MAX_FIXED_STEPS:
        return {"integrator": "leapfrog", "step": step}
    return {"integrator": "implicit", "step": 0.5 / case.rate}


def _springs(model: Model) -> list[PairSprings]:
    """Return the springs of a model between two particles."""
    forces = [force.pair_springs if isinstance(force, GridSprings) else force for force in model.forces]
    return [force for force in forces if isinstance(force, PairSprings)]


def max_stretch(pairs: np.ndarray, rest_length: Array, x: Array) -> float:
    """Return the largest length of springs relative to their rest length; joints (rest length 0) do not count."""
    separations = x[:, pairs[:, 1]] - x[:, pairs[:, 0]]
    length = np.sqrt(np.sum(separations * separations, axis=0))
    return float(np.max(length[rest_length > 0.0] / rest_length[rest_length > 0.0], initial=0.0))
