# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Twenty cloths whose parameters are known, fitted: `python test/soak_fit.py [--count 20] [--first 0]`.

Each is a square of 0.4 m, 10 x 10 particles, that hung still from two hands and is swung by them for 2 s, as a robot
can do (see support/fit_samples.py for the motion and the ranges of the parameters). Clouds at 30 Hz have 2 mm of noise
in each coordinate and lack a third of the particles. Every fit begins at the middle of the ranges. Each parameter must
come out within 5 % of the truth, or be declared not told because its Cramér-Rao bound is above 2.5 %. Exit status 1 if
one does not, or a fit takes more than ten minutes.
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

from cloth_sim_ros.batch.fit import Fit, fit
from cloth_sim_ros.batch.fit_recording import read_session

#: Largest relative error of what is told, and longest a fit may take [s].
LARGEST, LONGEST = 0.05, 600.0


def fitted(seed: int, strength: float, workers: int | None) -> tuple[dict[str, float], Fit, tuple[float, float]]:
    """The true parameters of a cloth, its fit, and the wall time and the processor time that took [s]."""
    truth = random_truth(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = record_swing(Path(folder), truth, seed=seed, strength=strength)
        begun, used = time.perf_counter(), processor_time()
        found = fit(read_session([path]), list(RANGES), start=START, workers=workers)
    return truth, found, (time.perf_counter() - begun, processor_time() - used)


def processor_time() -> float:
    """Processor time that this process and those it waited for have used [s]."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; its exit status."""
    parser = argparse.ArgumentParser(
        description="Fits of synthetic cloths must find the truth, or say that they can't."
    )
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first cloth")
    parser.add_argument("--strength", type=float, default=1.0, help="of the swing, 1 is the usual one")
    parser.add_argument("--workers", type=int, default=None, help="processes; one a core by default")
    options = parser.parse_args(arguments)
    short = [name.split(".")[1].removesuffix("_modulus") for name in RANGES]
    print(
        "error (bound) in %, * not told"
        + " " * 9
        + "".join(f"{name:>18}" for name in short)
        + "   until     time   processor"
    )
    wrong, slow, covered, told, ratios = 0, 0, 0, 0, []
    longest = 0.0
    for seed in tqdm(range(options.first, options.first + options.count), unit="cloth", disable=None):
        truth, found, (seconds, work) = fitted(seed, options.strength, options.workers)
        cells = []
        for estimate in found.estimates:
            true = truth[estimate.parameter.name]
            error = estimate.value / true - 1.0
            low, high = estimate.interval
            covered += low <= true <= high
            ratios.append(np.log(estimate.value / true) / estimate.bound)
            told += estimate.told
            wrong += estimate.told and abs(error) > LARGEST
            cells.append(f"{100 * error:+8.2f} ({100 * estimate.bound:.2g}){'' if estimate.told else '*'}")
        slow += seconds > LONGEST
        longest = max(longest, seconds)
        row = "".join(f"{cell:>18}" for cell in cells)
        tqdm.write(f"cloth {seed:<4}" + " " * 30 + f"{row} {found.until:6.2f} s {seconds:6.1f} s {work:8.1f} s")
    total = len(RANGES) * options.count
    print(
        f"{options.count} cloths: {told} of {total} parameters told, {wrong} of those off by more than "
        f"{100 * LARGEST:.0f} %; {covered} of {total} 95 % intervals hold the truth; errors over bounds deviate by "
        f"{np.std(ratios):.2f} (1 is right); the longest fit took {longest:.0f} s"
    )
    return 1 if wrong or slow else 0


if __name__ == "__main__":
    sys.exit(main())
