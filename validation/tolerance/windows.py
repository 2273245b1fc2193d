# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a recorded run: errors of windows and the whole run against the reference."""

from __future__ import annotations

import attrs
import numpy as np

from cloth_sim_ros.physics.arrays import largest_distance
from cloth_sim_ros.physics.forces.force import Array
from cloth_sim_ros.physics.gripper_path import rotation_matrix
from validation.tolerance.compiled_reference import KICK, LANES, Held, Integration, ReferenceError, trajectories
from validation.tolerance.random_scenes import draw, smooth_field
from validation.tolerance.recording import SAME_FORCES, Recording, record

#: Local error of the reference relative to the tolerance, and the factor of its second, finer run.
REFERENCE, FINER = 1e-3, 0.1
#: Largest difference of the two runs relative to the error bound; above it both become finer.
REFERENCE_ERROR = 0.02
#: Smallest local error [m]: not far below it rounding dominates.
LEAST_LOCAL = 1e-13
#: Largest amplification of the whole run: beyond it a perturbation is not meaningful.
HORIZON = 1e6
#: Parts of a window. Perturbations also start at their borders if those at the window's start do not explain its error.
_PARTS = 8
#: Amplification below which flagged windows count.
CALM = 1e3
#: Largest number of steps of the reference in a frame: a constant, and a number per radian of the highest frequency at
#: the start. Beyond it the equations count as singular. Last: stages of a step.
_MOST_STEPS, _STIFFER, _STAGES = 300, 10, 12


@attrs.frozen(kw_only=True)
class Window:
    """One evaluated interval of time."""

    #: First frame, and number of frames.
    first: int
    frames: int
    #: Largest distance of a particle from the reference at the end of any frame [m].
    error: float
    #: Amplification of a perturbation at its start.
    growth: float
    #: Error bound [m].
    promised: float
    #: Difference of two runs of the reference [m].
    reference_error: float
    #: Number of flagged frames, and of frames asleep.
    flagged: int
    asleep: int
    #: Step limits of its frames, and the reason of the frame with the most evaluations.
    binds: str
    reason: str
    #: Evaluations of the engine, and of the reference.
    evaluations: int
    reference_evaluations: int
    #: Amplification of perturbations that start later in it; 0 if it was not measured.
    later: float = 0.0

    @property
    def from_start(self) -> float:
        """Ratio of error to the error bound by perturbations at the start only."""
        return self.ratio * max(1.0, self.growth, self.later) / max(1.0, self.growth)

    @property
    def ratio(self) -> float:
        """Ratio of error to error bound."""
        return self.error / self.promised

    @property
    def known(self) -> bool:
        """True if the reference is accurate enough for an evaluation."""
        return self.reference_error <= 0.2 * self.promised


@attrs.frozen(kw_only=True)
class Judgement:
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

    def worst(self, *, flagged: bool) -> Window | None:
        """Return the window with the largest error ratio among those with, or without, flagged frames."""
        chosen = [window for window in self.windows if window.known and bool(window.flagged) == flagged]
        return max(chosen, key=lambda window: window.ratio, default=None)

    @property
    def verdict(self) -> str:
        """Verdict in one or two words."""
        if self.trouble:
            return "STOPPED"
        if not self.mismatch <= SAME_FORCES:
            return "FORCES DIFFER"
        unflagged, flagged = self.worst(flagged=False), self.worst(flagged=True)
        if unflagged and unflagged.ratio > 1.0:
            return "BROKEN"
        if flagged and flagged.ratio > 2.0:
            return "BROKEN, flagged"
        if self.whole and self.whole.known and self.whole.ratio > 1.0 and not self.whole.flagged:
            return "BROKEN, whole"
        return "kept" if not self.unknown and all(window.known for window in self.windows) else "kept, some unknown"


def judge(seed: int, index: int, windows: int) -> Judgement:
    """Draw a scene, run it, and evaluate a number of its windows."""
    drawn = draw(seed, index)
    run = record(drawn)
    second = drawn.frames_a_second
    judged, unknown = list[Window](), list[str]()
    whole, trouble = None, run.trouble
    count = len(run.frames)
    if not run.mismatch > SAME_FORCES:
        for start in [0, *starts(run, windows)] if count >= second else []:
            try:
                window, longer = judge_window(run, start, second if start else count, seed=index + start)
                judged.append(window)
                whole = longer or whole
            except ReferenceError as error:
                unknown.append(f"window at {start}: {error}")
    return Judgement(
        seed=seed,
        index=index,
        words=drawn.words,
        tolerance=drawn.scene.tolerance,
        particles=run.system.model.particle_count,
        frames=count,
        period=run.period,
        cost=drawn.cost,
        windows=tuple(judged),
        whole=whole,
        flagged_frames=sum(frame.advance.flagged > 0 for frame in run.frames),
        evaluations=sum(frame.advance.evaluations for frame in run.frames),
        seconds=sum(frame.seconds for frame in run.frames),
        longest_frame=max((frame.seconds for frame in run.frames), default=0.0),
        mismatch=run.mismatch,
        trouble=trouble,
        unknown=tuple(unknown),
    )


def starts(run: Recording, count: int) -> list[int]:
    """Return the first frames of random windows: one half at events, one half anywhere."""
    last = len(run.frames) - run.draw.frames_a_second
    rng = np.random.default_rng([run.draw.seed, run.draw.index, 1])
    moments = [frame for frame in run.draw.script.moments() if 0 < frame <= last]
    wanted = max(0, count - 1)
    found = set(rng.permutation(moments)[: (wanted + 1) // 2].tolist()) if moments else set[int]()
    others = [frame for frame in range(1, last + 1) if frame not in found]
    found |= set(rng.permutation(others)[: wanted - len(found)].tolist())
    return sorted(int(frame) for frame in found)


def kicks(run: Recording, seed: int, *, second: bool) -> Array:
    """Return perturbations of size 1 in positions or velocities, shape (2, n, 3, LANES - 1)."""
    rng = np.random.default_rng([seed, int(second)])
    model, rest = run.system.model, run.positions[0].T
    found = np.zeros((2, model.particle_count, 3, LANES - 1))
    for lane in range(LANES - 1):
        # Independent particles perturb the shortest waves, a smooth field perturbs the longest.
        field = rng.normal(size=rest.shape) if lane == 0 else smooth_field(rng, rest)
        if lane == 0:
            field /= np.linalg.norm(field, axis=1)[:, None]
        velocity = second if lane == 0 else lane % 2 == 0
        found[int(velocity), :, :, lane] = field
    return found * (model.inverse_masses > 0.0)[None, :, None, None]


def judge_window(run: Recording, first: int, frames: int, *, seed: int) -> tuple[Window, Window | None]:
    """Evaluate the window of one second from a frame on; also the whole interval if it is longer."""
    tolerance = run.draw.scene.tolerance
    second = run.draw.frames_a_second
    least = LEAST_LOCAL / FINER
    local = max(REFERENCE * tolerance, least)
    while True:
        rough = follow(run, first, frames, kicks(run, seed, second=False), local)
        fine = follow(run, first, frames, kicks(run, seed, second=True), FINER * local)
        window = window_of(run, first, second, rough, fine, tolerance)
        if window.reference_error <= REFERENCE_ERROR * window.promised or local <= least:
            break
        local = max(0.01 * local, least)
    if window.ratio > 1.0:
        later = max(_growth_from(run, first, second, part, seed, local) for part in range(1, _PARTS))
        promised = tolerance * max(1.0, window.growth, later)
        window = attrs.evolve(window, later=later, promised=promised)
    if frames <= second:
        return window, None
    many = min(len(rough.positions), len(fine.positions))
    return window, window_of(run, first, many, rough, fine, tolerance * max(1.0, many * run.period))


def _growth_from(run: Recording, first: int, frames: int, part: int, seed: int, local: float) -> float:
    """Return the largest amplification of perturbations that start after a number of parts of a window."""
    passed = part * frames // _PARTS
    if not 0 < passed < frames:
        return 0.0
    both = (follow(run, first + passed, frames - passed, kicks(run, seed, second=k), local) for k in (False, True))
    return max(float(np.max(each.growths)) for each in both)


@attrs.frozen(kw_only=True, eq=False)
class Followed:
    """One run of the reference."""

    #: Positions at the end of each frame, (3, n) [m].
    positions: list[Array]
    #: Amplification of each perturbation at the end of each frame, (LANES - 1,).
    growths: list[Array]
    evaluations: int


def follow(run: Recording, first: int, frames: int, kick: Array, local: float) -> Followed:
    """Run the reference from the engine's state at a frame with a local error [m].

    It stops early if the amplification exceeds `MAX_AMPLIFICATION`.

    Raises:
        ReferenceFailureError: if the equations are singular.
    """
    y = trajectories(run.positions[first], run.velocities[first])
    y[..., 1:] += KICK * kick
    steps = _STIFFER * run.draw.frequency * run.period + _MOST_STEPS
    integration = Integration(run.system, y, tolerance=local, most=int(_STAGES * steps))
    positions, growths = list[Array](), list[Array]()
    offsets: dict[tuple[int, int], Array] = {}
    for number in range(first, first + frames):
        t = number * run.period
        frame = run.frames[number]
        run.system.hold(own_points(frame.held, frame.fresh, offsets, y), t)
        integration.advance(run.period)
        positions.append(integration.positions)
        growths.append(integration.deviations() / KICK)
        if len(positions) >= run.draw.frames_a_second and growths[-1].max() > HORIZON:
            break
    return Followed(positions=positions, growths=growths, evaluations=integration.evaluations)


def own_points(held: Held | None, fresh: np.ndarray, known: dict[tuple[int, int], Array], y: Array) -> Held | None:
    """Return the grasped particles; new grips start at each trajectory's own position."""
    if held is None:
        known.clear()
        return None
    points = held.offsets.copy()
    now: dict[tuple[int, int], Array] = {}
    for grip, (gripper, particle) in enumerate(zip(held.grippers.tolist(), held.particles.tolist(), strict=True)):
        key = (gripper, particle)
        path = held.paths[gripper]
        if fresh[grip]:
            away = y[0, particle] - path[1:4, None]
            points[grip] = rotation_matrix(path[13:17]).T @ away
        elif key in known:
            points[grip] = known[key]
        now[key] = points[grip].copy()
    known.clear()
    known.update(now)
    return attrs.evolve(held, offsets=points)


def window_of(run: Recording, first: int, frames: int, rough: Followed, fine: Followed, tolerance: float) -> Window:
    """Evaluate an interval by two runs of the reference; `tolerance`: error bound without amplification [m]."""
    growth = max(float(np.max(each.growths[:frames])) for each in (rough, fine))
    pairs = zip(rough.positions[:frames], fine.positions[:frames], strict=True)
    reference_error = max(largest_distance(a, b) for a, b in pairs)
    there = run.positions[first + 1 : first + 1 + frames]
    error = max(largest_distance(a, b) for a, b in zip(there, fine.positions[:frames], strict=True))
    part = run.frames[first : first + frames]
    most = max(part, key=lambda frame: (frame.advance.flagged, frame.advance.evaluations)).advance
    return Window(
        first=first,
        frames=frames,
        error=error,
        growth=growth,
        promised=tolerance * max(1.0, growth),
        reference_error=reference_error,
        flagged=sum(frame.advance.flagged > 0 for frame in part),
        asleep=sum(frame.advance.limited_by == "rest" for frame in part),
        binds=", ".join(sorted({frame.advance.limited_by for frame in part})),
        reason=most.reason,
        evaluations=sum(frame.advance.evaluations for frame in part),
        reference_evaluations=rough.evaluations + fine.evaluations,
    )
