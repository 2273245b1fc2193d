# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bending calibration: hinge shapes, moduli of the plate, and the limits of S7."""

import math

import numpy as np
import pytest
from support.alone import alone
from support.alone import force as force_of

from cloth_sim_ros.physics.model.forces.hinge_springs import signed_lengths
from cloth_sim_ros.physics.model.forces.opposite import OppositeSprings
from cloth_sim_ros.physics.model.sheets.bending import (
    added_membrane_stiffness,
    bending_terms,
    grid_hinge_constants,
    mesh_hinge_constants,
    spring_constants,
)
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape
from cloth_sim_ros.physics.model.sheets.surface import Surface, grid_diagonals, grid_hinges, grid_triangles
from validation.bending.patterns import grid_patch, plate_moduli, triangle_patch
from validation.bending.recovery import REST_TRIANGLES, rest_shape

PAIR = np.array([[0, 1, 2, 3]])
KINDS = ("crossed", "altitude")


def energy_of(forces, positions):
    """Return the energy [J] of particles (n, 3)."""
    return alone(*forces, count=len(positions)).energies(0.0, np.ascontiguousarray(positions.T), None)[1]


def pair_shape(name="equilateral", angle=0.0):
    return HingeShape.of(PAIR, rest_shape(name, angle))


@pytest.mark.parametrize("kind", KINDS)
def test_lengths_of_a_hinge_shape_are_those_of_its_particles(kind):
    x = np.random.default_rng(0).standard_normal((80, 3))
    hinges = np.arange(80).reshape(-1, 4)
    shape = HingeShape.of(hinges, x)
    assert shape.length(kind) == pytest.approx(signed_lengths(hinges, x.T, kind=kind), rel=1e-10)
    assert shape.wing_distance() == pytest.approx(np.linalg.norm(x[3::4] - x[2::4], axis=1), rel=1e-12)
    step = 1e-6
    angle = np.arctan2(shape.sine, shape.cosine)
    up, down = shape.folded(angle + step), shape.folded(angle - step)
    assert shape.length_slope(kind) == pytest.approx((up.length(kind) - down.length(kind)) / (2 * step), abs=1e-8)
    slope = (up.wing_distance() - down.wing_distance()) / (2 * step)
    assert shape.wing_distance_slope() == pytest.approx(slope, abs=1e-8)
    folds = [shape.folded(angle) for angle in np.linspace(-math.pi, math.pi, 4001)]
    highest = np.max([fold.length(kind) for fold in folds], axis=0)
    distances = [fold.wing_distance() for fold in folds]
    half = 0.5 * (np.max(distances, axis=0) - np.min(distances, axis=0))
    assert shape.half_range_ratio(kind) == pytest.approx(highest / half, rel=1e-5)


@pytest.mark.parametrize("angle", [-2.5, -0.3, 0.0, 1.0, 3.0])
def test_the_fold_angle_is_signed(angle):
    shape = pair_shape("scalene", angle)
    assert (shape.sine, shape.cosine) == (pytest.approx(math.sin(angle)), pytest.approx(math.cos(angle)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", REST_TRIANGLES)
@pytest.mark.parametrize("angle", [0.0, 0.5, 1.2, 2.1, -0.7])
def test_fold_energy_is_half_hinge_constant_times_angle_squared(kind, name, angle):
    rest_positions = rest_shape(name, angle)
    forces = bending_terms(kind, PAIR, rest_positions, hinge_constants=[3.0])
    step = 1e-4

    def energy(fold):
        return energy_of(forces, rest_shape(name, fold))

    # the mean of both sides has no cubic part, and two steps leave no quartic one
    single, double = (0.5 * (energy(angle + k * step) + energy(angle - k * step)) for k in (1, 2))
    quadratic = (16 * single - double) / 12
    assert quadratic / (0.5 * step**2) == pytest.approx(3.0, rel=1e-6)
    assert energy(angle) == pytest.approx(0.0, abs=1e-20)


def test_the_hinges_of_a_grid_are_a_plate_without_poissons_ratio():
    for spacing in [(1.0, 1.0), (0.4, 1.0), (1.0, 0.1)]:
        plate = plate_moduli(grid_patch(spacing=spacing))
        for modulus in (plate.along_x, plate.along_y, plate.cylindrical, plate.isotropy):
            assert modulus == pytest.approx(1.0, rel=1e-9)
        assert (plate.poisson, plate.twist) == pytest.approx((0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize("layout", ["left", "right", "alternating", "both"])
@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 1.0)])
def test_single_triangulation_has_the_modulus_in_free_strips(layout, spacing):
    plate = plate_moduli(grid_patch(layout, spacing=spacing))
    assert (plate.along_x, plate.along_y) == pytest.approx((1.0, 1.0), rel=1e-9)
    if spacing == (1.0, 1.0):
        # as documented in docs/bending.md: a checkerboard has a Poisson's ratio, one family of diagonals twists
        twist = {"left": -1 / 3, "right": 1 / 3}.get(layout, 0.0)
        assert plate.twist == pytest.approx(twist, abs=1e-9)
        assert plate.poisson == pytest.approx(0.0 if twist else -1 / 3, abs=1e-9)


def test_triangle_bending_moduli_deviate_as_documented():
    plate = plate_moduli(triangle_patch(0.0))
    moduli = (plate.along_x, plate.along_y, plate.cylindrical, plate.poisson, plate.isotropy)
    assert moduli == pytest.approx((1.0, 1.0, 1.125, -1 / 3, 1.0), rel=1e-9)
    for jitter, least, most in [(0.1, 1.0, 1.02), (0.2, 1.02, 1.07), (0.4, 1.05, 1.25)]:
        along = [plate_moduli(triangle_patch(jitter, seed=seed)).along_x for seed in range(3)]
        assert least < np.mean(along) < most


def test_hinge_constants_do_not_change_under_refinement():
    coarse = grid_hinge_constants(grid_hinges(5, 5), columns=5, spacing=(0.2, 0.2), bending_modulus=1e-3)
    fine = grid_hinge_constants(grid_hinges(9, 9), columns=9, spacing=(0.1, 0.1), bending_modulus=1e-3)
    assert set(np.round(coarse, 12)) == set(np.round(fine, 12)) == {0.0005}


def test_opposite_springs_have_quartic_energy_and_cubic_moment():
    # equal heights, feet together: E = k L θ⁴/128 and moment k L θ³/32, k the force per strain
    k_s, distance = 2.0, 2.0 * REST_TRIANGLES["checkerboard edge"][1]
    springs = OppositeSprings(PAIR[:, 2:], distance, k_s)

    def energy(angle):
        return energy_of([springs], rest_shape("checkerboard edge", angle))

    for angle in (0.02, 0.04):
        assert energy(angle) == pytest.approx(k_s * distance * angle**4 / 128, rel=angle**2)
        moment = (energy(angle * 1.001) - energy(angle * 0.999)) / (0.002 * angle)
        assert moment == pytest.approx(k_s * distance * angle**3 / 32, rel=angle**2)


def flattened(name="equilateral"):
    return np.ascontiguousarray(rest_shape(name, 0.0).T)


def force(forces, x):
    return force_of(alone(*forces, count=x.shape[1]), x)


def test_opposite_springs_have_no_preferred_side_when_coplanar():
    rest_positions = rest_shape("equilateral", math.radians(60))
    (opposite,) = bending_terms("opposite", PAIR, rest_positions, spring_stiffness=1.0)
    # coplanar: the force lies in the plane, although the rest shape is folded
    assert np.abs(force([opposite], flattened())).max() > 0.01
    assert force([opposite], flattened())[2] == pytest.approx(0.0, abs=1e-15)
    # bent the wrong way: at rest
    mirror = np.ascontiguousarray(rest_shape("equilateral", math.radians(-60)).T)
    assert force([opposite], mirror) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_second_spring_lifts_a_coplanar_pair_to_the_right_side(kind):
    forces = bending_terms(kind, PAIR, rest_shape("equilateral", math.radians(60)), hinge_constants=[1.0])
    for x in (flattened(), np.ascontiguousarray(rest_shape("equilateral", math.radians(-60)).T)):
        lift = force(forces, x)[2]
        assert (lift[2:] > 0.1).all()
        assert (lift[:2] < -0.1).all()
    flat = bending_terms(kind, PAIR, rest_shape("equilateral", 0.0), hinge_constants=[1.0])
    # near flat the moment is linear in the fold, where S7's is cubic
    energy1, energy2 = (energy_of(flat, rest_shape("equilateral", angle)) for angle in (1e-3, 2e-3))
    assert energy2 / energy1 == pytest.approx(4.0, rel=1e-4)


def test_opposite_springs_skip_existing_pairs():
    rows, columns = 4, 5
    row, column = np.divmod(np.arange(rows * columns), columns)
    rest_positions = np.stack((column, row, 0 * row), axis=1).astype(float)
    shear = grid_diagonals(rows, columns, "both")
    surface = Surface.from_triangles(grid_triangles(rows, columns, "both"))
    (every,) = bending_terms("opposite", surface.hinges, rest_positions, spring_stiffness=1.0)
    (without,) = bending_terms("opposite", surface.hinges, rest_positions, spring_stiffness=1.0, existing=shear)
    assert len(every.pairs) - len(without.pairs) == (rows - 1) * (columns - 1)
    assert not {tuple(p) for p in np.sort(shear, axis=1).tolist()} & {tuple(p) for p in without.pairs.tolist()}


def test_rest_angles_come_from_the_mesh_or_from_the_scene():
    rest_positions = rest_shape("scalene", 0.8)
    _, from_mesh = bending_terms("crossed", PAIR, rest_positions, hinge_constants=[1.0])
    _, from_angle = bending_terms("crossed", PAIR, rest_shape("scalene", 0.0), hinge_constants=[1.0], rest_angle=0.8)
    assert from_angle.rest_length == pytest.approx(from_mesh.rest_length, rel=1e-12)
    assert from_angle.stiffness == pytest.approx(from_mesh.stiffness, rel=1e-12)


def test_springs_of_one_pair_merge_and_add_their_stiffness():
    hinges = grid_hinges(3, 3)
    row, column = np.divmod(np.arange(9), 3)
    rest_positions = np.stack((column, row, 0 * row), axis=1).astype(float)
    constants = grid_hinge_constants(hinges, columns=3, spacing=(1.0, 1.0), bending_modulus=1.0)
    opposite, _ = bending_terms("crossed", hinges, rest_positions, hinge_constants=constants)
    assert len(np.unique(opposite.pairs, axis=0)) == len(opposite.pairs)
    _, k7 = spring_constants("crossed", HingeShape.of(hinges, rest_positions), constants)
    assert opposite.rigidity.sum() == pytest.approx(k7.sum())


def test_added_membrane_stiffness_follows_from_the_energy():
    hinges = grid_hinges(4, 5)
    row, column = np.divmod(np.arange(20), 5)
    rest_positions = np.stack((column * 0.1, row * 0.2, 0 * row), axis=1)
    constants = grid_hinge_constants(hinges, columns=5, spacing=(0.1, 0.2), bending_modulus=1e-3)
    opposite, _ = bending_terms("altitude", hinges, rest_positions, hinge_constants=constants)
    area = 0.4 * 0.6
    added = added_membrane_stiffness(opposite, rest_positions, area=area)
    strain = 1e-5
    for which, stretch in enumerate(
        [np.diag([1, 0, 0]), np.diag([0, 1, 0]), np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]])]
    ):
        energies = [energy_of([opposite], rest_positions @ (np.eye(3) + sign * strain * stretch)) for sign in (1, -1)]
        assert np.mean(energies) == pytest.approx(0.5 * added[which] * strain**2 * area, rel=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_critical_damping_of_two_equal_free_ends_is_root_two(kind):
    # only the wings of this pair can move, along the gradient: the decrement of the hinge's mode gives k_d0
    rest_positions, mass, k_d0 = rest_shape("checkerboard edge", 0.4), np.array([0.2, 0.3, 0.4, 0.5]), 0.7
    _, springs = bending_terms(kind, PAIR, rest_positions, hinge_constants=[1.0], damping=k_d0, masses=mass)
    x = np.ascontiguousarray(rest_positions.T)
    step = 1e-6
    gradient = np.zeros_like(x)
    for index in np.ndindex(x.shape):
        up, down = x.copy(), x.copy()
        up[index] += step
        down[index] -= step
        gradient[index] = (springs.lengths(up)[0] - springs.lengths(down)[0]) / (2 * step)
    reduced = 1.0 / np.sum(gradient**2 / mass)
    ratio = springs.damping[0] / (2.0 * math.sqrt(springs.stiffness[0] * reduced))
    assert ratio * math.sqrt(2.0) == pytest.approx(k_d0, rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("opposite", {"hinge_constants": [1.0]}), "'opposite' has no bending modulus: near flat .* fourth power"),
        (("opposite", {}), "'opposite' needs spring_stiffness"),
        (("crossed", {"spring_stiffness": 1.0}), "'crossed' takes hinge_constants"),
        (("altitude", {"hinge_constants": [-1.0]}), "hinge constants are -1.0 at hinge 0"),
        (("altitude", {"hinge_constants": [1.0, 2.0]}), r"hinge constants are of shape \(2,\)"),
        (("altitude", {"hinge_constants": [1.0], "ratio": 0.0}), "ratio is 0.0; it must be finite and above 0"),
        (("altitude", {"hinge_constants": [1.0], "rest_angle": 3.2}), "rest_angle is 3.2 rad"),
        (("altitude", {"hinge_constants": [1.0], "rest_angle": math.nan}), "rest_angle is nan rad"),
        (("altitude", {"hinge_constants": [1.0], "damping": 0.1}), "damping is 0.1 without masses"),
    ],
)
def test_mismatched_parameters_are_refused(arguments, words):
    model, options = arguments
    with pytest.raises(ValueError, match=words):
        bending_terms(model, PAIR, rest_shape("equilateral", 0.0), **options)


def test_moduli_and_shapes_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"bending_modulus is -1\.0"):
        mesh_hinge_constants(PAIR, rest_shape("equilateral", 0.0), bending_modulus=-1.0)
    with pytest.raises(ValueError, match="spacing is"):
        grid_hinge_constants(PAIR, columns=2, spacing=(0.0, 1.0), bending_modulus=1.0)
    with pytest.raises(ValueError, match=r"hinge 0 .* has a triangle without area"):
        HingeShape.of(PAIR, [[0, 0, 0], [0, 1, 0], [0, 2, 0], [1, 0, 0]])
