# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Added mass of air: Lagrange's equations, conservation laws, orders, grips, implicit steps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support import laws

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.control.automatic import make_integrator
from cloth_sim_ros.physics.control.energy import leapfrog_energy
from cloth_sim_ros.physics.integrators.extrapolation_tableau import weights
from cloth_sim_ros.physics.model.forces.added_mass import AddedMass
from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.force import Array, Force
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.model.sheets.surface import grid_cells
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.verify.independent_integrator import dop853
from cloth_sim_ros.verify.reference_integrator import MotionState

ROWS, COLUMNS, SPACING, MASS, DENSITY = 6, 8, 0.05, 2e-3, 0.4
FRAME = 1.0 / 60.0
CELLS = grid_cells(ROWS, COLUMNS)
TRIANGLES = np.concatenate([CELLS[:, [0, 1, 2]], CELLS[:, [0, 2, 3]]])


def family(name: str, stiffness: float, reach: float, damping: float) -> GridFamily:
    return GridFamily(name=name, stiffness=stiffness, rest_length=reach * SPACING, damping=damping, border=1.0)


def springs(damping: float) -> GridSprings:
    families = [family("right", 30.0, 1.0, 0.02 * damping), family("down", 31.0, 1.0, 0.02 * damping)]
    families += [family("diagonal", 12.0, math.sqrt(2.0), 0.0), family("right2", 3.0, 2.0, 0.0)]
    return GridSprings(ROWS, COLUMNS, tuple(families))


def sheet(
    *more: Force, panels: Array = CELLS, wind: Any = (0.0, 0.0, 0.0), damping: float = 0.0, listed: bool = False
) -> Plan:
    grid = springs(damping)
    forces = [grid.pair_springs if listed else grid, AddedMass(panels, density=DENSITY, wind=wind), *more]
    return compile(Model(np.full(ROWS * COLUMNS, MASS), forces))


def moving_state(size: float = 1.0) -> tuple[Array, Array]:
    """Sheet that is bent smoothly and moves, positions and velocities (3, n)."""
    row, column = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    x = np.stack([SPACING * column, SPACING * row, 0.03 * np.sin(9.0 * SPACING * row + 4.0 * SPACING * column)])
    v = size * np.stack([np.sin(8.0 * x[1]), np.cos(6.0 * x[0] + 3.0 * x[1]), 1.0 + np.sin(7.0 * x[0])])
    return np.ascontiguousarray(x), np.ascontiguousarray(v)


def run(plan: Plan, start: tuple[Array, Array], steps: int, **options: Any) -> tuple[Array, Array]:
    runs, _ = plan.runs(0.0, FRAME, start, [steps], **options)
    return runs[0].x, runs[0].v


@pytest.mark.parametrize("corners", [3, 4])
def test_accelerations_are_those_of_lagrange(corners: int) -> None:
    random = np.random.default_rng(corners)
    panels = np.array([[0, 1, 2], [2, 1, 3], [3, 1, 4]] if corners == 3 else [[0, 1, 2, 3], [1, 4, 5, 2]])
    n = int(panels.max()) + 1
    x, v, masses, wind = (random.normal(size=shape) for shape in ((3, n), (3, n), n, 3))
    model = Model(np.abs(masses) + 0.5, [AddedMass(panels, density=0.7, wind=wind)])
    a = np.empty((3, n))
    compile(model).accelerations(0.0, x, v, a)
    assert a == pytest.approx(laws.lagrange_accelerations(model.masses, panels, 0.7, wind, x, v), abs=1e-7)


def test_flat_panel_carries_its_mass_across_itself() -> None:
    square = np.array([[0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
    plan = compile(Model(np.ones(4), [AddedMass([[0, 1, 2, 3]], density=2.0), Gravity([3.0, 0.0, -6.0])]))
    a = np.empty((3, 4))
    plan.accelerations(0.0, square, np.zeros((3, 4)), a)
    # A corner carries 2 / 4 kg: gravity acts on 1 kg, across the panel 1.5 kg resist.
    assert a.T.tolist() == [[3.0, 0.0, -4.0]] * 4
    assert plan.mass_blocks(square)[2].tolist() == [0.5] * 4
    assert plan.momenta(square, np.ones((3, 4)))[:, 0].tolist() == [1.0, 1.0, 1.5]


def test_panel_without_area_carries_none() -> None:
    line = np.array([[0.0, 1.0, 2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    plan = compile(Model(np.ones(3), [AddedMass([[0, 1, 2]], density=2.0, wind=[0.0, 1.0, 2.0])]))
    a = np.empty((3, 3))
    plan.accelerations(0.0, line, np.arange(9.0).reshape(3, 3), a)
    assert not a.any()
    assert not plan.mass_blocks(line).any()


@pytest.mark.parametrize("wind", [(0.0, 0.0, 0.0), (2.0, -1.0, 3.0)])
def test_energy_is_conserved_to_second_order(wind: tuple[float, float, float]) -> None:
    plan, start = sheet(wind=wind), moving_state()
    energy = plan.energy(0.0, *start)
    errors = [abs(plan.energy(FRAME, *run(plan, start, steps)) - energy) for steps in (200, 400)]
    assert errors[1] < 1e-4 * energy
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.4)


def test_momentum_of_cloth_and_air_is_conserved() -> None:
    plan, start = sheet(), moving_state()
    x, v = run(plan, start, 2000)
    before, after = (plan.momenta(*state).sum(axis=1) for state in (start, (x, v)))
    assert after == pytest.approx(before, abs=1e-6 * np.abs(before).max())
    # That of the cloth alone is not.
    assert np.abs(MASS * (v - start[1]).sum(axis=1)).max() > 1e-3 * np.abs(before).max()


def test_wind_carries_the_air_with_it() -> None:
    # In a frame that moves with the wind there is none.
    wind, (x, v) = np.array([2.0, -1.0, 3.0]), moving_state()
    still = run(sheet(), (x, v), 100)
    blown = run(sheet(wind=wind), (x, np.ascontiguousarray(v + wind[:, None])), 100)
    assert blown[0] - FRAME * wind[:, None] == pytest.approx(still[0], abs=1e-12)
    assert blown[1] - wind[:, None] == pytest.approx(still[1], abs=1e-9)


def taut_strip_frequency(wind: float) -> float:
    """Lowest angular frequency of a taut strip of two threads in a wind along it, from the linearised equations."""
    columns, spacing, free = 41, 0.025, slice(1, 40)
    families = [
        GridFamily(name=name, stiffness=20.0, rest_length=rest_length)
        for name, rest_length in (("right", 0.02), ("down", 1.0))
    ]
    cells = grid_cells(2, columns)
    forces = [GridSprings(2, columns, tuple(families)), AddedMass(cells, density=DENSITY, wind=(wind, 0.0, 0.0))]
    plan = compile(Model(np.full(2 * columns, MASS), forces))
    row, column = np.divmod(np.arange(2 * columns), columns)
    x, v, a = np.stack([spacing * column, 1.0 * row, 0.0 * row]), np.zeros((3, 2 * columns)), np.empty((3, 2 * columns))
    size, n = 1e-6, 39
    matrix = np.zeros((2 * n, 2 * n))
    matrix[:n, n:] = np.eye(n)
    for k in range(2 * n):
        at, speed = x.copy(), v.copy()
        (at if k < n else speed)[2].reshape(2, columns)[:, 1 + k % n] = size
        plan.accelerations(0.0, at, speed, a)
        matrix[n:, k] = a[2].reshape(2, columns)[0, free] / size
    return float(np.abs(np.linalg.eigvals(matrix).imag).min())


@pytest.mark.parametrize("wind", [0.0, 0.5, 1.0, 1.5])
def test_wind_along_a_taut_strip_slows_waves(wind: float) -> None:
    # Per length: mass of a thread, air at it, tension. Waves obey (m + a) w^2 - 2 a U k w + (a U^2 - tension) k^2 = 0.
    m, air, tension, length = MASS / 0.025, 0.5 * DENSITY * 1.0, 20.0 * 0.25, 1.0
    expected = math.pi / length * (tension - air * wind**2) / math.sqrt(tension * (m + air) - m * air * wind**2)
    assert taut_strip_frequency(wind) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("panels", [CELLS, TRIANGLES])
@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("n_runs", [1, 2, 3])
def test_combinations_of_runs_have_their_order(panels: Array, listed: bool, n_runs: int) -> None:
    plan, start = sheet(Gravity(), panels=panels, wind=(1.0, 0.0, -2.0), damping=1.0, listed=listed), moving_state()
    reference = dop853(plan, 0.0, FRAME, MotionState(*start))
    errors = []
    for steps in (60, 120):
        counts = tuple(round(ratio * steps) for ratio in (1.0, 1.5, 2.0)[:n_runs])
        _, result = plan.runs(0.0, FRAME, start, counts, weights=weights(counts))
        assert result is not None
        errors.append(float(np.abs(result[0] - reference.x).max()))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(n_runs + 1.0, abs=0.5)


@pytest.mark.parametrize("listed", [False, True])
def test_multirate_runs_keep_second_order(listed: bool) -> None:
    n = ROWS * COLUMNS
    hinges = np.array([[i + 1, i + COLUMNS, i, i + COLUMNS + 1] for i in range(n - COLUMNS - 1) if (i + 1) % COLUMNS])
    bending = AltitudeSprings(hinges, np.zeros(len(hinges)), np.full(len(hinges), 20.0), np.full(len(hinges), 0.5))
    plan, start = sheet(bending, damping=1.0, listed=listed), moving_state()
    reference = dop853(plan, 0.0, FRAME, MotionState(*start))
    errors = [float(np.abs(run(plan, start, steps, multirate=3)[0] - reference.x).max()) for steps in (600, 1200)]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize(("name", "order"), [("implicit", 2.0), ("symplectic_euler", 1.0)])
@pytest.mark.parametrize("panels", [CELLS, TRIANGLES])
def test_other_integrators_keep_their_order(name: str, order: float, panels: Array) -> None:
    plan, start = sheet(Gravity(), panels=panels, wind=(1.0, 0.0, -2.0), damping=1.0), moving_state()
    reference = dop853(plan, 0.0, FRAME, MotionState(*start))
    errors = []
    for steps in (160, 320):
        state = State(start[0].T, start[1].T)
        make_integrator(name, step=FRAME / steps).advance(plan, state, 0.0, FRAME)
        errors.append(float(np.abs(state.x - reference.x).max()))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)


def test_leapfrog_energy_counts_the_mass_of_air() -> None:
    # Unlike the physical energy it does not oscillate with the step.
    plan, (x, v) = sheet(), moving_state(0.01)
    h = FRAME / 30
    end = run(plan, (x, v), 30)
    states = [State(a.T, b.T) for a, b in ((x, v), end)]
    first, last = (leapfrog_energy(plan, 0.0, state, h) for state in states)
    energies = [plan.energy(0.0, state.x, state.v) for state in states]
    assert abs(last - first) < 0.1 * abs(energies[1] - energies[0])


@pytest.mark.parametrize("corners", [3, 4])
@pytest.mark.parametrize("wind", [(5.0, 0.0, 0.0), (0.0, 0.0, 5.0), (3.0, 3.0, 3.0)])
def test_bounds_contain_forces_of_the_wind(corners: int, wind: tuple[float, float, float]) -> None:
    rows, columns = 5, 6
    n, cells = rows * columns, grid_cells(rows, columns)
    panels = cells if corners == 4 else np.concatenate([cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]])
    plan = compile(Model(np.full(n, MASS), [AddedMass(panels, density=DENSITY, wind=wind)]))
    row, column = np.divmod(np.arange(n), columns)
    x = SPACING * (np.stack([column, row, 0 * row]) + 0.1 * np.random.default_rng(0).normal(size=(3, n)))
    zero, size, ends = np.zeros((3, n)), 1e-6, (np.empty((3, n)), np.empty((3, n)))

    def derivative(dx: Array, dv: Array) -> Array:
        for sign, out in zip((1.0, -1.0), ends, strict=True):
            plan.accelerations(0.0, x + sign * dx, zero + sign * dv, out)
        return (ends[0] - ends[1]).ravel() / (2.0 * size)

    units = [size * unit.reshape(3, n) for unit in np.eye(3 * n)]
    stiffness, damping = (
        np.abs(np.linalg.eigvals(np.array(matrix).T)).max()
        for matrix in ([derivative(unit, zero) for unit in units], [derivative(zero, unit) for unit in units])
    )
    omega2, damping_rate = plan.spectral_bounds(x)
    assert 0.03 * omega2 < stiffness < omega2
    assert 0.1 * damping_rate < damping < damping_rate


def test_diverging_implicit_steps_are_replaced() -> None:
    # A crumpled start explodes, and forces of the air grow with the square of the speed.
    stiff = [GridFamily(name=name, stiffness=3e4, rest_length=SPACING, damping=0.05) for name in ("right", "down")]
    plan = compile(
        Model(np.full(ROWS * COLUMNS, MASS), [GridSprings(ROWS, COLUMNS, stiff), AddedMass(CELLS, density=DENSITY)])
    )
    x = 0.02 * np.random.default_rng(1).normal(size=(3, ROWS * COLUMNS))
    state = State(x.T)
    make_integrator("implicit", tolerance=1e-3).advance(plan, state, 0.0, FRAME)
    assert np.isfinite(state.x).all()
    assert plan.energy(0.0, state.x, state.v) < 1.01 * plan.energy(0.0, x, np.zeros_like(x))


def test_displacement_by_velocity_errors_counts_the_air() -> None:
    from scipy.linalg import eigh

    # Heavy air shows the inner product. Eight steps of the method bound such rough errors from below.
    plan = compile(Model(np.full(ROWS * COLUMNS, MASS), [springs(0.0), AddedMass(CELLS, density=40.0)]))
    x, _ = moving_state()
    size, n, time = 1e-6, ROWS * COLUMNS, 0.5
    ends, zero = (np.empty((3, n)), np.empty((3, n))), np.zeros((3, n))
    mass, change = np.empty((3 * n, 3 * n)), np.empty((3 * n, 3 * n))
    for k, unit in enumerate(np.eye(3 * n)):
        direction = unit.reshape(3, n)
        mass[:, k] = plan.momenta(x, direction).ravel()
        for sign, out in zip((1.0, -1.0), ends, strict=True):
            plan.accelerations(0.0, x + sign * size * direction, zero, out)
        change[:, k] = (ends[1] - ends[0]).ravel() / (2.0 * size)
    stiffness = mass @ change
    values, modes = eigh(0.5 * (stiffness + stiffness.T), mass)
    envelope = modes * (np.maximum(values, 0.0) + 1.0 / time**2) ** -0.5 @ modes.T @ mass
    errors = 1e-4 * np.random.default_rng(2).normal(size=(3, n))
    exact = float(np.linalg.norm((envelope @ errors.ravel()).reshape(3, n), axis=0).max())
    estimate, _ = plan.velocity_displacement(0.0, x, errors, time)
    assert 0.1 * exact < estimate < exact


class Carried:
    """Sheet in air whose corner a gripper carries by prescribed motion."""

    def __init__(self, *, listed: bool, panels: Array = CELLS) -> None:
        held = np.array([0, 1, COLUMNS, COLUMNS + 1])
        grips = Grips(1)
        self.plan = sheet(grips, panels=panels, damping=1.0, listed=listed)
        self.x, self.v = moving_state()
        path = np.zeros((1, 26))
        path[0, 1:4], path[0, 16] = self.x[:, 0], 1.0
        path[0, 4:13] = [0.5, -0.2, 0.8, 3.0, 20.0, -5.0, 100.0, -50.0, 200.0]
        path[0, 17:23] = [1.0, 2.0, -1.0, 20.0, -30.0, 10.0]
        ones = np.ones(4)
        grips.set_grips(
            path, np.array([0, 4]), held, (self.x[:, held] - self.x[:, :1]).T, ones, ones, ones.astype(bool)
        )


@pytest.mark.parametrize("panels", [CELLS, TRIANGLES])
@pytest.mark.parametrize("listed", [False, True])
def test_prescribed_particles_carry_air(listed: bool, panels: Array) -> None:
    carried = Carried(listed=listed, panels=panels)
    plan, start, counts = carried.plan, (carried.x, carried.v), (600, 800, 1000)
    runs, result = plan.runs(0.0, FRAME, start, counts, weights=weights(counts), record_power=True)
    assert result is not None
    record = sum(w * part.integrals for w, part in zip(weights(counts), runs, strict=True))
    momentum = plan.momenta(result[0], result[1]).sum(axis=1) - plan.momenta(*start).sum(axis=1)
    # The record has the impulse of the cloth on the gripper.
    assert -np.asarray(record[:3]) == pytest.approx(momentum, abs=1e-8)
    gain = plan.energy(FRAME, result[0], result[1]) - plan.energy(0.0, *start)
    assert gain - record[6] + record[7] + record[8] == pytest.approx(0.0, abs=1e-8)


def test_wrench_of_prescribed_particles_is_rate_of_the_record() -> None:
    carried = Carried(listed=False)
    plan, (x, v) = carried.plan, (carried.x, carried.v)
    plan.prescribe(0.0, x, v)
    runs, _ = plan.runs(0.0, 1e-5, (x, v), [8])
    rates = plan.grip_wrench_rates(0.0, x, v)[0]
    assert runs[0].gripper_integrals[0] / 1e-5 == pytest.approx(rates, rel=1e-2, abs=1e-2)


@pytest.mark.parametrize(
    ("name", "options", "bound"),
    [("extrapolated", {"tolerance": 1e-6}, 1e-5), ("implicit", {"step": FRAME / 800}, 4e-3)],
)
def test_energy_balance_of_an_integrator_closes(name: str, options: dict[str, Any], bound: float) -> None:
    carried = Carried(listed=False)
    state = State(carried.x.T, carried.v.T)
    balance = EnergyBalance(carried.plan, state)
    make_integrator(name, **options).advance(carried.plan, state, 0.0, FRAME, balance.accumulator)
    assert abs(balance.add_advance(FRAME, state)) < bound * balance.energy_turnover


def test_air_drags_and_carries_in_one_scene() -> None:
    drag = AirPanels(CELLS, normal=0.8, tangential=0.1, wind=(1.0, 0.0, 0.0))
    plan, start = sheet(drag, wind=(1.0, 0.0, 0.0)), moving_state()
    runs, result = plan.runs(0.0, FRAME, start, (300, 400, 500), weights=weights((300, 400, 500)), record_power=True)
    assert result is not None
    record = sum(w * part.integrals for w, part in zip(weights((300, 400, 500)), runs, strict=True))
    gain = plan.energy(FRAME, result[0], result[1]) - plan.energy(0.0, *start)
    assert record[0] > 1e-4
    assert gain + record[0] - record[1] == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"density": -1.0}, "density"),
        ({"density": math.nan}, "density"),
        ({"density": 1.0, "wind": [1.0, 2.0]}, "wind"),
        ({"density": 1.0, "panels": []}, "there are no panels"),
    ],
)
def test_bad_input_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AddedMass(**{"panels": [[0, 1, 2]], **arguments})
