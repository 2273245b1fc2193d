# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stability of a gripper that another simulator moves, and that feels the cloth's force some frames later.

Model of the other simulator: a wrist of mass M, held by a spring kp and a damper d. In each frame it feels the mean
force of an earlier frame, while the cloth follows its position. A frame of length h delays the force by h: half a
frame because it is a mean, half a frame because it is held. n frames on the way delay it by τ = (n + 1) h.

A taut cloth is a spring k, so M z'' + d z' + kp z + k z(t - τ) = 0. At the border z = exp(iωt) gives
M ω² = kp + k cos ωτ and d ω = k sin ωτ. Therefore d > k τ suffices.

A free cloth of mass m is an inertia, M z'' + m z''(t - τ) + ... = 0. Its border at high frequencies is m = M, for any
delay and damping.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from cloth_sim_ros import Grasp, Scene, Simulation, Target
from cloth_sim_ros.simulation.events import Event
from validation.report import Report, Table

#: Mass of the wrist [kg] and stiffness of its holder [N/m].
_MASS, _HOLDER = 2.0, 1000.0
#: Rate at which the wrist of a free sheet comes to rest [1/s].
_RATE = 10.0
#: Length of the square sheet [m] and its mass per area [kg/m^2].
_LENGTH, _DENSITY = 0.2, 0.2
#: Frames of a run, and relative accuracy of a border.
_FRAMES, _ACCURACY = 480, 0.01
#: First displacement of the wrist, and stretch of the taut sheet [m].
_START, _STRETCH = 1e-3, 0.01


class CoupledWrist:
    """A wrist that leads an edge of a sheet and feels its force.

    Args:
        modulus: Young's modulus of the sheet [N/m].
        is_free: the wrist carries the sheet by its upper edge; otherwise that edge is held and the wrist stretches it.
        n_frames: frames that a force is on the way.
    """

    def __init__(self, modulus: float, *, is_free: bool, n_frames: int) -> None:
        parameters = {"material.stretch_modulus": modulus, "cloth.anchors": [""] if is_free else ["top"]}
        shape = {"cloth.size": [_LENGTH, _LENGTH], "cloth.resolution": [5, 5], "gripper.radius": 0.55 * _LENGTH}
        parameters["material.density"] = _DENSITY
        grip = {
            "grippers": ["hand"],
            "gripper.model": "prescribed",
            "tolerance": 1e-5,
            "air.drag": 0.0,
            "wind.normal_drag": 0.0,
        }
        self._simulation = Simulation(Scene.from_parameters({**shape, **grip, **parameters}))
        self.period = self._simulation.scene.period
        x = self._simulation.state.x
        edge = x[2].max() if is_free else x[2].min()
        self._grasp_point = x[:, abs(x[2] - edge) < 1e-6].mean(axis=1)
        self._forces: deque[float] = deque([0.0] * (n_frames + 1))
        self._rest_force = 0.0
        self._frame([Target("hand", tuple(self._grasp_point)), Grasp("hand", True)])
        self._simulation.advance()
        if not is_free:
            # Taut, so that it never goes slack.
            self._grasp_point[2] -= _STRETCH
        self._rest_force = self.force_at(0.0)

    def force_at(self, z: float) -> float:
        """Return the change of force [N] after the wrist has moved to z [m] and rested."""
        return [self._lead(z) for _ in range(240)][-1]

    def is_stable(self, mass: float, damping: float, holder: float) -> bool:
        """Return True if the wrist's energy decreases after a small displacement."""
        matrix = np.array([[0.0, 1.0, 0.0], [-holder / mass, -damping / mass, 1.0 / mass], [0.0, 0.0, 0.0]])
        advance, state = expm(self.period * matrix), np.array([_START, 0.0, 0.0])
        energies = []
        for _ in range(_FRAMES):
            state[2] = self._forces.popleft()
            state = advance @ state
            if abs(state[0]) > 100.0 * _START:
                return False
            self._forces.append(self._lead(float(state[0])))
            energies.append(0.5 * mass * state[1] ** 2 + 0.5 * holder * state[0] ** 2)
        first, last = np.max(energies[_FRAMES // 4 : _FRAMES // 2]), np.max(energies[-_FRAMES // 4 :])
        return bool(last < first)

    def _lead(self, z: float) -> float:
        """Move the wrist to z [m] within a frame; return the change of the frame's mean force [N]."""
        position = self._grasp_point + np.array([0.0, 0.0, z])
        return self._frame([Target("hand", tuple(position.tolist()))]) - self._rest_force

    def _frame(self, events: list[Event] | None = None) -> float:
        return float(self._simulation.advance(events or []).wrenches[0, 2])


def border(is_stable: Callable[[float], bool], low: float, high: float) -> float:
    """Return the border between an unstable low value and a stable high one, or a bound if there is none."""
    while high > (1.0 + _ACCURACY) * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if is_stable(middle) else (middle, high)
    return float(np.sqrt(low * high))


def predicted_damping(stiffness: float, delay: float) -> float:
    """Return the damping [N s/m] at the border of the wrist with a delayed spring."""
    omega = brentq(
        lambda w: _MASS * w * w - _HOLDER - stiffness * np.cos(w * delay), 1e-6, np.sqrt((_HOLDER + stiffness) / _MASS)
    )
    return float(stiffness * np.sin(omega * delay) / omega)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--frames", type=int, nargs="+", default=[0, 1, 3], help="frames that a force is on the way")
    parser.add_argument("--moduli", type=float, nargs="+", default=[50.0, 200.0], help="moduli of the sheets [N/m]")


def run(options: argparse.Namespace) -> Report:
    """Find the borders of stability by bisection."""
    columns = ["stiffness k N/m", "delay τ frames", "damping N s/m", "predicted N s/m", "k τ / damping"]
    taut = Table("Least damping of a wrist that leads a taut sheet", columns)
    inertia = Table(
        "Least mass of a wrist that carries a free sheet", ["modulus N/m", "delay τ frames", "mass / sheet"]
    )
    for modulus in options.moduli:
        for n_frames in options.frames:
            taut.rows.append(_taut_row(modulus, n_frames))
            inertia.rows.append(_inertia_row(modulus, n_frames))
    return Report("Stability of coupled simulators", tables=[taut, inertia])


def _taut_row(modulus: float, n_frames: int) -> list[Any]:
    wrist = CoupledWrist(modulus, is_free=False, n_frames=n_frames)
    stiffness = -wrist.force_at(_START) / _START
    delay = (n_frames + 1) * wrist.period

    def is_stable(damping: float) -> bool:
        return CoupledWrist(modulus, is_free=False, n_frames=n_frames).is_stable(_MASS, damping, _HOLDER)

    limit = stiffness * delay
    damping = border(is_stable, 0.1 * limit, 2.0 * limit)
    return [stiffness, n_frames + 1, damping, predicted_damping(stiffness, delay), limit / damping]


def _inertia_row(modulus: float, n_frames: int) -> list[Any]:
    sheet = _DENSITY * _LENGTH * _LENGTH

    def is_stable(mass: float) -> bool:
        wrist = CoupledWrist(modulus, is_free=True, n_frames=n_frames)
        # A damped holder of the same frequency for each mass.
        return wrist.is_stable(mass, mass * _RATE, 0.25 * mass * _RATE * _RATE)

    return [modulus, n_frames + 1, border(is_stable, 0.05 * sheet, 20.0 * sheet) / sheet]
