# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text report of a fit: table, confounded parameters and remedies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from cloth_sim_ros.fit.fit import MIN_CORRELATION, Estimate, Fit
from cloth_sim_ros.fit.grasped import describe_grasped
from cloth_sim_ros.fit.information import ConfoundedDirection
from cloth_sim_ros.session.plurals import pluralize


def describe(fit: Fit) -> str:
    """Return the text report of a fit to one recording: summary, table of estimates, explanations."""
    return "\n".join([*_head(fit), "", *estimate_table(fit.estimates, fit.within), *_explanations(fit)])


def _head(fit: Fit) -> Iterator[str]:
    missing_text = (
        "" if fit.missing_fraction is None else f", {100 * fit.missing_fraction:.0f} % of the particles not seen"
    )
    used = (
        f"{fit.n_clouds} of {pluralize(fit.n_recorded_clouds, 'cloud')}"
        if fit.reason
        else pluralize(fit.n_clouds, "cloud")
    )
    yield f"{fit.name}: {used} up to {fit.end_time:.2f} s{missing_text}; {fit.n_runs} simulations."
    if fit.recording.unreadable:
        yield f"A part of the recording is unreadable: {fit.recording.unreadable}."
    for grasped in fit.recording.grasped:
        yield describe_grasped(grasped, fit.recording.scene)
    source = "prescribed" if fit.is_sigma_prescribed else "from the residuals"
    yield f"Deviation of a coordinate: {1e3 * fit.sigma:.3g} mm ({source}); residuals: {1e3 * fit.rms:.3g} mm."
    if fit.shift is not None:
        x, y, z = (1e3 * value for value in fit.shift)
        yield f"The clouds have a common offset of ({x:.2g}, {y:.2g}, {z:.2g}) mm, which was fitted too."


def estimate_table(estimates: Sequence[Estimate], within: float) -> Iterator[str]:
    """Yield the lines of a table of estimates. `within`: largest relative deviation of an identified parameter."""
    rows = [("parameter", "value", "95 % interval", "unit", "bound", "")]
    for estimate in estimates:
        low, high = estimate.interval
        has_interval = estimate.has_interval and math.isfinite(estimate.bound)
        unknown = "any" if estimate.has_interval else "none"
        rows.append(
            (
                estimate.parameter.name,
                f"{estimate.value:.4g}",
                f"{_format_number(low)} to {_format_number(high)}" if has_interval else unknown,
                estimate.parameter.unit or "1",
                _format_percent(estimate.bound) if estimate.has_interval else "none",
                verdict(estimate, within),
            )
        )
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for row in rows:
        cells = [
            cell.ljust(width) if k in (0, 3) else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row[:-1], widths[:-1], strict=True))
        ]
        yield "  ".join([*cells, row[-1]]).rstrip()


def verdict(estimate: Estimate, within: float) -> str:
    """Return the text on an estimate for the table: identified, or NOT IDENTIFIED with the reason."""
    if estimate.is_at_limit:
        return "NOT IDENTIFIED: at the limit of the search range"
    if not estimate.is_explained:
        return "NOT IDENTIFIED: the fit is in doubt"
    if not estimate.has_interval:
        return "NOT IDENTIFIED: too few motions for an interval"
    if estimate.has_few_motions and estimate.bound <= within:
        return f"NOT IDENTIFIED: too few motions ({estimate.freedom:.1f} degrees of freedom)"
    if not estimate.is_identified and estimate.bound <= within:
        return f"NOT IDENTIFIED: 95 % interval too wide, by {estimate.freedom:.1f} degrees of freedom"
    return "identified" if estimate.is_identified else f"NOT IDENTIFIED: bound above {100 * within:.3g} %"


def _explanations(fit: Fit) -> Iterator[str]:
    for direction in fit.confounded:
        yield ""
        yield describe_direction(direction, fit.within)
        yield _remedy(direction, fit)
    for estimate in fit.estimates:
        if estimate.is_at_limit:
            yield ""
            yield (
                f"{estimate.parameter.name} is {estimate.value:.3g}, the limit of its search range: set the start by "
                f"--start {estimate.parameter.name}=VALUE, or omit it."
            )
    if fit.reason:
        yield ""
        yield fit.reason[0].upper() + fit.reason[1:] + "."
    if fit.doubt:
        yield ""
        yield f"No parameter is identified: {fit.doubt}."
    if fit.correlation > MIN_CORRELATION:
        yield ""
        yield (
            f"Residuals of successive clouds are correlated ({fit.correlation:.2f}), unlike noise: the model lacks "
            "something (the start, the grip, the air, the weave). The intervals are widened for it, and may still be "
            "too narrow."
        )


def describe_direction(direction: ConfoundedDirection, within: float) -> str:
    """Return a sentence about parameters that are uncertain together. `within`: limit of identified ones."""
    names = [parameter.name for parameter in direction.parameters]
    if direction.is_single:
        hardly = "these clouds hardly depend on it; " if direction.bound > 0.5 else ""
        return f"{names[0]}: {hardly}its standard deviation is at least {_format_least(direction.bound)}."
    changes = " and ".join(
        f"{name} by {'+' if component > 0 else '-'}{abs(10 * component):.2g} %"
        for name, component in zip(names, direction.components, strict=True)
    )
    if direction.bound < 4.0 * within:
        return f"The most uncertain combination is {changes}, together (sigma {_format_percent(direction.bound)})."
    known = ""
    if len(names) == 2 and abs(abs(direction.components[1]) - 1.0) < 0.15:
        known = f": only their {'ratio' if direction.components[1] > 0 else 'product'} is identified"
    return (
        f"{' and '.join(names)} are confounded{known}. Changing {changes}, together, changes these clouds by less than "
        f"the noise (standard deviation at least {_format_least(direction.bound)})."
    )


def _remedy(direction: ConfoundedDirection, fit: Fit) -> str:
    names = {parameter.name for parameter in direction.parameters}
    if not direction.is_single and "material.density" in names:
        return (
            "  Remedy: without measured forces, positions identify only the ratio of moduli to density. Weigh the "
            "cloth, set material.density in the scene and omit it here."
        )
    if not direction.bound < 2.0:
        return "  Remedy: omit it, or record a motion that depends on it."
    factor = direction.bound / fit.within
    remedies = [
        f"noise {factor:.1f} times lower ({1e3 * fit.sigma / factor:.2g} mm)",
        f"{factor**2:.1f} times as many clouds",
    ]
    if names & {"material.stretch_modulus", "material.shear_modulus"}:
        remedies.append("stronger shaking in the sheet's plane (larger accelerations, a weight at the free edge)")
    elif names & {"material.damping", "material.viscosity", "air.drag"}:
        remedies.append("faster shaking, and its decay after it stops")
    elif names & {"material.bending_modulus", "bending.stiffness"}:
        remedies.append("folds: hands closer together, waves across the sheet")
    else:
        remedies.append("more motion")
    if not direction.is_single:
        remedies.append("an independent measurement of one of them, which is then omitted")
    return "  Remedy: " + ", or ".join(remedies) + "."


def _format_percent(fraction: float) -> str:
    return "infinite" if not math.isfinite(fraction) else f"{100 * fraction:.2g} %" if fraction < 10.0 else "> 1000 %"


def _format_least(fraction: float) -> str:
    """Return a percentage for a sentence that says "at least"."""
    return _format_percent(fraction).removeprefix("> ")


def _format_number(value: float) -> str:
    return f"{value:.4g}"
