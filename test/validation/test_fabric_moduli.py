# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Strips at angles to the warp have the moduli of laminate theory, and patches move affinely."""

import pytest

from validation.moduli.fabric import (
    ANGLES,
    MAX_PATCH_ERROR,
    MAX_STRIP_ERROR,
    MESHES,
    WARP,
    WEFT,
    flat_sheet,
    laminate_modulus,
    patch_error,
    strip_modulus,
)


def test_laminate_theory_ends_at_warp_and_weft():
    assert laminate_modulus(0.0) == pytest.approx(WARP)
    assert laminate_modulus(90.0) == pytest.approx(WEFT)


@pytest.mark.parametrize("mesh", MESHES)
@pytest.mark.parametrize("angle", ANGLES)
def test_strip_has_the_modulus_of_laminate_theory(mesh, angle):
    assert strip_modulus(flat_sheet(mesh, angle, cells=3)) == pytest.approx(
        laminate_modulus(angle), rel=MAX_STRIP_ERROR
    )


@pytest.mark.parametrize("mesh", MESHES)
def test_patch_moves_affinely(mesh):
    assert patch_error(flat_sheet(mesh, 30.0, cells=4, length=0.2)) < MAX_PATCH_ERROR
