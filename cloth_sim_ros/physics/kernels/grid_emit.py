# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Explicit vectors for numba kernels: a few lines of LLVM IR that read like the formulas.

A loop over springs with forces to both ends does not vectorise by itself, and what does vectorise depends on alias
checks that fail silently. Here the vector operations are written down, through llvmlite, which numba brings along.
LLVM lowers them to whatever the machine has, so nothing here depends on the processor but the width chosen by
`vector_bytes`.

No fast-math freedom is given away except the approximate `1/sqrt` of float32, so that equal input gives equal bits
whatever surrounds the kernel.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir

BLOCK_BYTES = 64
"""Rows are padded to a multiple of this many bytes: one widest vector, one cache line."""

SHORTEST_SQUARE = 1e-30
"""Added to the squared length [m^2]: keeps 1/|d| finite at |d| = 0, and is lost in rounding for any length above
1e-7 m.
"""


@cache
def vector_bytes() -> int:
    """Return the width of the machine's vectors [bytes]: 64, 32 or 16."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 64
    return 32 if features.get("avx2") else 16


class Vectors:
    """Builds vector operations of one element type at the place where `builder` stands.

    `element` is the LLVM type, `itemsize` its size [bytes], `lanes` the number of elements in a vector.
    """

    def __init__(self, builder: Any, itemsize: int) -> None:
        self.builder = builder
        self.itemsize = itemsize
        self.lanes = vector_bytes() // itemsize
        self.element = ir.FloatType() if itemsize == 4 else ir.DoubleType()
        self.type = ir.VectorType(self.element, self.lanes)

    def constant(self, value: float) -> Any:
        """The vector that holds `value` in each lane."""
        return ir.Constant(self.type, [ir.Constant(self.element, value)] * self.lanes)

    def splat(self, scalar: Any) -> Any:
        """The vector that holds an LLVM scalar in each lane."""
        one = self.builder.insert_element(ir.Constant(self.type, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), [ir.Constant(ir.IntType(32), 0)] * self.lanes)
        return self.builder.shuffle_vector(one, ir.Constant(self.type, ir.Undefined), mask)

    def _address(self, data: Any, index: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(data, [index]), self.type.as_pointer())

    def load(self, data: Any, index: Any) -> Any:
        """The `lanes` elements from data[index] on; any alignment."""
        return self.builder.load(self._address(data, index), align=self.itemsize)

    def store(self, value: Any, data: Any, index: Any) -> None:
        """Write a vector to data[index] and on; any alignment."""
        self.builder.store(value, self._address(data, index), align=self.itemsize)

    def add(self, a: Any, b: Any) -> Any:
        """a + b."""
        return self.builder.fadd(a, b)

    def sub(self, a: Any, b: Any) -> Any:
        """a - b."""
        return self.builder.fsub(a, b)

    def mul(self, a: Any, b: Any) -> Any:
        """a * b."""
        return self.builder.fmul(a, b)

    def neg(self, a: Any) -> Any:
        """-a."""
        return self.builder.fneg(a)

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        """a * b + c, with one rounding where the machine has the instruction."""
        return self._call("llvm.fmuladd", self.type, a, b, c)

    def size(self, a: Any) -> Any:
        """|a|."""
        return self._call("llvm.fabs", self.type, a)

    def least(self, a: Any, b: Any) -> Any:
        """The smaller of a and b; of a number and a NaN, the number."""
        return self._call("llvm.minnum", self.type, a, b)

    def dot(self, a: list[Any], b: list[Any], start: Any) -> Any:
        """start + a.b for lists of components."""
        for p, q in zip(a, b, strict=True):
            start = self.fma(p, q, start)
        return start

    def shift(self, previous: Any, current: Any, lanes: int) -> Any:
        """The vector whose lane j holds element j - `lanes` of `current`, the first ones coming from the end of
        `previous`.
        """
        order = [ir.Constant(ir.IntType(32), self.lanes - lanes + j) for j in range(self.lanes)]
        return self.builder.shuffle_vector(
            previous, current, ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), order)
        )

    def inverse_root(self, square: Any) -> Any:
        """1/sqrt(square), to the last bit or two of the element type.

        float32: left to LLVM with leave to use the machine's estimate and a Newton step. float64: that, followed by one
        third-order step r (1 + e/2 + 3 e^2/8), e = 1 - square r^2, which takes 2^-22 to below 2^-60.
        """
        if self.itemsize == 4:
            return self._estimate(square, self.type)
        narrow = ir.VectorType(ir.FloatType(), self.lanes)
        root = self.builder.fpext(self._estimate(self.builder.fptrunc(square, narrow), narrow), self.type)
        error = self.fma(self.neg(self.mul(square, root)), root, self.constant(1.0))
        correction = self.mul(error, self.fma(error, self.constant(0.375), self.constant(0.5)))
        return self.fma(root, correction, root)

    def _estimate(self, square: Any, kind: Any) -> Any:
        root = self._call("llvm.sqrt", kind, square, flags=("fast",))
        one = ir.Constant(kind, [ir.Constant(ir.FloatType(), 1.0)] * self.lanes)
        return self.builder.fdiv(one, root, flags=("fast",))

    def _call(self, name: str, kind: Any, *arguments: Any, flags: tuple[str, ...] = ()) -> Any:
        module = self.builder.module
        full = f"{name}.v{kind.count}f{32 if kind.element == ir.FloatType() else 64}"
        function = module.globals.get(full) or ir.Function(module, ir.FunctionType(kind, [kind] * len(arguments)), full)
        return self.builder.call(function, list(arguments), fastmath=flags)
