# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plans of listed springs and hinges: invisible inner order, same bits on any processor."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.plan_scenes import FILES, MESH, SCENES, SHEET

from cloth_sim_ros import engine
from cloth_sim_ros.engine.instruction_set import libraries
from cloth_sim_ros.physics.model.forces.altitude import AltitudeSprings
from cloth_sim_ros.physics.model.forces.crossed import CrossedSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.ordering import bandwidth, local_order
from cloth_sim_ros.physics.model.sheets.chain import Chain, SpringLaw, joint
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation


def test_local_order_is_invisible_outside():
    """A sheet and a copy with permuted particles move alike, each in its own order."""
    vertices = [line for line in MESH.decode().splitlines() if line[0] == "v"]
    faces = [line.split()[1:] for line in MESH.decode().splitlines() if line[0] == "f"]
    order = np.random.default_rng(9).permutation(len(vertices))
    rank = np.argsort(order)
    moved = [vertices[i] for i in order] + ["f " + " ".join(str(rank[int(i) - 1] + 1) for i in f) for f in faces]
    files = {"one.obj": MESH, "two.obj": "\n".join(moved).encode()}
    ends = []
    for name, anchor, back in (("one.obj", 3, np.arange(len(order))), ("two.obj", rank[3], rank)):
        values = {**SHEET, "cloth.mesh": name, "cloth.anchors": [str(anchor)], "grippers": ["one"], "tolerance": 1e-5}
        simulation = Simulation(Scene.from_parameters({**values, "gripper.radius": 0.2}, files=files))
        corner = simulation.positions[back[0]]
        simulation.advance([Target("one", corner)])
        frame = simulation.advance([Grasp("one", True)])
        for k in range(3):
            last = simulation.advance([Target("one", corner + 0.01 * k)])
        ends.append((simulation.positions[back], frame.grasps[0].grasped_count, last.wrenches))
    assert ends[0][1] == ends[1][1] > 1
    assert ends[0][0] == pytest.approx(ends[1][0], abs=1e-12)
    assert ends[0][2] == pytest.approx(ends[1][2], abs=1e-9)


#: Moves scenes with a gripper that carries each, and prints a line with the state's digest for each.
DIGESTS = """
import json, sys
sys.path.insert(0, sys.argv[2])
import numpy as np
from cloth_sim_ros.simulation.events import Grasp, Target
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.simulation import Simulation
from support.plan_scenes import FILES, stir
for values in json.loads(sys.argv[1]):
    simulation = Simulation(Scene.from_parameters(values, files=FILES))
    stir(simulation)
    corner = simulation.positions[-1]
    simulation.advance([Target("one", corner)])
    simulation.advance([Grasp("one", True)])
    for k in range(3):
        turned = (0.0, 0.0, np.sin(0.01 * k), np.cos(0.01 * k))
        frame = simulation.advance([Target("one", corner + 0.003 * k, turned)])
    print(simulation.state.digest(), frame.wrenches.tobytes().hex(), simulation.energy_report)
"""
BUILT = [name for name in libraries() if (Path(engine.__path__[0]) / f"_{name}.so").exists()]
#: Scenes by their names and changed values.
MOVED = {
    "accurate": ("default", {"tolerance": 1e-5, "cloth.resolution": [17, 18]}),
    "coarse": ("default", {"tolerance": 1e-2}),
    "grid, wind and air": ("grid, wind and air", {"cloth.resolution": [7, 9]}),
    "grid, altitude, undamped": ("grid, altitude, undamped", {}),
    "mesh, crossed": ("mesh, crossed", {}),
    "implicit": ("default", {"integrator": "implicit", "cloth.resolution": [7, 9]}),
    "springs": ("springs", {}),
}


@functools.cache
def digests_of(library: str) -> dict[str, str]:
    """Return the line of each scene by a library of the engine, from one process."""
    common = {"grippers": ["one"], "gripper.radius": 0.2, "diagnostics.energy": True}
    scenes = [{**common, **SCENES[name], **values} for name, values in MOVED.values()]
    command = [sys.executable, "-c", DIGESTS, json.dumps(scenes), str(Path(__file__).parents[1])]
    environment = {**os.environ, "CLOTH_SIM_ROS_ENGINE": library}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert not done.returncode, done.stderr
    return dict(zip(MOVED, done.stdout.splitlines(), strict=True))


@pytest.mark.skipif(len(BUILT) < 2, reason="the engine is built for one instruction set that runs here")
@pytest.mark.parametrize("name", MOVED)
def test_any_instruction_set_gives_the_same_bits(name):
    assert len({digests_of(library)[name] for library in BUILT}) == 1


def test_coincident_particles_give_no_force_and_no_nan():
    chain = Chain(law=SpringLaw(mass=0.1, rest_length=0.1, stiffness=1.0, k_d0=0.1), particle_count=3)
    zeros = np.zeros((3, 3))
    (run,), _ = compile(chain.model()).runs(0.0, 5e-3, (zeros, zeros), [5])
    assert not run.x.any()
    assert not run.v.any()


@pytest.mark.parametrize("damping", [0.0, 0.02], ids=["undamped", "damped"])
@pytest.mark.parametrize("kind", [CrossedSprings, AltitudeSprings])
def test_many_hinges_give_the_sum_of_their_forces(kind, damping):
    rng = np.random.default_rng(0)
    quads = np.array([12 + rng.choice(288, 4, replace=False) for _ in range(900)])
    x, v = rng.uniform(-1, 1, (3, 300)), rng.uniform(-1, 1, (3, 300))
    # Edge and wings parallel, all in one line, all in one point.
    x[:, :4] = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]).T
    x[:, 4:8] = np.outer([1, 2, 3], np.arange(4))
    x[:, 8:12], v[:, :12] = 0.5, 0.0
    quads = np.concatenate([quads, np.arange(12).reshape(3, 4)])
    stiffness, rest_lengths = rng.uniform(0.1, 1, len(quads)), rng.uniform(-0.1, 0.1, len(quads))

    def force(chosen):
        ends = (quads[chosen, :2], quads[chosen, 2:]) if kind is CrossedSprings else (quads[chosen],)
        hinges = kind(*ends, rest_lengths[chosen], stiffness[chosen], damping * stiffness[chosen])
        out = np.empty_like(x)
        compile(Model(np.ones(300), [hinges])).accelerations(0.0, x, v, out)
        return out

    together = force(slice(None))
    # In lists of other lengths: the other hinges in a vector differ.
    apart = sum(force(slice(k, k + 1)) for k in range(7)) + sum(force(slice(k, k + 64)) for k in range(7, 903, 64))
    scale = np.abs(together).max()
    assert scale > 0.1
    assert together == pytest.approx(apart, abs=1e-12 * scale)
    assert not together[:, 4:12].any()


@pytest.mark.parametrize("count", [3, 700])
def test_chain_with_a_joint_moves_by_its_formula(count):
    chain = Chain(
        law=SpringLaw(mass=0.1, rest_length=0.1, stiffness=5.0, k_d0=0.1), particle_count=count, anchored="both"
    )
    joint_pair = (0, count - 2)
    model = chain.model(gravity=(0.0, 0.0, -9.81), further=(joint(joint_pair, stiffness=2.0, k_d0=0.3, mass=0.1),))
    springs = [force for force in model.forces if hasattr(force, "pairs")]
    rng = np.random.default_rng(4)
    x = np.ascontiguousarray(chain.positions().T) + 0.01 * rng.standard_normal((3, count))
    v = rng.standard_normal((3, count)) * (model.inverse_masses > 0)

    def acceleration(x, v):
        f = np.zeros_like(x)
        for force in springs:
            for (i, j), rest_length, k, c in zip(
                force.pairs, force.rest_length, force.rigidity, force.damping, strict=True
            ):
                s, u = x[:, j] - x[:, i], v[:, j] - v[:, i]
                length = np.linalg.norm(s)
                pull = (
                    k * s + c * u
                    if rest_length == 0.0
                    else (k * (length - rest_length) + c * (u @ s) / length) * s / length
                )
                f[:, i] += pull
                f[:, j] -= pull
        return f * model.inverse_masses + np.outer([0.0, 0.0, -9.81], model.inverse_masses > 0.0)

    steps, h = 5, 1e-4
    (run,), _ = compile(model).runs(0.0, steps * h, (x, v), [steps])
    before = a = acceleration(x, v)
    for _ in range(steps):
        x = x + 0.5 * h * v
        a, before = acceleration(x, v + 0.25 * h * (a + before)), a
        v = v + h * a
        x = x + 0.5 * h * v
    assert run.x == pytest.approx(x, abs=1e-13)
    assert run.v == pytest.approx(v, abs=1e-11)


def test_local_order_reduces_bandwidth_and_keeps_local_orders():
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


def test_grip_on_a_missing_particle_is_refused():
    simulation = Simulation(Scene.from_parameters({**SHEET, "grippers": ["one"]}, files=FILES))
    grips = simulation.plan.grips
    ones = np.ones(1)
    grips.set_grips(grips.paths, np.array([0, 1]), np.array([400]), np.zeros((1, 3)), ones, ones)
    with pytest.raises(ValueError, match=r"held particles names particle 400; there are 400"):
        simulation.plan.spectral_bounds(simulation.state.x)
