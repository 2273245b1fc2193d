# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded runs of the engine, and the errors of their windows against the reference.

A run goes through the public interface, frame by frame. Windows and the whole run are evaluated.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros import Advance, SetParameters, Simulation, UnstableError
from cloth_sim_ros.physics.arithmetic.arrays import largest_distance
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.plan.gripper_path import rotation_matrix
from validation.tolerance.compiled_reference import (
    LANES,
    PERTURBATION,
    GripTable,
    Integration,
    ReferenceFailureError,
    ReferenceSystem,
    trajectories,
)
from validation.tolerance.random_scenes import RandomGripPlayer, RandomScene, draw_scene, smooth_field

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


#: Local error of the reference relative to the tolerance, and the factor of its second, finer run.
LOCAL_ERROR_FRACTION, REFINEMENT_FACTOR = 1e-3, 0.1
#: Largest difference of the two runs relative to the error bound; above it both become finer.
MAX_REFERENCE_DIFFERENCE = 0.02
#: Smallest local error [m]: not far below it rounding dominates.
MIN_LOCAL_ERROR = 1e-13
#: Largest amplification of the whole run: beyond it a perturbation is not meaningful.
MAX_AMPLIFICATION = 1e6
#: Parts of a window. Perturbations also start at their borders if the error exceeds this fraction of the bound by those
#: at the window's start. A climb would stop just below 1 if it were 1.
_PARTS, EXPLAINED_FRACTION = 8, 0.5
#: Amplification below which flagged windows count.
CALM_AMPLIFICATION = 1e3
#: Largest number of steps of the reference in a frame: a constant, and a number per radian of the highest frequency at
#: the start. Beyond it the equations count as singular. Last: stages of a step.
_MAX_STEPS, _STEPS_PER_RADIAN, _STAGES = 300, 10, 12
#: Least number of steps in a frame with friction of bending, for a local error of a thousandth of the tolerance. Its
#: kinks leave an error of second order in the step, which a finer run divides by its refinement.
_FRICTION_STEPS = 40


@attrs.frozen(kw_only=True)
class Window:
    """One evaluated interval of time."""

    #: First frame, and number of frames.
    first: int
    frames: int
    #: Largest distance of a particle from the reference at the end of any frame [m].
    error: float
    #: Amplification of a perturbation at its start.
    amplification: float
    #: Error bound [m].
    error_bound: float
    #: Difference of two runs of the reference [m].
    reference_error: float
    #: Number of flagged frames, and of frames asleep.
    flagged: int
    asleep: int
    #: Step limits of its frames, and the reason of the frame with the most evaluations.
    limited_by: str
    reason: str
    #: Evaluations of the engine, and of the reference.
    evaluations: int
    reference_evaluations: int
    #: Amplification of perturbations that start later in it; 0 if it was not measured.
    later_amplification: float = 0.0

    @classmethod
    def of(cls, advances: Sequence[Advance], **values: Any) -> Window:
        """Return a window with the step statistics of its frames and further values."""
        costliest = max(advances, key=lambda advance: (advance.flagged, advance.evaluations))
        return cls(
            flagged=sum(advance.flagged > 0 for advance in advances),
            asleep=sum(advance.limited_by == "rest" for advance in advances),
            limited_by=", ".join(sorted({advance.limited_by for advance in advances})),
            reason=costliest.reason,
            evaluations=sum(advance.evaluations for advance in advances),
            **values,
        )

    @property
    def ratio_from_start(self) -> float:
        """Ratio of error to the error bound by perturbations at the start only."""
        return self.ratio * max(1.0, self.amplification, self.later_amplification) / max(1.0, self.amplification)

    @property
    def ratio(self) -> float:
        """Ratio of error to error bound."""
        return self.error / self.error_bound

    @property
    def is_known(self) -> bool:
        """True if the reference is accurate enough for an evaluation."""
        return self.reference_error <= 0.2 * self.error_bound


@attrs.frozen(kw_only=True)
class SceneEvaluation:
    """Evaluation of one scene."""

    seed: int
    index: int
    words: str
    tolerance: float
    particles: int
    frames: int
    #: Length of a frame [s].
    period: float
    cost: float
    windows: tuple[Window, ...]
    #: From the start until the amplification exceeds `MAX_AMPLIFICATION`; None if the engine stopped before.
    whole: Window | None
    flagged_frames: int
    evaluations: int
    seconds: float
    longest_frame: float
    mismatch: float
    trouble: str
    #: Windows that the reference can't follow, and the reasons.
    unknown: tuple[str, ...]

    @classmethod
    def of(
        cls, draw: RandomScene, advances: Sequence[Advance], seconds: Sequence[float], **values: Any
    ) -> SceneEvaluation:
        """Return the evaluation of a scene with the statistics and wall times [s] of its frames and further values."""
        return cls(
            seed=draw.seed,
            index=draw.index,
            words=draw.words,
            tolerance=draw.scene.tolerance,
            particles=draw.state.particle_count,
            period=draw.scene.period,
            cost=draw.cost,
            frames=len(advances),
            flagged_frames=sum(advance.flagged > 0 for advance in advances),
            evaluations=sum(advance.evaluations for advance in advances),
            seconds=sum(seconds),
            longest_frame=max(seconds, default=0.0),
            **values,
        )

    def worst(self, *, flagged: bool) -> Window | None:
        """Return the window with the largest error ratio among those with, or without, flagged frames."""
        chosen = [window for window in self.windows if window.is_known and bool(window.flagged) == flagged]
        return max(chosen, key=lambda window: window.ratio, default=None)

    @property
    def verdict(self) -> str:
        """Verdict in one or two words."""
        if self.trouble:
            return "STOPPED"
        if not self.mismatch <= MAX_FORCE_MISMATCH:
            return "FORCES DIFFER"
        unflagged, flagged = self.worst(flagged=False), self.worst(flagged=True)
        if unflagged and unflagged.ratio > 1.0:
            return "BROKEN"
        if flagged and flagged.ratio > 2.0:
            return "BROKEN, flagged"
        if self.whole and self.whole.is_known and self.whole.ratio > 1.0 and not self.whole.flagged:
            return "BROKEN, whole"
        return "kept" if not self.unknown and all(window.is_known for window in self.windows) else "kept, some unknown"


def evaluate_scene(seed: int, index: int, windows: int) -> SceneEvaluation:
    """Draw a scene, run it, and evaluate a number of its windows."""
    scene = draw_scene(seed, index)
    run = record_run(scene)
    frames_per_second = scene.frames_per_second
    evaluated, unknown = list[Window](), list[str]()
    whole, count = None, len(run.frames)
    if not run.mismatch > MAX_FORCE_MISMATCH:
        for start in [0, *window_starts(run, windows)] if count >= frames_per_second else []:
            try:
                length = frames_per_second if start else count
                window, whole_window = evaluate_window(run, start, length, seed=index + start)
                evaluated.append(window)
                whole = whole_window or whole
            except ReferenceFailureError as error:
                unknown.append(f"window at {start}: {error}")
    return SceneEvaluation.of(
        scene,
        [frame.advance for frame in run.frames],
        [frame.seconds for frame in run.frames],
        windows=tuple(evaluated),
        whole=whole,
        mismatch=run.mismatch,
        trouble=run.trouble,
        unknown=tuple(unknown),
    )


def window_starts(run: RecordedRun, count: int) -> list[int]:
    """Return the first frames of random windows: one half at events, one half anywhere."""
    last = len(run.frames) - run.draw.frames_per_second
    rng = np.random.default_rng([run.draw.seed, run.draw.index, 1])
    event_frames = [frame for frame in run.draw.script.moments() if 0 < frame <= last]
    n_random = max(0, count - 1)
    chosen = set(rng.permutation(event_frames)[: (n_random + 1) // 2].tolist()) if event_frames else set[int]()
    other_frames = [frame for frame in range(1, last + 1) if frame not in chosen]
    chosen |= set(rng.permutation(other_frames)[: n_random - len(chosen)].tolist())
    return sorted(int(frame) for frame in chosen)


def unit_perturbations(run: RecordedRun, seed: int, *, second: bool) -> Array:
    """Return perturbations of size 1 in positions or velocities, shape (2, n, 3, LANES - 1)."""
    rng = np.random.default_rng([seed, int(second)])
    model, initial_positions = run.system.model, run.positions[0].T
    perturbations = np.zeros((2, model.particle_count, 3, LANES - 1))
    for lane in range(LANES - 1):
        # Independent particles perturb the shortest waves, a smooth field perturbs the longest.
        field = rng.normal(size=initial_positions.shape) if lane == 0 else smooth_field(rng, initial_positions)
        if lane == 0:
            field /= np.linalg.norm(field, axis=1)[:, None]
        perturbs_velocity = second if lane == 0 else lane % 2 == 0
        perturbations[int(perturbs_velocity), :, :, lane] = field
    return perturbations * (model.inverse_masses > 0.0)[None, :, None, None]


def evaluate_window(run: RecordedRun, first: int, frames: int, *, seed: int) -> tuple[Window, Window | None]:
    """Evaluate the window of one second from a frame on; also the whole interval if it is longer."""
    tolerance = run.draw.scene.tolerance
    second = run.draw.frames_per_second
    min_local = MIN_LOCAL_ERROR / REFINEMENT_FACTOR
    local_error = max(LOCAL_ERROR_FRACTION * tolerance, min_local)
    while True:
        coarse = run_reference(run, first, frames, unit_perturbations(run, seed, second=False), local_error)
        perturbations = unit_perturbations(run, seed, second=True)
        fine = run_reference(run, first, frames, perturbations, REFINEMENT_FACTOR * local_error)
        window = make_window(run, first, second, coarse, fine, tolerance)
        if window.reference_error <= MAX_REFERENCE_DIFFERENCE * window.error_bound or local_error <= min_local:
            break
        local_error = max(0.01 * local_error, min_local)
    if window.ratio > EXPLAINED_FRACTION:
        amplifications = (
            _later_amplification(run, first, second, part, seed, local_error) for part in range(1, _PARTS)
        )
        later_amplification = max(amplifications)
        error_bound = tolerance * max(1.0, window.amplification, later_amplification)
        window = attrs.evolve(window, later_amplification=later_amplification, error_bound=error_bound)
    if frames <= second:
        return window, None
    n_frames = min(len(coarse.positions), len(fine.positions))
    return window, make_window(run, first, n_frames, coarse, fine, tolerance * max(1.0, n_frames * run.period))


def _later_amplification(run: RecordedRun, first: int, frames: int, part: int, seed: int, local_error: float) -> float:
    """Return the largest amplification of perturbations that start after a number of parts of a window."""
    n_passed = part * frames // _PARTS
    if not 0 < n_passed < frames:
        return 0.0
    perturbations = (unit_perturbations(run, seed, second=perturbs_velocity) for perturbs_velocity in (False, True))
    start, length = first + n_passed, frames - n_passed
    reference_runs = (run_reference(run, start, length, both, local_error) for both in perturbations)
    return max(float(np.max(reference_run.amplifications)) for reference_run in reference_runs)


@attrs.frozen(kw_only=True, eq=False)
class ReferenceRun:
    """One run of the reference."""

    #: Positions at the end of each frame, (3, n) [m].
    positions: list[Array]
    #: Amplification of each perturbation at the end of each frame, (LANES - 1,).
    amplifications: list[Array]
    evaluations: int


def run_reference(run: RecordedRun, first: int, frames: int, perturbation: Array, local_error: float) -> ReferenceRun:
    """Run the reference from the engine's state at a frame with a local error [m].

    It stops early if the amplification exceeds `MAX_AMPLIFICATION`.

    Raises:
        ReferenceFailureError: if the equations are singular.
    """
    y = trajectories(run.positions[first], run.velocities[first])
    y[..., 1:] += PERTURBATION * perturbation
    steps, max_step = _STEPS_PER_RADIAN * run.draw.frequency * run.period + _MAX_STEPS, 0.0
    if run.plastic_lengths[first].size:
        n_friction_steps = _FRICTION_STEPS * math.sqrt(LOCAL_ERROR_FRACTION * run.draw.scene.tolerance / local_error)
        steps, max_step = steps + n_friction_steps, run.period / n_friction_steps
    max_evaluations = int(_STAGES * steps)
    integration = Integration(run.system, y, tolerance=local_error, max_evaluations=max_evaluations, max_step=max_step)
    positions, amplifications = list[Array](), list[Array]()
    offsets: dict[tuple[int, int], Array] = {}
    plastic_lengths = run.plastic_lengths[first]
    for frame_index in range(first, first + frames):
        t = frame_index * run.period
        frame = run.frames[frame_index]
        integration.system = frame.system
        frame.system.set_plastic_lengths(plastic_lengths)
        frame.system.set_grasped(grip_points(frame.grasped, frame.is_new_grip, offsets, y), t)
        integration.advance(run.period)
        plastic_lengths = frame.system.plastic_lengths
        positions.append(integration.positions)
        amplifications.append(integration.deviations() / PERTURBATION)
        if len(positions) >= run.draw.frames_per_second and amplifications[-1].max() > MAX_AMPLIFICATION:
            break
    return ReferenceRun(positions=positions, amplifications=amplifications, evaluations=integration.evaluations)


def grip_points(
    grasped: GripTable | None, is_new_grip: np.ndarray, known_points: dict[tuple[int, int], Array], y: Array
) -> GripTable | None:
    """Return the grasped particles; new grips start at each trajectory's own position."""
    if grasped is None:
        known_points.clear()
        return None
    points = grasped.offsets.copy()
    current_points: dict[tuple[int, int], Array] = {}
    for grip, (gripper, particle) in enumerate(zip(grasped.grippers.tolist(), grasped.particles.tolist(), strict=True)):
        key = (gripper, particle)
        path = grasped.paths[gripper]
        if is_new_grip[grip]:
            offsets = y[0, particle] - path[1:4, None]
            points[grip] = rotation_matrix(path[13:17]).T @ offsets
        elif key in known_points:
            points[grip] = known_points[key]
        current_points[key] = points[grip].copy()
    known_points.clear()
    known_points.update(current_points)
    return attrs.evolve(grasped, offsets=points)


def make_window(
    run: RecordedRun, first: int, frames: int, coarse: ReferenceRun, fine: ReferenceRun, tolerance: float
) -> Window:
    """Evaluate an interval by two runs of the reference; `tolerance`: error bound without amplification [m]."""
    amplification = max(float(np.max(reference_run.amplifications[:frames])) for reference_run in (coarse, fine))
    pairs = zip(coarse.positions[:frames], fine.positions[:frames], strict=True)
    reference_error = max(largest_distance(a, b) for a, b in pairs)
    engine_positions = run.positions[first + 1 : first + 1 + frames]
    error = max(largest_distance(a, b) for a, b in zip(engine_positions, fine.positions[:frames], strict=True))
    return Window.of(
        [frame.advance for frame in run.frames[first : first + frames]],
        first=first,
        frames=frames,
        error=error,
        amplification=amplification,
        error_bound=tolerance * max(1.0, amplification),
        reference_error=reference_error,
        reference_evaluations=coarse.evaluations + fine.evaluations,
    )
