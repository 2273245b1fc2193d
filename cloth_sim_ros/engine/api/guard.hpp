// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Guard of every call of the C interface: floating-point state, status instead of exceptions, one call per plan.
#pragma once

#include <new>

#include "api/cloth_sim.hpp"
#include "core/fpu_guard.hpp"
#include "plan/plan.hpp"

namespace cloth::api {

template <class F>
int guarded(F&& call) {
    try {
        const FpuGuard rounding;
        call();
        return ok;
    } catch (const std::bad_alloc&) {
        return no_memory;
    } catch (...) {
        return failed;
    }
}
/// A plan is not re-entrant: a second call would overwrite its workspaces.
template <class F>
int guarded(const Plan* plan, F&& call) {
    if (plan->busy.test_and_set(std::memory_order_acquire)) return busy;
    const int status = guarded(call);
    plan->busy.clear(std::memory_order_release);
    return status;
}

}  // namespace cloth::api
