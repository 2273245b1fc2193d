// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Points and edges of obstacles, with a radius, and their neighbours: triangles and edges of the cloth. Verlet lists are
// valid until something has moved too far. No bit depends on when they are rebuilt.
#pragma once

#include <optional>

#include "contact/self_contact.hpp"

namespace cloth::contact {

/// Points of one obstacle in its own frame, edges between them, and their radius [m]: the centre of a ball, corners and
/// edges of a box. `reach` [m]: largest distance of a point from the origin of the frame.
struct Features {
    std::vector<Vec3<double>> points;
    std::vector<std::array<Index, 2>> edges;
    double radius = 0.0, reach = 0.0;
};

/// Features at one time. `lever` [m]: vector from the reference point of torques (the gripper of a jaw) to the
/// position.
struct FeaturesAt {
    const Features& features;
    const Pose& pose;
    Vec3<double> lever{};

    Vec3<double> arm(Index k) const {
        const Vec3<double> p = features.points[k];
        return p.x * pose.rotation[0] + p.y * pose.rotation[1] + p.z * pose.rotation[2];
    }
    Vec3<double> position(Index k) const { return pose.position + arm(k); }
    Vec3<double> velocity(Index k) const { return pose.velocity + cross(pose.spin, arm(k)); }
};

/// Functions of the corners of gaps: positions and velocities of particles, by `at`, and of points of an obstacle, ~k.
template <class X>
auto with_point_positions(const FeaturesAt& from, const X& at) {
    return [&](Index c) {
        using V = decltype(at(c).x);
        return c < 0 ? splat3<V>(from.position(~c)) : at(c);
    };
}
template <class X>
auto with_point_velocities(const FeaturesAt& from, const X& at) {
    return [&](Index c) {
        using V = decltype(at(c).x);
        return c < 0 ? splat3<V>(from.velocity(~c)) : at(c);
    };
}

/// Box of the edges of a surface.
inline AxisBox box_of_edges(const Surface& s, const Quads& at) {
    AxisBox box(at(s.edges[0][0]));
    for (const auto& e : s.edges)
        for (const Index c : e) box.include(at(c));
    return box;
}
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

/// Corners of pair k of an obstacle: its point ~k and those of the triangle; or those of the cloth's edge and of the
/// obstacle's.
template <bool Edges>
inline std::array<Index, 4> feature_corners(const Surface& s, const Features& features, const PairList& pairs,
                                            std::size_t k) {
    if constexpr (Edges) {
        const auto &edge = s.edges[pairs.second[k]], &obstacle_edge = features.edges[pairs.first[k]];
        return {edge[0], edge[1], ~obstacle_edge[0], ~obstacle_edge[1]};
    } else {
        const auto& t = s.triangles[pairs.second[k]];
        return {~pairs.first[k], t[0], t[1], t[2]};
    }
}

/// Pairs of one obstacle: point and triangle, edge of the obstacle and edge of the cloth.
struct FeaturePairs : PairLists {
    double reach = -1.0;

    /// Build the list of all pairs within `max_distance` [m], radius included. Positions are quads.
    void build(const Surface& s, const FeaturesAt& from, const double* x, double max_distance) {
        reach = -1.0;  // an exception may end this
        FeaturePairs near;
        if (!s.triangles.empty() && !from.features.points.empty()) near.find(s, from, Quads{x}, max_distance);
        near.measure(s, from, x);
        select(near, max_distance, max_distance);
        reach = max_distance;
    }
    /// Measure the squared distances of all pairs.
    void measure(const Surface& s, const FeaturesAt& from, const double* x) {
        measure<false>(s, from, Quads{x}, triangles);
        measure<true>(s, from, Quads{x}, edges);
    }

private:
    template <bool Edges>
    static void measure(const Surface& s, const FeaturesAt& from, const Quads& at, PairList& pairs) {
        using V = vec<double>;
        pairs.square.resize(pairs.size() + lanes<double>);
        const Pose& pose = from.pose;
        const Vec3<V> position = splat3<V>(pose.position),
                      axis[3] = {splat3<V>(pose.rotation[0]), splat3<V>(pose.rotation[1]), splat3<V>(pose.rotation[2])};
        for (std::size_t k = 0; k < pairs.size(); k += lanes<double>) {
            // Points of the obstacle are in its frame. The last pair fills the vectors.
            alignas(64) double numbers[4][3][lanes<double>];
            for (int lane = 0; lane < lanes<double>; ++lane) {
                const auto corners =
                    feature_corners<Edges>(s, from.features, pairs, std::min(k + lane, pairs.size() - 1));
                for (int j = 0; j < 4; ++j) {
                    const Vec3<double> p = corners[j] < 0 ? from.features.points[~corners[j]] : at(corners[j]);
                    numbers[j][0][lane] = p.x, numbers[j][1][lane] = p.y, numbers[j][2][lane] = p.z;
                }
            }
            Vec3<V> x[4];
            for (int j = 0; j < 4; ++j) {
                x[j] = {load(numbers[j][0]), load(numbers[j][1]), load(numbers[j][2])};
                if (Edges ? j > 1 : j < 1) x[j] = position + (x[j].x * axis[0] + x[j].y * axis[1] + x[j].z * axis[2]);
            }
            if constexpr (Edges)
                store(pairs.square.data() + k, near_segments(x[0], x[1], x[2], x[3]).square);
            else
                store(pairs.square.data() + k, near_triangle(x[0], x[1], x[2], x[3]).square);
        }
    }
    void find(const Surface& s, const FeaturesAt& from, const Quads& at, double range) {
        const double length = longest_edge(s, at);
        const AxisBox search_box = box_of_edges(s, at).expanded(range);
        std::vector<Index> points;
        for (Index k = 0; k < std::ssize(from.features.points); ++k)
            if (search_box.overlaps(AxisBox(from.position(k)))) points.push_back(k);
        find_triangles(
            s, at, length, range, std::ssize(points), [&](std::int64_t k) { return from.position(points[k]); },
            [](Index) { return Index{-1}; }, triangles);
        for (Index& k : triangles.first) k = points[k];
        std::optional<EdgeGrid> grid;
        std::vector<Index> hits;
        for (std::size_t edge = 0; edge < from.features.edges.size(); ++edge) {
            const Vec3<double> a = from.position(from.features.edges[edge][0]),
                               b = from.position(from.features.edges[edge][1]);
            double first, last;
            clip(search_box, a, b, first, last);
            if (!(first <= last)) continue;
            if (!grid) grid.emplace(s, at, length + range);
            // Search in pieces as long as a cell: the box of a whole long edge would contain half the cloth.
            const double pieces = larger(std::ceil((last - first) * root(norm2(b - a)) / (length + range)), 1.0);
            hits.clear();
            for (double piece = 0.0; piece < pieces; piece += 1.0) {
                const double span = (last - first) / pieces, begin = first + piece * span;
                const AxisBox box({a + begin * (b - a), a + (begin + span) * (b - a)});
                grid->for_each_overlap(box.expanded(range), {-1, -1}, 0, [&](Index e) { hits.push_back(e); });
            }
            std::sort(hits.begin(), hits.end());
            hits.erase(std::unique(hits.begin(), hits.end()), hits.end());
            for (const Index e : hits) edges.add(static_cast<Index>(edge), e);
        }
    }
};

/// Upper bound of the displacement of a point at a distance `reach` [m] by the rotation between two poses.
inline double rotation_displacement(const Pose& a, const Pose& b, double reach) {
    double square = 0.0;
    for (int j = 0; j < 3; ++j) square += norm2(a.rotation[j] - b.rotation[j]);
    return root(square) * reach;
}

/// Upper bound of the motion of the cloth relative to an obstacle that moves between two poses.
inline double max_relative_motion(MotionBound cloth, const Features& features, const Pose& from, const Pose& to) {
    cloth.include(to.position - from.position);
    return cloth.diameter() + rotation_displacement(to, from, features.reach);
}

/// Pairs of the last `find`, by Verlet lists of the features of one obstacle, kept between calls. Concurrent runs need
/// one each.
class FeatureVerletList : public PairLists {
public:
    /// Find the pairs nearer than thickness + margin [m], in addition to the radius. Return false if a position is not
    /// finite, or if that distance is at least four times the shortest edge.
    bool find(const Surface& s, const double* x, const FeaturesAt& from, double thickness, double margin) {
        return update(s, x, from, thickness, margin, std::numeric_limits<double>::infinity());
    }
    /// The same for each step of a run. `motion`: upper bound of the relative motion of cloth and obstacle since the
    /// last call [m]; infinite after any other call.
    bool update(const Surface& s, const double* x, const FeaturesAt& from, double thickness, double margin,
                double motion) {
        const double range = thickness + margin, reach = from.features.radius + range;
        if (!(range < 4.0 * s.shortest)) return false;
        inner_margin_left_ -= motion;
        if (thickness != thickness_ || !(margin <= inner_margin_left_)) {
            if (!(motion_since(s, x, from, ReferenceState{}) < 1e30)) return false;
            rebuild_inner(s, x, from, thickness, margin);
        } else {
            inner_.measure(s, from, x);
        }
        select(inner_, reach, reach);
        return true;
    }

private:
    /// Margin of the inner list beyond the look-ahead distance: a multiple of that, within fractions of the thickness.
    /// The middle list has a fraction more.
    static constexpr double inner_margin_factor = 4.0, min_inner_margin = 0.02, max_inner_margin = 0.3,
                            middle_margin = 0.3;

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
        const bool has_reference = !reference.positions.empty();
        MotionBound motion;
        motion.include(x, has_reference ? reference.positions.data() : nullptr, s.count);
        if (has_reference) return max_relative_motion(motion, from.features, reference.pose, from.pose);
        motion.include(from.pose.position);
        return motion.diameter();
    }
    /// Rebuild the inner list, measured at x, with a margin beyond the look-ahead distance.
    void rebuild_inner(const Surface& s, const double* x, const FeaturesAt& from, double thickness, double margin) {
        inner_margin_left_ = -1.0;
        const double extra = inner_margin_factor * margin;
        margin += smaller(larger(extra, min_inner_margin * thickness), max_inner_margin * thickness);
        const double reach = from.features.radius + thickness + margin;
        if (thickness != thickness_ || middle_.reference.positions.empty() ||
            !(margin + motion_since(s, x, from, middle_.reference) <= middle_.margin)) {
            thickness_ = thickness;
            rebuild_middle(s, x, from, margin + middle_margin * thickness);
        } else {
            middle_.pairs.measure(s, from, x);
        }
        inner_.select(middle_.pairs, reach, reach);
        inner_margin_left_ = margin;
    }
    void rebuild_middle(const Surface& s, const double* x, const FeaturesAt& from, double margin) {
        middle_.margin = -1.0;
        const double range = thickness_ + margin, radius = from.features.radius;
        if (outer_.reference.positions.empty() ||
            !(radius + range + motion_since(s, x, from, outer_.reference) <= outer_.pairs.reach)) {
            const double outer_range = larger(SelfVerletList::min_reach * s.shortest, 1.5 * range);
            outer_.pairs.build(s, from, x, radius + outer_range);
            store_reference(s, x, from.pose, outer_.reference);
        } else {
            outer_.pairs.measure(s, from, x);
        }
        middle_.pairs.select(outer_.pairs, radius + range, radius + range);
        store_reference(s, x, from.pose, middle_.reference);
        middle_.margin = margin;
    }
    static void store_reference(const Surface& s, const double* x, const Pose& pose, ReferenceState& reference) {
        reference.positions.assign(x, x + 4 * s.count);
        reference.pose = pose;
    }
    ListLevel outer_, middle_;
    FeaturePairs inner_;
    double thickness_ = 0.0;
    double inner_margin_left_ = -1.0;  ///< lower bound of the inner list's margin beyond the thickness at present
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
    SurfaceLaw<double> law(const Contacts& contacts) const { return {contacts.thickness, contacts.damping, mass}; }

private:
    std::array<std::vector<FeatureVerletList>, plan::max_concurrency> neighbors_;
};

}  // namespace cloth::contact
