// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Velocities of a run at its steps. What a run leaves out, because nothing gets there, depends on them: a particle that
// is slow at both ends of a run may be fast between them.
//
// In a time T a path leaves the straight one between its ends by at most T/4 times the diagonal of the box of the
// particle's velocities: by t (T - t)/T times the difference of the mean velocities before and after t.
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
    /// Set the largest distances [m] from straight paths in a time [s], (n,).
    void deviations(double duration, const std::vector<std::int64_t>& rank, std::vector<double>& out) const {
        for (std::int64_t i = 0; i < count_; ++i) {
            double square = 0.0;
            for (int c = 0; c < 3; ++c) {
                const std::int64_t k = offset(i, c, rank);
                const double width = static_cast<double>(high_[k]) - static_cast<double>(low_[k]);
                square = fma(width, width, square);
            }
            out[i] = 0.25 * duration * root(square);
        }
    }

private:
    std::int64_t offset(std::int64_t i, int c, const std::vector<std::int64_t>& rank) const {
        return in_quads_ ? 4 * rank[i] + c : c * count_ + i;
    }
    std::int64_t count_ = 0;
    bool in_quads_ = false;
    std::vector<T> low_, high_;
};

/// Velocities of a run as needed: bounds of all in each step, and paths of particles in both halves of the run.
class MotionRecord {
public:
    /// Path of all particles in a part of a run: its duration [s], and largest distances from straight paths [m], (n,).
    struct Path {
        double duration;
        std::vector<double> deviations;
    };
    MotionRecord() = default;
    /// `keeps_bounds`: whether bounds in each step are recorded; `n_paths`: number of particles whose paths are, or 0.
    MotionRecord(bool keeps_bounds, std::int64_t n_paths) : keeps_bounds_(keeps_bounds), n_paths_(n_paths) {}
    bool keeps_bounds() const { return keeps_bounds_; }
    bool keeps_paths() const { return n_paths_ > 0; }
    /// Prepare for a run of a number of steps of a size [s] on some threads, with numbers of a type, from positions x0
    /// and velocities v0, (3, n); `rank`: places of particles in quads, empty for rows.
    template <class T>
    void start(std::int64_t steps, double step, int threads, const double* x0, const double* v0,
               const std::vector<std::int64_t>& rank) {
        steps_per_slot_ = steps / max_slots + 1;
        slots_ = steps / steps_per_slot_ + 1;
        bounds<double>().clear(), bounds<float>().clear();
        bounds<T>().assign(keeps_bounds_ ? static_cast<std::size_t>(threads) * slots_ : 0, VelocityBounds<vec<T>>{});
        middle_step_ = steps / 2 - 1, step_ = step, steps_ = steps;
        for (int half = 0; half < 2 && keeps_paths(); ++half) {
            boxes<double>(half).start(0, false), boxes<float>(half).start(0, false);
            boxes<T>(half).start(n_paths_, !rank.empty());
        }
        if (!keeps_paths()) return;
        boxes<T>(0).set(v0, rank);
        // Where the middle is not after a step, it is after the drift at the start.
        middle_.resize(3 * n_paths_);
        for (std::int64_t k = 0; k < 3 * n_paths_; ++k) middle_[k] = fma(0.5 * step, v0[k], x0[k]);
    }
    /// Include the path of a row of particles from the i-th on after a step: positions relative to an origin, and
    /// velocities, whose components are `pitch` apart.
    template <class T>
    void include_row(std::int64_t step, std::int64_t first, std::int64_t columns, const T* x, const T* v,
                     std::int64_t pitch, const double* origin) {
        boxes<T>(step > middle_step_).include_row(step == middle_step_ + 1, first, columns, v, pitch);
        for (int c = 0; c < 3 && step == middle_step_; ++c)
            for (std::int64_t j = 0; j < columns; ++j)
                middle_[c * n_paths_ + first + j] = origin[c] + static_cast<double>(x[c * pitch + j]);
    }
    /// Include the paths of the particles from the first rank to that before the last, in quads, after a step.
    template <class T>
    void include_quads(std::int64_t step, std::int64_t first, std::int64_t last, const T* x, const T* v,
                       const std::vector<std::int64_t>& particle_of_rank, const double* origin) {
        boxes<T>(step > middle_step_).include_quads(step == middle_step_ + 1, first, last, v);
        for (std::int64_t i = first; i < last && step == middle_step_; ++i)
            for (int c = 0; c < 3; ++c)
                middle_[c * n_paths_ + particle_of_rank[i]] = origin[c] + static_cast<double>(x[4 * i + c]);
    }
    /// Positions in the middle of the run [m], (3, n).
    const double* middle() const { return middle_.data(); }
    /// Path to the middle, or from there; `rank`: places of particles in quads.
    Path path(int half, const std::vector<std::int64_t>& rank) const {
        // The middle is half a step after the step's end.
        const double before = (static_cast<double>(middle_step_) + 1.5) * step_;
        Path path{half ? static_cast<double>(steps_) * step_ - before : before, std::vector<double>(n_paths_, 0.0)};
        double_boxes_[half].deviations(path.duration, rank, path.deviations);
        single_boxes_[half].deviations(path.duration, rank, path.deviations);
        return path;
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
    template <class T>
    VelocityBoxes<T>& boxes(int half) {
        if constexpr (sizeof(T) == 8)
            return double_boxes_[half];
        else
            return single_boxes_[half];
    }
    bool keeps_bounds_ = true;
    std::int64_t n_paths_ = 0, steps_per_slot_ = 1, slots_ = 0;
    std::int64_t middle_step_ = 0, steps_ = 0;  ///< last step of the first half; all steps
    double step_ = 0.0;
    std::vector<double> middle_;
    std::vector<VelocityBounds<vec<double>>> double_;  ///< by thread, then by slot
    std::vector<VelocityBounds<vec<float>>> single_;
    VelocityBoxes<double> double_boxes_[2];  ///< by half
    VelocityBoxes<float> single_boxes_[2];
};

}  // namespace cloth::plan
