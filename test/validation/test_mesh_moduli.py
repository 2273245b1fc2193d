# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Moduli of sheets of triangles over random meshes."""

import numpy as np
import pytest

from validation.bending.patterns import periodic_triangulation
from validation.moduli.mesh import measure_moduli


@pytest.mark.parametrize("relaxed", [True, False])
def test_moduli_of_a_regular_periodic_patch_are_those_asked_for(relaxed):
    moduli = measure_moduli(periodic_triangulation(0.0), relaxed=relaxed)
    assert (moduli.along_x, moduli.along_y, moduli.shear, moduli.poisson) == pytest.approx(
        (1.0, 1.0, 1.0, 1.0), rel=1e-9
    )


def test_irregular_triangles_deviate_by_what_the_docs_say():
    """0.3 of a side: mean Young's modulus 0.898, mean shear modulus 0.887 of the nominal ones (docs/springs.md)."""
    meshes = [periodic_triangulation(0.3, seed=seed) for seed in range(12)]
    moduli = [measure_moduli(mesh) for mesh in meshes]
    # Three standard errors of a dozen meshes whose standard deviation is 0.02.
    assert np.mean([mesh_moduli.along_x for mesh_moduli in moduli]) == pytest.approx(0.898, abs=0.02)
    assert np.mean([mesh_moduli.shear for mesh_moduli in moduli]) == pytest.approx(0.887, abs=0.02)
    # A constraint of the vertices to the strain can only make the sheet stiffer.
    assert all(
        mesh_moduli.along_x < measure_moduli(mesh, relaxed=False).along_x
        for mesh_moduli, mesh in zip(moduli, meshes, strict=True)
    )
