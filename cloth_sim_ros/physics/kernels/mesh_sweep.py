# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Leapfrog sweeps over particles joined by listed springs: the compiled loops of `mesh_leapfrog`.

Particles are taken in blocks of BLOCK. A block owns the springs, hinges, panels and grips whose lowest particle lies in
it.
When a block's own are done, so are those of all blocks before, the forces on its particles are complete, and they
move at once; nothing that comes later looks at them. So a step reads and writes each number once, and several steps
can follow each other through the particles, each `lag` blocks behind the one before.

None in place of a table leaves its code out of the compiled loop.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros.physics.kernels.air_panels import add_forces as add_air_forces
from cloth_sim_ros.physics.kernels.held_points import book, held_point
from cloth_sim_ros.physics.kernels.hinge_emit import pull_altitude, pull_crossed
from cloth_sim_ros.physics.kernels.mesh_emit import QUAD, ROW, move_particles, pull_springs
from cloth_sim_ros.physics.kernels.pairs import add_pair_forces

BLOCK = 256
"""Particles of a block."""

Floats = NDArray[np.float64]


class Batches(NamedTuple):
    """Springs or hinges in batches, see `mesh_emit.pull_springs`; block b owns batches starts[b] to starts[b + 1] - 1.
    `damped`: None where nothing is.
    """

    starts: NDArray[np.int64]
    ends: NDArray[np.int32]
    table: Floats
    damped: int | None


class Listed(NamedTuple):
    """Joints, particles (m, 2), as their terms have them, in order of their owners."""

    starts: NDArray[np.int64]
    particles: NDArray[np.int64]
    rest: Floats
    stiffness: Floats
    damping: Floats


class Panels(NamedTuple):
    """Panels of a surface in the air, particles (m, 3) or (m, 4), in order of their owners; see `air_panels`."""

    starts: NDArray[np.int64]
    particles: NDArray[np.int64]
    normal: float
    tangential: float
    wind: Floats


class Held(NamedTuple):
    """Grips in order of their particles, block b owning starts[b] to starts[b + 1] - 1.

    `owners`: gripper of each. `offsets` [m], shape (m, 3), in the gripper's frame. `poses`: see `held_points`.
    `booked`, shape (m, BOOKED_NUMBERS), is added to.
    """

    starts: NDArray[np.int64]
    particles: NDArray[np.int64]
    owners: NDArray[np.int64]
    offsets: Floats
    stiffness: Floats
    damping: Floats
    poses: Floats
    booked: Floats


class Particles(NamedTuple):
    """`rows`, `force`: see `mesh_emit`, flat; forces are zero between runs. `inverse`: 1/m [1/kg]. `order`: number
    outside of each. `rank`: for each number outside its place here.
    """

    rows: Floats
    force: Floats
    inverse: Floats
    order: NDArray[np.int64]
    rank: NDArray[np.int64]


class Forces(NamedTuple):
    """What a block adds up, None for what the model does not have. A block's sums run in this order."""

    undamped: Batches | None
    damped: Batches | None
    joints: Listed | None
    crossed: Batches | None
    altitude: Batches | None
    panels: Panels | None


class Motion(NamedTuple):
    """`values`: see `mesh_emit.move_particles`; `gravity`, `drag`: None where there is none. `blocks`: how many there
    are; `lag`: blocks that interactions reach ahead; `levels`: steps in one sweep. `stamp`: which emitters and kernels
    compiled this.
    """

    values: Floats
    gravity: int | None
    drag: int | None
    blocks: int
    lag: int
    levels: int
    stamp: tuple[int | None, ...]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _hold(held, block, entry, dt, rows, force):  # type: ignore[no-untyped-def]
    """Add the forces of a block's grips; book the reactions over dt."""
    for e in range(held.starts[block], held.starts[block + 1]):
        arm, point, speed = held_point(held.poses[entry, held.owners[e]], held.offsets[e])
        row, at, k, c = held.particles[e] * ROW, held.particles[e] * QUAD, held.stiffness[e], held.damping[e]
        px = k * (rows[row] - point[0]) + c * (rows[row + QUAD] - speed[0])
        py = k * (rows[row + 1] - point[1]) + c * (rows[row + QUAD + 1] - speed[1])
        pz = k * (rows[row + 2] - point[2]) + c * (rows[row + QUAD + 2] - speed[2])
        force[at] -= px
        force[at + 1] -= py
        force[at + 2] -= pz
        book(held.booked[e], arm, speed, (px, py, pz), dt)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _forces(block, rows, force, undamped, damped, joints, crossed, altitude, panels):  # type: ignore[no-untyped-def]
    """Add the forces of the springs, hinges and panels that a block owns."""
    if undamped is not None:
        a, b = undamped.starts[block], undamped.starts[block + 1]
        pull_springs(rows, force, undamped.ends, undamped.table, a, b, undamped.damped)
    if damped is not None:
        a, b = damped.starts[block], damped.starts[block + 1]
        pull_springs(rows, force, damped.ends, damped.table, a, b, damped.damped)
    if joints is not None:
        a, b = joints.starts[block], joints.starts[block + 1]
        x, v, f = _views(rows, force)
        add_pair_forces(joints.particles[a:b], joints.rest[a:b], joints.stiffness[a:b], joints.damping[a:b], x, v, f)
    if crossed is not None:
        a, b = crossed.starts[block], crossed.starts[block + 1]
        pull_crossed(rows, force, crossed.ends, crossed.table, a, b, crossed.damped)
    if altitude is not None:
        a, b = altitude.starts[block], altitude.starts[block + 1]
        pull_altitude(rows, force, altitude.ends, altitude.table, a, b, altitude.damped)
    if panels is not None:
        a, b = panels.starts[block], panels.starts[block + 1]
        x, v, f = _views(rows, force)
        add_air_forces(panels.particles[a:b], panels.normal, panels.tangential, panels.wind, x, v, f)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _views(rows, force):  # type: ignore[no-untyped-def]
    """Positions, velocities and forces as the kernels of terms take them, (3, n)."""
    table = rows.reshape(-1, ROW)
    return table[:, :3].T, table[:, QUAD : QUAD + 3].T, force.reshape(-1, QUAD)[:, :3].T


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _load(particles, motion, x, v):  # type: ignore[no-untyped-def]
    """Copy positions and velocities in; the velocity that forces see starts as the velocity.

    In the order outside: there a particle lies in six places, here in two.
    """
    rows, rank = particles.rows, particles.rank
    for outside in range(len(rank)):
        place = rank[outside] * ROW
        for c in range(3):
            rows[place + c] = x[c, outside]
            rows[place + QUAD + c] = v[c, outside]
            if motion is not None:
                motion[place + c] = v[c, outside]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _unload(particles, motion, x, v, half):  # type: ignore[no-untyped-def]
    """Copy positions, half a step back from where they are, and velocities out, these unless v is empty."""
    rows, rank = particles.rows, particles.rank
    for outside in range(len(rank)):
        place = rank[outside] * ROW
        for c in range(3):
            speed = rows[place + QUAD + c] if motion is None else motion[place + c]
            x[c, outside] = rows[place + c] - half * speed
            if len(v):
                v[c, outside] = speed


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _drift(particles, duration):  # type: ignore[no-untyped-def]
    """Move all positions, where no velocity has to be predicted."""
    rows = particles.rows
    for i in range(0, len(rows), ROW):
        for c in range(3):
            rows[i + c] += duration * rows[i + QUAD + c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _take(block, entry, dt, particles, speeds, motion, forces, held, start):  # type: ignore[no-untyped-def]
    """Add a block's forces and move its particles."""
    rows, force, inverse, order, _ = particles
    _forces(
        block,
        rows,
        force,
        forces.undamped,
        forces.damped,
        forces.joints,
        forces.crossed,
        forces.altitude,
        forces.panels,
    )
    if held is not None:
        _hold(held, block, entry, dt, rows, force)
    first, last = block * BLOCK, min(block * BLOCK + BLOCK, len(order))
    move_particles(rows, force, speeds, inverse, first, last, motion.values, motion.gravity, motion.drag, start)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def advance_mesh(x0, v0, x, v, steps, particles, speeds, motion, forces, held):  # type: ignore[no-untyped-def]
    """Advance x0, v0 (3, n) by so many steps to x, v, which may be the same arrays, and v empty. `speeds`: flat, room
    for `motion` of `mesh_emit.move_particles`, or None where no force depends on velocity.
    """
    step = motion.values[0]
    _load(particles, speeds, x0, v0)
    if speeds is not None:
        for block in range(motion.blocks):
            _take(block, 0, 0.0, particles, speeds, motion, forces, held, 1)
    else:
        _drift(particles, 0.5 * step)
    for begin in range(0, steps, motion.levels):
        levels = min(motion.levels, steps - begin)
        for front in range(motion.blocks + motion.lag * (levels - 1)):
            for level in range(levels):
                block = front - motion.lag * level
                if 0 <= block < motion.blocks:
                    _take(block, begin + level + 1, step, particles, speeds, motion, forces, held, None)
    _unload(particles, speeds, x, v, 0.5 * step)
