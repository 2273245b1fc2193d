# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contracts of the installed package: commands and their options, extras, environment variables, module names."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import io
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "cloth_sim_ros"
#: Measurements of the repository, which are no part of the product.
_MEASUREMENTS = re.compile(r"cloth_sim_ros[/.](bench\b|ros[/.]measure_|session[/.]measure\b)")
#: First words that choose a parser.
_SUBCOMMANDS = {"cloth_batch": ["", "check", "view", "export"]}
#: These options name no command of the product.
_SKIPPED_COMMANDS = {"cloth_bench"}


class _ParserCapturedError(Exception):
    def __init__(self, parser: argparse.ArgumentParser) -> None:
        super().__init__(parser.prog)
        self.parser = parser


def package() -> dict[str, Any]:
    """Return what setup.py declares, and the files that are installed beside the code."""
    script = (
        "import json, runpy, setuptools\n"
        "setuptools.setup = lambda **arguments: print(json.dumps(arguments, default=str))\n"
        "runpy.run_path('setup.py')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=True, capture_output=True, text=True)
    arguments = json.loads(done.stdout.splitlines()[-1])
    commands = [entry.partition(" = ")[0] for entry in arguments["entry_points"]["console_scripts"]]
    return {
        "name": arguments["name"],
        "commands": sorted(commands),
        "extras": sorted(arguments["extras_require"]),
        "config": sorted(path.name for path in (ROOT / "config").iterdir()),
        "launch": sorted(path.name for path in (ROOT / "launch").glob("*.launch.py")),
    }


def options() -> dict[str, Any]:
    """Return the options of every command."""
    contract: dict[str, Any] = {}
    for command, (module, function) in _entry_points().items():
        if command in _SKIPPED_COMMANDS:
            continue
        for word in _SUBCOMMANDS.get(command, [""]):
            main = getattr(importlib.import_module(module), function)
            contract[f"{command} {word}".strip()] = _described(_parser_of(main, [word] if word else []))
    from cloth_sim_ros.ros.process.options import parser

    contract["cloth_sim"] = _described(parser())
    return contract


def environment_variables() -> dict[str, Any]:
    """Return the names in capitals that the code has as text: environment variables, and some of their values."""
    names: set[str] = set()
    for path in _sources():
        text = path.read_text(encoding="utf-8")
        names |= set(re.findall(r"[\"']([A-Z][A-Z0-9]*(?:_[A-Z0-9]+)+)[\"']", text))
        names |= set(re.findall(r"\benviron(?:ment)?(?:\.get\(|\.pop\(|\[)[\"']([A-Z][A-Z0-9_]+)", text))
    return {"names": sorted(names)}


def module_names() -> dict[str, Any]:
    """Return the modules that users run or name as text: after `-m`, in environment ids, and of child processes."""
    texts = [ROOT / "README.md", ROOT / "Makefile", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    texts += [*sorted((ROOT / "examples").iterdir()), *sorted((ROOT / "launch").iterdir()), *_sources()]
    run, named = set(), set()
    for path in texts:
        if not path.is_file() or not (text := path.read_text(encoding="utf-8", errors="replace")):
            continue
        run |= set(re.findall(r"-m (cloth_sim_ros(?:\.\w+)*)", text))
        named |= set(re.findall(r"\b(cloth_sim_ros(?:\.\w+)*:[\w/.-]+)", text))
        if path.suffix == ".py" and PACKAGE in path.parents:
            run |= _module_texts(text)
    modules = sorted(name for name in run if not _MEASUREMENTS.match(name))
    for name in modules:
        assert importlib.util.find_spec(name) is not None, f"there is no module {name}"
    return {"run as modules": modules, "named with a member": sorted(named)}


def gymnasium_environments() -> dict[str, Any]:
    """Return the ids that gymnasium knows of this package."""
    import gymnasium

    importlib.import_module("cloth_sim_ros.learning.registered")
    return {
        name: {
            "max_episode_steps": entry.max_episode_steps,
            "environments": [
                _member(str(entry.entry_point)).__name__,
                _member(str(entry.vector_entry_point)).__name__,
            ],
        }
        for name, entry in gymnasium.registry.items()
        if name.startswith("cloth_sim_ros/")
    }


def _member(reference: str) -> Any:
    module, _, name = reference.partition(":")
    return getattr(importlib.import_module(module), name)


def _sources() -> list[Path]:
    paths = sorted(PACKAGE.rglob("*.py"))
    return [path for path in paths if not _MEASUREMENTS.match(path.relative_to(ROOT).as_posix())]


def _module_texts(source: str) -> set[str]:
    """Return the strings of a source that name a module of this package."""
    return set(re.findall(r"[\"'](cloth_sim_ros(?:\.\w+)+)[\"']", source))


def _entry_points() -> dict[str, tuple[str, str]]:
    text = (ROOT / "setup.py").read_text(encoding="utf-8")
    return {name: (module, member) for name, module, member in re.findall(r'"(\w+) = ([\w.]+):(\w+)"', text)}


@contextlib.contextmanager
def _capture_parser() -> Iterator[None]:
    def parse(self: argparse.ArgumentParser, *_: Any, **__: Any) -> Any:
        raise _ParserCapturedError(self)

    with (
        mock.patch.object(argparse.ArgumentParser, "parse_args", parse),
        mock.patch.object(argparse.ArgumentParser, "parse_known_args", parse),
        contextlib.redirect_stderr(io.StringIO()),
    ):
        yield


def _parser_of(main: Any, arguments: list[str]) -> argparse.ArgumentParser:
    """Return the first parser that a command asks to parse."""
    with _capture_parser():
        try:
            main(arguments)
        except _ParserCapturedError as captured:
            return captured.parser
    raise AssertionError("the command parsed nothing")


def _described(parser: argparse.ArgumentParser) -> dict[str, Any]:
    described: dict[str, Any] = {"name": parser.prog, "arguments": [], "options": {}}
    # private: argparse has no other list
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            described["commands"] = {name: _described(inner) for name, inner in action.choices.items()}
        elif not action.option_strings:
            described["arguments"].append(f"{action.metavar or action.dest} {action.nargs or ''}".strip())
        else:
            takes = "nothing" if action.nargs == 0 else str(action.nargs or "one")
            described["options"][", ".join(action.option_strings)] = {
                "takes": takes,
                "default": None if action.default is argparse.SUPPRESS else action.default,
                "required": action.required,
                "choices": None if action.choices is None else [str(choice) for choice in action.choices],
            }
    return described
