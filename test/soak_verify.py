# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Re-run of many random sessions: `python test/soak_verify.py [--sessions 200] [--first 0] [--contact]`.

Each session has a random scene with random commands, parameter changes, pauses and resets, and is split and cut at
random. The re-run must be equal to the last bit. Exit status 1 if one differs; its index reproduces it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from support.random_contact import Coverage, threads
from support.random_sessions import make_random_session
from tqdm import tqdm

from cloth_sim_ros.verify.main import describe
from cloth_sim_ros.verify.run import Verdict, verify

#: Numbers of threads for sessions with contact.
THREADS = (1, 2, 8)


def run_again(paths: list[Path], count: int | None) -> Verdict:
    """Run a session again with a number of threads; None lets the plan choose."""
    with nullcontext() if count is None else threads(count):
        return verify(paths)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description="Check that random sessions rerun to the last bit.")
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="index of the first session")
    parser.add_argument("--obstacles", action="store_true", help="with obstacles around the cloth")
    parser.add_argument(
        "--contact", action="store_true", help="with all kinds of contact, and re-run with 1, 2 and 8 threads"
    )
    options = parser.parse_args(arguments)
    different = frames = clouds = cut = split = 0
    coverage = Coverage()
    for seed in tqdm(range(options.first, options.first + options.sessions), unit="session", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            options_of_session = {
                "obstacles": options.obstacles,
                "contact": options.contact,
                "hinges": seed % 2 == 1,
                "frames": 30 if options.contact else 60,
            }
            paths = make_random_session(Path(folder), seed, **options_of_session, watch=coverage)
            coverage.close()
            verdicts = [run_again(paths, count) for count in (THREADS if options.contact else (None,))]
        verdict = verdicts[0]
        frames, clouds = frames + verdict.frames, clouds + verdict.clouds
        cut, split = cut + bool(verdict.missing), split + (len(paths) > 1)
        wrong = [verdict for verdict in verdicts if not verdict.same or verdict.damaged or not verdict.frames]
        if wrong:
            different += 1
            print(f"session {seed}: {describe(wrong[0])}", file=sys.stderr)
    print(
        f"{options.sessions} sessions, {split} of them split and {cut} cut off, {frames} frames and {clouds} clouds: "
        f"{different} sessions differ"
    )
    if coverage.sessions:
        print(f"sessions in which the cloth met what: {coverage}")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
