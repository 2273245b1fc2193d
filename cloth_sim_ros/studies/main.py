# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_batch`: runs, checks, shows and exports studies."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.session.command_runner import exit_on_signal
from cloth_sim_ros.session.console import escape_unencodable
from cloth_sim_ros.studies.errors import StoppedError, StudyError

#: Exit statuses: every run was successful; a run failed, or the study stopped; bad input; interrupted.
SUCCESS, INCOMPLETE, REFUSED, INTERRUPTED = 0, 1, 2, 130
_COMMANDS = ("check", "view", "export")
#: Default rows of a table, and default description of a dataset's task.
_TABLE_ROWS, _TASK = 20, "move the cloth"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cloth_batch` (run, check, view, export); return 0, 1 after a failed run, 2 for bad input, or 130."""
    escape_unencodable()
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words[0] if words and words[0] in _COMMANDS else "run"
    parser = {"run": _run_parser, "check": _check_parser, "view": _view_parser, "export": _export_parser}[name]()
    options = parser.parse_args(words if name == "run" else words[1:])
    try:
        _check_libraries()
        with exit_on_signal("cloth_batch"):
            # An interrupt during the import of numpy becomes an ImportError.
            importlib.import_module("numpy")
        status: int = options.run(options)
    except StudyError as error:
        print(f"cloth_batch: {error}", file=sys.stderr)
        return REFUSED
    except StoppedError as error:
        print(f"cloth_batch: {error}", file=sys.stderr)
        return INCOMPLETE
    except BrokenPipeError:
        # The reader of the output (head, less) has closed the pipe.
        sys.stderr.close()
        return SUCCESS
    except OSError as error:
        print(f"cloth_batch: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return REFUSED
    except KeyboardInterrupt:
        remedy = "; finished runs are kept; continue with --resume" if name == "run" else ""
        print(f"cloth_batch: interrupted{remedy}", file=sys.stderr)
        return INTERRUPTED
    return status


def _check_libraries() -> None:
    for library in ("distributed", "cryptography", "pyarrow", "mcap", "rosbags", "lz4"):
        if importlib.util.find_spec(library) is None:
            raise StudyError(f"studies need {library}, which is not installed: pip install 'cloth_sim_ros[batch]'")


def _run_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cloth_batch",
        description="Runs a study: many simulations of one scene, on all cores or on a Dask cluster. Each run is "
        "recorded as a session. Exit status 0: every run was successful; 1: a run failed, or the study stopped; "
        "2: the study was refused before the first run.",
        epilog="also: cloth_batch check study.yaml, cloth_batch view FOLDER, cloth_batch export FOLDER",
    )
    parser.add_argument("study", type=Path, metavar="study.yaml", help="the study; see docs/studies.md")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="folder of the results")
    parser.add_argument("--resume", action="store_true", help="continue an interrupted study")
    parser.add_argument("--retry-failed", action="store_true", help="with --resume: repeat failed runs")
    destination = parser.add_mutually_exclusive_group()
    cluster = "a running Dask cluster, instead of this machine"
    destination.add_argument("--scheduler", metavar="tcp://HOST:PORT", help=cluster)
    workers = "local worker processes (default: one per core)"
    destination.add_argument("--workers", type=_positive, metavar="N", help=workers)
    wait = "time limit for a lost scheduler to return (default: %(default)g)"
    parser.add_argument("--wait", type=_seconds, default=300.0, metavar="SECONDS", help=wait)
    parser.set_defaults(run=_run)
    return parser


def _check_parser() -> argparse.ArgumentParser:
    description = "Checks a study and estimates its cost; runs nothing."
    parser = argparse.ArgumentParser(prog="cloth_batch check", description=description)
    parser.add_argument("study", type=Path, metavar="study.yaml")
    parser.set_defaults(run=_check)
    return parser


def _view_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cloth_batch view", description="Shows the results of a study.")
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--outcome", metavar="NAME", help="outcome of the plot, and order of the table")
    parser.add_argument("--over", metavar="NAME", help="factor on the plot's x axis")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="plot the outcome over the factor")
    parser.add_argument("--rows", type=_positive, metavar="N", help=f"rows of the table (default: {_TABLE_ROWS})")
    parser.add_argument("--run", type=int, dest="number", metavar="K", help="open one run in Rerun")
    parser.add_argument("--save", type=Path, metavar="OUT.rrd", help="with --run: write the recording instead")
    parser.set_defaults(run=_view)
    return parser


def _export_parser() -> argparse.ArgumentParser:
    description = "Writes the successful runs as a dataset for learning."
    parser = argparse.ArgumentParser(prog="cloth_batch export", description=description)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument("--zarr", type=Path, metavar="OUT.zarr", help="zarr v3: one chunk per run, float32")
    kind.add_argument("--lerobot", type=Path, metavar="OUT", help="LeRobotDataset v3.0: one episode per run")
    kind.add_argument("--mcap", type=Path, metavar="OUT", help="sessions with clouds, also if the study omitted them")
    parser.add_argument("--video", action="store_true", help="with --lerobot: also render each run (slow)")
    parser.add_argument("--task", help=f"with --lerobot: description of the task (default: {_TASK})")
    parser.set_defaults(run=_export)
    return parser


def _run(options: argparse.Namespace) -> int:
    """Run the study that the options name; return the exit status."""
    from cloth_sim_ros.studies.study_session import run_study

    if options.retry_failed and not options.resume:
        raise StudyError("--retry-failed continues a study: it needs --resume")
    return run_study(
        options.study,
        options.out,
        resume=options.resume,
        retry_failed=options.retry_failed,
        scheduler=options.scheduler,
        workers=options.workers,
        wait=options.wait,
    )


def _check(options: argparse.Namespace) -> int:
    """Check a study, and print its size and estimated cost; return exit status 0."""
    from cloth_sim_ros.studies import study_file
    from cloth_sim_ros.studies.cluster import core_count
    from cloth_sim_ros.studies.study_estimate import sample_and_estimate

    study = study_file.read(options.study)
    _, estimate = sample_and_estimate(study, core_count())
    print(f"{study.runs} runs of {study.duration:g} s, {estimate.n_frames} frames, {study.sampling}, seed {study.seed}")
    for factor in study.factors:
        print(f"  {factor.name}: {factor.kind} {', '.join(map(str, factor.values[:8]))}")
    print(f"they take {estimate.describe(study.runs, core_count())}")
    return SUCCESS


def _view(options: argparse.Namespace) -> int:
    """Show the results of a study as the options demand; return the exit status."""
    from cloth_sim_ros.session.output_files import OutputError, check_outputs
    from cloth_sim_ros.studies.folder import StudyFolder
    from cloth_sim_ros.studies.view import view

    if options.plot is not None and not (options.outcome and options.over):
        raise StudyError("--plot draws an outcome over a factor: it needs --outcome and --over")
    if options.save is not None and options.number is None:
        raise StudyError("--save writes one run: it needs --run")
    opens_run, of_table = options.number is not None, ("outcome", "over", "plot", "rows")
    unused = [f"--{name}" for name in of_table if opens_run and getattr(options, name) is not None]
    unused += ["--rows"] if options.plot is not None and options.rows is not None else []
    if unused:
        shown = "--run opens one run" if opens_run else "--plot draws every run"
        raise StudyError(f"{shown}: it takes no {unused[0]}")
    try:
        check_outputs({"--plot": options.plot, "--save": options.save}, StudyFolder(options.folder).study_files())
    except OutputError as error:
        raise StudyError(str(error)) from error
    return view(
        options.folder,
        outcome=options.outcome,
        over=options.over,
        plot=options.plot,
        rows=options.rows or _TABLE_ROWS,
        run=options.number,
        save=options.save,
    )


def _export(options: argparse.Namespace) -> int:
    """Export a study in the format that the options name; return the exit status."""
    from cloth_sim_ros.studies import datasets

    if options.video and options.lerobot is None:
        raise StudyError("--video goes into a LeRobot dataset: it needs --lerobot")
    if options.task is not None and options.lerobot is None:
        raise StudyError("--task describes a LeRobot dataset: it needs --lerobot")
    if options.zarr is not None:
        return datasets.to_zarr(options.folder, options.zarr)
    if options.mcap is not None:
        return datasets.to_mcap(options.folder, options.mcap)
    return datasets.to_lerobot(
        options.folder, options.lerobot, task=_TASK if options.task is None else options.task, video=options.video
    )


def _positive(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is below 1")
    return value


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of seconds") from None
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{value} s is no waiting time; give 0 or more")
    return value


if __name__ == "__main__":
    sys.exit(main())
