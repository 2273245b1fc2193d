# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `reality`: the cloth against recordings of real cloth, and against synthetic copies of them, by part."""

from __future__ import annotations

import argparse
from pathlib import Path

from validation.command import at_least
from validation.report import Report

#: Names of the parts.
PARTS = ("swings", "models", "recorded")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--part", choices=PARTS, default="swings", help="part")
    swings = parser.add_argument_group(
        "swings: fits to a synthetic copy of a recorded set; models: to motions of other models"
    )
    swings.add_argument("--fits", type=int, default=1, help="complete fits")
    linear = "fits that are linear about the true parameters; a second each"
    swings.add_argument("--linear", type=int, default=0, help=linear)
    swings.add_argument("--motions", type=at_least(5), default=40, help="motions of the set")
    swings.add_argument("--first", type=int, default=0, help="seed of the first fit")
    record = "file of JSON lines: finished fits are read from it, new ones appended"
    swings.add_argument("--record", type=Path, metavar="FILE", help=record)
    recorded = parser.add_argument_group("recorded: swings of a real cloth, which lie on this machine")
    folder = "folder of the recordings; without it the part is skipped"
    recorded.add_argument("--folder", type=Path, help=folder)
    swings.add_argument("--workers", type=int, help="processes")


def run(options: argparse.Namespace) -> Report:
    """Run a part."""
    from validation.reality import other_models, recorded_swings, swings

    parts = {"swings": swings, "models": other_models, "recorded": recorded_swings}
    return parts[options.part].run(options)
