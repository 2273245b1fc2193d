# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Python forces together with engine forces: same motion, same energy balance, exceptions."""

from __future__ import annotations

import numpy as np
import pytest
from support.plan_scenes import FILES, SCENES, listed, stir

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.control.automatic import INTEGRATORS, make_integrator
from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.physics.integrators.base import UnstableError
from cloth_sim_ros.physics.model.forces.force import Force
from cloth_sim_ros.physics.model.forces.grid_springs import GridSprings
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.parts import GridFamily
from cloth_sim_ros.physics.plan.assembly import MOVE_OPERATIONS
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.plan.python_forces import PythonForces
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

PERIOD = 1 / 60


class NumpySprings(Force):
    """S1 and S4 of docs/springs.md in numpy."""

    damped = True

    def __init__(self, springs: PairSprings) -> None:
        self.name = f"{springs.name}, in numpy"
        self.near_ends, self.far_ends = springs.pairs.T
        self.rest_lengths, self.k, self.damping = springs.rest_length, springs.rigidity, springs.damping
        self.joint = self.rest_lengths == 0.0

    def geometry(self, x, v):
        s, u = x[:, self.far_ends] - x[:, self.near_ends], v[:, self.far_ends] - v[:, self.near_ends]
        length = np.linalg.norm(s, axis=0)
        return s, u, length, s / np.where(length > 0.0, length, 1.0)

    def add_force(self, t, x, v, f):
        s, u, length, unit = self.geometry(x, v)
        spring = self.k * (length - self.rest_lengths) + self.damping * (u * unit).sum(axis=0)
        pull = np.where(self.joint, self.k * s + self.damping * u, spring * unit)
        for c in range(3):
            np.add.at(f[c], self.near_ends, pull[c])
            np.add.at(f[c], self.far_ends, -pull[c])

    def energy(self, t, x):
        length = self.geometry(x, np.zeros_like(x))[2]
        return 0.5 * float(np.sum(self.k * (length - self.rest_lengths) ** 2))

    def dissipation(self, t, x, v):
        _, u, _, unit = self.geometry(x, v)
        rate = np.where(self.joint, (u * u).sum(axis=0), (u * unit).sum(axis=0) ** 2)
        return float(np.sum(self.damping * rate))

    def add_stiffness(self, x, blocks):
        _, _, length, unit = self.geometry(x, np.zeros_like(x))
        # Compression counts like tension: it destabilises, and a step must resolve that, too.
        tension = np.minimum(np.abs(self.k * (1.0 - self.rest_lengths / np.maximum(length, 1e-12))), 9.0 * self.k)
        across = np.where(self.joint, self.k, tension)
        self.add(blocks, unit, 2.0 * self.k, 2.0 * across)

    def add_damping(self, x, blocks):
        unit = self.geometry(x, np.zeros_like(x))[3]
        self.add(blocks, unit, 2.0 * self.damping, np.where(self.joint, 2.0 * self.damping, 0.0))

    def add(self, blocks, unit, along, across):
        """Add to both ends: along the spring and across it."""
        for row, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
            entry = (along - across) * unit[i] * unit[j] + (across if i == j else 0.0)
            for ends in (self.near_ends, self.far_ends):
                np.add.at(blocks[row], ends, entry)

    def add_jacobian_product(self, t, x, v, dx, dv, out):
        # By a difference: the reference is exact.
        ends = []
        for sign in (1.0, -1.0):
            ends.append(np.zeros_like(out))
            self.add_force(t, x + sign * 1e-6 * dx, v + sign * 1e-6 * dv, ends[-1])
        out += (ends[0] - ends[1]) / 2e-6


def in_numpy(model, name):
    """Return the model with one of its forces in numpy."""
    forces = [NumpySprings(force) if force.name == name else force for force in listed(model).forces]
    return Model(model.masses, forces, anchors=model.anchors)


def pair(name, force="structural", **options):
    """Return the simulation by the engine, and with one force in numpy."""
    common = {"cloth.resolution": [7, 9], "grippers": ["one"], "gripper.radius": 0.2, "integrator": "leapfrog"}
    scene = Scene.from_parameters({**common, **SCENES[name], **options}, files=FILES)
    engine, python_simulation = Simulation(scene), Simulation(scene)
    python_simulation.plan = compile(in_numpy(python_simulation.model, force))
    for simulation in (engine, python_simulation):
        stir(simulation)
    return engine, python_simulation


SHEETS = [("default", "structural"), ("hinges", "shear"), ("mesh", "structural"), ("springs", "springs")]
every_sheet = pytest.mark.parametrize(("name", "force"), SHEETS)


@every_sheet
def test_numpy_force_equals_the_engine_force(name, force):
    engine, python_simulation = pair(name, force)
    x, v = engine.state.x, engine.state.v
    results = []
    for plan in (engine.plan, python_simulation.plan):
        a = np.empty_like(x)
        plan.accelerations(0.0, x, v, a)
        f, out, dx = np.zeros_like(x), np.zeros_like(x), np.random.default_rng(1).standard_normal(x.shape)
        plan.add_force(0.0, x, v, f)
        plan.add_jacobian_product(0.0, x, v, dx, 0.5 * dx, out)
        results.append((a, f, out, plan.energies(0.0, x, v), plan.powers(0.0, x, v), plan.spectral_bounds(x)))
    (a, f, out, energies, powers, rates), (b, g, python_product, *python_values) = results
    assert a == pytest.approx(b, abs=1e-12 * np.abs(a).max())
    assert f == pytest.approx(g, abs=1e-12 * np.abs(f).max())
    assert out == pytest.approx(python_product, abs=1e-5 * np.abs(out).max())
    assert [energies, powers] == [pytest.approx(values, rel=1e-10) for values in python_values[:2]]
    # A sheet's bounds are calculated in single precision; those of listed springs may be sharper than blocks alone are.
    for sharp, plain in zip(rates, python_values[2], strict=True):
        assert 0.5 * plain < sharp <= plain * (1.0 + 1e-5)


@every_sheet
def test_carried_sheet_moves_and_pulls_the_same(name, force):
    # Bounds may differ, and so may steps.
    engine, python_simulation = pair(name, force, step=2e-5)
    corner, frames = engine.positions[-1], []
    for simulation in (engine, python_simulation):
        simulation.advance([Target("one", corner)])
        simulation.advance([Grasp("one", True)])
        turned = (0.0, 0.0, np.sin(0.05), np.cos(0.05))
        frames.append([simulation.advance([Target("one", corner + 0.003 * k, turned)]) for k in range(1, 4)])
    assert [frame.advance.steps for frame in frames[0]] == [frame.advance.steps for frame in frames[1]]
    assert engine.positions == pytest.approx(python_simulation.positions, abs=1e-9)
    scale = np.abs(frames[0][-1].wrenches).max()
    assert scale > 0.0
    assert frames[0][-1].wrenches == pytest.approx(frames[1][-1].wrenches, abs=1e-7 * max(1.0, scale))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_every_integrator_closes_its_energy_balance(integrator):
    for plan in [simulation.plan for simulation in pair("default", "shear")]:
        # From flat: a smooth motion.
        state = Simulation(Scene.from_parameters({"cloth.resolution": [7, 9]})).state
        stepper = make_integrator(integrator, tolerance=1e-5)
        balance, open_by = EnergyBalance(plan, state), 0.0
        for frame in range(5):
            stepper.advance(plan, state, frame * PERIOD, PERIOD, balance.accumulator)
            open_by = balance.add_advance((frame + 1) * PERIOD, state)
        assert balance.dissipation > 0.0
        # Of first order, at its stability limit.
        share = 0.05 if integrator == "symplectic_euler" else 1e-3
        assert abs(open_by) < share * balance.energy_turnover


class Wind(Force):
    """A force with constant power on each particle that moves along x, and with some damping."""

    name = "a wind of one's own"

    def add_force(self, t, x, v, f):
        f[0] += 2.0 + t - 0.5 * v[0]

    def external_power(self, t, x, v):
        return (2.0 + t) * float(v[0].sum())

    def dissipation(self, t, x, v):
        return 0.5 * float((v[0] ** 2).sum())


def test_its_powers_are_accumulated():
    plan = compile(Model(np.ones(4), [Wind()]))
    (run,), _ = plan.runs(0.0, 1.0, (np.zeros((3, 4)), np.zeros((3, 4))), [1000], record_power=True)
    # v' = 2 + t - v / 2 of four particles of 1 kg from rest: v = 2 t.
    assert run.v[0] == pytest.approx(2.0, rel=1e-6)
    # The integrals of v^2 / 2 and (2 + t) v.
    assert run.power_integrals == pytest.approx([4.0 * 2.0 / 3.0, 4.0 * (2.0 + 2.0 / 3.0)], rel=1e-5)
    assert pytest.approx(run.power_integrals[1] - run.power_integrals[0], rel=1e-5) == 0.5 * 4.0 * 2.0**2


def test_force_receives_the_time_of_the_step():
    class Clock(Force):
        name = "clock"

        def __init__(self):
            self.times = []

        def add_force(self, t, x, v, f):
            self.times.append(t)

    clock = Clock()
    plan = compile(Model(np.ones(2), [clock]))
    plan.runs(3.0, 0.5, (np.zeros((3, 2)), np.zeros((3, 2))), [5])
    # The start replaces the steps before it; then the middle of each.
    assert clock.times == pytest.approx([3.0, 3.05, 3.15, 3.25, 3.35, 3.45])


class Trouble(Force):
    """A force that raises after a number of evaluations."""

    name = "trouble"

    def __init__(self, error, after):
        self.error, self.left = error, after

    def add_force(self, t, x, v, f):
        self.left -= 1
        if self.left < 0:
            raise self.error


@pytest.mark.parametrize("error", [RuntimeError("no such wind"), KeyboardInterrupt(), UnstableError("torn")], ids=repr)
@pytest.mark.parametrize("after", [0, 1, 7])
@pytest.mark.parametrize("grid", [False, True], ids=["alone", "beside a sheet"])
def test_its_exceptions_reach_the_caller_and_the_plan_survives(error, after, grid):
    family = GridFamily(name="right", stiffness=1.0, rest_length=0.1)
    trouble = Trouble(error, after)
    plan = compile(Model(np.ones(60), [*([GridSprings(6, 10, [family])] if grid else []), trouble]))
    start = np.random.default_rng(0).standard_normal((2, 3, 60))
    with pytest.raises(type(error)) as raised:
        plan.runs(0.0, 1e-3, (start[0], start[1]), [4, 5, 6], weights=[0.2, 0.3, 0.5])
    assert raised.value is error
    if after == 0:
        with pytest.raises(type(error)):
            plan.accelerations(0.0, start[0], start[1], np.empty((3, 60)))
    trouble.left = 1000
    ends = [plan.runs(0.0, 1e-3, (start[0], start[1]), [4])[0][0].x for _ in range(2)]
    assert np.array_equal(*ends)
    assert np.isfinite(ends[0]).all()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_signal_between_engine_and_force_ends_the_run(monkeypatch):
    class Still(Force):
        name = "still"

        def add_force(self, t, x, v, f):
            pass

    def interrupted(*_):
        raise KeyboardInterrupt

    plan, at = compile(Model(np.ones(2), [Still()])), np.zeros((3, 2))
    with monkeypatch.context() as patch:
        patch.setattr(PythonForces, "evaluate", interrupted)
        for ask in (lambda: plan.runs(0.0, 1e-3, (at, at), [4]), lambda: plan.accelerations(0.0, at, at, at.copy())):
            # ctypes has printed it, and returned any number to the engine.
            with pytest.raises(KeyboardInterrupt):
                ask()
    assert np.isfinite(plan.runs(0.0, 1e-3, (at, at), [4])[0][0].x).all()


def test_exception_in_a_frame_leaves_the_simulation_unchanged():
    simulation = Simulation(Scene.from_parameters({"cloth.resolution": [7, 9]}))
    simulation.advance()
    model, trouble = simulation.model, Trouble(LookupError("out of air"), 5)
    simulation.plan = compile(Model(model.masses, [*model.forces, trouble], anchors=model.anchors))
    before = simulation.state.digest()
    with pytest.raises(LookupError, match="out of air"):
        simulation.advance()
    assert simulation.state.digest() == before


def test_force_without_parts_or_add_force_is_refused():
    class Nothing(Force):
        name = "nothing"

    plan = compile(Model(np.ones(2), [Nothing()]))
    with pytest.raises(NotImplementedError, match="force 'nothing' has neither parts nor add_force"):
        plan.accelerations(0.0, np.zeros((3, 2)), np.zeros((3, 2)), np.empty((3, 2)))


def test_step_cost_adds_only_the_force_itself():
    model = pair("default")[0].model
    with_it = Model(model.masses, [*model.forces, Wind()], anchors=model.anchors)
    count = model.particle_count
    force_cost = CONSTANTS.python_force_time * (count + 100) / count
    assert compile(with_it).step_cost == pytest.approx(compile(model).step_cost + force_cost)
    single_cost = compile(Model(np.ones(100), [Wind()])).step_cost
    assert single_cost == pytest.approx(CONSTANTS.operation_time * MOVE_OPERATIONS + 2.0 * CONSTANTS.python_force_time)


def test_work_accumulator_changes_no_bit():
    ends = []
    for book in (None, WorkAccumulator(0, record_power=True)):
        plan, state = compile(Model(np.ones(3), [Wind()])), State(np.zeros((3, 3)))
        make_integrator("auto", tolerance=1e-5).advance(plan, state, 0.0, PERIOD, book)
        ends.append(state.digest())
    assert ends[0] == ends[1]
