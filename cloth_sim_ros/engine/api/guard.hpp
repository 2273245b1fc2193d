// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What every call of the engine runs in, and what it answers; included by library.cpp.
#pragma once

#include <new>

#include "core/fpu_guard.hpp"
#include "plan/plan.hpp"

namespace {

enum Status : int { ok = 0, failed = 1, no_memory = 2, callback_failed = 3, not_finite = 4, busy = 5 };

template <class F>
int guarded(F&& call) {
    try {
        const cloth::FpuGuard rounding;
        call();
        return ok;
    } catch (const std::bad_alloc&) {
        return no_memory;
    } catch (...) {
        return failed;
    }
}
/// A plan serves one call at a time: what it keeps from one to the next would be overwritten.
template <class F>
int guarded(const cloth::Plan* plan, F&& call) {
    if (plan->busy.test_and_set(std::memory_order_acquire)) return busy;
    const int status = guarded(call);
    plan->busy.clear(std::memory_order_release);
    return status;
}

}  // namespace
