# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The fused plan of listed springs and hinges against the sum of the terms."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import Delaunay

from cloth_sim_ros.events import Grasp, Reset, Target
from cloth_sim_ros.physics.chain import Chain, SpringLaw, joint
from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.integrators.base import Observer
from cloth_sim_ros.physics.integrators.leapfrog import Leapfrog
from cloth_sim_ros.physics.integrators.march import leapfrog, leapfrog_by_terms
from cloth_sim_ros.physics.kernels import mesh_leapfrog
from cloth_sim_ros.physics.mesh_plan import MeshPlan
from cloth_sim_ros.physics.model import Model
from cloth_sim_ros.physics.ordering import bandwidth, local_order
from cloth_sim_ros.physics.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.forces.force import Term
from cloth_sim_ros.physics.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.forces.drag import Drag
from cloth_sim_ros.physics.forces.gravity import Gravity
from cloth_sim_ros.scene import Scene
from cloth_sim_ros.simulation import Simulation


def sheet_of_triangles(count=400, seed=0):
    """A wavefront file of an irregular sheet whose vertices come in random order."""
    rng = np.random.default_rng(seed)
    side = round(count**0.5)
    plane = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) / (side - 1.0)
    inner = ((plane > 0.0) & (plane < 1.0)).all(axis=1)
    plane[inner] += rng.uniform(-0.2, 0.2, (int(inner.sum()), 2)) / side
    plane = plane[rng.permutation(len(plane))]
    vertices = [f"v {x:.6f} {y:.6f} 0" for x, y in plane]
    faces = ["f " + " ".join(str(i + 1) for i in triangle) for triangle in Delaunay(plane).simplices]
    return "\n".join(vertices + faces).encode()


def tangle(count=300, seed=1):
    """A springs file with joints, damped and undamped springs, and a particle that many hang on."""
    rng = np.random.default_rng(seed)
    pairs = {tuple(sorted(pair)) for pair in rng.integers(0, count, (900, 2)).tolist() if pair[0] != pair[1]}
    pairs |= {(0, i) for i in range(1, 60)}
    chosen = np.array(sorted(pairs))[rng.permutation(len(pairs))]
    many = len(chosen)
    rest = rng.uniform(0.1, 1.0, many)
    rest[::7] = 0.0
    damping = np.where(np.arange(many) % 3 == 0, 0.0, 0.02)
    tables = {
        "positions": rng.uniform(-1, 1, (count, 3)).tolist(),
        "masses": rng.uniform(0.1, 0.4, count).tolist(),
        "springs": chosen.tolist(),
        "rest_lengths": rest.tolist(),
        "stiffness": 5.0,
        "k_d": damping.tolist(),
    }
    return json.dumps(tables).encode()


MESH, TANGLE = sheet_of_triangles(), tangle()
FILES = {"sheet.obj": MESH, "springs.yaml": TANGLE}
SHEET = {
    "cloth.mesh": "sheet.obj",
    "material.stretch_modulus": 100.0,
    "cloth.anchors": ["3", "77"],
    "bending.model": "none",
}
BENDING = {"cloth.resolution": [7, 9], "material.bending_modulus": 1e-4}
SCENES = {
    "mesh": SHEET,
    "mesh, bare": {**SHEET, "gravity": [0.0] * 3, "air.drag": 0.0, "material.damping": 0.0, "cloth.anchors": [""]},
    "mesh, undamped in air": {**SHEET, "material.damping": 0.0},
    "mesh, viscous": {**SHEET, "material.viscosity": 0.05, "air.drag": 0.0},
    "mesh, wind": {**SHEET, "wind.velocity": [1.0, 2.0, -0.5]},
    "mesh, air": {**SHEET, "wind.velocity": [1.0, 2.0, -0.5], "wind.normal_drag": 0.3, "wind.tangential_drag": 0.1},
    "mesh, crossed": {**SHEET, "bending.model": "crossed", "material.bending_modulus": 1e-8},
    "grid, air": {"cloth.resolution": [7, 9], "material.damping": 0.0, "air.drag": 0.0, "wind.normal_drag": 0.3},
    "grid, opposite": {**BENDING, "bending.model": "opposite", "material.bending_modulus": 0.0},
    "grid, crossed": {**BENDING, "bending.model": "crossed"},
    "grid, altitude, undamped": {**BENDING, "bending.model": "altitude", "material.damping": 0.0},
    "springs": {"cloth.springs": "springs.yaml", "cloth.anchors": ["5"], "bending.model": "none"},
}
every_scene = pytest.mark.parametrize("values", SCENES.values(), ids=SCENES.keys())


def pair(values):
    """The same simulation with its plan, and term by term."""
    common = {"integrator": "leapfrog", "grippers": ["one", "two"], "gripper.radius": 0.2}
    scene = Scene.from_parameters({**common, **values}, files=FILES)
    fused, plain = Simulation(scene), Simulation(scene)
    plain.dynamics.plan = plain.dynamics.forces = None
    return fused, plain


def stir(simulation, seed=3):
    """A crumpled, moving start."""
    rng = np.random.default_rng(seed)
    free = simulation.model.inverse_masses > 0
    simulation.state.x[:, free] += 0.003 * rng.standard_normal((3, int(free.sum())))
    simulation.state.v[:, free] += 0.1 * rng.standard_normal((3, int(free.sum())))


@every_scene
def test_motion_is_that_of_the_terms_to_rounding(values):
    fused, plain = pair(values)
    assert isinstance(fused.dynamics.plan, MeshPlan)
    for simulation in (fused, plain):
        stir(simulation)
    for _ in range(4):
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


def test_the_plan_is_what_runs(monkeypatch):
    """Guards the comparisons above: with the plan's loop broken, the motion is wrong."""
    fused, plain = pair(SHEET)

    def stay(t, x, v, steps, step, *, grips, start):
        x[:], v[:] = start

    monkeypatch.setattr(fused.dynamics.plan._loop, "advance", stay)
    fused.advance()
    plain.advance()
    assert np.abs(fused.velocities - plain.velocities).max() > 1e-3


def test_what_a_scene_does_not_have_is_not_in_its_loop(monkeypatch):
    """Left out by the types of what the compiled loop is given."""
    given = {}

    def record(x0, v0, x, v, steps, particles, speeds, motion, forces, held):
        given.update(motion._asdict(), **forces._asdict(), speeds=speeds, held=held)

    monkeypatch.setattr(mesh_leapfrog, "advance_mesh", record)
    absent = {}
    for name in ("mesh, bare", "mesh, undamped in air", "mesh, crossed", "springs"):
        fused, _ = pair(SCENES[name])
        fused.dynamics.plan.leapfrog(0.0, fused.state.x.copy(), fused.state.v.copy(), 1e-4, 1, None, 1.0)
        absent[name] = {what for what, value in given.items() if value is None}
    hinges = {"crossed", "altitude", "panels"}
    assert absent["mesh, bare"] == {"gravity", "drag", "damped", "joints", "held", "speeds", *hinges}
    assert absent["mesh, undamped in air"] == {"damped", "joints", "held", *hinges}
    assert absent["mesh, crossed"] == {"undamped", "joints", "held", "altitude", "panels"}
    assert absent["springs"] == {"held", *hinges}


def test_the_order_of_locality_is_seen_nowhere_outside():
    """A sheet and the same with its particles renumbered move alike, each in its own numbers."""
    vertices = [line for line in MESH.decode().splitlines() if line[0] == "v"]
    faces = [line.split()[1:] for line in MESH.decode().splitlines() if line[0] == "f"]
    order = np.random.default_rng(9).permutation(len(vertices))
    rank = np.argsort(order)
    moved = [vertices[i] for i in order] + ["f " + " ".join(str(rank[int(i) - 1] + 1) for i in f) for f in faces]
    files = {"one.obj": MESH, "two.obj": "\n".join(moved).encode()}
    ends = []
    for name, anchor, back in (("one.obj", 3, np.arange(len(order))), ("two.obj", rank[3], rank)):
        values = {**SHEET, "cloth.mesh": name, "cloth.anchors": [str(anchor)], "grippers": ["one"]}
        simulation = Simulation(Scene.from_parameters({**values, "gripper.radius": 0.2}, files=files))
        assert simulation.dynamics.plan._loop._rank.tolist() != list(range(len(order)))
        corner = simulation.positions[back[0]]
        simulation.advance([Target("one", corner)])
        frame = simulation.advance([Grasp("one", True)])
        for k in range(3):
            simulation.advance([Target("one", corner + 0.01 * k)])
        ends.append((simulation.positions[back], frame.grasps[0].held))
    assert ends[0][1] == ends[1][1] > 1
    assert ends[0][0] == pytest.approx(ends[1][0], abs=1e-12)


def test_a_repeat_gives_the_same_bits():
    fused, _ = pair(SHEET)
    ends = set()
    for _ in range(3):
        fused.advance([Reset()])
        fused.advance()
        ends.add(fused.state.x.tobytes() + fused.state.v.tobytes())
    assert len(ends) == 1


def test_several_steps_in_one_sweep_change_no_bit(monkeypatch):
    monkeypatch.setattr(mesh_leapfrog, "_SECOND_CACHE", 0)
    scene = Scene.from_parameters(SHEET, files={"sheet.obj": sheet_of_triangles(2500)})
    ends = []
    for levels in (1, 2, 5):
        simulation = Simulation(scene)
        loop = simulation.dynamics.plan._loop
        assert loop._levels > 1
        assert loop._blocks > loop._lag + 1
        loop._levels = levels
        stir(simulation)
        simulation.advance()
        ends.append(simulation.state.digest())
    assert len(set(ends)) == 1


NARROWER = """
import sys
from cloth_sim_ros.physics.kernels import grid_emit
grid_emit.vector_bytes = lambda: 32
from cloth_sim_ros.physics.kernels import mesh_emit
assert mesh_emit.LANES == 4
import numpy as np
from cloth_sim_ros.physics.chain import Chain, SpringLaw
from cloth_sim_ros.physics.dynamics import Dynamics
from cloth_sim_ros.physics.mesh_plan import MeshPlan
"""
RUN = """
chain = Chain(law=SpringLaw(mass=0.1, rest_length=0.1, stiffness=5.0, k_d0=0.1), particle_count=300)
x = np.ascontiguousarray(chain.positions().T) + 0.01 * np.random.default_rng(0).standard_normal((3, 300))
v = np.zeros_like(x)
MeshPlan(Dynamics(chain.model())).leapfrog(0.0, x, v, 1e-3, 20, None, 1.0)
found = x.tobytes().hex()
"""


def test_narrower_vectors_give_the_same_bits(tmp_path):
    # A cache of its own: kernels of another width have the same names.
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    code = NARROWER + RUN + "sys.stdout.write(found)"
    narrower = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    names = {"np": np, "Chain": Chain, "SpringLaw": SpringLaw, "MeshPlan": MeshPlan, "Dynamics": Dynamics}
    exec(RUN, names)
    assert narrower.stdout == names["found"]


def test_after_a_state_that_is_not_finite_nothing_is_left_behind():
    fused, plain = pair(SHEET)
    bad = np.full_like(fused.state.x, np.nan)
    fused.dynamics.plan.leapfrog(0.0, bad, bad.copy(), 1e-3, 2, None, 1.0)
    for simulation in (fused, plain):
        simulation.advance()
    assert fused.positions == pytest.approx(plain.positions, abs=1e-10)


def test_coincident_particles_give_no_force_and_no_nan():
    chain = Chain(law=SpringLaw(mass=0.1, rest_length=0.1, stiffness=1.0, k_d0=0.1), particle_count=3)
    dynamics = Dynamics(chain.model())
    x, v = np.zeros((3, 3)), np.zeros((3, 3))
    MeshPlan(dynamics).leapfrog(0.0, x, v, 1e-3, 5, None, 1.0)
    assert not x.any()
    assert not v.any()


@pytest.mark.parametrize("damping", [0.0, 0.02], ids=["undamped", "damped"])
@pytest.mark.parametrize("kind", [CrossedSprings, AltitudeSprings])
def test_hinges_give_the_forces_of_their_terms_and_none_where_they_have_no_length(kind, damping):
    rng = np.random.default_rng(0)
    quads = np.array([12 + rng.choice(288, 4, replace=False) for _ in range(900)])
    x, v = rng.uniform(-1, 1, (3, 300)), rng.uniform(-1, 1, (3, 300))
    # Edge and wings parallel, all in one line, all in one point.
    x[:, :4] = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]).T
    x[:, 4:8] = np.outer([1, 2, 3], np.arange(4))
    x[:, 8:12], v[:, :12] = 0.5, 0.0
    quads = np.concatenate([quads, np.arange(12).reshape(3, 4)])
    stiffness, rest = rng.uniform(0.1, 1, len(quads)), rng.uniform(-0.1, 0.1, len(quads))
    ends = (quads[:, :2], quads[:, 2:]) if kind is CrossedSprings else (quads,)
    term = kind(*ends, rest, stiffness, damping * stiffness)
    dynamics = Dynamics(Model(rng.uniform(0.5, 1, 300), [term], anchors=[20]))
    ends = []
    for march in (MeshPlan(dynamics).leapfrog, lambda *arguments: leapfrog_by_terms(dynamics, *arguments)):
        ends.append((x.copy(), v.copy()))
        march(0.0, *ends[-1], 1e-3, 3, None, 1.0)
    pushed = np.abs(ends[1][1] - v).max()
    assert pushed > 1e-4
    assert ends[0][1] == pytest.approx(ends[1][1], abs=1e-12 * max(1.0, pushed))
    assert ends[0][0] == pytest.approx(ends[1][0], abs=1e-12)
    assert not ends[0][1][:, 4:12].any()


def test_a_chain_with_a_joint_keeps_its_order_and_moves_as_by_its_terms():
    chain = Chain(
        law=SpringLaw(mass=0.1, rest_length=0.1, stiffness=5.0, k_d0=0.1), particle_count=700, anchored="both"
    )
    model = chain.model(gravity=(0.0, 0.0, -9.81), further=(joint((3, 600), stiffness=2.0, k_d0=0.3, mass=0.1),))
    dynamics = Dynamics(model)
    plan = MeshPlan(dynamics)
    rng = np.random.default_rng(4)
    x = np.ascontiguousarray(chain.positions().T) + 0.01 * rng.standard_normal((3, 700))
    v = rng.standard_normal((3, 700)) * (model.inverse_masses > 0)
    ends = []
    for march in (plan.leapfrog, lambda *arguments: leapfrog_by_terms(dynamics, *arguments)):
        ends.append((x.copy(), v.copy()))
        march(0.0, *ends[-1], 1e-4, 50, None, 1.0)
    assert ends[0][0] == pytest.approx(ends[1][0], abs=1e-12)
    assert ends[0][1] == pytest.approx(ends[1][1], abs=1e-11)


def test_without_springs_particles_fall_freely():
    model = Model(np.ones(5), [Gravity(np.ones(5), (0.0, 0.0, -10.0)), Drag(np.ones(5), 0.0)], anchors=[2])
    dynamics = Dynamics(model)
    dynamics.plan = MeshPlan(dynamics)
    x, v = np.zeros((3, 5)), np.zeros((3, 5))
    leapfrog(dynamics, 0.0, x, v, 0.01, 100)
    assert x[2] == pytest.approx([-5.0, -5.0, 0.0, -5.0, -5.0])


def test_a_term_of_another_kind_keeps_the_sum_of_terms():
    class Push(Term):
        name = "push"

        def add_force(self, t, x, v, f):
            f += 1.0

    assert not MeshPlan.fits(Dynamics(Model(np.ones(3), [Push()])))
    assert MeshPlan.fits(Dynamics(Model(np.ones(3), [Gravity(np.ones(3), (0.0, 0.0, 1.0))])))


class _Counter(Observer):
    def __init__(self):
        self.points = 0

    def restart(self):
        self.points = 0

    def observe(self, t, x, v, weight):
        self.points += 1


def test_an_observer_sees_every_step_and_changes_no_bit():
    digests = []
    counter = _Counter()
    for observer in (None, counter):
        fused, _ = pair(SHEET)
        stir(fused)
        done = Leapfrog().advance(fused.dynamics, fused.state, 0.0, 1 / 60, observer)
        digests.append(fused.state.digest())
    assert digests[0] == digests[1]
    assert counter.points == done.steps


def test_local_order_brings_neighbours_together_and_keeps_what_is_local():
    rng = np.random.default_rng(2)
    index = np.arange(900).reshape(30, 30)
    pairs = np.concatenate(
        [
            np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
            np.stack([index[:-1].ravel(), index[1:].ravel()], 1),
        ]
    )
    assert local_order(900, pairs) is None
    shuffled = rng.permutation(900)[pairs]
    order = local_order(900, shuffled)
    assert sorted(order.tolist()) == list(range(900))
    assert bandwidth(shuffled) > 800
    assert bandwidth(np.argsort(order)[shuffled]) < 60
