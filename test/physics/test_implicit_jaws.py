# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Jaws in an implicit step: between the stops they stay on their side of the cloth."""

import numpy as np
import pytest

from cloth_sim_ros.physics.contact import implicit_jaws
from cloth_sim_ros.physics.contact.parallel_jaw import ParallelJaw
from cloth_sim_ros.physics.model.forces.contact import Contact

STEP, STOOD = 0.01, 0.005
PADS = ParallelJaw(
    gripper="hand", size=(0.1, 0.01, 0.1), force=1.0, speed=0.1, friction=(0.0, 0.0), opening=0.02, inertia=0.1
)


def step_jaws_with(rate, cloth, *, passes=False):
    """Return the half opening after a step that began with a jaw speed [m/s].

    The cloth lies between two half openings [m]. `passes`: it is so thin that only a crossing test detects it.
    """
    force = Contact([], thickness=0.002, jaws=[PADS])
    force.set_jaw_commands(np.array([[True, True]]))

    def accelerations(jaws):
        half_openings = jaws[:, 0]
        return np.where((cloth[0] < half_openings) & (half_openings < cloth[1]) & (not passes), np.nan, 0.0)

    def cross(jaws, half_openings):
        middle = 0.5 * sum(cloth)
        return (half_openings - middle) * (jaws[:, 0] - middle) < 0.0

    before = np.array([[STOOD, rate]])
    moved = implicit_jaws.step_jaws(
        force,
        before,
        STEP,
        accelerations=accelerations,
        find_hits=cross if passes else None,
    )
    assert moved[0, 0] == pytest.approx(STOOD + STEP * moved[0, 1])
    return float(moved[0, 0])


def test_jaws_without_load_keep_their_speed():
    assert step_jaws_with(0.3, (1.0, 2.0)) == pytest.approx(STOOD + 0.3 * STEP)


@pytest.mark.parametrize(("rate", "cloth", "stops"), [(0.6, (0.008, 0.009), 0.008), (-0.6, (-0.01, 0.003), 0.003)])
def test_jaws_stop_before_cloth_on_either_side(rate, cloth, stops):
    assert step_jaws_with(rate, cloth) == pytest.approx(stops, abs=1e-9)


@pytest.mark.parametrize(("rate", "cloth", "stops"), [(0.6, (0.008, 0.009), 0.0085), (-0.6, (0.002, 0.003), 0.0025)])
def test_jaws_do_not_jump_over_thin_cloth(rate, cloth, stops):
    assert step_jaws_with(rate, cloth, passes=True) == pytest.approx(stops, abs=1e-9)


def test_jaws_inside_cloth_may_move_outward():
    assert step_jaws_with(0.0, (0.004, 0.006)) == pytest.approx(0.006, abs=1e-9)
