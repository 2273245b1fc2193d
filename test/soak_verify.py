# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random sessions run again, many of them: `python test/soak_verify.py [--sessions 200] [--first 0] [--contact]`.

Each is a random scene with random commands, parameter changes, pauses and resets, recorded, split and cut at random,
and must come out the same to the last bit. Exit status 1 if one does not; its number makes it again.
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

#: Sessions with contact are run again by so many threads.
THREADS = (1, 2, 8)


def run_again(paths: list[Path], count: int | None) -> Verdict:
    """Run a session again, by so many threads or as many as the plan chooses."""
    with nullcontext() if count is None else threads(count):
        return verify(paths)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; its exit status."""
    parser = argparse.ArgumentParser(description="Random sessions must run again to the last bit.")
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first session")
    parser.add_argument("--obstacles", action="store_true", help="with obstacles about the cloth")
    parser.add_argument(
        "--contact", action="store_true", help="with contact of every kind, and run again by 1, 2 and 8 threads"
    )
    options = parser.parse_args(arguments)
    different = frames = clouds = cut = split = 0
    coverage = Coverage()
    for seed in tqdm(range(options.first, options.first + options.sessions), unit="session", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            asked = {
                "obstacles": options.obstacles,
                "contact": options.contact,
                "hinges": seed % 2 == 1,
                "frames": 30 if options.contact else 60,
            }
            paths = make_random_session(Path(folder), seed, **asked, watch=coverage)
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
