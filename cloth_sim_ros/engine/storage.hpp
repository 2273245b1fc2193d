// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Aligned arrays, and the state of the floating-point unit that every call of the engine runs in.
#pragma once

#include <cfenv>
#include <new>
#include <vector>

#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

#include "vectors.hpp"

namespace cloth {

template <class T>
struct Aligned {
    using value_type = T;
    static constexpr std::align_val_t alignment{64};
    Aligned() = default;
    template <class U>
    Aligned(const Aligned<U>&) {}
    T* allocate(std::size_t count) { return static_cast<T*>(::operator new(count * sizeof(T), alignment)); }
    void deallocate(T* pointer, std::size_t) { ::operator delete(pointer, alignment); }
    template <class U>
    bool operator==(const Aligned<U>&) const {
        return true;
    }
};
/// An array that begins on a cache line.
template <class T>
using Array = std::vector<T, Aligned<T>>;

/// Rounding to nearest and gradual underflow, whatever the caller has set; restored at the end.
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

}  // namespace cloth
