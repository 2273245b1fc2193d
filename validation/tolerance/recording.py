# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded run of the engine through its public interface, frame by frame."""

from __future__ import annotations

import time

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
from cloth_sim_ros.simulation.simulation import Simulation
from validation.tolerance.compiled_reference import LANES, Held, ReferenceSystem
from validation.tolerance.random_grips import Player
from validation.tolerance.random_scenes import Draw

#: Largest difference between accelerations of the reference and of the plan, relative to the largest acceleration.
SAME_FORCES = 1e-12


@attrs.frozen(kw_only=True, eq=False)
class FrameRecord:
    """Inputs of one frame and its step statistics."""

    #: Grasped particles with the engine's points for each trajectory; None if nothing is grasped.
    held: Held | None
    #: True for grips that are new in this frame, shape (m,); their points follow from the particles' positions.
    fresh: NDArray[np.bool_]
    advance: Advance
    #: Wall time [s].
    seconds: float


@attrs.frozen(kw_only=True, eq=False)
class Recording:
    """Run with its states at the boundaries of frames."""

    draw: Draw
    system: ReferenceSystem
    #: (3, n) each [m], [m/s]; one more than frames.
    positions: list[Array]
    velocities: list[Array]
    frames: list[FrameRecord]
    #: Largest difference of accelerations, see `MAX_FORCE_MISMATCH`.
    mismatch: float
    #: Reason why it ended early; empty if it did not.
    trouble: str

    @property
    def period(self) -> float:
        """Length of a frame [s]."""
        return self.draw.scene.period


def record(draw: Draw) -> Recording:
    """Run a scene to its end."""
    simulation = Simulation(draw.scene, draw.state)
    player = Player(draw.script, simulation)
    system = ReferenceSystem(simulation.model)
    positions, velocities = [simulation.state.x.copy()], [simulation.state.v.copy()]
    frames: list[FrameRecord] = []
    mismatch, trouble = _mismatch(simulation, system, None, 0.0), ""
    looked = False
    for number in range(draw.frames):
        begin = time.perf_counter()
        try:
            done = simulation.advance(player.events(number)).advance
        except (UnstableError, ValueError) as error:
            trouble = f"frame {number}: {error}"
            break
        seconds = time.perf_counter() - begin
        if done is None:
            raise RuntimeError(f"frame {number} let no time pass")
        held, fresh = _held(simulation, frames[-1].held if frames else None)
        if held is not None and not looked:
            looked = True
            start = simulation.time - draw.scene.period
            mismatch = max(mismatch, _mismatch(simulation, system, held, start))
        frames.append(FrameRecord(held=held, fresh=fresh, advance=done, seconds=seconds))
        positions.append(simulation.state.x.copy())
        velocities.append(simulation.state.v.copy())
    return Recording(
        draw=draw,
        system=system,
        positions=positions,
        velocities=velocities,
        frames=frames,
        mismatch=mismatch,
        trouble=trouble,
    )


def _held(simulation: Simulation, before: Held | None) -> tuple[Held | None, NDArray[np.bool_]]:
    """Return the grasped particles of the last frame, and which grips are new."""
    grips = simulation.plan.grips
    if grips is None or not grips.particles.size:
        return None, np.zeros(0, dtype=bool)
    held = Held(
        paths=grips.paths.copy(),
        grippers=grips.gripper_indices(),
        particles=grips.particles.copy(),
        numbers=np.stack([grips.stiffness, grips.damping], axis=1),
        offsets=np.repeat(grips.offsets[:, :, None], LANES, axis=2),
    )
    fresh = np.ones(len(held.particles), dtype=bool)
    if before is not None:
        for gripper in np.unique(held.grippers):
            now, then = held.grippers == gripper, before.grippers == gripper
            same = np.array_equal(held.particles[now], before.particles[then])
            if same and np.array_equal(held.offsets[now], before.offsets[then]):
                fresh[now] = False
    return held, fresh


def _mismatch(simulation: Simulation, system: ReferenceSystem, held: Held | None, t: float) -> float:
    """Return the relative difference of accelerations in a perturbed state, less the rounding error."""
    rng = np.random.default_rng(7)
    state = simulation.state
    size = float(np.ptp(state.x, axis=1).max())
    free = simulation.model.inverse_masses > 0.0
    x = state.x + 1e-3 * size * rng.normal(size=state.x.shape) * free
    v = (state.v + 0.1 * rng.normal(size=state.v.shape)) * free
    since = 0.3 * simulation.scene.period
    expected = np.empty_like(x)
    simulation.plan.accelerations(t + since, x, v, expected)
    system.hold(held, t)
    found = system.accelerations(x, v, since=since)
    # Stiff springs convert the rounding of positions to accelerations.
    rounding = 4.0 * np.finfo(np.float64).eps * float(np.abs(x).max()) * simulation.plan.spectral_bounds(x)[0]
    beyond = float(np.abs(found - expected).max()) - rounding
    return max(0.0, beyond) / max(float(np.abs(expected).max()), 1e-30)
