# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Options and outputs that the commands of the laboratory share."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloth_sim_ros.laboratory.samples import FabricSample

#: Exit status: the test is done.
DONE = 0
#: Exit status: the test is done, and a specimen is not at rest.
NOT_AT_REST = 1
#: Exit status: the test is impossible.
REFUSED = 2


def add_sample_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments `fabric`, `--set` (replaced parameters) and `--json` (output file) to a parser."""
    fabric = "name of a fabric, fabric file, or scene file (ROS parameters) whose fabric is tested"
    parser.add_argument("fabric", help=fabric)
    override = "parameter of the fabric that replaces its own, e.g. material.bending_modulus=2e-6"
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="overrides", help=override)
    parser.add_argument("--json", type=Path, metavar="OUT.json", help="all numbers")


def sample_from_options(options: argparse.Namespace) -> FabricSample:
    """Read the fabric that a command's options name, with the parameters that they replace; raise if it is invalid.

    Raises:
        LaboratoryError: for an override that is no NAME=VALUE.
        ParameterError: for an unknown fabric, or an invalid value.
    """
    import yaml

    from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
    from cloth_sim_ros.laboratory.samples import read_sample
    from cloth_sim_ros.scene.parameters import ros_yaml

    overrides: dict[str, Any] = {}
    for text in options.overrides:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise LaboratoryError(f"--set is '{text}'; write NAME=VALUE")
        if name in overrides:
            raise LaboratoryError(f"--set names '{name}' twice; give it once")
        try:
            overrides[name] = ros_yaml.load(value)
        except yaml.YAMLError:
            raise LaboratoryError(f"--set is '{text}'; its value is no YAML") from None
    return read_sample(options.fabric, overrides)


def run_test(name: str, options: argparse.Namespace, test: Callable[[], int], **outputs: Path | None) -> int:
    """Check the output files, run a test, and return the exit status; errors of the user go to stderr as a sentence.

    Args:
        name: name of the command.
        options: options of the command line.
        test: the test, which returns the exit status.
        outputs: further output files by option.
    """
    from cloth_sim_ros.laboratory.equilibrium import LaboratoryError
    from cloth_sim_ros.laboratory.samples import scene_files_of
    from cloth_sim_ros.physics.integrators.base import UnstableError
    from cloth_sim_ros.scene.parameters.declare import ParameterError
    from cloth_sim_ros.session.errors import SessionError
    from cloth_sim_ros.session.output_files import check_outputs

    files = {"--json": options.json, **{f"--{option}": path for option, path in outputs.items()}}
    try:
        check_outputs(files, [Path(options.fabric), *scene_files_of(options.fabric)], endings={"--picture": ".png"})
        return test()
    except (LaboratoryError, ParameterError, SessionError, UnstableError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return REFUSED
    except OSError as error:
        # A full device does not name itself.
        named = error.filename or " or ".join(str(path) for path in files.values() if path) or "output"
        print(f"{name}: cannot write '{named}': {error.strerror or error}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return 130


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write the numbers of a test to a file as JSON, complete or not at all."""
    from cloth_sim_ros.session.output_files import atomic_write

    with atomic_write(path) as output:
        output.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
