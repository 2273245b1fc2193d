# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Old address of `learning`, `studies` and `fit`, kept for one release (docs/migration.md)."""

from cloth_sim_ros.learning import __all__, __getattr__  # noqa: F401
