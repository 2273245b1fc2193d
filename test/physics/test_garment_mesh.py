# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The T-shirt of `support.garment`: one clean sheet, the same every time."""

import numpy as np
import pytest
from support import garment

from cloth_sim_ros.physics.model.sheets.surface import Surface


@pytest.mark.parametrize("vertices", [150, 1460])
def test_the_shirt_is_one_clean_sheet_of_the_size_asked_for(vertices: int) -> None:
    places, triangles = garment.mesh(vertices)
    assert abs(len(places) - vertices) <= 0.03 * vertices
    surface = Surface.from_triangles(triangles, particle_count=len(places))
    assert surface.pieces().max() == 0
    # One border, no hole: vertices - edges + faces is that of a disc.
    assert len(places) - len(surface.edges) + len(triangles) == 1
    x, y = garment.outline().T
    area = 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))
    a, b, c = (places[triangles[:, k]][:, [0, 2]] for k in range(3))
    (ux, uy), (wx, wy) = (b - a).T, (c - a).T
    assert 0.5 * float(np.abs(ux * wy - uy * wx).sum()) == pytest.approx(area, rel=0.03)


def test_the_shirt_is_the_same_every_time() -> None:
    garment.mesh.cache_clear()
    first = garment.obj_file(200)
    garment.mesh.cache_clear()
    assert garment.obj_file(200) == first
