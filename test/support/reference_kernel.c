/* Copyright 2026 the cloth_sim_ros authors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The bar for the engine: all spring forces of a regular sheet in vectors written by hand.
 *
 * Six families (right, down, both diagonals, two apart along either axis), damping included, each spring once. Three components of position,
 * velocity and force in separate arrays of (rows + 2) x pitch numbers, pitch a multiple of the vector; the numbers beyond the sheet are there to be
 * read, and weights of zero take their springs away. Compiled once for each precision: -DREAL=float or double.
 */
#include <math.h>
#include <stddef.h>

#ifndef REAL
#define REAL float
#endif
#define BYTES 64
#define LANES ((ptrdiff_t)(BYTES / sizeof(REAL)))
typedef REAL vector __attribute__((vector_size(BYTES)));
typedef REAL loose __attribute__((vector_size(BYTES), aligned(sizeof(REAL)), may_alias));

static inline vector load(const REAL *p) { return *(const loose *)p; }
static inline void store(REAL *p, vector value) { *(loose *)p = value; }

static inline vector inverse_root(vector square) {
    vector root;
    for (int lane = 0; lane < LANES; ++lane)
        root[lane] = (REAL)1 / (sizeof(REAL) == 4 ? (REAL)sqrtf((float)square[lane]) : (REAL)sqrt(square[lane]));
    return root;
}

/* Family by family, a row at a time: the force of each spring goes to a row buffer, is added to the near ends from there, then taken from the far
 * ends. `offset` leads from the near to the far end. */
static void family(ptrdiff_t rows, ptrdiff_t pitch, ptrdiff_t offset, const REAL *const *x, const REAL *const *v,
                   const REAL *weights, ptrdiff_t weight_pitch, REAL k, REAL slope, REAL damping, REAL *buffer,
                   REAL *const *f) {
    for (ptrdiff_t row = 0; row < rows; ++row) {
        const ptrdiff_t start = row * pitch;
        for (ptrdiff_t j = 0; j < pitch; j += LANES) {
            const ptrdiff_t near = start + j, far = near + offset;
            const vector d0 = load(x[0] + far) - load(x[0] + near);
            const vector d1 = load(x[1] + far) - load(x[1] + near);
            const vector d2 = load(x[2] + far) - load(x[2] + near);
            const vector e0 = load(v[0] + far) - load(v[0] + near);
            const vector e1 = load(v[1] + far) - load(v[1] + near);
            const vector e2 = load(v[2] + far) - load(v[2] + near);
            const vector r = inverse_root(d0 * d0 + d1 * d1 + d2 * d2 + (REAL)1e-30);
            const vector rate = e0 * d0 + e1 * d1 + e2 * d2;
            const vector factor = ((damping * rate * r - k) * r + slope) * load(weights + row * weight_pitch + j);
            store(buffer + j, factor * d0);
            store(buffer + pitch + j, factor * d1);
            store(buffer + 2 * pitch + j, factor * d2);
        }
        for (int c = 0; c < 3; ++c)
            for (ptrdiff_t j = 0; j < pitch; j += LANES)
                store(f[c] + start + j, load(f[c] + start + j) + load(buffer + c * pitch + j));
        for (int c = 0; c < 3; ++c)
            for (ptrdiff_t j = 0; j < pitch; j += LANES)
                store(f[c] + start + offset + j, load(f[c] + start + offset + j) - load(buffer + c * pitch + j));
    }
}

/* f = spring forces, `repeats` times. x, v, f: three components each, (rows + 2) * pitch + 2 LANES numbers apart. weights: for each family rows x pitch.
 * constants: for each family k_s [N], k_s / rest length [N/m], k_d [N s/m]. buffer: 3 * pitch. */
void family_forces(ptrdiff_t rows, ptrdiff_t pitch, ptrdiff_t repeats, const REAL *x, const REAL *v, const REAL *weights,
                   const REAL *constants, REAL *buffer, REAL *f) {
    const ptrdiff_t size = (rows + 2) * pitch + 2 * LANES;
    const REAL *const xs[3] = {x, x + size, x + 2 * size}, *const vs[3] = {v, v + size, v + 2 * size};
    REAL *const fs[3] = {f, f + size, f + 2 * size};
    const ptrdiff_t offsets[6] = {1, pitch, pitch + 1, pitch - 1, 2, 2 * pitch};
    for (ptrdiff_t repeat = 0; repeat < repeats; ++repeat) {
        for (ptrdiff_t i = 0; i < 3 * size; ++i) f[i] = 0;
        for (int n = 0; n < 6; ++n)
            family(rows, pitch, offsets[n], xs, vs, weights + n * rows * pitch, pitch, constants[3 * n], constants[3 * n + 1],
                   constants[3 * n + 2], buffer, fs);
    }
}
