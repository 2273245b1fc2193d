// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Lists of springs, joints, hinges or panels on any particles, and the order of their evaluation.
#pragma once

#include <algorithm>
#include <numeric>

#include "core/storage.hpp"
#include "laws/all.hpp"

namespace cloth {

enum class Kind : int { spring, joint, crossed, altitude, panel3, panel4 };

/// Call `visit` with the law of a kind.
template <class F>
inline auto with_law(Kind kind, F&& visit) {
    switch (kind) {
        case Kind::spring: return visit(Spring{});
        case Kind::joint: return visit(Joint{});
        case Kind::crossed: return visit(Crossed{});
        case Kind::altitude: return visit(Altitude{});
        case Kind::panel3: return visit(Panel<3>{});
        default: return visit(Panel<4>{});
    }
}

/// Neighbouring elements of a list are evaluated this far apart, so that additions to the force on one particle do not
/// wait for each other.
inline constexpr std::int64_t interleave_stride = 16, chunk = 64;

/// Elements in order of evaluation, padded to whole vectors by elements of zero strength on a dummy particle.
template <class T>
struct Elements {
    std::int64_t count = 0;
    /// Offsets of the particles' quads.
    std::vector<std::uint32_t> corner[4];
    Array<T> param[3];
};

class List {
public:
    List(Kind kind, std::int64_t count, const std::int64_t* corners, const double* params, const double* common)
        : kind(kind), count(count) {
        with_law(kind, [&](auto law) {
            using Law = decltype(law);
            width = Law::corners;
            numbers = Law::params;
        });
        this->corners.assign(corners, corners + count * width);
        if (numbers) this->params.assign(params, params + count * numbers);
        if (common) std::copy(common, common + 5, this->common);
        slow = kind == Kind::crossed || kind == Kind::altitude;
        damped = kind == Kind::panel3 || kind == Kind::panel4;
        for (std::int64_t e = 0; !damped && e < count; ++e) damped = this->params[e * numbers + numbers - 1] != 0.0;
    }

    /// Select the elements with a corner from `first` to before `last`, with particles renumbered by `rank`, in order
    /// of their lowest particle, interleaved. `dummy` is the number of the dummy particle.
    template <class T>
    Elements<T> select(const std::int64_t* rank, std::int64_t dummy, std::int64_t first, std::int64_t last) const {
        std::vector<std::int64_t> lowest(count), order(count);
        for (std::int64_t e = 0; e < count; ++e) {
            lowest[e] = rank[corners[e * width]];
            for (int c = 1; c < width; ++c) lowest[e] = std::min(lowest[e], rank[corners[e * width + c]]);
        }
        std::iota(order.begin(), order.end(), std::int64_t{0});
        std::stable_sort(order.begin(), order.end(), [&](auto a, auto b) { return lowest[a] < lowest[b]; });
        std::vector<std::int64_t> interleaved;
        interleaved.reserve(count);
        const auto in_range = [&](std::int64_t e) {
            for (int c = 0; c < width; ++c)
                if (rank[corners[e * width + c]] >= first && rank[corners[e * width + c]] < last) return true;
            return false;
        };
        for (std::int64_t begin = 0; begin < count; begin += chunk * interleave_stride) {
            const std::int64_t n_in_chunk = std::min(chunk * interleave_stride, count - begin),
                               rows = (n_in_chunk + interleave_stride - 1) / interleave_stride;
            for (std::int64_t i = 0; i < rows; ++i)
                for (std::int64_t j = 0; j < interleave_stride; ++j)
                    if (j * rows + i < n_in_chunk && in_range(order[begin + j * rows + i]))
                        interleaved.push_back(order[begin + j * rows + i]);
        }
        const std::int64_t count = static_cast<std::int64_t>(interleaved.size());
        Elements<T> r;
        r.count = (count + 15) / 16 * 16;
        for (int c = 0; c < width; ++c) {
            r.corner[c].assign(r.count, static_cast<std::uint32_t>(4 * dummy));
            for (std::int64_t k = 0; k < count; ++k)
                r.corner[c][k] = static_cast<std::uint32_t>(4 * rank[corners[interleaved[k] * width + c]]);
        }
        for (int p = 0; p < numbers; ++p) {
            r.param[p].assign(r.count, T(0));
            for (std::int64_t k = 0; k < count; ++k)
                r.param[p][k] = static_cast<T>(params[interleaved[k] * numbers + p]);
        }
        return r;
    }

    Kind kind;
    bool damped = false;
    /// Hinges: they are the most expensive and the slowest elements of a sheet, so runs may evaluate them less often.
    bool slow = false;
    std::int64_t count;
    int width = 0, numbers = 0;
    std::vector<std::int64_t> corners;
    std::vector<double> params;
    double common[5] = {};
};

template <class Law, class V>
inline typename Law::template Params<V> law_params(const V* numbers, const double* common) {
    using T = scalar<V>;
    if constexpr (Law::params == 3)
        return {numbers[0], numbers[1], numbers[2]};
    else if constexpr (Law::params == 2)
        return {numbers[0], numbers[1]};
    else
        return {splat<V>(T(common[0])), splat<V>(T(common[1])),
                Vec3<V>{splat<V>(T(common[2])), splat<V>(T(common[3])), splat<V>(T(common[4]))}};
}

/// Operands of a law for one element of a list at x and v, (3, n) by component.
template <class Law>
struct ElementState {
    Vec3<double> d[Law::corners - 1], u[Law::corners];
    typename Law::template Params<double> params;
    ElementState(const List& list, std::int64_t e, const double* x, const double* v, std::int64_t n)
        : params(law_params<Law, double>(list.params.data() + e * list.numbers, list.common)) {
        const std::int64_t* const p = list.corners.data() + e * list.width;
        const auto at = [n](const double* a, std::int64_t i) { return Vec3<double>{a[i], a[n + i], a[2 * n + i]}; };
        for (int c = 1; c < Law::corners; ++c) {
            d[c - 1] = at(x, p[c]) - at(x, p[0]);
            if constexpr (!Law::absolute_velocities)
                if (v) u[c - 1] = at(v, p[c]) - at(v, p[0]);
        }
        if constexpr (Law::absolute_velocities)
            if (v)
                for (int c = 0; c < Law::corners; ++c) u[c] = at(v, p[c]);
    }
};

}  // namespace cloth
