# Copyright 2026 the cloth_sim_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counters by which compiled loops of several threads share out work, a fraction of a microsecond at a time."""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


def _place(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    return builder.gep(data, [arguments[1]])


@intrinsic
def load_acquire(typing, counters, index):  # type: ignore[no-untyped-def]
    """counters[index], and all that its writer wrote before it. `counters` is int64."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.load_atomic(_place(context, builder, signature, arguments), ordering="acquire", align=8)

    return types.int64(counters, types.intp), generate


@intrinsic
def store_release(typing, counters, index, value):  # type: ignore[no-untyped-def]
    """counters[index] = value, after all that was written before. `counters` is int64."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        place = _place(context, builder, signature, arguments)
        builder.store_atomic(arguments[2], place, ordering="release", align=8)
        return context.get_dummy_value()

    return types.void(counters, types.intp, types.int64), generate


@intrinsic
def claim(typing, counters, index):  # type: ignore[no-untyped-def]
    """Set counters[index] to 1 if it was 0, at once for all threads; tell whether it was. `counters` is int64."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        place = _place(context, builder, signature, arguments)
        free, taken = ir.Constant(ir.IntType(64), 0), ir.Constant(ir.IntType(64), 1)
        return builder.extract_value(builder.cmpxchg(place, free, taken, "acquire", "monotonic"), 1)

    return types.boolean(counters, types.intp), generate


@intrinsic
def pause(typing):  # type: ignore[no-untyped-def]
    """Tell the processor that this is a waiting loop, where it has a word for that."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        if llvm.get_process_triple().startswith("x86_64"):
            kind = ir.FunctionType(ir.VoidType(), [])
            module = builder.module
            builder.call(
                module.globals.get("llvm.x86.sse2.pause") or ir.Function(module, kind, "llvm.x86.sse2.pause"), []
            )
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def yield_processor(typing):  # type: ignore[no-untyped-def]
    """Let another thread have this core: sched_yield of the C library."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        module = builder.module
        kind = ir.FunctionType(ir.IntType(32), [])
        builder.call(module.globals.get("sched_yield") or ir.Function(module, kind, "sched_yield"), [])
        return context.get_dummy_value()

    return types.void(), generate
