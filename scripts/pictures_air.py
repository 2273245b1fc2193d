# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of air across the sheet, computed anew: `python -m scripts.pictures_air docs/images`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

#: The recorded cloth: side [m], and density [kg/m^2] by its weight over the air that it meets.
SIDE, DENSITY = 0.3, 0.45 / 2.30
#: How far the held corners are carried across the sheet [m], in what time [s], and what follows [s]: at most 0.75 m/s.
WAY, CARRIED, WATCHED = 0.25, 0.5, 5.0
DRAGS = (0.0, 0.45)
_UPRIGHT, ACROSS = (0.0, 0.0, 0.0, 1.0), np.array([0.0, 1.0, 0.0])


def swing(normal_drag: float) -> tuple[Array, Array]:
    """Carry a hung cloth by two corners, stop, and let it swing.

    Args:
        normal_drag: `wind.normal_drag` [N s/m^3].

    Returns:
        Times since the stop [s], (frames,), and how far the free edge's middle is from below the held corners [m].
    """
    values = {
        "cloth.size": [SIDE, SIDE],
        "cloth.resolution": [21, 21],
        "cloth.anchors": [""],
        "material.density": DENSITY,
        "wind.normal_drag": normal_drag,
        "grippers": ["left", "right"],
        "gripper.radius": 0.02,
    }
    scene = Scene.from_parameters(values)
    cloth = Simulation(scene)
    places = scene.initial_positions()
    rows, columns = scene.shape
    held = {"left": places[0], "right": places[columns - 1]}
    middle = (rows - 1) * columns + columns // 2
    times, ways = [], []
    for frame in range(round((CARRIED + WATCHED) * scene.rate) + 1):
        part = min(frame * scene.period / CARRIED, 1.0)
        moved = WAY * part**2 * (3.0 - 2.0 * part)
        events: list[Event] = [Target(name, place + moved * ACROSS, _UPRIGHT) for name, place in held.items()]
        if frame == 0:
            events += [Grasp(name, True) for name in held]
        cloth.advance(events)
        times.append(frame * scene.period - CARRIED)
        ways.append(cloth.positions[middle, 1] - places[0, 1] - moved)
    return np.array(times), np.array(ways)


def draw_swing(pyplot: Any, folder: Path) -> Path:
    """Draw the swing of a cloth with and without air across it."""
    figure, axis = pyplot.subplots(figsize=(9, 3.5), layout="constrained")
    for normal_drag in DRAGS:
        times, ways = swing(normal_drag)
        axis.plot(times, 1e3 * ways, label=f"wind.normal_drag {normal_drag:g} N s/m³")
    axis.axvspan(-CARRIED, 0.0, color="0.9", label="corners are carried")
    axis.set(
        xlim=(-CARRIED, WATCHED), xlabel="time since the corners stopped [s]", ylabel="free edge, behind or ahead [mm]"
    )
    axis.set_title(f"A cloth of {SIDE:g} m, held at two corners")
    figure.legend(loc="outside lower center", ncols=3)
    path = folder / "air_swing.png"
    figure.savefig(path, dpi=100)
    return path


def main() -> int:
    """Draw the picture into the folder that is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="where the picture goes, e.g. docs/images")
    folder = parser.parse_args().folder
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    print(draw_swing(pyplot, folder))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
