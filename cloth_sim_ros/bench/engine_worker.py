# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Measures the package of one tree, in a Python of its own: a script that loads whatever `cloth_sim_ros` is there.

Reads requests from its input and answers each on its output, one line of JSON each: `{"measure": JOB, ...}` with the
job's options is answered by the job's figures, `seconds` first, or by `{"error": why}`. A job is made ready when it is
first asked for, which is not timed; `{"forget": true}` frees all that were.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any


def answer(request: dict[str, Any], jobs: Any, ready: dict[str, Any]) -> dict[str, Any]:
    """Do what a request asks for."""
    if request.pop("forget", False):
        ready.clear()
        return {}
    key = json.dumps(request, sort_keys=True)
    if key not in ready:
        options = dict(request)
        ready[key] = jobs.prepare(options.pop("measure"), options)
    figures: dict[str, Any] = ready[key]()
    return figures


def main() -> None:
    """Answer until the input ends."""
    # What libraries print goes to the error output; ours stays clean.
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    sys.path.append(str(Path(__file__).parent))
    jobs = importlib.import_module("engine_jobs")
    ready: dict[str, Any] = {}
    for line in sys.stdin:
        try:
            said = answer(json.loads(line), jobs, ready)
        except Exception as error:  # whatever it is: the other side tells of it
            said = {"error": f"{type(error).__name__}: {error}"}
        output.write(json.dumps(said) + "\n")
        output.flush()


if __name__ == "__main__":
    main()
