# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The section of grippers: how they hold, and by what."""

from __future__ import annotations

import attrs

from cloth_sim_ros.physics.obstacle_shapes import MOST_SIZE
from cloth_sim_ros.scene.limits import FRAME, FRICTION
from cloth_sim_ros.scene.parameters import parameter

#: Default limit of a gripper's speed, that of obstacles [m/s]: robots move at 2 to 3 m/s, fast parallel ones at 10.
MAX_SPEED = 10.0
#: How a gripper may hold.
MODES = ATTACH, PINCH = ("attach", "pinch")


@attrs.frozen(kw_only=True)
class Gripper:
    """What every gripper is like."""

    mode: str = parameter(
        "string",
        "attach",
        "How a gripper holds: attach takes hold of particles; pinch closes two pads on the cloth, held by friction. "
        "<gripper>.mode says so of one gripper",
        choices=MODES,
    )
    radius: float = parameter(
        "double",
        0.05,
        "Closing grabs the particles within this distance",
        unit="m",
        least=0.0,
        most=100.0,
        live=True,
        observes=True,
    )
    stiffness: float = parameter(
        "double",
        1000.0,
        "Stiffness of the zero-length spring that holds a particle inside the sheet; in proportion to mass at borders",
        unit="N/m",
        least=0.0,
        most=1e8,
        open_least=True,
        live=True,
    )
    damping: float = parameter(
        "double",
        0.5,
        "Dimensionless damping of that spring; 2 is critical for a free particle",
        least=0.0,
        most=10.0,
        live=True,
    )
    timeout: float = parameter(
        "double",
        0.0,
        "A closed gripper lets go when no target has come for this long; 0 never, it keeps its last target",
        unit="s",
        least=0.0,
        most=1e6,
        live=True,
        observes=True,
    )
    frame: str = parameter(
        "string",
        "",
        "TF frame that a gripper follows, {gripper} standing for its name; empty for none. Needs tf2_ros. "
        "<gripper>.frame says so of one gripper",
        constraint=FRAME,
    )
    max_speed: float = parameter(
        "double",
        MAX_SPEED,
        "Fastest that a gripper moves what it holds to follow its target, mean over a frame; 0 sets no limit, but pads "
        f"keep to {MAX_SPEED:g} m/s. <gripper>.max_speed says so of one gripper",
        unit="m/s",
        least=0.0,
        most=1e6,
        live=True,
        observes=True,
    )
    pad_size: tuple[float, ...] = parameter(
        "double[]",
        (0.06, 0.02, 0.06),
        "Of a gripper that pinches: edge lengths of each pad along the gripper's axes; pads close along y. They pinch "
        "particles, not what is between them: pads smaller than a cell of the cloth may miss it",
        unit="m",
        length=3,
        least=0.0,
        most=MOST_SIZE,
        open_least=True,
    )
    opening: float = parameter(
        "double",
        0.06,
        "Of a gripper that pinches: way between the faces of its pads when it is open",
        unit="m",
        least=0.0,
        most=MOST_SIZE,
        open_least=True,
        live=True,
    )
    force: float = parameter(
        "double",
        5.0,
        "Of a gripper that pinches: force with which each pad presses at rest; cloth of a weight G slips out below G / "
        "(2 friction)",
        unit="N",
        least=0.0,
        most=1e4,
        open_least=True,
        live=True,
    )
    speed: float = parameter(
        "double",
        0.05,
        "Of a gripper that pinches: speed of each pad in the air",
        unit="m/s",
        least=1e-4,
        most=10.0,
        live=True,
    )
    friction: tuple[float, ...] = parameter(
        "double[]",
        (0.6, 0.5),
        "Of a gripper that pinches: coefficients of friction between its pads and the cloth, as those of an obstacle",
        least=0.0,
        most=1e3,
        constraint=FRICTION,
        live=True,
    )
