// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Which points and edges of obstacles may come near which triangles and edges of the cloth. Lists of pairs hold until
// something has moved too far, and no bit depends on when they were made.
#pragma once

#include "contact_features.hpp"
#include "self_contact.hpp"

namespace cloth {

/// A box along the axes.
struct Bounds {
    Vec3<double> low, high;

    explicit Bounds(Vec3<double> a) : low(a), high(a) {}
    void take(Vec3<double> a) {
        low = {smaller(a.x, low.x), smaller(a.y, low.y), smaller(a.z, low.z)};
        high = {larger(a.x, high.x), larger(a.y, high.y), larger(a.z, high.z)};
    }
    Bounds grown(double by) const {
        const Vec3<double> more{by, by, by};
        Bounds b(low - more);
        b.high = high + more;
        return b;
    }
    bool meets(const Bounds& b) const {
        return b.high.x >= low.x && b.low.x <= high.x && b.high.y >= low.y && b.low.y <= high.y &&
               b.high.z >= low.z && b.low.z <= high.z;
    }
    Vec3<double> middle() const { return 0.5 * (low + high); }
};

/// Which part of the way from a to b is in a box: from share `first` to `last`, in reverse order where none is.
inline void clip(const Bounds& box, Vec3<double> a, Vec3<double> b, double& first, double& last) {
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

    /// All pairs within a reach [m], radius included. Positions are quads.
    void make(const Surface& s, const FeaturesAt& from, const double* x, double wanted) {
        reach = wanted;
        triangles.clear();
        edges.clear();
        if (s.triangles.empty() || from.features.points.empty()) return;
        const Quads at{x};
        double length = 0.0;
        Bounds cloth(at(s.edges[0][0]));
        for (const auto& e : s.edges) {
            length = larger(norm2(at(e[0]) - at(e[1])), length);
            cloth.take(at(e[0]));
            cloth.take(at(e[1]));
        }
        length = root(length);
        const Bounds room = cloth.grown(reach);
        const auto count = static_cast<Index>(from.features.points.size());
        std::vector<Index> points, sides;
        for (Index k = 0; k < count; ++k)
            if (room.meets(Bounds(from.place(k)))) points.push_back(k);
        for (std::size_t e = 0; e < from.features.edges.size(); ++e) {
            double first, last;
            clip(room, from.place(from.features.edges[e][0]), from.place(from.features.edges[e][1]), first, last);
            if (first <= last) sides.push_back(static_cast<Index>(e));
        }
        if (!points.empty()) find_triangles(s, from, at, points, length);
        if (!sides.empty()) find_edges(s, from, at, sides, room, length);
    }

private:
    void find_triangles(const Surface& s, const FeaturesAt& from, const Quads& at, const std::vector<Index>& points,
                        double length) {
        std::vector<Bounds> boxes;
        boxes.reserve(s.triangles.size());
        for (const auto& t : s.triangles) {
            boxes.emplace_back(at(t[0]));
            boxes.back().take(at(t[1]));
            boxes.back().take(at(t[2]));
        }
        const Lookup cells(boxes, length + reach);
        std::vector<Index> found;
        for (const Index k : points) {
            const Vec3<double> p = from.place(k);
            const Bounds box = Bounds(p).grown(reach);
            cells.each(box, length, found);
            for (const Index t : found) {
                if (!box.meets(boxes[t])) continue;
                const auto& c = s.triangles[t];
                if (near_triangle(p, at(c[0]), at(c[1]), at(c[2])).square < reach * reach) triangles.add(k, t);
            }
        }
    }
    void find_edges(const Surface& s, const FeaturesAt& from, const Quads& at, const std::vector<Index>& sides,
                    const Bounds& room, double length) {
        std::vector<Bounds> boxes;
        boxes.reserve(s.edges.size());
        for (const auto& e : s.edges) {
            boxes.emplace_back(at(e[0]));
            boxes.back().take(at(e[1]));
        }
        const Lookup cells(boxes, length + reach);
        std::vector<Index> found, all;
        for (const Index side : sides) {
            const Vec3<double> a = from.place(from.features.edges[side][0]), b = from.place(from.features.edges[side][1]);
            double first, last;
            clip(room, a, b, first, last);
            // Pieces as long as a cell: the box of all of a long edge would hold half the cloth.
            const double pieces = std::ceil((last - first) * root(norm2(b - a)) / (length + reach));
            all.clear();
            for (double piece = 0.0; piece < larger(pieces, 1.0); piece += 1.0) {
                const double span = (last - first) / larger(pieces, 1.0), begin = first + piece * span;
                Bounds box(a + begin * (b - a));
                box.take(a + (begin + span) * (b - a));
                box = box.grown(reach);
                cells.each(box, length, found);
                for (const Index e : found)
                    if (box.meets(boxes[e])) all.push_back(e);
            }
            std::sort(all.begin(), all.end());
            all.erase(std::unique(all.begin(), all.end()), all.end());
            for (const Index e : all)
                if (near_segments(at(s.edges[e][0]), at(s.edges[e][1]), a, b).square < reach * reach) edges.add(side, e);
        }
    }
    /// Boxes by the cells that their middles are in; all of them where a search would look at more cells than that.
    class Lookup {
    public:
        Lookup(const std::vector<Bounds>& boxes, double size)
            : size_(size), count_(static_cast<Index>(boxes.size())), cells_(count_, size) {
            cells_.fill([&](std::int64_t k) { return boxes[k].middle(); });
        }
        /// Those that may meet a box, none with a side longer than `length`, in ascending order.
        void each(const Bounds& box, double length, std::vector<Index>& found) const {
            found.clear();
            const Bounds wide = box.grown(0.5 * length);
            const Vec3<double> many = (1.0 / size_) * (wide.high - wide.low);
            if ((many.x + 1.0) * (many.y + 1.0) * (many.z + 1.0) > static_cast<double>(count_)) {
                for (Index k = 0; k < count_; ++k) found.push_back(k);
                return;
            }
            cells_.each(wide.low, wide.high, [&](Index k) { found.push_back(k); });
            std::sort(found.begin(), found.end());
        }

    private:
        double size_;
        Index count_;
        Cells cells_;
    };
};

/// How far a turn from one pose to another leads a point at a reach [m], at most.
inline double turned(const Pose& a, const Pose& b, double reach) {
    double square = 0.0;
    for (int j = 0; j < 3; ++j) square += norm2(a.rotation[j] - b.rotation[j]);
    return root(square) * reach;
}

/// One obstacle's features, and who of the cloth is near them, kept from one call to the next.
class NearFeatures {
public:
    Features features;
    /// Of the last `find`: pairs that are near.
    PairList triangles, edges;

    /// Find the pairs that are nearer than thickness + beyond [m], the radius aside. False where a position is not
    /// finite, or where that is at least four times the cloth's shortest edge.
    bool find(const Surface& s, const double* x, const Pose& pose, double thickness, double beyond) {
        return follow(s, x, pose, thickness, beyond, std::numeric_limits<double>::infinity());
    }
    /// The same for a run, in every step. `moved` is how far cloth and obstacle have moved relative to each other since the
    /// last call [m], at most; after anything else than that it is infinite.
    bool follow(const Surface& s, const double* x, const Pose& pose, double thickness, double beyond, double moved) {
        const double wanted = thickness + beyond;
        if (!(wanted < 4.0 * s.shortest)) return false;
        way_ += moved;
        if (thickness != thickness_ || !(beyond + way_ <= near_.beyond)) {
            if (!(since(s, x, pose, Place{}) < 1e30)) return false;
            way_ = since(s, x, pose, near_.place);
            if (thickness != thickness_ || !(beyond + way_ <= near_.beyond)) {
                thickness_ = thickness;
                take_near(s, x, pose, beyond + 0.6 * thickness);
                way_ = 0.0;
            }
        }
        choose(s, {features, pose}, x, near_.pairs, features.radius + wanted, triangles, edges);
        return true;
    }
    /// Squared distances of a pair's two sides [m^2].
    static double point_square(const Surface& s, const FeaturesAt& from, const Quads& at, Index point, Index triangle) {
        const auto& t = s.triangles[triangle];
        return near_triangle(from.place(point), at(t[0]), at(t[1]), at(t[2])).square;
    }
    static double edge_square(const Surface& s, const FeaturesAt& from, const Quads& at, Index edge, Index own) {
        const auto &a = s.edges[own], &b = from.features.edges[edge];
        return near_segments(at(a[0]), at(a[1]), from.place(b[0]), from.place(b[1])).square;
    }

private:
    struct Place {
        Array<double> places;
        Pose pose{};
    };
    struct Found {
        FeaturePairs pairs;
        Place place;
        double beyond = -1.0;
    };
    /// How far cloth and obstacle have moved relative to each other since then; without places, since the origin.
    double since(const Surface& s, const double* x, const Pose& pose, const Place& then) const {
        Spread spread;
        const bool known = !then.places.empty();
        for (std::int64_t i = 0; i < s.count; ++i) {
            const quad<double> now = load4(x + 4 * i);
            spread.take(known ? quad<double>(now - load4(then.places.data() + 4 * i)) : now);
        }
        const Vec3<double> way = known ? pose.place - then.pose.place : pose.place;
        spread.take(quad<double>{way.x, way.y, way.z, 0.0});
        return spread.most() + (known ? turned(pose, then.pose, features.reach) : 0.0);
    }
    void take_near(const Surface& s, const double* x, const Pose& pose, double beyond) {
        const double wanted = thickness_ + beyond;
        if (far_.place.places.empty() ||
            !(features.radius + wanted + since(s, x, pose, far_.place) <= far_.pairs.reach)) {
            const double most = larger(SelfContact::usual * s.shortest, 1.5 * wanted);
            far_.pairs.make(s, {features, pose}, x, features.radius + most);
            keep(s, x, pose, far_.place);
        }
        choose(s, {features, pose}, x, far_.pairs, features.radius + wanted, near_.pairs.triangles, near_.pairs.edges);
        keep(s, x, pose, near_.place);
        near_.beyond = beyond;
    }
    static void keep(const Surface& s, const double* x, const Pose& pose, Place& place) {
        place.places.assign(x, x + 4 * s.count);
        place.pose = pose;
    }
    static void choose(const Surface& s, const FeaturesAt& from, const double* x, const FeaturePairs& pairs, double reach,
                       PairList& triangles, PairList& edges) {
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
    Found far_, near_;
    double thickness_ = 0.0, way_ = 0.0;  ///< since the near ones were found, at most
};

/// The cloth's surface and what obstacles have that may come through it. `acts[k]`: whether runs look at obstacle k's.
struct FeatureContact {
    Surface surface;  ///< of triangles whose corners all move: what is anchored is not pushed
    double mass = 0.0;
    std::vector<NearFeatures> obstacles;
    std::vector<char> acts;

    bool any() const { return std::find(acts.begin(), acts.end(), 1) != acts.end(); }
    bool has(const Contacts& contacts, std::int64_t k) const {
        return !obstacles[k].features.points.empty() && contacts.present(k);
    }
    bool has_any(const Contacts& contacts) const {
        for (std::int64_t k = 0; k < contacts.count(); ++k)
            if (has(contacts, k)) return true;
        return false;
    }
    void wake(const Contacts& contacts) {
        for (std::int64_t k = 0; k < contacts.count(); ++k) acts[k] = has(contacts, k);
    }
    FeatureLaw<double> law(const Contacts& contacts) const { return {contacts.thickness, contacts.damping, mass}; }
};

/// Call `point(k, first, last)` with ranges of a point's triangles and `edge(k)` with each pair of edges that `find` found.
template <class P, class E>
inline void for_each_feature(const NearFeatures& near, P&& point, E&& edge) {
    const PairList& t = near.triangles;
    for (std::size_t first = 0, last; first < t.size(); first = last) {
        for (last = first; last < t.size() && t.first[last] == t.first[first];) ++last;
        point(t.first[first], first, last);
    }
    for (std::size_t k = 0; k < near.edges.size(); ++k) edge(k);
}

}  // namespace cloth
