# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One row of a regular sheet: the forces of its springs, and one leapfrog step of its particles.

A row owns the springs that lead from it to the right and down (`FAMILIES`). Their forces on this row, on the next and on the one
after are summed in a ring of three force rows. As rows are taken in order, and none looks back, a row's force is complete when
its own springs are done, and its particles can move at once: a step reads and writes each number once.

Which springs exist, whether they are damped, whether there is drag or gravity is read off the *type* of `params`: an array of
one record whose field names list what the scene has. Numba compiles one version for each such type; what has no field has no
instruction. Fields:

- of a spring family, `NAME_SLOT_k` (k_s [N]), `NAME_SLOT_l` (k_s / rest length [N/m]) and, if it is damped, `NAME_SLOT_d`
  (k_d [N s/m]), SLOT being the place of its weights in the table;
- `step` and `half` (dt, dt/2 [s]); `drag` [1/s]; `gravity_0`, `_1`, `_2` [m/s^2];
- `predicted` if forces depend on velocity, `carry` if positions are kept with what rounding took from them.

The table holds entries of slots, `pitch` numbers each: inverse masses [1/kg]; one for a free particle and zero for an anchored one;
then the weights of the families. A weight stands in the column of the spring's leftmost end, and is zero where there is no
spring.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from llvmlite import ir
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
"""Slots of a table entry."""

POSITION, VELOCITY, PREDICTED, CARRY = 0, 3, 6, 9
"""Where a row's components of each kind start."""

_COMPONENTS = range(3)
_MOTION = ("step", "half", "drag", "gravity_0", "gravity_1", "gravity_2")
_ARGUMENTS = (
    *("rows", "row0", "row1", "row2", "pitch", "table", "table_row"),
    *("ring", "ring0", "ring1", "ring2", "params"),
)


class _Row:
    """Emits the loop over one row.

    `velocity` is where the velocities that damping sees start. `first` is the first of the three rows whose force is wanted: 0 as a rule, 1 or
    2 for a row that others own, of which only the springs that reach below count. `finish(row, force, motion, column)` emits what
    happens to this row's complete force.
    """

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any, velocity: int, first: int) -> None:
        self.context, self.builder, self.velocity, self.first = context, builder, velocity, first
        kinds = dict(zip(_ARGUMENTS, signature.args, strict=True))
        self.values = dict(zip(_ARGUMENTS, arguments, strict=True))
        self.data = {
            name: context.make_array(kinds[name])(context, builder, self.values[name]).data
            for name in ("rows", "table", "ring", "params")
        }
        self.record = kinds["params"].dtype
        self.fields = self.record.fields
        self.vectors = Vectors(builder, 4 if kinds["rows"].dtype == types.float32 else 8)
        self.slots = {
            name: int(slot) for name, slot, _ in (field.rsplit("_", 2) for field in self.fields if field[-2:] == "_k")
        }
        # The last row that springs reach is written, those before it are added to. Without springs to lower rows the next one is
        # written all the same: a grip may add to it.
        self.deepest = max((1, *(FAMILIES[name].second[0] for name in self.slots)))

    def integer(self, value: int) -> Any:
        """An index constant."""
        return self.context.get_constant(types.intp, value)

    def param(self, field: str) -> Any:
        """The value of a field of `params` in each lane."""
        start = self.builder.bitcast(self.data["params"], ir.IntType(8).as_pointer())
        place = self.builder.gep(start, [self.integer(self.record.offset(field))])
        return self.vectors.splat(self.builder.load(self.builder.bitcast(place, self.vectors.element.as_pointer())))

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
        families = [(FAMILIES[name], name) for name in self.slots if FAMILIES[name].second[0] >= self.first]
        constants = {
            name: {
                part: self.param(field)
                for part in "kld"
                if (field := f"{name}_{self.slots[name]}_{part}") in self.fields
            }
            for _, name in families
        }
        motion = {name: self.param(name) for name in _MOTION if name in self.fields}
        shifted = {end for family, _ in families for end in family if end[1] > 0 and end[0] >= self.first}
        zero = self.vectors.constant(0.0)
        before = {end: [cgutils.alloca_once_value(self.builder, zero) for _ in _COMPONENTS] for end in sorted(shifted)}
        lanes = self.integer(self.vectors.lanes)
        with cgutils.for_range(self.builder, self.builder.sdiv(self.values["pitch"], lanes)) as loop:
            column = self.builder.mul(loop.index, lanes)
            forces: dict[tuple[int, int], list[Any]] = {}
            for family, name in families:
                self.add_spring(forces, family, self.slots[name], constants[name], column)
            self.sum_rows(forces, before, motion, finish, column)

    def sum_rows(self, forces: Any, before: Any, motion: Any, finish: Any, column: Any) -> None:
        """Add the forces by end to the ring, those on ends to the right moved there; finish this row."""
        vectors, builder = self.vectors, self.builder
        for row in range(self.first, self.deepest + 1):
            total = []
            for c in _COMPONENTS:
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
                finish(self, total, motion, column)

    def add_spring(self, forces: Any, family: Family, slot: int, constants: Any, column: Any) -> None:
        """Add F = (k/l0 - k/|d| + k_d (dv.d)/|d|^2) d to the force on the first end, subtract it on the second (S1 of the model)."""
        vectors = self.vectors
        (x0, p0), (x1, p1) = (self.point(end, column, moving="d" in constants) for end in family)
        d = [vectors.sub(b, a) for a, b in zip(x0, x1, strict=True)]
        inverse = vectors.inverse_root(vectors.dot(d, d, vectors.constant(SHORTEST_SQUARE)))
        slope = vectors.neg(constants["k"])
        if "d" in constants:
            approach = [vectors.sub(b, a) for a, b in zip(p0, p1, strict=True)]
            rate = vectors.dot(approach[1:], d[1:], vectors.mul(approach[0], d[0]))
            slope = vectors.fma(vectors.mul(constants["d"], rate), inverse, slope)
        factor = vectors.fma(slope, inverse, constants["l"])
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

    def accelerations(self, force: list[Any], motion: Any, column: Any) -> list[Any]:
        """F/m + gravity - drag times predicted velocity; zero where anchored."""
        vectors = self.vectors
        inverse_mass = vectors.load(self.data["table"], self.index("table_row", INVERSE_MASS_SLOT, column))
        free = vectors.load(self.data["table"], self.index("table_row", FREE_SLOT, column))
        predicted = self.load(PREDICTED, column) if "drag" in motion else []
        accelerations = []
        for c in _COMPONENTS:
            a = vectors.mul(inverse_mass, force[c])
            field = motion.get(f"gravity_{c}")
            if predicted:
                drag = vectors.mul(motion["drag"], predicted[c])
                field = vectors.neg(drag) if field is None else vectors.sub(field, drag)
            accelerations.append(a if field is None else vectors.fma(free, field, a))
        return accelerations


def _keep(row: _Row, force: list[Any], motion: Any, column: Any) -> None:
    """Store the complete force in the ring."""
    for c in _COMPONENTS:
        row.vectors.store(force[c], row.data["ring"], row.index("ring0", c, column))


def _start(row: _Row, force: list[Any], motion: Any, column: Any) -> None:
    """predicted = v + dt/2 a, x += dt/2 v."""  # noqa: D403
    fma = row.vectors.fma
    a, v, x = row.accelerations(force, motion, column), row.load(VELOCITY, column), row.load(POSITION, column)
    row.store([fma(motion["half"], a[c], v[c]) for c in _COMPONENTS], PREDICTED, column)
    row.store([fma(motion["half"], v[c], x[c]) for c in _COMPONENTS], POSITION, column)


def _step(row: _Row, force: list[Any], motion: Any, column: Any) -> None:
    """v += dt a, predicted = v + dt/2 a, x += dt v."""  # noqa: D403
    vectors = row.vectors
    a, v, x = row.accelerations(force, motion, column), row.load(VELOCITY, column), row.load(POSITION, column)
    v = [vectors.fma(motion["step"], a[c], v[c]) for c in _COMPONENTS]
    row.store(v, VELOCITY, column)
    if "predicted" in row.fields:
        row.store([vectors.fma(motion["half"], a[c], v[c]) for c in _COMPONENTS], PREDICTED, column)
    if "carry" not in row.fields:
        row.store([vectors.fma(motion["step"], v[c], x[c]) for c in _COMPONENTS], POSITION, column)
        return
    # Kahan's sum: what rounding takes from this step's way is added to the next one's.
    carry = row.load(CARRY, column)
    ways = [vectors.fma(motion["step"], v[c], carry[c]) for c in _COMPONENTS]
    ends = [vectors.add(x[c], ways[c]) for c in _COMPONENTS]
    row.store([vectors.sub(ways[c], vectors.sub(ends[c], x[c])) for c in _COMPONENTS], CARRY, column)
    row.store(ends, POSITION, column)


def _generator(velocity: int, first: int, finish: Any) -> Any:
    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        _Row(context, builder, signature, arguments, velocity, first).emit(finish)
        return context.get_dummy_value()

    return generate


def _signature(*kinds: Any) -> Any:
    return types.void(*kinds)


# fmt: off
@intrinsic
def row_forces(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params):  # type: ignore[no-untyped-def]
    """Write a row's complete force [N] to ring row `ring0`; add what its springs do to the next rows to `ring1`, `ring2`.

    `rows` is flat; a row is 3 components of position [m], then 3 of velocity [m/s], `pitch` numbers each, from index `row0`
    on; `row1` and `row2` are the next two. `ring` likewise holds 3 components a row. The row's entry in `table` starts
    at `table_row`. The last of the ring rows that springs reach is overwritten, the others are added to.
    """
    signature = _signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params)
    return signature, _generator(VELOCITY, 0, _keep)


@intrinsic
def row_start(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params):  # type: ignore[no-untyped-def]
    """As `row_forces`, but prepare the row for `row_step`: predicted = v + dt/2 a(x, v), x += dt/2 v.

    A row is 3 components of position, 3 of velocity, 3 of predicted velocity, which must hold v on entry.
    """
    signature = _signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params)
    return signature, _generator(PREDICTED, 0, _start)


@intrinsic
def row_step(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params):  # type: ignore[no-untyped-def]
    """As `row_forces`, but move the row by one step: v += dt a(x, predicted), predicted = v + dt/2 a, x += dt v.

    A row is 3 components of position at the half step, 3 of velocity at the step, 3 of the velocity predicted for the half step (with the
    field `predicted`), 3 of what rounding took from the positions (with the field `carry`).
    """
    signature = _signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params)
    return signature, _generator(PREDICTED, 0, _step)


@intrinsic
def row_above(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params):  # type: ignore[no-untyped-def]
    """The part of `row_step` that concerns the next two rows, with the same bits: for the last row above a band of rows."""
    signature = _signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params)
    return signature, _generator(PREDICTED, 1, None)


@intrinsic
def row_two_above(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params):  # type: ignore[no-untyped-def]
    """The part of `row_step` that concerns the row after the next, with the same bits: for the last row but one above a band."""
    signature = _signature(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params)
    return signature, _generator(PREDICTED, 2, None)
# fmt: on
