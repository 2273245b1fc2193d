# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Certificate as text: sentences, and tables of windows and worst frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.verify.certificate import MAX_AMPLIFICATION, AccuracyWindow, Certificate, FrameAccuracy

#: Maximum number of listed windows (the worst ones), and of listed frames.
_MAX_WINDOWS, _MAX_FRAMES = 60, 5


def describe_accuracy(certificate: Certificate) -> str:
    """Return a certificate as text: sentences, a table of the worst windows and one of the worst frames."""
    if not certificate.frames:
        return "Accuracy: no time passes in the session; there is nothing to measure."
    windows = sorted(certificate.windows, key=_window_severity, reverse=True)[:_MAX_WINDOWS]
    listed = sorted(windows, key=lambda window: window.index)
    worst = sorted(certificate.frames, key=_frame_severity, reverse=True)[:_MAX_FRAMES]
    lines = [" ".join(_sentences(certificate)), ""]
    if len(listed) < len(certificate.windows):
        lines.append(f"The worst {len(listed)} of {len(certificate.windows)} windows:")
    lines += _table([_window_row(window) for window in listed])
    lines += ["", "The worst frames:", *_table([_frame_row(frame) for frame in worst])]
    return "\n".join(lines)


def _sentences(certificate: Certificate) -> list[str]:
    windows = certificate.windows
    violated, undecided, flagged = (
        certificate.windows_with(verdict) for verdict in ("not kept", "undecided", "flagged")
    )
    n_bounded = len(windows) - len(certificate.windows_with("no promise"))
    sentences = [
        f"Accuracy: of {pluralize(n_bounded, 'window')} of a second, {len(certificate.windows_with('kept'))} satisfy "
        f"the "
        "error bound."
    ]
    if not n_bounded:
        sentences = ["Accuracy: no tolerance is set, therefore there is no error bound."]
    elif n_bounded < len(windows):
        sentences.append(f"In {len(windows) - n_bounded} more no tolerance is set.")
    if flagged:
        sentences.append(f"{len(flagged)} do not, and the simulation flagged their frames.")
    if violated:
        sentences.append(f"VIOLATED, unflagged: {_list_windows(violated)}.")
    if undecided:
        sentences.append(
            f"Undecided, because the certificate is not accurate enough there: {_list_windows(undecided)}."
        )
    chaotic = sum(window.amplification > MAX_AMPLIFICATION for window in windows)
    if chaotic:
        sentences.append(
            f"In {chaotic} a perturbation grows more than {MAX_AMPLIFICATION:g} times: positions there are "
            f"unpredictable."
        )
    if certificate.altered:
        sentences.append(
            f"The recorded positions of {pluralize(certificate.altered, 'frame')} do not follow from its record."
        )
    if certificate.horizon is None:
        session_errors = [frame.session_error for frame in certificate.frames if not math.isnan(frame.session_error)]
        sentences.append(
            f"Positions are predictable from the beginning to the end ({certificate.longest:.3g} s); "
            f"the error is at most {max(session_errors, default=math.nan):.2g} m."
        )
    else:
        sentences.append(f"Positions are predictable up to {certificate.horizon:.3g} s from the beginning or a reset.")
    sentences.append(_other_integrator(certificate))
    if certificate.unsolved_samples:
        frames = ", ".join(str(sample.frame) for sample in certificate.unsolved_samples[:5])
        count = pluralize(len(certificate.unsolved_samples), "frame")
        sentences.append(f"Undecided, because scipy's DOP853 has no solution: {count} ({frames}).")
    sentences.append(f"({certificate.seconds:.1f} s)")
    return sentences


def _other_integrator(certificate: Certificate) -> str:
    samples = certificate.samples
    if not samples:
        return "No frame was checked with another integrator."
    disagreeing = [sample for sample in samples if not sample.agrees]
    largest = max(sample.difference for sample in samples)
    if disagreeing:
        frames = ", ".join(str(sample.frame) for sample in disagreeing[:5])
        return f"BUT scipy's DOP853 differs by up to {largest:.2g} m (frames {frames}): do not trust this certificate."
    return f"On {pluralize(len(samples), 'frame')} scipy's DOP853 agrees within {largest:.2g} m."


def _window_row(window: AccuracyWindow) -> dict[str, str]:
    return {
        "from [s]": f"{window.start:.3f}",
        "to [s]": f"{window.end:.3f}",
        "flagged": f"{window.flagged}/{window.frames}",
        "error [m]": f"{window.error:.2e}",
        "bound [m]": f"{window.error_bound:.2e}",
        "amplification": f"{max(window.amplification, window.later_amplification):.3g}",
        "uncertainty [m]": f"{window.uncertainty:.1e}",
        "rounding [m]": f"{window.floor:.1e}",
        "verdict": window.verdict + (f" in {window.violating_frames} alone" if window.violating_frames else ""),
    }


def _frame_row(frame: FrameAccuracy) -> dict[str, str]:
    return {
        "frame": str(frame.frame),
        "at [s]": f"{frame.time:.3f}",
        "error [m]": f"{frame.error:.2e}",
        "of this frame [m]": f"{frame.error_of_frame:.2e}",
        "bound [m]": f"{frame.error_bound:.2e}",
        "amplification": f"{frame.amplification:.3g}",
        "since the beginning [m]": f"{frame.session_error:.2e}",
        "flagged": "yes" if frame.flagged else "no",
    }


def _table(rows: Sequence[dict[str, str]]) -> list[str]:
    cells = [list(rows[0]), *(list(row.values()) for row in rows)]
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    return ["  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in cells]


def _window_severity(window: AccuracyWindow) -> float:
    return _severity(window.error, window.error_bound)


def _frame_severity(frame: FrameAccuracy) -> float:
    return _severity(frame.error, frame.error_bound)


def _severity(error: float, allowed: float) -> float:
    """Return the key that sorts errors: error over its bound, or the error without a bound; infinite if unknown."""
    if math.isnan(error):
        return math.inf
    return error if math.isnan(allowed) else error / allowed


def _list_windows(windows: Sequence[AccuracyWindow]) -> str:
    ranges = ", ".join(f"{window.start:.3f} to {window.end:.3f} s (frame {window.worst})" for window in windows[:5])
    return ranges if len(windows) <= 5 else f"{ranges} and {len(windows) - 5} more"
