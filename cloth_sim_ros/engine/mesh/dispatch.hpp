// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Choice of the law of a list, and its operands for one element.
#pragma once

#include "laws/all.hpp"
#include "mesh/elements.hpp"

namespace cloth::mesh {

using laws::AddedMass, laws::Altitude, laws::BendingFriction, laws::Coupling, laws::Crossed, laws::EdgeEdge,
    laws::Joint, laws::law_params, laws::Membrane, laws::Panel, laws::PointFace, laws::QuadraticHinge, laws::Spring,
    laws::StiffeningMembrane;

/// Call `visit` with the law of a kind.
template <class F>
inline auto with_law(Kind kind, F&& visit) {
    switch (kind) {
        case Kind::spring: return visit(Spring{});
        case Kind::joint: return visit(Joint{});
        case Kind::crossed: return visit(Crossed{});
        case Kind::altitude: return visit(Altitude{});
        case Kind::edge_edge: return visit(EdgeEdge{});
        case Kind::point_face: return visit(PointFace{});
        case Kind::membrane: return visit(Membrane{});
        case Kind::stiffening_membrane: return visit(StiffeningMembrane{});
        case Kind::quadratic: return visit(QuadraticHinge{});
        case Kind::bending_friction: return visit(BendingFriction{});
        case Kind::coupling: return visit(Coupling{});
        case Kind::panel3: return visit(Panel<3>{});
        case Kind::mass3: return visit(AddedMass<3>{});
        case Kind::mass4: return visit(AddedMass<4>{});
        default: return visit(Panel<4>{});
    }
}

/// Whether the corners and parameters of a kind are those of its law.
template <class Law>
inline constexpr bool fits(Kind kind) {
    return corners_of(kind) == Law::corners && params_of(kind) == Law::params;
}
static_assert(fits<Spring>(Kind::spring) && fits<Joint>(Kind::joint) && fits<Crossed>(Kind::crossed) &&
              fits<Altitude>(Kind::altitude) && fits<EdgeEdge>(Kind::edge_edge) && fits<PointFace>(Kind::point_face) &&
              fits<Membrane>(Kind::membrane) && fits<Panel<3>>(Kind::panel3) && fits<Panel<4>>(Kind::panel4) &&
              fits<AddedMass<3>>(Kind::mass3) && fits<AddedMass<4>>(Kind::mass4) &&
              fits<QuadraticHinge>(Kind::quadratic) && fits<StiffeningMembrane>(Kind::stiffening_membrane) &&
              fits<BendingFriction>(Kind::bending_friction) && fits<Coupling>(Kind::coupling));

/// Operands of a law for one element of a list at x and v, (3, n) by component.
template <class Law>
struct ElementState {
    Vec3<double> d[Law::corners - 1], u[Law::corners];
    typename Law::template Params<double> params;
    ElementState(const List& list, std::int64_t e, const double* x, const double* v, std::int64_t n)
        : params(law_params<Law, double>(list.params.data() + e * list.numbers, list.common)) {
        const std::int64_t* const p = list.corners.data() + e * list.width;
        const auto at = [n](const double* a, std::int64_t i) { return Vec3<double>{a[i], a[n + i], a[2 * n + i]}; };
        for (int c = 1; c < Law::corners; ++c) {
            d[c - 1] = at(x, p[c]) - at(x, p[0]);
            if constexpr (!Law::absolute_velocities)
                if (v) u[c - 1] = at(v, p[c]) - at(v, p[0]);
        }
        if constexpr (Law::absolute_velocities)
            if (v)
                for (int c = 0; c < Law::corners; ++c) u[c] = at(v, p[c]);
    }
};

}  // namespace cloth::mesh
