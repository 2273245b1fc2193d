// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Membrane triangle: constant strain, orthotropic St. Venant-Kirchhoff law in the frame of the threads, with or without
// moduli that grow with strain.
#pragma once

#include <array>

#include "laws/bound.hpp"

namespace cloth::laws {

/// Triangle of woven cloth. Threads at rest of unit length become a = p1 d1 + p2 d2 (warp) and b = q1 d1 + q2 d2
/// (weft). Green's strains are e1 = (a.a - 1)/2, e2 = (b.b - 1)/2 and the shear g = a.b. Energy A (C11 e1^2/2 +
/// C12 e1 e2 + C22 e2^2/2 + G g^2/2), damping stress D of the strain rates. docs/derivations/membrane.md derives it.
///
/// A stiffening membrane adds, for each strain e, the stress A r x^2 (e - 2 x / 3). x is e between 0 (its negative limit
/// for shear) and its limit. The modulus thus grows by r x^2, and stays constant beyond the limit.
template <bool stiffening>
struct MembraneLaw {
    static constexpr int corners = 3, params = 6, squares = 3;
    static constexpr bool absolute_velocities = false;
    /// Numbers that all triangles of a list have in common.
    static constexpr int common = stiffening ? 14 : 8;
    template <class V>
    struct Moduli {
        V warp, coupling, weft, shear;
    };
    /// Strain at which a modulus stops growing, and r [N/m].
    template <class V>
    struct Growth {
        V limit, rate;
    };
    /// p, q [1/m], area A [m^2], its product with the size of the triangle [m^3], moduli C11, C12, C22, G [N/m],
    /// viscosities D11, D12, D22, D33 per size [N s/m^2], and growth of C11, C22 and G.
    template <class V>
    struct Params {
        V p1, p2, q1, q2, area, damping;
        Moduli<V> elastic, viscous;
        std::array<Growth<V>, stiffening ? 3 : 0> growth{};
    };
    template <class V>
    static CLOTH_INLINE Params<V> make_params(const V* n, const double* c) {
        const auto at = [c](int k) { return splat<V>(scalar<V>(c[k])); };
        Params<V> p{n[0], n[1], n[2], n[3], n[4], n[5], {at(0), at(1), at(2), at(3)}, {at(4), at(5), at(6), at(7)}};
        for (int k = 0; k < int(p.growth.size()); ++k) p.growth[k] = {at(8 + 2 * k), at(9 + 2 * k)};
        return p;
    }
    template <class V>
    struct Stress {
        V warp, weft, shear;
    };

    template <class V>
    static CLOTH_INLINE Vec3<V> warp(const Params<V>& p, const Vec3<V>* d) {
        return fma(p.p1, d[0], p.p2 * d[1]);
    }
    template <class V>
    static CLOTH_INLINE Vec3<V> weft(const Params<V>& p, const Vec3<V>* d) {
        return fma(p.q1, d[0], p.q2 * d[1]);
    }
    /// Strains, or strain rates, times moduli and a factor.
    template <class V>
    static CLOTH_INLINE Stress<V> stress(const Moduli<V>& c, V factor, V warp, V weft, V shear) {
        return {factor * fma(c.warp, warp, c.coupling * weft), factor * fma(c.weft, weft, c.coupling * warp),
                factor * (c.shear * shear)};
    }
    template <class V>
    static CLOTH_INLINE V strain(Vec3<V> thread) {
        return splat<V>(0.5) * (norm2(thread) - splat<V>(1));
    }
    template <class V>
    static CLOTH_INLINE Stress<V> elastic_stress(const Params<V>& p, Vec3<V> a, Vec3<V> b) {
        const V along = strain(a), across = strain(b), shear = dot(a, b);
        Stress<V> t = stress(p.elastic, p.area, along, across, shear);
        if constexpr (stiffening)
            t = {fma(p.area, added_stress(p, 0, along), t.warp), fma(p.area, added_stress(p, 1, across), t.weft),
                 fma(p.area, added_stress(p, 2, shear), t.shear)};
        return t;
    }
    /// Rates of the strains.
    template <class V>
    static CLOTH_INLINE Stress<V> rates(const Params<V>& p, Vec3<V> a, Vec3<V> b, const Vec3<V>* u) {
        const Vec3<V> da = warp(p, u), db = weft(p, u);
        return {dot(a, da), dot(b, db), dot(a, db) + dot(b, da)};
    }

    template <class V>
    static CLOTH_INLINE void force(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u, Vec3<V>* f, bool damped) {
        const Vec3<V> a = warp(p, d), b = weft(p, d);
        Stress<V> t = elastic_stress(p, a, b);
        if (damped) {
            const Stress<V> r = rates(p, a, b, u), s = stress(p.viscous, p.damping, r.warp, r.weft, r.shear);
            t = {t.warp + s.warp, t.weft + s.weft, t.shear + s.shear};
        }
        const Vec3<V> fa = fma(t.warp, a, t.shear * b), fb = fma(t.weft, b, t.shear * a);
        f[0] = -fma(p.p1, fa, p.q1 * fb);
        f[1] = -fma(p.p2, fa, p.q2 * fb);
    }
    template <class V>
    static CLOTH_INLINE V energy(const Params<V>& p, const Vec3<V>* d) {
        const Vec3<V> a = warp(p, d), b = weft(p, d);
        const V along = strain(a), across = strain(b), shear = dot(a, b);
        const Stress<V> t = stress(p.elastic, p.area, along, across, shear);
        const V linear = splat<V>(0.5) * fma(t.warp, along, fma(t.weft, across, t.shear * shear));
        if constexpr (stiffening)
            return fma(p.area, added_energy(p, 0, along) + added_energy(p, 1, across) + added_energy(p, 2, shear),
                       linear);
        else
            return linear;
    }
    template <class V>
    static CLOTH_INLINE V dissipation(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u) {
        const Stress<V> r = rates(p, warp(p, d), weft(p, d), u),
                        s = stress(p.viscous, p.damping, r.warp, r.weft, r.shear);
        // A rounding error must not make it negative.
        return larger(fma(s.warp, r.warp, fma(s.weft, r.weft, s.shear * r.shear)), V{});
    }

    /// Strains and their rates [1/s] of the threads: warp, weft and shear.
    template <class V>
    static CLOTH_INLINE void strains(const Params<V>& p, const Vec3<V>* d, const Vec3<V>* u, V (&value)[3],
                                     V (&rate)[3]) {
        const Vec3<V> a = warp(p, d), b = weft(p, d);
        const Stress<V> r = rates(p, a, b, u);
        value[0] = strain(a), value[1] = strain(b), value[2] = dot(a, b);
        rate[0] = r.warp, rate[1] = r.weft, rate[2] = r.shear;
    }
    /// Largest jump of the second time derivative of stress `k` [N m/s^2] within an interval of a duration [s], between
    /// whose ends a strain and its rate are known; zero if the strain can't reach a limit. A jump at strain 0 counts as
    /// the one at the limit that changes the motion of half a step [s] as much.
    static double limit_jump(const Params<double>& p, int k, const double (&strain)[2], const double (&rate)[2],
                             double duration, double step) {
        const double limit = p.growth[k].limit, mean = (strain[1] - strain[0]) / duration;
        const double speed = larger(absolute(mean), larger(absolute(rate[0]), absolute(rate[1])));
        // A cubic deviates from its chord by up to 4/27 of what its slopes at the ends do; a wave by more.
        const double deviation = 8.0 / 27.0 * duration * (absolute(rate[0] - mean) + absolute(rate[1] - mean));
        const double least = smaller(strain[0], strain[1]) - deviation, most = larger(strain[0], strain[1]) + deviation;
        const auto reaches = [&](double value) { return least <= value && value <= most; };
        double size = 0.0;
        if (reaches(limit) || (k == 2 && reaches(-limit)))
            size = limit;
        else if (k < 2 && reaches(0.0))
            size = smaller(limit, 0.125 * step * speed);
        return 2.0 * p.area * p.growth[k].rate * size * (speed * speed);
    }

    /// Gradients of strain `k` by the corners [1/m].
    template <class V>
    static CLOTH_INLINE void gradients(const Params<V>& p, const Vec3<V>* d, int k, Vec3<V> (&gradient)[3]) {
        const Vec3<V> a = warp(p, d), b = weft(p, d);
        const V along[3] = {-(p.p1 + p.p2), p.p1, p.p2}, across[3] = {-(p.q1 + p.q2), p.q1, p.q2};
        for (int i = 0; i < 3; ++i)
            gradient[i] = k == 0 ? along[i] * a : k == 1 ? across[i] * b : fma(along[i], b, across[i] * a);
    }

    /// The stiffness is A (C11 (a.a')^2 + 2 C12 (a.a')(b.b') + C22 (b.b')^2 + G (a.b' + b.a')^2) and the part of the
    /// stress. |2 C12 (a.a')(b.b')| <= |C12| (r (a.a')^2 + (b.b')^2 / r), r = sqrt(C11 / C22), leaves three squares.
    /// Square `k` of them, for every corner.
    template <class V>
    static CLOTH_INLINE void square(const Params<V>& p, const Vec3<V>* d, int k, Bound<V>* bound) {
        const Vec3<V> a = warp(p, d), b = weft(p, d);
        Vec3<V> g[3];
        gradients(p, d, k, g);
        V total{};
        for (int i = 0; i < 3; ++i) {
            bound[i].norm = root(norm2(g[i]));
            total = total + bound[i].norm;
        }
        V modulus = decoupled(p.elastic, k);
        if constexpr (stiffening)
            modulus = modulus + added_modulus(p, k, k == 0 ? strain(a) : k == 1 ? strain(b) : dot(a, b));
        const V stiffness = p.area * modulus, damping = p.damping * decoupled(p.viscous, k);
        for (int i = 0; i < 3; ++i) {
            const auto has_norm = bound[i].norm > V{};
            const V share = select(has_norm, total / select(has_norm, bound[i].norm, splat<V>(1)), V{});
            bound[i].stiff = outer(stiffness * share, g[i], V{});
            bound[i].damp = outer(damping * share, g[i], V{});
            bound[i].isotropic = bound[i].transverse = V{};
        }
    }
    /// The part of the stress is s1 |a'|^2 + s2 |b'|^2 + 2 s3 a'.b' <= (|s1| + |s3|) |a'|^2 + (|s2| + |s3|) |b'|^2.
    /// Compression is negative and destabilises nothing, but its absolute value counts as for springs.
    template <class V>
    static CLOTH_INLINE void bounds(const Params<V>& p, const Vec3<V>* d, Bound<V>* b) {
        const Stress<V> t = elastic_stress(p, warp(p, d), weft(p, d));
        const V shear = absolute(t.shear), along = absolute(t.warp) + shear, across = absolute(t.weft) + shear;
        const V p1 = absolute(p.p1), p2 = absolute(p.p2), q1 = absolute(p.q1), q2 = absolute(p.q2);
        const V p0 = absolute(p.p1 + p.p2), q0 = absolute(p.q1 + p.q2);
        const V from_warp = along * (p0 + p1 + p2), from_weft = across * (q0 + q1 + q2);
        const V isotropic[3] = {fma(from_warp, p0, from_weft * q0), fma(from_warp, p1, from_weft * q1),
                                fma(from_warp, p2, from_weft * q2)};
        for (int i = 0; i < 3; ++i) {
            b[i] = Bound<V>{};
            b[i].isotropic = b[i].transverse = isotropic[i];
        }
        for (int k = 0; k < squares; ++k) {
            Bound<V> part[3];
            square(p, d, k, part);
            for (int i = 0; i < 3; ++i) {
                b[i].stiff = sum(b[i].stiff, part[i].stiff);
                b[i].damp = sum(b[i].damp, part[i].damp);
            }
        }
    }

    /// Coupling of two corners in the matrix of an implicit step: -(`stiffness` K + `damping` D) of the corners' blocks
    /// (0, 1), (0, 2) and (1, 2), by rows. Of the stress it has the part of tension alone, so that the matrix is
    /// positive definite.
    static void couplings(const Params<double>& p, const Vec3<double>* d, double stiffness, double damping,
                          double (*blocks)[9]) {
        const Vec3<double> a = warp(p, d), b = weft(p, d);
        const double along[3] = {-(p.p1 + p.p2), p.p1, p.p2}, across[3] = {-(p.q1 + p.q2), p.q1, p.q2};
        const double by = stiffness * p.area, rate = damping * p.damping;
        Moduli<double> moduli = p.elastic;
        if constexpr (stiffening) {
            moduli.warp += added_modulus(p, 0, strain(a));
            moduli.weft += added_modulus(p, 1, strain(b));
            moduli.shear += added_modulus(p, 2, dot(a, b));
        }
        const double c11 = fma(rate, p.viscous.warp, by * moduli.warp),
                     c12 = fma(rate, p.viscous.coupling, by * moduli.coupling),
                     c22 = fma(rate, p.viscous.weft, by * moduli.weft),
                     c33 = fma(rate, p.viscous.shear, by * moduli.shear);
        const Stress<double> t = tension(elastic_stress(p, a, b));
        const double va[3] = {a.x, a.y, a.z}, vb[3] = {b.x, b.y, b.z};
        int pair = 0;
        for (int i = 0; i < 2; ++i)
            for (int j = i + 1; j < 3; ++j, ++pair) {
                const double pp = along[i] * along[j], qq = across[i] * across[j], pq = along[i] * across[j],
                             qp = across[i] * along[j];
                const double isotropic = stiffness * fma(pp, t.warp, fma(qq, t.weft, (pq + qp) * t.shear));
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c) {
                        const double aa = va[r] * va[c], bb = vb[r] * vb[c], ab = va[r] * vb[c], ba = vb[r] * va[c];
                        const double coupled = c12 * fma(pq, ab, qp * ba);
                        const double sheared = c33 * fma(pp, bb, fma(qq, aa, fma(pq, ba, qp * ab)));
                        const double direct = fma(c11 * pp, aa, fma(c22 * qq, bb, coupled + sheared));
                        blocks[pair][3 * r + c] = -(direct + (r == c ? isotropic : 0.0));
                    }
            }
    }

private:
    /// A strain (0 warp, 1 weft, 2 shear) between the limits of its growth; compression does not stiffen.
    template <class V>
    static CLOTH_INLINE V limited(const Params<V>& p, int k, V strain) {
        const V limit = p.growth[k].limit;
        return larger(smaller(strain, limit), k == 2 ? -limit : V{});
    }
    /// Parts of modulus [N/m], stress [N/m] and energy per area [N/m] of the growth of a modulus. Each is the integral of
    /// the one before.
    template <class V>
    static CLOTH_INLINE V added_modulus(const Params<V>& p, int k, V strain) {
        const V x = limited(p, k, strain);
        return p.growth[k].rate * (x * x);
    }
    template <class V>
    static CLOTH_INLINE V added_stress(const Params<V>& p, int k, V strain) {
        const V x = limited(p, k, strain);
        return p.growth[k].rate * (x * x) * fma(splat<V>(scalar<V>(-2.0 / 3.0)), x, strain);
    }
    template <class V>
    static CLOTH_INLINE V added_energy(const Params<V>& p, int k, V strain) {
        const V x = limited(p, k, strain), beyond = strain - x;
        const V first = fma(splat<V>(0.5), beyond, splat<V>(scalar<V>(1.0 / 3.0)) * x);
        return p.growth[k].rate * (x * x) * fma(beyond, first, splat<V>(scalar<V>(1.0 / 12.0)) * (x * x));
    }
    /// Factor of a square without coupling.
    template <class V>
    static CLOTH_INLINE V decoupled(const Moduli<V>& c, int k) {
        if (k == 2) return c.shear;
        const V modulus = k == 0 ? c.warp : c.weft, other = k == 0 ? c.weft : c.warp;
        const auto both = other > V{};
        return modulus + absolute(c.coupling) * root(select(both, modulus / select(both, other, splat<V>(1)), V{}));
    }
    template <class V>
    static CLOTH_INLINE Sym3<V> sum(const Sym3<V>& a, const Sym3<V>& b) {
        return {a.xx + b.xx, a.yy + b.yy, a.zz + b.zz, a.xy + b.xy, a.xz + b.xz, a.yz + b.yz};
    }
    /// Positive semidefinite part of a stress.
    static Stress<double> tension(const Stress<double>& t) {
        const double mean = 0.5 * (t.warp + t.weft), half = 0.5 * (t.warp - t.weft);
        const double radius = root(fma(half, half, t.shear * t.shear));
        if (mean - radius >= 0.0) return t;
        if (!(mean + radius > 0.0)) return {0.0, 0.0, 0.0};
        // The projection on the larger principal direction, times its stress.
        const double scale = (mean + radius) / (2.0 * radius);
        return {scale * (radius + half), scale * (radius - half), scale * t.shear};
    }
};
using Membrane = MembraneLaw<false>;
using StiffeningMembrane = MembraneLaw<true>;

}  // namespace cloth::laws
