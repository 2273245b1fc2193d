# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Assignment of recorded numbers to plots, from diagnostics and frame records."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from cloth_sim_ros.session import old_keys
from cloth_sim_ros.session.cdr import decode

DIAGNOSTICS_TOPIC = "/diagnostics"

#: Titles of the plots by path, from top to bottom of the window.
PLOTS = {
    "plots/deviation": "Largest deviation [m]",
    "plots/strain": "Largest strain [%]",
    "plots/force": "Force of the cloth [N]",
    "plots/steps": "Steps a frame",
    "plots/pace": "Real time",
    "plots/late": "Late frames",
    "plots/energy": "Energy [J]",
    "plots/error": "Error estimate [m]",
    "plots/accuracy": "Error [m], powers of ten",
    "plots/growth": "Amplification, powers of ten",
}

#: Plots that are shown with a session's accuracy.
ACCURACY = ("plots/accuracy", "plots/growth", "plots/strain", "plots/steps")

#: Patterns of recorded names, with the path of their plot.
_PLOT_PATTERNS = (
    (re.compile(r"real[- ]?time factor(?! overall)"), "plots/pace"),
    (re.compile(r"\blate\b"), "plots/late"),
    (re.compile(r"energy|balance|dissipat|\bwork\b"), "plots/energy"),
    (re.compile(r"error estimate|accuracy error"), "plots/error"),
)
_NUMBER_PATTERN = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?![\w.])")


def diagnostic_numbers(data: bytes) -> Iterator[tuple[str, float]]:
    """Yield plot path and number of each entry of a serialized DiagnosticArray that has a plot. Raises SessionError."""
    message = decode(data, "diagnostic_msgs/msg/DiagnosticArray")
    for status in message.status:
        pairs = ((pair.key, pair.value) for pair in status.values)
        for key, text in old_keys.current_entries(pairs, old_keys.DIAGNOSTICS):
            match = _NUMBER_PATTERN.match(text)
            plot_path = _plot_path(key)
            if match and plot_path:
                yield plot_path, float(match.group(1))


def extra_numbers(extras: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield the plot path and the number of each extra of a frame record that has a plot; nested names are joined."""
    for key, value in extras.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from extra_numbers(value, f"{name} ")
        elif isinstance(value, int | float):
            plot_path = _plot_path(name)
            if plot_path:
                yield plot_path, float(value)


def _plot_path(name: str) -> str | None:
    plain = name.lower().replace("_", " ")
    for pattern, path in _PLOT_PATTERNS:
        if pattern.search(plain):
            return f"{path}/{re.sub(r'[^a-z0-9]+', '_', plain).strip('_')}"
    return None
