# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `cloth_verify`: re-run and comparison of recorded sessions and bags.

With `--accuracy` it also measures their accuracy.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cloth_sim_ros.session.bag import is_bag
from cloth_sim_ros.session.console import escape_unencodable, printable
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.output_files import OutputError, atomic_write, check_outputs
from cloth_sim_ros.session.plurals import pluralize
from cloth_sim_ros.session.reader import SessionReader, absent_files, by_session

if TYPE_CHECKING:
    from cloth_sim_ros.verify.certificate import Certificate
    from cloth_sim_ros.verify.run import Verdict

#: Exit status: the re-run equals the recording to the last bit.
SAME = 0
#: Exit status: something differs.
DIFFERENT = 1
#: Exit status: a file could not be read, or lacks frames.
UNREADABLE = 2
#: Exit status: recorded by a version with other arithmetic; rounding explains all differences.
OTHER_ARITHMETIC = 3
#: Exit status with `--accuracy`: equal bits, but an unflagged window violates its error bound, or may do so.
BOUND_VIOLATED = 4
#: Maximum number of frames without an independent solution that are listed.
_MAX_UNSOLVED = 5
#: In ascending order; the most severe status of several sessions counts.
_SEVERITY = (SAME, OTHER_ARITHMETIC, BOUND_VIOLATED, DIFFERENT, UNREADABLE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cloth_verify`: verify sessions and bags, print verdicts; return 0 if all are the same, 1 to 4, or 130."""
    escape_unencodable()
    parser = argparse.ArgumentParser(
        prog="cloth_verify",
        description="Run recorded sessions and bags again from their snapshots and events, and compare every message. "
        "Exit status 0: the same to the last bit; 1: something differs; 2: a file cannot be read, or holds no frames; "
        "3: recorded with other arithmetic, and nothing differs that this does not explain; "
        "4: with --accuracy, a window without flagged frames violates its error bound, or may do so.",
    )
    files = (
        "session.mcap, one or more, files of a split session together, in order; or the folder or file of a bag of "
        "ros2 bag record that holds ~/frame and ~/snapshot"
    )
    parser.add_argument("session", nargs="+", type=Path, help=files)
    _add_accuracy(parser)
    options = parser.parse_args(arguments)
    _check_accuracy(parser, options)
    sessions = list(by_session(options.session))
    _check_one_session(parser, options, len(sessions))
    status = SAME
    try:
        for gap in absent_files(options.session, whole=False):
            print(f"cloth_verify: {printable(gap)}", file=sys.stderr)
            status = UNREADABLE
        for paths in sessions:
            certificate = None
            try:
                if is_bag(paths[0]):
                    verdicts = _verify_bag(paths[0], options)
                elif options.accuracy:
                    verdict, certificate = _certify(paths, options)
                    verdicts = [verdict]
                else:
                    verdicts = [_verify(paths)]
            except SessionError as error:
                print(f"cloth_verify: {printable(str(error))}", file=sys.stderr)
                status = UNREADABLE
                continue
            for verdict in verdicts:
                print(printable(describe(verdict), keep="\n"), flush=True)
                status = max(status, status_of(verdict), key=_SEVERITY.index)
                if certificate is not None:
                    status = max(status, SAME if certificate.is_satisfied else BOUND_VIOLATED, key=_SEVERITY.index)
                    _write_certificate(certificate, verdict, options)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader of the output (head, less) has closed the pipe.
        sys.stderr.close()
        return status
    except OSError as error:
        print(f"cloth_verify: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return UNREADABLE
    return status


def _add_accuracy(parser: argparse.ArgumentParser) -> None:
    accuracy = parser.add_argument_group("accuracy")
    reference = "compare with a reference solution of much smaller steps: error of each frame, verdict on the tolerance"
    accuracy.add_argument("--accuracy", action="store_true", help=reference)
    accuracy.add_argument("--json", metavar="OUT.json", type=Path, help="write every frame's numbers")
    accuracy.add_argument("--plot", metavar="OUT.png", type=Path, help="plot them over time; needs matplotlib")
    particles = "write each particle's error [m], float32, frame after frame"
    accuracy.add_argument("--particles", metavar="OUT.f32", type=Path, help=particles)


def _outputs(options: argparse.Namespace) -> dict[str, Path]:
    """Return the paths of the requested output files, by option."""
    paths = {f"--{name}": getattr(options, name) for name in ("json", "plot", "particles")}
    return {option: path for option, path in paths.items() if path is not None}


def _check_accuracy(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Exit by `parser.error` if options of the accuracy are invalid, before any work.

    The measurement itself may take hours.
    """
    outputs = _outputs(options)
    if outputs and not options.accuracy:
        parser.error(f"{next(iter(outputs))} needs --accuracy")
    try:
        check_outputs(outputs, options.session, endings={"--plot": ".png"})
    except OutputError as error:
        parser.error(str(error))
    if options.plot is not None and importlib.util.find_spec("matplotlib") is None:
        parser.error("--plot needs matplotlib: pip install 'cloth_sim_ros[bench]'")


def _check_one_session(parser: argparse.ArgumentParser, options: argparse.Namespace, sessions: int) -> None:
    outputs = _outputs(options)
    if outputs and sessions > 1:
        parser.error(f"{next(iter(outputs))} takes the accuracy of one session; {sessions} are given")


def status_of(verdict: Verdict) -> int:
    """Return the exit status for a verdict: SAME, DIFFERENT, OTHER_ARITHMETIC or UNREADABLE."""
    if verdict.damaged or not verdict.frames:
        return UNREADABLE
    if verdict.same:
        return SAME
    return OTHER_ARITHMETIC if verdict.other_arithmetic and not verdict.unexplained else DIFFERENT


def describe(verdict: Verdict) -> str:
    """Return a verdict as sentences for the terminal: the outcome first, then its qualifications."""
    prefix = f"{verdict.name}: "
    speed = f"{verdict.simulated:.1f} s run in {verdict.seconds:.1f} s"
    counts = f"{pluralize(verdict.frames, 'frame')} and {pluralize(verdict.clouds, 'cloud')}"
    if not verdict.frames:
        sentences = ["it holds no frames: there is nothing to compare."]
    elif verdict.same:
        if not verdict.clouds:
            counts = pluralize(verdict.frames, "frame")
        sentences = [f"{counts} came out the same to the last bit{_format_other_kinds(verdict)} ({speed})."]
    else:
        verb = "differs" if verdict.different == 1 else "differ"
        sentences = [
            f"it differs from frame {verdict.first_frame} ({verdict.first_time:.3f} s) on, in {verdict.first_reason}.",
            f"Of {counts}, {pluralize(verdict.different, 'frame')} {verb}; "
            f"the largest deviation of a particle is {verdict.largest_deviation:.3g} m ({speed}).",
            f"What differs: {', '.join(format_counts(verdict.differing))}.",
        ]
    if verdict.other_arithmetic and not verdict.same:
        cause = "whose arithmetic this version's engine does not repeat to the last bit"
        sentences.append(f"It was recorded by {verdict.other_arithmetic}, {cause}; that is no damage.")
        if verdict.unexplained:
            sentences.append(f"But arithmetic does not explain {verdict.unexplained}.")
    if verdict.environment:
        changed = "; ".join(verdict.environment)
        caveat = "" if verdict.same else ", where equal bits are not promised"
        sentences.append(f"Here is not what it was recorded with{caveat}: {changed}.")
    if verdict.absent:
        sentences.append(f"No message is there of {', '.join(verdict.absent)}{_note_missing_clouds(verdict)}.")
    if verdict.not_compared:
        sentences.append(f"Not compared: {'; '.join(format_omissions(verdict))}.")
    if verdict.missing:
        sentences.append(f"Not all of it is there: {'; '.join(verdict.missing)}.")
    return prefix + " ".join(sentences)


def format_counts(counts: Mapping[str, int]) -> list[str]:
    """Return a phrase such as "3 clouds" for each kind with a count above 0, sorted by kind."""
    plurals = {"wrench": "wrenches", "topology": "topologies"}
    present = [(count, kind) for kind, count in sorted(counts.items()) if count]
    return [f"{n} {plurals[kind]}" if kind in plurals and n != 1 else pluralize(n, kind) for n, kind in present]


def format_omissions(verdict: Verdict) -> list[str]:
    """Return a phrase for each topic with messages that were not compared: counts and reasons."""
    reasons_by_topic: dict[str, dict[int, list[str]]] = {}
    for (topic, reason), count in sorted(verdict.not_compared.items()):
        reasons_by_topic.setdefault(topic, {}).setdefault(count, []).append(reason)
    lines = []
    for topic, counts in reasons_by_topic.items():
        text = "; ".join(f"{count} x {', '.join(reasons)}" for count, reasons in counts.items())
        lines.append(f"{topic} ({text})")
    return lines


def _format_other_kinds(verdict: Verdict) -> str:
    """Format the numbers of compared messages other than clouds, as the end of a sentence."""
    counts = format_counts({kind: count for kind, count in verdict.compared.items() if kind != "cloud"})
    return f", and so did {', '.join(counts)}" if counts else ""


def _note_missing_clouds(verdict: Verdict) -> str:
    clouds = any(topic.endswith("/points") for topic in verdict.absent)
    return ": of the positions, the digests of the frames alone were compared" if clouds else ""


def _verify(paths: Sequence[Path]) -> Verdict:
    from tqdm import tqdm

    from cloth_sim_ros.verify.run import verify

    total = sum(path.stat().st_size for path in paths if path.is_file())
    with tqdm(total=total, unit="B", unit_scale=True, desc="verify", delay=1.0, disable=None, leave=False) as bar:
        return verify(paths, on_progress=lambda read: bar.update(max(read - bar.n, 0)))


def _verify_bag(path: Path, options: argparse.Namespace) -> list[Verdict]:
    from tqdm import tqdm

    from cloth_sim_ros.verify.bag import verify_bag

    if options.accuracy:
        raise SessionError(f"{path} is a bag; --accuracy takes a session, which the node records with record.enabled")
    with tqdm(unit="frame", desc="verify", delay=1.0, disable=None, leave=False) as bar:
        verdicts = verify_bag(path, on_frame=bar.update)
    if not verdicts:
        raise SessionError(
            f"{path} is a bag without frames of a cloth; start the node with record.topics: true, so that it publishes "
            "~/frame and ~/snapshot, and record both"
        )
    return verdicts


def _certify(paths: Sequence[Path], options: argparse.Namespace) -> tuple[Verdict, Certificate]:
    from tqdm import tqdm

    from cloth_sim_ros.verify.accuracy import certify

    with contextlib.ExitStack() as stack:
        particles = None
        if options.particles is not None:
            output = stack.enter_context(atomic_write(options.particles))
            particles = stack.enter_context(output.open("wb"))
        total = _frames_in(paths)
        bar = tqdm(total=total, unit="frame", desc="accuracy", delay=1.0, disable=None, leave=False)
        stack.enter_context(bar)
        return certify(paths, particles=particles, on_frame=bar.update)


def _write_certificate(certificate: Certificate, verdict: Verdict, options: argparse.Namespace) -> None:
    from cloth_sim_ros.verify.certificate_files import write_json, write_plot
    from cloth_sim_ros.verify.certificate_text import describe_accuracy

    print(printable(describe_accuracy(certificate), keep="\n"), flush=True)
    for sample in certificate.unsolved_samples[:_MAX_UNSOLVED]:
        print(f"cloth_verify: {certificate.name}: frame {sample.frame}: {sample.reason}", file=sys.stderr)
    if options.json is not None:
        write_json(certificate, options.json, verdict)
    if options.plot is not None:
        write_plot(certificate, options.plot)


def _frames_in(paths: Sequence[Path]) -> int | None:
    """Return a session's number of frames by the indexes of its files; None if a file has none. Raises SessionError."""
    count = 0
    with SessionReader(list(paths)) as reader:
        for part in reader.parts:
            if part.summary is None or part.summary.statistics is None:
                return None
            counts = part.summary.statistics.channel_message_counts
            for channel_id, channel in part.summary.channels.items():
                if channel.topic == f"{reader.node}/frame":
                    count += counts.get(channel_id, 0)
    return count


if __name__ == "__main__":
    sys.exit(main())
