# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The fused plan of a grid against the sum of its terms."""

import numpy as np
import pytest

from cloth_sim_ros.events import Grasp, Target
from cloth_sim_ros.physics import grid_plan
from cloth_sim_ros.physics.dynamics import Economy
from cloth_sim_ros.physics.integrators.base import Observer
from cloth_sim_ros.physics.integrators.march import leapfrog
from cloth_sim_ros.physics.mesh_plan import MeshPlan
from cloth_sim_ros.physics.forces.grips import WrenchObserver
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation

SCENES = {
    "default": {},
    "bare": {
        "gravity": [0.0, 0.0, 0.0],
        "air.drag": 0.0,
        "bending.model": "none",
        "material.shear_modulus": 0.0,
        "material.damping": 0.0,
    },
    "left": {"cloth.shear_layout": "left", "cloth.anchors": ["top_left", "40"]},
    "right, undamped": {"cloth.shear_layout": "right", "material.damping": 0.0, "air.drag": 0.0},
    "alternating, free": {"cloth.shear_layout": "alternating", "cloth.anchors": [""]},
    "viscous": {"material.viscosity": 0.05},
    "hinges": {"bending.model": "crossed", "material.bending_modulus": 1e-4},
    "narrow": {"cloth.resolution": [3, 17], "cloth.size": [0.2, 1.1], "material.shear_modulus": 10.0},
    "two wide": {"cloth.resolution": [11, 2], "cloth.size": [1.0, 0.1]},
}
every_scene = pytest.mark.parametrize("values", SCENES.values(), ids=SCENES.keys())


def pair(values):
    """The same simulation with its plan, and term by term."""
    common = {"cloth.resolution": [7, 9], "grippers": ["one", "two"], "gripper.radius": 0.2}
    scene = Scene.from_parameters({**common, **values})
    fused, plain = Simulation(scene), Simulation(scene)
    plain.dynamics.plan = plain.dynamics.forces = None
    return fused, plain


def stir(simulation, seed=3):
    """A crumpled, moving start."""
    rng = np.random.default_rng(seed)
    free = simulation.model.inverse_masses > 0
    simulation.state.x[:, free] += 0.02 * rng.standard_normal((3, int(free.sum())))
    simulation.state.v[:, free] += rng.standard_normal((3, int(free.sum())))


@every_scene
def test_forces_and_motion_are_those_of_the_terms_to_rounding(values):
    fused, plain = pair(values)
    for simulation in (fused, plain):
        stir(simulation)
    x, v = fused.state.x, fused.state.v
    one, two = np.empty_like(x), np.empty_like(x)
    fused.dynamics.acceleration(0.0, x, v, one)
    plain.dynamics.acceleration(0.0, x, v, two)
    assert one == pytest.approx(two, abs=1e-12 * np.abs(two).max())
    # No longer: a crumpled sheet without damping multiplies rounding by five a frame.
    for _ in range(3):
        steps = [simulation.advance().advance.steps for simulation in (fused, plain)]
        assert steps[0] == steps[1]
    assert fused.positions == pytest.approx(plain.positions, abs=1e-10)
    assert fused.velocities == pytest.approx(plain.velocities, abs=1e-8)


@pytest.mark.parametrize("turning", [False, True], ids=["carried", "turned as well"])
@every_scene
def test_grips_and_wrenches_are_those_of_the_terms_to_rounding(values, turning):
    fused, plain = pair(values)
    corner = fused.positions[-1]
    frames = []
    for simulation in (fused, plain):
        # Both hold some of the same particles.
        simulation.advance([Target("one", corner), Target("two", corner - 0.05)])
        simulation.advance([Grasp("one", True), Grasp("two", True)])
        held = [simulation.grippers.held(g) for g in (0, 1)]
        for k in range(1, 6):
            angle = 0.02 * k if turning else 0.3
            away = 0.002 * k * np.array([1.0, -1.0, 0.5])
            q = (0.0, np.sin(angle), 0.0, np.cos(angle))
            frame = simulation.advance([Target("one", corner + away, q), Target("two", corner - 0.05 + away)])
        frames.append(frame)
    assert np.intersect1d(*held).size
    assert fused.positions == pytest.approx(plain.positions, abs=1e-10)
    scale = np.abs(frames[1].wrenches).max()
    assert scale > 0.0
    works = [simulation._wrenches.work for simulation in (fused, plain)]
    assert works[0] == pytest.approx(works[1], abs=1e-8 * max(1.0, abs(works[1])))
    assert frames[0].wrenches == pytest.approx(frames[1].wrenches, abs=1e-8 * max(1.0, scale))


def test_a_fixed_step_and_a_paused_start_give_the_same_bits_each_time():
    digests = set()
    for _ in range(2):
        fused, _ = pair({"step": 1e-4})
        stir(fused)
        for _ in range(3):
            fused.advance()
        digests.add(fused.state.digest())
    assert len(digests) == 1


def test_the_plan_is_what_runs(monkeypatch):
    """Guards the comparison above: with the plan's loop broken, the motion is wrong."""
    fused, plain = pair({})

    def stay(x, v, steps, step, *, grips, alternate, start):
        x[:], v[:] = start

    monkeypatch.setattr(fused.dynamics.plan._loop(np.float64), "advance", stay)
    fused.advance()
    plain.advance()
    assert np.abs(fused.velocities - plain.velocities).max() > 1e-3


@pytest.mark.parametrize("narrow", [False, True], ids=["double", "single"])
def test_a_turning_gripper_keeps_the_fused_loop_and_its_wrench(narrow, monkeypatch):
    fused, plain = pair({})
    corner = fused.positions[-1]
    for simulation in (fused, plain):
        simulation.advance([Target("one", corner)])
        simulation.advance([Grasp("one", True)])
        simulation.advance([Target("one", corner + 0.01, (0.0, 0.0, 0.1, 1.0))])
    ends, wrenches = [], []
    for simulation in (fused, plain):
        if simulation is fused:
            monkeypatch.setattr(grid_plan, "leapfrog_by_terms", None)
        x, v = simulation.state.x.copy(), simulation.state.v.copy()
        observer = WrenchObserver(simulation._grips)
        # The path of the frame before goes on.
        leapfrog(simulation.dynamics, 2 / 60, x, v, 1e-4, 100, observer, economy=Economy(narrow=narrow))
        ends.append(x)
        wrenches.append(observer.mean_wrenches)
    assert ends[0] == pytest.approx(ends[1], abs=2e-7 if narrow else 1e-12)
    assert np.abs(wrenches[1][0, 3:]).max() > 1e-3
    assert wrenches[0] == pytest.approx(wrenches[1], abs=(2e-3 if narrow else 1e-9) * np.abs(wrenches[1]).max())


def test_poses_of_a_gripper_that_holds_nothing_are_numbers(monkeypatch):
    fused, _ = pair({})
    corner = fused.positions[-1]
    fused.advance([Target("one", corner)])
    fused.advance([Grasp("one", True)])
    fused.advance([Target("one", corner + 0.01, (0.0, 0.0, 0.1, 1.0))])
    # What memory happens to hold: where nothing is set, a subtraction would warn.
    monkeypatch.setattr(np, "empty", lambda shape, **_: np.full(shape, np.nan))
    grips, _ = fused.dynamics.plan._held(2 / 60, 1e-4, 3)
    assert grips.turns.poses[:, 0].any()
    assert np.isfinite(grips.turns.poses).all()


def test_hinge_springs_keep_the_fused_forces_and_take_the_loop_of_listed_springs():
    fused, _ = pair(SCENES["hinges"])
    assert isinstance(fused.dynamics.plan, MeshPlan)
    assert fused.dynamics.forces.names == {"structural", "shear"}


class _Counter(Observer):
    def __init__(self):
        self.points = 0

    def restart(self):
        self.points = 0

    def observe(self, t, x, v, weight):
        self.points += 1


def test_an_observer_sees_every_step():
    fused, _ = pair({})
    counter = _Counter()
    integrator = fused.scene.build_integrator()
    done = integrator.advance(fused.dynamics, fused.state, 0.0, 1 / 60, counter)
    assert counter.points == done.steps


@pytest.mark.parametrize("integrator", ["auto", "leapfrog", "extrapolated"])
def test_an_observer_changes_no_bit(integrator):
    digests = []
    for observer in (None, _Counter()):
        fused, _ = pair({"integrator": integrator, "tolerance": 1e-6})
        stir(fused)
        stepper = fused.scene.build_integrator()
        for k in range(3):
            stepper.advance(fused.dynamics, fused.state, k / 60, 1 / 60, observer)
        digests.append(fused.state.digest())
    assert digests[0] == digests[1]
