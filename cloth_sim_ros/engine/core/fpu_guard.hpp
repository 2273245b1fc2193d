// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// State of the floating-point unit inside a call of the engine.
#pragma once

#include <cstdint>

#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

namespace cloth::inline core {

/// Sets round to nearest and gradual underflow, and restores the caller's state at the end.
class FpuGuard {
public:
    FpuGuard() {
#if defined(__x86_64__)
        saved_ = _mm_getcsr();
        _mm_setcsr(0x1f80);
#elif defined(__aarch64__)
        __asm__ __volatile__("mrs %0, fpcr" : "=r"(saved_));
        __asm__ __volatile__("msr fpcr, %0" : : "r"(std::uint64_t{0}));
#endif
    }
    ~FpuGuard() {
#if defined(__x86_64__)
        _mm_setcsr(saved_);
#elif defined(__aarch64__)
        __asm__ __volatile__("msr fpcr, %0" : : "r"(saved_));
#endif
    }
    FpuGuard(const FpuGuard&) = delete;
    FpuGuard& operator=(const FpuGuard&) = delete;

private:
#if defined(__x86_64__)
    unsigned saved_;
#else
    std::uint64_t saved_ = 0;
#endif
};

}  // namespace cloth::inline core
