# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Thread stiffnesses of a grid from the moduli of a sheet.

A family of threads has a stiffness k_s [N], a direction d and a spacing w. It acts like a sheet with the modulus tensor
(k_s / w) d d d d. The sums over the families of a grid follow; docs/springs.md derives them. The grid has spacings hx,
hy and diagonals of length l.

- Diagonals `both` or `alternating`: C66 = C12 = G, C11 = E_x + G (hx/hy)^2, C22 = E_y + G (hy/hx)^2.
- They have a Young's modulus Y along both axes if C11 = C22 = (Y + sqrt(Y^2 + 4 G^2)) / 2.
- Diagonals `left` or `right`: an axial pull also shears, which unloads the single diagonal family: Y = E_x = E_y.
"""

from __future__ import annotations

import math

import attrs

from cloth_sim_ros.physics.model.sheets.surface import Layout


@attrs.frozen(kw_only=True)
class Threads:
    """Spring stiffnesses of a grid, force per strain k_s [N], for threads inside the sheet.

    Border threads carry half.
    """

    along_rows: float
    along_columns: float
    diagonal: float
    bend_along_rows: float
    bend_along_columns: float
    #: Poisson's ratio of the sheet along its axes. The moduli fix it; a network of springs can't choose it freely.
    poisson_ratio: float


def grid_threads(
    *,
    stretch_modulus: float,
    shear_modulus: float,
    spacing: tuple[float, float],
    layout: Layout,
    bend_stiffness: float = 0.0,
) -> Threads:
    """Return the threads of a rectangular grid that make a sheet of the given moduli.

    Args:
        stretch_modulus: Young's modulus Y of the sheet along its axes [N/m], above 0.
        shear_modulus: shear modulus G [N/m], at least 0.
        spacing: distance of neighbours along a row and along a column, hx and hy [m].
        layout: diagonals of the cells that are springs.
        bend_stiffness: stiffness B [N/m] of the springs two apart along both axes (bending `axial`), k_s = B times the
            thread spacing. Two of them overlap everywhere along a thread and add 2 B to the axial stiffness. The edge
            springs are weakened by that.

    Raises:
        ValueError: if no edge springs of positive stiffness give these moduli.
    """
    hx, hy = spacing
    # Products, not powers: a library's pow and hypot differ in the last bit from machine to machine.
    diagonal = math.sqrt(hx * hx + hy * hy)
    families = 2.0 if layout == "both" else 1.0
    k_diagonal = shear_modulus * (diagonal * diagonal * diagonal) / (families * hx * hy)
    if layout in ("left", "right"):
        axial_x = axial_y = stretch_modulus
        poisson = 0.0
    else:
        root = math.sqrt(stretch_modulus * stretch_modulus + 4.0 * (shear_modulus * shear_modulus))
        axial = 0.5 * (stretch_modulus + root)
        axial_x = axial - shear_modulus * (hx / hy * (hx / hy))
        axial_y = axial - shear_modulus * (hy / hx * (hy / hx))
        poisson = shear_modulus / axial
    axial_x -= 2.0 * bend_stiffness
    axial_y -= 2.0 * bend_stiffness
    if not min(axial_x, axial_y) > 0.0:
        raise ValueError(
            f"no edge springs are left at stretch_modulus {stretch_modulus} N/m with shear_modulus "
            f"{shear_modulus} N/m, bending stiffness {bend_stiffness} N/m and cells of {hx:.4g} m x {hy:.4g} m; "
            "raise the stretch modulus or lower the others"
        )
    return Threads(
        along_rows=axial_x * hy,
        along_columns=axial_y * hx,
        diagonal=k_diagonal,
        bend_along_rows=bend_stiffness * hy,
        bend_along_columns=bend_stiffness * hx,
        poisson_ratio=poisson,
    )
