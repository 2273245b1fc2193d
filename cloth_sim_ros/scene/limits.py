# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Limits of parameters that no range can say, as numbers and in words."""

from __future__ import annotations

#: Largest number of particles of a cloth.
MAX_PARTICLES = 4_000_000
#: Positions of metres are rounded to about 1e-16 of themselves, a few thousand times a frame [m].
MIN_TOLERANCE = 1e-12
#: Of coefficients of friction.
FRICTION = "1 or 2 entries, the second no larger"
#: Of orientations.
QUATERNION = "finite entries, not all 0"
#: Of names of coordinate frames that may be left out.
FRAME = "no / as its first character, no blanks around it"
#: Of names of grippers and obstacles.
NAMES = "letters, digits and _ with a letter first, each name once"
