# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Series of drapes of one fabric: several specimens, their mean and the error of the mesh."""

from __future__ import annotations

import math
import os
import statistics
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import attrs

from cloth_sim_ros.laboratory.drape import COARSENING, Drape, DrapeTest, coarser_drape, drape, mesh_error
from cloth_sim_ros.laboratory.samples import FabricSample


@attrs.frozen(eq=False, kw_only=True)
class DrapeSeries:
    """Drapes of several specimens of one fabric, with those of coarser meshes if requested."""

    sample: FabricSample
    test: DrapeTest
    drapes: Sequence[Drape]
    #: Drapes of coarser meshes with the same folds; empty if they were not asked for.
    coarse: Sequence[Drape] = ()
    #: True if coarser meshes were requested and do not fit the test.
    is_too_coarse: bool = False

    @property
    def coefficient(self) -> float:
        """Mean drape coefficient of the specimens."""
        return statistics.fmean(drape.coefficient for drape in self.drapes)

    @property
    def deviation(self) -> float:
        """Standard deviation of the drape coefficient between specimens; 0 for one specimen."""
        coefficients = [drape.coefficient for drape in self.drapes]
        return statistics.stdev(coefficients) if len(coefficients) > 1 else 0.0

    @property
    def nodes(self) -> float:
        """Mean number of nodes (folds) of the specimens."""
        return statistics.fmean(drape.shadow.nodes for drape in self.drapes)

    @property
    def mesh_error(self) -> float | None:
        """Estimated error of the mean drape coefficient by the mesh; None without coarser drapes."""
        if not self.coarse:
            return None
        pairs = zip(self.drapes, self.coarse, strict=True)
        return statistics.fmean(mesh_error(fine, coarse) for fine, coarse in pairs)

    @property
    def is_converged(self) -> bool:
        """True if every specimen, those of coarser meshes included, is at rest."""
        return all(drape.is_converged for drape in (*self.drapes, *self.coarse))

    def summary(self) -> dict[str, Any]:
        """Return all numbers by name, nested, for JSON; lengths in m."""
        stated = self.sample.fabric.drape_coefficient
        return {
            "fabric": self.sample.fabric.name,
            "title": self.sample.title,
            "source": self.sample.fabric.source,
            "test": attrs.asdict(self.test),
            "coefficient": self.coefficient,
            "deviation": self.deviation,
            "nodes": self.nodes,
            "mesh_error": self.mesh_error,
            "stated": None if stated is None else list(stated),
            "converged": self.is_converged,
            "specimens": [
                {
                    "seed": drape.seed,
                    "coefficient": drape.coefficient,
                    "nodes": drape.shadow.nodes,
                    "residual": drape.residual,
                    "time": drape.time,
                    "particles": len(drape.mesh.points),
                    "min_quality": drape.mesh.min_quality(),
                    "contour": drape.shadow.radii.tolist(),
                }
                for drape in self.drapes
            ],
        }


def drape_series(
    sample: FabricSample,
    test: DrapeTest,
    *,
    seeds: Sequence[int],
    with_mesh_error: bool = True,
    on_progress: Callable[[], Any] = lambda: None,
) -> DrapeSeries:
    """Simulate the drapes of specimens, each on one thread, as many at once as there are cores; wait for all.

    Args:
        sample: the fabric.
        test: conditions of the test.
        seeds: seed of each specimen.
        with_mesh_error: true to drape coarser meshes too, if they fit the test, unless specimens are in contact. The
            plates of a coarser mesh are larger, and the finer one's shape would begin in them.
        on_progress: called by a specimen's thread after its drape, before that of the coarser mesh.
    """
    needs_coarse = with_mesh_error and not test.contact

    def drape_specimen(seed: int) -> tuple[Drape, Drape | None]:
        fine = drape(sample, test, seed=seed)
        on_progress()
        coarse = coarser_drape(sample, fine) if needs_coarse and test.permits_coarser_mesh else None
        return fine, coarse

    workers = max(1, min(len(seeds), len(os.sched_getaffinity(0))))
    with ThreadPoolExecutor(workers) as pool:
        specimens = list(pool.map(drape_specimen, seeds))
    return DrapeSeries(
        sample=sample,
        test=test,
        drapes=[fine for fine, _ in specimens],
        coarse=[coarse for _, coarse in specimens if coarse is not None],
        is_too_coarse=needs_coarse and not test.permits_coarser_mesh,
    )


def describe(series: DrapeSeries) -> str:
    """Return the report of a series of drapes as text of several lines."""
    fabric, test = series.sample.fabric, series.test
    support = "contact with the plate" if test.contact else "held on the plate"
    size = f"{1e3 * test.diameter:g} mm on {1e3 * test.plate_diameter:g} mm"
    lines = [f"{series.sample.title}: Cusick drape, {size}, {support}, edges of {1e3 * test.edge_length:g} mm", ""]
    lines.append(f"{'specimen':>8}  {'coefficient':>11}  {'nodes':>5}  {'residual':>8}")
    lines += [
        f"{drape.seed:>8}  {100.0 * drape.coefficient:>9.1f} %  {drape.shadow.nodes:>5}  {drape.residual:>8.1e}"
        for drape in series.drapes
    ]
    spread = f" ± {100.0 * series.deviation:.1f}" if len(series.drapes) > 1 else ""
    lines += ["", f"drape coefficient  {100.0 * series.coefficient:.1f}{spread} %, {series.nodes:.1f} nodes"]
    if series.mesh_error is not None:
        lines.append(f"error of the mesh  {100.0 * series.mesh_error:+.1f} points, from edges 1.5 times as long")
    if series.is_too_coarse:
        lines.append(
            f"error of the mesh  unknown: it needs edges of at most {1e3 * test.max_edge_length / COARSENING:.3g} mm"
        )
    if fabric.drape_coefficient is not None:
        low, high = (100.0 * bound for bound in fabric.drape_coefficient)
        real = f"{low:.1f} %" if math.isclose(low, high) else f"{low:.0f} to {high:.0f} %"
        lines.append(f"real fabric        {real}")
    if fabric.source:
        lines.append(f"source             {fabric.source}")
    if not series.is_converged:
        lines.append("not at rest: a specimen still moved at the end; its numbers are of that moment")
    return "\n".join(lines)
