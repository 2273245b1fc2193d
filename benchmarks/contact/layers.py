# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Friction between layers of the cloth against theory: the angle at which a stack slides, its motion, its rest."""

from __future__ import annotations

import argparse
import math

import numpy as np
from support.layer_stacks import advance, advance_with_balance, anchors, friction_error, is_sliding, stack
from support.obstacle_sheets import FRAME

from validation.report import Report

#: Largest relative error of the angle at which a stack slides.
OFF = 0.02


def layers(report: Report, options: argparse.Namespace) -> None:
    """Measure stacks just below and above the friction angle, resting stacks and sliding stacks."""
    columns = ["mu", "particles, above and below", "slides at 0.98 mu N", "at 1.02 mu N", "friction off %"]
    table = report.add_table("Layers", columns)
    for mu in (0.2, 0.5, 1.0):
        for count, below in ((7, 13), (10, 13), (13, 13), (10, 21)):
            slides_below = is_sliding(stack(count, below, math.degrees(math.atan((1.0 - OFF) * mu)), (mu,)))
            slides_above = is_sliding(stack(count, below, math.degrees(math.atan((1.0 + OFF) * mu)), (mu,)))
            off = friction_error(count, below, mu)
            name = f"{count}^2 on {below}^2"
            table.rows.append([mu, name, slides_below, slides_above, 100.0 * off])
            report.require(slides_above and not slides_below, f"mu {mu}, {name}: does not begin to slide at mu N")
            report.require(abs(off) < OFF, f"mu {mu}, {name}: friction in motion is {100.0 * off:.2g} % off mu N")
    _drift(report, options)
    _energy(report)


def _drift(report: Report, options: argparse.Namespace) -> None:
    """Measure the drift of a stack 0.1 degrees below the friction angle."""
    motion = stack(10, 13, math.degrees(math.atan(0.5)) - 0.1, (0.5,))
    advance(motion, 60)
    start, start_anchors = motion.state.x.copy(), anchors(motion)
    advance(motion, round(options.drift / 10.0 / FRAME))
    drift = float(np.abs(motion.state.x - start).max())
    moved = int((anchors(motion) != start_anchors).sum())
    table = report.add_table("Layers at rest", ["seconds", "largest way um", "numbers of anchors that changed"])
    table.rows.append([options.drift / 10.0, 1e6 * drift, moved])
    if not drift < 1e-6 or moved:
        report.fail(f"a stack that sticks drifted by {drift:.2g} m, {moved} numbers of anchors changed")


def _energy(report: Report) -> None:
    """Measure friction work and energy residual of a sliding stack."""
    balance, worst, least = advance_with_balance(stack(10, 13, 40.0, (0.5, 0.4)), 18)
    columns = ["lost J", "by friction J", "least in a frame J", "residual / turned over"]
    table = report.add_table("Energy of a stack that slides", columns)
    table.rows.append([balance.dissipation, balance.friction_work, least, worst / balance.energy_turnover])
    if not (least >= 0.0 and worst <= 1e-3 * balance.energy_turnover):
        report.fail(f"friction gave energy, or the balance is open: {least:.2g} J, {worst:.2g} J")
