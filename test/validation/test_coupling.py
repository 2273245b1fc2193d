# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A wrist that feels the cloth's force some frames later."""

from __future__ import annotations

import pytest

from validation.stability.coupling import CoupledWrist, predicted_damping

MASS, HOLDER, MODULUS = 2.0, 1000.0, 200.0


@pytest.mark.parametrize("n_frames", [0, 3])
def test_border_of_stability_is_the_predicted_one(n_frames: int) -> None:
    wrist = CoupledWrist(MODULUS, is_free=False, n_frames=n_frames)
    stiffness = -wrist.force_at(1e-3) / 1e-3
    damping = predicted_damping(stiffness, (n_frames + 1) * wrist.period)
    for factor, is_stable in ((0.8, False), (1.2, True)):
        wrist = CoupledWrist(MODULUS, is_free=False, n_frames=n_frames)
        assert wrist.is_stable(MASS, factor * damping, HOLDER) == is_stable


def test_a_hand_much_lighter_than_the_cloth_is_unstable() -> None:
    def is_stable(mass: float) -> bool:
        return CoupledWrist(MODULUS, is_free=True, n_frames=0).is_stable(mass, 10.0 * mass, 25.0 * mass)

    sheet = 0.2 * 0.2 * 0.2
    assert is_stable(3.0 * sheet)
    assert not is_stable(0.2 * sheet)
