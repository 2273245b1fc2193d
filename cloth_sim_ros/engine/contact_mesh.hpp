// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// A closed triangle mesh as an obstacle: which point of it is nearest, and on which side of it a point is.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <numeric>
#include <vector>

#include "self_near.hpp"

namespace cloth {

/// Which side is told by the normal of the face, the edge or the vertex that is nearest: an edge's is the sum of those of
/// its faces, a vertex's that of its faces weighted by their angles there (J. A. Baerentzen and H. Aanaes, "Signed distance
/// computation using the angle weighted pseudonormal", IEEE Trans. Vis. Comput. Graph. 11, 2005).
class Mesh {
public:
    Mesh(std::int64_t vertices, const double* places, std::int64_t triangles, const std::int64_t* corners) {
        for (std::int64_t k = 0; k < vertices; ++k)
            vertices_.push_back({places[3 * k], places[3 * k + 1], places[3 * k + 2]});
        for (std::int64_t k = 0; k < triangles; ++k)
            triangles_.push_back({static_cast<Number>(corners[3 * k]), static_cast<Number>(corners[3 * k + 1]),
                                  static_cast<Number>(corners[3 * k + 2])});
        take_normals();
        order_.resize(triangles_.size());
        std::iota(order_.begin(), order_.end(), Number{0});
        split(0, static_cast<Number>(order_.size()));
    }

    /// What of the mesh is nearest: `from` on it; a face (two directions in it), an edge (one) or a vertex; and whether the
    /// point is within.
    struct Site {
        Vec3<double> from, along, normal;
        int kind = 0;  ///< 0 a vertex, 1 an edge, 2 a face
        bool within = false;
    };
    Site site(Vec3<double> p) const {
        Best best;
        look(0, p, best);
        const auto& t = triangles_[best.triangle];
        const Vec3<double> x[3] = {vertices_[t[0]], vertices_[t[1]], vertices_[t[2]]};
        int there[3], count = 0;
        for (int k = 0; k < 3; ++k)
            if (best.near.weight[k] > 0.0) there[count++] = k;
        Site s;
        s.from = x[0];
        if (!count) return s;  // no place at all
        s.kind = count - 1;
        s.from = x[there[0]];
        s.normal = faces_[best.triangle];
        Vec3<double> side = s.normal;
        if (s.kind == 1) {
            s.along = x[there[1]] - x[there[0]];
            // Sides run from corner 0 to 1, 1 to 2, 2 to 0.
            side = edges_[best.triangle][there[0] == 0 && there[1] == 2 ? 2 : there[0]];
        } else if (s.kind == 0) {
            side = corners_[t[there[0]]];
        }
        s.within = dot(side, best.near.away) < 0.0;
        return s;
    }

private:
    using Number = std::int32_t;
    struct Node {
        Vec3<double> low, high;
        Number first, last;  ///< of the triangles in order
        Number left = -1, right = -1;
    };
    struct Best {
        double square = 1e300;
        Number triangle = 0;
        OnTriangle<double> near;
    };
    /// A box of the tree has no more triangles than this, or two boxes.
    static constexpr Number few = 4;

    static Vec3<double> unit(Vec3<double> a) { return (1.0 / root(norm2(a))) * a; }
    /// Angle between two vectors: tan of half of it, halved thrice, and the series of the arctangent.
    static double angle(Vec3<double> a, Vec3<double> b) {
        const double s = root(norm2(cross(a, b))), c = dot(a, b), length = root(norm2(a) * norm2(b));
        double t = c >= 0.0 ? s / (length + c) : (length - c) / s;
        for (int k = 0; k < 3; ++k) t = t / (1.0 + root(1.0 + t * t));
        double sum = 0.0;
        for (int k = 20; k >= 0; --k) sum = 1.0 / (2.0 * k + 1.0) - t * t * sum;
        return 16.0 * t * sum;
    }
    void take_normals() {
        struct Side {
            Number low, high, triangle;
            int which;
        };
        std::vector<Side> sides;
        corners_.assign(vertices_.size(), {});
        for (std::size_t k = 0; k < triangles_.size(); ++k) {
            const auto& t = triangles_[k];
            const Vec3<double> x[3] = {vertices_[t[0]], vertices_[t[1]], vertices_[t[2]]};
            const Vec3<double> n = unit(cross(x[1] - x[0], x[2] - x[0]));
            faces_.push_back(n);
            for (int c = 0; c < 3; ++c) {
                const int next = (c + 1) % 3, last = (c + 2) % 3;
                corners_[t[c]] = corners_[t[c]] + angle(x[next] - x[c], x[last] - x[c]) * n;
                sides.push_back({std::min(t[c], t[next]), std::max(t[c], t[next]), static_cast<Number>(k), c});
            }
        }
        edges_.resize(triangles_.size());
        std::stable_sort(sides.begin(), sides.end(), [](const Side& a, const Side& b) {
            return a.low != b.low ? a.low < b.low : a.high < b.high;
        });
        // A closed mesh: each edge has two triangles.
        for (std::size_t k = 0; k + 1 < sides.size(); k += 2) {
            const Vec3<double> sum = faces_[sides[k].triangle] + faces_[sides[k + 1].triangle];
            edges_[sides[k].triangle][sides[k].which] = sum;
            edges_[sides[k + 1].triangle][sides[k + 1].which] = sum;
        }
    }
    static double part(Vec3<double> a, int axis) { return axis == 0 ? a.x : axis == 1 ? a.y : a.z; }

    Number split(Number first, Number last) {
        const auto number = static_cast<Number>(nodes_.size());
        Vec3<double> low = vertices_[triangles_[order_[first]][0]], high = low;
        for (Number k = first; k < last; ++k)
            for (const Number corner : triangles_[order_[k]]) {
                const Vec3<double> a = vertices_[corner];
                low = {smaller(a.x, low.x), smaller(a.y, low.y), smaller(a.z, low.z)};
                high = {larger(a.x, high.x), larger(a.y, high.y), larger(a.z, high.z)};
            }
        nodes_.push_back({low, high, first, last});
        if (last - first <= few) return number;
        const Vec3<double> wide = high - low;
        const int axis = wide.x >= wide.y && wide.x >= wide.z ? 0 : wide.y >= wide.z ? 1 : 2;
        const auto middle = [&](Number k) {
            const auto& t = triangles_[k];
            return part(vertices_[t[0]], axis) + part(vertices_[t[1]], axis) + part(vertices_[t[2]], axis);
        };
        const Number half = first + (last - first) / 2;
        std::sort(order_.begin() + first, order_.begin() + last, [&](Number a, Number b) {
            const double u = middle(a), v = middle(b);
            return u != v ? u < v : a < b;
        });
        const Number left = split(first, half), right = split(half, last);
        nodes_[number].left = left;
        nodes_[number].right = right;
        return number;
    }
    double away(Number node, Vec3<double> p) const {
        const Node& n = nodes_[node];
        const auto out = [](double a, double low, double high) { return larger(larger(low - a, a - high), 0.0); };
        return norm2(Vec3<double>{out(p.x, n.low.x, n.high.x), out(p.y, n.low.y, n.high.y), out(p.z, n.low.z, n.high.z)});
    }
    void look(Number number, Vec3<double> p, Best& best) const {
        const Node& node = nodes_[number];
        if (node.left < 0) {
            for (Number k = node.first; k < node.last; ++k) {
                const auto& t = triangles_[order_[k]];
                const auto near = near_triangle(p, vertices_[t[0]], vertices_[t[1]], vertices_[t[2]]);
                if (near.square < best.square) best = {near.square, order_[k], near};
            }
            return;
        }
        const double left = away(node.left, p), right = away(node.right, p);
        const bool first = left <= right;
        if ((first ? left : right) < best.square) look(first ? node.left : node.right, p, best);
        if ((first ? right : left) < best.square) look(first ? node.right : node.left, p, best);
    }

    std::vector<Vec3<double>> vertices_, faces_, corners_;
    std::vector<std::array<Number, 3>> triangles_;
    std::vector<std::array<Vec3<double>, 3>> edges_;
    std::vector<Number> order_;
    std::vector<Node> nodes_;
};

}  // namespace cloth
