// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What of a cloth may come near other parts of it: particles and triangles, edges and edges, found by a grid of cells. A
// list of pairs holds until something has moved too far, and no bit depends on when it was made.
#pragma once

#include <cmath>

#include "self_near.hpp"
#include "self_surface.hpp"

namespace cloth {

/// Where particles are, as quads.
struct Quads {
    const double* from;
    CLOTH_INLINE Vec3<double> operator()(std::int64_t i) const { return {from[4 * i], from[4 * i + 1], from[4 * i + 2]}; }
};

/// Pairs by index, ascending by the first and then by the second; each with a vector's worth of room behind.
struct PairList {
    std::vector<Index> first, second;
    std::size_t size() const { return first.size(); }
    void clear() {
        first.clear();
        second.clear();
    }
    void add(Index a, Index b) {
        first.push_back(a);
        second.push_back(b);
    }
    /// In order, where the seconds of each first ascend already.
    void sort(std::int64_t firsts) {
        std::vector<std::size_t> place(firsts + 1, 0);
        for (const Index a : first) ++place[a + 1];
        for (std::int64_t i = 0; i < firsts; ++i) place[i + 1] += place[i];
        std::vector<Index> a(size()), b(size());
        for (std::size_t k = 0; k < size(); ++k) {
            const std::size_t to = place[first[k]]++;
            a[to] = first[k];
            b[to] = second[k];
        }
        first.swap(a);
        second.swap(b);
    }
};

/// Squared distances of pairs, a vector of them at a time: `see` gives each one's corners by `corner(k)`.
template <int Corners, class F, class D>
inline void squares(std::size_t size, const double* x, F&& corners, D&& distance, double* out) {
    using V = vec<double>;
    for (std::size_t k = 0; k < size; k += lanes<double>) {
        quad<double> rows[Corners][lanes<double>];
        for (int lane = 0; lane < lanes<double>; ++lane) {
            const std::array<Index, Corners> c = corners(std::min(k + lane, size - 1));
            for (int j = 0; j < Corners; ++j) rows[j][lane] = load4(x + 4 * c[j]);
        }
        Vec3<V> at[Corners];
        for (int j = 0; j < Corners; ++j) apart(rows[j], at[j].x, at[j].y, at[j].z);
        store(out + k, distance(at));
    }
}

/// Cells of a grid, found by a hash: points by the cell that they are in.
class Cells {
public:
    Cells(std::int64_t points, double size) : size_(size) {
        while (buckets_ < 2 * points) buckets_ *= 2;
        start_.assign(buckets_ + 1, 0);
        cell_.resize(points);
        in_order_.resize(points);
        order_.resize(points);
    }
    /// Take in all points, `at(i)`.
    template <class F>
    void fill(F&& at) {
        const std::int64_t points = static_cast<std::int64_t>(cell_.size());
        for (std::int64_t i = 0; i < points; ++i) {
            const Vec3<double> p = at(i);
            cell_[i] = cell(number(p.x), number(p.y), number(p.z));
            ++start_[bucket(cell_[i]) + 1];
        }
        for (std::int64_t k = 0; k < buckets_; ++k) start_[k + 1] += start_[k];
        std::vector<std::int64_t> next(start_.begin(), start_.end() - 1);
        for (std::int64_t i = 0; i < points; ++i) {
            const std::int64_t place = next[bucket(cell_[i])]++;
            order_[place] = static_cast<Index>(i);
            in_order_[place] = cell_[i];
        }
    }
    /// Call `what` with each point in the cells of a box.
    template <class F>
    void each(Vec3<double> low, Vec3<double> high, F&& what) const {
        const std::int64_t first[3] = {number(low.x), number(low.y), number(low.z)};
        const std::int64_t last[3] = {number(high.x), number(high.y), number(high.z)};
        for (std::int64_t i = first[0]; i <= last[0]; ++i)
            for (std::int64_t j = first[1]; j <= last[1]; ++j)
                for (std::int64_t k = first[2]; k <= last[2]; ++k) {
                    const std::uint64_t wanted = cell(i, j, k);
                    const std::int64_t b = bucket(wanted);
                    for (std::int64_t place = start_[b]; place < start_[b + 1]; ++place)
                        if (in_order_[place] == wanted) what(order_[place]);
                }
    }

private:
    std::int64_t number(double a) const {
        return static_cast<std::int64_t>(std::floor(larger(smaller(a / size_, most_), -most_)));
    }
    /// One number for a cell: 21 bits of each coordinate. What is two million cells apart and takes the same one is told
    /// apart by boxes.
    static std::uint64_t cell(std::int64_t i, std::int64_t j, std::int64_t k) {
        constexpr std::uint64_t bits = (1u << 21) - 1;
        return (static_cast<std::uint64_t>(i) & bits) | (static_cast<std::uint64_t>(j) & bits) << 21 |
               (static_cast<std::uint64_t>(k) & bits) << 42;
    }
    std::int64_t bucket(std::uint64_t cell) const {
        const std::uint64_t mixed = cell * 0x9e3779b97f4a7c15u;
        return static_cast<std::int64_t>((mixed ^ mixed >> 32) & static_cast<std::uint64_t>(buckets_ - 1));
    }
    static constexpr double most_ = 1e15;
    double size_;
    std::int64_t buckets_ = 16;
    std::vector<std::int64_t> start_;
    std::vector<std::uint64_t> cell_, in_order_;  ///< of each point, and in the order of buckets
    std::vector<Index> order_;
};

/// The pairs of a surface that are within a reach of each other where `make` looked.
class NearPairs {
public:
    PairList triangles;  ///< particle, triangle
    PairList edges;      ///< edge, later edge
    double reach = -1.0;

    /// All pairs within a reach [m] at positions x, quads; of edges those within a reach that is `less` [m] shorter.
    void make(const Surface& s, const double* x, double wanted, double less = 0.0) {
        reach = wanted;
        triangles.clear();
        edges.clear();
        if (s.triangles.empty()) return;
        const Quads at{x};
        double length = 0.0;
        for (const auto& e : s.edges) length = larger(norm2(at(e[0]) - at(e[1])), length);
        length = root(length);
        find_triangles(s, at, length);
        find_edges(s, at, length, wanted - less);
    }
    /// Squares of the distances of pairs in a list, and whether a vector of them fits behind.
    void triangle_squares(const Surface& s, const double* x, std::vector<double>& out) const {
        out.resize(triangles.size() + lanes<double>);
        const auto corners = [&](std::size_t k) CLOTH_INLINED {
            const auto& t = s.triangles[triangles.second[k]];
            return std::array<Index, 4>{triangles.first[k], t[0], t[1], t[2]};
        };
        const auto distance = [](const Vec3<vec<double>>* at) CLOTH_INLINED {
            return near_triangle(at[0], at[1], at[2], at[3]).square;
        };
        squares<4>(triangles.size(), x, corners, distance, out.data());
    }
    void edge_squares(const Surface& s, const double* x, std::vector<double>& out) const {
        out.resize(edges.size() + lanes<double>);
        const auto corners = [&](std::size_t k) CLOTH_INLINED {
            const auto &a = s.edges[edges.first[k]], &b = s.edges[edges.second[k]];
            return std::array<Index, 4>{a[0], a[1], b[0], b[1]};
        };
        const auto distance = [](const Vec3<vec<double>>* at) CLOTH_INLINED {
            return near_segments(at[0], at[1], at[2], at[3]).square;
        };
        squares<4>(edges.size(), x, corners, distance, out.data());
    }

private:
    struct Box {
        Vec3<double> low, high;
        explicit Box(Vec3<double> a) : low(a), high(a) {}
        void take(Vec3<double> a) {
            low = {smaller(a.x, low.x), smaller(a.y, low.y), smaller(a.z, low.z)};
            high = {larger(a.x, high.x), larger(a.y, high.y), larger(a.z, high.z)};
        }
        Box grown(double by) const {
            const Vec3<double> more{by, by, by};
            Box b(low - more);
            b.high = high + more;
            return b;
        }
        bool holds(Vec3<double> a) const {
            return a.x >= low.x && a.x <= high.x && a.y >= low.y && a.y <= high.y && a.z >= low.z && a.z <= high.z;
        }
        bool meets(const Box& b) const {
            return b.high.x >= low.x && b.low.x <= high.x && b.high.y >= low.y && b.low.y <= high.y &&
                   b.high.z >= low.z && b.low.z <= high.z;
        }
    };

    /// Keep those of a list that are within a reach.
    static void keep(PairList& list, const std::vector<double>& squares, double reach) {
        std::size_t kept = 0;
        for (std::size_t k = 0; k < list.size(); ++k) {
            list.first[kept] = list.first[k];
            list.second[kept] = list.second[k];
            kept += squares[k] < reach * reach ? 1 : 0;
        }
        list.first.resize(kept);
        list.second.resize(kept);
    }
    void find_triangles(const Surface& s, const Quads& at, double length) {
        Cells cells(s.count, length + reach);
        cells.fill(at);
        for (std::size_t t = 0; t < s.triangles.size(); ++t) {
            Box box(at(s.triangles[t][0]));
            box.take(at(s.triangles[t][1]));
            box.take(at(s.triangles[t][2]));
            box = box.grown(reach);
            cells.each(box.low, box.high, [&](Index i) {
                if (box.holds(at(i)) && !s.has(t, i)) triangles.add(i, static_cast<Index>(t));
            });
        }
        triangles.sort(s.count);
        std::vector<double> all;
        triangle_squares(s, at.from, all);
        keep(triangles, all, reach);
    }
    void find_edges(const Surface& s, const Quads& at, double length, double reach) {
        const std::int64_t count = static_cast<std::int64_t>(s.edges.size());
        std::vector<Box> boxes;
        boxes.reserve(count);
        for (const auto& e : s.edges) {
            boxes.emplace_back(at(e[0]));
            boxes.back().take(at(e[1]));
        }
        // Edges stand in their middles' cells; none reaches further than half the largest extent along an axis.
        Vec3<double> half{};
        for (const Box& box : boxes) {
            const Vec3<double> extent = 0.5 * (box.high - box.low);
            half = {larger(extent.x, half.x), larger(extent.y, half.y), larger(extent.z, half.z)};
        }
        Cells cells(count, length + reach);
        cells.fill([&](std::int64_t e) { return 0.5 * (boxes[e].low + boxes[e].high); });
        std::vector<Index> found;
        for (std::int64_t e = 0; e < count; ++e) {
            const Box box = boxes[e].grown(reach);
            Box wide = box;
            wide.low = box.low - half;
            wide.high = box.high + half;
            found.clear();
            cells.each(wide.low, wide.high, [&](Index other) {
                if (other <= e || !box.meets(boxes[other])) return;
                const auto &a = s.edges[e], &b = s.edges[other];
                if (a[0] != b[0] && a[0] != b[1] && a[1] != b[0] && a[1] != b[1]) found.push_back(other);
            });
            std::sort(found.begin(), found.end());
            for (const Index other : found) edges.add(static_cast<Index>(e), other);
        }
        std::vector<double> all;
        edge_squares(s, at.from, all);
        keep(edges, all, reach);
    }
};

}  // namespace cloth
