// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Broad phase of self-contact: pairs of particles and triangles, and of edges, found by a grid of cells. No bit depends
// on when a list of pairs is built.
#pragma once

#include <bit>
#include <cmath>

#include "contact/primitives.hpp"
#include "contact/surface.hpp"

namespace cloth::contact {

/// Positions as quads.
struct Quads {
    const double* from;
    CLOTH_INLINE Vec3<double> operator()(std::int64_t i) const {
        return {from[4 * i], from[4 * i + 1], from[4 * i + 2]};
    }
};

/// Pairs by index, ascending by the first and then by the second.
struct PairList {
    std::vector<Index> first, second;
    /// Squared distances [m^2] when they were measured, padded by a vector.
    std::vector<double> square;
    std::size_t size() const { return first.size(); }
    void clear() {
        first.clear();
        second.clear();
        square.clear();
    }
    void add(Index a, Index b) {
        first.push_back(a);
        second.push_back(b);
    }
    /// Set to the pairs of a list that are measured within a range. Return the indices of the others.
    const std::vector<Index>& select(const PairList& from, double reach) {
        const std::size_t size = from.size();
        std::size_t n = 0, n_omitted = 0;
        each_below(from.square.data(), size, reach * reach, [&](std::size_t) { ++n; });
        // One more, because each pair is written before it is known to count.
        // `first` last, because its size tells that all have theirs.
        omitted_.resize(size - n + 1);
        square.resize(n + lanes<double>);
        for (auto* all : {&second, &first}) all->resize(n + 1);
        n = 0;
        for (std::size_t k = 0; k < size; ++k) {
            first[n] = from.first[k], second[n] = from.second[k], square[n] = from.square[k];
            omitted_[n_omitted] = static_cast<Index>(k);
            const bool is_near = from.square[k] < reach * reach;
            n += is_near ? 1 : 0;
            n_omitted += is_near ? 0 : 1;
        }
        for (auto* all : {&first, &second}) all->resize(n);
        omitted_.resize(n_omitted);
        return omitted_;
    }
    /// Sort by the first; the second already ascend for each first.
    void sort(std::int64_t firsts) { sort(first, second, firsts); }
    /// Sort by both, which are below a limit.
    void sort_both(std::int64_t limit) {
        sort(second, first, limit);
        sort(first, second, limit);
    }

private:
    std::vector<Index> omitted_;
    /// Stable counting sort by one of each pair, which is below a limit.
    static void sort(std::vector<Index>& by, std::vector<Index>& paired, std::int64_t limit) {
        std::vector<Index> offset(limit + 1, 0);
        for (const Index a : by) ++offset[a + 1];
        for (std::int64_t i = 0; i < limit; ++i) offset[i + 1] += offset[i];
        std::vector<Index> sorted(by.size()), along(by.size());
        for (std::size_t k = 0; k < by.size(); ++k) {
            const Index to = offset[by[k]]++;
            sorted[to] = by[k];
            along[to] = paired[k];
        }
        by.swap(sorted);
        paired.swap(along);
    }
};

/// Pairs of a point and a triangle, and of two edges.
struct PairLists {
    PairList triangles, edges;

    std::size_t size() const { return triangles.size() + edges.size(); }
    bool empty() const { return !size(); }
    void clear() {
        triangles.clear();
        edges.clear();
    }
    /// Set to the pairs of other lists that are measured within a range [m], edges within another.
    void select(const PairLists& from, double range, double edge_range) {
        triangles.select(from.triangles, range);
        edges.select(from.edges, edge_range);
    }
    /// Whether test(edges, list, k) holds for any pair. `edges`: std::true_type for two edges.
    template <class F>
    bool any(F&& test) const {
        for (std::size_t k = 0; k < triangles.size(); ++k)
            if (test(std::false_type{}, triangles, k)) return true;
        for (std::size_t k = 0; k < edges.size(); ++k)
            if (test(std::true_type{}, edges, k)) return true;
        return false;
    }
};

/// Corners of pair k: of two edges, or the particle and those of the triangle.
template <bool Edges>
CLOTH_INLINE std::array<Index, 4> pair_corners(const Surface& s, const PairList& pairs, std::size_t k) {
    const Index first = pairs.first[k], second = pairs.second[k];
    if constexpr (Edges)
        return {s.edges[first][0], s.edges[first][1], s.edges[second][0], s.edges[second][1]};
    else
        return {first, s.triangles[second][0], s.triangles[second][1], s.triangles[second][2]};
}
/// Squared distance of a pair [m^2], from the positions of its corners.
template <bool Edges, class X>
CLOTH_INLINE auto pair_square(const std::array<Index, 4>& corner, X&& at) {
    if constexpr (Edges)
        return near_segments(at(corner[0]), at(corner[1]), at(corner[2]), at(corner[3])).square;
    else
        return near_triangle(at(corner[0]), at(corner[1]), at(corner[2]), at(corner[3])).square;
}
/// Length of the longest edge [m].
inline double longest_edge(const Surface& s, const Quads& at) {
    double square = 0.0;
    for (const auto& e : s.edges) square = larger(norm2(at(e[0]) - at(e[1])), square);
    return root(square);
}
/// Positions of the corners of a vector of pairs from k on; the last one is repeated.
template <bool Edges>
CLOTH_INLINE void gather_pairs(const Surface& s, const PairList& pairs, std::size_t k, const double* x,
                               Vec3<vec<double>>* at) {
    quad<double> rows[4][lanes<double>];
    for (int lane = 0; lane < lanes<double>; ++lane) {
        const auto corners = pair_corners<Edges>(s, pairs, std::min(k + lane, pairs.size() - 1));
        for (int j = 0; j < 4; ++j) rows[j][lane] = load4(x + 4 * static_cast<std::int64_t>(corners[j]));
    }
    for (int j = 0; j < 4; ++j) deinterleave(rows[j], at[j].x, at[j].y, at[j].z);
}

/// Points sorted into the cells of a grid. Cells along x are consecutive, and so are their points: a row of cells is
/// one range of slots.
class Cells {
public:
    /// A grid for a number of points, with cells of a size [m] or larger, so that there are not many more cells than
    /// points.
    Cells(std::int64_t points, double size) : size_(size), cell_(points), order_(points) {}
    /// Insert all points, at(i).
    template <class F>
    void fill(F&& at) {
        const std::int64_t points = static_cast<std::int64_t>(cell_.size());
        if (!points) return;
        AxisBox box(at(0));
        for (std::int64_t i = 1; i < points; ++i) box.include(at(i));
        low_ = box.low;
        const Vec3<double> extent = box.high - box.low;
        const double max_cells = 4.0 * static_cast<double>(points) + 64.0;
        const auto cells_along = [&](double length) { return length < 1e300 ? std::floor(length / size_) + 1.0 : 1.0; };
        while (cells_along(extent.x) * cells_along(extent.y) * cells_along(extent.z) > max_cells) size_ *= 1.5;
        n_cells_[0] = cells_along(extent.x), n_cells_[1] = cells_along(extent.y), n_cells_[2] = cells_along(extent.z);
        start_.assign(static_cast<std::size_t>(n_cells_[0] * n_cells_[1] * n_cells_[2]) + 1, 0);
        for (std::int64_t i = 0; i < points; ++i) {
            const Vec3<double> p = at(i);
            cell_[i] = cell(cell_index(p.x - low_.x, 0), cell_index(p.y - low_.y, 1), cell_index(p.z - low_.z, 2));
            ++start_[cell_[i] + 1];
        }
        for (std::size_t k = 1; k < start_.size(); ++k) start_[k] += start_[k - 1];
        std::vector<std::int64_t> next(start_.begin(), start_.end() - 1);
        for (std::int64_t i = 0; i < points; ++i) order_[next[cell_[i]]++] = static_cast<Index>(i);
    }
    /// The point in a slot.
    Index operator[](std::int64_t slot) const { return order_[slot]; }
    /// Call visit(begin, end) with the range of slots of each row of cells in a box.
    template <class F>
    void for_each_row(Vec3<double> low, Vec3<double> high, F&& visit) const {
        if (order_.empty()) return;
        const Vec3<double> from = low - low_, to = high - low_;
        const std::int64_t first = cell_index(from.x, 0), last = cell_index(to.x, 0);
        for (std::int64_t k = cell_index(from.z, 2); k <= cell_index(to.z, 2); ++k)
            for (std::int64_t j = cell_index(from.y, 1); j <= cell_index(to.y, 1); ++j) {
                const std::int64_t begin = start_[cell(first, j, k)], end = start_[cell(last, j, k) + 1];
                if (begin < end) visit(begin, end);
            }
    }

private:
    /// Index of a cell along an axis, clamped to the grid.
    std::int64_t cell_index(double a, int axis) const {
        return static_cast<std::int64_t>(larger(smaller(std::floor(a / size_), n_cells_[axis] - 1.0), 0.0));
    }
    std::int64_t cell(std::int64_t i, std::int64_t j, std::int64_t k) const {
        return i + static_cast<std::int64_t>(n_cells_[0]) * (j + static_cast<std::int64_t>(n_cells_[1]) * k);
    }
    double size_;
    Vec3<double> low_{};
    double n_cells_[3] = {1.0, 1.0, 1.0};  ///< cells along each axis
    std::vector<std::int64_t> start_, cell_;
    std::vector<Index> order_;
};

/// Boxes in the order of cells, so that a row of them is compared with a box a vector at a time. Each has keys: boxes
/// with an equal key don't count.
template <int Keys>
class SortedBoxes {
public:
    explicit SortedBoxes(std::int64_t count) {
        for (auto* all : {&low_, &high_})
            for (auto& numbers : *all) numbers.resize(count + lanes<double>);
        for (auto& numbers : key_) numbers.resize(count + lanes<double>);
    }
    void put(std::int64_t slot, const AxisBox& box, const std::array<Index, Keys>& keys) {
        low_[0][slot] = box.low.x, low_[1][slot] = box.low.y, low_[2][slot] = box.low.z;
        high_[0][slot] = box.high.x, high_[1][slot] = box.high.y, high_[2][slot] = box.high.z;
        for (int k = 0; k < Keys; ++k) key_[k][slot] = static_cast<double>(keys[k]);
    }
    /// Call `visit` with each slot of a range, which may be empty, whose box overlaps another.
    template <std::size_t N, class F>
    void for_each_overlap(std::int64_t begin, std::int64_t end, const AxisBox& box, const std::array<Index, N>& keys,
                          F&& visit) {
        using V = vec<double>;
        const V unit = splat<V>(1.0);
        for (std::int64_t k = begin; k < end; k += lanes<double>) {
            // Overlap along an axis, negative if there is none.
            const auto axis_overlap = [&](int axis, double from, double to) CLOTH_INLINED {
                return smaller(V(load(high_[axis].data() + k) - from * unit),
                               V(to * unit - load(low_[axis].data() + k)));
            };
            const V overlap =
                smaller(smaller(axis_overlap(0, box.low.x, box.high.x), axis_overlap(1, box.low.y, box.high.y)),
                        axis_overlap(2, box.low.z, box.high.z));
            auto counts = overlap >= V{};
            for (const auto& key : key_)
                for (const Index excluded : keys)
                    counts &= load(key.data() + k) != static_cast<double>(excluded) * unit;
            unsigned bits = bits_of(counts);
            if (end - k < lanes<double>) bits &= (1u << (end - k)) - 1u;
            for (; bits; bits &= bits - 1u) visit(k + std::countr_zero(bits));
        }
    }

private:
    std::vector<double> low_[3], high_[3], key_[Keys];
};

/// Cell size as a fraction of the search distance.
inline constexpr double cell_fineness = 0.5;

/// Add the pairs of points, in ascending order, and triangles whose boxes are within `reach` [m]. `point_at(k)`:
/// position; `key_of(k)`: key of a point, which counts with triangles that have no corner joined to that particle.
/// `length` [m]: that of the longest edge.
template <class P, class K>
inline void find_triangles(const Surface& s, const Quads& at, double length, double reach, std::int64_t count,
                           P&& point_at, K&& key_of, PairList& pairs) {
    if (!count) return;
    Cells cells(count, cell_fineness * (length + reach));
    cells.fill(point_at);
    SortedBoxes<1> points(count);
    for (std::int64_t slot = 0; slot < count; ++slot)
        points.put(slot, AxisBox(point_at(cells[slot])), {key_of(cells[slot])});
    for (std::size_t t = 0; t < s.triangles.size(); ++t) {
        const auto& corner = s.triangles[t];
        const AxisBox box = AxisBox({at(corner[0]), at(corner[1]), at(corner[2])}).expanded(reach);
        const std::array<Index, 3> keys{s.joined[corner[0]], s.joined[corner[1]], s.joined[corner[2]]};
        cells.for_each_row(box.low, box.high, [&](std::int64_t begin, std::int64_t end) {
            points.for_each_overlap(begin, end, box, keys,
                                    [&](std::int64_t slot) { pairs.add(cells[slot], static_cast<Index>(t)); });
        });
    }
    pairs.sort(count);
}

/// Edges of a surface in the slots of a grid, by the centers of their boxes.
class EdgeGrid {
public:
    EdgeGrid(const Surface& s, const Quads& at, double cell_size)
        : count(static_cast<std::int64_t>(s.edges.size())), surface_(s), cells_(count, cell_size), sorted_(count) {
        boxes_.reserve(count);
        for (const auto& e : s.edges) {
            const AxisBox& box = boxes_.emplace_back(AxisBox({at(e[0]), at(e[1])}));
            const Vec3<double> extent = 0.5 * (box.high - box.low);
            half_ = {larger(extent.x, half_.x), larger(extent.y, half_.y), larger(extent.z, half_.z)};
        }
        cells_.fill([&](std::int64_t e) { return boxes_[e].center(); });
        for (std::int64_t slot = 0; slot < count; ++slot) sorted_.put(slot, boxes_[cells_[slot]], keys(cells_[slot]));
    }
    const std::int64_t count;
    Index operator[](std::int64_t slot) const { return cells_[slot]; }
    const AxisBox& box(Index e) const { return boxes_[e]; }
    /// Particles that edges with a common corner share.
    std::array<Index, 2> keys(Index e) const {
        return {surface_.joined[surface_.edges[e][0]], surface_.joined[surface_.edges[e][1]]};
    }
    /// Call `visit` with each edge from a slot on whose box overlaps another, unless a key is equal.
    template <class F>
    void for_each_overlap(const AxisBox& box, const std::array<Index, 2>& keys, std::int64_t from_slot, F&& visit) {
        cells_.for_each_row(box.low - half_, box.high + half_, [&](std::int64_t begin, std::int64_t end) {
            sorted_.for_each_overlap(std::max(begin, from_slot), end, box, keys,
                                     [&](std::int64_t slot) { visit(cells_[slot]); });
        });
    }

private:
    const Surface& surface_;
    std::vector<AxisBox> boxes_;
    Vec3<double> half_{};  ///< no box extends further from its center
    Cells cells_;
    SortedBoxes<2> sorted_;
};

/// Pairs of a surface within a range of each other.
struct SurfacePairs : PairLists {
    double reach = -1.0;

    /// Build the lists of all pairs within `max_distance` [m] at positions x, quads, and measure them; for edges the
    /// distance is `edge_reduction` [m] shorter.
    void build(const Surface& s, const double* x, double max_distance, double edge_reduction = 0.0) {
        reach = max_distance;
        clear();
        if (s.triangles.empty()) return;
        const Quads at{x};
        const double length = longest_edge(s, at);
        SurfacePairs near;
        find_triangles(s, at, length, reach, s.count, at, [&](Index i) { return s.joined[i]; }, near.triangles);
        near.find_edges(s, at, length, max_distance - edge_reduction);
        near.measure(s, x);
        select(near, reach, max_distance - edge_reduction);
    }
    /// Measure the squared distances of all pairs.
    void measure(const Surface& s, const double* x) {
        measure<false>(s, x, triangles);
        measure<true>(s, x, edges);
    }
    void measure_edges(const Surface& s, const double* x) { measure<true>(s, x, edges); }

private:
    template <bool Edges>
    static void measure(const Surface& s, const double* x, PairList& pairs) {
        pairs.square.resize(pairs.size() + lanes<double>);
        for (std::size_t k = 0; k < pairs.size(); k += lanes<double>) {
            Vec3<vec<double>> at[4];
            gather_pairs<Edges>(s, pairs, k, x, at);
            if constexpr (Edges)
                store(pairs.square.data() + k, near_segments(at[0], at[1], at[2], at[3]).square);
            else
                store(pairs.square.data() + k, near_triangle(at[0], at[1], at[2], at[3]).square);
        }
    }
    void find_edges(const Surface& s, const Quads& at, double length, double reach) {
        EdgeGrid grid(s, at, cell_fineness * (length + reach));
        // Each pair is found once, by the one that is first in the order of slots.
        for (std::int64_t slot = 0; slot < grid.count; ++slot) {
            const Index e = grid[slot];
            grid.for_each_overlap(grid.box(e).expanded(reach), grid.keys(e), slot + 1,
                                  [&](Index later) { edges.add(std::min(e, later), std::max(e, later)); });
        }
        edges.sort_both(grid.count);
    }
};

}  // namespace cloth::contact
