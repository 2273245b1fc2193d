// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Ordering of particles by reverse Cuthill-McKee.
#include "core/ordering.hpp"

#include "samples.hpp"

namespace cloth::tests::ordering {

namespace {

using Pairs = std::vector<std::int64_t>;

std::vector<std::int64_t> order_of(std::int64_t count, const Pairs& pairs) {
    std::vector<std::int64_t> order(count, -1);
    CuthillMcKee(count, pairs).write_order(order);
    return order;
}

bool is_permutation(std::vector<std::int64_t> order) {
    std::sort(order.begin(), order.end());
    for (std::size_t k = 0; k < order.size(); ++k)
        if (order[k] != static_cast<std::int64_t>(k)) return false;
    return true;
}

/// Largest distance of a coupled pair in an order.
std::int64_t bandwidth(const std::vector<std::int64_t>& order, const Pairs& pairs) {
    std::vector<std::int64_t> rank(order.size());
    for (std::size_t k = 0; k < order.size(); ++k) rank[order[k]] = static_cast<std::int64_t>(k);
    std::int64_t width = 0;
    for (std::size_t e = 0; e < pairs.size(); e += 2)
        width = std::max(width, std::abs(rank[pairs[e]] - rank[pairs[e + 1]]));
    return width;
}

/// Names of particles in random order.
std::vector<std::int64_t> shuffled(std::int64_t count, Random& random) {
    std::vector<std::int64_t> names(count);
    std::iota(names.begin(), names.end(), 0);
    for (std::int64_t k = count - 1; k > 0; --k) std::swap(names[k], names[random.below(k + 1)]);
    return names;
}

}  // namespace

TEST_CASE("a chain has bandwidth one") {
    Random random;
    const auto names = shuffled(50, random);
    Pairs pairs;
    for (int k = 0; k < 49; ++k) pairs.insert(pairs.end(), {names[k], names[k + 1]});
    const auto order = order_of(50, pairs);
    CHECK(is_permutation(order));
    CHECK(bandwidth(order, pairs) == 1);
}

TEST_CASE("a sheet has the bandwidth of its shorter side") {
    Random random;
    constexpr std::int64_t rows = 20, columns = 6;
    const auto names = shuffled(rows * columns, random);
    Pairs pairs;
    for (std::int64_t i = 0; i < rows; ++i)
        for (std::int64_t j = 0; j < columns; ++j) {
            if (i + 1 < rows) pairs.insert(pairs.end(), {names[i * columns + j], names[(i + 1) * columns + j]});
            if (j + 1 < columns) pairs.insert(pairs.end(), {names[i * columns + j], names[i * columns + j + 1]});
        }
    const auto order = order_of(rows * columns, pairs);
    CHECK(is_permutation(order));
    CHECK(bandwidth(order, pairs) <= columns + 1);
}

TEST_CASE("separate particles and pieces are all ordered") {
    const Pairs pairs{0, 5, 2, 3};
    CHECK(is_permutation(order_of(7, pairs)));
    CHECK(bandwidth(order_of(7, pairs), pairs) == 1);
    CHECK(is_permutation(order_of(3, {})));
    CHECK(order_of(0, {}).empty());
}

TEST_CASE("the order depends on the set of pairs alone") {
    Random random;
    Pairs pairs, changed;
    for (int k = 0; k < 80; ++k) pairs.insert(pairs.end(), {random.below(30), random.below(30)});
    // Reversed pairs in reverse order, with duplicates and loops.
    for (std::size_t e = pairs.size(); e > 0; e -= 2) changed.insert(changed.end(), {pairs[e - 1], pairs[e - 2]});
    changed.insert(changed.end(), {pairs[0], pairs[1], 7, 7});
    CHECK(order_of(30, pairs) == order_of(30, changed));
}

}  // namespace cloth::tests::ordering
