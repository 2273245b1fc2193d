// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// An order of particles in which coupled ones lie close together: that of Cuthill and McKee (1969), reversed (George,
// 1971). Whole numbers only, and no two keys of a sort are equal: the order depends on the pairs alone.
#pragma once

#include <algorithm>
#include <cstdint>
#include <numeric>
#include <vector>

namespace cloth {

class CuthillMcKee {
    using Index = std::int64_t;

    Index degree(Index p) const { return first_[p + 1] - first_[p]; }
    auto before() const {
        return [this](Index a, Index b) { return degree(a) != degree(b) ? degree(a) < degree(b) : a < b; };
    }

public:

    /// Particles 0 ... count - 1 and the pairs of them that are coupled; repeated ones and loops do not matter.
    CuthillMcKee(Index count, const Index* pairs, Index pair_count)
        : count_(count), first_(count + 1), level_(count), rank_(count), seen_(count), taken_(count) {
        std::vector<Index> place(count + 1);
        for (Index e = 0; e < 2 * pair_count; ++e) ++place[pairs[e] + 1];
        std::partial_sum(place.begin(), place.end(), place.begin());
        std::vector<Index> next(place), ends(2 * pair_count);
        for (Index e = 0; e < 2 * pair_count; ++e) ends[next[pairs[e]]++] = pairs[e ^ 1];
        for (Index p = 0; p < count; ++p) {
            const auto begin = ends.begin() + place[p], end = ends.begin() + place[p + 1];
            std::sort(begin, end);
            for (auto other = begin; other != end; ++other)
                if (*other != p && (other == begin || *other != *(other - 1))) near_.push_back(*other);
            first_[p + 1] = Index(near_.size());
        }
        for (Index p = 0; p < count; ++p)
            std::sort(near_.begin() + first_[p], near_.begin() + first_[p + 1], before());
    }

    /// Write the particles in their order.
    void write(Index* order) {
        std::vector<Index> starts(count_), best, trial;
        std::iota(starts.begin(), starts.end(), 0);
        std::sort(starts.begin(), starts.end(), before());
        Index written = count_;
        for (Index start : starts) {
            if (taken_[start]) continue;
            best.clear();
            // From the far end of the part that was reached last, levels are more and narrower: the best of some tries.
            Index least = 0;
            for (int sweep = 0; sweep < tries; ++sweep) {
                const Index wide = visit(start, trial);
                if (sweep == 0 || wide < least) {
                    best = trial;
                    least = wide;
                }
                const Index deepest = level_[trial.back()];
                for (Index p : trial)
                    if (level_[p] == deepest && (level_[start] != deepest || before()(p, start))) start = p;
            }
            for (Index p : best) {
                taken_[p] = true;
                order[--written] = p;
            }
        }
    }

private:
    static constexpr int tries = 3;

    /// Visit all that is coupled with a particle, level by level; return the largest distance of two coupled ones.
    Index visit(Index start, std::vector<Index>& visited) {
        visited.assign(1, start);
        ++round_;
        rank_[start] = 0;
        level_[start] = 0;
        seen_[start] = round_;
        Index wide = 0;
        for (Index k = 0; k < Index(visited.size()); ++k) {
            const Index p = visited[k];
            for (Index e = first_[p]; e < first_[p + 1]; ++e) {
                const Index q = near_[e];
                if (seen_[q] != round_) {
                    seen_[q] = round_;
                    level_[q] = level_[p] + 1;
                    rank_[q] = Index(visited.size());
                    visited.push_back(q);
                }
                wide = std::max(wide, rank_[q] - k);
            }
        }
        return wide;
    }

    Index count_, round_ = 0;
    std::vector<Index> first_, near_, level_, rank_, seen_;
    std::vector<char> taken_;
};

}  // namespace cloth
