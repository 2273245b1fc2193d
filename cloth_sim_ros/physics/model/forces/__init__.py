# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Forces, one file each: parameters, units and parts for the engine. Begin with `force`."""
