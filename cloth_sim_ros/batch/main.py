# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old address of `studies.main`."""

from cloth_sim_ros.studies.main import main

if __name__ == "__main__":
    raise SystemExit(main())
