// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Signed distances of obstacle shapes and their normals.
#include "contact/shapes.hpp"

#include "samples.hpp"

namespace cloth::tests {

using namespace contact;

namespace {

/// Dimensions [m] that suit every shape: a box of 0.6 x 0.4 x 0.8, radius 0.3 and length 0.5.
template <Shape S>
constexpr Vec3<double> size = S == Shape::box ? Vec3<double>{0.6, 0.4, 0.8} : Vec3<double>{0.3, 0.5, 0.0};

template <Shape S>
double gap(double x, double y, double z) {
    return nearest_on<S>(Vec3<double>{x, y, z}, size<S>).gap;
}

/// Check the normal of a shape outside of it: of length 1, the gradient of the gap, away from the nearest point.
template <Shape S>
void check_normals() {
    Random random;
    int outside = 0;
    for (int round = 0; round < 500; ++round) {
        const Vec3<double> p = random.vector(), direction = random.vector();
        const SurfacePoint<double> n = nearest_on<S>(p, size<S>);
        if (n.gap <= 0.0) continue;
        ++outside;
        check_close(norm2(n.normal), 1.0, 1e-12);
        const SurfacePoint<Dual> product = nearest_on<S>(dual(p, direction), splat3<Dual>(size<S>));
        check_close(product.gap.value, n.gap, 1e-14);
        check_close(product.gap.slope, dot(n.normal, direction), 1e-10, 1.0);
        check_close(nearest_on<S>(p - n.gap * n.normal, size<S>).gap, 0.0, 1e-12, 1.0);
    }
    CHECK(outside > 100);
}

template <Shape S>
void check_lanes() {
    using V = vec<double>;
    Random random;
    for (int round = 0; round < 100; ++round) {
        Vec3<V> p{};
        for (int k = 0; k < lanes<double>; ++k) {
            const Vec3<double> point = random.vector();
            p.x[k] = point.x, p.y[k] = point.y, p.z[k] = point.z;
        }
        const SurfacePoint<V> all = nearest_on<S>(p, splat3<V>(size<S>));
        for (int k = 0; k < lanes<double>; ++k) {
            const SurfacePoint<double> expected = nearest_on<S>(lane(p, k), size<S>);
            CHECK(has_same_bits<double>(all.gap[k], expected.gap));
            CHECK(has_same_bits<double>(all.normal.x[k], expected.normal.x));
            CHECK(has_same_bits<double>(all.normal.y[k], expected.normal.y));
            CHECK(has_same_bits<double>(all.normal.z[k], expected.normal.z));
        }
    }
}

}  // namespace

TEST_CASE("normals are gradients of the signed distance") {
    check_normals<Shape::plane>();
    check_normals<Shape::box>();
    check_normals<Shape::sphere>();
    check_normals<Shape::capsule>();
    check_normals<Shape::cylinder>();
}

TEST_CASE("lanes of signed distances have the bits of numbers") {
    check_lanes<Shape::plane>();
    check_lanes<Shape::box>();
    check_lanes<Shape::sphere>();
    check_lanes<Shape::capsule>();
    check_lanes<Shape::cylinder>();
}

TEST_CASE("shapes have closed distances") {
    CHECK(gap<Shape::plane>(3.0, -2.0, 0.7) == 0.7);
    check_close(gap<Shape::sphere>(0.0, 0.3, 0.4), 0.2, 1e-12);
    check_close(gap<Shape::box>(0.5, 0.0, 0.0), 0.2, 1e-12);        // face
    check_close(gap<Shape::box>(0.6, 0.6, 0.1), 0.5, 1e-12);        // edge
    check_close(gap<Shape::box>(0.4, 0.4, 0.6), 0.3, 1e-12);        // corner
    check_close(gap<Shape::box>(0.0, 0.1, 0.0), -0.1, 1e-12);       // inside
    check_close(gap<Shape::capsule>(0.5, 0.0, 0.2), 0.2, 1e-12);    // side
    check_close(gap<Shape::capsule>(0.3, 0.0, 0.65), 0.2, 1e-12);   // cap
    check_close(gap<Shape::cylinder>(0.0, -0.5, 0.1), 0.2, 1e-12);  // side
    check_close(gap<Shape::cylinder>(0.0, 0.0, 0.65), 0.4, 1e-12);  // end, on the axis
    check_close(gap<Shape::cylinder>(0.6, 0.0, 0.65), 0.5, 1e-12);  // rim
    check_close(gap<Shape::cylinder>(0.1, 0.0, 0.0), -0.2, 1e-12);  // inside
}

TEST_CASE("with_shape passes each shape as a constant") {
    for (const Shape shape : {Shape::plane, Shape::box, Shape::sphere, Shape::capsule, Shape::cylinder, Shape::mesh})
        CHECK(with_shape(shape, [](auto constant) { return constant.value; }) == shape);
}

}  // namespace cloth::tests
