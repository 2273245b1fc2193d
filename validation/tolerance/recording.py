# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded run of the engine through its public interface, frame by frame."""

from __future__ import annotations

import time

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.integrators.base import Advance, UnstableError
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import SetParameters
from cloth_sim_ros.simulation.simulation import Simulation
from validation.tolerance.compiled_reference import LANES, GripTable, ReferenceSystem
from validation.tolerance.random_grips import RandomGripPlayer
from validation.tolerance.random_scenes import RandomScene

#: Largest difference between accelerations of the reference and of the plan, relative to the largest acceleration.
MAX_FORCE_MISMATCH = 1e-12


@attrs.frozen(kw_only=True, eq=False)
class RecordedFrame:
    """Inputs of one frame and its step statistics."""

    #: Equations of motion.
    system: ReferenceSystem
    #: Grasped particles with the engine's points for each trajectory; None if nothing is grasped.
    grasped: GripTable | None
    #: True for grips that are new in this frame, shape (m,); their points follow from the particles' positions.
    is_new_grip: NDArray[np.bool_]
    advance: Advance
    #: Wall time [s].
    seconds: float


@attrs.frozen(kw_only=True, eq=False)
class RecordedRun:
    """Run with its states at the boundaries of frames."""

    draw: RandomScene
    #: Equations of motion at the end.
    system: ReferenceSystem
    #: (3, n) each [m], [m/s]; one more than frames.
    positions: list[Array]
    velocities: list[Array]
    #: Plastic lengths of hinges with friction, one more than frames [m]; empty arrays without friction of bending.
    plastic_lengths: list[Array]
    frames: list[RecordedFrame]
    #: Largest difference of accelerations, see `MAX_FORCE_MISMATCH`.
    mismatch: float
    #: Reason why it ended early; empty if it did not.
    trouble: str

    @property
    def period(self) -> float:
        """Length of a frame [s]."""
        return self.draw.scene.period


def record_run(draw: RandomScene) -> RecordedRun:
    """Run a scene to its end."""
    simulation = Simulation(draw.scene, draw.state)
    player = RandomGripPlayer(draw.script, simulation)
    system = ReferenceSystem(simulation.model)
    positions, velocities = [simulation.state.x.copy()], [simulation.state.v.copy()]
    plastic_lengths = [_plastic_lengths(simulation)]
    frames: list[RecordedFrame] = []
    mismatch, trouble = _mismatch(simulation, system, None, 0.0), ""
    grips_compared = False
    for frame_index in range(draw.frames):
        begin = time.perf_counter()
        try:
            events = player.events(frame_index)
            if frame_index in draw.changes:
                events.append(SetParameters(dict(draw.changes[frame_index])))
            advance = simulation.advance(events).advance
        except (UnstableError, ValueError) as error:
            trouble = f"frame {frame_index}: {error}"
            break
        seconds = time.perf_counter() - begin
        if advance is None:
            raise RuntimeError(f"frame {frame_index} let no time pass")
        if frame_index in draw.changes:
            system = ReferenceSystem(simulation.model)
        grasped, is_new_grip = _grasped_particles(simulation, frames[-1].grasped if frames else None)
        if grasped is not None and not grips_compared:
            grips_compared = True
            start = simulation.time - draw.scene.period
            mismatch = max(mismatch, _mismatch(simulation, system, grasped, start))
        frames.append(
            RecordedFrame(system=system, grasped=grasped, is_new_grip=is_new_grip, advance=advance, seconds=seconds)
        )
        positions.append(simulation.state.x.copy())
        velocities.append(simulation.state.v.copy())
        plastic_lengths.append(_plastic_lengths(simulation))
    return RecordedRun(
        draw=draw,
        system=system,
        positions=positions,
        velocities=velocities,
        plastic_lengths=plastic_lengths,
        frames=frames,
        mismatch=mismatch,
        trouble=trouble,
    )


def _plastic_lengths(simulation: Simulation) -> Array:
    """Return the plastic lengths of hinges with friction [m], shape (hinges,)."""
    plastic = simulation.plan.plastic
    return np.empty(0) if plastic is None else plastic.lengths_of(simulation.state.memory).copy()


def _grasped_particles(
    simulation: Simulation, previous: GripTable | None
) -> tuple[GripTable | None, NDArray[np.bool_]]:
    """Return the grasped particles of the last frame, and which grips are new."""
    grips = simulation.plan.grips
    if grips is None or not grips.particles.size:
        return None, np.zeros(0, dtype=bool)
    grasped = GripTable(
        paths=grips.paths.copy(),
        grippers=grips.gripper_indices(),
        particles=grips.particles.copy(),
        numbers=np.stack([grips.stiffness, grips.damping], axis=1),
        offsets=np.repeat(grips.offsets[:, :, None], LANES, axis=2),
    )
    is_new_grip = np.ones(len(grasped.particles), dtype=bool)
    if previous is not None:
        for gripper in np.unique(grasped.grippers):
            current, previous_selection = grasped.grippers == gripper, previous.grippers == gripper
            same_particles = np.array_equal(grasped.particles[current], previous.particles[previous_selection])
            if same_particles and np.array_equal(grasped.offsets[current], previous.offsets[previous_selection]):
                is_new_grip[current] = False
    return grasped, is_new_grip


def _mismatch(simulation: Simulation, system: ReferenceSystem, grasped: GripTable | None, t: float) -> float:
    """Return the relative difference of accelerations in a perturbed state, less the rounding error."""
    rng = np.random.default_rng(7)
    state = simulation.state
    size = float(np.ptp(state.x, axis=1).max())
    free = simulation.model.inverse_masses > 0.0
    x = state.x + 1e-3 * size * rng.normal(size=state.x.shape) * free
    v = (state.v + 0.1 * rng.normal(size=state.v.shape)) * free
    since = 0.3 * simulation.scene.period
    expected = np.empty_like(x)
    simulation.plan.accelerations(t + since, x, v, expected, state.memory)
    system.set_grasped(grasped, t)
    system.set_plastic_lengths(_plastic_lengths(simulation))
    accelerations = system.accelerations(x, v, since=since)
    # Stiff springs convert the rounding of positions to accelerations.
    rounding = 4.0 * np.finfo(np.float64).eps * float(np.abs(x).max()) * simulation.plan.spectral_bounds(x)[0]
    excess = float(np.abs(accelerations - expected).max()) - rounding
    return max(0.0, excess) / max(float(np.abs(expected).max()), 1e-30)
