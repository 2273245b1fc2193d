# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stacks of two layers that stick or slide by friction, on a slope.

Two sheets, the lower one held, the upper one of 0.2 m free upon it; thickness 2 mm, no air. Gravity is
tilted instead of the stack.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.accounting.energy_balance import EnergyBalance
from cloth_sim_ros.physics.accounting.work_accumulator import WorkAccumulator
from cloth_sim_ros.physics.integrators.base import Advance
from cloth_sim_ros.physics.model.forces.contact import Contact, ContactSurface
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.grid import grid_triangles
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.model.sheets.surface import Surface
from cloth_sim_ros.physics.plan.plan import compile
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY, LAYER_SIDES
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from cloth_sim_ros.scene.sections import MaterialParameters
from support.obstacle_sheets import BORNE, FRAME, THICKNESS

G = 9.81
#: A sheet that moves by this much in half a second slides [m].
SLIPPED = 1e-4


def stack_geometry(count: int, below: int, turned: float) -> tuple[Array, NDArray[np.int64], list[int]]:
    """Positions, triangles and the lower sheet's particles of a stack.

    Args:
        count: particles along a side of the upper sheet, 0.2 m.
        below: of the lower sheet, 0.4 m.
        turned: of the upper sheet about the vertical [rad].
    """

    def square(edge_length: float, n_per_edge: int, height: float, angle: float) -> Array:
        axis = (np.arange(n_per_edge) / (n_per_edge - 1) - 0.5) * edge_length
        x, y = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
        cos, sin = math.cos(angle), math.sin(angle)
        return np.stack([cos * x - sin * y, sin * x + cos * y, np.full(x.size, height)], axis=1)

    lower, upper = square(0.4, below, 0.0, 0.0), square(0.2, count, BORNE * THICKNESS, turned)
    # Not over the lower sheet's particles and edges.
    upper[:, :2] += [0.0031, 0.0017]
    triangles = np.concatenate(
        [grid_triangles(below, below, "alternating"), grid_triangles(count, count, "alternating") + below * below]
    )
    return np.concatenate([lower, upper]), triangles, list(range(below * below))


def stack(
    count: int, below: int, degrees: float, friction: tuple[float, ...], *, turned: float = 0.3, tolerance: float = 1e-4
) -> Stack:
    """A stack that is laid at rest, with gravity as on a slope."""
    places, triangles, held = stack_geometry(count, below, turned)
    angle, material = math.radians(degrees), MaterialParameters()
    first = len(held)
    lower = MeshSheet(rest_positions=places[:first], surface=Surface.from_triangles(triangles[triangles[:, 0] < first]))
    upper = MeshSheet(
        rest_positions=places[first:], surface=Surface.from_triangles(triangles[triangles[:, 0] >= first] - first)
    )
    threads = upper.springs(
        stretch_modulus=material.stretch_modulus, k_d0=material.damping, density=material.density, viscosity=0.0
    )
    springs = PairSprings(threads.pairs + first, threads.rest_length, threads.stiffness, threads.damping)
    surface = ContactSurface(triangles, places, thickness=THICKNESS, friction=(friction[0], friction[-1]))
    forces = [
        springs,
        Gravity([G * math.sin(angle), 0.0, -G * math.cos(angle)]),
        Contact(thickness=THICKNESS, surface=surface),
    ]
    masses = np.concatenate([sheet.masses(material.density) for sheet in (lower, upper)])
    return Stack(Model(masses, forces, anchors=held), places, tolerance)


class Stack:
    """Two layers, advanced frame by frame."""

    def __init__(self, model: Model, positions: Array, tolerance: float) -> None:
        self.plan, self.state, self.frames = compile(model), State(positions), 0
        self._steps = Scene.from_parameters({"tolerance": tolerance}).build_integrator()

    def advance(self, accumulator: WorkAccumulator | None = None) -> Advance:
        """Advance by one frame."""
        done = self._steps.advance(self.plan, self.state, self.frames * FRAME, FRAME, accumulator)
        self.frames += 1
        return done


def slope_position(motion: Stack) -> float:
    """Return the mean position of free particles along the slope [m]."""
    return float(motion.state.x[0, motion.plan.model.inverse_masses > 0.0].mean())


def advance(motion: Stack, frames: int) -> float:
    """Advance; return by how much the upper sheet moved [m]."""
    start = slope_position(motion)
    for _ in range(frames):
        motion.advance()
    return slope_position(motion) - start


def anchors(motion: Stack) -> Array:
    """Anchors on layers, shape (sides, 4, particles)."""
    return motion.state.memory[ANCHORS_KEY][-LAYER_SIDES:].copy()


def is_sliding(motion: Stack) -> bool:
    """Return true if a stack slides."""
    advance(motion, 12)
    return advance(motion, 18) > SLIPPED


def advance_with_balance(motion: Stack, frames: int) -> tuple[EnergyBalance, float, float]:
    """Advance with a balance of energy; return it, the largest residual [J], and the least loss by friction in a frame
    [J].
    """
    balance = EnergyBalance(motion.plan, motion.state)
    worst, min_loss, previous_loss = 0.0, math.inf, 0.0
    for _ in range(frames):
        motion.advance(balance.accumulator)
        worst = max(worst, abs(balance.add_advance(motion.frames * FRAME, motion.state)))
        min_loss, previous_loss = min(min_loss, balance.friction_work - previous_loss), balance.friction_work
    return balance, worst, min_loss


def friction_error(count: int, below: int, mu: float) -> float:
    """Return the relative error of kinetic friction, on a slope ten degrees above the angle of static friction."""
    degrees = math.degrees(math.atan(mu)) + 10.0
    motion = stack(count, below, degrees, (mu, 0.8 * mu))
    slope_positions = []
    for _ in range(18):
        motion.advance()
        slope_positions.append(slope_position(motion))
    angle = math.radians(degrees)
    acceleration = (slope_positions[-1] - 2.0 * slope_positions[-7] + slope_positions[-13]) / (6 * FRAME) ** 2
    return (G * math.sin(angle) - acceleration) / (0.8 * mu * G * math.cos(angle)) - 1.0
