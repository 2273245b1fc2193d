# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Identity of the cloth that a state belongs to.

It distinguishes cloths with equal numbers of particles.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.raw import RawSprings
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.physics_scene import Sheet

#: Upper bound of a fingerprint, which must fit into a signed integer of 64 bits.
_MAX_FINGERPRINT = (1 << 63) - 1


def topology_id(sheet: Sheet) -> tuple[int, int, int]:
    """Return rows, columns and a fingerprint of the connections, which identify the cloth of a state.

    Without a grid, rows is 1 and columns is the number of particles.
    The fingerprint of a grid is 0. Size, material and the layout of a grid's diagonals are left out, because a draped
    cloth may continue as a stiffer one.
    """
    if isinstance(sheet, GridSheet):
        return sheet.rows, sheet.columns, 0
    return 1, len(sheet.positions()), _fingerprint(sheet)


def difference(state: State, cloth: tuple[int, int, int]) -> str:
    """Return the difference of a state's cloth from a topology id, as the end of a sentence; empty if it fits.

    A state without a cloth's identity fits any cloth with its number of particles.
    """
    rows, columns, connections = cloth
    if state.particle_count != rows * columns:
        return f"has {state.particle_count} particles, the cloth {rows * columns}"
    if state.cloth is None or state.cloth == cloth:
        return ""
    if state.cloth[2] == connections:
        return f"is of a grid of {state.cloth[0]} x {state.cloth[1]} particles, the cloth has {rows} x {columns}"
    if state.cloth[2] and connections:
        return "is of a mesh, or of springs, that connect their particles otherwise than the cloth's"
    return "is of a grid, the cloth is none" if connections else "is of a mesh, or of springs, the cloth is a grid"


@lru_cache(maxsize=8)
def _fingerprint(sheet: MeshSheet | RawSprings) -> int:
    import xxhash

    hasher = xxhash.xxh3_64(np.ascontiguousarray(sheet.triangles(), dtype="<i8").tobytes())
    if isinstance(sheet, RawSprings):
        hasher.update(np.ascontiguousarray(sheet.term.pairs, dtype="<i8").tobytes())
    # Never 0, which stands for a grid.
    return 1 + int(hasher.intdigest()) % _MAX_FINGERPRINT
