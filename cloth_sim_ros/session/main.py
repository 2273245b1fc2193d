# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `cloth_session`: info, recover, export."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.session.console import escape_unencodable, printable
from cloth_sim_ros.session.errors import SessionError
from cloth_sim_ros.session.plurals import pluralize


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cloth_session`; return 0, 1 if a session is incomplete, 2 on an error, 130 after an interruption."""
    escape_unencodable()
    options = _parser().parse_args(arguments)
    try:
        status: int = options.run(options)
    except SessionError as error:
        print(f"cloth_session: {printable(str(error))}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # The reader of the output (head, less) has closed the pipe.
        sys.stderr.close()
        return 0
    except OSError as error:
        print(f"cloth_session: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("cloth_session: interrupted", file=sys.stderr)
        return 130
    return status


def _parser() -> argparse.ArgumentParser:
    description = "Inspect, repair and export recorded sessions. No ROS needed."
    parser = argparse.ArgumentParser(prog="cloth_session", description=description)
    commands = parser.add_subparsers(required=True, metavar="{info,recover,export}")

    info = commands.add_parser("info", help="summarize sessions", description=_info.__doc__)
    info.add_argument("files", nargs="+", type=Path, metavar="session.mcap", help="sessions, the parts of one in order")
    info.add_argument("--all-parts", action="store_true", help="with one file given, read all files of its session")
    info.add_argument("--json", action="store_true", help="print JSON")
    info.set_defaults(run=_info)

    damage = "repair a session that was cut off or damaged"
    recover = commands.add_parser("recover", help=damage, description=_recover.__doc__)
    recover.add_argument("file", type=Path, metavar="session.mcap")
    output = "default: <name>_recovered.mcap beside it"
    recover.add_argument("-o", "--output", type=Path, metavar="repaired.mcap", help=output)
    recover.set_defaults(run=_recover)

    formats = "particle trajectories as .npz or .parquet"
    export = commands.add_parser("export", help=formats, description=_export.__doc__)
    files = "one file, or the parts of a session"
    export.add_argument("files", nargs="+", type=Path, metavar="session.mcap", help=files)
    export.add_argument("--all-parts", action="store_true", help="with one file given, read all files of its session")
    output = "*.npz or *.parquet; default: <name>.npz beside it"
    export.add_argument("-o", "--output", type=Path, metavar="out.npz", help=output)
    export.add_argument("--every", type=int, default=1, metavar="N", help="export every N-th cloud")
    export.add_argument("--start", type=float, metavar="S", help="from this simulated time on [s]")
    export.add_argument("--end", type=float, metavar="S", help="up to this simulated time [s]")
    export.set_defaults(run=_export)
    return parser


def _files(options: argparse.Namespace) -> tuple[list[Path], bool]:
    """Return the files to read, and True if files of a split session are missing among them, as then printed."""
    from cloth_sim_ros.session.reader import absent_files, session_files

    files: list[Path] = options.files
    is_whole = options.all_parts and len(files) == 1
    if is_whole:
        files = session_files(files[0])
    absent = absent_files(files, whole=is_whole)
    for sentence in absent:
        print(f"cloth_session: {printable(sentence)}", file=sys.stderr)
    return files, bool(absent)


def _info(options: argparse.Namespace) -> int:
    """Read sessions to their end, check every checksum, and summarize. Status 1 if a session is incomplete."""
    from cloth_sim_ros.session.reader import by_session

    paths, lacks_files = _files(options)
    reports, missing = [], [lacks_files]
    for files in by_session(paths):
        report, is_incomplete = _summary(files, as_json=options.json)
        reports.append(report)
        missing.append(is_incomplete)
    if options.json:
        print(json.dumps(reports[0] if len(reports) == 1 else reports, indent=2))
    else:
        print("\n\n".join(map(str, reports)))
    return 1 if any(missing) else 0


def _summary(files: list[Path], *, as_json: bool) -> tuple[object, bool]:
    """Read a session to its end; return its summary (text, or a dict if `as_json`), and True if it is incomplete."""
    from tqdm import tqdm

    from cloth_sim_ros.session.info import Summarizer, render, to_json
    from cloth_sim_ros.session.reader import SessionReader

    with SessionReader(files) as reader:
        total = sum(part.size() for part in reader.parts)
        summarizer = Summarizer(reader.node)
        with tqdm(total=total, unit="B", unit_scale=True, desc="reading", delay=1.0, leave=False) as bar:
            for message in reader.messages():
                summarizer.add(message)
                bar.update(sum(part.position for part in reader.parts) - bar.n)
        report = to_json(reader, summarizer.summary) if as_json else render(reader, summarizer.summary)
        return report, reader.missing is not None


def _recover(options: argparse.Namespace) -> int:
    """Copy all intact chunks into a new, finished file. The old file does not change."""
    from tqdm import tqdm

    from cloth_sim_ros.session.recover import recover

    with tqdm(unit="B", unit_scale=True, desc="copying", delay=1.0, leave=False) as bar:

        def update_bar(position: int, size: int) -> None:
            bar.total = size
            bar.update(position - bar.n)

        recovery = recover(options.file, options.output, on_progress=update_bar)
    size = f"{pluralize(recovery.messages, 'message')}, {recovery.bytes_written / 1e6:,.1f} MB"
    print(f"{recovery.path}: {size}\nwhat was missing stays missing: {printable(recovery.missing)}")
    return 0


def _export(options: argparse.Namespace) -> int:
    """Write the positions of all particles over time."""
    from tqdm import tqdm

    from cloth_sim_ros.session.export import export
    from cloth_sim_ros.session.reader import SessionReader

    files, _ = _files(options)
    output = options.output or files[0].with_suffix(".npz")
    with SessionReader(files) as reader, tqdm(unit=" clouds", desc="reading", delay=1.0, leave=False) as bar:
        count = export(
            reader,
            output,
            every=options.every,
            start=options.start,
            end=options.end,
            on_progress=lambda: _advance_bar(bar),
        )
        if reader.missing is not None:
            print(f"cloth_session: {printable(reader.missing)}", file=sys.stderr)
    print(f"{output}: {pluralize(count, 'frame')}, {output.stat().st_size / 1e6:,.1f} MB")
    return 0


def _advance_bar(bar: object) -> None:
    bar.update()  # type: ignore[attr-defined]


if __name__ == "__main__":
    sys.exit(main())
