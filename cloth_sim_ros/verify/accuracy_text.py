# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Certificate as text: sentences, and tables of windows and worst frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cloth_sim_ros.session.words import counted
from cloth_sim_ros.verify.certificate import MOST_GROWTH, Certificate, FrameAccuracy, Window

#: Maximum number of listed windows (the worst ones), and of listed frames.
_MOST_WINDOWS, _WORST_FRAMES = 60, 5


def describe_accuracy(certificate: Certificate) -> str:
    """Format a certificate as sentences and tables."""
    if not certificate.frames:
        return "Accuracy: no time passes in the session; there is nothing to measure."
    windows = sorted(certificate.windows, key=_badness, reverse=True)[:_MOST_WINDOWS]
    listed = sorted(windows, key=lambda window: window.number)
    worst = sorted(certificate.frames, key=_frame_badness, reverse=True)[:_WORST_FRAMES]
    lines = [" ".join(_sentences(certificate)), ""]
    if len(listed) < len(certificate.windows):
        lines.append(f"The worst {len(listed)} of {len(certificate.windows)} windows:")
    lines += _table([_window_row(window) for window in listed])
    lines += ["", "The worst frames:", *_table([_frame_row(frame) for frame in worst])]
    return "\n".join(lines)


def _sentences(certificate: Certificate) -> list[str]:
    windows = certificate.windows
    broken, open_ones, flagged = (certificate.having(verdict) for verdict in ("not kept", "undecided", "flagged"))
    promised = len(windows) - len(certificate.having("no promise"))
    found = [
        f"Accuracy: of {counted(promised, 'window')} of a second, {len(certificate.having('kept'))} satisfy the "
        "error bound."
    ]
    if not promised:
        found = ["Accuracy: no tolerance is set, therefore there is no error bound."]
    elif promised < len(windows):
        found.append(f"In {len(windows) - promised} more no tolerance is set.")
    if flagged:
        found.append(f"{len(flagged)} do not, and the simulation flagged their frames.")
    if broken:
        found.append(f"VIOLATED, unflagged: {_list(broken)}.")
    if open_ones:
        found.append(f"Undecided, because the certificate is not accurate enough there: {_list(open_ones)}.")
    chaotic = sum(window.growth > MOST_GROWTH for window in windows)
    if chaotic:
        found.append(
            f"In {chaotic} a perturbation grows more than {MOST_GROWTH:g} times: positions there are unpredictable."
        )
    if certificate.altered:
        found.append(
            f"The recorded positions of {counted(certificate.altered, 'frame')} do not follow from its record."
        )
    if certificate.horizon is None:
        along = [frame.session_error for frame in certificate.frames if not math.isnan(frame.session_error)]
        found.append(
            f"Positions are predictable from the beginning to the end ({certificate.longest:.3g} s); "
            f"the error is at most {max(along, default=math.nan):.2g} m."
        )
    else:
        found.append(f"Positions are predictable up to {certificate.horizon:.3g} s from the beginning or a reset.")
    found.append(_other_integrator(certificate))
    found.append(f"({certificate.seconds:.1f} s)")
    return found


def _other_integrator(certificate: Certificate) -> str:
    samples = certificate.samples
    if not samples:
        return "No frame was checked with another integrator."
    wrong = [sample for sample in samples if not sample.agrees]
    largest = max(sample.difference for sample in samples)
    if wrong:
        frames = ", ".join(str(sample.frame) for sample in wrong[:5])
        return f"BUT scipy's DOP853 differs by up to {largest:.2g} m (frames {frames}): do not trust this certificate."
    return f"On {counted(len(samples), 'frame')} scipy's DOP853 agrees within {largest:.2g} m."


def _window_row(window: Window) -> dict[str, str]:
    return {
        "from [s]": f"{window.start:.3f}",
        "to [s]": f"{window.end:.3f}",
        "flagged": f"{window.flagged}/{window.frames}",
        "error [m]": f"{window.error:.2e}",
        "allowed [m]": f"{window.promise:.2e}",
        "growth": f"{max(window.growth, window.later):.3g}",
        "own error [m]": f"{window.own:.1e}",
        "rounding [m]": f"{window.floor:.1e}",
        "verdict": window.verdict + (f" in {window.standing_out} alone" if window.standing_out else ""),
    }


def _frame_row(frame: FrameAccuracy) -> dict[str, str]:
    return {
        "frame": str(frame.frame),
        "at [s]": f"{frame.time:.3f}",
        "error [m]": f"{frame.error:.2e}",
        "of this frame [m]": f"{frame.error_of_frame:.2e}",
        "allowed [m]": f"{frame.promise:.2e}",
        "growth": f"{frame.growth:.3g}",
        "since the beginning [m]": f"{frame.session_error:.2e}",
        "flagged": "yes" if frame.flagged else "no",
    }


def _table(rows: Sequence[dict[str, str]]) -> list[str]:
    cells = [list(rows[0]), *(list(row.values()) for row in rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    return ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in cells]


def _badness(window: Window) -> float:
    return _ratio(window.error, window.promise)


def _frame_badness(frame: FrameAccuracy) -> float:
    return _ratio(frame.error, frame.promise)


def _ratio(error: float, allowed: float) -> float:
    """Return the sort key: error over its bound, or the error itself without a bound. Unknown errors are worst."""
    if math.isnan(error):
        return math.inf
    return error if math.isnan(allowed) else error / allowed


def _list(windows: Sequence[Window]) -> str:
    named = ", ".join(f"{window.start:.3f} to {window.end:.3f} s (frame {window.worst})" for window in windows[:5])
    return named if len(windows) <= 5 else f"{named} and {len(windows) - 5} more"
