// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Bounds of the relative motion of particles: of all of them, and of patches of the surface.
#pragma once

#include <limits>

#include "contact/broad_phase.hpp"

namespace cloth::contact {

/// Upper bound of the relative motion of any two particles: diagonal of the bounding box of all displacements. NaN if a
/// displacement is not finite.
class MotionBound {
public:
    CLOTH_INLINE void include(quad<double> displacement) {
        low_ = smaller(displacement, low_);
        high_ = larger(displacement, high_);
        nan_check_ = fma(displacement, quad<double>{}, nan_check_);
    }
    void include(Vec3<double> displacement) {
        include(quad<double>{displacement.x, displacement.y, displacement.z, 0.0});
    }
    void include(const MotionBound& other) {
        low_ = smaller(other.low_, low_);
        high_ = larger(other.high_, high_);
        nan_check_ += other.nan_check_;
    }
    /// Include the displacements of n quads from reference positions; from the origin if these are null.
    void include(const double* x, const double* reference, std::int64_t n) {
        // Independent bounds, because each waits for the one before.
        MotionBound all[4];
        const auto include_quad = [&](std::int64_t i, MotionBound& bound) CLOTH_INLINED {
            const quad<double> at = load4(x + 4 * i);
            bound.include(reference ? quad<double>(at - load4(reference + 4 * i)) : at);
        };
        std::int64_t i = 0;
        for (; i + 4 <= n; i += 4)
            for (int k = 0; k < 4; ++k) include_quad(i + k, all[k]);
        for (; i < n; ++i) include_quad(i, all[0]);
        for (const MotionBound& bound : all) include(bound);
    }
    /// Extent of the bounding box.
    quad<double> extent() const { return high_ - low_ + nan_check_; }
    double diameter() const {
        const quad<double> w = extent();
        return root(norm2(Vec3<double>{w[0], w[1], w[2]}));
    }
    /// Vector between the nearest points of two boxes.
    static quad<double> gap(const MotionBound& a, const MotionBound& b) {
        return larger(larger(quad<double>(a.low_ - b.high_), quad<double>(b.low_ - a.high_)), quad<double>{});
    }

private:
    quad<double> low_ = quad<double>{} + 1e300, high_ = quad<double>{} - 1e300, nan_check_{};
};

/// Upper bound of the relative motion of the sides of a pair [m], from the displacements of its corners. No point of a
/// side moves further, relative to a corner, than the side's corners. That corner is an obstacle's if there is one.
template <bool Edges, class F>
inline double relative_motion(const std::array<Index, 4>& corner, F&& displacement) {
    const int first = Edges && corner[2] < 0 ? 2 : 0;
    const Vec3<double> reference = displacement(corner[first]);
    const auto relative = [&](int k) { return root(norm2(displacement(corner[k ^ first]) - reference)); };
    const double second = larger(relative(2), relative(3));
    return Edges ? relative(1) + second : larger(relative(1), second);
}
/// Whether a pair may have intersected during a step. `square`: squared distance at the end of the step [m^2];
/// displacement(c): that of a corner [m]. It has not if its relative motion is below that distance, less the radius [m]
/// of an obstacle.
template <bool Edges, class F>
inline bool may_intersect(const std::array<Index, 4>& corner, double square, double radius, F&& displacement) {
    return !(relative_motion<Edges>(corner, displacement) < root(square) - radius);
}
/// Whether a pair intersects on the straight paths of its corners from start(c) to end(c). Conservative advancement:
/// the sides approach at most by their relative motion, so each step along the paths is one gap long. A gap below
/// `min_gap` [m] counts as an intersection.
template <bool Edges, class X, class Y>
inline bool ccd_pair(const std::array<Index, 4>& corner, double radius, double min_gap, X&& start, Y&& end) {
    const auto displacement = [&](Index c) { return end(c) - start(c); };
    const double length = relative_motion<Edges>(corner, displacement);
    double fraction = 0.0;
    for (int iteration = 0; fraction < 1.0; ++iteration) {
        const auto at = [&](Index c) { return start(c) + fraction * displacement(c); };
        const double gap = root(pair_square<Edges>(corner, at)) - radius;
        if (!(gap > min_gap) || iteration > 1000) return true;
        if (!(length > 0.0)) return false;
        fraction += gap / length;
    }
    return false;
}

/// Patches of a surface: particles that are close to each other on it. Those of two layers in contact move much less
/// relative to each other than all particles of the surface.
class Patches {
public:
    /// Lower bounds of the distances of some pairs of a surface at some positions, by two patches that have particles of
    /// them, and for all other patches.
    struct Distances {
        Array<double> positions;
        std::vector<std::array<Index, 2>> patches;
        std::vector<double> distance;
        double far_distance = std::numeric_limits<double>::infinity();
    };

    /// Patches of a surface: squares of a sheet with a number of columns, or ranges of particles if that is zero.
    Patches(const Surface& s, std::int64_t columns) {
        auto width = std::int64_t{3};
        while (width * width * max_patches < s.count) ++width;
        patch_.resize(s.count);
        Index n_patches = 0;
        std::vector<Index> numbers;
        for (std::int64_t i = 0; i < s.count; ++i) {
            const std::int64_t k =
                columns ? i / columns / width * (columns / width + 1) + i % columns / width : i / (width * width);
            numbers.resize(std::max<std::size_t>(numbers.size(), k + 1), -1);
            if (numbers[k] < 0) numbers[k] = n_patches++;
            patch_[i] = numbers[k];
        }
        const auto patches_of = [&](auto parts, auto& all) {
            all.clear();
            for (auto& part : parts) {
                for (Index& corner : part) corner = patch_[corner];
                all.push_back(part);
            }
        };
        patches_of(s.edges, of_edge_);
        patches_of(s.triangles, of_triangle_);
        moved_.resize(n_patches);
        least_.assign(static_cast<std::size_t>(n_patches) * n_patches, std::numeric_limits<double>::infinity());
    }
    /// Set the distances to no pairs at positions x, quads.
    void clear(Distances& all, const double* x) {
        // An exception may have ended the collection of others.
        if (is_collecting_) std::fill(least_.begin(), least_.end(), std::numeric_limits<double>::infinity());
        is_collecting_ = true;
        all.positions.assign(x, x + 4 * patch_.size());
        all.patches.clear(), all.distance.clear();
        all.far_distance = std::numeric_limits<double>::infinity();
    }
    /// Include a pair of two edges, or of a particle and a triangle, at a distance [m].
    template <bool Edges>
    void include(Distances& all, Index first, Index second, double distance) {
        // A patch counts as often as it is listed: that takes less time than a branch for each that is not.
        if constexpr (Edges) {
            for (const Index a : of_edge_[first])
                for (const Index b : of_edge_[second]) include_patches(all, a, b, distance);
        } else {
            for (const Index b : of_triangle_[second]) include_patches(all, patch_[first], b, distance);
        }
    }
    /// Set the distances of all pairs of a surface that are further than `reach` [m].
    void set_beyond(Distances& all, const Surface& s, const double* x, double reach) {
        clear(all, x);
        // Boxes of all triangles that have particles of a patch.
        std::vector<MotionBound> hulls(moved_.size());
        for (std::int64_t i = 0; i < s.count; ++i) {
            hulls[patch_[i]].include(load4(x + 4 * i));
            for (Index f = s.start[i]; f < s.start[i + 1]; ++f)
                for (const Index corner : s.triangles[s.fan[f]]) hulls[patch_[i]].include(load4(x + 4 * corner));
        }
        all.far_distance = far_factor * reach;
        for (std::size_t a = 0; a < hulls.size(); ++a)
            for (std::size_t b = a; b < hulls.size(); ++b) {
                const quad<double> gap = MotionBound::gap(hulls[a], hulls[b]);
                const double distance = root(norm2(Vec3<double>{gap[0], gap[1], gap[2]}));
                if (distance < all.far_distance) include_patches(all, a, b, larger(reach, distance));
            }
        finish(all);
    }
    /// Set to one distance [m] of all patches that other distances list, at positions x.
    void set_uniform(Distances& all, const Distances& listed, const double* x, double distance) {
        all.positions.assign(x, x + 4 * patch_.size());
        all.patches = listed.patches;
        all.distance.assign(listed.patches.size(), distance);
        std::fill(all.distance.end() - lanes<double>, all.distance.end(), std::numeric_limits<double>::infinity());
        all.far_distance = std::numeric_limits<double>::infinity();
    }
    /// Complete distances after the last pair.
    void finish(Distances& all) {
        for (const auto& [a, b] : all.patches) {
            double& least = least_[a * moved_.size() + b];
            all.distance.push_back(least);
            least = std::numeric_limits<double>::infinity();
        }
        all.patches.resize(all.patches.size() + lanes<double>);
        all.distance.resize(all.patches.size(), std::numeric_limits<double>::infinity());
        is_collecting_ = false;
    }
    /// Lower bound of the distances of these pairs at other positions. NaN if a position is not finite.
    double bound(const Distances& all, const double* x) {
        using V = vec<double>;
        std::fill(moved_.begin(), moved_.end(), MotionBound{});
        for (std::size_t i = 0; i < patch_.size(); ++i)
            moved_[patch_[i]].include(load4(x + 4 * i) - load4(all.positions.data() + 4 * i));
        MotionBound total;
        for (const MotionBound& moved : moved_) total.include(moved);
        const double diameter = total.diameter();
        V least = splat<V>((1.0 - rounding) * all.far_distance - (1.0 + rounding) * diameter);
        for (std::size_t k = 0; k + lanes<double> <= all.patches.size(); k += lanes<double>) {
            quad<double> rows[lanes<double>];
            for (int lane = 0; lane < lanes<double>; ++lane) {
                MotionBound pair = moved_[all.patches[k + lane][0]];
                pair.include(moved_[all.patches[k + lane][1]]);
                rows[lane] = pair.extent();
            }
            Vec3<V> extent;
            deinterleave(rows, extent.x, extent.y, extent.z);
            const V distance = load(all.distance.data() + k);
            least = smaller(fma(splat<V>(1.0 - rounding), distance, splat<V>(-1.0 - rounding) * root(norm2(extent))),
                            least);
        }
        double min = diameter < largest ? std::numeric_limits<double>::infinity() : diameter;
        for (int lane = 0; lane < lanes<double>; ++lane) min = smaller<double>(least[lane], min);
        return min;
    }

private:
    static constexpr std::int64_t max_patches = 256;
    /// Patches that are further apart have one distance, as a multiple of the reach.
    static constexpr double far_factor = 4.0, largest = 1e300;
    /// Relative rounding of distances.
    static constexpr double rounding = 1e-12;

    void include_patches(Distances& all, std::size_t a, std::size_t b, double distance) {
        double& least = least_[std::min(a, b) * moved_.size() + std::max(a, b)];
        if (!(distance < least)) return;
        if (least > largest)
            all.patches.push_back({static_cast<Index>(std::min(a, b)), static_cast<Index>(std::max(a, b))});
        least = distance;
    }

    /// Patch of each particle; those of the corners of each edge and triangle.
    std::vector<Index> patch_;
    std::vector<std::array<Index, 2>> of_edge_;
    std::vector<std::array<Index, 3>> of_triangle_;
    std::vector<double> least_;  ///< distance of two patches, while distances are collected
    bool is_collecting_ = false;
    std::vector<MotionBound> moved_;
};

}  // namespace cloth::contact
