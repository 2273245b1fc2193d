// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Arrays aligned to cache lines.
#pragma once

#include <new>
#include <vector>

#include "core/simd.hpp"

namespace cloth::inline core {

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

}  // namespace cloth::inline core
