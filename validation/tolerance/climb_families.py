# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Table of the families that the search for violations climbs over."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from validation.tolerance import climb_hidden, climb_kinks, climb_scenes
from validation.tolerance.climb_scenes import Trial

#: Evaluation of each family by the draws of a generator, and the number of coordinates that a climb varies.
FAMILIES: dict[str, tuple[Callable[[np.random.Generator], Trial], int]] = {
    "falling": (climb_scenes.falling, 6),
    "joints": (partial(climb_scenes.network, is_joint=True), 20),
    "springs": (partial(climb_scenes.network, is_joint=False), 20),
    "thrown": (climb_scenes.thrown, 8),
    "snapping": (climb_scenes.snapping, 14),
    "hung": (climb_scenes.hung, 16),
    "moving": (climb_scenes.moving, 40),
    "carried-air": (partial(climb_scenes.moving, carries_air=True), 42),
    "fabric": (climb_scenes.fabric, 60),
    "friction": (climb_scenes.friction, 50),
    "mesh": (climb_scenes.mesh, 40),
    "mesh-air": (partial(climb_scenes.mesh, carries_air=True), 42),
    "events": (climb_scenes.events, 70),
    "contact": (climb_scenes.contact, 24),
    "save-times": (climb_scenes.save_times, 18),
    "shaken": (climb_scenes.shaken, 40),
    "prescribed": (climb_scenes.prescribed, 45),
    "stiffening": (climb_kinks.stiffening, 13),
    "gust": (climb_kinks.gust, 15),
    "hinges": (climb_kinks.hinges, 12),
    "yielding": (climb_kinks.yielding, 11),
    "gliding": (climb_kinks.gliding, 11),
    "landing": (climb_kinks.landing, 8),
    "jaws": (climb_kinks.jaws, 11),
    "free_fall": (climb_hidden.free_fall, 6),
    "crossing": (climb_hidden.crossing, 9),
    "passing": (climb_hidden.passing, 9),
    "orbit": (climb_hidden.orbit, 10),
    "stairs": (climb_hidden.stairs, 9),
    "sticking": (climb_kinks.sticking, 11),
    "dipping": (climb_hidden.dipping, 10),
}
