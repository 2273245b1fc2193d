// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Band solver against dense matrices.
#include "core/band.hpp"

#include <vector>

#include "samples.hpp"

namespace cloth::tests {

namespace {

/// A dense symmetric matrix.
struct Dense {
    std::int64_t size;
    std::vector<double> entries;

    explicit Dense(std::int64_t n) : size(n), entries(n * n, 0.0) {}
    double& operator()(std::int64_t i, std::int64_t j) { return entries[i * size + j]; }

    std::vector<double> product(const std::vector<double>& x) {
        std::vector<double> y(size, 0.0);
        for (std::int64_t i = 0; i < size; ++i)
            for (std::int64_t j = 0; j < size; ++j) y[i] += (*this)(i, j) * x[j];
        return y;
    }
    /// Eliminate the first unknowns; the rest is the Schur complement.
    void eliminate(std::int64_t unknowns) {
        for (std::int64_t k = 0; k < unknowns; ++k)
            for (std::int64_t i = k + 1; i < size; ++i) {
                const double factor = (*this)(i, k) / (*this)(k, k);
                for (std::int64_t j = k; j < size; ++j) (*this)(i, j) -= factor * (*this)(k, j);
            }
    }
};

/// A matrix of masses and pairs within a band, as a band and dense.
struct Matrix {
    std::vector<double> rows;
    Band band;
    Dense dense;

    Matrix(std::int64_t count, std::int64_t width, Random& random)
        : rows(3 * count * band_stride(width), 0.0), band{rows.data(), count, width}, dense(3 * count) {
        for (std::int64_t i = 0; i < count; ++i) {
            add_block(i, i, random);
            for (std::int64_t j = i + 1; j < count && j <= i + width; ++j) add_block(i, j, random);
            add_block(i, -1, random);
        }
    }
    Matrix(const Matrix&) = delete;

    /// Set all blocks beside the diagonal to random numbers, which are not symmetric.
    void randomize(Random& random) {
        for (std::int64_t i = 0; i < band.count; ++i)
            for (std::int64_t j = i + 1; j < band.count && j <= i + band.width; ++j)
                for (int r = 0; r < 3; ++r)
                    for (int c = 0; c < 3; ++c)
                        band.row(i, r)[3 * (j - i) + c] = dense(3 * i + r, 3 * j + c) = dense(3 * j + c, 3 * i + r) =
                            random.uniform();
    }
    /// Add a positive semi-definite block to a pair, or with a mass to a diagonal (i = j). Row -1 is fixed.
    void add_block(std::int64_t i, std::int64_t j, Random& random) {
        const Vec3<double> a = random.vector();
        const Sym3<double> m = outer(1.0, a, 0.1);
        const double block[6] = {m.xx, m.yy, m.zz, m.xy, m.xz, m.yz}, mass = i == j ? 1.0 : 0.0;
        const double full[3][3] = {{m.xx, m.xy, m.xz}, {m.xy, m.yy, m.yz}, {m.xz, m.yz, m.zz}};
        if (i == j)
            add_diagonal(band, i, mass, block, 1);
        else
            add_pair(band, i, j, block);
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) {
                dense(3 * i + r, 3 * i + c) += full[r][c] + (r == c ? mass : 0.0);
                if (i == j || j < 0) continue;
                dense(3 * j + r, 3 * j + c) += full[r][c];
                dense(3 * i + r, 3 * j + c) -= full[r][c];
                dense(3 * j + r, 3 * i + c) -= full[r][c];
            }
    }
};

/// Entry of a band, row and column of the whole matrix, on or above the diagonal.
double entry(const Band& a, std::int64_t i, std::int64_t j) {
    return a.row(i / 3, static_cast<int>(i % 3))[j - i / 3 * 3];
}

/// Sum with eight partial sums, by numbers.
double partial_sum(const std::vector<double>& numbers) {
    double s[8] = {};
    for (std::size_t k = 0; k < numbers.size(); ++k) s[k % 8] += numbers[k];
    return ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]));
}

}  // namespace

TEST_CASE("assembly stores the upper half of the matrix") {
    Random random;
    Matrix m(6, 2, random);
    for (std::int64_t i = 0; i < 18; ++i)
        for (std::int64_t j = i; j < std::min<std::int64_t>(18, 3 * (i / 3 + 3)); ++j)
            check_close(entry(m.band, i, j), m.dense(i, j), 1e-14, 1.0);
}

TEST_CASE("the solution of a band has no residual") {
    Random random;
    for (std::int64_t count = 1; count <= 9; ++count)
        for (std::int64_t width = 1; width <= 5; ++width) {
            Matrix m(count, width, random);
            std::vector<double> expected(3 * count);
            for (double& x : expected) x = random.uniform();
            std::vector<double> y = m.dense.product(expected);
            REQUIRE(factor(m.band, count));
            forward(m.band, count, y.data());
            backward(m.band, count, y.data());
            for (std::size_t i = 0; i < y.size(); ++i) check_close(y[i], expected[i], 1e-12, 1.0);
        }
}

TEST_CASE("the rows that are not eliminated are the Schur complement") {
    Random random;
    for (const std::int64_t inner : {1, 2, 3, 5}) {
        Matrix m(7, 3, random);
        REQUIRE(factor(m.band, inner));
        m.dense.eliminate(3 * inner);
        for (std::int64_t i = 3 * inner; i < 21; ++i)
            for (std::int64_t j = i; j < std::min<std::int64_t>(21, 3 * (i / 3 + 4)); ++j)
                check_close(entry(m.band, i, j), m.dense(i, j), 1e-12, 1.0);
    }
}

TEST_CASE("a matrix that is not positive definite is refused") {
    Random random;
    for (const std::int64_t bad_row : {0, 3, 6}) {
        Matrix m(7, 2, random);
        m.band.row(bad_row, 1)[1] = -1.0;
        CHECK_FALSE(factor(m.band, 7));
    }
    Matrix m(3, 1, random);
    m.band.row(1, 0)[0] = std::numeric_limits<double>::quiet_NaN();
    CHECK_FALSE(factor(m.band, 3));
}

TEST_CASE("join adds two Schur complements, one of them in reverse order") {
    Random random;
    constexpr std::int64_t count = 3, width = 4;
    Matrix upper(2 + count, width, random), lower(1 + count, width, random);
    upper.randomize(random);
    lower.randomize(random);
    std::vector<double> rows(3 * count * band_stride(width), 0.0);
    const Band middle{rows.data(), count, width};
    join(upper.band, lower.band, 2, 1, middle);
    for (std::int64_t i = 0; i < count; ++i)
        for (std::int64_t j = i; j < count; ++j)
            for (int r = 0; r < 3; ++r)
                for (int c = i == j ? r : 0; c < 3; ++c) {
                    const double expected = upper.dense(3 * (2 + i) + r, 3 * (2 + j) + c) +
                                            lower.dense(3 * (count - i) + r, 3 * (count - j) + c);
                    check_close(entry(middle, 3 * i + r, 3 * j + c), expected, 1e-14, 1.0);
                }
}

TEST_CASE("sums have eight partial sums at any width") {
    Random random;
    for (int count = 0; count < 40; ++count) {
        std::vector<double> numbers(count);
        for (double& a : numbers) a = std::ldexp(random.uniform(), static_cast<int>(random.below(40)));
        CHECK(has_same_bits(sum(numbers), partial_sum(numbers)));
    }
}

TEST_CASE("numbers that would become denormal are set to zero") {
    const vec<double> flushed = flush_tiny(splat<vec<double>>(-9e-121));
    CHECK(flushed[0] == 0.0);
    CHECK(flush_tiny(1.1e-120) == 1.1e-120);
    CHECK(flush_tiny(-1.0) == -1.0);
}

}  // namespace cloth::tests
