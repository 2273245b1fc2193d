# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `cloth_drape`: drape coefficient and nodes of a fabric by the Cusick test."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from cloth_sim_ros.laboratory.command_options import (
    DONE,
    NOT_AT_REST,
    add_sample_options,
    run_test,
    sample_from_options,
    write_json,
)
from cloth_sim_ros.session.console import escape_unencodable

_DESCRIPTION = (
    "Drape a disc of fabric over a plate (BS 5058, ISO 9073-9), and print the drape coefficient, the number of nodes, "
    "and the coefficient of the real fabric if its file states one. Exit status 0: done; 1: a specimen is not at rest; "
    "2: the test is impossible."
)
#: Largest number of specimens.
_MAX_SPECIMENS = 1000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `cloth_drape`: parse the options, drape the specimens, print and write results; return the exit status."""
    escape_unencodable()
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.picture is not None and importlib.util.find_spec("matplotlib") is None:
        parser.error("--picture needs matplotlib: pip install 'cloth_sim_ros[batch]'")
    if not 1 <= options.specimens <= _MAX_SPECIMENS:
        parser.error(f"--specimens is {options.specimens}; it must be from 1 to {_MAX_SPECIMENS}")
    return run_test("cloth_drape", options, lambda: _run(options), picture=options.picture)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="cloth_drape", description=_DESCRIPTION)
    add_sample_options(parser)
    parser.add_argument("--diameter", type=float, default=0.3, metavar="M", help="of the specimen [m] (default 0.3)")
    parser.add_argument("--plate", type=float, default=0.18, metavar="M", help="diameter of the plate (default 0.18)")
    edge_length = "length of the mesh's edges [m] (default 0.005, by contact 0.0075, times diameter / 0.3 m)"
    parser.add_argument("--edge-length", type=float, metavar="M", help=edge_length)
    pattern = "mesh: rings around the centre, or irregular triangles (default regular)"
    parser.add_argument("--pattern", choices=("regular", "irregular"), default="regular", help=pattern)
    specimens = "number of specimens, each turned and perturbed in its own way (default 3)"
    parser.add_argument("--specimens", type=int, default=3, metavar="N", help=specimens)
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the first specimen (default 0)")
    contact = "let the specimen lie on the plate by contact and friction; default: it is held there"
    parser.add_argument("--contact", action="store_true", help=contact)
    parser.add_argument(
        "--no-mesh-error", action="store_true", help="omit the drapes of coarser meshes; contact has none"
    )
    picture = "contour and view of the first specimen; needs matplotlib"
    parser.add_argument("--picture", type=Path, metavar="OUT.png", help=picture)
    return parser


def _run(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from cloth_sim_ros.laboratory.drape import CONTACT_EDGE_LENGTH, DIAMETER, EDGE_LENGTH, DrapeTest
    from cloth_sim_ros.laboratory.drape_picture import write_picture
    from cloth_sim_ros.laboratory.drape_series import describe, drape_series
    from cloth_sim_ros.laboratory.equilibrium import LaboratoryError

    if options.seed < 0:
        raise LaboratoryError(f"--seed is {options.seed}; it must be at least 0")
    edge_length = (CONTACT_EDGE_LENGTH if options.contact else EDGE_LENGTH) * options.diameter / DIAMETER
    test = DrapeTest(
        diameter=options.diameter,
        plate_diameter=options.plate,
        edge_length=edge_length if options.edge_length is None else options.edge_length,
        pattern=options.pattern,
        contact=options.contact,
    )
    sample = sample_from_options(options)
    seeds = range(options.seed, options.seed + options.specimens)
    with tqdm(total=len(seeds), unit=" specimens", desc="drape", delay=1.0, disable=None, leave=False) as bar:
        series = drape_series(
            sample, test, seeds=seeds, with_mesh_error=not options.no_mesh_error, on_progress=bar.update
        )
    print(describe(series), flush=True)
    if options.json is not None:
        write_json(series.summary(), options.json)
    if options.picture is not None:
        from cloth_sim_ros.session.output_files import atomic_write

        with atomic_write(options.picture) as output:
            write_picture(series.drapes[0], sample.title, output)
    return DONE if series.is_converged else NOT_AT_REST


if __name__ == "__main__":
    sys.exit(main())
