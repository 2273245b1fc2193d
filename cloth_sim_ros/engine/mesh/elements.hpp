// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Lists of springs, joints, membranes, hinges or panels on any particles, and the order of their evaluation.
#pragma once

#include <algorithm>
#include <numeric>

#include "core/storage.hpp"

namespace cloth::mesh {

enum class Kind : int {
    spring,
    joint,
    crossed,
    altitude,
    panel3,
    panel4,
    edge_edge,
    point_face,
    membrane,
    mass3,
    mass4,
    quadratic,
    stiffening_membrane,
    bending_friction,
    coupling
};
/// Whether elements are panels of air, which have common parameters alone.
inline constexpr bool is_panel(Kind kind) { return kind == Kind::panel3 || kind == Kind::panel4; }
/// Whether elements are panels with added mass.
inline constexpr bool is_mass(Kind kind) { return kind == Kind::mass3 || kind == Kind::mass4; }
/// Whether elements have a state, the plastic length: their first parameter, which runs move.
inline constexpr bool is_plastic(Kind kind) { return kind == Kind::bending_friction; }
inline constexpr bool is_membrane(Kind kind) { return kind == Kind::membrane || kind == Kind::stiffening_membrane; }
/// Whether the damping of all elements is their stiffness times one time.
inline constexpr bool has_damping_time(Kind kind) { return kind == Kind::quadratic || kind == Kind::coupling; }
/// Number of particles of an element, and of parameters of its own.
inline constexpr int corners_of(Kind kind) {
    if (kind == Kind::panel3 || kind == Kind::mass3 || is_membrane(kind)) return 3;
    return kind == Kind::spring || kind == Kind::joint || kind == Kind::coupling ? 2 : 4;
}
inline constexpr int params_of(Kind kind) {
    if (is_panel(kind) || is_mass(kind)) return 0;
    if (kind == Kind::quadratic) return 4;
    if (kind == Kind::coupling) return 1;
    return kind == Kind::joint ? 2 : is_membrane(kind) ? 6 : 3;
}
/// Number of parameters that all elements of a list have in common.
inline constexpr int common_of(Kind kind) {
    if (kind == Kind::stiffening_membrane) return 14;
    if (has_damping_time(kind)) return 1;
    return is_panel(kind) || is_mass(kind) ? 5 : kind == Kind::membrane ? 8 : 0;
}
inline constexpr int max_params = 6, max_common = 14;

/// Neighbouring elements of a list are evaluated this far apart, so that additions to the force on one particle do not
/// wait for each other.
inline constexpr std::int64_t interleave_stride = 16, chunk = 64;

/// Elements in order of evaluation, padded to whole vectors by elements of zero strength on a dummy particle.
template <class T>
struct Elements {
    std::int64_t count = 0;
    /// Offsets of the particles' quads.
    std::vector<std::uint32_t> corner[4];
    Array<T> param[max_params];
    /// Plastic elements: the index of each in its list, without padding.
    std::vector<std::int64_t> source;
};

class List {
public:
    List(Kind kind, std::int64_t count, const std::int64_t* corners, const double* params, const double* common)
        : kind(kind), count(count), width(corners_of(kind)), numbers(params_of(kind)) {
        this->corners.assign(corners, corners + count * width);
        if (numbers) this->params.assign(params, params + count * numbers);
        if (common) std::copy(common, common + common_of(kind), this->common);
        slow = kind == Kind::crossed || kind == Kind::altitude;
        // A plastic length follows the velocities.
        damped =
            is_panel(kind) || is_mass(kind) || is_plastic(kind) || (has_damping_time(kind) && this->common[0] > 0.0);
        for (std::int64_t e = 0; !damped && !has_damping_time(kind) && e < count; ++e)
            damped = this->params[e * numbers + numbers - 1] != 0.0;
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
        if (is_plastic(kind)) r.source = interleaved;
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

    /// Of panels: whether the air moves.
    bool has_wind() const { return common[2] != 0.0 || common[3] != 0.0 || common[4] != 0.0; }

    Kind kind;
    bool damped = false;
    /// Hinges: they are the most expensive and the slowest elements of a sheet, so runs may evaluate them less often.
    bool slow = false;
    std::int64_t count;
    int width = 0, numbers = 0;
    std::vector<std::int64_t> corners;
    std::vector<double> params;
    double common[max_common] = {};
};

/// Dissipated and external power of elements, in 16 partial sums of every sixteenth element, whatever the vector width.
struct PowerSums {
    double dissipation[16] = {}, external[16] = {};
    double sum(const double (&parts)[16]) const {
        double total = 0.0;
        for (double part : parts) total += part;
        return total;
    }
};

}  // namespace cloth::mesh
