# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drape of specimens: limits of the coefficient, repeatability, plate by contact, mesh error."""

from __future__ import annotations

import attrs
import numpy as np
import pytest

from cloth_sim_ros.laboratory.drape import DrapeTest, coarser_drape, drape, mesh_error
from cloth_sim_ros.laboratory.drape_series import describe, drape_series
from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
from cloth_sim_ros.laboratory.samples import FabricSample, read_sample

COARSE = DrapeTest(edge_length=0.015, loading_time=0.3)
MODULUS = "material.bending_modulus"


def fabric(modulus: float) -> FabricSample:
    return read_sample("wool_twill", {MODULUS: modulus, f"{MODULUS}_weft": 0.0})


def test_stiff_fabric_stays_nearly_flat() -> None:
    # The bending length, 0.14 m, is more than twice the overhang.
    draped = drape(fabric(5e-3), COARSE)
    assert draped.is_converged
    assert draped.coefficient > 0.97


def test_coefficient_grows_with_the_bending_modulus() -> None:
    coefficients = [drape(fabric(modulus), COARSE).coefficient for modulus in (4e-6, 4e-5, 4e-4)]
    assert coefficients == sorted(coefficients)
    assert coefficients[0] < 0.6
    assert coefficients[2] > 0.8


def test_drape_repeats_bit_for_bit() -> None:
    sample = fabric(2e-5)
    first, again = drape(sample, COARSE, seed=3), drape(sample, COARSE, seed=3)
    assert np.array_equal(first.positions, again.positions)


def test_contact_with_the_plate_resembles_a_held_specimen() -> None:
    sample = fabric(1e-4)
    held, draped_by_contact = (
        drape(sample, attrs.evolve(COARSE, edge_length=0.02, contact=contact)) for contact in (False, True)
    )
    assert draped_by_contact.is_converged
    assert draped_by_contact.coefficient == pytest.approx(held.coefficient, abs=0.06)
    middle = np.hypot(*draped_by_contact.mesh.points.T) < 0.05
    assert np.abs(draped_by_contact.positions[middle, 2]).max() < 0.001


def test_contact_agrees_with_a_held_specimen_of_its_folds() -> None:
    sample = fabric(2e-5)
    by_contact = drape(sample, attrs.evolve(COARSE, contact=True))
    held = drape(sample, COARSE, start=by_contact)
    assert by_contact.is_converged
    assert by_contact.shadow.nodes == held.shadow.nodes
    assert by_contact.coefficient == pytest.approx(held.coefficient, abs=0.015)


def test_coarser_drape_keeps_the_folds() -> None:
    sample = fabric(2e-5)
    fine = drape(sample, attrs.evolve(COARSE, edge_length=0.0125))
    coarse = coarser_drape(sample, fine)
    assert coarse.is_converged
    assert len(coarse.mesh.points) < 0.6 * len(fine.mesh.points)
    assert abs(coarse.shadow.nodes - fine.shadow.nodes) <= 1
    assert abs(mesh_error(fine, coarse)) < 0.05


def test_series_states_mean_mesh_error_and_real_value() -> None:
    series = drape_series(fabric(2e-5), COARSE, seeds=[0, 1])
    assert series.coefficient == pytest.approx(np.mean([draped.coefficient for draped in series.drapes]))
    text = describe(series)
    assert "real fabric        34.9 %" in text
    assert "error of the mesh" in text


def test_mesh_error_is_left_out_if_coarser_mesh_does_not_fit() -> None:
    series = drape_series(fabric(1e-4), attrs.evolve(COARSE, edge_length=0.02), seeds=[0])
    assert series.mesh_error is None
    assert "error of the mesh  unknown: it needs edges of at most 16.4 mm" in describe(series)


def test_series_by_contact_has_no_mesh_error() -> None:
    series = drape_series(fabric(1e-4), attrs.evolve(COARSE, edge_length=0.02, contact=True), seeds=[0])
    assert series.mesh_error is None
    assert "error of the mesh" not in describe(series)
    assert "contact with the plate" in describe(series)


def test_plate_larger_than_the_specimen_is_refused() -> None:
    with pytest.raises(LaboratoryError, match="plate"):
        DrapeTest(diameter=0.1, plate_diameter=0.18)
