# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plans: grids equal listed springs, costs add up, and integrals of runs are true."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
from support.alone import of_blocks
from support.contact_scenes import contact, still
from support.plan_scenes import FILES, SCENES, listed, stir

from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator, accumulate
from cloth_sim_ros.physics.arithmetic.arrays import combine
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.control.extrapolated import Extrapolated
from cloth_sim_ros.physics.model.forces.air_panels import AirPanels
from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.assembly import MOVE_OPERATIONS
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Reset, Target
from cloth_sim_ros.simulation.simulation import Simulation

every_scene = pytest.mark.parametrize("values", SCENES.values(), ids=SCENES.keys())
GRIDS = {name: values for name, values in SCENES.items() if not {"cloth.mesh", "cloth.springs"} & values.keys()}
every_grid = pytest.mark.parametrize("values", GRIDS.values(), ids=GRIDS.keys())


def simulation_of(values):
    common = {"cloth.resolution": [7, 9], "grippers": ["one", "two"], "gripper.radius": 0.2, "integrator": "leapfrog"}
    return Simulation(Scene.from_parameters({**common, **values}, files=FILES))


def pair(values):
    """Return the simulation with grid springs, and with listed springs."""
    swept, plain = simulation_of(values), simulation_of(values)
    plain.plan = compile(listed(plain.model))
    for simulation in (swept, plain):
        stir(simulation)
    return swept, plain


def grip(simulation, corner):
    """Close both grippers on the corner; they grasp some of the same particles."""
    simulation.advance([Target("one", corner), Target("two", corner - 0.05)])
    simulation.advance([Grasp("one", True), Grasp("two", True)])


def carry(simulation, corner, k):
    """Move both grippers on, and turn the first."""
    away, angle = 0.002 * k * np.array([1.0, -1.0, 0.5]), 0.02 * k
    turned = (0.0, np.sin(angle), 0.0, np.cos(angle))
    return simulation.advance([Target("one", corner + away, turned), Target("two", corner - 0.05 + away)])


@every_grid
def test_grid_equals_listed_springs_to_rounding(values):
    swept, plain = pair(values)
    x, v = swept.state.x, swept.state.v
    grid_out, list_out = np.empty_like(x), np.empty_like(x)
    swept.plan.accelerations(0.0, x, v, grid_out)
    plain.plan.accelerations(0.0, x, v, list_out)
    assert grid_out == pytest.approx(list_out, abs=1e-12 * np.abs(list_out).max())
    # A sheet's bounds are calculated in single precision.
    assert swept.plan.spectral_bounds(x) == pytest.approx(of_blocks(plain.plan, x), rel=1e-5)
    assert swept.plan.energies(0.0, x, v) == pytest.approx(plain.plan.energies(0.0, x, v), rel=1e-12)
    assert swept.plan.powers(0.0, x, v) == pytest.approx(plain.plan.powers(0.0, x, v), rel=1e-12)
    dx, dv = np.random.default_rng(5).standard_normal((2, *x.shape))
    grid_out, list_out = np.zeros_like(x), np.zeros_like(x)
    swept.plan.add_jacobian_product(0.0, x, v, dx, dv, grid_out)
    plain.plan.add_jacobian_product(0.0, x, v, dx, dv, list_out)
    assert grid_out == pytest.approx(list_out, abs=1e-12 * np.abs(list_out).max())
    blocks = np.zeros((2, 2, 6, x.shape[1]))
    swept.plan.add_bounds(x, *blocks[0])
    plain.plan.add_bounds(x, *blocks[1])
    assert blocks[0] == pytest.approx(blocks[1], abs=1e-12 * np.abs(blocks[1]).max())


@every_grid
def test_carried_grid_moves_as_listed_springs(values):
    # Bounds of listed springs are sharper, therefore their own steps would differ.
    swept, plain = pair(values | {"step": 2e-5})
    corner, frames = swept.positions[-1], []
    for simulation in (swept, plain):
        grip(simulation, corner)
        assert np.intersect1d(*(simulation.grippers.grasped_particles(g) for g in (0, 1))).size
        # For no longer: a crumpled sheet without damping amplifies rounding by five per frame.
        frames.append([carry(simulation, corner, k) for k in range(1, 4)])
    assert [frame.advance.steps for frame in frames[0]] == [frame.advance.steps for frame in frames[1]]
    assert swept.positions == pytest.approx(plain.positions, abs=1e-9)
    scale = np.abs(frames[1][-1].wrenches).max()
    assert scale > 0.0
    assert frames[0][-1].wrenches == pytest.approx(frames[1][-1].wrenches, abs=1e-7 * max(1.0, scale))


@every_scene
def test_runs_are_the_same_alone_and_together(values):
    simulation = simulation_of(values)
    stir(simulation)
    grip(simulation, simulation.positions[-1])
    plan, state = simulation.plan, simulation.state
    before = state.x.copy(), state.v.copy()
    # As fast a motion as explicit steps can follow here.
    first = 3 + int(2e-3 * np.sqrt(plan.spectral_bounds(state.x)[0]) + 2e-3 * plan.spectral_bounds(state.x)[1])
    steps, weights = [first, 2 * first, 5 * first], [0.3, -1.1, 1.8]
    together, (x, v, summary) = plan.runs(0.1, 2e-3, before, steps, weights=weights, record_power=True)
    alone = [plan.runs(0.1, 2e-3, before, [count], record_power=True)[0][0] for count in steps]
    assert np.array_equal(state.x, before[0]) and np.array_equal(state.v, before[1])
    for joint_run, single_run in zip(together, alone, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(joint_run, single_run, strict=True))
    assert np.array_equal(x, combine([run.x for run in alone], weights))
    assert np.array_equal(v, combine([run.v for run in alone], weights))
    assert summary.is_finite
    assert (summary.omega2, summary.damping) == plan.spectral_bounds(x)
    assert together[2].x == pytest.approx(together[1].x, abs=1e-3)
    assert np.abs(together[2].x - before[0]).max() > 1e-5


@every_scene
@pytest.mark.parametrize("single_precision", [False, True])
def test_concurrent_runs_equal_sequential_runs(values, single_precision):
    simulation = simulation_of(values)
    stir(simulation)
    grip(simulation, simulation.positions[-1])
    plan, start = simulation.plan, (simulation.state.x, simulation.state.v)
    first = 3 * (1 + int(1e-3 * np.sqrt(plan.spectral_bounds(start[0])[0]) + 1e-3 * plan.spectral_bounds(start[0])[1]))
    options = {
        "single_precision": single_precision,
        "record_power": not single_precision,
        "multirate": 3 if plan.has_hinges else 1,
    }
    for steps in ([first, 2 * first], [first, 2 * first, 3 * first, 5 * first, 7 * first]):
        weights = [1.0] if single_precision else [-0.5, 1.5]
        sequential, (x, v, summary) = plan.runs(0.1, 2e-3, start, steps, weights=weights, **options)
        for _ in range(5):
            concurrent, (y, w, concurrent_summary) = plan.runs(
                0.1, 2e-3, start, steps, weights=weights, concurrency=2, **options
            )
            for concurrent_run, sequential_run in zip(concurrent, sequential, strict=True):
                assert np.array_equal(concurrent_run.end_state, sequential_run.end_state)
                assert np.array_equal(concurrent_run.integrals, sequential_run.integrals)
            assert np.array_equal(x, y) and np.array_equal(v, w) and summary == concurrent_summary


def test_runs_beyond_a_combination_do_not_change_it():
    plan, state = (simulation := simulation_of({})).plan, simulation.state
    stir(simulation)
    enough = int(np.sqrt(plan.spectral_bounds(state.x)[0]) + plan.spectral_bounds(state.x)[1])
    _, (x, _, summary) = plan.runs(0.0, 1.0, (state.x, state.v), [enough], weights=[1.0])
    runs, (y, _, longer_summary) = plan.runs(0.0, 1.0, (state.x, state.v), [enough, 60], weights=[1.0], concurrency=2)
    assert summary.is_finite and not np.isfinite(runs[1].x).all()
    assert np.array_equal(x, y) and summary == longer_summary


@every_scene
def test_a_repeat_gives_the_same_bits(values):
    simulation, ends = simulation_of(values), set()
    for _ in range(3):
        simulation.advance([Reset()])
        simulation.advance()
        ends.add(simulation.state.x.tobytes() + simulation.state.v.tobytes())
    assert len(ends) == 1


@every_scene
def test_non_finite_state_leaves_no_trace_in_the_plan(values):
    simulation = simulation_of(values)
    plan, x, v = simulation.plan, simulation.state.x, simulation.state.v
    (before,), _ = plan.runs(0.0, 1e-3, (x, v), [5])
    plan.runs(0.0, 1e-3, (np.full_like(x, np.nan), v), [2])
    (after,), _ = plan.runs(0.0, 1e-3, (x, v), [5])
    assert np.array_equal(before.x, after.x)


@every_scene
def test_run_integrals_equal_integrals_of_the_rates(values):
    """Wrenches, work, dissipation and wind work against an independent quadrature along much finer steps."""
    simulation = simulation_of({**values, "integrator": "extrapolated", "tolerance": 1e-9})
    corner = simulation.positions[-1]
    grip(simulation, corner)
    for k in range(1, 4):
        carry(simulation, corner, k)
    plan, start, t = simulation.plan, simulation.state, simulation.time - simulation.scene.period
    duration, points = 4e-3, 400
    booked, exact = WorkAccumulator(2, record_power=True), WorkAccumulator(2, record_power=True)
    (run,), _ = plan.runs(t, duration, (start.x, start.v), [800], record_power=True)
    booked.add_runs([1.0], [run], duration)
    x, v, part = start.x, start.v, duration / points
    for k in range(points):
        (middle,), _ = plan.runs(t + k * part, 0.5 * part, (x, v), [4])
        accumulate(exact, plan, t + (k + 0.5) * part, middle.x, middle.v, part, {})
        (end,), _ = plan.runs(t + k * part, part, (x, v), [8])
        x, v = end.x, end.v
    assert np.abs(exact.wrenches[:, :3]).max() > 1e-4
    scale = np.abs(exact.wrenches).max()
    assert booked.wrenches == pytest.approx(exact.wrenches, abs=1e-4 * scale)
    assert booked.work == pytest.approx(exact.work, abs=1e-4 * (abs(exact.work) + 1e-6))
    assert booked.dissipation == pytest.approx(exact.dissipation, rel=1e-3, abs=1e-12)
    assert booked.wind_work == pytest.approx(exact.wind_work, rel=1e-3, abs=1e-12)
    # Therefore the energy balance closes.
    turned = abs(exact.work) + abs(exact.dissipation) + abs(exact.wind_work)
    gained = plan.energy(t + duration, run.x, run.v) - plan.energy(t, start.x, start.v)
    assert gained == pytest.approx(booked.work + booked.wind_work - booked.dissipation, abs=1e-3 * turned + 1e-9)


@pytest.mark.parametrize("name", ["mesh", "hinges", "grid, air"])
def test_costs_add_up(name):
    model = simulation_of(SCENES[name]).model

    def cost(*forces):
        return compile(Model(model.masses, forces)).step_cost

    move = CONSTANTS.operation_time * MOVE_OPERATIONS
    assert cost() == pytest.approx(move)
    every = [force for force in model.forces if not isinstance(force, Grips)]
    # Panels on a grid's cells cost less with the grid than alone.
    sheet = [force for force in every if isinstance(force, GridSprings)]
    panels = [force for force in every if isinstance(force, AirPanels)]
    apart = sum(cost(force) - move for force in every if force not in panels)
    apart += sum(cost(*sheet, force) - cost(*sheet) for force in panels)
    assert cost(*every) == pytest.approx(move + apart)
    assert cost(*every) > cost() + 1.0


def test_without_springs_particles_fall_freely():
    plan = compile(Model(np.ones(5), [Gravity((0.0, 0.0, -10.0)), Drag(0.0)], anchors=[2]))
    (run,), _ = plan.runs(0.0, 1.0, (np.zeros((3, 5)), np.zeros((3, 5))), [100])
    assert run.x[2] == pytest.approx([-5.0, -5.0, 0.0, -5.0, -5.0])


def test_invalid_model_is_refused_by_force_name():
    edges = [GridFamily(name="right", stiffness=1.0, rest_length=0.1)]
    grid = GridSprings(2, 3, edges, name="a")
    with pytest.raises(ValueError, match="two forces have springs 'right' of one sheet"):
        compile(Model(np.ones(6), [grid, GridSprings(2, 3, edges, name="b")]))
    down = [GridFamily(name="down", stiffness=1.0, rest_length=0.1)]
    with pytest.raises(ValueError, match="sheets of 2 x 3 and 3 x 2 particles"):
        compile(Model(np.ones(6), [grid, GridSprings(3, 2, down, name="b")]))
    with pytest.raises(ValueError, match="'a' is a sheet of 2 x 3 particles; the model has 5"):
        compile(Model(np.ones(5), [grid]))
    first, second = Grips(1), Grips(1)
    second.name = "more grips"
    with pytest.raises(ValueError, match="two forces hold particles, 'grips' and 'more grips'"):
        compile(Model(np.ones(6), [first, second]))


def test_bindings_keep_the_engine_plan_alive():
    force, places = contact("sphere", paths=[still()]), np.full((3, 4), 0.2)
    plan = compile(Model(np.ones(4), [force, Grips(1)]))
    # private: freed with the plan
    owner, contact_binding, grip_binding = weakref.ref(plan._owner), plan.contact, plan._grip_binding
    del plan
    gc.collect()
    # The ball's radius is 0.2 m, the particles are at 0.2 sqrt(3) m from its centre.
    assert contact_binding.obstacle_gaps(0.0, places, {})[0, 1] == pytest.approx(0.2 * (np.sqrt(3.0) - 1.0))
    del contact_binding
    gc.collect()
    assert grip_binding.wrench_rates(0.0, places, np.zeros((3, 4)))[1].shape == (1, 8)
    assert owner() is not None
    del grip_binding
    gc.collect()
    assert owner() is None


def test_a_run_of_no_step_is_refused():
    plan, start = compile(Model(np.ones(2), [])), (np.zeros((3, 2)), np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"runs of \[3, 0\] steps"):
        plan.runs(0.0, 1.0, start, [3, 0])


def test_arrays_that_the_engine_would_misread_are_refused():
    plan, good = compile(Model(np.ones(4), [])), np.zeros((3, 4))
    with pytest.raises(ValueError, match="out is float64, not C-contiguous"):
        plan.accelerations(0.0, good, good, np.zeros((4, 3)).T)
    with pytest.raises(ValueError, match="v is float32; it must be"):
        plan.runs(0.0, 1.0, (good, good.astype(np.float32)), [1])
    with pytest.raises(ValueError, match=r"x has shape \(3, 5\)"):
        plan.runs(0.0, 1.0, (np.zeros((3, 5)), good), [1])


def test_mismatched_work_accumulator_is_refused():
    simulation = simulation_of(next(iter(SCENES.values())))
    with pytest.raises(ValueError, match="accumulator is for 3 grippers, the run has 2"):
        Extrapolated(tolerance=1e-4).advance(simulation.plan, simulation.state, 0.0, 1.0 / 60.0, WorkAccumulator(3))
