// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// C ABI of the band matrix and of the ordering. `band.py` checks shapes and types; this file checks indices.
#pragma once

#include <cstdint>
#include <new>
#include <span>

#include "api/guard.hpp"
#include "core/band.hpp"
#include "core/ordering.hpp"

namespace cloth::api {

CLOTH_API std::int64_t cloth_band_stride(std::int64_t width) { return band_stride(width); }

CLOTH_API int cloth_band_assemble(double* rows, std::int64_t count, std::int64_t width, const std::int64_t* block_rows,
                                  std::int64_t particles, const std::int64_t* pairs, const double* blocks,
                                  std::int64_t numbers, std::int64_t pair_count, const std::int64_t* selected,
                                  std::int64_t selected_count) {
    const Band a{rows, count, width};
    for (std::int64_t k = 0; k < selected_count; ++k) {
        const std::int64_t e = selected[k];
        if (e < 0 || e >= pair_count) return CLOTH_BAND_BAD_SELECTION;
        const std::int64_t p = pairs[2 * e], q = pairs[2 * e + 1];
        if (p < 0 || p >= particles || q < 0 || q >= particles) return CLOTH_BAND_BAD_PARTICLE;
        const std::int64_t i = block_rows[p], j = block_rows[q];
        if (i >= count || j >= count) return CLOTH_BAND_BAD_BLOCK_ROW;
        if (i >= 0 && j >= 0 && (i == j || i - j > width || j - i > width)) return CLOTH_BAND_BAD_BLOCK_ROW;
        if (numbers == 9)
            add_coupling(a, i, j, blocks + 9 * e);
        else
            add_pair(a, i, j, blocks + 6 * e);
    }
    return CLOTH_BAND_OK;
}

CLOTH_API int cloth_band_assemble_diagonal(double* rows, std::int64_t count, std::int64_t width,
                                           const std::int64_t* block_rows, std::int64_t particles, const double* masses,
                                           const double* blocks) {
    const Band a{rows, count, width};
    for (std::int64_t p = 0; p < particles; ++p) {
        if (block_rows[p] >= count) return CLOTH_BAND_BAD_BLOCK_ROW;
        if (block_rows[p] >= 0) add_diagonal(a, block_rows[p], masses[p], blocks + p, particles);
    }
    return CLOTH_BAND_OK;
}

CLOTH_API int cloth_band_factor(double* rows, std::int64_t count, std::int64_t width, std::int64_t inner) {
    return factor({rows, count, width}, inner) ? CLOTH_BAND_OK : CLOTH_BAND_NOT_POSITIVE;
}

CLOTH_API int cloth_band_forward(double* rows, std::int64_t count, std::int64_t width, std::int64_t inner, double* y) {
    forward({rows, count, width}, inner, y);
    return CLOTH_BAND_OK;
}

CLOTH_API int cloth_band_backward(double* rows, std::int64_t count, std::int64_t width, std::int64_t inner, double* y) {
    backward({rows, count, width}, inner, y);
    return CLOTH_BAND_OK;
}

CLOTH_API int cloth_band_join(double* upper, std::int64_t count_upper, double* lower, std::int64_t count_lower,
                              std::int64_t width, std::int64_t inner_upper, std::int64_t inner_lower, double* middle,
                              std::int64_t shared, std::int64_t width_middle) {
    join({upper, count_upper, width}, {lower, count_lower, width}, inner_upper, inner_lower,
         {middle, shared, width_middle});
    return CLOTH_BAND_OK;
}

CLOTH_API int cloth_cuthill_mckee(std::int64_t count, const std::int64_t* pairs, std::int64_t pair_count,
                                  std::int64_t* order) {
    const std::span coupled(pairs, 2 * pair_count);
    for (const std::int64_t p : coupled)
        if (p < 0 || p >= count) return CLOTH_BAND_BAD_PARTICLE;
    try {
        CuthillMcKee(count, coupled).write_order({order, static_cast<std::size_t>(count)});
    } catch (const std::bad_alloc&) {
        return CLOTH_BAND_NO_MEMORY;
    }
    return CLOTH_BAND_OK;
}

CLOTH_API int cloth_sum(const double* values, std::int64_t count, double* total) {
    *total = sum({values, static_cast<std::size_t>(count)});
    return CLOTH_BAND_OK;
}

}  // namespace cloth::api
