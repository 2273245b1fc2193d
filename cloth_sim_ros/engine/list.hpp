// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Lists of springs, hinges or panels on any particles: what a law needs is gathered for a vector of elements at a time,
// and forces are added one element after the other, so that sums run in one order whatever the vectors' width.
#pragma once

#include <algorithm>
#include <numeric>

#include "laws.hpp"
#include "storage.hpp"

namespace cloth {

enum class Kind : int { spring, joint, crossed, altitude, panel3, panel4 };

/// Call `what` with the law of a kind.
template <class F>
inline auto with_law(Kind kind, F&& what) {
    switch (kind) {
        case Kind::spring: return what(Spring{});
        case Kind::joint: return what(Joint{});
        case Kind::crossed: return what(Crossed{});
        case Kind::altitude: return what(Altitude{});
        case Kind::panel3: return what(Panel<3>{});
        default: return what(Panel<4>{});
    }
}

/// Elements that are neighbours in a list are this far apart in the order in which they are taken: forces on one
/// particle are not added right after each other, which would wait for memory.
inline constexpr std::int64_t apart_by = 16, chunk = 64;

/// Elements as they are taken: padded to whole vectors by elements without strength on a particle that is none.
template <class T>
struct Elements {
    std::int64_t count = 0;
    /// Places of the particles' quads.
    std::vector<std::uint32_t> corner[4];
    Array<T> param[3];
};

class List {
public:
    List(Kind kind, std::int64_t count, const std::int64_t* corners, const double* params, const double* common,
         bool weak)
        : kind(kind), weak(weak), count(count) {
        with_law(kind, [&](auto law) {
            using Law = decltype(law);
            width = Law::corners;
            numbers = Law::params;
        });
        this->corners.assign(corners, corners + count * width);
        if (numbers) this->params.assign(params, params + count * numbers);
        if (common) std::copy(common, common + 5, this->common);
        damped = kind == Kind::panel3 || kind == Kind::panel4;
        for (std::int64_t e = 0; !damped && e < count; ++e) damped = this->params[e * numbers + numbers - 1] != 0.0;
    }

    /// The elements with particles renumbered by `rank`, in order of their lowest particle, spread: those that a particle
    /// from `first` to before `last` is a corner of. `nobody` is the number of a particle that is none.
    template <class T>
    Elements<T> taken(const std::int64_t* rank, std::int64_t nobody, std::int64_t first, std::int64_t last) const {
        std::vector<std::int64_t> lowest(count), order(count);
        for (std::int64_t e = 0; e < count; ++e) {
            lowest[e] = rank[corners[e * width]];
            for (int c = 1; c < width; ++c) lowest[e] = std::min(lowest[e], rank[corners[e * width + c]]);
        }
        std::iota(order.begin(), order.end(), std::int64_t{0});
        std::stable_sort(order.begin(), order.end(), [&](auto a, auto b) { return lowest[a] < lowest[b]; });
        std::vector<std::int64_t> spread;
        spread.reserve(count);
        const auto touched = [&](std::int64_t e) {
            for (int c = 0; c < width; ++c)
                if (rank[corners[e * width + c]] >= first && rank[corners[e * width + c]] < last) return true;
            return false;
        };
        for (std::int64_t begin = 0; begin < count; begin += chunk * apart_by) {
            const std::int64_t most = std::min(chunk * apart_by, count - begin), rows = (most + apart_by - 1) / apart_by;
            for (std::int64_t i = 0; i < rows; ++i)
                for (std::int64_t j = 0; j < apart_by; ++j)
                    if (j * rows + i < most && touched(order[begin + j * rows + i]))
                        spread.push_back(order[begin + j * rows + i]);
        }
        const std::int64_t count = static_cast<std::int64_t>(spread.size());
        Elements<T> r;
        r.count = (count + 15) / 16 * 16;
        for (int c = 0; c < width; ++c) {
            r.corner[c].assign(r.count, static_cast<std::uint32_t>(4 * nobody));
            for (std::int64_t k = 0; k < count; ++k)
                r.corner[c][k] = static_cast<std::uint32_t>(4 * rank[corners[spread[k] * width + c]]);
        }
        for (int p = 0; p < numbers; ++p) {
            r.param[p].assign(r.count, T(0));
            for (std::int64_t k = 0; k < count; ++k) r.param[p][k] = static_cast<T>(params[spread[k] * numbers + p]);
        }
        return r;
    }

    Kind kind;
    bool weak, damped = false;
    std::int64_t count;
    int width = 0, numbers = 0;
    std::vector<std::int64_t> corners;
    std::vector<double> params;
    double common[5] = {};
};

template <class Law, class V>
inline typename Law::template Params<V> law_params(const V* numbers, const double* common) {
    using T = scalar<V>;
    if constexpr (Law::params == 3) return {numbers[0], numbers[1], numbers[2]};
    else if constexpr (Law::params == 2)
        return {numbers[0], numbers[1]};
    else
        return {splat<V>(T(common[0])), splat<V>(T(common[1])),
                Vec3<V>{splat<V>(T(common[2])), splat<V>(T(common[3])), splat<V>(T(common[4]))}};
}

/// Sums of powers that elements lose and are given, each of every sixteenth element, whatever the vectors' width.
struct Powers {
    double lost[16] = {}, given[16] = {};
    double sum(const double (&parts)[16]) const {
        double total = 0.0;
        for (double part : parts) total += part;
        return total;
    }
};

/// Add the forces of all elements at positions x and velocities v to f, all quads by particle; times a factor if Scaled,
/// and with what they lose and are given if Watched.
template <class Law, class T, bool Damped, bool Scaled, bool Watched>
inline void add_forces(const Elements<T>& list, const double* common, const T* x, const T* v, T* f, T factor,
                       [[maybe_unused]] Powers* powers) {
    using V = vec<T>;
    constexpr int L = lanes<T>, C = Law::corners, given = Law::own_velocities ? C : C - 1;
    const std::uint32_t* corner[C];
    for (int c = 0; c < C; ++c) corner[c] = list.corner[c].data();
    const T* param[3];
    for (int p = 0; p < Law::params; ++p) param[p] = list.param[p].data();
    const V scale = splat<V>(factor);
    const std::int64_t count = list.count;
    for (std::int64_t e = 0; e < count; e += L) {
        Vec3<V> d[C - 1], u[C], g[C];
        quad<T> rows[L];
        const auto ways = [&](const T* from, int c) CLOTH_INLINED {
            for (int k = 0; k < L; ++k)
                rows[k] = load4(from + std::size_t{corner[c][e + k]}) - load4(from + std::size_t{corner[0][e + k]});
        };
        for (int c = 1; c < C; ++c) {
            ways(x, c);
            apart<T>(rows, d[c - 1].x, d[c - 1].y, d[c - 1].z);
            if constexpr (Damped && !Law::own_velocities) {
                ways(v, c);
                apart<T>(rows, u[c - 1].x, u[c - 1].y, u[c - 1].z);
            }
        }
        if constexpr (Law::own_velocities)
            for (int c = 0; c < C; ++c) {
                for (int k = 0; k < L; ++k) rows[k] = load4(v + std::size_t{corner[c][e + k]});
                apart<T>(rows, u[c].x, u[c].y, u[c].z);
            }
        V numbers[3];
        for (int p = 0; p < Law::params; ++p) numbers[p] = load(param[p] + e);
        const auto params = law_params<Law, V>(numbers, common);
        Law::force(params, d, u, g, Damped);
        if constexpr (Watched && Damped) {
            const V lost = scale * Law::lost(params, d, u);
            for (int k = 0; k < L; ++k) powers->lost[(e + k) & 15] += static_cast<double>(lost[k]);
            if constexpr (Law::own_velocities) {
                const V given_ = scale * Law::given(params, d, u);
                for (int k = 0; k < L; ++k) powers->given[(e + k) & 15] += static_cast<double>(given_[k]);
            }
        }
        quad<T> out[C][L];
        for (int c = 0; c < given; ++c) {
            const Vec3<V> s = Scaled ? scale * g[c] : g[c];
            together<T>(s.x, s.y, s.z, out[Law::own_velocities ? c : c + 1]);
        }
        for (int k = 0; k < L; ++k) {
            if constexpr (!Law::own_velocities) {
                out[0][k] = -out[1][k];
                for (int c = 2; c < C; ++c) out[0][k] = out[0][k] - out[c][k];
            }
            for (int c = 0; c < C; ++c) {
                T* const to = f + std::size_t{corner[c][e + k]};
                store4(to, load4(to) + out[c][k]);
            }
        }
    }
}

template <class T>
inline void add_forces(const List& list, const Elements<T>& taken, const T* x, const T* v, T* f, T factor,
                       Powers* powers) {
    with_law(list.kind, [&](auto law) {
        using Law = decltype(law);
        const auto add = [&](auto damped, auto scaled, auto watched) {
            add_forces<Law, T, damped.value, scaled.value, watched.value>(taken, list.common, x, v, f, factor, powers);
        };
        constexpr std::true_type yes;
        constexpr std::false_type no;
        const bool damped = Law::own_velocities || list.damped;
        if (powers && damped)
            add(yes, yes, yes);
        else if (factor != T(1))
            add(yes, yes, no);
        else if (damped)
            add(yes, no, no);
        else if constexpr (!Law::own_velocities)
            add(no, no, no);
    });
}

/// What a law says of one element of a list at x and v, (3, n) by component: its corners seen as laws see them.
template <class Law>
struct Seen {
    Vec3<double> d[Law::corners - 1], u[Law::corners];
    typename Law::template Params<double> params;
    Seen(const List& list, std::int64_t e, const double* x, const double* v, std::int64_t n)
        : params(law_params<Law, double>(list.params.data() + e * list.numbers, list.common)) {
        const std::int64_t* const p = list.corners.data() + e * list.width;
        const auto at = [n](const double* a, std::int64_t i) { return Vec3<double>{a[i], a[n + i], a[2 * n + i]}; };
        for (int c = 1; c < Law::corners; ++c) {
            d[c - 1] = at(x, p[c]) - at(x, p[0]);
            if constexpr (!Law::own_velocities)
                if (v) u[c - 1] = at(v, p[c]) - at(v, p[0]);
        }
        if constexpr (Law::own_velocities)
            if (v)
                for (int c = 0; c < Law::corners; ++c) u[c] = at(v, p[c]);
    }
};

}  // namespace cloth
