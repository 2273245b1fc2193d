// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// SIMD vectors of the machine's width, and the operations of the laws. Only IEEE arithmetic (+ - * / sqrt, and fma
// where written), lane by lane: every width gives the same bits. The build sets CLOTH_VECTOR_BYTES.
#pragma once

#include <bit>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#if defined(__AVX2__) || defined(__AVX512F__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#ifndef CLOTH_VECTOR_BYTES
#define CLOTH_VECTOR_BYTES 16
#endif

/// Inlines inner loops: otherwise the compiler calls some functions and passes vectors through memory.
#define CLOTH_INLINE inline __attribute__((always_inline))
/// The same attribute for lambdas.
#define CLOTH_INLINED __attribute__((always_inline))

/// Laws of four corners need more registers than exist. GCC spills fewer values if it may move loads next to their
/// uses, and the loop is a fifth faster. No bit changes, because the order of loads is no order of sums.
#if defined(__AVX2__) && !defined(__clang__)
#define CLOTH_SCHEDULED __attribute__((noinline, optimize("schedule-insns", "sched-pressure")))
#else
#define CLOTH_SCHEDULED __attribute__((noinline))
#endif

namespace cloth::inline core {

template <class T>
struct SimdVector {
    typedef T type __attribute__((vector_size(CLOTH_VECTOR_BYTES)));
    static constexpr int lanes = CLOTH_VECTOR_BYTES / sizeof(T);
};
/// One number per lane.
template <class T>
using vec = typename SimdVector<T>::type;
template <class T>
inline constexpr int lanes = SimdVector<T>::lanes;
/// A vector of at most MaxBytes.
template <class T, int MaxBytes>
struct CappedVector {
    typedef T type __attribute__((vector_size(MaxBytes < CLOTH_VECTOR_BYTES ? MaxBytes : CLOTH_VECTOR_BYTES)));
};

template <class T>
struct QuadVector {
    typedef T type __attribute__((vector_size(4 * sizeof(T))));
};
/// x, y, z of one particle, and one unused number.
template <class T>
using quad = typename QuadVector<T>::type;

/// Scalar type of V, which is double, float, vec<double> or vec<float>.
template <class V>
struct Scalar {
    using type = typename std::remove_reference<decltype(V{}[0])>::type;
};
template <>
struct Scalar<double> {
    using type = double;
};
template <>
struct Scalar<float> {
    using type = float;
};
template <class V>
using scalar = typename Scalar<V>::type;

template <class V>
CLOTH_INLINE V splat(scalar<V> a) {
    if constexpr (sizeof(V) == sizeof(scalar<V>))
        return a;
    else
        return a - V{};  // a - 0 is a, signed zeros included
}

template <class V>
CLOTH_INLINE V load_as(const scalar<V>* from) {
    V to;
    std::memcpy(&to, from, sizeof to);
    return to;
}
template <class V>
CLOTH_INLINE void store_as(scalar<V>* to, V from) {
    std::memcpy(to, &from, sizeof from);
}
template <class T>
CLOTH_INLINE vec<T> load(const T* from) {
    return load_as<vec<T>>(from);
}
template <class T>
CLOTH_INLINE void store(T* to, vec<T> from) {
    store_as(to, from);
}
template <class T>
CLOTH_INLINE quad<T> load4(const T* from) {
    quad<T> to;
    std::memcpy(&to, from, sizeof to);
    return to;
}
template <class T>
CLOTH_INLINE void store4(T* to, quad<T> from) {
    std::memcpy(to, &from, sizeof from);
}

/// a b + c, rounded once.
CLOTH_INLINE double fma(double a, double b, double c) { return __builtin_fma(a, b, c); }
CLOTH_INLINE float fma(float a, float b, float c) { return __builtin_fmaf(a, b, c); }

template <class V>
    requires(sizeof(V) > sizeof(scalar<V>))
CLOTH_INLINE V fma(V a, V b, V c) {
    [[maybe_unused]] constexpr bool wide = sizeof(scalar<V>) == 8;
#if defined(__AVX512F__)
    if constexpr (sizeof(V) == 64 && wide) return V(_mm512_fmadd_pd(__m512d(a), __m512d(b), __m512d(c)));
    if constexpr (sizeof(V) == 64 && !wide) return V(_mm512_fmadd_ps(__m512(a), __m512(b), __m512(c)));
#endif
#if defined(__FMA__)
    if constexpr (sizeof(V) == 32 && wide) return V(_mm256_fmadd_pd(__m256d(a), __m256d(b), __m256d(c)));
    if constexpr (sizeof(V) == 32 && !wide) return V(_mm256_fmadd_ps(__m256(a), __m256(b), __m256(c)));
    if constexpr (sizeof(V) == 16 && wide) return V(_mm_fmadd_pd(__m128d(a), __m128d(b), __m128d(c)));
    if constexpr (sizeof(V) == 16 && !wide) return V(_mm_fmadd_ps(__m128(a), __m128(b), __m128(c)));
#elif defined(__aarch64__)
    if constexpr (sizeof(V) == 16 && wide) return V(vfmaq_f64(float64x2_t(c), float64x2_t(a), float64x2_t(b)));
    if constexpr (sizeof(V) == 16 && !wide) return V(vfmaq_f32(float32x4_t(c), float32x4_t(a), float32x4_t(b)));
#endif
    V r{};
    for (std::size_t k = 0; k < sizeof(V) / sizeof(scalar<V>); ++k) r[k] = fma(a[k], b[k], c[k]);
    return r;
}

CLOTH_INLINE double root(double a) { return __builtin_sqrt(a); }
CLOTH_INLINE float root(float a) { return __builtin_sqrtf(a); }

template <class V>
    requires(sizeof(V) > sizeof(scalar<V>))
CLOTH_INLINE V root(V a) {
    [[maybe_unused]] constexpr bool wide = sizeof(scalar<V>) == 8;
#if defined(__AVX512F__)
    if constexpr (sizeof(V) == 64 && wide) return V(_mm512_maskz_sqrt_pd(0xff, __m512d(a)));
    if constexpr (sizeof(V) == 64 && !wide) return V(_mm512_maskz_sqrt_ps(0xffff, __m512(a)));
#endif
#if defined(__AVX2__)
    if constexpr (sizeof(V) == 32 && wide) return V(_mm256_sqrt_pd(__m256d(a)));
    if constexpr (sizeof(V) == 32 && !wide) return V(_mm256_sqrt_ps(__m256(a)));
#endif
    V r{};
    for (std::size_t k = 0; k < sizeof(V) / sizeof(scalar<V>); ++k) r[k] = root(a[k]);
    return r;
}

#if defined(__AVX512F__)
/// 1 / b, correctly rounded, by Newton's iteration: a division takes twice as long, and roots wait for it.
///
/// e = 1 - b y is exact near 1 / b, and 1 / b exceeds the exact y + y e by e^2 / b. No number halfway between two others
/// is nearer to 1 / b than 2^-106 / b. Therefore both round alike if |e| < 2^-53. Any other number is divided.
CLOTH_INLINE __m512d divide_unit(__m512d b) {
    const __m512d unit = _mm512_set1_pd(1.0);
    __m512d y = _mm512_maskz_rcp14_pd(0xff, b), e = _mm512_fnmadd_pd(b, y, unit);
    y = _mm512_fmadd_pd(y, e, y), e = _mm512_fnmadd_pd(b, y, unit);
    y = _mm512_fmadd_pd(y, e, y), e = _mm512_fnmadd_pd(b, y, unit);
    y = _mm512_fmadd_pd(y, e, y);
    const __mmask8 unknown = _mm512_cmp_pd_mask(_mm512_abs_pd(e), _mm512_set1_pd(0x1p-53), _CMP_NLT_UQ);
    if (__builtin_expect(unknown, 0)) y = _mm512_mask_div_pd(y, unknown, unit, b);
    return y;
}
#endif
/// 1 / a, correctly rounded.
template <class V>
CLOTH_INLINE V reciprocal(V a) {
#if defined(__AVX512F__)
    if constexpr (sizeof(V) == 64 && sizeof(scalar<V>) == 8) return V(divide_unit(__m512d(a)));
#endif
    return splat<V>(1) / a;
}

/// 1 / sqrt(a).
template <class V>
CLOTH_INLINE V inverse_root(V a) {
    return reciprocal(root(a));
}

// Comparisons return a bool for numbers and a mask for vectors; select accepts either.
CLOTH_INLINE double select(bool yes, double a, double b) { return yes ? a : b; }
CLOTH_INLINE float select(bool yes, float a, float b) { return yes ? a : b; }
template <class M, class V>
    requires(sizeof(V) > sizeof(scalar<V>))
CLOTH_INLINE V select(M yes, V a, V b) {
    return yes ? a : b;
}
/// Lanes in which a mask is set, as bits.
template <class M>
CLOTH_INLINE unsigned bits_of(M yes) {
    [[maybe_unused]] constexpr bool wide = sizeof(scalar<M>) == 8;
#if defined(__AVX512F__)
    if constexpr (sizeof(M) == 64 && wide) return _mm512_movepi64_mask(__m512i(yes));
    if constexpr (sizeof(M) == 64 && !wide) return _mm512_movepi32_mask(__m512i(yes));
#endif
#if defined(__AVX2__)
    if constexpr (sizeof(M) == 32 && wide) return static_cast<unsigned>(_mm256_movemask_pd(__m256d(yes)));
    if constexpr (sizeof(M) == 32 && !wide) return static_cast<unsigned>(_mm256_movemask_ps(__m256(yes)));
#endif
    unsigned bits = 0;
    for (std::size_t k = 0; k < sizeof(M) / sizeof(scalar<M>); ++k) bits |= (yes[k] ? 1u : 0u) << k;
    return bits;
}
/// The lanes whose bits are set, moved to the front. The lanes behind them have any numbers.
CLOTH_INLINE vec<double> compress(vec<double> a, unsigned bits) {
#if defined(__AVX512F__)
    if constexpr (lanes<double> == 8) return vec<double>(_mm512_maskz_compress_pd(__mmask8(bits), __m512d(a)));
#endif
    vec<double> r = a;
    for (int lane = 0, to = 0; lane < lanes<double>; ++lane) {
        r[to] = a[lane];
        to += bits >> lane & 1u;
    }
    return r;
}
/// Whether a mask, or a bool, is set in any lane.
CLOTH_INLINE bool any(bool yes) { return yes; }
template <class M>
    requires(sizeof(M) >= 16)
CLOTH_INLINE bool any(M yes) {
    return bits_of(yes) != 0;
}
/// Call `visit` with the indices of the numbers below a bound. The array is padded by a vector.
template <class F>
CLOTH_INLINE void each_below(const double* from, std::size_t size, double limit, F&& visit) {
    using V = vec<double>;
    const V bound = splat<V>(limit);
    for (std::size_t k = 0; k < size; k += lanes<double>) {
        unsigned bits = bits_of(load(from + k) < bound);
        if (size - k < static_cast<std::size_t>(lanes<double>)) bits &= (1u << (size - k)) - 1u;
        for (; bits; bits &= bits - 1u) visit(k + static_cast<std::size_t>(std::countr_zero(bits)));
    }
}
template <class V>
CLOTH_INLINE V absolute(V a) {
    return select(a < V{}, -a, a);
}
/// The smaller, or b if a is NaN.
template <class V>
CLOTH_INLINE V smaller(V a, V b) {
    return select(a < b, a, b);
}
template <class V>
CLOTH_INLINE V larger(V a, V b) {
    return select(a > b, a, b);
}

/// The last N lanes of one vector, then the first of the next: a shift by N columns to the left.
template <int N, class V>
CLOTH_INLINE V shift(V previous, V next) {
    using T = scalar<V>;
    constexpr int L = sizeof(V) / sizeof(T);
    return [&]<int... I>(std::integer_sequence<int, I...>) CLOTH_INLINED {
        return V(__builtin_shufflevector(previous, next, (L - N + I)...));
    }(std::make_integer_sequence<int, L>{});
}

/// All lanes of one vector but the first N, then the first N of the next.
template <int N, class V>
CLOTH_INLINE V shift_left(V current, V next) {
    return shift<static_cast<int>(sizeof(V) / sizeof(scalar<V>)) - N>(current, next);
}

// Particles are quads, laws need vectors of x, y and z: convert `lanes` quads to three vectors, and back. Vectors are
// groups of four lanes, and each group of four rows is transposed.
template <int L>
constexpr int unpack_index(int lane, int first) {
    return (lane & ~3) + (lane & 2) + first + (lane & 1 ? L : 0);
}
template <int L>
constexpr int pair_index(int lane, int first) {
    return (lane & ~3) + (lane & 1) + first + (lane & 2 ? L : 0);
}
template <class V>
CLOTH_INLINE void transpose(V& a, V& b, V& c, V& d) {
    constexpr int L = sizeof(V) / sizeof(scalar<V>);
    [&]<int... I>(std::integer_sequence<int, I...>) CLOTH_INLINED {
        const V even_ab = __builtin_shufflevector(a, b, unpack_index<L>(I, 0)...);
        const V odd_ab = __builtin_shufflevector(a, b, unpack_index<L>(I, 1)...);
        const V even_cd = __builtin_shufflevector(c, d, unpack_index<L>(I, 0)...);
        const V odd_cd = __builtin_shufflevector(c, d, unpack_index<L>(I, 1)...);
        a = __builtin_shufflevector(even_ab, even_cd, pair_index<L>(I, 0)...);
        b = __builtin_shufflevector(odd_ab, odd_cd, pair_index<L>(I, 0)...);
        c = __builtin_shufflevector(even_ab, even_cd, pair_index<L>(I, 2)...);
        d = __builtin_shufflevector(odd_ab, odd_cd, pair_index<L>(I, 2)...);
    }(std::make_integer_sequence<int, L>{});
}

/// Rows k, k + 4, k + 8, ... joined in one vector.
template <class V>
CLOTH_INLINE V join_rows(const quad<scalar<V>>* rows, int k) {
    constexpr int L = sizeof(V) / sizeof(scalar<V>);
    if constexpr (L == 4) {
        return rows[k];
    } else {
        const auto two = __builtin_shufflevector(rows[k], rows[k + 4], 0, 1, 2, 3, 4, 5, 6, 7);
        if constexpr (L == 8) {
            return two;
        } else {
            const auto more = __builtin_shufflevector(rows[k + 8], rows[k + 12], 0, 1, 2, 3, 4, 5, 6, 7);
            return __builtin_shufflevector(two, more, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        }
    }
}

template <class V>
CLOTH_INLINE void deinterleave(const quad<scalar<V>>* rows, V& x, V& y, V& z, V& w) {
    if constexpr (sizeof(V) == 2 * sizeof(scalar<V>)) {
        x = V{rows[0][0], rows[1][0]};
        y = V{rows[0][1], rows[1][1]};
        z = V{rows[0][2], rows[1][2]};
        w = V{rows[0][3], rows[1][3]};
    } else {
        x = join_rows<V>(rows, 0);
        y = join_rows<V>(rows, 1);
        z = join_rows<V>(rows, 2);
        w = join_rows<V>(rows, 3);
        transpose(x, y, z, w);
    }
}
template <class V>
CLOTH_INLINE void deinterleave(const quad<scalar<V>>* rows, V& x, V& y, V& z) {
    V unused;
    deinterleave(rows, x, y, z, unused);
}

/// The numbers of even and of odd index in two vectors, one after the other.
template <class V>
CLOTH_INLINE void split_pairs(V first, V second, V& even, V& odd) {
    constexpr int L = sizeof(V) / sizeof(scalar<V>);
    const auto split = [&]<int... I>(std::integer_sequence<int, I...>) CLOTH_INLINED {
        even = __builtin_shufflevector(first, second, (2 * I)...);
        odd = __builtin_shufflevector(first, second, (2 * I + 1)...);
    };
    split(std::make_integer_sequence<int, L>{});
}

/// `w`: the fourth numbers.
template <class V>
CLOTH_INLINE void interleave(V x, V y, V z, quad<scalar<V>>* rows, V w = V{}) {
    constexpr int L = sizeof(V) / sizeof(scalar<V>);
    if constexpr (L == 2) {
        rows[0] = quad<scalar<V>>{x[0], y[0], z[0], w[0]};
        rows[1] = quad<scalar<V>>{x[1], y[1], z[1], w[1]};
    } else {
        V four[4] = {x, y, z, w};
        transpose(four[0], four[1], four[2], four[3]);
        for (int k = 0; k < 4; ++k) {
            rows[k] = __builtin_shufflevector(four[k], four[k], 0, 1, 2, 3);
            if constexpr (L >= 8) rows[k + 4] = __builtin_shufflevector(four[k], four[k], 4, 5, 6, 7);
            if constexpr (L == 16) {
                rows[k + 8] = __builtin_shufflevector(four[k], four[k], 8, 9, 10, 11);
                rows[k + 12] = __builtin_shufflevector(four[k], four[k], 12, 13, 14, 15);
            }
        }
    }
}

}  // namespace cloth::inline core
