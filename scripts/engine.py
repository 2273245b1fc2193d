# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Builds the engine beside its sources, for an environment that uses the package in place. Run by the Makefile.

Builds the library that this machine loads; with `--every` all that it can run, whose bits the tests compare. Takes a
tenth of a second if they are up to date. With `--sanitize` it builds the engine with the address and the
undefined-behaviour sanitizer, into a folder of its own, and runs tests with it.
"""

from __future__ import annotations

import argparse
import os
import runpy
import subprocess
import sys
from pathlib import Path

import compiler

ROOT = Path(__file__).resolve().parent.parent
SANITIZED = ROOT / "build" / "sanitize"


def preloaded() -> str:
    """Paths of the libraries to preload: the sanitizer, and the C++ library that it needs at its start.

    Raises:
        RuntimeError: if the compiler is not GCC, or has no sanitizer.
    """
    build = compiler.load_build()
    command = build.find_compiler()
    if "clang" in build.describe(command):
        raise RuntimeError("cloth_sim_ros: the sanitizers' tests run with g++, not with clang: make sanitize CXX=g++.")
    paths = []
    # Without the C++ library at its start, the sanitizer aborts at the first exception.
    for name in ("libasan.so", "libstdc++.so.6"):
        done = subprocess.run([*command, f"-print-file-name={name}"], check=True, capture_output=True, text=True)
        path = done.stdout.strip()
        if path == name:  # the compiler's answer if it has no such file
            raise RuntimeError(f"cloth_sim_ros: {command[0]} has no {name}; install the package libasan8 or its like.")
        paths.append(path)
    return " ".join(paths)


def sanitize(tests: list[str]) -> int:
    """Run tests with the widest and the plainest library; return the first exit status that is not 0."""
    build = compiler.load_build()
    libraries = runpy.run_path(str(compiler.ENGINE / "instruction_set.py"))["libraries"]()
    names = list(dict.fromkeys([libraries[0], libraries[-1]]))  # the widest vectors that run here, and the plainest
    try:
        preload = preloaded()
        build.build(
            SANITIZED, names=names, sanitize=True, on_message=lambda text: compiler.report(f"cloth_sim_ros: {text}")
        )
    except (build.BuildError, RuntimeError) as error:
        compiler.report(str(error))
        return 1
    for name in names:
        library = SANITIZED / build.file_name(name)
        compiler.report(f"cloth_sim_ros: {' '.join(tests)} with {library.relative_to(ROOT)} ...")
        environment = {
            **os.environ,
            "CLOTH_SIM_ROS_ENGINE": str(library),
            "LD_PRELOAD": preload,
            # Python never frees all its memory.
            "ASAN_OPTIONS": "detect_leaks=0",
            # Small arrays get memory of their own too, whose ends are checked.
            "PYTHONMALLOC": "malloc",
            "UBSAN_OPTIONS": "print_stacktrace=1",
        }
        # Sanitizers report on the error stream, which pytest would capture.
        command = [sys.executable, "-m", "pytest", "--capture=sys", *tests]
        status = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
        if status:
            return status
    return 0


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--sanitize", nargs="+", metavar="TEST", help="run these tests under the sanitizers")
    parser.add_argument("--every", action="store_true", help="every library that this machine can run")
    arguments, unknown = parser.parse_known_args()
    if not compiler.ensure():
        return 1
    if arguments.sanitize:
        return sanitize([*arguments.sanitize, *unknown])
    if unknown:
        parser.error(f"unknown: {' '.join(unknown)}")
    build = compiler.load_build()
    try:
        names = build.names_here()
        build.build(
            names=names if arguments.every else names[:1],
            on_message=lambda text: compiler.report(f"cloth_sim_ros: {text}"),
        )
    except build.BuildError as error:
        compiler.report(str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
