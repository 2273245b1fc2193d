# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Throughput of other engines on the same sheet, at their longest stable steps."""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import attrs
import numpy as np
from support.problems import PERIOD, corner_drop, curtain

from benchmarks.peers import environment as peer_environment
from benchmarks.peers.environment import Attempt, Peer, PeerFailed
from benchmarks.peers.solvers import PEERS, REQUIREMENTS
from benchmarks.speed import curtain as speed_curtain
from validation.command import above, at_least
from validation.report import Report, print_progress

#: Smallest speed ratio of the product to the fastest peer, and the N of scene C for which it applies.
MIN_PEER_RATIO, RATED_RESOLUTIONS = 15.0, (64, 128)
#: The product runs at the loosest of these tolerances with an error of at most 1 mm [m].
TOLERANCES = (1e-3, 1e-4)
SCENES = {"curtain": curtain, "corners": corner_drop}
#: Time limit of a round, as a share of that of a run of the search.
_ROUND = 0.25


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--scene", choices=SCENES, default="curtain", help="an edge pinned (C), or two corners (A)")
    sizes = [*speed_curtain.SCORED_FRAMES]
    parser.add_argument("--resolutions", type=int, nargs="+", metavar="N", default=sizes, help="particles a side")
    parser.add_argument("--duration", type=above(0.0), default=1.0, metavar="S", help="simulated seconds of each run")
    torn = "an edge longer than this times its rest is torn"
    parser.add_argument("--stretch", type=above(1.0), default=1.5, metavar="TIMES", help=torn)
    parser.add_argument(
        "--repeats", type=at_least(1), default=3, help="timed rounds with every peer at its longest step"
    )
    parser.add_argument(
        "--peer-threads", type=at_least(1), default=1, metavar="N", help="for a peer that can use several"
    )
    peer_environment.add_arguments(parser, REQUIREMENTS, seconds=10.0)


@attrs.define
class EngineRuns:
    """Runs of one engine on one sheet: simulated seconds per wall second of each round, and a peer's attempts."""

    name: str
    factors: list[float] = attrs.field(factory=list)
    attempts: list[Attempt] = attrs.field(factory=list)

    @property
    def factor(self) -> float:
        """Median factor of the rounds."""
        return statistics.median(self.factors)


def run(options: argparse.Namespace) -> Report:
    """Measure the selected sheets and engines."""
    for resolution in options.resolutions:
        # Checked before any expensive run.
        speed_curtain.scored(SCENES[options.scene], resolution)
    report = Report("Peers")
    folder, absent = peer_environment.prepare_selected(options, REQUIREMENTS, report)
    peers = [peer for peer in PEERS if peer.package in options.peers and peer.package not in absent]
    report.note(
        f"a peer's step is the longest, to about a fifth, at which its sheet stays whole for {options.duration:g} s: "
        f"no edge longer than {options.stretch:g} times its rest length at any frame; peers do not report their error"
    )
    threads = "one thread" if options.peer_threads == 1 else f"up to {options.peer_threads} threads"
    report.note(f"peers have {threads} each; medians of {options.repeats} interleaved rounds")
    report.notes += [f"{peer.name}: {peer.differs}" for peer in peers]
    factors = report.add_table("Simulated seconds per wall second", ["engine"])
    columns = ["N", "tolerance m", "error m", "at s", "fastest peer", "as fast as it", "on one core"]
    report.add_table("Product against the fastest peer", columns)
    columns = ["N", "engine", "steps a frame", "step s", "largest stretch", "simulated s", "ms a step", "x real time"]
    report.add_table("Each peer at its longest step", columns)
    by_name: dict[str, dict[int, float]] = {}
    for resolution in options.resolutions:
        for entry in compare(options, folder, resolution, peers, report):
            by_name.setdefault(entry.name, {})[resolution] = entry.factor
    factors.columns += [f"N = {resolution}" for resolution in options.resolutions]
    factors.rows = [[name, *(by.get(n, "-") for n in options.resolutions)] for name, by in by_name.items()]
    return report


def compare(
    options: argparse.Namespace, folder: Path, resolution: int, peers: list[Peer], report: Report
) -> list[EngineRuns]:
    """Search the longest step of each engine on one sheet, time all engines in turns, and report; return the runs."""
    where, scene = f"N = {resolution}", SCENES[options.scene]
    print_progress(f"{where}: reference")
    scored = speed_curtain.scored(scene, resolution)
    known = speed_curtain.trusted(scored)
    for tolerance in TOLERANCES:
        # The loosest accurate tolerance counts.
        error = known.deviation(scored.frames, speed_curtain.run(scored, tolerance=tolerance).positions)
        if error <= speed_curtain.ACCURATE:
            break
    whole = attrs.evolve(scored, frames=max(round(options.duration / PERIOD), 1))
    product, one_core = EngineRuns("cloth_sim_ros, as shipped"), EngineRuns("cloth_sim_ros, one core")
    longest: dict[Peer, EngineRuns] = {}
    with tempfile.TemporaryDirectory() as temporary:
        sheet = Path(temporary, "sheet.npz")
        np.savez(sheet, **peer_environment.sheet_tables(whole))

        def attempt(peer: Peer, steps: int, share: float = 1.0) -> Attempt:
            return peer_environment.attempt(
                peer,
                sheet,
                steps,
                environment=folder,
                frames=whole.frames,
                seconds=share * options.seconds,
                whole=options.stretch,
                threads=options.peer_threads,
            )

        for peer in peers:
            try:
                first = _search(peer, resolution, attempt)
            except PeerFailed as failure:
                report.note(f"FAILED: {where}: {failure}")
                continue
            if first is None:
                report.note(f"FAILED: {where}: {peer.name}: no step kept the sheet whole")
                continue
            longest[peer] = EngineRuns(peer.name, attempts=[first])
        for round_index in range(options.repeats):
            print_progress(f"{where}: round {round_index + 1} of {options.repeats}")
            for is_on_one_core, entry in ((False, product), (True, one_core)):
                run = speed_curtain.run(whole, tolerance=tolerance, one_core=is_on_one_core)
                entry.factors.append(whole.duration / run.seconds)
            for peer, entry in longest.items():
                entry.attempts.append(attempt(peer, entry.attempts[0].steps, _ROUND))
                entry.factors.append(entry.attempts[-1].factor)
    report.note(f"{where}: the error's reference is within {known.error:.1g} m of the exact solution")
    for entry in longest.values():
        _report_peer(entry, resolution, options, report)
    best = max(longest.values(), key=lambda entry: entry.factor, default=None)
    ratios = [best.name, product.factor / best.factor, one_core.factor / best.factor] if best else ["-"] * 3
    report.table("Product").rows.append([resolution, tolerance, error, scored.duration, *ratios])
    if options.scene == "curtain":
        accurate = error <= speed_curtain.ACCURATE
        report.require(accurate, f"{where}: the product is {error:.2g} m off; at most {speed_curtain.ACCURATE:g} m")
        if best and resolution in RATED_RESOLUTIONS and product.factor < MIN_PEER_RATIO * best.factor:
            times = product.factor / best.factor
            report.fail(f"{where}: {times:.3g} times as fast as {best.name}; target {MIN_PEER_RATIO:g}")
    return [product, one_core, *longest.values()]


def _report_peer(entry: EngineRuns, resolution: int, options: argparse.Namespace, report: Report) -> None:
    first, where = entry.attempts[0], f"N = {resolution}"
    stretch, step = max(attempt.stretch for attempt in entry.attempts), PERIOD / first.steps
    row = [resolution, entry.name, first.steps, step, stretch, first.simulated]
    report.table("Each peer").rows.append([*row, 1e3 * step / entry.factor, entry.factor])
    report.environment |= first.versions
    if first.simulated < options.duration - PERIOD:
        report.note(
            f"{where}: {entry.name} reached the limit of {options.seconds:g} s: its sheet was whole for "
            f"{first.simulated:.2f} s and may tear later"
        )
    report.notes += [f"{where}: {entry.name} {remark}" for remark in first.remarks]


def _search(peer: Peer, resolution: int, attempt: Callable[[Peer, int], Attempt]) -> Attempt | None:
    """Run a peer at its longest step that keeps the sheet whole; log each attempt."""
    tried: dict[int, Attempt] = {}

    def is_whole(steps: int) -> bool:
        done = tried[steps] = attempt(peer, steps)
        how = "whole" if done.whole else "torn"
        print_progress(f"N = {resolution}: {peer.name}, {steps} steps a frame: {how} after {done.simulated:.2f} s")
        return done.whole

    steps = peer_environment.longest_step(is_whole, peer.first_steps(resolution))
    return None if steps is None else tried[steps]
