# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Slow motions with and without sleep: `python test/soak_sleep.py [--seconds 60] [--only NAME]`.

The motion that sleep skips must stay within the tolerance. Exit status 1 if it does not.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from cloth_sim_ros.physics.control.constants import CONSTANTS
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.simulation.events import Event, Grasp, Target
from cloth_sim_ros.simulation.simulation import Simulation

BASE = {
    "cloth.resolution": [5, 6],
    "cloth.size": [1.0, 1.25],
    "material.stretch_modulus": 100.0,
    "material.shear_modulus": 20.0,
    "air.drag": 5.0,
    "tolerance": 1e-3,
    "rate": 30.0,
}
WEIGHTLESS: dict[str, Any] = {"gravity": [0.0, 0.0, 0.0]}
Commands = Callable[[Simulation, int], list[Event]]


def alone(_simulation: Simulation, _frame: int) -> list[Event]:
    """Return no events: an undisturbed cloth."""
    return []


def creeping(speed: float) -> Commands:
    """Return commands of a gripper that holds the last corner and creeps at a speed [m/s], ten targets per second."""

    def commands(simulation: Simulation, frame: int) -> list[Event]:
        if frame == 0:
            creeping.corner = simulation.positions[-1].copy()  # type: ignore[attr-defined]
            return [Target("gripper", tuple(creeping.corner)), Grasp("gripper", True)]  # type: ignore[attr-defined]
        if frame % 3:
            return []
        target = creeping.corner + np.array([0.0, speed * frame / simulation.scene.rate, 0.0])  # type: ignore[attr-defined]
        return [Target("gripper", tuple(target))]

    return commands


def pendulum(period: float) -> dict[str, Any]:
    """Return a sheet hung by its upper edge in oblique gravity, with a swing `period` [s] and almost no air."""
    return {
        "gravity": [0.3 * 4.0 * math.pi**2 / period**2, 0.0, -(4.0 * math.pi**2) / period**2],
        "air.drag": 0.02,
        "wind.normal_drag": 0.0,
        "cloth.anchors": ["top"],
    }


def motions() -> dict[str, tuple[dict[str, Any], Commands]]:
    """Return all motions by name."""
    wind = {f"wind of {speed:g} m/s": {"wind.velocity": [0.0, speed, 0.0]} for speed in (1e-4, 1e-3)}
    by_name: dict[str, tuple[dict[str, Any], Commands]] = {}
    for speed in (1e-6, 1e-5, 1e-4, 1e-3):
        by_name[f"gripper at {speed:g} m/s"] = ({}, creeping(speed))
    by_name["gripper at 1e-05 m/s, weightless"] = (WEIGHTLESS, creeping(1e-5))
    for name, values in wind.items():
        by_name[name] = (values, alone)
        by_name[f"{name}, weightless"] = ({**values, **WEIGHTLESS, "cloth.anchors": [""]}, alone)
        by_name[f"{name}, weightless, held"] = ({**values, **WEIGHTLESS}, alone)
    for drag in (50.0, 200.0, 1000.0):
        by_name[f"air of {drag:g} 1/s"] = ({"air.drag": drag}, alone)
    by_name["falls in air of 1000 1/s"] = ({"air.drag": 1000.0, "cloth.anchors": [""]}, alone)
    for period in (10.0, 30.0, 100.0, 300.0):
        by_name[f"pendulum of {period:g} s"] = (pendulum(period), alone)
    by_name["pendulum of 30 s, 1e-05 m"] = ({**pendulum(30.0), "tolerance": 1e-5}, alone)
    return by_name


def run(
    values: dict[str, Any], commands: Commands, seconds: float, *, calm: float
) -> Iterator[tuple[np.ndarray, bool]]:
    """Return positions and sleep flag of each frame, for a minimum calm time before sleep [s]."""
    simulation = Simulation(Scene.from_parameters({**BASE, **values}))
    for frame in range(round(seconds * simulation.scene.rate)):
        known, CONSTANTS.sleep_quiet_time = CONSTANTS.sleep_quiet_time, calm
        try:
            simulation.advance(commands(simulation, frame))
        finally:
            CONSTANTS.sleep_quiet_time = known
        yield simulation.positions, simulation.asleep


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description="Check that the motion skipped by sleep stays within the tolerance.")
    parser.add_argument("--seconds", type=float, default=60.0, help="simulated time of each motion [s]")
    parser.add_argument("--only", help="run only motions with this text in their name")
    options = parser.parse_args(arguments)
    chosen = {name: motion for name, motion in motions().items() if (options.only or "") in name}
    wrong = 0
    for name, (values, commands) in tqdm(chosen.items(), unit="motion", disable=None):
        most = slept = moved = 0.0
        # An infinite calm time: it never sleeps.
        twins = (run(values, commands, options.seconds, calm=calm) for calm in (CONSTANTS.sleep_quiet_time, math.inf))
        first = None
        for (x, asleep), (awake, _) in zip(*twins, strict=True):
            first = awake if first is None else first
            most = max(most, float(np.sqrt(((x - awake) ** 2).sum(axis=1)).max()))
            moved = max(moved, float(np.abs(awake - first).max()))
            slept += asleep
        tolerance = {**BASE, **values}["tolerance"]
        wrong += not most <= tolerance
        part = slept / (options.seconds * BASE["rate"])
        tqdm.write(f"{name}: {most:.2g} m off of {tolerance:g}, {moved:.2g} m moved, {part:.0%} asleep")
    print(f"{len(chosen)} slow motions of {options.seconds:g} s, {wrong} beyond the tolerance")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
