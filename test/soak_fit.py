# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Fits of synthetic cloths with known parameters: `python test/soak_fit.py [--count 20] [--first 0]`.

Each cloth is a square of 0.4 m with 10 x 10 particles, hung at rest from two hands that swing it for 2 s. Motion and
parameter ranges are in support/fit_samples.py. Clouds at 30 Hz have 2 mm of noise in each coordinate and lack a third
of the particles. Every fit begins at the middle of the ranges. Each parameter must be within 5 % of the truth, or not
identified because its Cramér-Rao bound is above 2.5 %. Exit status 1 if a parameter fails, or a fit takes more than ten
minutes.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from support.fit_samples import RANGES, START, random_truth, record_swing
from tqdm import tqdm

from cloth_sim_ros.fit.fit import Fit, fit
from cloth_sim_ros.fit.recording import read_session

#: Maximum relative error of an identified parameter, and maximum time of a fit [s].
LARGEST, LONGEST = 0.05, 600.0


def fitted(seed: int, strength: float, workers: int | None) -> tuple[dict[str, float], Fit, tuple[float, float]]:
    """Return the true parameters of a cloth, its fit, and the wall time and processor time of the fit [s]."""
    truth = random_truth(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = record_swing(Path(folder), truth, seed=seed, strength=strength)
        begun, used = time.perf_counter(), processor_time()
        result = fit(read_session([path]), list(RANGES), start=START, workers=workers)
    return truth, result, (time.perf_counter() - begun, processor_time() - used)


def processor_time() -> float:
    """Return the processor time of this process and its finished children [s]."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(description="Fit synthetic cloths with known parameters.")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="index of the first cloth")
    parser.add_argument("--strength", type=float, default=1.0, help="strength of the swing; 1 is the usual one")
    parser.add_argument("--workers", type=int, default=None, help="number of processes; by default one per core")
    options = parser.parse_args(arguments)
    short = [name.split(".")[1].removesuffix("_modulus") for name in RANGES]
    print(
        "error (bound) in %, * not told"
        + " " * 9
        + "".join(f"{name:>18}" for name in short)
        + "   until     time   processor"
    )
    wrong, slow, covered, n_identified, ratios = 0, 0, 0, 0, []
    longest = 0.0
    for seed in tqdm(range(options.first, options.first + options.count), unit="cloth", disable=None):
        truth, result, (seconds, work) = fitted(seed, options.strength, options.workers)
        cells = []
        for estimate in result.estimates:
            true = truth[estimate.parameter.name]
            error = estimate.value / true - 1.0
            low, high = estimate.interval
            covered += low <= true <= high
            ratios.append(np.log(estimate.value / true) / estimate.bound)
            n_identified += estimate.is_identified
            wrong += estimate.is_identified and abs(error) > LARGEST
            cells.append(f"{100 * error:+8.2f} ({100 * estimate.bound:.2g}){'' if estimate.is_identified else '*'}")
        slow += seconds > LONGEST
        longest = max(longest, seconds)
        row = "".join(f"{cell:>18}" for cell in cells)
        tqdm.write(f"cloth {seed:<4}" + " " * 30 + f"{row} {result.end_time:6.2f} s {seconds:6.1f} s {work:8.1f} s")
    total = len(RANGES) * options.count
    print(
        f"{options.count} cloths: {n_identified} of {total} parameters told, {wrong} of those off by more than "
        f"{100 * LARGEST:.0f} %; {covered} of {total} 95 % intervals hold the truth; errors over bounds deviate by "
        f"{np.std(ratios):.2f} (1 is right); the longest fit took {longest:.0f} s"
    )
    return 1 if wrong or slow else 0


if __name__ == "__main__":
    sys.exit(main())
