# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old address of `fit.main`."""

from cloth_sim_ros.fit.main import main

if __name__ == "__main__":
    raise SystemExit(main())
