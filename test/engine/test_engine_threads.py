# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Threads of the engine: the pool avoids a late one, and concurrent runs have the bits of those in turn."""

from __future__ import annotations

import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from cloth_sim_ros.engine import build
from cloth_sim_ros.engine.instruction_set import libraries


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no g++")
def test_late_thread_is_retried_after_its_delay(tmp_path: Path) -> None:
    source, program = Path(__file__).with_name("late_thread.cpp"), tmp_path / "late_thread"
    command = ["g++", "-std=c++20", "-pthread", "-O1", *build.WARNINGS, "-I", str(Path(build.__file__).parent)]
    subprocess.run([*command, str(source), "-o", str(program)], check=True, capture_output=True, text=True)
    output = subprocess.run([program], check=True, capture_output=True, text=True, timeout=120).stdout
    assert output.splitlines() == [f"{late} late: 1 meanwhile, 2 later" for late in (1, 2, 3)]


@pytest.mark.skipif("avx2" not in libraries(), reason="the program is built for AVX2")
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no g++")
def test_runs_with_contact_are_concurrent(tmp_path: Path) -> None:
    source, program = Path(__file__).with_name("concurrent_runs.cpp"), tmp_path / "concurrent_runs"
    engine, compiler = Path(build.__file__).parent, build.find_compiler()
    with ExitStack() as stack:
        # The objects of the library, which exist if it is built.
        version = build.describe(compiler)
        objects = build.compile_units(stack, compiler, version, ["avx2"], sanitize=False, sources=engine)["avx2"]
        command = [*compiler, *build.flags("avx2"), "-I", str(engine), str(source), *map(str, objects)]
        subprocess.run([*command, "-o", str(program)], check=True, capture_output=True)
    output = subprocess.run([program], check=True, capture_output=True, text=True, timeout=300).stdout
    assert output.splitlines() == [
        "no contact: clear, 2 threads, same bits",
        "separated sheet: clear, 2 threads, same bits",
        "layers: in contact, 2 threads, same bits",
        "listed layers: in contact, 2 threads, same bits",
        "table: in contact, 2 threads, same bits",
        "table and point: in contact, 2 threads, same bits",
        "jaws: in contact, 2 threads, same bits",
        "all: in contact, 2 threads, same bits",
        # Python evaluates forces in one thread.
        "callback: in contact, 1 threads, same bits",
    ]
