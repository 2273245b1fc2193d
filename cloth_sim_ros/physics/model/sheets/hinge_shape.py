# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Closed-form lengths of a hinge's springs (S7, S8, S9) over its fold angle.

Two rigid triangles share an edge of length e. Wing i stands at height h_i over it, its foot at f_i along it. The hinge
is folded by θ, with t = cos θ.

S7 has the distance L of the wings, with d = f1 - f0.

    L² = h0² + h1² + d² + 2 h0 h1 t.

S8 and S9 have the length h = 6V / M with 6V = e h0 h1 sin θ. In S8, M belongs to the edge and the wings' line, and ε =
PARALLEL.

    M² = e² (h0² + h1² + 2 h0 h1 t) + (ε e²)².

In S9, M belongs to the four faces, and k = 0, 1 are the ends of the edge.

    M² = e² (h0² + h1²) + Σ (p_k² q_k² - (α_k - h0 h1 t)²).

Here p_k, q_k are the distances of the wings from end k, and α_k = (f0 - e_k)(f1 - e_k). Therefore every M² is a + b t +
c t².
"""

from __future__ import annotations

from typing import Literal

import attrs
import numpy as np
from numpy.typing import ArrayLike

from cloth_sim_ros.physics.arithmetic.angles import sine_and_cosine
from cloth_sim_ros.physics.model.forces.force import Array

Length = Literal["crossed", "altitude"]
#: S8's M² has (this e²)² more than |a × b|²: parallel lines have a distance, too. The same as in engine/laws/hinge.hpp.
PARALLEL = 0.1


def _dot(a: Array, b: Array) -> Array:
    """Return the scalar products of rows, shapes (m, 3)."""
    products: Array = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
    return products


@attrs.frozen(eq=False, kw_only=True)
class HingeShape:
    """Shape of many hinges, each two rigid triangles and their fold angle; every array has shape (m,), lengths [m]."""

    edge: Array
    """Length e of the shared edge."""
    height0: Array
    """Height of wing 0 over the edge's line."""
    height1: Array
    """Height of wing 1 over the edge's line."""
    foot0: Array
    """Foot of wing 0 along the edge, counted from its first end."""
    foot1: Array
    """Foot of wing 1 along the edge, counted from its first end."""
    cosine: Array
    """Cosine of the fold angle. The angle is 0 if flat, positive if the wings rise to the side of the normal."""
    sine: Array
    """Sine of the fold angle."""

    @classmethod
    def of(cls, hinges: ArrayLike, positions: ArrayLike) -> HingeShape:
        """Return the shape of hinges (m, 4) at particle positions (n, 3) [m]; refuse triangles without area.

        Raises:
            ValueError: for an edge without length or a triangle without area.
        """
        quads = np.asarray(hinges, dtype=np.int64).reshape(-1, 4)
        x = np.asarray(positions, dtype=np.float64)
        start, along = x[quads[:, 0]], x[quads[:, 1]] - x[quads[:, 0]]
        edge = np.sqrt(_dot(along, along))
        if np.any(edge == 0.0):
            bad = int(np.argmax(edge == 0.0))
            raise ValueError(f"hinge {bad} {quads[bad].tolist()} has an edge without length; weld its particles")
        unit = along / edge[:, None]
        feet, heights, directions = [], [], []
        for wing in (2, 3):
            arm = x[quads[:, wing]] - start
            foot = _dot(arm, unit)
            perpendicular = arm - foot[:, None] * unit
            height = np.sqrt(_dot(perpendicular, perpendicular))
            flat = height <= 1e-9 * edge
            if np.any(flat):
                bad = int(np.argmax(flat))
                raise ValueError(f"hinge {bad} {quads[bad].tolist()} has a triangle without area; remove it")
            feet.append(foot)
            heights.append(height)
            directions.append(perpendicular / height[:, None])
        # flat: the wings stand on opposite sides, sides[0] = -sides[1]
        sine, cosine = _dot(unit, np.cross(directions[0], directions[1])), -_dot(directions[0], directions[1])
        length = np.sqrt(sine * sine + cosine * cosine)
        (foot0, foot1), (height0, height1), cosine, sine = feet, heights, cosine / length, sine / length
        return cls(edge=edge, height0=height0, height1=height1, foot0=foot0, foot1=foot1, cosine=cosine, sine=sine)

    @classmethod
    def of_sides(cls, edge: Array, sides: Array, folds: HingeShape) -> HingeShape:
        """Return hinges of given side lengths, with the folds of other hinges; refuse lengths that make no triangle.

        Args:
            edge: length of the shared edge [m], shape (m,).
            sides: lengths from either end of the edge to wing 0, then to wing 1 [m], shape (m, 4).
            folds: hinges whose folds are taken.

        Raises:
            ValueError: for lengths that make no triangle with an area.
        """
        feet, heights = [], []
        for first, second in (sides.T[:2], sides.T[2:]):
            with np.errstate(all="ignore"):
                foot = (first * first + edge * edge - second * second) / (2.0 * edge)
                square = first * first - foot * foot
                wrong = np.flatnonzero(~(square > 1e-18 * edge * edge))
            if wrong.size:
                lengths = ", ".join(f"{length[wrong[0]]:.4g}" for length in (edge, first, second))
                raise ValueError(f"the sides {lengths} m of a triangle at hinge {wrong[0]} make no area; lengthen two")
            feet.append(foot)
            heights.append(np.sqrt(square))
        (foot0, foot1), (height0, height1) = feet, heights
        return attrs.evolve(folds, edge=edge, foot0=foot0, foot1=foot1, height0=height0, height1=height1)

    def folded(self, angle: ArrayLike) -> HingeShape:
        """Return the same triangles folded by `angle` [rad], -π to π, one number or shape (m,); NaN keeps a fold."""
        angles = np.broadcast_to(np.asarray(angle, np.float64), self.edge.shape)
        folds = np.nan_to_num(angles).tolist()
        sines_and_cosines = {fold: sine_and_cosine(fold) for fold in set(folds)}
        sine, cosine = np.array([sines_and_cosines[fold] for fold in folds]).reshape(-1, 2).T
        is_missing = np.isnan(angles)
        return attrs.evolve(
            self, cosine=np.where(is_missing, self.cosine, cosine), sine=np.where(is_missing, self.sine, sine)
        )

    def wing_distance(self) -> Array:
        """Return the distance L of the wings [m]: the length of S7."""
        return np.sqrt(self._distance2(self.cosine))

    def wing_distance_slope(self) -> Array:
        """Return the derivative dL/dθ [m] of the wings' distance by the fold angle."""
        distance = self.wing_distance()
        torque_arm = self.height0 * self.height1 * self.sine
        return np.divide(-torque_arm, distance, out=np.zeros_like(torque_arm), where=distance > 0.0)

    def length(self, kind: Length) -> Array:
        """Return the signed length h [m] of S8 (`crossed`) or S9 (`altitude`)."""
        a, b, c = self._squared_area(kind)
        t = self.cosine
        area = np.sqrt(np.maximum(a + b * t + c * t * t, 0.0))
        return self._volume() * self.sine / area

    def length_slope(self, kind: Length) -> Array:
        """Return the derivative dh/dθ [m] of the signed length of S8 or S9 by the fold angle.

        It is e h0 h1 / M when flat.
        """
        a, b, c = self._squared_area(kind)
        t, s = self.cosine, self.sine
        square = a + b * t + c * t * t
        return self._volume() * (t / np.sqrt(square) + s * s * (b + 2.0 * c * t) / (2.0 * square * np.sqrt(square)))

    def half_range_ratio(self, kind: Length) -> Array:
        """Return the largest h of S8 or S9 over all folds, divided by half the range of S7's length L.

        Scaled by it, the closed curve of (L, h) is as wide as it is high. The energies of S7 and of S8 or S9 then have
        equal depth.
        """
        a, b, c = self._squared_area(kind)
        # h² = (6V)² (1 - t²) / (a + b t + c t²) is largest where b t² + 2 (a + c) t + b = 0, |t| < 1
        t = -b / (a + c + np.sqrt(np.maximum((a + c) ** 2 - b * b, 0.0)))
        sine2 = np.maximum(1.0 - t * t, 0.0)
        area2 = a + b * t + c * t * t
        max_length = self._volume() * np.sqrt(sine2 / area2)
        half_range = 0.5 * (np.sqrt(self._distance2(1.0)) - np.sqrt(self._distance2(-1.0)))
        return max_length / half_range

    def _volume(self) -> Array:
        return self.edge * self.height0 * self.height1

    def _distance2(self, t: ArrayLike) -> Array:
        h0, h1 = self.height0, self.height1
        height_part = h0 * h0 + h1 * h1 + 2.0 * h0 * h1 * np.asarray(t)
        return np.maximum(height_part + (self.foot1 - self.foot0) ** 2, 0.0)

    def _squared_area(self, kind: Length) -> tuple[Array, Array, Array]:
        """Return a, b, c [m^4] of M² = a + b cos θ + c cos²θ in the length 6V/M of S8 or S9."""
        a = self.edge * self.edge * (self.height0 * self.height0 + self.height1 * self.height1)
        product = self.height0 * self.height1
        if kind == "crossed":
            parallel_area = PARALLEL * self.edge * self.edge
            return a + parallel_area * parallel_area, 2.0 * self.edge * self.edge * product, np.zeros_like(a)
        b = np.zeros_like(a)
        for end in (np.zeros_like(self.edge), self.edge):
            offset0, offset1 = self.foot0 - end, self.foot1 - end
            square0 = offset0 * offset0 + self.height0 * self.height0
            square1 = offset1 * offset1 + self.height1 * self.height1
            a = a + square0 * square1 - (offset0 * offset1) ** 2
            b = b + 2.0 * product * offset0 * offset1
        return a, b, -2.0 * product * product
