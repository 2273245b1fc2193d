# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Events that leave contacts compressed: largest speed, rise and energy balance of the cloth in the second after them.

The cloths and events are those of `support.contact_starts`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from support.contact_starts import (
    COARSE,
    FASTEST,
    FINE,
    HIGHEST,
    OPEN,
    Start,
    added,
    changed,
    loaded,
    released,
    start,
    thickened,
    watch,
)
from support.obstacle_sheets import THICKNESS

from validation.report import Report, Table

#: Gaps over thickness that events leave, and depths by which a gripper presses a corner down before it opens [m].
GAPS, PRESSES = (0.02, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 0.95), (1e-3, 3e-3, 1e-2, 2e-2)
_Make = Callable[[str, float, float], Start]
_OBSTACLES = ("plane", "box", "sphere", "mesh")
PRESSED_ON = (*_OBSTACLES, "cloth")
#: Function of each event, and the supports it is run on.
SITUATIONS: dict[str, tuple[_Make, Sequence[str]]] = {
    "start": (start, (*_OBSTACLES, "cloth", "fold")),
    "thickness raised": (thickened, (*_OBSTACLES, "cloth")),
    "obstacle added": (added, (*_OBSTACLES, "box, hovering")),
    "state of another thickness": (loaded, (*_OBSTACLES, "cloth")),
    "shape or size changed": (changed, ("plane", "box, its size", "box", "sphere")),
}


def starts(report: Report, options: argparse.Namespace) -> None:
    """Tabulate the fastest particle of all situations by gap and by press depth."""
    columns = ["highest rise mm", "energy left over"]
    table = report.add_table(
        "Fastest particle m/s, by the gap that an event leaves", ["event", "on", *map(str, GAPS), *columns]
    )
    for name, (make, supports) in SITUATIONS.items():
        for support in supports:
            # The margin keeps a start at the smallest gap from being refused by rounding.
            _add(report, table, name, support, make, [max(gap, 0.02 + 1e-6) * THICKNESS for gap in GAPS])
    columns = ["on", *(f"{1e3 * depth:g}" for depth in PRESSES), *columns]
    pressed = report.add_table("Fastest particle m/s after a press by so many mm", columns)
    for support in PRESSED_ON:
        rise = _add(report, pressed, "", support, released, PRESSES)
        if support != "sphere" and rise > HIGHEST:
            report.fail(f"released on {support}: a corner rises {1e3 * rise:.3g} mm")
    report.note(
        f"Speeds and rises in the second after an event, at a tolerance of {COARSE:g} m; residuals of the energy "
        f"balance over what is turned over at {FINE:g} m. Rises of sheets without gravity are drift: on a sphere, on "
        "what became smaller, hovering, and folded."
    )


def _add(report: Report, table: Table, name: str, support: str, make: _Make, values: Sequence[float]) -> float:
    """Add a row; return the highest rise [m]."""
    observations = [watch(make(support, value, COARSE)) for value in values]
    left = max(watch(make(support, value, FINE)).left_over for value in values)
    rise = max(observation.rise for observation in observations)
    speeds = [observation.speed for observation in observations]
    table.rows.append([*filter(None, [name]), support, *speeds, 1e3 * rise, left])
    label = f"{name or 'released'}, {support}"
    for value, observation in zip(values, observations, strict=True):
        if observation.speed > FASTEST:
            report.fail(f"{label}, {1e3 * value:.3g} mm: a particle moves at {observation.speed:.3g} m/s")
    report.require(left <= OPEN, f"{label}: the energy balance leaves {left:.2g} of what is turned over")
    return rise
