# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Thread stiffnesses of a grid from the moduli of a sheet.

A family of threads has a stiffness k_s [N], a direction d and a spacing w. It acts like a sheet with the modulus tensor
(k_s / w) d d d d. The sums over the families of a grid follow; docs/springs.md derives them. The grid has spacings hx,
hy and diagonals of length l.

- Diagonals `both` or `alternating`: C66 = C12 = G, C11 = E_x + G (hx/hy)^2, C22 = E_y + G (hy/hx)^2.
- They have Young's moduli Y_x = C11 - G^2/C22 and Y_y = C22 - G^2/C11. With r = Y_x/Y_y = C11/C22, C11 is
  (Y_x + sqrt(Y_x^2 + 4 r G^2)) / 2.
- Diagonals `left` or `right`: an axial pull also shears, which unloads the single diagonal family: Y_x = E_x and
  Y_y = E_y.
"""

from __future__ import annotations

import math

import attrs

from cloth_sim_ros.physics.model.sheets.surface import Layout


@attrs.frozen(kw_only=True)
class ThreadStiffness:
    """Spring stiffnesses of a grid by direction, force per strain k_s [N], for threads inside the sheet.

    Border threads carry half.
    """

    along_rows: float
    along_columns: float
    diagonal: float
    bend_along_rows: float
    bend_along_columns: float
    #: Poisson's ratio of the sheet in a pull along its rows. The moduli fix it; a network of springs can't choose it
    #: freely.
    poisson_ratio: float


def grid_threads(
    *,
    stretch_modulus: float | tuple[float, float],
    shear_modulus: float,
    spacing: tuple[float, float],
    layout: Layout,
    bend_stiffness: float | tuple[float, float] = 0.0,
) -> ThreadStiffness:
    """Return the spring stiffnesses of a rectangular grid that give the sheet its stretch and shear moduli.

    Args:
        stretch_modulus: Young's modulus of the sheet along its axes [N/m], above 0: one number, or Y_x along rows and
            Y_y along columns.
        shear_modulus: shear modulus G [N/m], at least 0.
        spacing: distance of neighbours along a row and along a column, hx and hy [m].
        layout: diagonals of the cells that are springs.
        bend_stiffness: stiffness B [N/m] of the springs two apart along both axes (bending `axial`), one number or
            two, k_s = B times the thread spacing. Two of them overlap everywhere along a thread and add 2 B to the
            axial stiffness. The edge springs are weakened by that.

    Raises:
        ValueError: if no edge springs of positive stiffness give these moduli.
    """
    hx, hy = spacing
    young_x, young_y = _along_axes(stretch_modulus)
    bend_x, bend_y = _along_axes(bend_stiffness)
    # Products, not powers: a library's pow and hypot differ in the last bit from machine to machine.
    diagonal = math.sqrt(hx * hx + hy * hy)
    families = 2.0 if layout == "both" else 1.0
    k_diagonal = shear_modulus * (diagonal * diagonal * diagonal) / (families * hx * hy)
    if layout in ("left", "right"):
        axial_x, axial_y = young_x, young_y
        poisson = 0.0
    else:
        ratio = young_x / young_y
        root = math.sqrt(young_x * young_x + 4.0 * (ratio * (shear_modulus * shear_modulus)))
        stiffness_x = 0.5 * (young_x + root)
        stiffness_y = stiffness_x / ratio
        axial_x = stiffness_x - shear_modulus * (hx / hy * (hx / hy))
        axial_y = stiffness_y - shear_modulus * (hy / hx * (hy / hx))
        poisson = shear_modulus / stiffness_y
    axial_x -= 2.0 * bend_x
    axial_y -= 2.0 * bend_y
    if not min(axial_x, axial_y) > 0.0:
        raise ValueError(
            f"no edge springs are left at stretch_modulus {stretch_modulus} N/m with shear_modulus "
            f"{shear_modulus} N/m, bending stiffness {bend_stiffness} N/m and cells of {hx:.4g} m x {hy:.4g} m; "
            "raise the stretch modulus or lower the others"
        )
    return ThreadStiffness(
        along_rows=axial_x * hy,
        along_columns=axial_y * hx,
        diagonal=k_diagonal,
        bend_along_rows=bend_x * hy,
        bend_along_columns=bend_y * hx,
        poisson_ratio=poisson,
    )


def _along_axes(value: float | tuple[float, float]) -> tuple[float, float]:
    """Return a pair of values, along rows and along columns; a single number stands for both."""
    return value if isinstance(value, tuple) else (value, value)
