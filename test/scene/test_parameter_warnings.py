# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Ineffective parameters: reported ones change no bit of the motion, others do."""

import numpy as np
import pytest

from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.scene.parameters.parameter_file import dump
from cloth_sim_ros.scene.parameters.warnings import ineffective_parameters

MESH = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"
SPRINGS = "positions: [[0, 0, 0], [1, 0, 0], [1, 1, 0]]\nmasses: 0.1\nsprings: [[0, 1], [1, 2]]\nstiffness: 10.0\n"
FILES = {"m.obj": MESH.encode(), "s.yaml": SPRINGS.encode()}
MODULUS = {"material.bending_modulus": 1e-4}
#: Scenes of every kind that the rules distinguish.
SCENES = {
    "axial": {},
    "none": {"bending.model": "none"},
    "opposite": {"bending.model": "opposite"},
    "crossed": {"bending.model": "crossed", **MODULUS},
    "altitude": {"bending.model": "altitude", **MODULUS},
    "mesh": {"cloth.mesh": "m.obj", "cloth.anchors": ["0"], "bending.model": "none"},
    "folded mesh": {"cloth.mesh": "m.obj", "cloth.anchors": ["0"], "bending.model": "crossed", **MODULUS},
    "springs": {"cloth.springs": "s.yaml", "cloth.anchors": ["0"], "bending.model": "none"},
    "calm": {"air.drag": 0.0, "wind.normal_drag": 0.0},
    "windy": {"air.drag": 0.3, "wind.normal_drag": 0.0},
    "fixed step": {"step": 1e-4},
    "no error control": {"integrator": "symplectic_euler"},
    "viscous": {"material.viscosity": 0.01, "bending.model": "none"},
    "viscous axial": {"material.viscosity": 0.01},
    "viscous hinges": {"material.viscosity": 0.01, "bending.model": "crossed", **MODULUS},
    "no grippers": {"grippers": [""]},
}
CHANGED_VALUES = {
    "cloth.size": [1.1, 0.9], "cloth.resolution": [5, 4], "cloth.shear_layout": "left", "material.density": 0.3,
    "material.stretch_modulus": 900.0, "material.shear_modulus": 90.0, "material.bending_modulus": 2e-4,
    "material.damping": 0.2, "material.viscosity": 0.3, "bending.stiffness": 3.0, "bending.rest_angle": 0.4,
    "tolerance": 1e-6, "gripper.radius": 1.5, "gripper.stiffness": 500.0, "gripper.damping": 0.9,
    "wind.velocity": [0.0, 2.0, 0.0], "wind.normal_drag": 0.5, "wind.tangential_drag": 0.5,
}  # fmt: skip


def motion(values):
    scene = Scene.from_parameters({"cloth.resolution": [4, 4], **values}, files=FILES)
    simulation = Simulation(scene)
    # The sheet starts off its rest shape, so that each force acts.
    simulation.state.x[:] += 0.02 * np.sin(np.arange(simulation.state.x.size)).reshape(simulation.state.x.shape)
    corner = simulation.positions[-1]
    grasp = [Target("gripper", tuple(corner)), Grasp("gripper", True)] if scene.gripper_names else []
    simulation.advance(grasp)
    if grasp:
        simulation.advance([Target("gripper", tuple(np.add(corner, (0.0, 0.0, 0.1))))])
    simulation.advance()
    return scene, simulation.state.x.tobytes()


@pytest.mark.parametrize("kind", SCENES)
def test_reported_parameters_have_no_effect_and_others_have(kind):
    plain = motion(SCENES[kind])[1]
    for name, value in CHANGED_VALUES.items():
        try:
            scene, moved = motion({**SCENES[kind], name: value})
        except ValueError:
            # A refusal with its reason is better still.
            continue
        sentences = ineffective_parameters(scene, [*SCENES[kind], name])
        assert (moved == plain) == any(sentence.startswith(f"{name} is set") for sentence in sentences), (
            name,
            sentences,
        )


def test_defaults_are_not_reported():
    scene = Scene.from_parameters({"bending.model": "none"})
    assert ineffective_parameters(scene, scene.parameters()) == []
    assert dump(scene.parameters())


def test_each_parameter_is_reported_once():
    values = {**SCENES["springs"], "bending.stiffness": 7.0}
    scene = Scene.from_parameters(values, files=FILES)
    (sentence,) = ineffective_parameters(scene, values)
    assert sentence == (
        "bending.stiffness is set and has no effect: cloth.springs has stiffnesses and damping of its own, and "
        "bending.model is none"
    )


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"integrator": "symplectic_euler", "work_limit": 2.0}, "work_limit"),
        ({"step": 1e-4, "overload": "relax"}, "overload"),
        ({"tolerance": 0.0, "overload": "relax"}, "overload"),
        ({"coverage.resolution": 0.01}, "coverage.resolution"),
        ({"record.snapshot_period": 1.0}, "record.snapshot_period"),
    ],
)
def test_settings_of_what_is_off_are_reported(values, name):
    (sentence,) = ineffective_parameters(Scene.from_parameters(values), values)
    assert sentence.startswith(f"{name} is set and has no effect: ")
