# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""S5 and S6: moduli of a grid of springs, measured on the package's energies, against theory."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve
from support.alone import alone, product

from cloth_sim_ros.physics.model.sheets.grid import GridSheet
from cloth_sim_ros.physics.model.sheets.material import grid_threads

LAYOUTS = ["left", "right", "alternating", "both"]
Y, G = 800.0, 130.0


def sheet_and_springs(layout, *, shape=(7, 7), size=(0.3, 0.3), shear=G, bend=0.0):
    height, width = size
    sheet = GridSheet(height=height, width=width, rows=shape[0], columns=shape[1], layout=layout)
    threads = grid_threads(
        stretch_modulus=Y, shear_modulus=shear, spacing=sheet.spacing, layout=layout, bend_stiffness=bend
    )
    return sheet, threads, sheet.springs(sheet.families(threads, k_d0=0.1, density=0.2))


def moduli(sheet, springs):
    """The 3x3 matrix C of energy density = e' C e / 2 for strains e = (xx, yy, 2 xy), by second differences."""
    rest_positions = sheet.positions().T
    area = sheet.height * sheet.width
    plan = alone(*springs, count=rest_positions.shape[1])

    def energy(strain):
        xx, yy, xy = strain
        deformed = np.eye(3) + np.array([[xx, xy / 2, 0], [xy / 2, yy, 0], [0, 0, 0]])
        return plan.energies(0.0, np.ascontiguousarray(deformed @ rest_positions), None)[1] / area

    h = 1e-4
    c = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            a, b = h * np.eye(3)[i], h * np.eye(3)[j]
            c[i, j] = (energy(a + b) - energy(a - b) - energy(b - a) + energy(-a - b)) / (4 * h * h)
    return c


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("shape", [(7, 7), (5, 9)], ids=["square cells", "flat cells"])
def test_moduli_of_each_layout_agree_with_theory(layout, shape):
    sheet, threads, springs = sheet_and_springs(layout, shape=shape)
    hx, hy = sheet.spacing
    length, families = np.hypot(hx, hy), {"both": 2, "alternating": 1, "left": 1, "right": 1}[layout]
    cosine, sine = hx / length, hy / length
    # One family everywhere has k_s l / (hx hy) d d d d; `alternating` has half of each.
    density = threads.diagonal * length / (hx * hy) * families
    expected = np.diag([threads.along_rows / hy, threads.along_columns / hx, 0.0])
    signs = {"left": [-1.0], "right": [1.0]}.get(layout, [-1.0, 1.0])
    for sign in signs:  # `left` runs down to the right
        n = np.array([cosine**2, sine**2, sign * cosine * sine])
        expected += density / len(signs) * np.outer(n, n)
    measured = moduli(sheet, springs)
    assert measured == pytest.approx(expected, rel=2e-3, abs=1e-3 * Y)
    assert measured[2, 2] == pytest.approx(G, rel=2e-3)
    assert (abs(measured[0, 2]) < 1e-3 * G) == (layout in ("both", "alternating")), "a single diagonal also shears"


@pytest.mark.parametrize("layout", LAYOUTS)
def test_moduli_and_poisson_ratio_are_those_requested(layout):
    sheet, threads, springs = sheet_and_springs(layout, shape=(6, 8), bend=15.0)
    # Within 2 %: in border cells there is one of the springs two apart instead of two.
    compliance = np.linalg.inv(moduli(sheet, springs))
    assert 1 / compliance[0, 0] == pytest.approx(Y, rel=0.02)
    assert 1 / compliance[1, 1] == pytest.approx(Y, rel=0.02)
    assert -compliance[0, 1] / compliance[0, 0] == pytest.approx(threads.poisson_ratio, abs=0.01)


def test_square_cells_follow_the_closed_forms():
    """E_e = (Y - 2G + sqrt(Y^2 + 4G^2)) / 2, k_g = sqrt(2) G h; stiffness along 45 degrees (C11 + C12 + 2 C66) / 2."""
    sheet, threads, springs = sheet_and_springs("both")
    h = sheet.spacing[0]
    assert threads.along_rows / h == pytest.approx(0.5 * (Y - 2 * G + np.sqrt(Y**2 + 4 * G**2)), rel=1e-12)
    assert threads.diagonal == pytest.approx(np.sqrt(2) * G * h, rel=1e-12)
    c = moduli(sheet, springs)
    along = np.array([0.5, 0.5, 1.0])  # strain of a unit stretch along 45 degrees
    assert along @ c @ along == pytest.approx(0.5 * (c[0, 0] + c[0, 1] + 2 * c[2, 2]), rel=1e-9)
    assert along @ c @ along == pytest.approx(0.5 * threads.along_rows / h + 2 * G, rel=2e-3)


def test_a_network_is_isotropic_only_at_a_third():
    """At g = E_e, Poisson's ratio is 1/3 and every direction has the same stiffness."""
    modulus = 900.0
    shear = 3 / 8 * modulus
    sheet = GridSheet(height=1.0, width=1.0, rows=6, columns=6, layout="both")
    threads = grid_threads(stretch_modulus=modulus, shear_modulus=shear, spacing=sheet.spacing, layout="both")
    assert threads.poisson_ratio == pytest.approx(1 / 3, rel=1e-12)
    c = moduli(sheet, sheet.springs(sheet.families(threads, k_d0=0.0, density=0.2)))
    along = np.array([0.5, 0.5, 1.0])
    assert along @ c @ along == pytest.approx(c[0, 0], rel=2e-3)


def test_diagonals_resist_shear_and_edge_springs_alone_do_not():
    for layout in LAYOUTS:
        sheet, _, springs = sheet_and_springs(layout, shape=(2, 2), size=(1.0, 1.0))
        rest_positions = sheet.positions() + 0.5
        for angle in np.radians([10, 45, 89.9]):
            sheared = rest_positions.copy()
            sheared[:, 0] = rest_positions[:, 0] + rest_positions[:, 1] * np.sin(angle)
            sheared[:, 1] = rest_positions[:, 1] * np.cos(angle)
            places = np.ascontiguousarray(sheared.T)
            structural, shear = (
                alone(springs_force, count=4).energies(0.0, places, None)[1] for springs_force in springs
            )
            assert structural < 1e-25 * Y
            assert shear > 0.01 * G * angle**2
        assert np.ptp(sheared[:, 0]) == pytest.approx(2.0, rel=1e-5), "a line of twice the edge"


def test_without_a_shear_modulus_there_are_no_shear_springs():
    _, _, springs = sheet_and_springs("both", shear=0.0)
    assert [force.name for force in springs] == ["structural"]


def test_impossible_moduli_are_refused():
    with pytest.raises(ValueError, match=r"no edge springs are left .* raise the stretch modulus"):
        grid_threads(stretch_modulus=100.0, shear_modulus=100.0, spacing=(0.1, 0.02), layout="both")


def stiffness_matrix(sheet, springs):
    """Return the in-plane stiffness of the rest shape, from Jacobian products, (2n, 2n), particle-major."""
    x = np.ascontiguousarray(sheet.positions().T)
    n, zero = x.shape[1], np.zeros_like(x)
    plan, columns = alone(*springs, count=n), []
    for p in range(n):
        for i in range(2):
            push = np.zeros_like(x)
            push[i, p] = 1.0
            columns.append(-product(plan, x, zero, push, zero)[:2].T.ravel())
    return sparse.csc_array(np.array(columns).T)


def finite_elements(count, c, weight):
    """Return displacements of a hanging unit sheet by bilinear finite elements, assembled independently, (n, n, 2)."""
    h = 1.0 / (count - 1)
    local = np.zeros((8, 8))
    for a in (-1, 1):
        for b in (-1, 1):
            s, t = a / np.sqrt(3), b / np.sqrt(3)
            corners = np.array([[-1, 1], [1, 1], [-1, -1], [1, -1]])
            ds = corners[:, 0] * (1 + corners[:, 1] * t) / 4 * 2 / h
            dt = corners[:, 1] * (1 + corners[:, 0] * s) / 4 * 2 / h
            strain = np.zeros((3, 8))
            strain[0, ::2], strain[1, 1::2], strain[2, ::2], strain[2, 1::2] = ds, dt, dt, ds
            local += strain.T @ c @ strain * h * h / 4
    index = np.arange(count * count).reshape(count, count)
    cells = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], axis=-1).reshape(-1, 4)
    dofs = (2 * cells[:, :, None] + np.arange(2)).reshape(-1, 8)
    rows, columns = np.repeat(dofs, 8, axis=1).ravel(), np.tile(dofs, (1, 8)).ravel()
    k = sparse.csc_array((np.tile(local.ravel(), len(cells)), (rows, columns)))
    load = np.zeros(2 * count * count)
    np.add.at(load, 2 * cells.ravel() + 1, -weight * h * h / 4)
    free = np.arange(2 * count, 2 * count * count)
    u = np.zeros_like(load)
    u[free] = spsolve(k[free][:, free], load[free])
    return u.reshape(count, count, 2)


@pytest.mark.parametrize("layout", ["both", "alternating", "left"])
def test_hanging_sheet_stretches_as_the_continuum(layout):
    weight = 1.0  # N/m^2: strains of a thousandth, where the springs are linear
    errors = []
    for count in (5, 9, 17):
        sheet, _, springs = sheet_and_springs(layout, shape=(count, count), size=(1.0, 1.0))
        k = stiffness_matrix(sheet, springs)
        load = np.zeros((count * count, 2))
        load[:, 1] = -weight * sheet.masses(1.0)
        free = np.arange(2 * count, 2 * count * count)
        u = np.zeros(2 * count * count)
        u[free] = spsolve(k[free][:, free], load.ravel()[free])
        if count == 5:
            fine, _, fine_springs = sheet_and_springs(layout, shape=(3, 3), size=(1.0, 1.0))
            reference = finite_elements(65, moduli(fine, fine_springs), weight)
        stride = 64 // (count - 1)
        difference = u.reshape(count, count, 2) - reference[::stride, ::stride]
        errors.append(np.abs(difference[-1]).max() / np.abs(reference).max())
    if layout == "left":
        # The pull alone does not load a single diagonal family: each column is a chain, exact at any resolution.
        assert max(errors) < 1e-6
        return
    assert errors[0] / errors[1] > 1.6, errors
    assert errors[1] / errors[2] > 1.6, errors
    assert errors[2] < 0.01, errors
