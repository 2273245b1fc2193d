# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One row of a regular sheet: the forces of its springs, and one leapfrog step of its particles.

A row owns the springs that lead from it to the right and down (`FAMILIES`). Their forces on this row, on the next and
on the one after are summed in a ring of three force rows. As rows are taken in order, and none looks back, a row's
force is complete when its own springs are done, and its particles can move at once: a step reads and writes each
number once.

Which springs exist, whether they are damped, whether there is drag or gravity is read off the *type* of `shape`, a
tuple of None for what is not there and numbers for what is (`Shape`). Numba compiles one version for each such type;
what is not there has no instruction. The constants themselves are in the array `values` (`value_index`).

The table holds entries of TABLE_SLOTS slots, `pitch` numbers each: inverse masses [1/kg]; one for a free particle and
zero for an anchored one; then the weights of the families. A weight stands in the column of the spring's leftmost
end, and is zero where there is no spring.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

from numba.core import cgutils, types
from numba.extending import intrinsic

from cloth_sim_ros.physics.kernels.grid_emit import SHORTEST_SQUARE, Vectors


class Family(NamedTuple):
    """The ends of a spring relative to the row and column that own it: (row, column) of each."""

    first: tuple[int, int]
    second: tuple[int, int]


FAMILIES = {
    "right": Family((0, 0), (0, 1)),
    "down": Family((0, 0), (1, 0)),
    "diagonal": Family((0, 0), (1, 1)),
    "antidiagonal": Family((0, 1), (1, 0)),
    "right2": Family((0, 0), (0, 2)),
    "down2": Family((0, 0), (2, 0)),
}
"""Spring families of a grid. The antidiagonal is owned by its left column, so that no force moves to the left."""

INVERSE_MASS_SLOT, FREE_SLOT, FIRST_WEIGHT_SLOT = 0, 1, 2
TABLE_SLOTS = FIRST_WEIGHT_SLOT + len(FAMILIES)
"""Slots of a table entry."""

POSITION, VELOCITY, PREDICTED, LAST, CARRY = 0, 3, 6, 9, 12
"""Where a row's components of each kind start."""


class Shape(NamedTuple):
    """What a step consists of. Only the types count: None, or a number.

    A family is None where it does not exist, an int where it is not damped, a float where it is. `drag`, `gravity`;
    `predicted`: forces depend on velocity; `carry`: positions are kept with what rounding took from them. `stamp`:
    which emitters compiled this.
    """

    right: int | float | None
    down: int | float | None
    diagonal: int | float | None
    antidiagonal: int | float | None
    right2: int | float | None
    down2: int | float | None
    drag: int | None
    gravity: int | None
    predicted: int | None
    carry: int | None
    stamp: tuple[int | None, ...]

    def kinds(self) -> tuple[type, ...]:
        """The types that count; the stamp is the same for all shapes of a process."""
        return tuple(type(part) for part in self)


_MOTION = ("step", "half", "quarter", "drag", "gravity_0", "gravity_1", "gravity_2")
VALUE_COUNT = 3 * len(FAMILIES) + len(_MOTION)
"""Length of `values`."""


@cache
def value_index(name: str, part: str = "") -> int:
    """Place in `values` of a constant.

    For a family, `part` "k" is k_s [N], "l" is k_s / rest length [N/m], "d" is k_d [N s/m]. Otherwise `name` is
    "step", "half" or "quarter" (dt, dt/2, dt/4 [s]), "drag" [1/s], "gravity_0", "_1" or "_2" [m/s^2].
    """
    if part:
        return 3 * list(FAMILIES).index(name) + "kld".index(part)
    return 3 * len(FAMILIES) + _MOTION.index(name)


_COMPONENTS = range(3)
_ARGUMENTS = (
    *("rows", "row0", "row1", "row2", "pitch", "table", "table_row"),
    *("ring", "ring0", "ring1", "ring2", "shape", "values"),
)


class Row:
    """Emits the loop over one row.

    `velocity` is where the velocities that damping sees start. `first` is the first of the three rows whose force is
    wanted: 0 as a rule, 1 or 2 for a row that others own, of which only the springs that reach below count.
    `finish(row, force, column)` emits what happens to this row's complete force. Another class may give the ends
    something else than forces, in `parts` numbers.
    """

    parts = 3

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any, velocity: int, first: int) -> None:
        self.context, self.builder, self.velocity, self.first = context, builder, velocity, first
        kinds = dict(zip(_ARGUMENTS, signature.args, strict=True))
        self.values = dict(zip(_ARGUMENTS, arguments, strict=True))
        self.data = {
            name: context.make_array(kinds[name])(context, builder, self.values[name]).data
            for name in ("rows", "table", "ring", "values")
        }
        self.vectors = Vectors(builder, 4 if kinds["rows"].dtype == types.float32 else 8)
        present = dict(zip(Shape._fields, kinds["shape"].types, strict=True))
        self.has = {name for name, kind in present.items() if kind != types.none}
        self.families = [name for name in FAMILIES if name in self.has]
        self.damped = {name for name in self.families if isinstance(present[name], types.Float)}
        # The last row that springs reach is written, those before it are added to. Without springs to lower rows the
        # next one is written all the same: a grip may add to it.
        self.deepest = max((1, *(FAMILIES[name].second[0] for name in self.families)))

    def integer(self, value: int) -> Any:
        """An index constant."""
        return self.context.get_constant(types.intp, value)

    def value(self, name: str, part: str = "") -> Any:
        """A constant in each lane."""
        place = self.builder.gep(self.data["values"], [self.integer(value_index(name, part))])
        return self.vectors.splat(self.builder.load(place))

    def index(self, origin: str, slot: int, column: Any, columns: int = 0) -> Any:
        """Index of a column of component or slot `slot` of the row or entry that starts at the argument `origin`."""
        start = self.builder.add(self.values[origin], self.builder.mul(self.values["pitch"], self.integer(slot)))
        return self.builder.add(start, self.builder.add(column, self.integer(columns)))

    def load(self, slot: int, column: Any) -> Any:
        """Components `slot` to `slot` + 2 of this row."""
        return [self.vectors.load(self.data["rows"], self.index("row0", slot + c, column)) for c in _COMPONENTS]

    def store(self, values: list[Any], slot: int, column: Any) -> None:
        """Write components `slot` to `slot` + 2 of this row."""
        for c in _COMPONENTS:
            self.vectors.store(values[c], self.data["rows"], self.index("row0", slot + c, column))

    def emit(self, finish: Any) -> None:
        """Emit the loop over the row's vectors."""
        if self.first > self.deepest:
            return
        families = [name for name in self.families if FAMILIES[name].second[0] >= self.first]
        ends = {end for name in families for end in FAMILIES[name]}
        shifted = sorted(end for end in ends if end[1] > 0 and end[0] >= self.first)
        zero = self.vectors.constant(0.0)
        before = {end: [cgutils.alloca_once_value(self.builder, zero) for _ in range(self.parts)] for end in shifted}
        lanes = self.integer(self.vectors.lanes)
        with cgutils.for_range(self.builder, self.builder.sdiv(self.values["pitch"], lanes)) as loop:
            column = self.builder.mul(loop.index, lanes)
            forces: dict[tuple[int, int], list[Any]] = {}
            for name in families:
                self.add_spring(forces, name, column)
            self.sum_rows(forces, before, finish, column)

    def sum_rows(self, forces: Any, before: Any, finish: Any, column: Any) -> None:
        """Add the forces by end to the ring, those on ends to the right moved there; finish this row."""
        vectors, builder = self.vectors, self.builder
        for row in range(self.first, self.deepest + 1):
            total = []
            for c in range(self.parts):
                place = self.index(f"ring{row}", c, column)
                value = vectors.load(self.data["ring"], place) if row < self.deepest else None
                for end in sorted(end for end in forces if end[0] == row):
                    part = forces[end][c]
                    if end[1] > 0:
                        last = builder.load(before[end][c])
                        builder.store(part, before[end][c])
                        part = vectors.shift(last, part, end[1])
                    value = part if value is None else vectors.add(value, part)
                value = vectors.constant(0.0) if value is None else value
                total.append(value)
                if row > 0:
                    vectors.store(value, self.data["ring"], place)
            if row == 0:
                finish(self, total, column)

    def add_spring(self, forces: Any, name: str, column: Any) -> None:
        """Add F = (k/l0 - k/|d| + k_d (dv.d)/|d|^2) d to the first end's force, subtract it from the second's (S1 of
        the model).

        The constants are read here, not before the loop: they become broadcast operands instead of spilled registers.
        """
        vectors, family, damped = self.vectors, FAMILIES[name], name in self.damped
        (x0, p0), (x1, p1) = (self.point(end, column, moving=damped) for end in family)
        d = [vectors.sub(b, a) for a, b in zip(x0, x1, strict=True)]
        inverse = vectors.inverse_root(vectors.dot(d, d, vectors.constant(SHORTEST_SQUARE)))
        slope = vectors.neg(self.value(name, "k"))
        if damped:
            approach = [vectors.sub(b, a) for a, b in zip(p0, p1, strict=True)]
            rate = vectors.dot(approach[1:], d[1:], vectors.mul(approach[0], d[0]))
            slope = vectors.fma(vectors.mul(self.value(name, "d"), rate), inverse, slope)
        factor = vectors.fma(slope, inverse, self.value(name, "l"))
        slot = FIRST_WEIGHT_SLOT + list(FAMILIES).index(name)
        factor = vectors.mul(factor, vectors.load(self.data["table"], self.index("table_row", slot, column)))
        for end, sign in zip(family, (factor, vectors.neg(factor)), strict=True):
            if end[0] < self.first:
                continue
            if end in forces:
                forces[end] = [vectors.fma(sign, q, f) for q, f in zip(d, forces[end], strict=True)]
            else:
                forces[end] = [vectors.mul(sign, q) for q in d]

    def point(self, end: tuple[int, int], column: Any, *, moving: bool) -> tuple[list[Any], list[Any]]:
        """Positions, and velocities where wanted, of the particles at a spring's end. LLVM merges repeated loads."""

        def components(start: int) -> list[Any]:
            places = [self.index(f"row{end[0]}", start + c, column, end[1]) for c in _COMPONENTS]
            return [self.vectors.load(self.data["rows"], place) for place in places]

        return components(POSITION), components(self.velocity) if moving else []

    def accelerations(self, force: list[Any], column: Any) -> list[Any]:
        """F/m + gravity - drag times predicted velocity; zero where anchored."""
        vectors = self.vectors
        inverse_mass = vectors.load(self.data["table"], self.index("table_row", INVERSE_MASS_SLOT, column))
        free = vectors.load(self.data["table"], self.index("table_row", FREE_SLOT, column))
        predicted = self.load(PREDICTED, column) if "drag" in self.has else []
        accelerations = []
        for c in _COMPONENTS:
            a = vectors.mul(inverse_mass, force[c])
            field = self.value(f"gravity_{c}") if "gravity" in self.has else None
            if predicted:
                drag = vectors.mul(self.value("drag"), predicted[c])
                field = vectors.neg(drag) if field is None else vectors.sub(field, drag)
            accelerations.append(a if field is None else vectors.fma(free, field, a))
        return accelerations


def keep(row: Row, force: list[Any], column: Any) -> None:
    """Store the complete force in the ring."""
    for c in range(row.parts):
        row.vectors.store(force[c], row.data["ring"], row.index("ring0", c, column))


def _drift(row: Row, duration: Any, v: list[Any], column: Any) -> None:
    """x += duration v; with Kahan's sum where the positions carry what rounding takes from them."""
    vectors, x = row.vectors, row.load(POSITION, column)
    if "carry" not in row.has:
        row.store([vectors.fma(duration, v[c], x[c]) for c in _COMPONENTS], POSITION, column)
        return
    carry = row.load(CARRY, column)
    ways = [vectors.fma(duration, v[c], carry[c]) for c in _COMPONENTS]
    ends = [vectors.add(x[c], ways[c]) for c in _COMPONENTS]
    row.store([vectors.sub(ways[c], vectors.sub(ends[c], x[c])) for c in _COMPONENTS], CARRY, column)
    row.store(ends, POSITION, column)


def _start(row: Row, force: list[Any], column: Any) -> None:
    """predicted = v + dt/2 a, x += dt/2 v; the acceleration of the step before is taken to have been the same."""
    half, v = row.value("half"), row.load(VELOCITY, column)
    a = row.accelerations(force, column)
    row.store(a, LAST, column)
    row.store([row.vectors.fma(half, a[c], v[c]) for c in _COMPONENTS], PREDICTED, column)
    _drift(row, half, v, column)


def _step(row: Row, force: list[Any], column: Any) -> None:
    """v += dt a, predicted = v + dt/4 (a + a of the step before), x += dt v."""
    fma, step, v = row.vectors.fma, row.value("step"), row.load(VELOCITY, column)
    a = row.accelerations(force, column)
    v = [fma(step, a[c], v[c]) for c in _COMPONENTS]
    row.store(v, VELOCITY, column)
    if "predicted" in row.has:
        quarter, last = row.value("quarter"), row.load(LAST, column)
        both = [row.vectors.add(a[c], last[c]) for c in _COMPONENTS]
        row.store(a, LAST, column)
        row.store([fma(quarter, both[c], v[c]) for c in _COMPONENTS], PREDICTED, column)
    _drift(row, step, v, column)


def generator(velocity: int, first: int, finish: Any, kind: type[Row] = Row) -> Any:
    """What emits the loop over a row of some kind; see `Row`."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        kind(context, builder, signature, arguments, velocity, first).emit(finish)
        return context.get_dummy_value()

    return generate


def row_signature(*kinds: Any) -> Any:
    """The type of a row's loop."""
    return types.void(*kinds)


# fmt: off
@intrinsic
def row_forces(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """Write a row's complete force [N] to ring row `ring0`; add what its springs do to the next rows to `ring1`,
    `ring2`.

    `rows` is flat; a row is 3 components of position [m], then 3 of velocity [m/s], `pitch` numbers each, from index
    `row0` on; `row1` and `row2` are the next two. `ring` likewise holds 3 components a row. The row's entry in
    `table` starts at `table_row`. The last of the ring rows that springs reach is overwritten, the others are added
    to.
    """
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(VELOCITY, 0, keep)


@intrinsic
def row_start(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """As `row_forces`, but prepare the row for `row_step`: predicted = v + dt/2 a(x, v), x += dt/2 v.

    A row is 3 components of position, 3 of velocity, 3 of predicted velocity, which must hold v on entry, 3 of the
    last acceleration.
    """
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(PREDICTED, 0, _start)


@intrinsic
def row_step(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """As `row_forces`, but move the row by one step: v += dt a(x, predicted), predicted = v + dt/4 (a + last a), x +=
    dt v.

    A row is 3 components of position at the half step, 3 of velocity at the step, 3 of the velocity predicted for the
    half step and 3 of the last acceleration (where `shape` has `predicted`), 3 of what rounding took from the
    positions (where it has `carry`).
    """
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(PREDICTED, 0, _step)


@intrinsic
def row_above(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """The part of `row_step` that concerns the next two rows, with the same bits: for the last row above a band of
    rows.
    """
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(PREDICTED, 1, None)


@intrinsic
def row_two_above(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values):  # type: ignore[no-untyped-def]
    """The part of `row_step` that concerns the row after the next, with the same bits: for the last row but one
    above a band.
    """
    signature = row_signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, shape, values)
    return signature, generator(PREDICTED, 2, None)
# fmt: on
