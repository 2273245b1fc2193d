# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rest angles of single hinges, by their edges."""

from __future__ import annotations

import math
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.sheets.tables import checked_column, checked_table, pair_rows

_KEYS = ("edges", "angles")


@attrs.frozen(eq=False, kw_only=True)
class RestAngles:
    """Rest fold angles of single hinges, each named by its edge."""

    #: The two particles of each edge, in any order, shape (m, 2).
    edges: NDArray[np.int64]
    #: Folds [rad], positive to the side of the surface's normal, shape (m,).
    angles: Array

    @classmethod
    def from_tables(cls, tables: dict[str, Any]) -> RestAngles:
        """Return rest angles from the tables `edges` (m, 2) and `angles` [rad], one number or m.

        Raises:
            ValueError: naming the table and the fault.
        """
        for name in (*sorted(set(tables) - set(_KEYS)), *_KEYS):
            if name not in _KEYS:
                raise ValueError(f"unknown table '{name}'; there are {', '.join(_KEYS)}")
            if name not in tables:
                raise ValueError(f"table '{name}' is missing")
        edges = checked_table("edges", tables["edges"], np.int64, 2)
        angles = checked_column("angles", tables["angles"], len(edges))
        wrong = np.flatnonzero(~(np.abs(angles) < math.pi))
        if wrong.size:
            raise ValueError(
                f"row {wrong[0]} of table 'angles' is {angles[wrong[0]]} rad; it must lie between -π and π"
            )
        rows: dict[frozenset[int], int] = {}
        for row, edge in enumerate(map(frozenset, edges.tolist())):
            if rows.setdefault(edge, row) != row:
                raise ValueError(f"rows {rows[edge]} and {row} of table 'edges' are one edge; give it once")
        return cls(edges=edges, angles=angles)

    def of_hinges(self, hinges: NDArray[np.int64]) -> Array:
        """Return the rest angle of each hinge (h, 4) [rad], NaN without one, (h,); refuse an edge without hinge.

        Raises:
            ValueError: for an edge without hinge.
        """
        missing = np.flatnonzero(pair_rows(hinges[:, :2], self.edges) < 0)
        if missing.size:
            raise ValueError(
                f"row {missing[0]} of table 'edges' is {self.edges[missing[0]].tolist()}, which is no edge between two "
                "triangles of the cloth; remove it"
            )
        rows = pair_rows(self.edges, hinges[:, :2])
        angles = np.full(len(hinges), np.nan)
        angles[rows >= 0] = self.angles[rows[rows >= 0]]
        return angles
