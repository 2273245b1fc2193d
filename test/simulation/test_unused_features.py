# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A scene runs nothing that it does not use: calls of the engine, memory and modules, counted."""

import pytest
from support.feature_variants import Running, variants
from support.frame_counts import MARKERS, bytes_of_a_frame, calls_of_a_frame, modules_of

#: Engine calls of a frame with a fixed number of steps, by name. One call takes the steps, checks that the state is
#: finite, and gives the limits for the next steps.
NEEDED = {"frame": 1}
VARIANTS = {variant.name: variant for variant in variants()}


def running(name, resolution=16):
    return Running(VARIANTS[name], resolution).simulation


@pytest.mark.parametrize(
    "name",
    [
        "damping: absent",
        "drag: absent",
        "gravity: absent",
        "bending: absent",
        "gripper: absent",
        "energy balance: absent",
        "error control: absent",
    ],
)
def test_a_frame_is_one_call_of_the_engine(name):
    assert calls_of_a_frame(running(name)) == NEEDED


@pytest.mark.parametrize("presence", ["idle", "active, holding", "active, turning"])
def test_a_gripper_is_part_of_it(presence):
    # Its path is planned, and the engine told where it leads.
    assert calls_of_a_frame(running(f"gripper: {presence}")) == NEEDED | {"paths": 1, "plan_gripper_paths": 1}


def test_error_control_adds_a_look_at_the_end():
    more = calls_of_a_frame(running("error control: active"), frames=1)
    assert set(more) - set(NEEDED) <= {"distance", "combine", "spectral_bounds"}


def test_a_sleeping_frame_calls_nothing_and_takes_no_memory():
    asleep = running("sleep: active, asleep")
    assert calls_of_a_frame(asleep, frames=5) == {}
    needed, retained = bytes_of_a_frame(asleep)
    assert needed < 2000
    assert retained < 1000


def test_a_frame_takes_the_room_of_the_state_that_it_makes():
    simulation = running("gripper: absent", 32)
    needed, retained = bytes_of_a_frame(simulation)
    state = simulation.state.x.nbytes + simulation.state.v.nbytes
    # The new positions and velocities; the old ones go.
    assert needed < 1.3 * state
    assert retained < 4000


def test_springs_of_a_sheet_have_no_lists():
    simulation = running("sleep: idle, moving")
    assert not [force.name for force in simulation.model.forces if {"pairs", "listed"} & vars(force).keys()]


@pytest.mark.parametrize(
    ("values", "used"),
    [
        ({}, set()),
        (
            {"bending.model": "crossed", "material.bending_modulus": 1e-5, "cloth.resolution": [5, 5]},
            {"bending springs across hinges"},
        ),
        ({"integrator": "implicit", "cloth.resolution": [5, 5]}, {"implicit steps"}),
        ({"diagnostics.energy": True, "cloth.resolution": [5, 5]}, {"energy balance"}),
    ],
    ids=["default", "crossed", "implicit", "energy"],
)
def test_a_scene_loads_the_modules_that_it_uses(values, used):
    loaded = modules_of(values)
    assert {feature for feature, markers in MARKERS.items() if any(marker in loaded for marker in markers)} == used
