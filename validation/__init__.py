# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Validation of the physics: error, the tolerance's bound, stability, moduli, bending. Not installed.

`python -m validation` lists the commands, `make validate ARGS=tolerance` runs one. Begin with `__main__` (the names);
`command`, `report` and `case_pool` serve `benchmarks` too, which may import this package, but not the other way.
"""

import sys
from pathlib import Path

# At the end: the folder holds `support`, and nothing that may take the place of another module. Worker processes import
# this package first, therefore they find it too.
_TEST = str(Path(__file__).resolve().parents[1] / "test")
if _TEST not in sys.path:
    sys.path.append(_TEST)
