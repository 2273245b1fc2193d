// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Signed distances of points from shapes, and their normals. Points are in the frame of the obstacle, centred on the
// shape. V is a number, a vector or a Dual.
#pragma once

#include "contact/mesh_shape.hpp"

namespace cloth::contact {

/// Dimensions [m]: plane none, normal z; box edge lengths along x, y, z; sphere radius; capsule and cylinder radius and
/// length along z, that of a capsule without its caps; mesh none.
enum class Shape : int { plane, box, sphere, capsule, cylinder, mesh };

/// Signed distance from the surface, negative inside, and its gradient. Inside a shape with corners, which no cloth
/// enters, the gradient is undefined: zero in a box, NaN in a cylinder.
template <class V>
struct SurfacePoint {
    V gap;
    Vec3<V> normal;
};

template <class V>
CLOTH_INLINE V with_sign_of(V magnitude, V sign) {
    return select(sign < V{}, -magnitude, magnitude);
}
template <class V>
CLOTH_INLINE V clamped(V a, V limit) {
    return smaller(larger(a, -limit), limit);
}

template <Shape S, class V>
CLOTH_INLINE SurfacePoint<V> nearest_on(const Vec3<V>& p, const Vec3<V>& size) {
    const V half = splat<V>(scalar<V>(0.5)), none = splat<V>(scalar<V>(0)), unit = splat<V>(scalar<V>(1));
    if constexpr (S == Shape::plane) {
        return {p.z, {none, none, unit}};
    } else if constexpr (S == Shape::sphere) {
        const V away = root(norm2(p));
        return {away - size.x, (unit / away) * p};
    } else if constexpr (S == Shape::capsule) {
        const Vec3<V> q{p.x, p.y, p.z - clamped(p.z, half * size.y)};
        const V away = root(norm2(q));
        return {away - size.x, (unit / away) * q};
    } else if constexpr (S == Shape::box) {
        const Vec3<V> q{absolute(p.x) - half * size.x, absolute(p.y) - half * size.y, absolute(p.z) - half * size.z};
        const V max = larger(larger(q.x, q.y), q.z);
        // Nearest to a face the normal is along an axis, and needs neither root nor division.
        const auto face_normal = [&](V a, V along)
                                     CLOTH_INLINED { return with_sign_of(select(a > none, unit, none), along); };
        SurfacePoint<V> n{max, {face_normal(q.x, p.x), face_normal(q.y, p.y), face_normal(q.z, p.z)}};
        const auto corner = larger(smaller(q.x, q.y), smaller(larger(q.x, q.y), q.z)) > none;
        if (!any(corner)) return n;
        const Vec3<V> out{larger(q.x, none), larger(q.y, none), larger(q.z, none)};
        const V away = root(norm2(out)), inverse = unit / away;
        const auto off = [&](V a, V along, V otherwise)
                             CLOTH_INLINED { return select(corner, inverse * with_sign_of(a, along), otherwise); };
        return {select(corner, away, n.gap),
                {off(out.x, p.x, n.normal.x), off(out.y, p.y, n.normal.y), off(out.z, p.z, n.normal.z)}};
    } else {
        const V across = root(fma(p.y, p.y, p.x * p.x));
        const V over = across - size.x, above = absolute(p.z) - half * size.y;
        const V out = larger(over, none), up = larger(above, none);
        const V away = root(fma(up, up, out * out)), inverse = unit / away;
        // On the axis the radial direction is undefined and not needed.
        const V outward = inverse * out / select(across > none, across, unit);
        return {away + smaller(larger(over, above), none),
                {outward * p.x, outward * p.y, inverse * with_sign_of(up, p.z)}};
    }
}

/// The same for a mesh, from its nearest feature. For a point whose distance from the mesh's box is above `limit` [m], the
/// gap is that distance, a lower bound, and the normal is zero: a search takes far longer. `hints`: a triangle for each
/// lane, see `Mesh::nearest`.
template <class V>
inline SurfacePoint<V> nearest_on_mesh(const Mesh& mesh, const Vec3<V>& p, double limit, Index* hints = nullptr) {
    if constexpr (std::is_same_v<V, double> || std::is_same_v<V, Dual>) {
        const auto constant = [](Vec3<double> a) { return Vec3<V>{splat<V>(a.x), splat<V>(a.y), splat<V>(a.z)}; };
        const Vec3<double> point{value_of(p.x), value_of(p.y), value_of(p.z)};
        if (const double square = mesh.box_square(point); square > limit * limit)
            return {splat<V>(root(square)), constant({0.0, 0.0, 0.0})};
        const Mesh::NearestFeature nearest = mesh.nearest(point, hints);
        Vec3<V> away = p - constant(nearest.from);
        if (nearest.kind == 2) {
            const Vec3<V> normal = constant(nearest.normal);
            return {dot(normal, away), normal};
        }
        const Vec3<V> along = constant(nearest.along);
        if (nearest.kind == 1) away = away - (dot(away, along) / norm2(along)) * along;
        const V length = root(norm2(away)), gap = nearest.inside ? -length : length;
        return {gap, (splat<V>(1.0) / gap) * away};
    } else {
        SurfacePoint<V> result;
        for (int k = 0; k < static_cast<int>(sizeof(V) / sizeof(scalar<V>)); ++k) {
            const SurfacePoint<double> point = nearest_on_mesh<double>(
                mesh, {double(p.x[k]), double(p.y[k]), double(p.z[k])}, limit, hints ? hints + k : nullptr);
            result.gap[k] = static_cast<scalar<V>>(point.gap);
            result.normal.x[k] = static_cast<scalar<V>>(point.normal.x);
            result.normal.y[k] = static_cast<scalar<V>>(point.normal.y);
            result.normal.z[k] = static_cast<scalar<V>>(point.normal.z);
        }
        return result;
    }
}

/// Call `visit` with the shape as a compile-time constant.
template <class F>
inline auto with_shape(Shape shape, F&& visit) {
    switch (shape) {
        case Shape::plane: return visit(std::integral_constant<Shape, Shape::plane>{});
        case Shape::box: return visit(std::integral_constant<Shape, Shape::box>{});
        case Shape::sphere: return visit(std::integral_constant<Shape, Shape::sphere>{});
        case Shape::capsule: return visit(std::integral_constant<Shape, Shape::capsule>{});
        case Shape::cylinder: return visit(std::integral_constant<Shape, Shape::cylinder>{});
        default: return visit(std::integral_constant<Shape, Shape::mesh>{});
    }
}

}  // namespace cloth::contact
