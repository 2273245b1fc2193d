# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog steps of particles joined by listed springs and hinges, forces and motion in one sweep.

The scheme is that of `integrators.march`: x_h = x + dt/2 v; a = a(x_h, v + dt/4 (a' + a'')) with the accelerations of
the two steps before; v += dt a; x = x_h + dt/2 v. Between steps the kernel keeps x_h.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from cloth_sim_ros.physics.kernels.grid_springs import aligned_zeros
from cloth_sim_ros.physics.kernels.held_points import BOOKED_NUMBERS, POSE_NUMBERS, tabulate_poses
from cloth_sim_ros.physics.kernels.mesh_bounds import MeshBounds
from cloth_sim_ros.physics.kernels.mesh_emit import LANES, QUAD, ROW
from cloth_sim_ros.physics.kernels.mesh_sweep import (
    BLOCK,
    Batches,
    Floats,
    Forces,
    Held,
    Listed,
    Motion,
    Panels,
    Particles,
    advance_mesh,
)

Integers = NDArray[np.int64]

_SECOND_CACHE = 1 << 20
"""Bytes; that of the machines at hand. A wrong guess costs a few per cent."""

_MANY_STEPS = 4


@attrs.frozen(eq=False, kw_only=True)
class Springs:
    """Springs between two particles, (m, 2), or hinges of four, (m, 4), with what their terms say of each."""

    particles: Integers
    #: Rest lengths [m].
    rest: Floats
    #: k [N/m].
    stiffness: Floats
    #: k_d [N s/m].
    damping: Floats

    @classmethod
    def joined(cls, parts: Sequence[Springs], width: int) -> Springs:
        """All of several, of so many particles each."""
        none = np.empty(0)
        return cls(
            particles=np.concatenate([np.empty((0, width), dtype=np.int64), *(part.particles for part in parts)]),
            rest=np.concatenate([none, *(part.rest for part in parts)]),
            stiffness=np.concatenate([none, *(part.stiffness for part in parts)]),
            damping=np.concatenate([none, *(part.damping for part in parts)]),
        )

    def taken(self, which: NDArray[np.int64] | NDArray[np.bool_]) -> Springs:
        """Some of them."""
        return Springs(
            particles=self.particles[which],
            rest=self.rest[which],
            stiffness=self.stiffness[which],
            damping=self.damping[which],
        )

    def renumbered(self, rank: Integers) -> Springs:
        """Particle i is called rank[i]; ordered by the lowest particle, then by the next."""
        particles = rank[self.particles]
        return attrs.evolve(self, particles=particles).taken(_order(particles))


@attrs.frozen(eq=False, kw_only=True)
class MeshPanels:
    """Panels of a surface in the air; see `terms.air_panels.AirPanels`."""

    particles: Integers
    normal: float
    tangential: float
    wind: Floats


@attrs.frozen(eq=False, kw_only=True)
class MeshGrips:
    """Particles held by grippers on their paths; see `terms.grips.Grips`, whose arrays these are."""

    paths: Floats
    starts: Integers
    particles: Integers
    offsets: Floats
    stiffness: Floats
    damping: Floats


class MeshLeapfrog:
    """Fused leapfrog of springs and hinges. What is left out here has no instruction in the compiled loop.

    Args:
        inverse_masses: 1/m [1/kg], zero for anchored particles (they keep their velocity), shape (n,).
        pairs: springs by their lists; rest length 0 makes a joint (S4).
        crossed: hinges of S8.
        altitude: hinges of S9.
        panels: surface in the air.
        gravity: acceleration [m/s^2], shape (3,), or None.
        drag: a = -drag v [1/s]; 0 for none.
        order: particles in the order in which to take them, shape (n,); as they are numbered where left out. What
            `advance` takes and gives is not affected but by rounding.

    Not safe for two calls at once: the object owns its copy of the state.
    """

    def __init__(
        self,
        inverse_masses: ArrayLike,
        *,
        pairs: Springs,
        crossed: Springs | None = None,
        altitude: Springs | None = None,
        panels: MeshPanels | None = None,
        gravity: ArrayLike | None = None,
        drag: float = 0.0,
        order: Integers | None = None,
    ) -> None:
        inverse = np.asarray(inverse_masses, dtype=np.float64)
        count = len(inverse)
        order = np.arange(count) if order is None else order
        self._rank = np.empty(count, dtype=np.int64)
        self._rank[order] = np.arange(count)
        self._blocks = -(-count // BLOCK)
        joint, damped = pairs.rest == 0.0, pairs.damping > 0.0
        kinds = [
            *(pairs.taken(chosen) for chosen in (~joint & ~damped, ~joint & damped, joint)),
            *(hinges or Springs.joined([], 4) for hinges in (crossed, altitude)),
        ]
        undamped, damped_, joints, first, second = (part.renumbered(self._rank) for part in kinds)
        self._forces = Forces(
            self._batched(undamped, undamped.stiffness * undamped.rest, undamped.stiffness),
            self._batched(damped_, damped_.stiffness * damped_.rest, damped_.stiffness),
            self._listed(joints),
            self._batched(first, first.rest, first.stiffness),
            self._batched(second, second.rest, second.stiffness),
            None if panels is None else self._surface(panels),
        )
        found = [undamped.particles, damped_.particles, joints.particles, first.particles, second.particles]
        if self._forces.panels is not None:
            found.append(self._forces.panels.particles)
        self._lag = max(_reach(particles) for particles in found) or 1
        # Through a second cache that does not hold everything several steps are better taken at once; no bit changes.
        bytes_used = 8 * (count * (2 * ROW + QUAD + 1) + 4 * len(pairs.rest))
        self._levels = _MANY_STEPS if bytes_used > _SECOND_CACHE else 1
        self._predicts = drag > 0.0 or panels is not None or any(bool(part.damping.any()) for part in kinds)
        self._particles = Particles(
            aligned_zeros(count * ROW, np.float64),
            aligned_zeros(count * QUAD, np.float64),
            np.ascontiguousarray(inverse[order]),
            np.ascontiguousarray(order),
            self._rank,
        )
        self._speeds = aligned_zeros(count * ROW, np.float64)
        self._drag = float(drag)
        self._gravity = None if gravity is None else np.array(gravity, dtype=np.float64).reshape(3)

    def bounds(self, names: frozenset[str]) -> MeshBounds | None:
        """Bounds of its springs, which are those of the terms of these names; None where it has anything but springs
        of some length.
        """
        springs, others = self._forces[:2], self._forces[2:]
        if any(part is not None for part in others):
            return None
        return MeshBounds(names, self._particles, self._rank, self._lag, *springs)

    def advance(
        self,
        t: float,
        x: Floats,
        v: Floats | None,
        steps: int,
        dt: float,
        *,
        grips: MeshGrips | None = None,
        start: tuple[Floats, Floats] | None = None,
    ) -> Floats | None:
        """Advance positions x [m] and velocities v [m/s], (3, n), from time t by `steps` steps of dt [s], in place, or
        from those of `start`, which stay as they are; v may then be None, and only positions are set.

        Returns:
            For each grip its impulse [N s] and torque impulse [N m s] on the gripper about its pose, and the work done
            on the cloth [J], shape (m, 7); None without grips.
        """
        values = np.zeros(2 * QUAD)
        values[:4] = dt, 0.5 * dt, 0.25 * dt, self._drag
        if self._gravity is not None:
            values[4:7] = self._gravity
        motion = Motion(
            values,
            None if self._gravity is None else 1,
            1 if self._drag else None,
            self._blocks,
            self._lag,
            self._levels,
            _stamp(),
        )
        order, held = self._held(grips, t, steps, dt)
        speeds = self._speeds if self._predicts or held is not None else None
        x0, v0 = (x, v) if start is None else start
        v = np.empty((0, 0)) if v is None else v
        advance_mesh(x0, v0, x, v, steps, self._particles, speeds, motion, self._forces, held)
        if held is None:
            return None
        booked = np.empty_like(held.booked)
        booked[order] = held.booked
        return booked

    def _held(self, grips: MeshGrips | None, t: float, steps: int, dt: float) -> tuple[Integers, Held | None]:
        """The grips in order of their particles, with their order."""
        if grips is None or not grips.particles.size:
            return np.empty(0, dtype=np.int64), None
        particles = self._rank[grips.particles]
        order = np.argsort(particles, kind="stable")
        poses = np.empty((steps + 1, len(grips.paths), POSE_NUMBERS))
        tabulate_poses(grips.paths, grips.starts, t, dt, poses)
        owners = np.repeat(np.arange(len(grips.paths)), np.diff(grips.starts))
        return order, Held(
            np.searchsorted(particles[order], BLOCK * np.arange(self._blocks + 1)),
            particles[order],
            owners[order],
            grips.offsets[order],
            grips.stiffness[order],
            grips.damping[order],
            poses,
            np.zeros((len(order), BOOKED_NUMBERS)),
        )

    def _starts(self, particles: Integers) -> Integers:
        """Where each block's own start, and the end."""
        lowest = particles.min(axis=1)
        return np.searchsorted(lowest, BLOCK * np.arange(self._blocks + 1)).astype(np.int64)

    def _listed(self, springs: Springs) -> Listed | None:
        if not len(springs.particles):
            return None
        return Listed(
            self._starts(springs.particles),
            np.ascontiguousarray(springs.particles),
            np.ascontiguousarray(springs.rest),
            np.ascontiguousarray(springs.stiffness),
            np.ascontiguousarray(springs.damping),
        )

    def _surface(self, panels: MeshPanels) -> Panels:
        particles = self._rank[panels.particles]
        particles = np.ascontiguousarray(particles[_order(particles)])
        wind = np.ascontiguousarray(panels.wind)
        return Panels(self._starts(particles), particles, panels.normal, panels.tangential, wind)

    def _batched(self, springs: Springs, *constants: Floats) -> Batches | None:
        """Cut each block's springs into batches with these constants and, where there is any, the damping.

        Lanes left over get springs from a particle to itself without stiffness.
        """
        count, ends = springs.particles.shape
        if not count:
            return None
        damped = bool(springs.damping.any())
        slots = (*constants, springs.damping) if damped else constants
        starts = self._starts(springs.particles)
        batches = -(-np.diff(starts) // LANES)
        first = np.concatenate([[0], np.cumsum(batches)])
        block = np.repeat(np.arange(self._blocks), np.diff(starts))
        batch, lane = np.divmod(first[block] * LANES + np.arange(count) - starts[block], LANES)
        particles = np.empty((first[-1], ends, LANES), dtype=np.int32)
        particles[:] = np.repeat(np.arange(self._blocks) * BLOCK, batches)[:, None, None]
        particles[batch, :, lane] = springs.particles
        table = aligned_zeros(first[-1] * len(slots) * LANES, np.float64)
        for slot, values in enumerate(slots):
            table.reshape(first[-1], len(slots), LANES)[batch, slot, lane] = values
        return Batches(first, (QUAD * particles).ravel(), table, 1 if damped else None)


def _order(particles: Integers) -> Integers:
    """The order by the lowest particle of each row, then by the next."""
    return np.lexsort(np.sort(particles, axis=1).T[::-1])


def _reach(particles: Integers) -> int:
    """Most blocks that a row of particles reaches ahead."""
    blocks = particles // BLOCK
    return int((blocks.max(axis=1) - blocks.min(axis=1)).max(initial=0)) if len(blocks) else 0


@cache
def _stamp() -> tuple[int | None, ...]:
    """Sixteen bits of a digest of the sources that the compiled loop is made of, as a type.

    Numba's disk cache looks at the file of the compiled function alone: this keeps it from serving older kernels.
    """
    from cloth_sim_ros.physics.kernels import (
        air_panels,
        grid_emit,
        held_points,
        hinge_emit,
        mesh_emit,
        pairs,
        tetrahedron,
    )

    modules = (air_panels, grid_emit, held_points, hinge_emit, mesh_emit, pairs, tetrahedron)
    sources = b"".join(Path(str(module.__file__)).read_bytes() for module in modules)
    number = int.from_bytes(hashlib.blake2b(sources, digest_size=2).digest())
    return tuple(1 if number >> bit & 1 else None for bit in range(16))
