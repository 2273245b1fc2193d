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
from support.problems import PERIOD, Problem, corner_drop, curtain

from benchmarks.peers import environment as peer_environment
from benchmarks.peers import jobs as peer_jobs
from benchmarks.peers.jobs import Attempt, Peer, PeerFailed
from benchmarks.peers.solvers import PEERS, REQUIREMENTS
from benchmarks.speed import curtain as speed_curtain
from validation.command import above, at_least
from validation.report import Report, Table, print_progress

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
class EngineEntry:
    """Runs of one engine on one sheet."""

    name: str
    #: Simulated seconds per wall second of each round.
    factors: list[float] = attrs.field(factory=list)
    attempts: list[Attempt] = attrs.field(factory=list)

    @property
    def factor(self) -> float:
        """Median factor of the rounds."""
        return statistics.median(self.factors)


@attrs.define
class SheetComparison:
    """Runs of all engines on one sheet."""

    resolution: int
    tolerance: float
    #: Largest position error of the product [m], and the time at which it is measured [s].
    error: float
    scored: float
    reference_error: float
    product: EngineEntry
    one_core: EngineEntry
    peers: list[EngineEntry] = attrs.field(factory=list)
    #: Failures of peers: the output of those without a result, and sheets that were never whole.
    failed: list[str] = attrs.field(factory=list)

    @property
    def fastest(self) -> EngineEntry | None:
        """Fastest peer; None if none gave a result."""
        return max(self.peers, key=lambda entry: entry.factor, default=None)


def run(options: argparse.Namespace) -> Report:
    """Measure the selected sheets and engines."""
    for resolution in options.resolutions:
        # Checked before any expensive run.
        speed_curtain.scored(SCENES[options.scene], resolution)
    folder = options.environment.expanduser().absolute()
    requirements = {name: REQUIREMENTS[name] for name in options.peers}
    absent = peer_environment.prepare(folder, requirements, print_progress) if requirements else {}
    peers = [peer for peer in PEERS if peer.package in requirements and peer.package not in absent]
    fields = [measure(options, folder, resolution, peers) for resolution in options.resolutions]
    report = Report("Peers")
    report.notes += [f"ABSENT: {name}: {reason}" for name, reason in absent.items()]
    report.tables += [_throughput(fields), _comparison(fields), _details(fields)]
    _explain(options, peers, fields, report)
    if options.scene == "curtain":
        _check_targets(fields, report)
    return report


def measure(options: argparse.Namespace, folder: Path, resolution: int, peers: list[Peer]) -> SheetComparison:
    """Search the longest step of each engine on one sheet, then time all engines in turns."""
    scene = SCENES[options.scene]
    print_progress(f"N = {resolution}: reference")
    field = _score(speed_curtain.scored(scene, resolution), resolution)
    whole = attrs.evolve(speed_curtain.scored(scene, resolution), frames=max(round(options.duration / PERIOD), 1))
    with tempfile.TemporaryDirectory() as temporary:
        sheet = Path(temporary, "sheet.npz")
        np.savez(sheet, **peer_jobs.sheet_tables(whole))

        def attempt(peer: Peer, steps: int, share: float = 1.0) -> Attempt:
            return peer_jobs.attempt(
                peer,
                sheet,
                steps,
                environment=folder,
                frames=whole.frames,
                seconds=share * options.seconds,
                whole=options.stretch,
                threads=options.peer_threads,
            )

        longest: dict[Peer, EngineEntry] = {}
        for peer in peers:
            try:
                longest_attempt = _search(peer, resolution, attempt)
            except PeerFailed as error:
                field.failed.append(f"N = {resolution}: {error}")
                continue
            if longest_attempt is None:
                field.failed.append(f"N = {resolution}: {peer.name}: no step kept the sheet whole")
                continue
            longest[peer] = EngineEntry(peer.name, attempts=[longest_attempt])
        for round_index in range(options.repeats):
            print_progress(f"N = {resolution}: round {round_index + 1} of {options.repeats}")
            for one_core, entry in ((False, field.product), (True, field.one_core)):
                run = speed_curtain.run(whole, tolerance=field.tolerance, one_core=one_core)
                entry.factors.append(whole.duration / run.seconds)
            for peer, entry in longest.items():
                repeat = attempt(peer, entry.attempts[0].steps, _ROUND)
                entry.attempts.append(repeat)
                entry.factors.append(repeat.factor)
    field.peers = [*longest.values()]
    return field


def _score(problem: Problem, resolution: int) -> SheetComparison:
    """Choose the loosest accurate tolerance of the product."""
    known = speed_curtain.trusted(problem)
    for tolerance in TOLERANCES:
        error = known.deviation(problem.frames, speed_curtain.run(problem, tolerance=tolerance).positions)
        if error <= speed_curtain.ACCURATE:
            break
    return SheetComparison(
        resolution=resolution,
        tolerance=tolerance,
        error=error,
        scored=problem.duration,
        reference_error=known.error,
        product=EngineEntry("cloth_sim_ros, as shipped"),
        one_core=EngineEntry("cloth_sim_ros, one core"),
    )


def _search(peer: Peer, resolution: int, attempt: Callable[[Peer, int], Attempt]) -> Attempt | None:
    """Run a peer at its longest step that keeps the sheet whole; log each attempt."""
    tried: dict[int, Attempt] = {}

    def is_whole(steps: int) -> bool:
        done = tried[steps] = attempt(peer, steps)
        how = "whole" if done.whole else "torn"
        print_progress(f"N = {resolution}: {peer.name}, {steps} steps a frame: {how} after {done.simulated:.2f} s")
        return done.whole

    steps = peer_jobs.longest_step(is_whole, peer.first_steps(resolution))
    return None if steps is None else tried[steps]


def _throughput(fields: list[SheetComparison]) -> Table:
    table = Table("Simulated seconds per wall second", ["engine", *(f"N = {field.resolution}" for field in fields)])
    by_name: dict[str, dict[int, float]] = {}
    for field in fields:
        for entry in (field.product, field.one_core, *field.peers):
            by_name.setdefault(entry.name, {})[field.resolution] = entry.factor
    table.rows = [[name, *(by.get(field.resolution, "-") for field in fields)] for name, by in by_name.items()]
    return table


def _comparison(fields: list[SheetComparison]) -> Table:
    columns = ["N", "tolerance m", "error m", "at s", "fastest peer", "as fast as it", "on one core"]
    table = Table("Product against the fastest peer", columns)
    for field in fields:
        start = [field.resolution, field.tolerance, field.error, field.scored]
        best = field.fastest
        end: list[str | float] = ["-"] * 3
        if best:
            end = [best.name, field.product.factor / best.factor, field.one_core.factor / best.factor]
        table.rows.append([*start, *end])
    return table


def _details(fields: list[SheetComparison]) -> Table:
    columns = ["N", "engine", "steps a frame", "step s", "largest stretch", "simulated s", "ms a step", "x real time"]
    table = Table("Each peer at its longest step", columns)
    for field in fields:
        for entry in field.peers:
            attempt = entry.attempts[0]
            milliseconds = 1e3 * PERIOD / (attempt.steps * entry.factor)
            stretch = max(attempt.stretch for attempt in entry.attempts)
            row = [field.resolution, entry.name, attempt.steps, PERIOD / attempt.steps, stretch, attempt.simulated]
            table.rows.append([*row, milliseconds, entry.factor])
    return table


def _explain(options: argparse.Namespace, peers: list[Peer], fields: list[SheetComparison], report: Report) -> None:
    versions = {name: text for f in fields for e in f.peers for name, text in e.attempts[0].versions.items()}
    report.environment |= versions
    report.note(
        f"a peer's step is the longest, to about a fifth, at which its sheet stays whole for {options.duration:g} s: "
        f"no edge longer than {options.stretch:g} times its rest length at any frame; peers do not report their error"
    )
    threads = "one thread" if options.peer_threads == 1 else f"up to {options.peer_threads} threads"
    report.note(f"peers have {threads} each; medians of {options.repeats} interleaved rounds")
    report.notes += [f"{peer.name}: {peer.differs}" for peer in peers]
    for field in fields:
        where = f"N = {field.resolution}"
        report.note(f"{where}: the error's reference is within {field.reference_error:.1g} m of the exact solution")
        for entry in field.peers:
            attempt = entry.attempts[0]
            if attempt.simulated < options.duration - PERIOD:
                report.note(
                    f"{where}: {entry.name} reached the limit of {options.seconds:g} s: its sheet was whole for "
                    f"{attempt.simulated:.2f} s and may tear later"
                )
            report.notes += [f"{where}: {entry.name} {remark}" for remark in attempt.remarks]
        report.notes += [f"FAILED: {text}" for text in field.failed]


def _check_targets(fields: list[SheetComparison], report: Report) -> None:
    for field in fields:
        where = f"N = {field.resolution}"
        if field.error > speed_curtain.ACCURATE:
            report.fail(f"{where}: the product is {field.error:.2g} m off; at most {speed_curtain.ACCURATE:g} m")
        best = field.fastest
        if best and field.resolution in RATED_RESOLUTIONS and field.product.factor < MIN_PEER_RATIO * best.factor:
            times = field.product.factor / best.factor
            report.fail(f"{where}: {times:.3g} times as fast as {best.name}; target {MIN_PEER_RATIO:g}")
