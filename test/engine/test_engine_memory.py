# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A frame without enough memory reports it, and leaves no trace in the next one."""

from __future__ import annotations

import re
import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from cloth_sim_ros.engine import build
from cloth_sim_ros.engine.instruction_set import libraries


@pytest.mark.skipif("avx2" not in libraries(), reason="the program is built for AVX2")
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no g++")
def test_every_allocation_may_fail(tmp_path: Path) -> None:
    source, program = Path(__file__).with_name("no_memory.cpp"), tmp_path / "no_memory"
    engine, compiler = Path(build.__file__).parent, build.find_compiler()
    with ExitStack() as stack:
        # The objects of the library, which exist if it is built.
        version = build.describe(compiler)
        objects = build.compile_units(stack, compiler, version, ["avx2"], sanitize=False, sources=engine)["avx2"]
        command = [
            *compiler,
            *build.flags("avx2"),
            "-I",
            str(engine),
            str(source),
            *map(str, objects),
            "-o",
            str(program),
        ]
        subprocess.run(command, check=True, capture_output=True)
    output = subprocess.run([program], check=True, capture_output=True, text=True).stdout
    lines = [
        re.fullmatch(r"(.*): (\d+) reported, 0 crashed, 0 wrong, 0 failed later", line) for line in output.splitlines()
    ]
    assert all(lines) and len(lines) == 6, output
    # Each frame allocates a few dozen times, and nearly each of them matters.
    assert min(int(line[2]) for line in lines) > 25, output
