# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Validation of the physics: error, the tolerance's bound, stability, moduli, bending. Not installed.

`python -m validation` lists the commands, `make validate ARGS=tolerance` runs one. `__main__` names the commands.
`command`, `report` and `case_pool` serve `benchmarks` too: `benchmarks` may import this package, not the reverse.
"""

import sys
from pathlib import Path

# The test folder, which holds `support`, is appended, so that it shadows no other module. Worker processes import this
# package first, therefore they find `support` too.
_TEST = str(Path(__file__).resolve().parents[1] / "test")
if _TEST not in sys.path:
    sys.path.append(_TEST)
