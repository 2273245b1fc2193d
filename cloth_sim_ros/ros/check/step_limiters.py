# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edges and triangles that limit the step, and the gain without them."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.model.forces.drag import Drag
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.gravity import Gravity
from cloth_sim_ros.physics.model.forces.grips import Grips
from cloth_sim_ros.physics.model.forces.wind import Wind
from cloth_sim_ros.physics.model.model import Model
from cloth_sim_ros.physics.model.sheets.mesh import MeshSheet
from cloth_sim_ros.physics.plan.plan import Plan, compile
from cloth_sim_ros.scene.physics_scene import Sheet

#: Largest fraction of the particles that is reported as limiting.
STIFF_FRACTION = 0.01
#: Smallest gain in step length for which particles are reported as limiting.
MIN_GAIN = 1.2
#: Largest number of edges and triangles that are named.
_MAX_NAMED = 5
#: Indices of a block's components as a symmetric matrix, see `Plan.add_bounds`.
_BLOCK = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


@attrs.frozen(kw_only=True)
class StepLimiters:
    """Stability limit of the step at given positions, and the particle, force and stiff particles that set it."""

    #: Longest stable step of the leapfrog by the bounds [s]; infinite without a bound.
    limit: float
    #: Index of the particle with this limit; None without a bound.
    particle: int | None
    #: Name of the force with the largest share of the stiffness at this particle, and the share.
    force: str = ""
    share: float = 0.0
    #: Indices of the particles that are much stiffer than all others, stiffest first, at most `STIFF_FRACTION`.
    stiff_particles: tuple[int, ...] = ()
    #: Ratio of the step length without them to the present one; close to 1 if the stiffness is spread evenly.
    gain: float = 1.0


def find_step_limiters(plan: Plan, x: Array) -> StepLimiters:
    """Find the step's stability limit and the particles that set it, at positions x [m], shape (3, n)."""
    model = plan.model
    moving = np.flatnonzero(model.inverse_masses > 0.0)
    limits = _step_limits(plan, x)[moving]
    order = np.argsort(limits, kind="stable")
    if not len(order) or not np.isfinite(limits[order[0]]):
        return StepLimiters(limit=float("inf"), particle=None)
    n_stiff = max(1, int(STIFF_FRACTION * len(moving)))
    particle, limit = int(moving[order[0]]), float(limits[order[0]])
    gain = float(limits[order[min(n_stiff, len(order) - 1)]]) / limit
    # Name only particles whose limit is clearly below the one without them.
    stiff = [k for k in order[:n_stiff] if limits[k] * MIN_GAIN <= gain * limit]
    force, share = _stiffest_force(model, x, particle)
    return StepLimiters(
        limit=limit,
        particle=particle,
        force=force,
        share=share,
        stiff_particles=tuple(int(moving[k]) for k in stiff),
        gain=gain,
    )


def describe_step_limiters(limiters: StepLimiters, sheet: Sheet) -> list[str]:
    """Return sentences on the step's stability limit, and on the edges and triangles that set it."""
    if limiters.particle is None:
        return ["nothing bounds the step by its stability"]
    lines = [
        f"the step's limit of {limiters.limit * 1e3:.3g} ms is that of particle {limiters.particle}, where "
        f"'{limiters.force}' has {limiters.share:.0%} of the stiffness"
    ]
    if limiters.gain < MIN_GAIN or not limiters.stiff_particles:
        lines.append(
            f"no small group sets it: without the stiffest {STIFF_FRACTION:.0%} steps would be {limiters.gain:.2f} "
            f"times as long"
        )
        return lines
    count = "1 particle" if len(limiters.stiff_particles) == 1 else f"{len(limiters.stiff_particles)} particles"
    lines.append(
        f"{count} set it: without them steps would be {limiters.gain:.2g} times as long, and frames as much faster"
    )
    if isinstance(sheet, MeshSheet):
        lines += _describe_elements(sheet, limiters.stiff_particles)
    else:
        lines.append("they are " + ", ".join(str(particle) for particle in limiters.stiff_particles[:_MAX_NAMED]))
    return lines


def _step_limits(plan: Plan, x: Array) -> Array:
    """Return for each particle the longest step that its bounds of stiffness and damping allow [s], shape (n,)."""
    stiff, damped = np.zeros((2, 6, plan.model.particle_count))
    plan.add_bounds(x, stiff, damped, memory={})
    omega2, rates = (np.maximum(_largest_eigenvalues(blocks), 0.0) / plan.model.masses for blocks in (stiff, damped))
    # As `leapfrog_limit`.
    with np.errstate(divide="ignore"):
        return np.asarray(2.0 / (0.5 * rates + np.sqrt(0.25 * rates * rates + omega2)))


def _largest_eigenvalues(blocks: Array) -> Array:
    """Return the largest eigenvalue of each symmetric block (6, n: xx, yy, zz, xy, xz, yz), shape (n,)."""
    return np.asarray(np.linalg.eigvalsh(blocks[_BLOCK].transpose(2, 0, 1))[:, -1])


def _stiffest_force(model: Model, x: Array, particle: int) -> tuple[str, float]:
    """Return the force with the largest share of a particle's stiffness, by name, and the share; ("", 0.0) for none."""
    stiffness: dict[str, float] = {}
    for force in model.forces:
        if not isinstance(force, Gravity | Drag | Wind | Grips):
            stiff, damped = np.zeros((2, 6, model.particle_count))
            compile(Model(model.masses, [force])).add_bounds(x, stiff, damped, memory={})
            stiffness[force.name] = float(_largest_eigenvalues(stiff[:, [particle]])[0])
    total = sum(stiffness.values())
    if not total:
        return "", 0.0
    name = max(stiffness, key=lambda name: stiffness[name])
    return name, stiffness[name] / total


def _describe_elements(sheet: MeshSheet, particles: tuple[int, ...]) -> list[str]:
    """Return sentences on the shortest edges and the flattest triangles of a mesh at given particles."""
    edges = sheet.surface.edges
    lengths = _norms(sheet.rest_positions[edges[:, 1]] - sheet.rest_positions[edges[:, 0]])
    edge_ids = np.flatnonzero(np.isin(edges, particles).any(axis=1))
    shortest = edge_ids[np.argsort(lengths[edge_ids], kind="stable")][:_MAX_NAMED]
    triangles = sheet.surface.triangles
    heights = _heights(sheet)
    triangle_ids = np.flatnonzero(np.isin(triangles, particles).any(axis=1))
    flattest = triangle_ids[np.argsort(heights[triangle_ids], kind="stable")][:_MAX_NAMED]
    named = [f"{edges[e, 0]}-{edges[e, 1]} ({_mm(lengths[e])})" for e in shortest]
    flat = [f"{t} ({_mm(heights[t])})" for t in flattest]
    return [
        f"the shortest edges there, by particles: {', '.join(named)}; median of the mesh {_mm(np.median(lengths))}",
        f"the flattest triangles there, by height: {', '.join(flat)}; median of the mesh {_mm(np.median(heights))}",
    ]


def _heights(sheet: MeshSheet) -> Array:
    """Return the smallest height of each triangle of a mesh at its rest positions [m], shape (m,)."""
    corners = [sheet.rest_positions[sheet.surface.triangles[:, k]] for k in range(3)]
    longest = np.max([_norms(corners[k] - corners[k - 1]) for k in range(3)], axis=0)
    return np.asarray(2.0 * sheet.areas() / longest)


def _mm(length: float) -> str:
    return f"{length * 1e3:.3g} mm"


def _norms(vectors: NDArray[np.float64]) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1))
