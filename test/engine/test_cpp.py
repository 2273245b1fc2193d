# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""C++ unit tests of the engine (test/engine/cpp), for each instruction set that this machine runs.

Under `make sanitize` they run with the sanitizers, for the instruction set of the library that it loads.
"""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
from support import cpp_tests

from cloth_sim_ros.engine import build
from cloth_sim_ros.engine.instruction_set import libraries

SANITIZE = "libasan" in os.environ.get("LD_PRELOAD", "")
NAMES = [Path(os.environ["CLOTH_SIM_ROS_ENGINE"]).stem[1:]] if SANITIZE else libraries()
#: Sets between the widest and the narrowest vectors take as long, and rarely fail alone.
PARAMETERS = [
    pytest.param(name, marks=pytest.mark.long) if 0 < k < len(NAMES) - 1 else name for k, name in enumerate(NAMES)
]
#: A build with the sanitizers takes minutes.
pytestmark = pytest.mark.timeout(900)
ENVIRONMENT = {**cpp_tests.ENVIRONMENT, "ASAN_OPTIONS": "detect_leaks=0"}


@pytest.fixture(scope="module", params=PARAMETERS)
def program(request: pytest.FixtureRequest) -> Path:
    """Program of an instruction set."""
    try:
        build.find_compiler()
    except build.NoCompilerError as error:
        pytest.skip(str(error))
    return cpp_tests.build_program(request.param, sanitize=SANITIZE)


@pytest.mark.parametrize("name", cpp_tests.test_files())
def test_cpp(program: Path, name: str) -> None:
    command = [program, f"--source-file=*/{name}.cpp", "--no-version"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    passed = re.search(r"test cases: +(\d+) \| +(\d+) passed", done.stdout)
    assert passed and int(passed[1]) > 0, done.stdout
