# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text report of a fit: table, confounded parameters and remedies."""

from __future__ import annotations

import math
from collections.abc import Iterator

from cloth_sim_ros.batch.fit import LEAST_CORRELATION, Estimate, Fit
from cloth_sim_ros.batch.fit_held import describe_held
from cloth_sim_ros.batch.fit_information import Tie
from cloth_sim_ros.session.words import counted


def describe(fit: Fit) -> str:
    """Return the text report of a fit, which starts with a table."""
    return "\n".join([*_head(fit), "", *_table(fit), *_explained(fit)])


def _head(fit: Fit) -> Iterator[str]:
    lost = "" if fit.missing is None else f", {100 * fit.missing:.0f} % of the particles not seen"
    used = f"{fit.clouds} of {counted(fit.all_clouds, 'cloud')}" if fit.reason else counted(fit.clouds, "cloud")
    yield f"{fit.name}: {used} up to {fit.until:.2f} s{lost}; {fit.runs} simulations."
    if fit.recording.lost:
        yield f"A part of the recording is unreadable: {fit.recording.lost}."
    for held in fit.recording.held:
        yield describe_held(held, fit.recording.scene)
    said = "prescribed" if fit.sigma_given else "from the residuals"
    yield f"Deviation of a coordinate: {1e3 * fit.sigma:.3g} mm ({said}); residuals: {1e3 * fit.rms:.3g} mm."
    if fit.shift is not None:
        x, y, z = (1e3 * value for value in fit.shift)
        yield f"The clouds have a common offset of ({x:.2g}, {y:.2g}, {z:.2g}) mm, which was fitted too."


def _table(fit: Fit) -> Iterator[str]:
    rows = [("parameter", "value", "95 % interval", "unit", "bound", "")]
    for estimate in fit.estimates:
        low, high = estimate.interval
        rows.append(
            (
                estimate.parameter.name,
                f"{estimate.value:.4g}",
                f"{_number(low)} to {_number(high)}" if math.isfinite(estimate.bound) else "any",
                estimate.parameter.unit or "1",
                _percent(estimate.bound),
                verdict(estimate, fit.within),
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
    """Return a short text: identified, or the reason why not."""
    if estimate.at_end:
        return "NOT IDENTIFIED: at the limit of the search range"
    if not estimate.followed:
        return "NOT IDENTIFIED: the simulated cloth does not follow the recording"
    return "identified" if estimate.told else f"NOT IDENTIFIED: bound above {100 * within:.3g} %"


def _explained(fit: Fit) -> Iterator[str]:
    for tie in fit.ties:
        yield ""
        yield _tied(tie, fit.within)
        yield _remedy(tie, fit)
    for estimate in fit.estimates:
        if estimate.at_end:
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
    if fit.correlation > LEAST_CORRELATION:
        yield ""
        yield (
            f"Residuals of successive clouds are correlated ({fit.correlation:.2f}), unlike noise: the model lacks "
            "something (the start, the grip, the air, the weave). The intervals are widened for it, and may still be "
            "too narrow."
        )


def _tied(tie: Tie, within: float) -> str:
    names = [parameter.name for parameter in tie.parameters]
    if tie.single:
        hardly = "these clouds hardly depend on it; " if tie.bound > 0.5 else ""
        return f"{names[0]}: {hardly}its standard deviation is at least {_percent(tie.bound)}."
    changes = " and ".join(
        f"{name} by {'+' if part > 0 else '-'}{abs(10 * part):.2g} %"
        for name, part in zip(names, tie.parts, strict=True)
    )
    if tie.bound < 4.0 * within:
        return f"The most uncertain combination is {changes}, together (sigma {_percent(tie.bound)})."
    known = ""
    if len(names) == 2 and abs(abs(tie.parts[1]) - 1.0) < 0.15:
        known = f": only their {'ratio' if tie.parts[1] > 0 else 'product'} is identified"
    return (
        f"{' and '.join(names)} are confounded{known}. Changing {changes}, together, changes these clouds by less than "
        f"the noise (standard deviation at least {_percent(tie.bound)})."
    )


def _remedy(tie: Tie, fit: Fit) -> str:
    names = {parameter.name for parameter in tie.parameters}
    if not tie.single and "material.density" in names:
        return (
            "  Remedy: without measured forces, positions identify only the ratio of moduli to density. Weigh the "
            "cloth, set material.density in the scene and omit it here."
        )
    if not tie.bound < 2.0:
        return "  Remedy: omit it, or record a motion that depends on it."
    factor = tie.bound / fit.within
    ways = [
        f"noise {factor:.1f} times lower ({1e3 * fit.sigma / factor:.2g} mm)",
        f"{factor**2:.1f} times as many clouds",
    ]
    if names & {"material.stretch_modulus", "material.shear_modulus"}:
        ways.append("stronger shaking in the sheet's plane (larger accelerations, a weight at the free edge)")
    elif names & {"material.damping", "material.viscosity", "air.drag"}:
        ways.append("faster shaking, and its decay after it stops")
    elif names & {"material.bending_modulus", "bending.stiffness"}:
        ways.append("folds: hands closer together, waves across the sheet")
    else:
        ways.append("more motion")
    if not tie.single:
        ways.append("an independent measurement of one of them, which is then omitted")
    return "  Remedy: " + ", or ".join(ways) + "."


def _percent(part: float) -> str:
    return "infinite" if not math.isfinite(part) else f"{100 * part:.2g} %" if part < 10.0 else "> 1000 %"


def _number(value: float) -> str:
    return f"{value:.4g}"
