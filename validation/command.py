# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command lines of `python -m benchmarks` and `python -m validation`."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cloth_sim_ros.session.child_process import child_environment, module_command, safe_imports
from cloth_sim_ros.session.output_files import OutputError, check_outputs


def run_command(
    package: str, description: str, commands: Mapping[str, tuple[str, str]], arguments: Sequence[str] | None
) -> int:
    """Run one of a package's commands, or list them if none is named; return the exit status.

    Args:
        package: name of the package that is run with `python -m`.
        description: one sentence about the package.
        commands: module and one-line description of each command, by name. A module has `add_arguments(parser)` and
            `run(options)`, which returns a `report.Report`. Or it has `figures(options)` instead, which returns figures
            by name, or a list of those. They are printed as JSON, and `met` in each decides the exit status.
        arguments: command line; None takes that of this process.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(
        prog=f"python -m {package}",
        description=description,
        epilog="\n".join(f"  {name:16s} {text}" for name, (_, text) in commands.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=commands, metavar="command", help="one of the names below")
    if not words:
        parser.print_help()
        return 0
    name, *command_arguments = words
    if name not in commands:
        parser.parse_args(words)
    module = importlib.import_module(commands[name][0])
    command_parser = argparse.ArgumentParser(
        prog=f"{parser.prog} {name}",
        description=commands[name][1],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    module.add_arguments(command_parser)
    if hasattr(module, "figures"):
        return _print_figures(module.figures, command_parser, command_arguments)
    command_parser.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    options = command_parser.parse_args(command_arguments)
    try:
        check_outputs({"--json": options.json}, [])
        with safe_imports():
            report = module.run(options)
    except (ValueError, OutputError) as error:
        command_parser.error(str(error))
    report.command = " ".join([command_parser.prog, *_without_files(command_arguments)])
    sys.stdout.write(report.text() + "\n")
    if options.json is not None:
        options.json.write_text(report.json_text())
    return 1 if report.failures else 0


def _without_files(arguments: Sequence[str]) -> list[str]:
    """Return the arguments without the files to which results are written."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("--json", "--resume", "--record"):
        parser.add_argument(name)
    return parser.parse_known_args(arguments)[1]


def at_least(minimum: int) -> Callable[[str], int]:
    """Return the type of an option: an integer of at least `minimum`."""

    def parse(text: str) -> int:
        if not text.lstrip("-").isdigit() or int(text) < minimum:
            raise argparse.ArgumentTypeError(f"{text}; it must be an integer of at least {minimum}")
        return int(text)

    return parse


def above(minimum: float) -> Callable[[str], float]:
    """Return the type of an option: a number above `minimum`."""

    def parse(text: str) -> float:
        if not float(text) > minimum:
            raise argparse.ArgumentTypeError(f"{text}; it must be above {minimum:g}")
        return float(text)

    return parse


def _print_figures(
    figures: Callable[[argparse.Namespace], Any], parser: argparse.ArgumentParser, arguments: Sequence[str]
) -> int:
    try:
        measured = figures(parser.parse_args(arguments))
    except ValueError as error:
        parser.error(str(error))
    sys.stdout.write(json.dumps(measured, indent=1) + "\n")
    return 0 if all(entry["met"] for entry in (measured if isinstance(measured, list) else [measured])) else 1


def child_process_arguments(module: str, *arguments: str) -> dict[str, Any]:
    """Return arguments of `subprocess` that run a module of this repository.

    The process imports nothing from its working folder, therefore the root of the repository is on its path.
    """
    environment = child_environment()
    paths = [str(Path(__file__).resolve().parents[1]), environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    return {"args": module_command(module, *arguments), "env": environment}


def run_module(module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a module of this repository in its own process; return its status and output."""
    process_arguments = child_process_arguments(module, *arguments)
    return subprocess.run(**process_arguments, check=False, capture_output=True, text=True)
