/* Copyright 2026 the cloth_sim_ros authors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Equations of motion by the formulas of docs/springs.md and docs/bending.md, with none of the engine's code, and the
 * method of Dormand and Prince of order 8 (Hairer, Norsett, Wanner I, II.5) to solve them. LANES trajectories of one
 * system advance in the same steps: the first is the solution, the others are perturbed. Positions and velocities of a
 * particle are stored as [3][LANES]. */
#include <math.h>
#include <stdint.h>
#include <string.h>

typedef double Lanes __attribute__((vector_size(LANES * 8), aligned(8), may_alias));
typedef int64_t Mask __attribute__((vector_size(LANES * 8), aligned(8), may_alias));
typedef struct {
    Lanes x, y, z;
} Vec;

/* Elements of one kind: particles and constants of each. compiled_reference.py reads the structs from here. */
typedef struct {
    int64_t count;
    const int64_t *particles;
    const double *numbers;
} Elements;

/* Equations of motion. */
typedef struct {
    int64_t particles;
    const double *inverse_mass;
    Elements springs;    /* k = k_s / l0 [N/m], l0 [m], k_d [N s/m] */
    Elements joints;     /* k [N/m], k_d */
    Elements crossed;    /* h0 [m], k [N/m], k_d */
    Elements altitudes;  /* as crossed */
    Elements quadratics; /* weights of the four corners [1/m], k [N m], damping time [s] */
    Elements frictions;  /* k [N/m], largest deflection [m] */
    Elements membranes;  /* change of a corner's thread coordinates: p1, p2, q1, q2 [1/m], area [m^2], damping [m^3] */
    Elements panels;     /* no constants */
    Elements held;       /* k, k_d */
    double *plastic_lengths;       /* [frictions][LANES] [m] */
    const double *membrane_moduli; /* C11, C12, C22, C33, D11, D12, D22, D33, then limit and rate of the growth of three */
    int64_t corners;               /* of a panel */
    double normal, tangential, wind[3];
    double added_mass; /* [kg/m^2] of the panels */
    double *blocks;    /* mass blocks of the air, [particles][6][LANES], if added_mass > 0 */
    double push[3], drag;
    const int64_t *held_grippers;
    const double *held_offsets; /* [held][3][LANES], in the gripper's frame */
    const double *paths;        /* 26 numbers a gripper */
    double shift[8];            /* start of the interval less the start of a gripper's path [s] */
} System;

static inline Vec load(const double *p, int64_t i) {
    const Lanes *q = (const Lanes *)(p + 3 * LANES * i);
    return (Vec){q[0], q[1], q[2]};
}
static inline void add(double *p, int64_t i, Vec f) {
    Lanes *q = (Lanes *)(p + 3 * LANES * i);
    q[0] += f.x, q[1] += f.y, q[2] += f.z;
}
static inline Vec minus(Vec a, Vec b) { return (Vec){a.x - b.x, a.y - b.y, a.z - b.z}; }
static inline Vec plus(Vec a, Vec b) { return (Vec){a.x + b.x, a.y + b.y, a.z + b.z}; }
static inline Vec times(Lanes s, Vec a) { return (Vec){s * a.x, s * a.y, s * a.z}; }
static inline Lanes dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline Vec cross(Vec a, Vec b) {
    return (Vec){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
static inline Lanes root(Lanes a) {
    for (int l = 0; l < LANES; ++l) a[l] = sqrt(a[l]);
    return a;
}
/* 1 / a if a is above a limit, else 0. */
static inline Lanes inverse_above(Lanes a, Lanes limit) {
    const Mask above = a > limit;
    return (Lanes)((Mask)(1.0 / a) & above);
}

static void springs(const System *s, const double *x, const double *v, double *f) {
    for (int64_t k = 0; k < s->springs.count; ++k) {
        const int64_t i = s->springs.particles[2 * k], j = s->springs.particles[2 * k + 1];
        const double *constants = s->springs.numbers + 3 * k;
        const Vec away = minus(load(x, j), load(x, i)), rate = minus(load(v, j), load(v, i));
        const Lanes length = root(dot(away, away));
        const Lanes inverse = inverse_above(length, (Lanes){0});
        const Vec along = times(inverse, away);
        const Vec pull = times(constants[0] * (length - constants[1]) + constants[2] * dot(rate, along), along);
        add(f, i, pull);
        add(f, j, times((Lanes){0} - 1.0, pull));
    }
    for (int64_t k = 0; k < s->joints.count; ++k) {
        const int64_t i = s->joints.particles[2 * k], j = s->joints.particles[2 * k + 1];
        const Lanes stiff = (Lanes){0} + s->joints.numbers[2 * k], damp = (Lanes){0} + s->joints.numbers[2 * k + 1];
        const Vec pull = plus(times(stiff, minus(load(x, j), load(x, i))), times(damp, minus(load(v, j), load(v, i))));
        add(f, i, pull);
        add(f, j, times((Lanes){0} - 1.0, pull));
    }
}

/* Energy k (h - h0)^2 / 2, damping -k_d (grad h . v) grad h. */
static inline void hinge(const int64_t *at, const double *constants, Lanes h, const Vec *gradient, const double *v,
                         double *f) {
    Lanes rate = {0};
    for (int c = 0; c < 4; ++c) rate += dot(gradient[c], load(v, at[c]));
    const Lanes tension = constants[1] * (constants[0] - h) - constants[2] * rate;
    for (int c = 0; c < 4; ++c) add(f, at[c], times(tension, gradient[c]));
}

/* h = 6V / M, M^2 = |a x b|^2 + (0.1 |a|^2)^2 of the edge a = 0-1 and the wings b = 2-3, and its gradients. */
static inline Lanes crossed_length(const int64_t *at, const double *x, Vec *gradient) {
    const Vec p0 = load(x, at[0]), p2 = load(x, at[2]);
    const Vec a = minus(load(x, at[1]), p0), b = minus(load(x, at[3]), p2), r = minus(p2, p0), c = cross(a, b);
    const Lanes aa = dot(a, a), square = dot(c, c) + 0.01 * aa * aa;
    const Lanes inverse_square = inverse_above(square, (Lanes){0} + 1e-30), inverse = root(inverse_square);
    /* 6V = r . (b x a) of any two points on the lines. */
    const Lanes h = (Lanes){0} - dot(r, c) * inverse;
    /* Gradients of 6V and of M^2 / 2 with respect to a, b and r. */
    const Vec va = cross(r, b), vb = cross(a, r), vr = cross(b, a);
    const Vec ma = plus(cross(b, c), times(0.02 * aa, a)), mb = cross(c, a);
    const Vec ga = minus(times(inverse, va), times(h * inverse_square, ma));
    const Vec gb = minus(times(inverse, vb), times(h * inverse_square, mb)), gr = times(inverse, vr);
    const Vec none = {{0}, {0}, {0}};
    gradient[0] = minus(minus(none, ga), gr), gradient[1] = ga;
    gradient[2] = minus(gr, gb), gradient[3] = gb;
    return h;
}

static void crossed(const System *s, const double *x, const double *v, double *f) {
    for (int64_t k = 0; k < s->crossed.count; ++k) {
        const int64_t *at = s->crossed.particles + 4 * k;
        Vec gradient[4];
        const Lanes h = crossed_length(at, x, gradient);
        hinge(at, s->crossed.numbers + 3 * k, h, gradient, v, f);
    }
}

/* Energy k |L|^2 / 2 of L = sum of w_i x_i, damping k time |dL/dt|^2. */
static void quadratics(const System *s, const double *x, const double *v, double *f) {
    for (int64_t k = 0; k < s->quadratics.count; ++k) {
        const int64_t *at = s->quadratics.particles + 4 * k;
        const double *w = s->quadratics.numbers + 6 * k;
        Vec fold = {{0}, {0}, {0}};
        for (int c = 1; c < 4; ++c) {
            const Vec away = minus(load(x, at[c]), load(x, at[0])), rate = minus(load(v, at[c]), load(v, at[0]));
            fold = plus(fold, times((Lanes){0} + w[c], plus(away, times((Lanes){0} + w[5], rate))));
        }
        for (int c = 0; c < 4; ++c) add(f, at[c], times((Lanes){0} - w[4] * w[c], fold));
    }
}

static inline Lanes between(Lanes a, Lanes low, Lanes high) {
    const Mask below = a < low, above = a > high;
    return (Lanes)(((Mask)low & below) | ((Mask)high & above) | ((Mask)a & ~(below | above)));
}

/* Tension -k e of an elasto-plastic spring, e = h - h_p cut to the largest deflection; h is that of crossed hinges. */
static void frictions(const System *s, const double *x, double *f) {
    for (int64_t k = 0; k < s->frictions.count; ++k) {
        const int64_t *at = s->frictions.particles + 4 * k;
        const double *numbers = s->frictions.numbers + 2 * k;
        Vec gradient[4];
        const Lanes h = crossed_length(at, x, gradient), reach = (Lanes){0} + numbers[1];
        const Lanes deflection = between(h - *(const Lanes *)(s->plastic_lengths + LANES * k), -reach, reach);
        for (int c = 0; c < 4; ++c) add(f, at[c], times((Lanes){0} - numbers[0] * deflection, gradient[c]));
    }
}

/* Return the plastic lengths of hinges beyond their largest deflection to it, at the start of an interval. */
static void return_at_start(const System *s, const double *y) {
    for (int64_t k = 0; k < s->frictions.count; ++k) {
        const Lanes reach = (Lanes){0} + s->frictions.numbers[2 * k + 1];
        Lanes *plastic = (Lanes *)(s->plastic_lengths + LANES * k);
        Vec gradient[4];
        const Lanes h = crossed_length(s->frictions.particles + 4 * k, y, gradient);
        *plastic = between(*plastic, h - reach, h + reach);
    }
}

/* Plastic lengths after a step h from y to next. Each follows the extremes of the cubic through h and its rates. */
static void flow(const System *s, double step, const double *y, const double *next, int64_t half) {
    for (int64_t k = 0; k < s->frictions.count; ++k) {
        const int64_t *at = s->frictions.particles + 4 * k;
        const double reach = s->frictions.numbers[2 * k + 1];
        double *plastic = s->plastic_lengths + LANES * k;
        Vec gradient[4];
        Lanes h[2], rate[2] = {{0}};
        for (int end = 0; end < 2; ++end) {
            const double *x = end ? next : y;
            h[end] = crossed_length(at, x, gradient);
            for (int c = 0; c < 4; ++c) rate[end] += dot(gradient[c], load(x + half, at[c]));
        }
        for (int l = 0; l < LANES; ++l) {
            /* h0 + t (r0 + t (b + t a)) for the fraction t of the step. */
            const double h0 = h[0][l], h1 = h[1][l], r0 = step * rate[0][l], r1 = step * rate[1][l];
            const double a = r0 + r1 - 2.0 * (h1 - h0), b = 3.0 * (h1 - h0) - 2.0 * r0 - r1;
            double times_of[3] = {1.0, 1.0, 1.0};
            const double root_square = b * b - 3.0 * a * r0;
            if (root_square > 0.0) {
                /* Both roots of 3 a t^2 + 2 b t + r0 without cancellation. */
                const double q = -(b + copysign(sqrt(root_square), b));
                times_of[0] = q != 0.0 ? r0 / q : 1.0;
                times_of[1] = a != 0.0 ? q / (3.0 * a) : 1.0;
                if (times_of[0] > times_of[1]) {
                    const double later = times_of[0];
                    times_of[0] = times_of[1], times_of[1] = later;
                }
            }
            for (int e = 0; e < 3; ++e) {
                const double t = times_of[e];
                if (!(t > 0.0 && t <= 1.0)) continue;
                const double at_extreme = t == 1.0 ? h1 : h0 + t * (r0 + t * (b + t * a));
                if (at_extreme - plastic[l] > reach) plastic[l] = at_extreme - reach;
                if (plastic[l] - at_extreme > reach) plastic[l] = at_extreme + reach;
            }
        }
    }
}

/* Membrane of threads a and b, of unit length at rest: Green's strains, moduli C, rates times D. A growing modulus adds the
 * stress r x^2 (e - 2 x / 3), x the strain e between its limits. */
static void membranes(const System *s, const double *x, const double *v, double *f) {
    const double *c = s->membrane_moduli, *d = c + 4, *growth = c + 8;
    for (int64_t k = 0; k < s->membranes.count; ++k) {
        const int64_t *at = s->membranes.particles + 3 * k;
        const double *n = s->membranes.numbers + 6 * k;
        const double along[3] = {-n[0] - n[1], n[0], n[1]}, across[3] = {-n[2] - n[3], n[2], n[3]};
        Vec a = {{0}, {0}, {0}}, b = a, da = a, db = a;
        for (int i = 1; i < 3; ++i) {
            const Vec p = minus(load(x, at[i]), load(x, at[0])), u = minus(load(v, at[i]), load(v, at[0]));
            a = plus(a, times((Lanes){0} + along[i], p)), b = plus(b, times((Lanes){0} + across[i], p));
            da = plus(da, times((Lanes){0} + along[i], u)), db = plus(db, times((Lanes){0} + across[i], u));
        }
        const Lanes strain[3] = {0.5 * (dot(a, a) - 1.0), 0.5 * (dot(b, b) - 1.0), dot(a, b)};
        const Lanes rate[3] = {dot(a, da), dot(b, db), dot(a, db) + dot(b, da)};
        Lanes stress[3] = {n[4] * (c[0] * strain[0] + c[1] * strain[1]) + n[5] * (d[0] * rate[0] + d[1] * rate[1]),
                           n[4] * (c[1] * strain[0] + c[2] * strain[1]) + n[5] * (d[1] * rate[0] + d[2] * rate[1]),
                           n[4] * c[3] * strain[2] + n[5] * d[3] * rate[2]};
        for (int e = 0; e < 3; ++e) {
            const Lanes limit = (Lanes){0} + growth[2 * e];
            const Lanes cut = between(strain[e], e == 2 ? -limit : (Lanes){0}, limit);
            stress[e] += n[4] * growth[2 * e + 1] * cut * cut * (strain[e] - cut * (2.0 / 3.0));
        }
        for (int i = 0; i < 3; ++i) {
            const Vec pull = plus(times(along[i] * stress[0] + across[i] * stress[2], a),
                                  times(across[i] * stress[1] + along[i] * stress[2], b));
            add(f, at[i], times((Lanes){0} - 1.0, pull));
        }
    }
}

/* h = 6V / M, M^2 the sum of the squared |a x b| of the four faces; none where all points are on a line to 1e-12. */
static void altitudes(const System *s, const double *x, const double *v, double *f) {
    static const int faces[4][3] = {{0, 1, 2}, {0, 1, 3}, {0, 2, 3}, {1, 2, 3}};
    for (int64_t k = 0; k < s->altitudes.count; ++k) {
        const int64_t *at = s->altitudes.particles + 4 * k;
        Vec p[4], half[4] = {{{0}}}, gradient[4];
        for (int c = 0; c < 4; ++c) p[c] = load(x, at[c]);
        Lanes square = {0};
        for (int face = 0; face < 4; ++face) {
            const int *o = faces[face];
            const Vec n = cross(minus(p[o[1]], p[o[0]]), minus(p[o[2]], p[o[0]]));
            square += dot(n, n);
            /* Half the gradient of |n|^2 with respect to a corner: the side opposite to it times n. */
            for (int c = 0; c < 3; ++c)
                half[o[c]] = plus(half[o[c]], cross(minus(p[o[(c + 1) % 3]], p[o[(c + 2) % 3]]), n));
        }
        const Vec a = minus(p[1], p[0]), b = minus(p[2], p[0]), c = minus(p[3], p[0]);
        const Vec volume[4] = {{{0}}, cross(b, c), cross(c, a), cross(a, b)};
        const Lanes size = 1e-12 * (dot(a, a) + dot(b, b) + dot(c, c));
        const Lanes inverse_square = inverse_above(square, size * size), inverse = root(inverse_square);
        const Lanes h = dot(a, volume[1]) * inverse;
        gradient[0] = (Vec){{0}, {0}, {0}};
        for (int i = 1; i < 4; ++i) {
            gradient[i] = minus(times(inverse, volume[i]), times(h * inverse_square, half[i]));
            gradient[0] = minus(gradient[0], gradient[i]);
        }
        hinge(at, s->altitudes.numbers + 3 * k, h, gradient, v, f);
    }
}

/* F = -A/k (c_n n n' + c_t (1 - n n')) (v - w) on each of k corners. */
static void panels(const System *s, const double *x, const double *v, double *f) {
    const int corners = (int)s->corners;
    const Vec wind = {(Lanes){0} + s->wind[0], (Lanes){0} + s->wind[1], (Lanes){0} + s->wind[2]};
    for (int64_t k = 0; k < s->panels.count; ++k) {
        const int64_t *at = s->panels.particles + corners * k;
        const Vec p0 = load(x, at[0]), p1 = load(x, at[1]), p2 = load(x, at[2]);
        const Vec a = corners == 3 ? minus(p1, p0) : minus(p2, p0);
        const Vec b = corners == 3 ? minus(p2, p0) : minus(load(x, at[3]), p1);
        const Vec twice = cross(a, b);
        const Lanes area = 0.5 * root(dot(twice, twice));
        const Vec n = times(0.5 * inverse_above(area, (Lanes){0} + 1e-15), twice);
        for (int c = 0; c < corners; ++c) {
            const Vec u = minus(load(v, at[c]), wind);
            const Vec across = times(dot(u, n), n);
            const Vec drag = plus(times((Lanes){0} + s->normal, across), times((Lanes){0} + s->tangential, minus(u, across)));
            add(f, at[c], times(area * (-1.0 / corners), drag));
        }
    }
}

/* Inertia of air with the energy rho / (2 corners) sum of A (n . u)^2, u = v - wind. With q = A n the momentum of a corner is
 * m (q . u) q / A, m = rho / corners: its rate at constant u is subtracted from dT/dq times the change of q. */
static void carried_air(const System *s, const double *x, const double *v, double *f) {
    const int corners = (int)s->corners;
    const double m = s->added_mass / corners;
    const Vec wind = {(Lanes){0} + s->wind[0], (Lanes){0} + s->wind[1], (Lanes){0} + s->wind[2]};
    memset(s->blocks, 0, (size_t)s->particles * 6 * LANES * sizeof(double));
    for (int64_t k = 0; k < s->panels.count; ++k) {
        const int64_t *at = s->panels.particles + corners * k;
        Vec p[4], u[4];
        for (int c = 0; c < corners; ++c) p[c] = load(x, at[c]), u[c] = minus(load(v, at[c]), wind);
        /* Area vector q = (1/2) sum of p_c x p_(c+1), and its rate. */
        Vec q = {{0}, {0}, {0}}, rate = q, slope = q;
        for (int c = 0; c < corners; ++c) {
            const int d = (c + 1) % corners;
            q = plus(q, times((Lanes){0} + 0.5, cross(minus(p[c], p[0]), minus(p[d], p[0]))));
            rate = plus(rate, times((Lanes){0} + 0.5, plus(cross(minus(u[c], u[0]), minus(p[d], p[0])),
                                                           cross(minus(p[c], p[0]), minus(u[d], u[0])))));
        }
        const Lanes area = root(dot(q, q)), inverse = inverse_above(area, (Lanes){0} + 1e-15);
        const Lanes area_rate = dot(q, rate) * inverse;
        for (int c = 0; c < corners; ++c) {
            const Lanes flux = dot(q, u[c]), flux_rate = dot(rate, u[c]);
            /* dT/dq = m flux u / A - m flux^2 q / (2 A^3). */
            slope = plus(slope, minus(times(m * flux * inverse, u[c]), times(0.5 * m * flux * flux * inverse * inverse * inverse, q)));
            /* d/dt (m flux q / A) at constant u. */
            const Vec changes = plus(times(m * (flux_rate - flux * area_rate * inverse) * inverse, q), times(m * flux * inverse, rate));
            add(f, at[c], times((Lanes){0} - 1.0, changes));
            Lanes *b = (Lanes *)(s->blocks + 6 * LANES * at[c]);
            const Lanes w = m * inverse;
            b[0] += w * q.x * q.x, b[1] += w * q.y * q.y, b[2] += w * q.z * q.z;
            b[3] += w * q.x * q.y, b[4] += w * q.x * q.z, b[5] += w * q.y * q.z;
        }
        /* A corner moves q by half the cross product of the diagonal between its neighbours. */
        for (int c = 0; c < corners; ++c) {
            const Vec across = minus(p[(c + 1) % corners], p[(c + corners - 1) % corners]);
            add(f, at[c], times((Lanes){0} + 0.5, cross(across, slope)));
        }
    }
}

/* Solve (1 + inverse B) a = right by elimination. */
static void solve_block(const Lanes *b, double inverse, Lanes *a) {
    Lanes xx = 1.0 + inverse * b[0], yy = 1.0 + inverse * b[1], zz = 1.0 + inverse * b[2];
    const Lanes xy = inverse * b[3], xz = inverse * b[4];
    Lanes yz = inverse * b[5];
    const Lanes first = xy / xx, second = xz / xx;
    yy -= first * xy, yz -= first * xz, zz -= second * xz;
    a[1] -= first * a[0], a[2] -= second * a[0];
    const Lanes third = yz / yy;
    zz -= third * yz, a[2] -= third * a[1];
    a[2] = a[2] / zz;
    a[1] = (a[1] - yz * a[2]) / yy;
    a[0] = (a[0] - xy * a[1] - xz * a[2]) / xx;
}

static void turn(const double *axis, double first, double second, const double *in, double *out) {
    const double cross_product[3] = {axis[1] * in[2] - axis[2] * in[1], axis[2] * in[0] - axis[0] * in[2],
                            axis[0] * in[1] - axis[1] * in[0]};
    const double double_cross[3] = {axis[1] * cross_product[2] - axis[2] * cross_product[1],
                                    axis[2] * cross_product[0] - axis[0] * cross_product[2],
                             axis[0] * cross_product[1] - axis[1] * cross_product[0]};
    for (int c = 0; c < 3; ++c) out[c] = in[c] + first * cross_product[c] + second * double_cross[c];
}

/* Position and velocity of a gripper, its rotation matrix by columns, and its angular velocity, at a time on its path. */
static void pose(const double *path, double t, double *position, double *speed, double rotation[3][3], double *spin) {
    double r[3], rate[3];
    for (int c = 0; c < 3; ++c) {
        position[c] = path[1 + c] + path[4 + c] * t + path[7 + c] * t * t + path[10 + c] * t * t * t;
        speed[c] = path[4 + c] + 2.0 * path[7 + c] * t + 3.0 * path[10 + c] * t * t;
        r[c] = path[17 + c] * t + path[20 + c] * t * t + path[23 + c] * t * t * t;
        rate[c] = path[17 + c] + 2.0 * path[20 + c] * t + 3.0 * path[23 + c] * t * t;
    }
    const double square = r[0] * r[0] + r[1] * r[1] + r[2] * r[2], angle = sqrt(square);
    double first, second, third; /* sin a / a, (1 - cos a) / a^2, (a - sin a) / a^3 */
    if (angle < 0.3) {
        first = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72 * (1 - square / 110))));
        second = 0.5 - square / 24 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90 * (1 - square / 132))));
        third = 1.0 / 6 - square / 120 * (1 - square / 42 * (1 - square / 72 * (1 - square / 110 * (1 - square / 156))));
    } else {
        first = sin(angle) / angle;
        second = (1.0 - cos(angle)) / square;
        third = (angle - sin(angle)) / (square * angle);
    }
    const double x = path[13], y = path[14], z = path[15], w = path[16];
    const double start[3][3] = {{w * w + x * x - y * y - z * z, 2 * (x * y + z * w), 2 * (x * z - y * w)},
                                {2 * (x * y - z * w), w * w - x * x + y * y - z * z, 2 * (y * z + x * w)},
                                {2 * (x * z + y * w), 2 * (y * z - x * w), w * w - x * x - y * y + z * z}};
    for (int c = 0; c < 3; ++c) turn(r, first, second, start[c], rotation[c]);
    turn(r, second, third, rate, spin);
}

static void grips(const System *s, double t, const double *x, const double *v, double *f) {
    int64_t gripper = -1;
    double position[3], speed[3], rotation[3][3], spin[3];
    for (int64_t k = 0; k < s->held.count; ++k) {
        if (s->held_grippers[k] != gripper) {
            gripper = s->held_grippers[k];
            pose(s->paths + 26 * gripper, t + s->shift[gripper], position, speed, rotation, spin);
        }
        const int64_t i = s->held.particles[k];
        const Vec offset = load(s->held_offsets, k);
        Lanes arm[3];
        for (int c = 0; c < 3; ++c) arm[c] = rotation[0][c] * offset.x + rotation[1][c] * offset.y + rotation[2][c] * offset.z;
        const Vec point = {position[0] + arm[0], position[1] + arm[1], position[2] + arm[2]};
        const Vec motion = {speed[0] + (spin[1] * arm[2] - spin[2] * arm[1]), speed[1] + (spin[2] * arm[0] - spin[0] * arm[2]),
                            speed[2] + (spin[0] * arm[1] - spin[1] * arm[0])};
        const Lanes stiff = (Lanes){0} + s->held.numbers[2 * k], damp = (Lanes){0} + s->held.numbers[2 * k + 1];
        const Vec pull = plus(times(stiff, minus(point, load(x, i))), times(damp, minus(motion, load(v, i))));
        add(f, i, pull);
    }
}

/* Accelerations [m/s^2] at a time [s] after the start of the interval. */
void accelerations(const System *s, double t, const double *x, const double *v, double *a) {
    const int64_t n = s->particles;
    memset(a, 0, (size_t)n * 3 * LANES * sizeof(double));
    springs(s, x, v, a);
    if (s->crossed.count) crossed(s, x, v, a);
    if (s->altitudes.count) altitudes(s, x, v, a);
    if (s->quadratics.count) quadratics(s, x, v, a);
    if (s->frictions.count) frictions(s, x, a);
    if (s->membranes.count) membranes(s, x, v, a);
    if (s->panels.count) panels(s, x, v, a);
    if (s->added_mass > 0.0) carried_air(s, x, v, a);
    if (s->held.count) grips(s, t, x, v, a);
    for (int64_t i = 0; i < n; ++i) {
        const double inverse = s->inverse_mass[i], free = inverse > 0.0 ? 1.0 : 0.0;
        Lanes *at = (Lanes *)(a + 3 * LANES * i);
        const Lanes *u = (const Lanes *)(v + 3 * LANES * i);
        for (int c = 0; c < 3; ++c) at[c] = inverse * at[c] + free * (s->push[c] - s->drag * u[c]);
        if (s->added_mass > 0.0) solve_block((const Lanes *)(s->blocks + 6 * LANES * i), inverse, at);
    }
}

/* Coefficients of the method: rows A of stages 1 to 11, B, then the two error estimates' 12; C. The first half of a slope is
 * the velocity of the stage, itself a sum of accelerations. Therefore positions need accelerations only, with the weights
 * of products with A. */
typedef struct {
    double a[12][12], b[12], c[12], third[12], fifth[12];
    double a_place[12][12], b_place[12], third_place[12], fifth_place[12];
} Method;

/* Error control of one interval. */
typedef struct {
    double tolerance;       /* of the solution's local error, positions [m] and velocities [m/s] alike */
    double kick;            /* size of the perturbations [m], [m/s] */
    double share;           /* local error of a perturbed trajectory's deviation, relative to the deviation */
    double step;            /* first step, then the next step [s] */
    double longest;         /* longest step [s]; 0 for no limit */
    double deviations[2];   /* largest deviations in position and velocity, with a slow decay */
    int64_t evaluations, rejected;
    int64_t most; /* largest number of evaluations in one interval */
} Control;

/* Writes positions and velocities at the fraction `c` of a step h after y, from weighted accelerations k, to out. */
static void combine(int64_t half, int count, double h, double c, const double *position_weights,
                    const double *velocity_weights, double *const *k, const double *y, double *out) {
    double position_factors[12], velocity_factors[12];
    const double *from[12];
    int terms = 0;
    for (int i = 0; i < count; ++i)
        if (position_weights[i] != 0.0 || velocity_weights[i] != 0.0)
            position_factors[terms] = h * h * position_weights[i],
            velocity_factors[terms] = h * velocity_weights[i], from[terms++] = k[i];
    for (int64_t e = 0; e < half; e += LANES) {
        Lanes x = {0}, v = {0};
        for (int i = 0; i < terms; ++i) {
            const Lanes acceleration = *(const Lanes *)(from[i] + e);
            x += position_factors[i] * acceleration;
            v += velocity_factors[i] * acceleration;
        }
        const Lanes moving = *(const Lanes *)(y + half + e);
        *(Lanes *)(out + e) = *(const Lanes *)(y + e) + (c * h * moving + x);
        *(Lanes *)(out + half + e) = moving + v;
    }
}

static inline Lanes larger(Lanes a, Lanes b) {
    const Mask first = a > b;
    return (Lanes)(((Mask)a & first) | ((Mask)b & ~first));
}
/* Magnitudes of the first lane and of the others' deviations from it. */
static inline Lanes sizes(Lanes a) {
    const double first_lane = a[0];
    a -= first_lane;
    a[0] = first_lane;
    return larger(a, (Lanes){0} - a);
}

/* Scaled error of a step with the accelerations k and the result y. */
static double error_of(const Method *m, Control *control, int64_t half, double h, double *const *k, const double *y) {
    Lanes away[2] = {{0}}, top3[2] = {{0}}, top5[2] = {{0}}, bad = {0};
    for (int64_t e = 0; e < half; e += LANES) {
        Lanes e3[2] = {{0}}, e5[2] = {{0}};
        for (int i = 0; i < 12; ++i) {
            const Lanes acceleration = *(const Lanes *)(k[i] + e);
            e3[0] += m->third_place[i] * acceleration, e3[1] += m->third[i] * acceleration;
            e5[0] += m->fifth_place[i] * acceleration, e5[1] += m->fifth[i] * acceleration;
        }
        bad += 0.0 * e3[1];
        for (int part = 0; part < 2; ++part) {
            const Lanes now = *(const Lanes *)(y + part * half + e);
            away[part] = larger(sizes(now), away[part]);
            top3[part] = larger(sizes(e3[part]), top3[part]);
            top5[part] = larger(sizes(e5[part]), top5[part]);
        }
    }
    if (!(bad[0] == 0.0)) return INFINITY;
    double third = 0.0, fifth = 0.0;
    for (int part = 0; part < 2; ++part) {
        /* Errors of positions have one more factor h. */
        const double unit = part ? 1.0 : h;
        double deviation = control->kick;
        for (int l = 1; l < LANES; ++l) deviation = fmax(deviation, away[part][l]);
        control->deviations[part] = fmax(deviation, 0.95 * control->deviations[part]);
        for (int l = 0; l < LANES; ++l) {
            const double scale = l ? control->share * control->deviations[part] : control->tolerance;
            third = fmax(third, unit * top3[part][l] / scale);
            fifth = fmax(fifth, unit * top5[part][l] / scale);
        }
    }
    if (fifth == 0.0) return 0.0;
    return h * fifth * fifth / sqrt(fifth * fifth + 0.01 * third * third);
}

/* Advance y by a duration [s]; work has room for 7 y. Returns 0, 1 if no step is small enough, 2 beyond `most`. */
int advance(const System *s, const Method *m, Control *control, double duration, double *y, double *work) {
    const int64_t half = s->particles * 3 * LANES;
    double *k[12], *next = work + 12 * half;
    for (int i = 0; i < 12; ++i) k[i] = work + i * half;
    const int64_t end = control->evaluations + control->most;
    const double longest = control->longest > 0.0 ? control->longest : INFINITY;
    double t = 0.0, h = fmin(longest, control->step > 0.0 ? control->step : 1e-3 * duration);
    return_at_start(s, y);
    accelerations(s, t, y, y + half, k[0]);
    ++control->evaluations;
    int rejected = 0;
    while (t < duration) {
        const double left = duration - t;
        const int last = h >= left * (1.0 - 1e-12);
        const double step = last ? left : h > 0.5 * left ? 0.5 * left : h;
        if (!(step > 1e-13 * duration)) return 1;
        if (control->evaluations > end) return 2;
        for (int i = 1; i < 12; ++i) {
            combine(half, i, step, m->c[i], m->a_place[i], m->a[i], k, y, next);
            accelerations(s, t + m->c[i] * step, next, next + half, k[i]);
        }
        combine(half, 12, step, 1.0, m->b_place, m->b, k, y, next);
        control->evaluations += 11;
        const double error = error_of(m, control, half, step, k, next);
        if (error < 1.0) {
            double factor = error == 0.0 ? 6.0 : fmin(6.0, 0.9 * pow(error, -0.125));
            if (rejected) factor = fmin(1.0, factor);
            h = fmin(longest, step < h ? fmax(factor * step, fmin(h, duration)) : factor * step);
            rejected = 0;
            t = last ? duration : t + step;
            if (s->frictions.count) flow(s, step, y, next, half);
            memcpy(y, next, 2 * (size_t)half * sizeof(double));
            if (t < duration) {
                accelerations(s, t, y, y + half, k[0]);
                ++control->evaluations;
            }
        } else {
            const double factor = error < INFINITY ? fmax(0.3333, 0.9 * pow(error, -0.125)) : 0.1;
            h = factor * step;
            rejected = 1;
            ++control->rejected;
        }
    }
    control->step = h;
    return 0;
}
