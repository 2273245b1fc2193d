# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of ten thousand perturbed triangle pairs by S9; S7 alone fails, and sometimes S8."""

import math

import numpy as np
import pytest

from validation.bending.recovery import REST_TRIANGLES, STARTS, rest_shape, simulate_recovery, start_positions

#: Starts of each kind and each rest shape by the edges' stiffness: 10,200 for a rest angle, and 1,500 of stiff edges,
#: whose steps are a third as long.
COUNTS = {10.0: 340, 100.0: 50}


@pytest.mark.parametrize("edge_stiffness", COUNTS)
@pytest.mark.parametrize("degrees", [0.0, 60.0, 120.0])
def test_altitude_springs_recover_every_start(degrees, edge_stiffness):
    total, missed = 0, []
    for name in REST_TRIANGLES:
        rest_positions = rest_shape(name, math.radians(degrees))
        for kind in STARTS:
            begin = start_positions(
                kind,
                rest_positions,
                COUNTS[edge_stiffness],
                np.random.default_rng([round(degrees), len(name), len(kind)]),
            )
            came = simulate_recovery(begin, rest_positions, edge_stiffness=edge_stiffness)
            total += came.starts
            if came.missed:
                missed.append((name, kind, came.missed))
            # there is no switch: in the last tenth of every motion the energy only falls, up to rounding
            assert came.late_energy_rise < 1e-15
    assert total == 30 * COUNTS[edge_stiffness]
    assert missed == []


@pytest.mark.parametrize("degrees", [0, 30, 75, 85, 105, 150, -60])
def test_altitude_springs_recover_at_other_rest_angles(degrees):
    for name in REST_TRIANGLES:
        rest_positions = rest_shape(name, math.radians(degrees))
        for kind in STARTS:
            assert (
                simulate_recovery(
                    start_positions(kind, rest_positions, 20, np.random.default_rng(1)), rest_positions
                ).missed
                == 0
            ), (
                name,
                kind,
            )


def test_planar_starts_recover_from_a_small_perturbation():
    rest_positions = rest_shape("equilateral", 0.0)
    swapped = rest_positions[[0, 1, 3, 3]] + np.array(
        [[0, 0, 0], [0, 0, 0], [0.05, 0.1, 0], [0, 0, 0]]
    )  # both wings on one side
    stuck = simulate_recovery(swapped[None].copy(), rest_positions)
    assert stuck.missed == 1  # no force leaves the plane
    pushed = swapped.copy()
    pushed[2, 2] += 1e-6
    assert simulate_recovery(pushed[None], rest_positions).missed == 0


def test_recovery_fails_at_a_wrong_stiffness_ratio():
    # S8's length falls to zero where a pair of unequal triangles is folded shut, and holds it there
    rest_positions = rest_shape("scalene", 0.0)
    begin = start_positions("folded", rest_positions, 50, np.random.default_rng(0))
    assert simulate_recovery(begin, rest_positions, model="crossed", ratio=4.0, limit=5000).missed == 50
    # too weak an altitude spring leaves the mirror image to S7
    folded = rest_shape("equilateral", math.radians(120))
    begin = start_positions("inverted", folded, 50, np.random.default_rng(0))
    assert simulate_recovery(begin, folded, ratio=0.05, limit=5000).missed > 40
