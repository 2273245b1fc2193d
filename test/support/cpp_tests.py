# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Build of the C++ unit tests: one program for each instruction set, in build/cpp_tests.

An object is compiled again if its command, the compiler or the content of a file that it includes has changed.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
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
    folder = FOLDER / (f"{name}_sanitize" if sanitize else name)
    folder.mkdir(parents=True, exist_ok=True)
    common = [*compiler, *LANGUAGE, *(build.SANITIZED if sanitize else ["-O1"])]
    checked = [*build.ARITHMETIC, *build.INSTRUCTION_SETS[name], *build.WARNINGS, *([] if sanitize else ["-Werror"])]
    # The main program has nothing of the engine, so it needs none of these flags and no optimization.
    commands = {name: [*common, *checked] for name in test_files()} | {"main": [*common, "-O0"]}

    def compile_one(name: str) -> bool:
        return _compile([*commands[name], str(SOURCES / f"{name}.cpp")], version, folder / f"{name}.o")

    with build.locked(folder), ThreadPoolExecutor(build.MAX_COMPILERS) as pool:
        changed = list(pool.map(compile_one, sorted(commands, key="main".__ne__)))
        program = folder / "tests"
        if any(changed) or not program.exists():
            _run([*common, *(str(folder / f"{name}.o") for name in commands), "-o", str(program)])
    return program


def _compile(command: Sequence[str], version: str, target: Path) -> bool:
    """Compile an object unless it is up to date; return whether it was compiled."""
    rule, record = target.with_suffix(".d"), target.with_suffix(".fingerprint")
    if target.exists() and record.exists() and record.read_text() == _fingerprint(command, version, rule):
        return False
    record.unlink(missing_ok=True)
    _run([*command, "-c", "-MMD", "-MF", str(rule), "-o", str(target)])
    record.write_text(_fingerprint(command, version, rule))
    return True


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
