# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Contact with obstacles against theory, and the cost of contact and self-contact.

Theory is compared with drift on a slope, a strip over a drum, and impacts. Costs are those of a sheet on a table, a
folded towel, a hanging sheet, and sheets that stay away from themselves. Sheets are 0.3 m wide, of the default
material, with contact.thickness 2 mm, without air. Sleep is off.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import attrs
import numpy as np
from support.obstacle_sheets import BORNE, FRAME, SHEET, THICKNESS, Capstan, Motion, sheet, slope

from benchmarks.timing import time_interleaved
from cloth_sim_ros import Grasp, Scene, Simulation, State, Target
from cloth_sim_ros.physics.state.controller_state import ANCHORS_KEY
from cloth_sim_ros.scene.parameters import parameter_file
from cloth_sim_ros.simulation.gripper_script import GripperScript
from cloth_sim_ros.simulation.script_events import ScriptEvents
from validation.report import Report, Table, print_progress

#: Orientation of a sheet that stands on its edge.
EDGE_ON = [0.7071067811865476, 0.0, 0.0, 0.7071067811865476]
#: Folder of the fold's scene and of the grippers' scripts.
CONFIG = Path(__file__).resolve().parents[2] / "config"
#: Thickness by resolution [m]: that of config/fold.yaml, and half a spacing of 64 x 64.
THICKNESSES = {30: 4e-3, 64: 3e-3}
#: Resolutions of the hanging sheets.
HANGING_RESOLUTIONS = (30, 64)
#: Frames of each motion of a separated sheet, and its largest cost with self-contact, relative to that without.
SEPARATED_FRAMES, MAX_SEPARATED_RATIO = 90, 1.15
#: Frames per second of simulated time.
FRAMES_PER_SECOND = round(1.0 / FRAME)


@attrs.frozen
class FoldRecord:
    """Cost of a fold, frame by frame."""

    #: Processor time [s], force evaluations, and contacts at its end.
    seconds: list[float]
    evaluations: list[int]
    contacts: list[int]
    particles: int

    @property
    def worst(self) -> int:
        """Index of the first frame of the slowest second."""
        n_windows = max(1, len(self.seconds) - FRAMES_PER_SECOND + 1)
        sums = [sum(self.seconds[k : k + FRAMES_PER_SECOND]) for k in range(n_windows)]
        return int(np.argmax(sums))

    def speed(self, first: int = 0, frames: int | None = None) -> float:
        """Return the real-time factor of a range of frames."""
        part = self.seconds[first:] if frames is None else self.seconds[first : first + frames]
        return len(part) * FRAME / sum(part)


def fold_events() -> ScriptEvents:
    """Return the commands to the grippers; each grasp acts in the frame that ends at its time."""
    scripts = [GripperScript.from_file(CONFIG / f"fold_{name}.yaml") for name in ("left", "right")]
    early = [
        attrs.evolve(script, grasps=tuple(attrs.evolve(grasp, time=grasp.time - FRAME) for grasp in script.grasps))
        for script in scripts
    ]
    return ScriptEvents(early, FRAME)


def fold(count: int, thickness: float, frames: int) -> FoldRecord:
    """Fold a towel of count x count particles for some frames."""
    values = {
        **parameter_file.read(CONFIG / "fold.yaml", node="cloth_sim", strict=True),
        "wind.normal_drag": 0.0,
        "cloth.resolution": [count, count],
        "cloth.position": [0.0, 0.0, 0.975 * thickness],
        "contact.thickness": thickness,
    }
    simulation = Simulation(Scene.from_parameters(values))
    record, events = FoldRecord([], [], [], simulation.state.x.shape[1]), fold_events()
    for frame in range(frames):
        commands = events.at(frame)
        start = time.process_time()
        done = simulation.advance(commands)
        record.seconds.append(time.process_time() - start)
        record.evaluations.append(0 if done.advance is None else done.advance.evaluations)
        contact = simulation.plan.contact
        record.contacts.append(0 if contact is None else contact.self_gaps(simulation.state.x)[0])
    return record


def folds(report: Report, options: argparse.Namespace) -> None:
    """Measure the processor time of folds of two resolutions, overall and in the slowest second."""
    columns = ["sheet", "thickness mm", "times real time", "in the worst second", "contacts in it a particle"]
    table = report.add_table(
        "Folding a towel", [*columns, "contacts at the end", "evaluations a frame", "in the worst second's"]
    )
    frames = max(1, round(options.fold / FRAME))
    for count, thickness in THICKNESSES.items():
        done = fold(count, thickness, frames)
        first = done.worst
        worst = slice(first, first + FRAMES_PER_SECOND)
        share = float(np.mean(done.contacts[worst])) / done.particles
        speeds = [done.speed(), done.speed(first, FRAMES_PER_SECOND)]
        row = [f"{count} x {count}", 1e3 * thickness, *speeds, share, done.contacts[-1]]
        means = [float(np.mean(done.evaluations)), float(np.mean(done.evaluations[worst]))]
        table.rows.append([*row, *means])
    report.note("Folding: by processor time of one process; 1 is real time, more is faster.")


def hanging(report: Report, options: argparse.Namespace) -> None:
    """Measure a hanging sheet at rest with and without self-contact."""
    table = report.add_table("A sheet that hangs", ["sheet", "with contact.self: times", "at most"])
    for count in HANGING_RESOLUTIONS:
        values = {
            **SHEET,
            "cloth.size": [1.0, 1.0],
            "cloth.resolution": [count, count],
            "cloth.anchors": ["top"],
            "cloth.orientation": EDGE_ON,
            "air.drag": 0.5,
            "tolerance": 1e-3,
        }
        motions = [Motion({**values, "contact.self": has_self_contact}) for has_self_contact in (True, False)]
        ratio = frame_cost_ratio(*motions, settling_frames=120, seconds=options.seconds)
        table.rows.append([f"{count} x {count}", ratio, 1.1])
        report.require(ratio <= 1.1, f"{count} x {count}, hanging: {ratio:.3g} times with contact.self")


def frame_cost_ratio(candidate: Motion, baseline: Motion, *, settling_frames: int, seconds: float) -> float:
    """Return the ratio of the frame times after both motions have settled."""
    for motion in (candidate, baseline):
        motion.advance_frames(settling_frames)
    # A turn has enough frames for one error estimate.
    turns = {name: partial(motion.advance_frames, 80) for name, motion in (("one", candidate), ("other", baseline))}
    return time_interleaved(turns, seconds=seconds, clock=time.process_time).ratio("one", "other")


def _carried(scene: Scene) -> None:
    """Carry a sheet by a corner, at up to 0.35 m/s."""
    x = scene.initial_positions()
    corner = x[np.argmax(x[:, 0] - x[:, 2])]
    simulation = Simulation(scene)
    for k in range(SEPARATED_FRAMES):
        t = k * FRAME
        offset = 0.1 * math.sin(2.0 * t), 0.2 * (1.0 - math.cos(1.5 * t)), 0.1 * (1.0 - math.cos(t))
        simulation.advance([Target("gripper", tuple(corner + offset)), *([] if k else [Grasp("gripper", True)])])


def _advance_free(simulation: Simulation) -> None:
    for _ in range(SEPARATED_FRAMES):
        simulation.advance([])


def _spinning(scene: Scene) -> None:
    """Let a free sheet fall while it spins at 3.2 rad/s."""
    x = scene.initial_positions()
    _advance_free(Simulation(scene, State(x, np.cross([0.5, 3.0, 1.0], x - x.mean(axis=0)))))


def _above_table(scene: Scene) -> None:
    """Drop a flat sheet on a table from three thicknesses."""
    x = scene.initial_positions()
    height = np.full(len(x), 3.0 * scene.contact.thickness)
    x = np.column_stack([x[:, 0], x[:, 2] - x[:, 2].min(), height])
    _advance_free(Simulation(scene, State(x, np.zeros_like(x))))


def separated(report: Report, options: argparse.Namespace) -> None:
    """Measure the default cloth with and without self-contact while no part of it comes near another."""
    table = report.add_table("A sheet away from itself", ["motion", "with contact.self: times", "at most"])
    on_table = {"obstacles": ["table"], "table.shape": "plane", "table.position": [0.0, 0.0, 0.0]}
    for name, motion, values in (
        ("is carried by a corner", _carried, {}),
        ("spins in free fall", _spinning, {"cloth.anchors": []}),
        ("falls on a table from 3 d", _above_table, {"cloth.anchors": [], **on_table}),
    ):
        scenes = {on: Scene.from_parameters({**values, "contact.self": on}) for on in (True, False)}
        candidates = {setting: partial(motion, scenes[on]) for setting, on in (("with", True), ("without", False))}
        turns = time_interleaved(candidates, seconds=options.seconds, clock=time.process_time)
        ratio = turns.ratio("with", "without")
        table.rows.append([name, ratio, MAX_SEPARATED_RATIO])
        report.require(ratio <= MAX_SEPARATED_RATIO, f"a sheet that {name} costs {ratio:.3g} times with contact.self")


#: Offset below the friction angle at which a sheet must stick [deg].
STICTION_MARGIN = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS], help="what to measure")
    parser.add_argument("--drift", type=float, default=600.0, metavar="SECONDS", help="on a slope")
    parser.add_argument("--fold", type=float, default=6.5, metavar="SECONDS", help="of the fold that are run")
    parser.add_argument("--seconds", type=float, default=20.0, help="that each comparison of costs takes")


def run(options: argparse.Namespace) -> Report:
    """Run the selected parts."""
    report = Report("Contact")
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
        for name, orientation in (("flat", [0.0, 0.0, 0.0, 1.0]), ("edge on", EDGE_ON)):
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
            ratio = frame_cost_ratio(on, free, settling_frames=60, seconds=options.seconds)
            table.rows.append([name, f"{count} x {count}", "floating", ratio, 1.3])
            report.require(ratio <= 1.3, f"{name}, {count} x {count}: {ratio:.3g} times a free sheet's frame")
        hung = {**common, "cloth.anchors": ["top"], "cloth.orientation": EDGE_ON}
        ball = {"obstacles": ["it"], "it.shape": "sphere", "it.size": [0.2], "it.position": [3.0, 0.0, 0.0]}
        near_ball, alone = Motion({**hung, **ball}), Motion(hung)
        ratio = frame_cost_ratio(near_ball, alone, settling_frames=60, seconds=options.seconds)
        table.rows.append(["a ball out of reach", f"{count} x {count}", "none", ratio, 1.02])
        report.require(ratio <= 1.02, f"a ball out of reach costs {ratio:.4g} times, {count} x {count}")


#: Function of each part.
PARTS: dict[str, Callable[[Report, argparse.Namespace], None]] = {
    "drift": drift,
    "capstan": capstan,
    "impacts": impacts,
    "cost": cost,
    "folds": folds,
    "hanging": hanging,
    "separated": separated,
}
