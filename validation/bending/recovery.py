# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recovery of the rest shape by pairs of triangles: experiment of docs/bending.md.

Many independent tetrahedra move with damping from their start positions until they rest. Each has the edges of two
triangles (S1), the bending spring (S7) and the second spring (S8 or S9). A tetrahedron has recovered if its six lengths
and its signed length are those of the rest shape. The signed length of the mirror image differs.
"""

from __future__ import annotations

import math
from typing import Literal

import attrs
import numpy as np
from numpy.typing import NDArray

from cloth_sim_ros import AltitudeSprings, CrossedSprings, Model, PairSprings, compile
from cloth_sim_ros.physics.model.forces.force import Array
from cloth_sim_ros.physics.model.forces.hinge_springs import HingeSprings, signed_lengths
from cloth_sim_ros.physics.model.sheets.bending import spring_constants
from cloth_sim_ros.physics.model.sheets.hinge_shape import HingeShape

#: The five edges of the triangles, then the bending spring.
EDGES = np.array([[0, 1], [0, 2], [1, 2], [0, 3], [1, 3], [2, 3]])

#: Steps between checks for rest.
STEPS_PER_CHECK = 50

#: Rest triangles: edge, heights and feet of the two wings [m].
REST_TRIANGLES: dict[str, tuple[float, float, float, float, float]] = {
    "equilateral": (1.0, math.sqrt(0.75), math.sqrt(0.75), 0.5, 0.5),
    "grid diagonal": (math.sqrt(2.0), math.sqrt(0.5), math.sqrt(0.5), math.sqrt(0.5), math.sqrt(0.5)),
    "grid edge": (1.0, 1.0, 1.0, 0.0, 1.0),
    "checkerboard edge": (1.0, 1.0, 1.0, 0.0, 0.0),
    "scalene": (1.0, 0.6, 1.1, 0.3, 0.8),
    "obtuse": (1.0, 0.5, 0.7, -0.1, 0.6),
}

Start = Literal["random", "inverted", "flat", "folded", "collinear"]
STARTS: tuple[Start, ...] = ("random", "inverted", "flat", "folded", "collinear")


@attrs.frozen(kw_only=True)
class RecoveryStatistics:
    """Statistics of a batch of starts."""

    starts: int
    #: Number of starts that rest in another shape, or that do not come to rest.
    missed: int
    #: Largest rise of the total energy between two checks in the last tenth of any motion, over k7 L².
    late_energy_rise: float


def start_positions(kind: Start, rest_positions: Array, count: int, rng: np.random.Generator) -> Array:
    """Return start positions (count, 4, 3) [m], none of them planar, for a rest shape (4, 3)."""
    size = float(np.linalg.norm(rest_positions - rest_positions.mean(axis=0), axis=1).max())
    noise = rng.standard_normal((count, 4, 3))
    if kind == "random":
        return size * noise
    if kind == "inverted":  # the mirror image, nearly
        return rest_positions * np.array([1.0, 1.0, -1.0]) + 0.1 * size * noise
    if kind == "flat":  # planar but for a thousandth
        x = rest_positions + 0.3 * size * noise
        x[:, :, 2] = 1e-3 * size * noise[:, :, 2]
        return x
    if kind == "folded":  # shut by nine tenths or more, either way
        turn = math.pi * rng.choice([-1.0, 1.0], count) * (1.0 - rng.uniform(0.0, 0.1, count))
        edge, foot = np.linalg.norm(rest_positions[1] - rest_positions[0]), rest_positions[2:, 1] - rest_positions[0, 1]
        height = np.linalg.norm(rest_positions[2:] - rest_positions[0], axis=1) ** 2 - foot**2
        h0, h1 = np.sqrt(height)
        c, s = np.cos(0.5 * turn), np.sin(0.5 * turn)
        x = np.zeros((count, 4, 3))
        x[:, 1, 1] = edge
        x[:, 2] = np.stack((-h0 * c, np.full(count, foot[0]), h0 * s), axis=1)
        x[:, 3] = np.stack((h1 * c, np.full(count, foot[1]), h1 * s), axis=1)
        return x + 0.02 * size * noise
    x = 1e-3 * size * noise  # nearly collinear
    x[:, :, 0] = size * rng.standard_normal((count, 4))
    return x


def rest_shape(name: str, angle: float) -> Array:
    """Return the rest positions (4, 3) [m] of one of `RESTS`, folded by `angle` [rad], its edge along y."""
    edge, h0, h1, f0, f1 = REST_TRIANGLES[name]
    c, s = math.cos(0.5 * angle), math.sin(0.5 * angle)
    return np.array([(0.0, 0.0, 0.0), (0.0, edge, 0.0), (-h0 * c, f0, h0 * s), (h1 * c, f1, h1 * s)])


def simulate_recovery(
    x: Array,
    rest_positions: Array,
    *,
    model: Literal["crossed", "altitude"] = "altitude",
    ratio: float | None = None,
    edge_stiffness: float = 10.0,
    damping: float = 0.7,
    limit: int = 60_000,
) -> RecoveryStatistics:
    """Integrate starts x (count, 4, 3) until rest, and count those that miss the rest shape (4, 3).

    `x` is changed in place.

    Args:
        x: start positions [m].
        rest_positions: rest positions [m].
        model: `altitude` for S9, `crossed` for S8, each with S7.
        ratio: stiffness ratio ρ; None is the recommended one.
        edge_stiffness: stiffness of the triangles' edges, in units of S7's.
        damping: dimensionless k_d0 of every spring.
        limit: maximal number of steps; a motion that takes longer counts as missed.
    """
    shape = HingeShape.of([[0, 1, 2, 3]], rest_positions)
    second, opposite = (float(k[0]) for k in spring_constants(model, shape, [1.0], ratio=ratio))
    ratio_second = second / opposite
    lengths = np.linalg.norm(rest_positions[EDGES[:, 1]] - rest_positions[EDGES[:, 0]], axis=1)
    stiffness = np.array([edge_stiffness] * 5 + [1.0])  # unit masses; S7 has 1 N/m
    k_d = damping * np.sqrt(stiffness)
    h0 = float(shape.length(model)[0])
    # a quarter of the stability limit: a particle has up to four stiff springs
    step = 0.25 / math.sqrt(edge_stiffness + ratio_second + 1.0)
    hinge = (h0, ratio_second, damping * math.sqrt(ratio_second))
    tetrahedra = _Tetrahedra((lengths, stiffness, k_d), hinge, model, len(x))
    rise = _come_to_rest(x, tetrahedra, step, limit)
    final_lengths = np.linalg.norm(x[:, EDGES[:, 1]] - x[:, EDGES[:, 0]], axis=2)
    final_signed_lengths = signed_lengths(_quads(len(x)), _componentwise(x), kind=model)
    length_tolerance = 1e-3 * float(lengths.max())
    is_recovered = np.abs(final_lengths - lengths).max(axis=1) < length_tolerance
    is_recovered &= np.abs(final_signed_lengths - h0) < length_tolerance
    return RecoveryStatistics(
        starts=len(x),
        missed=int(np.count_nonzero(~is_recovered)),
        late_energy_rise=float(rise.max(initial=0.0) / lengths.max() ** 2),
    )


class _Tetrahedra:
    """Independent tetrahedra of unit masses in one model.

    Args:
        edges: rest lengths [m], stiffness [N/m] and damping [N s/m] of the springs of one tetrahedron.
        hinge: signed rest length [m], stiffness [N/m] and damping [N s/m] of its second spring.
        kind: model of the second spring.
        count: number of tetrahedra.
    """

    def __init__(
        self, edges: tuple[Array, ...], hinge: tuple[float, ...], kind: Literal["crossed", "altitude"], count: int
    ) -> None:
        (self.lengths, self.stiffness, damping), (self.h0, self.second, _), self.kind = edges, hinge, kind
        self.quads = _quads(count)
        pairs = self.quads[:, EDGES].reshape(-1, 2)
        coefficients = (self.lengths, self.stiffness * self.lengths, damping)
        springs = PairSprings(pairs, *(np.tile(coefficient, count) for coefficient in coefficients))
        hinges: HingeSprings
        if kind == "crossed":
            hinges = CrossedSprings(self.quads[:, :2], self.quads[:, 2:], *hinge)
        else:
            hinges = AltitudeSprings(self.quads, *hinge)
        self.plan = compile(Model(np.ones(4 * count), [springs, hinges]))

    def energies(self, x: Array, v: Array) -> Array:
        """Return kinetic plus potential energy of each (m,) [J]; a hinge of undefined length counts 0."""
        p = x.T.reshape(-1, 4, 3)
        stretch = np.linalg.norm(p[:, EDGES[:, 1]] - p[:, EDGES[:, 0]], axis=2) - self.lengths
        h = signed_lengths(self.quads, x, kind=self.kind)
        hinge = np.where(np.isnan(h), 0.0, 0.5 * self.second * (h - self.h0) ** 2)
        return np.asarray(_kinetic_energies(v) + 0.5 * (self.stiffness * stretch**2).sum(axis=1) + hinge)


def _kinetic_energies(v: Array) -> Array:
    """Return the kinetic energy of each tetrahedron of unit masses (m,) [J]."""
    return np.asarray(0.5 * (v * v).sum(axis=0).reshape(-1, 4).sum(axis=1))


def _quads(count: int) -> NDArray[np.int64]:
    return np.arange(4 * count).reshape(-1, 4)


def _componentwise(x: Array) -> Array:
    return np.ascontiguousarray(x.reshape(-1, 3).T)


def _come_to_rest(starts: Array, tetrahedra: _Tetrahedra, step: float, limit: int) -> Array:
    """Integrate all by the leapfrog until they rest; return the late rise of energy of each [J].

    A check for rest follows every `STEPS_PER_CHECK` steps. A tetrahedron rests if four successive checks find it at
    rest.
    """
    x, count = _componentwise(starts), len(starts)
    v, forces = np.zeros_like(x), np.zeros_like(x)
    checks_at_rest, checks_until_rest = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    history = [tetrahedra.energies(x, v)]
    for check_index in range(1, limit // STEPS_PER_CHECK + 1):
        (run,), _ = tetrahedra.plan.runs(0.0, STEPS_PER_CHECK * step, (x, v), [STEPS_PER_CHECK])
        x, v = run.x, run.v
        tetrahedra.plan.accelerations(0.0, x, v, forces)
        history.append(tetrahedra.energies(x, v))
        is_at_rest = (2.0 * _kinetic_energies(forces) < 1e-14) & (_kinetic_energies(v) < 1e-14)
        checks_at_rest = np.where(is_at_rest, checks_at_rest + 1, 0)
        checks_until_rest[(checks_at_rest == 4) & (checks_until_rest == 0)] = check_index
        if checks_until_rest.all():
            break
    checks_until_rest[checks_until_rest == 0] = len(history) - 1
    starts[:] = x.T.reshape(-1, 4, 3)
    energy_rises = np.diff(np.array(history), axis=0)
    late_rises = [
        energy_rises[last_check - last_check // 10 : last_check, k].max(initial=0.0)
        for k, last_check in enumerate(checks_until_rest.tolist())
    ]
    return np.array(late_rises)
