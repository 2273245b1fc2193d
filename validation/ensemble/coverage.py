# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Coverage of an ensemble: how often a cloth with random parameters lies within two deviations of the mean.

To first order the offset of a particle is a normal vector of three components with the covariance C of the members'
offsets. Its squared length is a sum of eigenvalues of C times independent chi-squared numbers. A deviation s is the
root of the trace of C. The probability of a length of at most 2 s is 0.954 if all offsets lie on a line, and 0.993 if
they are isotropic. The report compares it with the share of cloths whose parameters are drawn from the distribution.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

import attrs
import numpy as np

from cloth_sim_ros import Distribution, Ensemble, Grasp, Scene, Target
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.simulation.events import Event
from validation.command import at_least
from validation.report import Report, Table

#: Number of deviations, and normal vectors for the probability of a particle.
WITHIN, _SAMPLES = 2.0, 4000
#: Deviations below this [m] are the tolerance of the simulation, not uncertainty; such particles are left out.
_MIN_DEVIATION = 5e-5
_CLOTH = {"cloth.size": [0.5, 0.5], "cloth.position": [0.0, 0.0, 1.0], "tolerance": 1e-5, "rate": 30.0}
SCENES: dict[str, tuple[dict[str, Any], dict[str, float]]] = {
    "swing from a corner": (
        {"cloth.anchors": ["top_left"], "bending.model": "crossed", "material.bending_modulus": 1e-4},
        {"air.drag": 0.2, "wind.normal_drag": 0.2, "material.density": 0.05, "material.bending_modulus": 0.3},
    ),
    "flag": (
        {"cloth.anchors": ["left"], "wind.velocity": [3.0, 1.0, 0.0], "material.stretch_modulus": 100.0},
        {"wind.normal_drag": 0.1, "material.density": 0.05, "wind.velocity": 0.05},
    ),
    "carried corner": (
        {"cloth.anchors": ["top"], "material.stretch_modulus": 50.0, "material.shear_modulus": 5.0},
        {"material.stretch_modulus": 0.1, "material.shear_modulus": 0.2, "wind.normal_drag": 0.2},
    ),
}


@attrs.frozen(kw_only=True)
class CoverageRow:
    """Coverage at one time of a motion."""

    #: Simulated time [s].
    time: float
    #: Root mean square of the deviations [m].
    deviation: float
    #: The same of the cloths with random parameters, about the ensemble's mean [m].
    sample_deviation: float
    #: Mean probability that a particle lies within two deviations.
    predicted: float
    #: Share of particles and cloths within two deviations.
    measured: float
    #: Standard error of that share, from its variation over cloths.
    standard_error: float


def distribution_of(deviations: dict[str, float]) -> Distribution:
    """Return independent parameters with relative standard deviations by full name."""
    entries = [{"name": name, "deviation": deviation} for name, deviation in deviations.items()]
    return Distribution.from_bytes(json.dumps({"parameters": entries}).encode(), "the distribution")


def probability_within(offsets: Array) -> Array:
    """Return the probability of each particle to lie within two deviations, shape (n,).

    Args:
        offsets: offsets of the members from their mean [m], shape (members, n, 3).
    """
    covariance = np.einsum("mni,mnj->nij", offsets, offsets) / len(offsets)
    eigenvalues = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    chi_squared = np.square(np.random.default_rng(1).standard_normal((_SAMPLES, 3)))
    limits = WITHIN**2 * eigenvalues.sum(axis=1)
    return np.asarray((eigenvalues @ chi_squared.T <= limits[:, None]).mean(axis=1))


def measure_coverage(
    name: str, *, resolution: int, cloths: int, seconds: float, seed: int = 0, scale: float = 1.0
) -> list[CoverageRow]:
    """Measure the coverage of a scene at each quarter of its duration.

    Args:
        name: one of `SCENES`.
        resolution: rows and columns of the cloth.
        cloths: number of cloths with random parameters.
        seconds: simulated time [s].
        seed: seed of the random parameters.
        scale: factor on the deviations of the parameters; small ones show the first order alone.
    """
    values, deviations = SCENES[name]
    scene = Scene.from_parameters({**_CLOTH, **values, "cloth.resolution": [resolution, resolution]})
    distribution = distribution_of({parameter: scale * deviation for parameter, deviation in deviations.items()})
    frames, rows = round(seconds * scene.rate), []
    with Ensemble(scene, distribution) as ensemble, Ensemble(scene, distribution, members=cloths, seed=seed) as truths:
        for frame in range(1, frames + 1):
            events = _events(name, scene, frame)
            state = ensemble.advance(events)
            truths.advance(events)
            if frame in {round(frames * quarter / 4) for quarter in (1, 2, 3, 4)}:
                is_uncertain = state.deviation > _MIN_DEVIATION
                distances = np.linalg.norm(truths.positions - state.mean, axis=2)[:, is_uncertain]
                shares = (distances <= WITHIN * state.deviation[is_uncertain]).mean(axis=1)
                probability = probability_within((ensemble.positions - state.mean)[:, is_uncertain])
                rows.append(
                    CoverageRow(
                        time=state.time,
                        deviation=float(np.sqrt(np.square(state.deviation[is_uncertain]).mean())),
                        sample_deviation=float(np.sqrt(np.square(distances).mean())),
                        predicted=float(probability.mean()),
                        measured=float(shares.mean()),
                        standard_error=float(shares.std(ddof=1) / np.sqrt(cloths)),
                    )
                )
    return rows


def _events(name: str, scene: Scene, frame: int) -> list[Event]:
    if name != "carried corner":
        return []
    corner, progress = scene.initial_positions()[-1], min(1.0, frame / scene.rate)
    events: list[Event] = [Target("gripper", tuple(corner + progress * np.array([-0.1, -0.3, 0.3])))]
    return [*events, Grasp("gripper", True)] if frame == 1 else events


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--cloths", type=at_least(2), default=100, help="cloths with random parameters")
    parser.add_argument("--resolution", type=int, default=12, help="rows and columns")
    parser.add_argument("--seconds", type=float, default=2.0, help="simulated time")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the deviations")
    parser.add_argument("--seed", type=int, default=0, help="seed of the parameters")


def run(options: argparse.Namespace) -> Report:
    """Measure the coverage of each scene."""
    if not 0.0 < options.scale <= 1.0:
        raise ValueError(f"--scale is {options.scale}; it must be above 0 and at most 1")
    columns = ["scene", "time [s]", "deviation [m]", "of random cloths [m]", "predicted", "measured", "standard error"]
    table = Table(f"Share within {WITHIN:g} deviations, {options.cloths} cloths with random parameters", columns)
    for name in SCENES:
        values = {key: getattr(options, key) for key in ("resolution", "cloths", "seconds", "seed", "scale")}
        table.rows += [[name, *attrs.astuple(row)] for row in measure_coverage(name, **values)]
    return Report("Coverage of ensembles", tables=[table])
