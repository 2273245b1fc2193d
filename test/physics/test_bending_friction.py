# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Internal friction of bending: loop of moment over curvature, order, energy, equal bits."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from support.alone import NO_MEMORY
from support.error_bound import SPRINGS

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.control.controller import Controller
from cloth_sim_ros.physics.control.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.extrapolation_tableau import ExtrapolationTableau
from cloth_sim_ros.physics.model.forces.bending_friction import BendingFriction
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.hinge_springs import signed_lengths
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.physics.simulate import simulate
from cloth_sim_ros.physics.state.controller_state import PLASTIC_LENGTHS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import SetParameters
from cloth_sim_ros.simulation.simulation import Simulation

MODELS = ("crossed", "altitude", "quadratic")
#: Bending modulus [N m], friction moment [N] and yield curvature [1/m].
MODULUS, MOMENT, YIELD = 1e-5, 1e-4, 5.0
CELL = 2e-3
#: A flat strip of 4 by 20 mm along x.
STRIP = {
    "cloth.resolution": [3, 11],
    "cloth.size": [2 * CELL, 10 * CELL],
    "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
    "cloth.position": [0.0, 0.0, 0.0],
    "cloth.anchors": [""],
    "gravity": [0.0, 0.0, 0.0],
    "grippers": [""],
    "material.bending_modulus": MODULUS,
    "bending.friction_moment": MOMENT,
    "bending.yield_curvature": YIELD,
}
#: A horizontal strip of 20 by 80 mm whose first two columns are held, and which falls.
FALLING = {
    **STRIP,
    "cloth.resolution": [3, 9],
    "cloth.size": [0.02, 0.08],
    "cloth.anchors": ["0", "1", "9", "10", "18", "19"],
    "gravity": [0.0, 0.0, -9.81],
    "bending.model": "quadratic",
    "material.stretch_modulus": 10.0,
    "material.shear_modulus": 3.0,
}


def scene(values: dict[str, Any], **changes: Any) -> Scene:
    return Scene.from_parameters({**values, **{name.replace("__", "."): value for name, value in changes.items()}})


def arc(strip: Scene, curvature: float) -> Array:
    """Return positions of a strip on a polygon whose sides turn by curvature times cell, (3, n)."""
    points = strip.initial_positions()
    column = np.rint((points[:, 0] - points[:, 0].min()) / CELL).astype(int)
    turns = curvature * CELL * np.arange(column.max())
    points[:, 0] = np.concatenate([[0.0], np.cumsum(CELL * np.cos(turns))])[column]
    points[:, 2] = np.concatenate([[0.0], np.cumsum(CELL * np.sin(turns))])[column]
    return np.ascontiguousarray(points.T)


def friction_moments(strip: Scene, curvatures: Array) -> tuple[Array, Array]:
    """Return the moment of friction per width [N] along a path of curvatures, and the work per area [J/m^2]."""
    plan, elastic = strip.plan(), strip.changed({"bending.friction_moment": 0.0}).plan()
    memory, moments, works, step = dict[str, Array](), [], [], 1e-4
    area = 2 * CELL * 9 * CELL
    for curvature in curvatures:
        ends = [arc(strip, curvature + sign * step) for sign in (1.0, -1.0)]
        energies = [plan.energies(0.0, x, None, memory)[1] - elastic.energies(0.0, x, None)[1] for x in ends]
        moments.append((energies[0] - energies[1]) / (2.0 * step) / area)
        memory[PLASTIC_LENGTHS_KEY], work = plan.plastic.return_mapping(arc(strip, curvature), memory)
        works.append(work / area)
    return np.array(moments), np.array(works)


def there_and_back(amplitude: float, n_points: int = 400) -> Array:
    """Return curvatures from 0 to the amplitude, to minus it, and back."""
    falling = np.linspace(amplitude, -amplitude, n_points)
    return np.concatenate([np.linspace(0.0, amplitude, n_points // 2), falling[1:], falling[::-1][1:]])


@pytest.mark.parametrize("model", MODELS)
def test_loop_has_analytic_area_beyond_yield(model: str) -> None:
    amplitude, n_points = 40.0, 400
    curvatures = there_and_back(amplitude, n_points)
    moments, works = friction_moments(scene(STRIP, bending__model=model), curvatures)
    loop = slice(n_points // 2 - 1, None)
    area = np.sum(0.5 * (moments[loop][1:] + moments[loop][:-1]) * np.diff(curvatures[loop]))
    analytic = 4.0 * MOMENT * (amplitude - YIELD)
    assert area == pytest.approx(analytic, rel=0.01)
    assert works[n_points // 2 :].sum() == pytest.approx(analytic, rel=0.01)
    assert moments.max() == pytest.approx(MOMENT, rel=0.01)


@pytest.mark.parametrize("model", MODELS)
def test_loop_below_yield_has_no_area(model: str) -> None:
    curvatures = there_and_back(0.99 * YIELD)
    moments, works = friction_moments(scene(STRIP, bending__model=model), curvatures)
    assert not works.any()
    assert np.abs(moments - MOMENT / YIELD * curvatures).max() < 0.01 * MOMENT


def mesh_plan(seed: int = 3) -> tuple[Plan, Array, Array]:
    """Return a plan of friction alone of random hinges, positions and velocities (3, n)."""
    random = np.random.default_rng(seed)
    hinges = np.array([random.permutation(40)[:4] for _ in range(150)])
    force = BendingFriction(hinges, random.uniform(-0.3, 0.3, 150), random.uniform(5.0, 50.0, 150), 0.05)
    return compile(Model(np.ones(40), [force])), random.normal(size=(3, 40)), random.normal(size=(3, 40))


def test_friction_has_neither_resultant_nor_torque() -> None:
    plan, x, v = mesh_plan()
    f = np.zeros_like(x)
    plan.add_force(0.0, x, v, f, NO_MEMORY)
    size = np.abs(f).sum()
    assert size > 1.0
    assert np.abs(f.sum(axis=1)).max() < 1e-13 * size
    assert np.abs(np.cross(x.T, f.T).sum(axis=0)).max() < 1e-12 * size


def test_bounds_hold_for_every_plastic_length() -> None:
    plan, x, v = mesh_plan()
    stiff, damped = np.zeros((2, 6, x.shape[1]))
    plan.add_bounds(x, stiff, damped, memory=NO_MEMORY)
    assert not damped.any()
    lengths = plan.plastic.lengths_of(NO_MEMORY) + np.random.default_rng(1).normal(size=150)
    directions = np.random.default_rng(2).normal(size=(50, *x.shape))
    for u in directions:
        product = np.zeros_like(x)
        plan.add_jacobian_product(0.0, x, v, u, 0.0 * u, product, {PLASTIC_LENGTHS_KEY: lengths})
        xx, yy, zz, xy, xz, yz = stiff
        squares = xx * u[0] ** 2 + yy * u[1] ** 2 + zz * u[2] ** 2
        squares += 2.0 * (xy * u[0] * u[1] + xz * u[0] * u[2] + yz * u[1] * u[2])
        assert -np.sum(u * product) <= squares.sum()


@pytest.mark.parametrize("friction_moment", [2e-2, MOMENT], ids=["below yield", "beyond yield"])
def test_runs_are_of_order_two(friction_moment: float) -> None:
    strip = scene(FALLING, bending__friction_moment=friction_moment, bending__yield_curvature=friction_moment / 2e-5)
    plan, start = strip.plan(), strip.starting_state()
    counts = (200, 400, 800, 12800)
    runs = [plan.runs(0.0, 0.05, (start.x, start.v), [count], memory={})[0][0] for count in counts]
    has_yielded = runs[-1].plastic_lengths.any()
    assert has_yielded == (friction_moment == MOMENT)
    errors = [np.abs(run.x - runs[-1].x).max() for run in runs[:-1]]
    assert min(errors[0] / errors[1], errors[1] / errors[2]) > (3.3 if has_yielded else 3.9)
    if has_yielded:
        errors = [np.abs(run.plastic_lengths - runs[-1].plastic_lengths).max() for run in runs[:-1]]
        assert min(errors[0] / errors[1], errors[1] / errors[2]) > 3.7


def test_kinks_of_friction_do_not_halve_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths = list[float]()
    monkeypatch.setattr(Controller, "_halve", lambda self, length: lengths.append(length) or False)
    simulation = Simulation(scene(FALLING, tolerance=1e-7))
    for _ in range(30):
        assert not simulation.advance([]).advance.flagged
    assert simulation.state.memory[PLASTIC_LENGTHS_KEY].any()
    assert not lengths


def test_combination_returns_to_yield_surface() -> None:
    strip = scene(FALLING)
    plan, start = strip.plan(), strip.starting_state()
    state = start.copy()
    tableau = ExtrapolationTableau(plan, start, 0.0, 0.05, (60, 75, 90))
    tableau.commit(3, state)
    lengths = state.memory[PLASTIC_LENGTHS_KEY]
    again, work = plan.plastic.return_mapping(state.x, state.memory)
    assert lengths.any()
    assert work == 0.0
    assert np.array_equal(again, lengths)


def test_lengths_that_no_run_moved_keep_their_bits() -> None:
    strip = scene(FALLING, bending__friction_moment=1.0, bending__yield_curvature=1e5)
    plan, start = strip.plan(), strip.starting_state()
    lengths = np.random.default_rng(5).uniform(-1e-6, 1e-6, len(plan.plastic.lengths_of({})))
    start.memory[PLASTIC_LENGTHS_KEY] = lengths
    ExtrapolationTableau(plan, start, 0.0, 0.02, (60, 75, 90)).commit(3, start)
    assert np.array_equal(start.memory[PLASTIC_LENGTHS_KEY], lengths)


@pytest.mark.parametrize(("stiffness", "ratio"), [(0.02, 3.0), (2.0, 1.0), (200.0, 1.0)])
def test_error_of_a_plastic_length_displaces_as_estimated(stiffness: float, ratio: float) -> None:
    # A slow hinge moves by three times the mean over errors of the second.
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0], [-0.1, 0.05, 0.0], [0.1, 0.04, 0.02]])
    friction = BendingFriction([[0, 1, 2, 3]], 0.0, stiffness, 1.0)
    edges = PairSprings([[0, 3], [1, 3]], [np.hypot(0.108, 0.02), np.hypot(0.118, 0.02)], 5.0)
    plan = compile(Model([1.0, 1.0, 1.0, 0.03], [friction, edges], anchors=[0, 1, 2]))
    x, error = np.ascontiguousarray(points.T), 1e-6
    assert plan.plastic is not None
    estimate, motions = plan.plastic.displacement(x, np.array([error])), list[Array]()
    lengths = signed_lengths(friction.hinges, x, kind="crossed")
    for start in (lengths, lengths + error):
        state, integrator, positions = State(points), Leapfrog(step=1e-3), list[Array]()
        state.memory[PLASTIC_LENGTHS_KEY] = start
        for k in range(50):
            integrator.advance(plan, state, 0.02 * k, 0.02)
            positions.append(state.x.copy())
        motions.append(np.array(positions))
    displacement = np.linalg.norm(motions[1] - motions[0], axis=1).max()
    assert displacement == pytest.approx(ratio * estimate, rel=0.05)


@pytest.mark.parametrize("integrator", ["leapfrog", "extrapolated", "implicit", "symplectic_euler"])
def test_energy_balance_closes_with_friction(integrator: str) -> None:
    strip = scene(FALLING, integrator=integrator, tolerance=0.0 if integrator == "symplectic_euler" else 1e-4)
    plan, state, method = strip.plan(), strip.starting_state(), strip.build_integrator()
    balance, residual, plastic = EnergyBalance(plan, state), 0.0, list[float]()
    for frame in range(20):
        before = balance.dissipation
        method.advance(plan, state, frame / 60.0, 1.0 / 60.0, balance.accumulator)
        residual = balance.add_advance((frame + 1) / 60.0, state)
        plastic.append(balance.dissipation - before)
    assert state.memory[PLASTIC_LENGTHS_KEY].any()
    assert min(plastic) > 0.0
    assert abs(residual) < (0.02 if integrator in ("implicit", "symplectic_euler") else 2e-3) * balance.energy_turnover


def test_free_strip_with_friction_gains_no_energy() -> None:
    strip = scene(STRIP, bending__model="quadratic", material__damping=0.0, air__drag=0.0, wind__normal_drag=0.0)
    plan, state, method = strip.plan(), strip.starting_state(), strip.build_integrator()
    state.x = arc(strip, 60.0)
    state.memory[PLASTIC_LENGTHS_KEY], _ = plan.plastic.return_mapping(state.x, {})
    energies = [plan.energy(0.0, state.x, state.v, state.memory)]
    for frame in range(60):
        method.advance(plan, state, frame / 60.0, 1.0 / 60.0)
        energies.append(plan.energy((frame + 1) / 60.0, state.x, state.v, state.memory))
    rises = np.diff(energies)
    assert rises.max() < 1e-3 * energies[0]
    assert energies[-1] < 0.6 * energies[0]


def run_twice(plan: Plan, x: Array, v: Array, duration: float, **options: Any) -> list[tuple[bytes, bytes]]:
    runs, _ = plan.runs(0.0, duration, (x, v), [40, 60], memory={}, **options)
    return [(run.end_state.tobytes(), run.plastic_lengths.tobytes()) for run in runs]


def test_runs_of_two_threads_have_the_same_bits() -> None:
    strip = scene(FALLING, cloth__resolution=[20, 20], cloth__size=[0.2, 0.2], cloth__anchors=["top_left"])
    sheet, start = strip.plan(), strip.starting_state()
    mesh, x, v = mesh_plan()
    speeds = np.random.default_rng(7).normal(size=start.v.shape)
    for plan, begin, duration in ((sheet, (start.x, speeds), 0.01), (mesh, (x, v), 0.2)):
        single = run_twice(plan, *begin, duration, threads=1)
        assert single[0][1] != plan.plastic.lengths_of({}).tobytes()
        assert run_twice(plan, *begin, duration, threads=2) == single
        assert run_twice(plan, *begin, duration, threads=3) == single
        assert run_twice(plan, *begin, duration, concurrency=2) == single
        assert run_twice(plan, *begin, duration, single_precision=True) == single
        assert not plan.supports_single_precision(duration, *begin, {})


def test_force_without_memory_is_refused() -> None:
    plan, x, v = mesh_plan()
    with pytest.raises(ValueError, match=r"friction of bending depends on the memory .* pass State\.memory"):
        plan.accelerations(0.0, x, v, np.empty_like(x))


def test_two_forces_of_friction_are_refused() -> None:
    forces = [BendingFriction([[0, 1, 2, 3]], 0.0, 1.0, 0.1, name=name) for name in ("first", "second")]
    with pytest.raises(ValueError, match="merge their hinges into one"):
        compile(Model(np.ones(4), forces))


def test_model_without_friction_has_no_plastic_lengths() -> None:
    simulation = Simulation(scene(FALLING, bending__friction_moment=0.0))
    simulation.advance([])
    assert simulation.plan.plastic is None
    assert not any(name.startswith("bending") for name in simulation.state.memory)


def test_folded_hinge_starts_at_its_yield_surface() -> None:
    # Its wings are folded far beyond the limit. The first step of a run would err in first order.
    friction, joints = BendingFriction([[0, 1, 2, 3]], 0.0, 2.0, 0.002), PairSprings([[0, 2], [0, 3]], 0.0, 3.0)
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.1, 0.5, 0.05], [0.1, 0.5, 0.05]])
    velocities = np.array([[0.0, 0.0, 0.0]] * 2 + [[0.0, 0.0, -0.5]] * 2)
    state = State(positions, velocities)
    motion = simulate(Model(np.full(4, 0.01), [friction, joints], anchors=[0, 1]), state, 1.0 / 60.0, tolerance=1e-5)
    # Six thousand if plastic lengths are mapped within the first step.
    assert motion.advances[0].evaluations < 1000


def test_lower_yield_limit_costs_no_first_order_step() -> None:
    parameters = {
        "tolerance": 1e-5,
        "cloth.resolution": [6, 6],
        "cloth.size": [0.3, 0.3],
        "cloth.orientation": [0.0, 0.0, 0.0, 1.0],
        "cloth.anchors": ["top"],
        "bending.model": "crossed",
        "material.bending_modulus": 1e-3,
        "bending.friction_moment": 1e-3,
        "bending.yield_curvature": 5.0,
        "grippers": [""],
    }
    simulation = Simulation(Scene.from_parameters(parameters))
    for _ in range(20):
        simulation.advance()
    done = simulation.advance([SetParameters({"bending.yield_curvature": 0.05})]).advance
    # Twenty thousand if plastic lengths are mapped within the first step.
    assert done is not None
    assert done.evaluations < 5000


def test_simulation_begins_folded_hinges_at_their_yield_surface() -> None:
    springs = {
        "positions": [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.5, 0.0], [0.3, 0.5, 0.8]],
        "velocities": [[0.0, 0.0, 0.0]] * 3 + [[0.0, 0.0, 0.5]],
        "masses": 0.01,
        "springs": [[0, 1], [0, 2], [1, 2], [0, 3], [1, 3]],
        "rest_lengths": [1.0, 1.118, 1.118, 0.99, 0.99],
        "stiffness": 3.0,
        "k_d0": 0.0,
        "triangles": [[0, 1, 2], [1, 0, 3]],
    }
    parameters = {
        **SPRINGS,
        "tolerance": 1e-5,
        "cloth.anchors": ["0", "1", "2"],
        "bending.model": "crossed",
        "bending.flat": True,
        "bending.friction_moment": 0.01,
        "bending.yield_curvature": 0.05,
        "material.bending_modulus": 1e-3,
        "material.damping": 0.0,
    }
    scene = Scene.from_parameters(parameters, files={"springs.yaml": json.dumps(springs).encode()})
    simulation = Simulation(scene)
    plastic, state = simulation.plan.plastic, simulation.state
    assert plastic is not None
    lengths, work = plastic.return_mapping(state.x, {})
    assert work > 0.0
    assert state.memory[PLASTIC_LENGTHS_KEY] == pytest.approx(lengths, abs=1e-15)
