# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tuned numbers of step control and sleep occur only in the table of constants."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "cloth_sim_ros"
#: Zero, one, halving and doubling need no reason.
PLAIN = {0.0, 0.5, 1.0, 2.0}
#: Every other number, and the reason that it is not tuned.
REASONS = {
    "automatic.py": {
        1e9: "nanoseconds a second",
        10.0: "expected iterations of a first implicit frame, two stages of five",
    },
    "description.py": {0.99: "text about a step that is shorter than the requested one; decides nothing"},
    "force_jump.py": {
        0.25: "quarters of the last half step",
        0.75: "same",
        1.25: "same",
        4.0: "fourth difference",
        6.0: "same",
    },
    "energy.py": {1e-12: "rounding of a sum of energies", 8.0: "roundings", 0.125: "h^2/8 v'Kv of the leapfrog"},
    "error.py": {
        3.0: "order of a single run's error in a frame: h^3 x'''",
        6.0: "phase error of the leapfrog, 1/24, over its activity, 1/4",
        4.0: "roundings; time without an estimate if the error is far below, see `max_estimate_period`",
        1e3: "a prediction that is off by more causes an estimate at any margin",
        1e-6: "two lengths of frames that differ by rounding",
    },
    "changes.py": {
        4.0: "a jump of a force misses a quarter of a step at most",
        24.0: "error of the leapfrog by a change of jerk",
    },
    "controller.py": {
        1e-6: "two lengths of frames that differ by rounding",
        1.5: "between the length of a stretch and its double",
        3.0: "order of a missed jump's error",
        64.0: "a cap divided by 2^64 is none",
    },
    "error_estimate.py": {9.0: "evaluations of a displacement: the first one and eight Lanczos steps"},
    "frame_division.py": {24.0: "halvings down to a nanosecond"},
    "work_budget.py": {
        1e-9: "nanoseconds",
        4e3: "four calls, in nanoseconds by microseconds",
        4.0: "checks of half steps and their displacements, reserved for a stretch",
    },
    "fallback.py": {
        1e-9: "nanoseconds",
        10.0: "expected evaluations of an implicit step, two stages of five iterations; hard ones take more",
        64.0: "a cap divided by 2^64 is none",
    },
    "multirate.py": {
        9.0: "a ninth of what hinges take is left, which is what a step takes without",
        4.0: "fewer impulses in a run could not tell runs apart",
        3.0: "by waves driven by w_b^2 / w and damped by tau w^2",
        0.6: "the rule's bounds are within a tenth of the eigenvalues' (test_multirate_rule.py)",
    },
    "precision.py": {
        24.0: "bits of single precision",
        3.0: "axes",
        4.0: "estimates of a motion that begins: after 0, 1, 3 and 7 frames; later ones repeat the last",
    },
    "run_differences.py": {6.0: "1 + 4 + 1, squares of the weights of a second difference"},
    "stability.py": {
        3.0: "phases drift apart by the third power of the frequency",
        **dict.fromkeys(
            (0.02, 0.2, 0.35, 0.45, 0.6, 0.75, 0.8, 4.0, 4.5, 6.0, 25.0),
            "by the eigenvalues of the combinations (test_control_rules.py)",
        ),
        84.0: "by the phases of the leapfrog, see `count_confirming_runs`",
        64.0: "by the phases of the leapfrog, see `count_confirming_runs`",
    },
    "sleep.py": {
        4.0: "roundings",
        53.0: "whole numbers that float64 holds",
        5.0: "root of a quadratic equation",
        8.0: "the same",
        25.0: "the same",
    },
}
FILES = [
    *(path for path in sorted((PACKAGE / "physics" / "control").glob("*.py")) if path.stem != "constants"),
    PACKAGE / "simulation" / "sleep.py",
]


def numbers(tree: ast.AST) -> set[float]:
    """Return the numbers in a file, except for indices, text formats and cache sizes."""
    left_out = set[int]()
    for node in ast.walk(tree):
        inner: list[ast.AST] = []
        if isinstance(node, ast.Subscript):
            inner = [node.slice]
        elif isinstance(node, ast.JoinedStr):
            inner = [node]
        elif isinstance(node, ast.keyword) and node.arg in ("start", "axis", "maxsize"):
            inner = [node.value]
        left_out.update(id(inner_node) for part in inner for inner_node in ast.walk(part))
    return {
        float(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and not isinstance(node.value, bool)
        and id(node) not in left_out
    }


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_numbers_outside_the_table_have_a_reason(path: Path) -> None:
    unlisted = numbers(ast.parse(path.read_bytes())) - PLAIN
    assert unlisted == set(REASONS.get(path.name, {}))


def test_numbers_in_any_expression_are_collected() -> None:
    source = "LEAST = 7.0\ndef f(x=3):\n    return x[5] + 0.9 * x if x > -4e2 else f'{x:.6f}'\n"
    assert numbers(ast.parse(source)) == {7.0, 3.0, 0.9, 400.0}
