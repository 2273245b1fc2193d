# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`cloth_bench`: run time against error, conditioning, stability and more, one subcommand each."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

from cloth_sim_ros.session.child_process import safe_imports
from cloth_sim_ros.session.outputs import OutputError, check_outputs

#: Subcommands: the module that runs each, and what it does. A module has `add_arguments(parser)` and `run(options)`,
#: which returns a `report.Report`.
COMMANDS = {
    "work-precision": ("work_precision", "wall time against error, ours and the solvers of libraries, on one scene"),
    "tolerance": ("tolerance_sweep", "achieved error against the tolerance that was asked for, over all scenes"),
    "conditioning": ("conditioning", "how far a kick of a nanometre grows, scene by scene"),
    "constants": ("constants", "the tuned numbers of step control, and what half and double of each does"),
    "promise": ("promise", "whether the tolerance's promise holds on random scenes, judged by a compiled reference"),
    "stability": (
        "stability",
        "thousands of attacks: stiffness, step, damping and events; the limits found and predicted",
    ),
    "contact": ("contact", "obstacles and friction against theory: slopes, weight, a strip over a drum, impacts, cost"),
    "speed": ("speed", "ns per spring against C, simulated seconds per wall second, two threads against one"),
    "peers": ("peers", "other engines on the same sheet, installed on demand into an environment of their own"),
    "peers-contact": ("peers_contact", "other engines where cloth touches: a drape, a fold, a pinch; depth and creep"),
    "scale": ("scale", "time per particle and step, and memory, from 10^3 to 10^6 particles"),
    "adds": ("adds", "whether features cost together what they cost one by one, for every pair of them"),
    "mesh-moduli": ("mesh_moduli", "moduli of sheets on irregular triangles: the distribution over random meshes"),
    "batch": ("batch", "many cloths in one process: real-time factor, threads, memory, rollouts, a soak"),
    "studies": ("studies", "cloth_batch against plain simulations, Dask's cost a task, a million runs on paper"),
    "skip": ("skip", "what a feature costs absent, idle and active; a loop made by hand; counts; start-up"),
}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(
        prog="cloth_bench",
        description="Measures cloth_sim_ros.",
        epilog="\n".join(f"  {name:16s} {text}" for name, (_, text) in COMMANDS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=COMMANDS, metavar="command", help="what to measure, see below")
    if not given or given[0] not in COMMANDS:
        parser.parse_args(given)
    name = given[0]
    module = importlib.import_module(f"cloth_sim_ros.bench.{COMMANDS[name][0]}")
    inner = argparse.ArgumentParser(prog=f"cloth_bench {name}", description=COMMANDS[name][1])
    module.add_arguments(inner)
    output = inner.add_argument_group("output")
    output.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    output.add_argument("--csv", type=Path, metavar="FOLDER", help="write each table as CSV")
    output.add_argument("--plots", type=Path, metavar="FOLDER", help="write plots as PNG")
    output.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables as a section of documentation")
    options = inner.parse_args(given[1:])
    try:
        check_outputs({"--json": options.json, "--markdown": options.markdown}, [])
        with safe_imports():
            report = module.run(options)
    except (ValueError, OutputError) as error:
        inner.error(str(error))
    sys.stdout.write(report.text() + "\n")
    report.write(json_file=options.json, csv_folder=options.csv, plot_folder=options.plots, markdown=options.markdown)
    return 1 if report.failures else 0


if __name__ == "__main__":
    sys.exit(main())
