# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Command `cloth_replay`: replay in the Rerun viewer, as .rrd or as a picture."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.replay.rows import MAX_TIME
from cloth_sim_ros.replay.viewer import ViewerError
from cloth_sim_ros.session.command_runner import INTERRUPTED, exit_on_signal
from cloth_sim_ros.session.console import escape_unencodable, printable
from cloth_sim_ros.session.errors import SessionError

#: Exit statuses: success; a missing requirement of this machine; a wrong session or command line.
DONE, UNAVAILABLE, INVALID = 0, 1, 2

_MAX_PIXELS = 8192
#: Default size of a picture [pixels].
_SIZE = (1600, 900)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cloth_replay`: show a session, or save a recording or a picture; return 0, 1 (machine), 2 (session), 130."""
    escape_unencodable()
    parser = _parser()
    options = parser.parse_args(arguments)
    _check(parser, options)
    if importlib.util.find_spec("rerun") is None:
        print("cloth_replay needs the Rerun viewer: pip install 'cloth_sim_ros[replay]'", file=sys.stderr)
        return UNAVAILABLE
    # Rerun starts threads early in its import, and last registers the exit handler that stops them. An exit between
    # these would race with the threads.
    with exit_on_signal("cloth_replay"):
        import rerun  # noqa: F401

        from cloth_sim_ros.replay import show
    from cloth_sim_ros.session.output_files import check_outputs

    try:
        outputs = {"--save": options.save, "--screenshot": options.screenshot}
        check_outputs(outputs, options.session, endings={"--screenshot": ".png"})
        if options.screenshot is not None:
            show.save_picture(
                options.session,
                options.screenshot,
                at=options.at,
                size=options.size or _SIZE,
                strain_limit=options.strain_limit,
                accuracy=options.accuracy,
            )
        elif options.save is not None:
            show.save_recording(
                options.session,
                options.save,
                every=options.every,
                strain_limit=options.strain_limit,
                follow=options.follow,
                accuracy=options.accuracy,
            )
        else:
            show.open_viewer(
                options.session,
                every=options.every,
                strain_limit=options.strain_limit,
                follow=options.follow,
                accuracy=options.accuracy,
            )
    except SessionError as error:
        print(f"cloth_replay: {printable(str(error))}", file=sys.stderr)
        return INVALID
    except ViewerError as error:
        print(f"cloth_replay: {error}", file=sys.stderr)
        return UNAVAILABLE
    except OSError as error:
        print(f"cloth_replay: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
        return UNAVAILABLE
    except KeyboardInterrupt:
        print("cloth_replay: interrupted", file=sys.stderr)
        return INTERRUPTED
    return DONE


def _parser() -> argparse.ArgumentParser:
    description = "Show a recorded cloth session in the Rerun viewer, or save it as a Rerun recording or a picture."
    parser = argparse.ArgumentParser(prog="cloth_replay", description=description)
    parser.add_argument("session", nargs="+", type=Path, help="session.mcap; all files of a split session, in order")
    output = parser.add_mutually_exclusive_group()
    output.add_argument("--save", metavar="OUT.rrd", type=Path, help="write a Rerun recording instead of showing it")
    screenshot = "save a picture; needs neither a screen nor a GPU"
    output.add_argument("--screenshot", metavar="OUT.png", type=Path, help=screenshot)
    parser.add_argument("--at", metavar="SECONDS", type=float, help="simulated time of the picture; default: the end")
    size = "size of the picture; default: 1600x900"
    parser.add_argument("--size", metavar="WxH", type=_size, help=size)
    parser.add_argument("--every", metavar="N", type=int, default=1, help="show every Nth cloud; default: all")
    strain = "strain of the last colour, instead of an ensemble's deviation; default: from the session"
    parser.add_argument("--strain-limit", metavar="PERCENT", type=float, help=strain)
    accuracy = "measure the error like cloth_verify --accuracy; colour the cloth by it, and plot it"
    parser.add_argument("--accuracy", action="store_true", help=accuracy)
    follow = "follow a session that is being recorded, until the recording ends"
    parser.add_argument("--follow", action="store_true", help=follow)
    return parser


def _check(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    if options.every < 1:
        parser.error(f"--every {options.every}: it must be at least 1")
    if options.strain_limit is not None:
        if not 0.0 < options.strain_limit <= 1e4:
            parser.error(f"--strain-limit {options.strain_limit:g}: it must be within (0, 10000] per cent")
        options.strain_limit /= 100.0
    if options.accuracy and options.follow:
        parser.error("--accuracy needs the whole session: it cannot be combined with --follow")
    if options.screenshot is not None and (options.follow or options.every != 1):
        parser.error("--screenshot shows one moment: it takes --at, not --follow or --every")
    if options.accuracy and options.strain_limit is not None:
        parser.error("--accuracy colours the cloth by error: it cannot be combined with --strain-limit")
    if options.size is not None and options.screenshot is None:
        parser.error("--size is the size of a picture: it needs --screenshot")
    if options.at is not None and options.screenshot is None:
        parser.error("--at is the time of a picture: it needs --screenshot")
    if options.at is not None and not abs(options.at) <= MAX_TIME:
        parser.error(f"--at {options.at:g}: it must be a number of seconds, at most {MAX_TIME:g}")


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"'{text}' is not a size; write it as 1600x900")
    if not all(200 <= int(length) <= _MAX_PIXELS for length in (width, height)):
        raise argparse.ArgumentTypeError(f"'{text}': either side must be within 200 and {_MAX_PIXELS}")
    return int(width), int(height)


if __name__ == "__main__":
    sys.exit(main())
