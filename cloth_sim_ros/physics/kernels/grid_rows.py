# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One row of a regular sheet: the forces of its springs, and one leapfrog step of its particles.

A row owns the springs that lead from it to the right and down (`FAMILIES`). Their forces on this row, on the next and on the one
after are summed in a ring of three force rows. As rows are taken in order, and none looks back, a row's force is complete when its
own springs are done, and its particles can move at once: `row_step` reads and writes each number once a step.

Which springs exist, whether they are damped, whether there is drag or gravity, is read off the *type* of `params`: a structured array of
one record whose field names list what the scene has. Numba compiles one version for each such type; what has no field has no
instruction.

Fields of `params`: for a spring family `NAME_SLOT_k` (k_s [N]), `NAME_SLOT_l` (k_s/rest length [N/m]) and, if damped, `NAME_SLOT_d` (k_d
[N s/m]), SLOT being the place of its weights in a row of the table; `step` and `half` (dt, dt/2 [s]); `drag` [1/s]; `gravity_0`, `_1`,
`_2` [m/s^2]; `predicted` if forces depend on velocity.

The table holds rows of `pitch` columns: slot 0 inverse masses [1/kg], slot 1 one for a free particle and zero for an anchored one, then
the weights of the families. A weight belongs to the column in which the spring's leftmost end lies, and is zero where there is none.
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

_COMPONENTS = range(3)


class _Row:
    """The emitter of one row's loop: arguments in, instructions out."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any, *, mode: str) -> None:
        self.context, self.builder, self.mode = context, builder, mode
        kinds = dict(zip(_ARGUMENTS, signature.args, strict=True))
        self.values = dict(zip(_ARGUMENTS, arguments, strict=True))
        self.data = {
            name: context.make_array(kinds[name])(context, builder, self.values[name]).data
            for name in ("rows", "table", "ring", "params")
        }
        self.record = kinds["params"].dtype
        self.vectors = Vectors(builder, 4 if kinds["rows"].dtype == types.float32 else 8)
        self.families = [
            (name, int(slot))
            for name, slot, last in (field.rsplit("_", 2) for field in self.record.fields if field[-2:] == "_k")
        ]
        self.predicts = "predicted" in self.record.fields

    def param(self, field: str) -> Any:
        """The value of a field in each lane."""
        bytes_at = self.builder.bitcast(self.data["params"], ir.IntType(8).as_pointer())
        place = self.builder.gep(bytes_at, [self.integer(self.record.offset(field))])
        return self.vectors.splat(self.builder.load(self.builder.bitcast(place, self.vectors.element.as_pointer())))

    def integer(self, value: int) -> Any:
        return self.context.get_constant(types.intp, value)

    def index(self, origin: str, slot: int, column: Any, columns: int = 0) -> Any:
        """Place of component or slot `slot` of the row that starts at the argument `origin`."""
        start = self.builder.add(self.values[origin], self.builder.mul(self.values["pitch"], self.integer(slot)))
        return self.builder.add(start, self.builder.add(column, self.integer(columns)))

    def emit(self) -> None:
        """Emit the loop over the row's vectors."""
        fields = self.record.fields
        springs = [
            (
                FAMILIES[name],
                slot,
                {part: self.param(f"{name}_{slot}_{part}") for part in "kld" if f"{name}_{slot}_{part}" in fields},
            )
            for name, slot in self.families
        ]
        motion = {} if self.mode == "force" else {name: self.param(name) for name in _MOTION if name in fields}
        shifted = sorted({end for family, _, _ in springs for end in family if end[1] > 0})
        zero = self.vectors.constant(0.0)
        before = {end: [cgutils.alloca_once_value(self.builder, zero) for _ in _COMPONENTS] for end in shifted}
        lanes = self.integer(self.vectors.lanes)
        with cgutils.for_range(self.builder, self.builder.sdiv(self.values["pitch"], lanes)) as loop:
            column = self.builder.mul(loop.index, lanes)
            total = self.sum_forces(springs, before, column)
            if self.mode == "step":
                self.move(total, motion, column)
            elif self.mode == "start":
                self.start(total, motion, column)
            else:
                for c in _COMPONENTS:
                    self.vectors.store(total[c], self.data["ring"], self.index("ring0", c, column))

    def sum_forces(self, springs: Any, before: Any, column: Any) -> list[Any]:
        """Evaluate the springs of one vector of columns; return this row's complete force, store the next rows' partial ones."""
        vectors, builder = self.vectors, self.builder
        forces: dict[tuple[int, int], list[Any]] = {}
        for family, slot, param in springs:
            self.add_spring(forces, family, slot, param, column)
        # Without springs to lower rows the next ring row is started all the same: a grip may add to it.
        deepest = max((1, *(end[0] for end in forces)))
        total: list[Any] = []
        for row in range(deepest + 1):
            for c in _COMPONENTS:
                place = self.index(f"ring{row}", c, column)
                value = vectors.load(self.data["ring"], place) if row < deepest else None
                for end in sorted(end for end in forces if end[0] == row):
                    part = forces[end][c]
                    if end[1] > 0:
                        last = builder.load(before[end][c])
                        builder.store(part, before[end][c])
                        part = vectors.shift(last, part, end[1])
                    value = part if value is None else vectors.add(value, part)
                if row == 0:
                    total.append(value)
                else:
                    vectors.store(vectors.constant(0.0) if value is None else value, self.data["ring"], place)
        return total

    def add_spring(self, forces: Any, family: Family, slot: int, param: Any, column: Any) -> None:
        """Add to `forces` by end: F = (k/l0 - k/|d| + k_d (dv.d)/|d|^2) d on the first end, -F on the second (S1 of the model)."""
        vectors = self.vectors
        (x0, p0), (x1, p1) = (self.point(end, column, velocity="d" in param) for end in family)
        d = [vectors.sub(b, a) for a, b in zip(x0, x1, strict=True)]
        inverse = vectors.inverse_root(vectors.dot(d, d, vectors.constant(SHORTEST_SQUARE)))
        slope = vectors.neg(param["k"])
        if "d" in param:
            approach = [vectors.sub(b, a) for a, b in zip(p0, p1, strict=True)]
            rate = vectors.mul(approach[0], d[0])
            rate = vectors.dot(approach[1:], d[1:], rate)
            slope = vectors.fma(vectors.mul(param["d"], rate), inverse, slope)
        factor = vectors.fma(slope, inverse, param["l"])
        factor = vectors.mul(factor, vectors.load(self.data["table"], self.index("table_row", slot, column)))
        back = vectors.neg(factor)
        for end, sign in zip(family, (factor, back), strict=True):
            if end in forces:
                forces[end] = [vectors.fma(sign, q, f) for q, f in zip(d, forces[end], strict=True)]
            else:
                forces[end] = [vectors.mul(sign, q) for q in d]

    def point(self, end: tuple[int, int], column: Any, *, velocity: bool) -> tuple[list[Any], list[Any]]:
        """Positions, and velocities where wanted, of the particles at a spring's end. Repeated loads are merged by LLVM."""
        row = f"row{end[0]}"
        positions = [self.vectors.load(self.data["rows"], self.index(row, c, column, end[1])) for c in _COMPONENTS]
        if not velocity:
            return positions, []
        slot = 6 if self.mode == "step" else 3
        return positions, [
            self.vectors.load(self.data["rows"], self.index(row, slot + c, column, end[1])) for c in _COMPONENTS
        ]

    def accelerations(self, force: list[Any], motion: Any, column: Any, slot: int) -> list[Any]:
        """F/m + gravity - drag times the velocity in `slot`; zero where anchored."""
        vectors = self.vectors
        inverse_mass = vectors.load(self.data["table"], self.index("table_row", INVERSE_MASS_SLOT, column))
        free = vectors.load(self.data["table"], self.index("table_row", FREE_SLOT, column))
        accelerations = []
        for c in _COMPONENTS:
            a = vectors.mul(inverse_mass, force[c])
            field = motion.get(f"gravity_{c}")
            if "drag" in motion:
                drag = vectors.mul(
                    motion["drag"], vectors.load(self.data["rows"], self.index("row0", slot + c, column))
                )
                field = vectors.neg(drag) if field is None else vectors.sub(field, drag)
            accelerations.append(a if field is None else vectors.fma(free, field, a))
        return accelerations

    def move(self, force: list[Any], motion: Any, column: Any) -> None:
        """v += dt a, predicted = v + dt/2 a, x += dt v for one vector of columns."""
        vectors, rows = self.vectors, self.data["rows"]
        for c, a in enumerate(self.accelerations(force, motion, column, 6)):
            x_at, v_at, p_at = (self.index("row0", slot + c, column) for slot in (0, 3, 6))
            v = vectors.fma(motion["step"], a, vectors.load(rows, v_at))
            vectors.store(v, rows, v_at)
            if self.predicts:
                vectors.store(vectors.fma(motion["half"], a, v), rows, p_at)
            vectors.store(vectors.fma(motion["step"], v, vectors.load(rows, x_at)), rows, x_at)

    def start(self, force: list[Any], motion: Any, column: Any) -> None:
        """predicted = v + dt/2 a, x += dt/2 v for one vector of columns."""
        vectors, rows = self.vectors, self.data["rows"]
        for c, a in enumerate(self.accelerations(force, motion, column, 3)):
            x_at, v_at, p_at = (self.index("row0", slot + c, column) for slot in (0, 3, 6))
            v = vectors.load(rows, v_at)
            vectors.store(vectors.fma(motion["half"], a, v), rows, p_at)
            vectors.store(vectors.fma(motion["half"], v, vectors.load(rows, x_at)), rows, x_at)


_MOTION = ("step", "half", "drag", "gravity_0", "gravity_1", "gravity_2")
_ARGUMENTS = (
    "rows",
    "row0",
    "row1",
    "row2",
    "pitch",
    "table",
    "table_row",
    "ring",
    "ring0",
    "ring1",
    "ring2",
    "params",
)


def _emitter(mode: str) -> Any:
    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        _Row(context, builder, signature, arguments, mode=mode).emit()
        return context.get_dummy_value()

    return generate


@intrinsic
def row_forces(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params):  # type: ignore[no-untyped-def]
    """Write a row's complete force [N] to ring row `ring0`; add what its springs exert on the next rows to `ring1`, `ring2`.

    `rows` is flat; a row is 3 components of position [m], then 3 of velocity [m/s], `pitch` numbers each, from index `row0` on; `row1` and `row2`
    are the next two. `ring` likewise holds 3 components a row. The row's entry in `table` starts at `table_row`. The last of the ring rows that the springs
    reach is overwritten, the others are added to.
    """
    signature = types.void(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params)
    return signature, _emitter("force")


@intrinsic
def row_start(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params):  # type: ignore[no-untyped-def]
    """As `row_forces`, but prepare the row for `row_step`: predicted = v + dt/2 a(x, v), x += dt/2 v.

    A row is 3 components of position, 3 of velocity, 3 of the velocity predicted for the half step.
    """
    signature = types.void(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params)
    return signature, _emitter("start")


@intrinsic
def row_step(typing, rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params):  # type: ignore[no-untyped-def]
    """As `row_forces`, but move the row by one step: v += dt a(x, predicted), predicted = v + dt/2 a, x += dt v.

    A row is 3 components of position at the half step, 3 of velocity at the step and, where `params` has the field `predicted`, 3 of the
    velocity predicted for the half step.
    """
    signature = types.void(rows, row0, row1, row2, pitch, table, table_row, ring, ring0, ring1, ring2, params)
    return signature, _emitter("step")
