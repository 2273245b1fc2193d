// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Velocities of a run at its steps. What a run leaves out, because nothing gets there, depends on them: a particle that
// is slow at both ends of a run may be fast between them.
#pragma once

#include <limits>
#include <vector>

#include "core/algebra.hpp"

namespace cloth::plan {

/// Bounds of the components of velocities, by lane.
template <class V>
struct VelocityBounds {
    static constexpr scalar<V> infinity = std::numeric_limits<scalar<V>>::infinity();
    Vec3<V> low{splat<V>(infinity), splat<V>(infinity), splat<V>(infinity)}, high = -low;
    CLOTH_INLINE void include(const Vec3<V>& a, const Vec3<V>& b) {
        low = {smaller(a.x, low.x), smaller(a.y, low.y), smaller(a.z, low.z)};
        high = {larger(b.x, high.x), larger(b.y, high.y), larger(b.z, high.z)};
    }
    CLOTH_INLINE void include(const Vec3<V>& v) { include(v, v); }
    CLOTH_INLINE void include(const VelocityBounds& other) { include(other.low, other.high); }
    /// Upper bound of the squared speed, by lane.
    CLOTH_INLINE V max_square() const {
        return norm2(Vec3<V>{larger(absolute(low.x), absolute(high.x)), larger(absolute(low.y), absolute(high.y)),
                             larger(absolute(low.z), absolute(high.z))});
    }
};

/// Bounds of the velocities of all particles in each step of a run.
class MotionRecord {
public:
    /// Prepare for a run of a number of steps on some threads, with numbers of a type.
    template <class T>
    void start(std::int64_t steps, int threads) {
        steps_per_slot_ = steps / max_slots + 1;
        slots_ = steps / steps_per_slot_ + 1;
        bounds<double>().clear(), bounds<float>().clear();
        bounds<T>().assign(static_cast<std::size_t>(threads) * slots_, VelocityBounds<vec<T>>{});
    }
    /// Include velocities after a step on a thread; steps before the first do not count.
    template <class T>
    CLOTH_INLINE void include(int thread, std::int64_t step, const VelocityBounds<vec<T>>& added) {
        if (step >= 0) bounds<T>()[thread * slots_ + step / steps_per_slot_].include(added);
    }
    /// Upper bound of the speed [m/s] in any step.
    double max_speed() const {
        double square = 0.0;
        for_each_slot([&](const VelocityBounds<double>& all) { square = larger(all.max_square(), square); });
        return root(square);
    }
    /// Upper bound of the relative speed of two particles [m/s] in any step.
    double max_relative_speed() const {
        double square = 0.0;
        for_each_slot([&](const VelocityBounds<double>& all) { square = larger(norm2(all.high - all.low), square); });
        return root(square);
    }

private:
    /// Long runs have one slot for several steps.
    static constexpr std::int64_t max_slots = 4096;

    template <class T>
    std::vector<VelocityBounds<vec<T>>>& bounds() {
        if constexpr (sizeof(T) == 8)
            return double_;
        else
            return single_;
    }
    /// Call `visit` with the bounds of all threads in each slot that has any.
    template <class F>
    void for_each_slot(F&& visit) const {
        const auto visit_all = [&](const auto& list) {
            for (std::int64_t slot = 0; slot < slots_ && !list.empty(); ++slot) {
                VelocityBounds<double> all;
                for (std::size_t at = slot; at < list.size(); at += slots_)
                    for (std::size_t k = 0; k < sizeof(list[at].low.x) / sizeof(list[at].low.x[0]); ++k) {
                        const auto lane = [k](const auto& v) {
                            return Vec3<double>{double(v.x[k]), double(v.y[k]), double(v.z[k])};
                        };
                        all.include(lane(list[at].low), lane(list[at].high));
                    }
                if (all.low.x <= all.high.x) visit(all);
            }
        };
        visit_all(double_);
        visit_all(single_);
    }
    std::int64_t steps_per_slot_ = 1, slots_ = 0;
    std::vector<VelocityBounds<vec<double>>> double_;  ///< by thread, then by slot
    std::vector<VelocityBounds<vec<float>>> single_;
};

}  // namespace cloth::plan
