# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics of depth cameras, rendered and published by a process of their own.

They cost no time and no import unless `cameras` names one. Begin with `cameras`, the node's part. `camera_worker` is
the process.
"""
