# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Largest strain of a cloth, for diagnostics."""

from __future__ import annotations

import numpy as np

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.scene.scene import Scene

#: Largest number of edges that are measured; more would delay frames.
MAX_EDGES = 400_000


class StrainGauge:
    """Gauge of the largest elongation of triangles' edges relative to their rest lengths."""

    def __init__(self, scene: Scene) -> None:
        sheet = scene.sheet
        triangles = sheet.triangles()
        edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        edges = np.unique(np.sort(edges, axis=1), axis=0)
        rest_positions = sheet.positions()
        lengths = np.linalg.norm(rest_positions[edges[:, 1]] - rest_positions[edges[:, 0]], axis=1)
        self._starts, self._ends = np.ascontiguousarray(edges[lengths > 0.0].T)
        self._inverse_squares = lengths[lengths > 0.0] ** -2.0

    def largest(self, x: Array) -> float | None:
        """Return the largest relative elongation of an edge at x [m], (3, n); None for no edges or too many."""
        if not 0 < len(self._inverse_squares) <= MAX_EDGES:
            return None
        # One component at a time and one root at the end: a quarter of the time.
        squares = np.zeros(len(self._inverse_squares))
        for component in x:
            edge = component.take(self._ends)
            edge -= component.take(self._starts)
            edge *= edge
            squares += edge
        squares *= self._inverse_squares
        return float(np.sqrt(squares.max()) - 1.0)
