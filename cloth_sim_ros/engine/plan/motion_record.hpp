// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Velocities of a run at its steps. What a run leaves out, because nothing gets there, depends on them: a particle that
// is slow at both ends of a run may be fast between them.
//
// A path of a velocity v(t) leaves the one of constant velocity v(0) by at most the integral of |v - v(0)|. In a time T
// it leaves the straight one between its ends by at most T/4 times the diameter of the set of all v(t): by t (T - t)/T
// times the difference of the mean velocities before and after t. Both hold for differences of two particles, too.
#pragma once

#include <array>
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

/// Box of the velocities of each particle in a part of a run, in rows by component, or in quads by rank.
template <class T>
class VelocityBoxes {
public:
    /// Prepare for n particles; 0 for none.
    void start(std::int64_t n, bool in_quads) {
        count_ = n, in_quads_ = in_quads;
        low_.resize(4 * n), high_.resize(4 * n);
    }
    /// Set the boxes to velocities (3, n); `rank`: places of particles in quads.
    void set(const double* v, const std::vector<std::int64_t>& rank) {
        for (int c = 0; c < 3; ++c)
            for (std::int64_t i = 0; i < count_; ++i)
                low_[offset(i, c, rank)] = high_[offset(i, c, rank)] = static_cast<T>(v[c * count_ + i]);
    }
    /// Include the velocities of a row of particles from the i-th on, whose components are `pitch` apart; or set them.
    void include_row(bool sets, std::int64_t first, std::int64_t columns, const T* v, std::int64_t pitch) {
        for (int c = 0; c < 3; ++c) {
            T *const low = low_.data() + c * count_ + first, *const high = high_.data() + c * count_ + first;
            const T* const from = v + c * pitch;
            if (sets) {
                std::copy_n(from, columns, low);
                std::copy_n(from, columns, high);
                continue;
            }
            if (columns < lanes<T>) {
                for (std::int64_t j = 0; j < columns; ++j)
                    low[j] = smaller(from[j], low[j]), high[j] = larger(from[j], high[j]);
                continue;
            }
            // The last vector overlaps the one before. It is loaded first: a load from two stores would wait for both.
            const std::int64_t tail = columns - lanes<T>;
            const vec<T> last = load(from + tail), last_low = smaller(last, load(low + tail)),
                         last_high = larger(last, load(high + tail));
            for (std::int64_t j = 0; j < tail; j += lanes<T>) {
                const vec<T> a = load(from + j);
                store(low + j, smaller(a, load(low + j)));
                store(high + j, larger(a, load(high + j)));
            }
            store(low + tail, last_low);
            store(high + tail, last_high);
        }
    }
    /// Include the velocities, in quads, of the particles from the first to that before the last; or set them.
    void include_quads(bool sets, std::int64_t first, std::int64_t last, const T* v) {
        for (std::int64_t i = 4 * first; i < 4 * last; i += 4) {
            const quad<T> a = load4(v + i);
            store4(low_.data() + i, sets ? a : quad<T>(smaller(a, load4(low_.data() + i))));
            store4(high_.data() + i, sets ? a : quad<T>(larger(a, load4(high_.data() + i))));
        }
    }
    /// Set the largest distances of particles [m], (n,), from straight paths in a time [s].
    void deviations(double duration, const std::vector<std::int64_t>& rank, std::vector<double>& out) const {
        if (!count_) return;
        out.assign(count_, 0.0);
        for (int c = 0; c < 3; ++c)
            for (std::int64_t i = 0; i < count_; ++i) {
                const std::int64_t k = in_quads_ ? 4 * rank[i] + c : c * count_ + i;
                const double width = static_cast<double>(high_[k]) - static_cast<double>(low_[k]);
                out[i] = fma(width, width, out[i]);
            }
        for (double& deviation : out) deviation = 0.25 * duration * root(deviation);
    }

private:
    std::int64_t offset(std::int64_t i, int c, const std::vector<std::int64_t>& rank) const {
        return in_quads_ ? 4 * rank[i] + c : c * count_ + i;
    }
    std::int64_t count_ = 0;
    bool in_quads_ = false;
    std::vector<T> low_, high_;
};

/// Bounds of all particles in each step of a run, by thread.
class StepBounds {
public:
    /// Prepare for a number of steps on some threads, with numbers of a type.
    template <class T>
    void start(std::int64_t steps, int threads) {
        steps_per_slot_ = steps / max_slots + 1;
        slots_ = steps / steps_per_slot_ + 1;
        double_.clear(), single_.clear();
        bounds<T>().assign(static_cast<std::size_t>(threads) * slots_, VelocityBounds<vec<T>>{});
    }
    /// Include bounds after a step on a thread; steps before the first do not count.
    template <class T>
    CLOTH_INLINE void include(int thread, std::int64_t step, const VelocityBounds<vec<T>>& added) {
        if (step >= 0) bounds<T>()[thread * slots_ + step / steps_per_slot_].include(added);
    }
    std::int64_t steps_per_slot() const { return steps_per_slot_; }
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
    std::int64_t steps_per_slot_ = 1, slots_ = 0;
    std::vector<VelocityBounds<vec<double>>> double_;  ///< by thread, then by slot
    std::vector<VelocityBounds<vec<float>>> single_;
};

/// What a run records: bounds of all velocities in each step, bounds of their changes since the start, and the box of
/// each particle's velocities in both halves of the run.
struct MotionNeeds {
    bool velocities = false, changes = false, paths = false;
};

/// Velocities of a run as needed: bounds of all in each step, and paths of particles in both halves of the run.
class MotionRecord {
public:
    /// Record this in the next run.
    void record(const MotionNeeds& needs) { needs_ = needs; }
    bool keeps_velocities() const { return needs_.velocities; }
    bool keeps_changes() const { return needs_.changes; }
    bool keeps_paths() const { return needs_.paths; }
    /// Prepare for a run of n particles and a number of steps of a size [s] on some threads, with numbers of a type,
    /// from positions x0 and velocities v0, (3, n); `rank`: places of particles in quads, empty for rows.
    template <class T>
    void start(std::int64_t n, std::int64_t steps, double step, int threads, const double* x0, const double* v0,
               const std::vector<std::int64_t>& rank) {
        if (keeps_velocities()) velocities_.start<T>(steps, threads);
        if (keeps_changes()) {
            changes_.start<T>(steps, threads);
            std::vector<T>& start = start_velocities_vector<T>();
            start.assign(rank.empty() ? 3 * n : 4 * n, T(0));
            for (int c = 0; c < 3; ++c)
                for (std::int64_t i = 0; i < n; ++i)
                    start[rank.empty() ? c * n + i : 4 * rank[i] + c] = static_cast<T>(v0[c * n + i]);
        }
        count_ = n, middle_step_ = steps / 2 - 1, step_ = step, steps_ = steps;
        for (int half = 0; half < 2 && keeps_paths(); ++half) {
            boxes<double>(half).start(0, false), boxes<float>(half).start(0, false);
            boxes<T>(half).start(n, !rank.empty());
        }
        if (!keeps_paths()) return;
        boxes<T>(0).set(v0, rank);
        // Where the middle is not after a step, it is after the drift at the start.
        middle_.resize(3 * n);
        for (std::int64_t k = 0; k < 3 * n; ++k) middle_[k] = fma(0.5 * step, v0[k], x0[k]);
    }
    /// Velocities at the start, in rows by component, or in quads by rank.
    template <class T>
    const T* start_velocities() const {
        return const_cast<MotionRecord*>(this)->start_velocities_vector<T>().data();
    }
    /// Include the path of a row of particles from the i-th on after a step: positions relative to an origin, and
    /// velocities, whose components are `pitch` apart.
    template <class T>
    void include_row(std::int64_t step, std::int64_t first, std::int64_t columns, const T* x, const T* v,
                     std::int64_t pitch, const double* origin) {
        boxes<T>(step > middle_step_).include_row(step == middle_step_ + 1, first, columns, v, pitch);
        for (int c = 0; c < 3 && step == middle_step_; ++c)
            for (std::int64_t j = 0; j < columns; ++j)
                middle_[c * count_ + first + j] = origin[c] + static_cast<double>(x[c * pitch + j]);
    }
    /// Include the paths of the particles from the first rank to that before the last, in quads, after a step.
    template <class T>
    void include_quads(std::int64_t step, std::int64_t first, std::int64_t last, const T* x, const T* v,
                       const std::vector<std::int64_t>& particle_of_rank, const double* origin) {
        boxes<T>(step > middle_step_).include_quads(step == middle_step_ + 1, first, last, v);
        for (std::int64_t i = first; i < last && step == middle_step_; ++i)
            for (int c = 0; c < 3; ++c)
                middle_[c * count_ + particle_of_rank[i]] = origin[c] + static_cast<double>(x[4 * i + c]);
    }
    /// Positions in the middle of the run [m], (3, n).
    const double* middle() const { return middle_.data(); }
    /// Largest distances of particles [m], (n,), from straight paths to the middle, and from there; `rank`: places of
    /// particles in quads.
    const std::array<std::vector<double>, 2>& half_deviations(const std::vector<std::int64_t>& rank) {
        // The middle is half a step after the step's end.
        const double before = (static_cast<double>(middle_step_) + 1.5) * step_;
        for (int half = 0; half < 2; ++half) {
            const double duration = half ? static_cast<double>(steps_) * step_ - before : before;
            double_boxes_[half].deviations(duration, rank, half_deviations_[half]);
            single_boxes_[half].deviations(duration, rank, half_deviations_[half]);
        }
        return half_deviations_;
    }
    /// Include bounds of velocities, and of their changes, after a step on a thread.
    template <class T>
    CLOTH_INLINE void include_velocities(int thread, std::int64_t step, const VelocityBounds<vec<T>>& added) {
        velocities_.include<T>(thread, step, added);
    }
    template <class T>
    CLOTH_INLINE void include_changes(int thread, std::int64_t step, const VelocityBounds<vec<T>>& added) {
        changes_.include<T>(thread, step, added);
    }
    /// Upper bound of the speed [m/s] in any step.
    double max_speed() const {
        double square = 0.0;
        velocities_.for_each_slot([&](const auto& all) { square = larger(all.max_square(), square); });
        return root(square);
    }
    /// Upper bound of the relative speed of two particles [m/s] in any step.
    double max_relative_speed() const {
        double square = 0.0;
        velocities_.for_each_slot([&](const auto& all) { square = larger(norm2(all.high - all.low), square); });
        return root(square);
    }
    /// Upper bound of the change of the relative velocity of two particles [m/s] since the start, in any step.
    double max_relative_change() const {
        double square = 0.0;
        changes_.for_each_slot([&](const auto& all) { square = larger(norm2(all.high - all.low), square); });
        return root(square);
    }
    /// Upper bound of the distance [m] by which two particles together leave paths of their velocities at the start.
    double max_relative_deviation() const {
        double sum = 0.0;
        changes_.for_each_slot([&](const auto& all) { sum += root(norm2(all.high - all.low)); });
        return static_cast<double>(changes_.steps_per_slot()) * step_ * sum;
    }

private:
    template <class T>
    std::vector<T>& start_velocities_vector() {
        if constexpr (sizeof(T) == 8)
            return double_start_;
        else
            return single_start_;
    }
    template <class T>
    VelocityBoxes<T>& boxes(int half) {
        if constexpr (sizeof(T) == 8)
            return double_boxes_[half];
        else
            return single_boxes_[half];
    }
    MotionNeeds needs_;
    std::int64_t count_ = 0, middle_step_ = 0,
                 steps_ = 0;  ///< number of particles; last step of the first half; all steps
    double step_ = 0.0;
    StepBounds velocities_, changes_;
    std::vector<double> double_start_, middle_;
    std::vector<float> single_start_;
    std::array<std::vector<double>, 2> half_deviations_;
    VelocityBoxes<double> double_boxes_[2];  ///< by half
    VelocityBoxes<float> single_boxes_[2];
};

}  // namespace cloth::plan
