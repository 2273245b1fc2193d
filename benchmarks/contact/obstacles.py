# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact with obstacles against theory, and the cost of contact.

Measured are drift on a slope, a strip over a drum, impacts, and the cost of contact and self-contact. Sheets are 0.3 m
wide, of the default material, with contact.thickness 2 mm, without air. Sleep is off.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import numpy as np
from support.obstacle_sheets import BORNE, FRAME, SHEET, THICKNESS, Capstan, Motion, sheet, slope

from benchmarks.contact import self_contact as contact_self
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY
from cloth_sim_ros.physics.state.state import State
from cloth_sim_ros.scene.scene import Scene
from validation.report import Report, Table, print_progress

#: Offset below the friction angle at which a sheet must stick [deg].
STICTION_MARGIN = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS], help="what to measure (all)")
    parser.add_argument("--drift", type=float, default=600.0, metavar="SECONDS", help="on a slope (600)")
    parser.add_argument("--fold", type=float, default=6.5, metavar="SECONDS", help="of the fold that are run (6.5)")
    parser.add_argument("--seconds", type=float, default=20.0, help="that each comparison of costs takes (20)")


def run(options: argparse.Namespace) -> Report:
    """Run the selected parts."""
    report = Report("Contact", "python -m benchmarks contact")
    for part in options.parts:
        print_progress(f"{part} ...")
        PARTS[part](report, options)
    return report


def drift(report: Report, options: argparse.Namespace) -> None:
    """Measure the drift of a sheet on a slope 0.1 degrees below the friction angle."""
    steep = math.degrees(math.atan(0.5)) - STICTION_MARGIN
    motion = slope("grid", 8, steep, (0.5, 0.5))
    motion.advance_frames(60)
    start, start_anchors = motion.state.x.copy(), motion.state.memory[ANCHORS_KEY].copy()
    motion.advance_frames(round(options.drift / FRAME))
    displacement = float(np.abs(motion.state.x - start).max())
    slipped = int((motion.state.memory[ANCHORS_KEY] != start_anchors).sum())
    columns = ["seconds", "largest way um", "numbers of anchors that changed"]
    report.tables.append(Table("Drift", columns, [[options.drift, 1e6 * displacement, slipped]]))
    report.require(displacement < 1e-6 and not slipped, f"a sheet that sticks drifted by {displacement:.2g} m")


def capstan(report: Report, options: argparse.Namespace) -> None:
    """Compare the tensions at the ends of a strip over a turning drum with the capstan equation."""
    table = report.add_table("Capstan", ["mu", "angle deg", "mu theta", "ratio", "exp(mu theta)", "off %"])
    for mu, degrees in ((0.25, 90.0), (0.5, 90.0), (0.5, 180.0), (0.64, 180.0)):
        strip = Capstan(mu, math.radians(degrees))
        # The integrator of the product.
        steps = Scene.from_parameters({**SHEET, "tolerance": 1e-4}).build_integrator()
        state = State(strip.start)
        pulls = np.zeros(2)
        for frame in range(150):
            strip.turn(frame * FRAME)
            steps.advance(strip.plan, state, frame * FRAME, FRAME)
            if frame >= 60:
                pulls += strip.tensions(state.x, state.v)
        ratio, expected = float(pulls.max() / pulls.min()), math.exp(mu * math.radians(degrees))
        off = ratio / expected - 1.0
        table.rows.append([mu, degrees, mu * math.radians(degrees), ratio, expected, 100.0 * off])
        report.require(abs(off) < 0.03, f"mu {mu} over {degrees:g} degrees: tensions {100.0 * off:.2g} % off")
    report.note("Capstan: means over 1.5 s, from 1 s on; the drum surface slides at 0.2 m/s under the strip.")


def impacts(report: Report, options: argparse.Namespace) -> None:
    """Drop sheets flat and edge on onto a plane."""
    columns = ["speed m/s", "sheet falls", "deepest gap / thickness", "finest step us", "evaluations", "flagged"]
    table = report.add_table("Impacts", columns)
    for speed in (1.0, 5.0, 20.0):
        for name, orientation in (("flat", [0.0, 0.0, 0.0, 1.0]), ("edge on", contact_self.EDGE_ON)):
            values, _ = sheet("grid", 12)
            values |= {
                "cloth.position": [0.0, 0.0, 0.01 + (0.15 if name == "edge on" else 0.0)],
                "cloth.orientation": orientation,
                "obstacles": ["floor"],
                "floor.shape": "plane",
                "tolerance": 1e-3,
            }
            motion = Motion(values)
            motion.state.v[2] = -speed
            deepest, finest, evaluations, flagged = math.inf, math.inf, 0, 0
            for _ in range(30):
                start = motion.state.x.copy(), motion.state.v.copy()
                done = motion.advance()
                # The frame is repeated in a single run that records the smallest gap.
                steps = [math.ceil(FRAME / done.step)]
                begin = motion.frames * FRAME - FRAME
                (again,), _ = motion.plan.runs(begin, FRAME, start, steps, record_obstacles=True, memory={})
                deepest = min(deepest, again.min_gap)
                finest, evaluations = min(finest, done.step), evaluations + done.evaluations
                flagged += done.flagged
            table.rows.append([speed, name, deepest / THICKNESS, 1e6 * finest, evaluations, flagged])
            report.require(deepest > 0.0, f"{speed:g} m/s, {name}: through the floor")
    report.note("Impacts: 30 frames after a start 10 mm above; a frame that reaches its work limit is flagged.")


def cost(report: Report, options: argparse.Namespace) -> None:
    """Compare the frame time of a sheet on a table with a free one, and of a distant obstacle with none."""
    table = report.add_table("Cost", ["what", "sheet", "against", "times", "at most"])
    flat = {"cloth.orientation": [0.0, 0.0, 0.0, 1.0], "tolerance": 1e-3}
    for count in (30, 64):
        common = {**SHEET, "cloth.size": [1.0, 1.0], "cloth.resolution": [count, count], **flat}
        lying = {**common, "cloth.position": [0.0, 0.0, BORNE * THICKNESS], "obstacles": ["it"], "it.shape": "plane"}
        for name, friction in (("on a table", 0.0), ("on a table with friction", 0.5)):
            on = Motion({**lying, "it.friction": [friction, friction]})
            free = Motion({**common, "gravity": [0.0, 0.0, 0.0]})
            ratio = contact_self.frame_cost_ratio(on, free, settling_frames=60, seconds=options.seconds)
            table.rows.append([name, f"{count} x {count}", "floating", ratio, 1.3])
            report.require(ratio <= 1.3, f"{name}, {count} x {count}: {ratio:.3g} times a free sheet's frame")
        hung = {**common, "cloth.anchors": ["top"], "cloth.orientation": contact_self.EDGE_ON}
        ball = {"obstacles": ["it"], "it.shape": "sphere", "it.size": [0.2], "it.position": [3.0, 0.0, 0.0]}
        near_ball, alone = Motion({**hung, **ball}), Motion(hung)
        ratio = contact_self.frame_cost_ratio(near_ball, alone, settling_frames=60, seconds=options.seconds)
        table.rows.append(["a ball out of reach", f"{count} x {count}", "none", ratio, 1.02])
        report.require(ratio <= 1.02, f"a ball out of reach costs {ratio:.4g} times, {count} x {count}")


#: Function of each part.
PARTS: dict[str, Callable[[Report, argparse.Namespace], None]] = {
    "drift": drift,
    "capstan": capstan,
    "impacts": impacts,
    "cost": cost,
    "folds": contact_self.folds,
    "hanging": contact_self.hanging,
    "separated": contact_self.separated,
}
