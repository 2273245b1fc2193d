# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_lab`: cantilever, tension, shear, bending and bias extension of a fabric."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import attrs

from cloth_sim_ros.laboratory.command_options import DONE, add_sample_options, run_test, sample_from_options, write_json
from cloth_sim_ros.session.console import escape_unencodable

_DESCRIPTION = (
    "Test a specimen of fabric, and print the measured quantities beside those that the fabric states. Exit status 0: "
    "done; 2: the test is impossible."
)
#: Module, function, norm and description of each test.
_TESTS = {
    "cantilever": ("cantilever", "measure_cantilever", "ASTM D1388: bending length and flexural rigidity"),
    "bending": ("pure_bending", "measure_bending", "KES-FB2: moment over curvature"),
    "tension": ("plane_tests", "measure_tension", "ISO 13934-1, KES-FB1: load over extension"),
    "shear": ("plane_tests", "measure_shear", "KES-FB1: shear force over angle"),
    "bias": ("plane_tests", "measure_bias_extension", "bias extension: load over extension at 45 degrees"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cloth_lab`: parse the options, run textile tests, print and write results; return the exit status."""
    escape_unencodable()
    options = _parser().parse_args(arguments)
    return run_test("cloth_lab", options, lambda: _run(options))


def _parser() -> argparse.ArgumentParser:
    epilog = "\n".join(f"  {name:11s} {text}" for name, (*_, text) in _TESTS.items())
    parser = argparse.ArgumentParser(
        prog="cloth_lab",
        description=_DESCRIPTION,
        epilog=f"tests:\n{epilog}\n  all         each of them",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("test", choices=(*_TESTS, "all"), metavar="TEST", help="one of the tests below")
    add_sample_options(parser)
    cells = "cells of the mesh: in a bending length, along a shorter side, or between clamps (default: each test's own)"
    parser.add_argument("--cells", type=int, metavar="N", help=cells)
    return parser


def _run(options: argparse.Namespace) -> int:
    import importlib

    from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
    from cloth_sim_ros.laboratory.strips import describe

    if options.cells is not None and not 2 <= options.cells <= 100:
        raise LaboratoryError(f"--cells is {options.cells}; it must be from 2 to 100")
    sample = sample_from_options(options)
    cells = {} if options.cells is None else {"cells": options.cells}
    results = {}
    for name in _TESTS if options.test == "all" else [options.test]:
        module, function, text = _TESTS[name]
        measure = getattr(importlib.import_module(f"cloth_sim_ros.laboratory.{module}"), function)
        results[name] = measure(sample, **cells)
        print(describe(f"{sample.title}: {text}", results[name]), flush=True)
    if options.json is not None:
        content = {
            name: [{**attrs.asdict(measurement), "ratio": measurement.ratio} for measurement in measurements]
            for name, measurements in results.items()
        }
        write_json({"fabric": sample.fabric.name, "source": sample.fabric.source, "tests": content}, options.json)
    return DONE


if __name__ == "__main__":
    sys.exit(main())
