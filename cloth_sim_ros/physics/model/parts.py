# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of a plan: element lists, spring grids, uniform forces, contact."""

from __future__ import annotations

from typing import Any, TypeAlias

import attrs
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@attrs.frozen(eq=False, kw_only=True)
class ElementList:
    """Elements of one kind for the engine, such as springs or hinges: particles and coefficients of each."""

    #: A key of `engine.binding.KINDS`.
    kind: str
    #: Particles of each element, shape (m, particles of the kind).
    particles: NDArray[np.int64]
    #: Coefficients of each element, shape (m, coefficients of the kind).
    coefficients: Array
    #: Of panels: c_n and c_t [N s/m^3] and the wind [m/s], shape (5,). Of membranes: moduli, viscosities, and growth.
    shared_coefficients: Array | None = None

    @property
    def is_membrane(self) -> bool:
        """True for membrane triangles."""
        return self.kind in ("membrane", "stiffening_membrane")


@attrs.frozen(kw_only=True)
class GridFamily:
    """Springs of a grid in one direction: stiffness, rest length, damping, border factor and parity.

    Attributes:
        name: right, down, diagonal, antidiagonal, right2 or down2; rows are counted downwards, columns to the right.
        stiffness: k_s [N], force per strain.
        rest_length: rest length [m].
        damping: k_d [N s/m].
        border: factor on k_s and k_d of the threads along the sheet's border.
        parity: 0 or 1 keeps only springs in cells with even or odd row + column; None keeps all.
    """

    name: str
    stiffness: float
    rest_length: float
    damping: float = 0.0
    border: float = 1.0
    parity: int | None = None


@attrs.frozen(kw_only=True)
class SpringGrid:
    """Springs of a sheet of rows x columns particles; particle indices are row * columns + column."""

    rows: int
    columns: int
    families: tuple[GridFamily, ...]


@attrs.frozen(eq=False, kw_only=True)
class UniformForces:
    """Forces that act on every particle alike: accelerations [m/s^2] of gravity and wind, and a drag rate [1/s]."""

    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drag: float = 0.0


@attrs.frozen(eq=False, kw_only=True)
class ContactPart:
    """Contact of all particles with obstacles and the cloth; the plan reads obstacles and paths in every frame."""

    #: A `forces.contact.Contact`, whose module imports this one.
    contact: Any


Part: TypeAlias = ElementList | SpringGrid | UniformForces | ContactPart


def min_damping_time(stiffness: Any, damping: Any) -> float:
    """Return the least ratio c / k [s] of damping [N s/m] to stiffness [N/m]; infinity if no stiffness is above 0."""
    k, c = np.asarray(stiffness, dtype=float), np.asarray(damping, dtype=float)
    is_stiff = k > 0.0
    return float((c[is_stiff] / k[is_stiff]).min()) if is_stiff.any() else np.inf
