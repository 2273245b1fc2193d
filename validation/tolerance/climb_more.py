# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Families of the search for violations with references of their own: contact, and close save times."""

from __future__ import annotations

import math

import numpy as np

from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.pair_springs import PairSprings
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.simulate import MAX_ADVANCE, simulate
from cloth_sim_ros.physics.state.state import State
from validation.tolerance.climb_scenes import GRAVITY, Trial, linear_window
from validation.tolerance.contact import (
    FINE,
    FRICTIONS,
    KINDS,
    draw_contact_scene,
    evaluate_contact_window,
    run_contact,
)
from validation.tolerance.linear_motion import LinearMotion
from validation.tolerance.random_scenes import log_uniform
from validation.tolerance.windows import Window

#: Limits of the number of particles along a side of a sheet in contact.
_SIDES = (2, 4)
#: Kinds of contact; the reference takes minutes for a fold that lies on itself.
_KINDS = [kind for kind in KINDS if kind != "itself"]
#: Number of save times of a scene.
_MAX_SAVES = 4000


def contact(rng: np.random.Generator) -> Trial:
    """Evaluate a small sheet that falls on an obstacle, in its first second."""
    kind, friction = str(rng.choice(_KINDS)), float(rng.choice(FRICTIONS))
    draw = draw_contact_scene(rng, kind, friction, _SIDES)
    run = run_contact(draw, duration=1.0)
    windows, trouble = list[Window](), run.trouble
    if not trouble:
        # Perturbations are a hundred times larger.
        fine = min(max(FINE, 1e-4 * draw.scene.tolerance), 1e-9)
        rngs = np.random.default_rng(0)
        try:
            windows.append(evaluate_contact_window(run, 0, len(run.frames), rngs, fine=fine, rough=10.0 * fine))
        except ArithmeticError as error:
            trouble = str(error)
    parameters = {**draw.scene.parameters(), "positions": draw.state.positions.tolist()}
    return Trial(
        tolerance=draw.scene.tolerance, words=draw.words, parameters=parameters, windows=tuple(windows), trouble=trouble
    )


def save_times(rng: np.random.Generator) -> Trial:
    """Evaluate a mass on joints whose motion `simulate` saves more often than each frame, at unequal intervals."""
    count = int(rng.integers(2, 4))
    masses = [log_uniform(rng, 1e-3, 1.0) for _ in range(count)]
    frequencies = [log_uniform(rng, 0.3, 3000.0) for _ in range(count - 1)]
    rigidity = [mass * frequency**2 for mass, frequency in zip(masses[1:], frequencies, strict=True)]
    damping = [
        2.0 * float(rng.uniform(0.0, 1.0)) * mass * frequency if rng.random() < 0.7 else 0.0
        for mass, frequency in zip(masses[1:], frequencies, strict=True)
    ]
    joints = PairSprings([[k, k + 1] for k in range(count - 1)], 0.0, rigidity, damping)
    model = Model(masses, [joints, Gravity(GRAVITY), Drag(log_uniform(rng, 0.01, 3.0))], anchors=[0])
    spacing = log_uniform(rng, 1e-4, 0.3)
    state = State(np.array([[0.0, 0.0, -spacing * k] for k in range(count)]))
    state.v[:, 1:] = float(rng.uniform(0.0, 1.0)) * rng.normal(size=(3, count - 1))
    tolerance, interval = log_uniform(rng, 1e-9, 1e-2), log_uniform(rng, 1.0 / _MAX_SAVES, MAX_ADVANCE)
    # Alternate intervals differ.
    share = float(rng.uniform(0.1, 0.9))
    durations = [2.0 * interval * part for part in (share, 1.0 - share)] * math.ceil(0.5 / interval)
    parameters = {
        "masses": masses,
        "rigidity": rigidity,
        "damping": damping,
        "drag": float(model.forces[2].rate),  # type: ignore[attr-defined]
        "positions": state.positions.tolist(),
        "velocities": state.velocities.tolist(),
        "tolerance": tolerance,
        "intervals": durations[:2],
    }
    exact = LinearMotion(model, state.x.copy(), state.v.copy())
    times = np.cumsum(durations)
    motion = simulate(model, state, float(times[-1]), save_at=times, tolerance=tolerance)
    end = int(np.searchsorted(times, 1.0 + 1e-9))
    saved = [positions.T for positions in motion.positions[:end]]
    window = linear_window(exact, saved, durations[:end], motion.advances, tolerance)
    words = f"{count - 1} joints, saved each {interval:.2g} s"
    return Trial(tolerance=tolerance, words=words, parameters=parameters, windows=(window,))
