// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Neighbours of features: points and edges of obstacles near triangles and edges of the cloth. Verlet lists are valid
// until something has moved too far. No bit depends on when they are rebuilt.
#pragma once

#include "contact/features.hpp"
#include "contact/self_contact.hpp"

namespace cloth::contact {

/// Clip the segment from a to b to a box: the fractions `first` to `last`, in reverse order if it is outside.
inline void clip(const AxisBox& box, Vec3<double> a, Vec3<double> b, double& first, double& last) {
    first = 0.0, last = 1.0;
    const auto slab = [&](double from, double to, double low, double high) {
        if (from == to) {
            if (from < low || from > high) last = -1.0;
            return;
        }
        const double over = 1.0 / (to - from), u = (low - from) * over, v = (high - from) * over;
        first = larger(smaller(u, v), first);
        last = smaller(larger(u, v), last);
    };
    slab(a.x, b.x, box.low.x, box.high.x);
    slab(a.y, b.y, box.low.y, box.high.y);
    slab(a.z, b.z, box.low.z, box.high.z);
}

/// Pairs of one obstacle: point and triangle, edge of the obstacle and edge of the cloth.
class FeaturePairs {
public:
    PairList triangles, edges;
    double reach = -1.0;

    /// Build the list of all pairs within `max_distance` [m], radius included. Positions are quads.
    void build(const Surface& s, const FeaturesAt& from, const double* x, double max_distance) {
        reach = max_distance;
        triangles.clear();
        edges.clear();
        if (s.triangles.empty() || from.features.points.empty()) return;
        const Quads at{x};
        double length = 0.0;
        AxisBox cloth(at(s.edges[0][0]));
        for (const auto& e : s.edges) {
            length = larger(norm2(at(e[0]) - at(e[1])), length);
            cloth.include(at(e[0]));
            cloth.include(at(e[1]));
        }
        length = root(length);
        const AxisBox search_box = cloth.expanded(reach);
        const auto count = static_cast<Index>(from.features.points.size());
        std::vector<Index> points, near_edges;
        for (Index k = 0; k < count; ++k)
            if (search_box.overlaps(AxisBox(from.position(k)))) points.push_back(k);
        for (std::size_t e = 0; e < from.features.edges.size(); ++e) {
            double first, last;
            clip(search_box, from.position(from.features.edges[e][0]), from.position(from.features.edges[e][1]), first,
                 last);
            if (first <= last) near_edges.push_back(static_cast<Index>(e));
        }
        if (!points.empty()) find_triangles(s, from, at, points, length);
        if (!near_edges.empty()) find_edges(s, from, at, near_edges, search_box, length);
    }

private:
    void find_triangles(const Surface& s, const FeaturesAt& from, const Quads& at, const std::vector<Index>& points,
                        double length) {
        std::vector<AxisBox> boxes;
        boxes.reserve(s.triangles.size());
        for (const auto& t : s.triangles) {
            boxes.emplace_back(at(t[0]));
            boxes.back().include(at(t[1]));
            boxes.back().include(at(t[2]));
        }
        const BoxGrid cells(boxes, length + reach);
        std::vector<Index> candidates;
        for (const Index k : points) {
            const Vec3<double> p = from.position(k);
            const AxisBox box = AxisBox(p).expanded(reach);
            cells.query(box, length, candidates);
            for (const Index t : candidates) {
                if (!box.overlaps(boxes[t])) continue;
                const auto& c = s.triangles[t];
                if (near_triangle(p, at(c[0]), at(c[1]), at(c[2])).square < reach * reach) triangles.add(k, t);
            }
        }
    }
    void find_edges(const Surface& s, const FeaturesAt& from, const Quads& at, const std::vector<Index>& near_edges,
                    const AxisBox& search_box, double length) {
        std::vector<AxisBox> boxes;
        boxes.reserve(s.edges.size());
        for (const auto& e : s.edges) {
            boxes.emplace_back(at(e[0]));
            boxes.back().include(at(e[1]));
        }
        const BoxGrid cells(boxes, length + reach);
        std::vector<Index> candidates, hits;
        for (const Index edge : near_edges) {
            const Vec3<double> a = from.position(from.features.edges[edge][0]),
                               b = from.position(from.features.edges[edge][1]);
            double first, last;
            clip(search_box, a, b, first, last);
            // Search in pieces as long as a cell: the box of a whole long edge would contain half the cloth.
            const double pieces = std::ceil((last - first) * root(norm2(b - a)) / (length + reach));
            hits.clear();
            for (double piece = 0.0; piece < larger(pieces, 1.0); piece += 1.0) {
                const double span = (last - first) / larger(pieces, 1.0), begin = first + piece * span;
                AxisBox box(a + begin * (b - a));
                box.include(a + (begin + span) * (b - a));
                box = box.expanded(reach);
                cells.query(box, length, candidates);
                for (const Index e : candidates)
                    if (box.overlaps(boxes[e])) hits.push_back(e);
            }
            std::sort(hits.begin(), hits.end());
            hits.erase(std::unique(hits.begin(), hits.end()), hits.end());
            for (const Index e : hits)
                if (near_segments(at(s.edges[e][0]), at(s.edges[e][1]), a, b).square < reach * reach)
                    edges.add(edge, e);
        }
    }
    /// Boxes sorted into cells by their centers. A query that would visit more cells than boxes returns all of them.
    class BoxGrid {
    public:
        BoxGrid(const std::vector<AxisBox>& boxes, double size)
            : size_(size), count_(static_cast<Index>(boxes.size())), cells_(count_, size) {
            cells_.fill([&](std::int64_t k) { return boxes[k].center(); });
        }
        /// Return the boxes that may overlap a box, in ascending order. None has a side longer than `length`.
        void query(const AxisBox& box, double length, std::vector<Index>& hits) const {
            hits.clear();
            const AxisBox expanded = box.expanded(0.5 * length);
            const Vec3<double> n_cells = (1.0 / size_) * (expanded.high - expanded.low);
            if ((n_cells.x + 1.0) * (n_cells.y + 1.0) * (n_cells.z + 1.0) > static_cast<double>(count_)) {
                for (Index k = 0; k < count_; ++k) hits.push_back(k);
                return;
            }
            cells_.for_each(expanded.low, expanded.high, [&](Index k) { hits.push_back(k); });
            std::sort(hits.begin(), hits.end());
        }

    private:
        double size_;
        Index count_;
        Cells cells_;
    };
};

/// Upper bound of the displacement of a point at a distance `reach` [m] by the rotation between two poses.
inline double rotation_displacement(const Pose& a, const Pose& b, double reach) {
    double square = 0.0;
    for (int j = 0; j < 3; ++j) square += norm2(a.rotation[j] - b.rotation[j]);
    return root(square) * reach;
}

/// Verlet lists of the features of one obstacle, kept between calls. Concurrent runs need one each.
class FeatureVerletList {
public:
    /// Pairs of the last `find`.
    PairList triangles, edges;

    /// Find the pairs nearer than thickness + margin [m], in addition to the radius. Return false if a position is not
    /// finite, or if that distance is at least four times the shortest edge.
    bool find(const Surface& s, const double* x, const FeaturesAt& from, double thickness, double margin) {
        return update(s, x, from, thickness, margin, std::numeric_limits<double>::infinity());
    }
    /// The same for each step of a run. `motion`: upper bound of the relative motion of cloth and obstacle since the
    /// last call [m]; infinite after any other call.
    bool update(const Surface& s, const double* x, const FeaturesAt& from, double thickness, double margin,
                double motion) {
        const double range = thickness + margin;
        if (!(range < 4.0 * s.shortest)) return false;
        motion_ += motion;
        if (thickness != thickness_ || !(margin + motion_ <= inner_.margin)) {
            if (!(motion_since(s, x, from, ReferenceState{}) < 1e30)) return false;
            motion_ = motion_since(s, x, from, inner_.reference);
            if (thickness != thickness_ || !(margin + motion_ <= inner_.margin)) {
                thickness_ = thickness;
                rebuild_inner(s, x, from, margin + 0.6 * thickness);
                motion_ = 0.0;
            }
        }
        filter(s, from, x, inner_.pairs, from.features.radius + range, triangles, edges);
        return true;
    }
    /// Squared distance of a pair [m^2].
    static double point_square(const Surface& s, const FeaturesAt& from, const Quads& at, Index point, Index triangle) {
        const auto& t = s.triangles[triangle];
        return near_triangle(from.position(point), at(t[0]), at(t[1]), at(t[2])).square;
    }
    static double edge_square(const Surface& s, const FeaturesAt& from, const Quads& at, Index edge, Index cloth_edge) {
        const auto &a = s.edges[cloth_edge], &b = from.features.edges[edge];
        return near_segments(at(a[0]), at(a[1]), from.position(b[0]), from.position(b[1])).square;
    }

private:
    struct ReferenceState {
        Array<double> positions;
        Pose pose{};
    };
    struct ListLevel {
        FeaturePairs pairs;
        ReferenceState reference;
        double margin = -1.0;
    };
    /// Relative motion of cloth and obstacle since the reference; since the origin if there is none.
    double motion_since(const Surface& s, const double* x, const FeaturesAt& from,
                        const ReferenceState& reference) const {
        MotionBound motion;
        const bool has_reference = !reference.positions.empty();
        for (std::int64_t i = 0; i < s.count; ++i) {
            const quad<double> x_i = load4(x + 4 * i);
            motion.include(has_reference ? quad<double>(x_i - load4(reference.positions.data() + 4 * i)) : x_i);
        }
        const Pose& pose = from.pose;
        const Vec3<double> displacement = has_reference ? pose.position - reference.pose.position : pose.position;
        motion.include(quad<double>{displacement.x, displacement.y, displacement.z, 0.0});
        return motion.diameter() +
               (has_reference ? rotation_displacement(pose, reference.pose, from.features.reach) : 0.0);
    }
    void rebuild_inner(const Surface& s, const double* x, const FeaturesAt& from, double margin) {
        const double range = thickness_ + margin, radius = from.features.radius;
        if (outer_.reference.positions.empty() ||
            !(radius + range + motion_since(s, x, from, outer_.reference) <= outer_.pairs.reach)) {
            const double outer_range = larger(SelfVerletList::min_reach * s.shortest, 1.5 * range);
            outer_.pairs.build(s, from, x, radius + outer_range);
            store_reference(s, x, from.pose, outer_.reference);
        }
        filter(s, from, x, outer_.pairs, radius + range, inner_.pairs.triangles, inner_.pairs.edges);
        store_reference(s, x, from.pose, inner_.reference);
        inner_.margin = margin;
    }
    static void store_reference(const Surface& s, const double* x, const Pose& pose, ReferenceState& reference) {
        reference.positions.assign(x, x + 4 * s.count);
        reference.pose = pose;
    }
    static void filter(const Surface& s, const FeaturesAt& from, const double* x, const FeaturePairs& pairs,
                       double reach, PairList& triangles, PairList& edges) {
        const Quads at{x};
        triangles.clear();
        edges.clear();
        for (std::size_t k = 0; k < pairs.triangles.size(); ++k) {
            const Index a = pairs.triangles.first[k], b = pairs.triangles.second[k];
            if (point_square(s, from, at, a, b) < reach * reach) triangles.add(a, b);
        }
        for (std::size_t k = 0; k < pairs.edges.size(); ++k) {
            const Index a = pairs.edges.first[k], b = pairs.edges.second[k];
            if (edge_square(s, from, at, a, b) < reach * reach) edges.add(a, b);
        }
    }
    ListLevel outer_, inner_;
    double thickness_ = 0.0, motion_ = 0.0;  ///< upper bound since the inner list was built
};

/// The surface of the cloth and the features of each obstacle. `is_active[k]`: whether runs evaluate obstacle k.
struct FeatureContactModel {
    Surface surface;  ///< triangles with three free corners: anchored particles are not pushed
    double mass = 0.0;
    std::vector<Features> obstacles;
    std::vector<char> is_active;

    /// Set the number of obstacles; none has features then.
    void resize(std::int64_t count) {
        obstacles.assign(count, {});
        is_active.assign(count, 0);
        for (auto& lists : neighbors_) lists.clear();
    }
    /// Verlet lists of each obstacle, of a workspace. Queries use those of the first.
    std::vector<FeatureVerletList>& neighbors(int workspace = 0) {
        neighbors_[workspace].resize(obstacles.size());
        return neighbors_[workspace];
    }

    bool any() const { return std::find(is_active.begin(), is_active.end(), 1) != is_active.end(); }
    bool has(const Contacts& contacts, std::int64_t k) const {
        return !obstacles[k].points.empty() && contacts.present(k);
    }
    bool has_any(const Contacts& contacts) const {
        for (std::int64_t k = 0; k < contacts.count(); ++k)
            if (has(contacts, k)) return true;
        return false;
    }
    void activate_all(const Contacts& contacts) {
        for (std::int64_t k = 0; k < contacts.count(); ++k) is_active[k] = has(contacts, k);
    }
    FeatureLaw<double> law(const Contacts& contacts) const { return {contacts.thickness, contacts.damping, mass}; }

private:
    std::array<std::vector<FeatureVerletList>, plan::max_concurrency> neighbors_;
};

/// Call point(k, first, last) with the range of triangles of each point, and edge(k) with each pair of edges of `find`.
template <class P, class E>
inline void for_each_feature(const FeatureVerletList& neighbors, P&& point, E&& edge) {
    const PairList& t = neighbors.triangles;
    for (std::size_t first = 0, last; first < t.size(); first = last) {
        for (last = first; last < t.size() && t.first[last] == t.first[first];) ++last;
        point(t.first[first], first, last);
    }
    for (std::size_t k = 0; k < neighbors.edges.size(); ++k) edge(k);
}

}  // namespace cloth::contact
