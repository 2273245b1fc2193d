// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Ordering of particles with coupled ones close together: reverse Cuthill-McKee (1969; George 1971). Integers only, and
// no two sort keys are equal: the order depends on the set of pairs alone.
#pragma once

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <span>
#include <vector>

namespace cloth::inline core {

class CuthillMcKee {
    using Index = std::int64_t;

    Index degree(Index p) const { return first_[p + 1] - first_[p]; }
    auto by_degree() const {
        return [this](Index a, Index b) { return degree(a) != degree(b) ? degree(a) < degree(b) : a < b; };
    }

public:
    /// Particles 0 ... count - 1 and the two particles of each coupled pair; duplicates and loops are ignored.
    CuthillMcKee(Index count, std::span<const Index> pairs)
        : count_(count), first_(count + 1), level_(count), rank_(count), visited_round_(count), ordered_(count) {
        std::vector<Index> offset(count + 1);
        for (const Index p : pairs) ++offset[p + 1];
        std::partial_sum(offset.begin(), offset.end(), offset.begin());
        std::vector<Index> next(offset), ends(pairs.size());
        for (std::size_t e = 0; e < pairs.size(); ++e) ends[next[pairs[e]]++] = pairs[e ^ 1];
        for (Index p = 0; p < count; ++p) {
            const auto begin = ends.begin() + offset[p], end = ends.begin() + offset[p + 1];
            std::sort(begin, end);
            for (auto it = begin; it != end; ++it)
                if (*it != p && (it == begin || *it != *(it - 1))) neighbors_.push_back(*it);
            first_[p + 1] = Index(neighbors_.size());
        }
        for (Index p = 0; p < count; ++p)
            std::sort(neighbors_.begin() + first_[p], neighbors_.begin() + first_[p + 1], by_degree());
    }

    /// Write the particles in order.
    void write_order(std::span<Index> order) {
        std::vector<Index> starts(count_), best, trial;
        std::iota(starts.begin(), starts.end(), 0);
        std::sort(starts.begin(), starts.end(), by_degree());
        Index written = count_;
        for (Index start : starts) {
            if (ordered_[start]) continue;
            best.clear();
            // Start from a particle of the last level, so that there are more and narrower levels; keep the best of
            // some tries.
            Index min_width = 0;
            for (int sweep = 0; sweep < tries; ++sweep) {
                const Index width = visit(start, trial);
                if (sweep == 0 || width < min_width) {
                    best = trial;
                    min_width = width;
                }
                const Index deepest = level_[trial.back()];
                for (Index p : trial)
                    if (level_[p] == deepest && (level_[start] != deepest || by_degree()(p, start))) start = p;
            }
            for (Index p : best) {
                ordered_[p] = true;
                order[--written] = p;
            }
        }
    }

private:
    static constexpr int tries = 3;

    /// Visit all particles coupled with a start, level by level; return the largest rank distance of a coupled pair.
    Index visit(Index start, std::vector<Index>& visited) {
        visited.assign(1, start);
        ++round_;
        rank_[start] = 0;
        level_[start] = 0;
        visited_round_[start] = round_;
        Index width = 0;
        for (Index k = 0; k < Index(visited.size()); ++k) {
            const Index p = visited[k];
            for (Index e = first_[p]; e < first_[p + 1]; ++e) {
                const Index q = neighbors_[e];
                if (visited_round_[q] != round_) {
                    visited_round_[q] = round_;
                    level_[q] = level_[p] + 1;
                    rank_[q] = Index(visited.size());
                    visited.push_back(q);
                }
                width = std::max(width, rank_[q] - k);
            }
        }
        return width;
    }

    Index count_, round_ = 0;
    std::vector<Index> first_, neighbors_, level_, rank_, visited_round_;
    std::vector<char> ordered_;
};

}  // namespace cloth::inline core
