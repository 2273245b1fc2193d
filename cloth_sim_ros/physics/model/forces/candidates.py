# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The seven candidate springs of a tetrahedron (S9), each as a force of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.engine.binding import checked_indices
from cloth_sim_ros.physics.model.forces.hinge_springs import HingeSprings

#: Kind of each candidate, and its corners in the order of the engine's law: two edges, or a face and a point. Numbers
#: are positions in (edge0, edge1, wing0, wing1). Every order is even; therefore the length keeps its sign.
CANDIDATES: dict[str, tuple[str, tuple[int, int, int, int]]] = {
    "edge-wings": ("edge_edge", (0, 1, 2, 3)),
    "edge0wing0-edge1wing1": ("edge_edge", (0, 2, 3, 1)),
    "edge0wing1-edge1wing0": ("edge_edge", (0, 3, 1, 2)),
    "edge0-face": ("point_face", (2, 1, 3, 0)),
    "edge1-face": ("point_face", (0, 2, 3, 1)),
    "wing0-face": ("point_face", (1, 0, 3, 2)),
    "wing1-face": ("point_face", (0, 1, 2, 3)),
}


class CandidateSprings(HingeSprings):
    """Bending springs on one of a hinge tetrahedron's seven signed distances: three edge-edge, four point-face.

    The signed length is ``h = 6V / M``. M is ``|a x b|`` of the two opposite edges, or of the face below the point. The
    length is positive if the wings rise to the side of the surface's normal.

    Near parallel edges, or a face without area, the force of that candidate grows without limit, and beyond it is zero.
    A sheet that has to recover from such states takes `AltitudeSprings`, the blend of all seven. The candidate
    `edge-wings` is the lecture's S8 as it stands; `CrossedSprings` bounds it.

    Args:
        candidate: a key of `CANDIDATES`: `edge-wings`, two sides of different triangles such as
            `edge0wing0-edge1wing1`, or a corner and the face of the other three such as `wing0-face`.
        hinges: particles (edge0, edge1, wing0, wing1) as in `surface`, shape (m, 4).
        rest_length: signed rest lengths [m], shape (m,) or one number; 0 is flat.
        stiffness: κ̂ [N/m], shape (m,) or one number.
        damping: k_d [N s/m], shape (m,) or one number.
        name: the force's name in a model; the default is that of the candidate.

    Raises:
        ValueError: for an unknown candidate, and as `HingeSprings` does.
    """

    def __init__(
        self,
        candidate: str,
        hinges: ArrayLike,
        rest_length: ArrayLike,
        stiffness: ArrayLike,
        damping: ArrayLike = 0.0,
        *,
        name: str = "",
    ) -> None:
        if candidate not in CANDIDATES:
            raise ValueError(f"candidate is {candidate!r}; there are {', '.join(CANDIDATES)}")
        self.candidate = candidate
        self.kind, order = CANDIDATES[candidate]
        name = name or candidate
        quads = checked_indices(f"hinges of '{name}'", hinges, 4, np.iinfo(np.int64).max)
        super().__init__(quads[:, order], rest_length, stiffness, damping, name=name)
