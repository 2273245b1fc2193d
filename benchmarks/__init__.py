# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of the package: run time, memory, latency, other engines. Not installed.

`python -m benchmarks` lists them, `make bench ARGS=speed` runs one. Begin with `__main__` (the names) and `timing`.
Scenes stand in `test/support`; report tables and the command line in `validation`.
"""

import sys
from pathlib import Path

# Appended, so that `support` shadows no other module. Worker processes import this package first, therefore they find
# it too.
_TEST = str(Path(__file__).resolve().parents[1] / "test")
if _TEST not in sys.path:
    sys.path.append(_TEST)
