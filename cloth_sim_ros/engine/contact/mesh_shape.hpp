// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Closed triangle mesh as an obstacle: nearest point, and whether a point is inside.
#pragma once

#include "contact/primitives.hpp"
#include "contact/surface.hpp"

namespace cloth::contact {

/// A point is inside according to the normal of the nearest face, edge or vertex: that of an edge is the sum of the
/// normals of its faces, that of a vertex the sum weighted by angles (J. A. Baerentzen and H. Aanaes, "Signed distance
/// computation using the angle weighted pseudonormal", IEEE Trans. Vis. Comput. Graph. 11, 2005).
class Mesh {
public:
    Mesh(std::int64_t vertices, const double* positions, std::int64_t triangles, const std::int64_t* corners) {
        for (std::int64_t k = 0; k < vertices; ++k)
            vertices_.push_back({positions[3 * k], positions[3 * k + 1], positions[3 * k + 2]});
        for (std::int64_t k = 0; k < triangles; ++k)
            triangles_.push_back({static_cast<Index>(corners[3 * k]), static_cast<Index>(corners[3 * k + 1]),
                                  static_cast<Index>(corners[3 * k + 2])});
        compute_normals();
        order_.resize(triangles_.size());
        std::iota(order_.begin(), order_.end(), Index{0});
        build_tree(0, static_cast<Index>(order_.size()));
        gather_leaves();
    }

    /// Nearest feature of the mesh: point `from`; its kind, a face, an edge or a vertex; and whether the query point is
    /// inside.
    struct NearestFeature {
        Vec3<double> from, along, normal;
        int kind = 0;  ///< 0 vertex, 1 edge, 2 face
        bool inside = false;
    };
    /// `hint`: a triangle that most likely is near; it becomes the nearest one. The result does not depend on it.
    NearestFeature nearest(Vec3<double> p, Index* hint = nullptr) const {
        Best best;
        if (hint) {
            // A little more than its distance, so that the search finds the same of several nearest triangles as without.
            const double square = near_triangle(p, corner(*hint, 0), corner(*hint, 1), corner(*hint, 2)).square;
            if (square < best.square) best.square = (1.0 + 1e-9) * square + 1e-30;
        }
        search(0, p, best);
        if (hint) *hint = best.triangle;
        const auto& t = triangles_[best.triangle];
        const Vec3<double> x[3] = {vertices_[t[0]], vertices_[t[1]], vertices_[t[2]]};
        int corner_index[3], count = 0;
        for (int k = 0; k < 3; ++k)
            if (best.point.weight[k] > 0.0) corner_index[count++] = k;
        NearestFeature s;
        s.from = x[0];
        if (!count) return s;  // the point is not finite
        s.kind = count - 1;
        s.from = x[corner_index[0]];
        s.normal = faces_[best.triangle];
        Vec3<double> pseudonormal = s.normal;
        if (s.kind == 1) {
            s.along = x[corner_index[1]] - x[corner_index[0]];
            // Edges run from corner 0 to 1, 1 to 2, 2 to 0.
            pseudonormal = edges_[best.triangle][corner_index[0] == 0 && corner_index[1] == 2 ? 2 : corner_index[0]];
        } else if (s.kind == 0) {
            pseudonormal = corners_[t[corner_index[0]]];
        }
        s.inside = dot(pseudonormal, best.point.away) < 0.0;
        return s;
    }

    /// Squared distance of a point from the box about the mesh [m^2]: a lower bound of that from the mesh, zero inside.
    double box_square(Vec3<double> p) const { return box_square(0, p); }

private:
    struct Node {
        AxisBox box;
        Index first, last;  ///< of the triangles in order
        Index left = -1, right = -1;
        Index leaf = -1;  ///< of a leaf
    };
    struct Best {
        double square = 1e300;
        Index triangle = 0;
        OnTriangle<double> point;
    };
    /// Maximum number of triangles in a leaf of the tree; whole vectors of them.
    static constexpr Index max_leaf_size = 4;
    static constexpr int leaf_pitch = std::max<int>(max_leaf_size, lanes<double>);

    Vec3<double> corner(Index triangle, int k) const { return vertices_[triangles_[triangle][k]]; }
    static Vec3<double> unit(Vec3<double> a) { return (1.0 / root(norm2(a))) * a; }
    /// Angle between two vectors: tangent of its half, halved three times, then the series of the arctangent.
    static double angle(Vec3<double> a, Vec3<double> b) {
        const double s = root(norm2(cross(a, b))), c = dot(a, b), length = root(norm2(a) * norm2(b));
        double t = c >= 0.0 ? s / (length + c) : (length - c) / s;
        for (int k = 0; k < 3; ++k) t = t / (1.0 + root(1.0 + t * t));
        double sum = 0.0;
        for (int k = 20; k >= 0; --k) sum = 1.0 / (2.0 * k + 1.0) - t * t * sum;
        return 16.0 * t * sum;
    }
    void compute_normals() {
        corners_.assign(vertices_.size(), {});
        for (std::size_t k = 0; k < triangles_.size(); ++k) {
            const auto& t = triangles_[k];
            const Vec3<double> x[3] = {vertices_[t[0]], vertices_[t[1]], vertices_[t[2]]};
            const Vec3<double> n = unit(cross(x[1] - x[0], x[2] - x[0]));
            faces_.push_back(n);
            for (int c = 0; c < 3; ++c) {
                const int next = (c + 1) % 3, last = (c + 2) % 3;
                corners_[t[c]] = corners_[t[c]] + angle(x[next] - x[c], x[last] - x[c]) * n;
            }
        }
        edges_.resize(triangles_.size());
        const std::vector<HalfEdge> half_edges = sorted_half_edges(triangles_);
        // In a closed mesh each edge has two triangles.
        for (std::size_t k = 0; k + 1 < half_edges.size(); k += 2) {
            const Vec3<double> sum = faces_[half_edges[k].triangle] + faces_[half_edges[k + 1].triangle];
            edges_[half_edges[k].triangle][half_edges[k].edge] = sum;
            edges_[half_edges[k + 1].triangle][half_edges[k + 1].edge] = sum;
        }
    }
    static double component(Vec3<double> a, int axis) { return axis == 0 ? a.x : axis == 1 ? a.y : a.z; }

    Index build_tree(Index first, Index last) {
        const auto node_index = static_cast<Index>(nodes_.size());
        AxisBox box(vertices_[triangles_[order_[first]][0]]);
        for (Index k = first; k < last; ++k)
            for (const Index corner : triangles_[order_[k]]) box.include(vertices_[corner]);
        nodes_.push_back({box, first, last});
        if (last - first <= max_leaf_size) return node_index;
        const Vec3<double> extent = box.high - box.low;
        const int axis = extent.x >= extent.y && extent.x >= extent.z ? 0 : extent.y >= extent.z ? 1 : 2;
        const auto center = [&](Index k) {
            const auto& t = triangles_[k];
            return component(vertices_[t[0]], axis) + component(vertices_[t[1]], axis) +
                   component(vertices_[t[2]], axis);
        };
        const Index half = first + (last - first) / 2;
        std::sort(order_.begin() + first, order_.begin() + last, [&](Index a, Index b) {
            const double u = center(a), v = center(b);
            return u != v ? u < v : a < b;
        });
        const Index left = build_tree(first, half), right = build_tree(half, last);
        nodes_[node_index].left = left;
        nodes_[node_index].right = right;
        return node_index;
    }
    /// Gather the corners of each leaf's triangles: 9 rows of numbers a leaf. The last triangle fills the vectors.
    void gather_leaves() {
        Index n_leaves = 0;
        for (Node& node : nodes_)
            if (node.left < 0) node.leaf = n_leaves++;
        leaf_corners_.resize(9 * leaf_pitch * n_leaves);
        for (const Node& node : nodes_)
            for (int k = 0; node.left < 0 && k < leaf_pitch; ++k)
                for (int c = 0; c < 3; ++c) {
                    const Vec3<double> x = corner(order_[std::min<Index>(node.first + k, node.last - 1)], c);
                    double* const to = leaf_corners_.data() + 9 * leaf_pitch * node.leaf + 3 * leaf_pitch * c + k;
                    to[0] = x.x, to[leaf_pitch] = x.y, to[2 * leaf_pitch] = x.z;
                }
    }
    double box_square(Index node, Vec3<double> p) const {
        const AxisBox& box = nodes_[node].box;
        const auto out = [](double a, double low, double high) { return larger(larger(low - a, a - high), 0.0); };
        return norm2(Vec3<double>{out(p.x, box.low.x, box.high.x), out(p.y, box.low.y, box.high.y),
                                  out(p.z, box.low.z, box.high.z)});
    }
    void search(Index node_index, Vec3<double> p, Best& best) const {
        const Node& node = nodes_[node_index];
        if (node.left < 0) {
            using V = vec<double>;
            const double* numbers = leaf_corners_.data() + 9 * leaf_pitch * node.leaf;
            const auto corners = [&](int k) {
                const double* const from = numbers + 3 * leaf_pitch * k;
                return Vec3<V>{load(from), load(from + leaf_pitch), load(from + 2 * leaf_pitch)};
            };
            for (Index first = node.first; first < node.last; first += lanes<double>, numbers += lanes<double>) {
                const OnTriangle<V> n = near_triangle(Vec3<V>{splat<V>(p.x), splat<V>(p.y), splat<V>(p.z)}, corners(0),
                                                      corners(1), corners(2));
                for (int k = 0; k < lanes<double> && first + k < node.last; ++k)
                    if (n.square[k] < best.square)
                        best = {n.square[k],
                                order_[first + k],
                                {{n.weight[0][k], n.weight[1][k], n.weight[2][k]},
                                 n.square[k],
                                 {n.away.x[k], n.away.y[k], n.away.z[k]}}};
            }
            return;
        }
        const double left = box_square(node.left, p), right = box_square(node.right, p);
        const bool first = left <= right;
        if ((first ? left : right) < best.square) search(first ? node.left : node.right, p, best);
        if ((first ? right : left) < best.square) search(first ? node.right : node.left, p, best);
    }

    std::vector<Vec3<double>> vertices_, faces_, corners_;
    std::vector<std::array<Index, 3>> triangles_;
    std::vector<std::array<Vec3<double>, 3>> edges_;
    std::vector<Index> order_;
    std::vector<Node> nodes_;
    Array<double> leaf_corners_;
};

}  // namespace cloth::contact
