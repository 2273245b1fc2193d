# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Limits of parameters that no range expresses, as numbers and text."""

from __future__ import annotations

#: Largest number of particles of a cloth.
MAX_PARTICLES = 4_000_000
#: Smallest tolerance [m]. Positions of metres have rounding errors of about 1e-16, a few thousand times a frame.
MIN_TOLERANCE = 1e-12
#: Constraint of coefficients of friction.
FRICTION = "1 or 2 entries, the second no larger"
#: Constraint of orientations.
QUATERNION = "finite entries, not all 0"
#: Constraint of optional names of coordinate frames.
FRAME = "no / as its first character, no blanks around it"
#: Constraint of names of grippers, obstacles and cameras.
NAMES = "letters, digits and _ with a letter first, each name once"
