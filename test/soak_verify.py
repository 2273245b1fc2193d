# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random sessions run again, many of them: `python test/soak_verify.py [--sessions 200] [--first 0] [--obstacles]`.

Each is a random scene with random commands, parameter changes, pauses and resets, recorded, split and cut at random,
and must come out the same to the last bit. Exit status 1 if one does not; its number makes it again.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from support.random_sessions import make_random_session
from tqdm import tqdm

from cloth_sim_ros.verify.main import describe
from cloth_sim_ros.verify.run import verify


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; its exit status."""
    parser = argparse.ArgumentParser(description="Random sessions must run again to the last bit.")
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="number of the first session")
    parser.add_argument("--obstacles", action="store_true", help="with obstacles about the cloth")
    options = parser.parse_args(arguments)
    different = frames = clouds = cut = split = 0
    for seed in tqdm(range(options.first, options.first + options.sessions), unit="session", disable=None):
        with tempfile.TemporaryDirectory() as folder:
            paths = make_random_session(Path(folder), seed, obstacles=options.obstacles)
            verdict = verify(paths)
        frames, clouds = frames + verdict.frames, clouds + verdict.clouds
        cut, split = cut + bool(verdict.missing), split + (len(paths) > 1)
        if not verdict.same or verdict.damaged or not verdict.frames:
            different += 1
            print(f"session {seed}: {describe(verdict)}", file=sys.stderr)
    print(
        f"{options.sessions} sessions, {split} of them split and {cut} cut off, {frames} frames and {clouds} clouds: "
        f"{different} sessions differ"
    )
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
