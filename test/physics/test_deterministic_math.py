# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Deterministic powers, roots and sums; no library arithmetic reaches reproducible bits."""

from __future__ import annotations

import ast
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from cloth_sim_ros.physics.arithmetic.deterministic_math import (
    dot_products,
    exponential,
    integer_sum,
    logarithm,
    ordered_sum,
    power,
    root,
)

PACKAGE = Path(__file__).resolve().parents[2] / "cloth_sim_ros"

#: Functions whose last bit depends on processor, C library or numpy's build.
FOREIGN = {
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2", "asin", "acos", "atan", "atan2", "sinh", "cosh"),
    *("tanh", "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "cbrt", "hypot", "pow", "power", "float_power"),
    *("einsum", "dot", "vdot", "inner", "matmul", "tensordot", "norm", "eigh", "eigvalsh", "svd", "inv"),
    *("lstsq", "det", "qr", "sum", "mean", "average", "prod", "cumsum", "cumprod", "fsum", "interp", "std", "var"),
}
#: Harmless uses of these functions: refusals of meshes and their messages, the side of a mesh of a point, exact
#: fractions, whole numbers, sums of arrays one by one, squares, which numpy computes as a product, and topics that no
#: session holds.
HARMLESS = {
    ("physics/model/sheets/meshes.py", "norm"),
    ("physics/model/sheets/meshes.py", "sum"),
    ("physics/model/sheets/surface.py", "sum"),
    ("physics/model/sheets/surface.py", "cumsum"),
    ("physics/integrators/stage_matrix.py", "sum"),
    ("physics/integrators/stage_matrix.py", "cumsum"),
    ("physics/integrators/extrapolation_tableau.py", "prod"),
    ("physics/contact/obstacle_mesh.py", "sum"),
    ("simulation/bodies/grippers.py", "sum"),
    ("physics/contact/obstacle_mesh.py", "arctan2"),
    ("physics/integrators/extrapolation_tableau.py", "**"),
    ("physics/plan/assembly.py", "sum"),
    ("physics/integrators/extrapolation_tableau.py", "sum"),
    ("physics/control/controller.py", "sum"),
    ("physics/control/frame_totals.py", "sum"),
    ("scene/coverage.py", "cumsum"),
    ("scene/coverage.py", "fsum"),
    ("scene/coverage.py", "sum"),
    ("scene/keypoints.py", "sum"),
    ("physics/plan/gripper_path.py", "sum"),
    ("physics/contact/feature_binding.py", "sum"),
    ("physics/model/sheets/hinge_shape.py", "**"),
    ("physics/model/sheets/mesh.py", "**"),
    ("physics/model/sheets/chain.py", "**"),
}


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5, 6, 9])
@pytest.mark.parametrize("value", [5e-324, 1e-300, 3e-9, 0.3, 1.0, 2.0, 7.25, 1e5, 1.7e308])
def test_a_root_is_right_to_a_few_roundings(value: float, degree: int) -> None:
    calculated = root(value, degree)
    # In exact fractions: a relative error e of the root is one of degree * e in the root's power.
    assert abs(Fraction(calculated) ** degree / Fraction(value) - 1) < degree * 2 * Fraction(2) ** -52


def test_roots_of_zero_and_infinity() -> None:
    assert [root(0.0, 3), root(math.inf, 4), root(8.0, 3), root(16.0, 4)] == [0.0, math.inf, 2.0, 2.0]


def test_powers_are_products() -> None:
    assert [power(3.0, 0), power(3.0, 1), power(3.0, 4), power(math.inf, 3)] == [1.0, 3.0, 81.0, math.inf]


def test_sums_are_rounded_after_each_number() -> None:
    # Python 3.12's sum gives 1.0.
    assert ordered_sum([1e16, 1.0, -1e16]) == 0.0
    assert ordered_sum([1.0, -1e16], 1e16) == 0.0
    assert ordered_sum(iter([0.1] * 10)) == 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1
    assert ordered_sum([]) == 0.0


def test_sums_of_whole_numbers_are_exact() -> None:
    assert integer_sum(iter([2**60, 1, -(2**60)])) == 1
    assert integer_sum([]) == 0


def test_scalar_products_are_added_from_the_left() -> None:
    vectors = np.array([[[1e16, 1.0, -1e16], [1.0, -1e16, 1e16]]])
    assert dot_products(vectors, np.ones(3)).tolist() == [[0.0, 0.0]]
    assert dot_products(vectors, np.array([1.0, 4.0, 1.0])).tolist() == [[4.0, -3e16]]


#: The shapes and poses of a robot's links are recorded, so no run computes them again.
RECORDED = set(PACKAGE.glob("scene/robot/*.py"))
ROOMS = ("engine", "physics", "scene", "simulation")


@pytest.mark.parametrize(
    "path",
    sorted({path for room in ROOMS for path in PACKAGE.glob(f"{room}/**/*.py")} - RECORDED),
    ids=lambda p: str(p.relative_to(PACKAGE)),
)
def test_no_library_arithmetic_reaches_the_bits(path: Path) -> None:
    used = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            function, owner = node.func.attr, node.func.value
            if function in FOREIGN or (isinstance(owner, ast.Attribute) and owner.attr == "linalg"):
                used.add((function, node.lineno))
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "sum":
            used.add(("sum", node.lineno))
        elif isinstance(node, ast.BinOp) and isinstance(node.left, ast.Constant):
            continue  # constants such as 2**31, and numbers in messages
        elif isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult | ast.Pow):
            used.add(("@" if isinstance(node.op, ast.MatMult) else "**", node.lineno))
    name = str(path.relative_to(PACKAGE))
    assert not {(function_name, line) for function_name, line in used if (name, function_name) not in HARMLESS}


@pytest.mark.parametrize("value", [-700.0, -20.3, -1.0, -0.3, 0.0, 1e-9, 0.5, 2.0, 33.3, 700.0])
def test_exponentials_are_right_to_some_roundings(value: float) -> None:
    assert exponential(value) == pytest.approx(math.exp(value), rel=2e-16 * (4.0 + 8.0 * abs(value)))


@pytest.mark.parametrize("value", [5e-324, 1e-300, 0.3, 0.7, 1.0 - 1e-9, 1.0, 1.3, 1.4, 2.0, 7.25, 1e5, 1.7e308])
def test_logarithms_are_right_to_a_few_roundings(value: float) -> None:
    assert logarithm(value) == pytest.approx(math.log(value), rel=4e-16, abs=0.0)
