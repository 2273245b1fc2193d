# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of the package: run time, memory, latency, other engines. Not installed.

`python -m benchmarks` lists them, `make bench ARGS=speed` runs one. Begin with `__main__` (the names) and `timing`.
Scenes stand in `test/support`; report tables and the command line in `validation`.
"""

# It adds the test folder, which holds `support`, to the path of this process and of workers.
import validation  # noqa: F401
