# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build of the C++ unit tests: one program for each instruction set, in build/cpp_tests.

All files with tests are one translation unit, because headers and templates take most of a file's compile time. An
object is compiled again if its command, the compiler or the content of a file that it includes has changed.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.engine import build

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ROOT / "test" / "engine" / "cpp"
FOLDER = ROOT / "build" / "cpp_tests"
LANGUAGE = ["-std=c++20", "-pthread", f"-I{build.ENGINE}", f"-I{SOURCES}"]
#: A program that the sanitizers check needs no library to be preloaded.
ENVIRONMENT = {name: text for name, text in os.environ.items() if name != "LD_PRELOAD"}


def test_files() -> list[str]:
    """Names of the files with tests, without their ending."""
    return sorted(path.stem for path in SOURCES.glob("*.cpp") if path.stem != "main")


def unit_text() -> str:
    """Return the unit: headers of the engine, optimized as in a library, then the tests, which are not.

    Optimizing the tests' own code takes half of the compile time. Other compilers than g++ optimize it all.
    """
    lines = {line for path in SOURCES.glob("*.?pp") for line in path.read_text().splitlines()}
    headers = sorted(line for line in lines if re.match(r'#include "\w+/', line))
    unoptimized = ["#if defined(__GNUC__) && !defined(__clang__)", '#pragma GCC optimize("O0")', "#endif"]
    tests = [f'#include "{name}.cpp"' for name in test_files()]
    return "\n".join([*headers, *unoptimized, *tests, ""])


def build_program(name: str, *, sanitize: bool = False) -> Path:
    """Build the program of an instruction set if it is not up to date; return its path.

    Args:
        name: of the instruction set, as in `build.INSTRUCTION_SETS`.
        sanitize: add the address and the undefined-behaviour sanitizer.

    Raises:
        BuildError: if the compiler is missing or fails.
    """
    compiler = build.find_compiler()
    version = build.describe(compiler)
    suffix = "_sanitize" if sanitize else ""
    folder = FOLDER / f"{name}{suffix}"
    folder.mkdir(parents=True, exist_ok=True)
    common = [*compiler, *LANGUAGE, *(build.SANITIZED if sanitize else ["-O1"])]
    checked = [*build.ARITHMETIC, *build.INSTRUCTION_SETS[name], *build.WARNINGS, *([] if sanitize else ["-Werror"])]
    unit, program = folder / "unit.cpp", folder / "tests"
    # The main program has nothing of the engine, so it needs none of these flags and no optimization.
    objects = [FOLDER / f"main{suffix}.o", folder / "unit.o"]
    with build.lock_folder(FOLDER):
        _compile([*common, "-O0", str(SOURCES / "main.cpp")], version, objects[0])
    with build.lock_folder(folder):
        unit.write_text(unit_text())
        _compile([*common, *checked, str(unit)], version, objects[1])
        if not program.exists() or program.stat().st_mtime_ns < max(path.stat().st_mtime_ns for path in objects):
            _run([*common, *map(str, objects), "-o", str(program)])
    return program


def _compile(command: Sequence[str], version: str, target: Path) -> None:
    """Compile an object unless it is up to date."""
    rule, record = target.with_suffix(".d"), target.with_suffix(".fingerprint")
    if target.exists() and record.exists() and record.read_text() == _fingerprint(command, version, rule):
        return
    record.unlink(missing_ok=True)
    _run([*command, "-c", "-MMD", "-MF", str(rule), "-o", str(target)])
    record.write_text(_fingerprint(command, version, rule))


def _fingerprint(command: Sequence[str], version: str, rule: Path) -> str:
    """Hash of a command, the compiler and all files that the compiler's rule for make names."""
    digest = hashlib.sha256("\0".join([*command, version]).encode())
    for name in rule.read_text().replace("\\\n", " ").split()[1:]:
        path = Path(name)
        digest.update(path.read_bytes() if path.exists() else b"")
    return digest.hexdigest()


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, errors="replace")
    if done.returncode:
        raise build.BuildError(f"{done.stderr}\ncloth_sim_ros: the C++ tests can't be built; see the errors above.")
