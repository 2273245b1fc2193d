# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bending moduli along warp and weft, on grids and meshes."""

import math

import attrs
import numpy as np
import pytest

from cloth_sim_ros.physics.model.sheets import thread_bending
from cloth_sim_ros.physics.model.sheets.bending import grid_hinge_constants
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.physics.model.sheets.surface import Surface, grid_hinges, grid_triangles
from cloth_sim_ros.physics.model.sheets.thread_bending import thread_factors

patterns = pytest.importorskip("validation.bending.patterns")


def test_grid_has_a_modulus_of_its_own_along_each_axis():
    spacing = (0.7, 1.1)
    patch = patterns.grid_patch(spacing=spacing)
    size = 7
    hinges = grid_hinges(size, size)
    constants = grid_hinge_constants(hinges, columns=size, spacing=spacing, bending_modulus=(3.0, 0.5))
    known = {tuple(hinge): constant for hinge, constant in zip(hinges.tolist(), constants, strict=True)}
    plate = patterns.plate_moduli(
        attrs.evolve(patch, constants=np.array([known[tuple(hinge)] for hinge in patch.hinges.tolist()]))
    )
    assert (plate.along_x, plate.along_y) == pytest.approx((3.0, 0.5), rel=1e-9)
    assert plate.twist == pytest.approx(0.0, abs=1e-9)


def test_one_surface_with_two_moduli_is_refused():
    hinges = Surface.from_triangles(grid_triangles(5, 5, "left")).hinges
    with pytest.raises(ValueError, match="one surface has one modulus"):
        grid_hinge_constants(hinges, columns=5, spacing=(1.0, 1.0), bending_modulus=(1.0, 2.0))


@pytest.mark.parametrize("angle", [0.0, 15.0, 90.0])
@pytest.mark.parametrize("ratio", [0.5, 3.0])
@pytest.mark.parametrize(("jitter", "error"), [(0.0, 0.005), (0.15, 0.06)])
def test_strips_of_a_mesh_have_the_moduli_of_the_threads(angle, ratio, jitter, error):
    patch = patterns.triangle_patch(jitter, size=8, seed=3)
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    flat = np.concatenate((patch.positions, np.zeros((len(patch.positions), 1))), axis=1)
    moduli = math.sqrt(ratio), 1.0 / math.sqrt(ratio)
    factors = thread_factors(patch.hinges, flat, patch.constants, moduli=moduli, warp=(c, s, 0.0))
    turned = patch.positions @ np.array([[c, -s], [s, c]])
    plate = patterns.plate_moduli(attrs.evolve(patch, positions=turned, constants=patch.constants * factors))
    assert (plate.along_x, plate.along_y) == pytest.approx(moduli, rel=error)


def test_two_moduli_of_a_single_hinge_are_refused():
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    random = np.random.default_rng(1)
    for _ in range(20):
        positions = corners + random.uniform(-0.4, 0.4, (4, 3)) * [1.0, 1.0, 0.0]
        # The tensor of one hinge is singular. Its determinant is a rounding error of either sign.
        with pytest.raises(ValueError, match="do not resist every curvature; use a finer mesh"):
            thread_factors([[1, 2, 0, 3]], positions, np.ones(1), moduli=(1.0, 2.0), warp=(1.0, 0.0, 0.0))


@pytest.mark.parametrize("curvature", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_folds_are_those_of_a_curved_sheet(curvature):
    """Folds measured on the surface z = (κ11 w² + κ22 f² + 2 κ12 w f) / 2 along warp w and weft f."""
    patch = patterns.triangle_patch(0.2, size=6)
    c, s = math.cos(0.4), math.sin(0.4)
    warp, weft = patch.positions @ [c, s], patch.positions @ [-s, c]
    k11, k22, twice_k12 = curvature
    height = 1e-6 * 0.5 * (k11 * warp**2 + k22 * weft**2 + twice_k12 * warp * weft)
    bent = np.concatenate((patch.positions, height[:, None]), axis=1)
    flat = bent * [1.0, 1.0, 0.0]
    # private: the folds under test
    directions = thread_bending._fold_directions(patch.hinges, flat, (c, s, 0.0))
    folds = thread_bending._folds(HingeShape.of(patch.hinges, flat), *directions)
    measured = HingeShape.of(patch.hinges, bent).sine / 1e-6
    assert np.abs(measured) == pytest.approx(np.abs(np.array(curvature) @ folds), abs=1e-4)


def test_equal_moduli_leave_the_constants():
    patch = patterns.triangle_patch(0.2)
    flat = np.concatenate((patch.positions, np.zeros((len(patch.positions), 1))), axis=1)
    factors = thread_factors(patch.hinges, flat, patch.constants, moduli=(2.0, 2.0), warp=(0.0, 1.0, 0.0))
    assert factors == pytest.approx(np.full(len(patch.hinges), 2.0), rel=1e-9)


def test_ratio_beyond_the_hinges_is_refused():
    patch = patterns.triangle_patch(0.0)
    flat = np.concatenate((patch.positions, np.zeros((len(patch.positions), 1))), axis=1)
    with pytest.raises(
        ValueError, match=r"along the weft the hinges .* ratio of at most about 3, a grid, or .*'shape_operator'"
    ):
        thread_factors(patch.hinges, flat, patch.constants, moduli=(1.0, 0.1), warp=(0.0, 1.0, 0.0))
