# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text report of a fit to several motions: table, alignment, grasped particles and scores."""

from __future__ import annotations

import math
from collections.abc import Iterator

from cloth_sim_ros.fit.alignment import FIXED, PER_RECORDING
from cloth_sim_ros.fit.clusters import MIN_MOTIONS
from cloth_sim_ros.fit.fit import MIN_FREEDOM
from cloth_sim_ros.fit.grasped import describe_grasped
from cloth_sim_ros.fit.hypotheses import GraspChoice
from cloth_sim_ros.fit.motions_result import MotionFit
from cloth_sim_ros.fit.scores import Score
from cloth_sim_ros.fit.text import describe_direction, estimate_table
from cloth_sim_ros.session.plurals import pluralize

#: Number of combinations of grasped particles that the report lists.
_N_LISTED = 4
#: Largest rotation of a camera that may be an error of its pose [degrees], three deviations of the prior.
_MAX_TURN = 35.0


def describe_motions(fit: MotionFit) -> str:
    """Return the text report of a fit to several motions."""
    return "\n".join([*_head(fit), "", *estimate_table(fit.estimates, fit.within), "", *_notes(fit)])


def _head(fit: MotionFit) -> Iterator[str]:
    missing = "" if fit.missing_fraction is None else f", {100 * fit.missing_fraction:.0f} % of the particles not seen"
    yield (
        f"{fit.name}: {fit.n_clouds} of {pluralize(fit.n_recorded_clouds, 'cloud')} of "
        f"{pluralize(len(fit.recordings), 'motion')}{missing}; {fit.n_runs} simulations."
    )
    reasons = {
        "without points": fit.left_out.empty,
        "of another scale": fit.left_out.wrong_scale,
        "shortened along the sheet, so that the camera missed a part": fit.left_out.shortened,
        "of another object": fit.left_out.other_object,
        "after the motion becomes unpredictable": fit.left_out.unpredictable,
    }
    if fit.left_out.total:
        parts = ", ".join(f"{count} {reason}" for reason, count in reasons.items() if count)
        yield f"{pluralize(fit.left_out.total, 'cloud')} left out: {parts}."
    for recording in fit.recordings:
        if recording.unreadable:
            yield f"A part of {recording.name} is unreadable: {recording.unreadable}."
    yield from _grasp_lines(fit)
    yield from _alignment_lines(fit)
    yield (
        f"Noise of a coordinate: {1e3 * fit.sigma:.3g} mm for each point, and smooth errors of the whole cloud with "
        f"{100 * fit.smooth_share:.0f} % of the variance."
    )


def _grasp_lines(fit: MotionFit) -> Iterator[str]:
    if fit.grasp is None:
        if all(recording.grasped == fit.recordings[0].grasped for recording in fit.recordings):
            for entry in fit.recordings[0].grasped:
                yield describe_grasped(entry, fit.scene)
            return
        for recording in fit.recordings:
            held = ", ".join(f"{e.gripper} {' '.join(str(k) for k in e.particles[:6])}" for e in recording.grasped)
            yield f"Held particles of {recording.name}: {held}."
        return
    yield from describe_choice(fit.grasp)


def describe_choice(choice: GraspChoice) -> Iterator[str]:
    """Yield lines about the chosen grasped particles and the scores of the best combinations."""

    def particles(index: int) -> str:
        entries = choice.hypotheses[index].particles
        return ", ".join(f"{name} {' '.join(str(k) for k in entries[name][:6])}" for name in choice.grippers)

    if not choice.grippers:
        return
    if choice.is_named:
        yield f"Held particles, as named: {particles(0)}."
        return
    simulated = [k for k, hypothesis in enumerate(choice.hypotheses) if hypothesis.distances]
    if not simulated:
        yield f"Held particles, the only plausible ones: {particles(0)}."
        return
    yield f"Held particles, of {len(simulated)} simulated combinations: {particles(0)}. Mean distance of the points:"
    for k in simulated[:_N_LISTED]:
        yield f"  {1e3 * choice.hypotheses[k].score:6.1f} mm  {particles(k)}"
    if choice.is_tie:
        yield "  The first two are a tie: these motions do not decide. Name the particles by --held."


def _alignment_lines(fit: MotionFit) -> Iterator[str]:
    model, sigmas = fit.alignment_model, fit.alignment_sigmas

    def sigma(component: int) -> float:
        components, places = model.columns(0)
        return float(sigmas[places[components == component]][0]) if component in components else math.nan

    alignments = [alignment for alignment in fit.alignments if alignment is not None]
    if model.time == PER_RECORDING:
        offsets = [alignment.offset for alignment in alignments]
        yield f"Clouds are late by {min(offsets):.3f} to {max(offsets):.3f} s (fitted for each recording)."
    elif model.time != FIXED:
        yield f"Clouds are late by {alignments[0].offset:.3f} s +- {sigma(0):.3f} (fitted, shared by all recordings)."
    if model.camera == PER_RECORDING:
        angles = [math.degrees(alignment.angle) for alignment in alignments]
        yield f"The camera is turned by {min(angles):.1f} to {max(angles):.1f} degrees (fitted for each recording)."
    elif model.camera != FIXED or model.has_shift:
        x, y, z = (1e3 * component for component in alignments[0].shift)
        turn = "" if model.camera == FIXED else f"turned by {math.degrees(alignments[0].angle):.2f} degrees and "
        yield f"The camera is {turn}shifted by ({x:.2g}, {y:.2g}, {z:.2g}) mm (fitted, shared by all recordings)."
    largest = max((math.degrees(alignment.angle) for alignment in alignments), default=0.0)
    if largest > _MAX_TURN:
        yield (
            f"  {largest:.0f} degrees are more than an error of the camera's pose, {_MAX_TURN:g} at most: check the "
            "order of the particles and the scene's resolution, or give --camera-pose."
        )


def _notes(fit: MotionFit) -> Iterator[str]:
    yield from _score_table(fit)
    if fit.covariance.without is not None:
        freedoms = [estimate.freedom or 0.0 for estimate in fit.estimates]
        yield (
            f"Intervals treat each of {len(fit.covariance.without)} motions as one independent observation "
            f"(jackknife, Student's t with {min(freedoms):.1f} to {max(freedoms):.1f} degrees of freedom)."
        )
        uncertain = [estimate.parameter.name for estimate in fit.estimates if estimate.has_few_motions]
        if uncertain:
            yield (
                f"Too few motions inform about {', '.join(uncertain)}: an identified parameter needs {MIN_FREEDOM:g} "
                "degrees of freedom. Record more motions, or fit fewer parameters."
            )
    elif fit.covariance.has_intervals:
        yield (
            "Intervals are of the noise of one motion alone: they hold only if the model is right and the clouds' "
            f"errors are independent. Record {MIN_MOTIONS} motions or more for intervals that cover."
        )
    else:
        yield (
            f"No intervals: fewer than {MIN_MOTIONS} motions do not show how much the result varies from motion to "
            f"motion. Record {MIN_MOTIONS} or more."
        )
    for direction in fit.confounded:
        yield describe_direction(direction, fit.within)
    for name in fit.unused:
        yield f"{name} is not used: none of its clouds can be this cloth. Is it another cloth?"
    for name in fit.suspicious:
        yield f"{name} follows the model much worse than the others: is it another cloth, or another grasp?"
    if fit.doubt:
        yield f"No parameter is identified: {fit.doubt}."


def _score_table(fit: MotionFit) -> Iterator[str]:
    yield "distance of the points [mm]      median   95 %    rms"

    def row(name: str, entry: Score) -> str:
        return f"  {name:30s} {1e3 * entry.median:6.1f} {1e3 * entry.quantile_95:6.1f} {1e3 * entry.rms:6.1f}"

    yield row("fitted", fit.fitted)
    if fit.held_out is not None:
        yield row("motions not fitted on", fit.held_out)
    yield row("rigid", fit.rigid)
    if fit.floor is not None:
        yield row("floor", fit.floor)
    better, count = sum(entry.model.rms < entry.rigid.rms for entry in fit.motions), len(fit.motions)
    yield f"Better than rigid (the cloth carried by its grippers) in {better} of {pluralize(count, 'motion')}."
    yield (
        f"Floor: {fit.floor_basis}, as the camera shows them."
        if fit.floor is not None
        else f"No floor: {fit.floor_basis}."
    )
    if fit.excess is not None:
        yield (
            f"Misfit: {1e3 * fit.excess:.2g} mm of the error are not explained by the floor. The model lacks "
            "something, or the camera is worse elsewhere. With these values and intervals this model follows such "
            "motions best; other motions may need others."
        )
