# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stress cases by the thousand, and step limits found beside those predicted."""
