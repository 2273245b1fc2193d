// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Bounds of the squared highest frequency and the highest damping rate of a whole scene, which limit explicit steps.
// Positions are (3, n).
#pragma once

#include "grid_bounds.hpp"
#include "plan.hpp"

namespace cloth {

/// Largest number of an array, and whether all were numbers.
inline double largest_or_nan(const double* numbers, std::int64_t count) {
    double most = 0.0;
    bool bad = false;
    for (std::int64_t i = 0; i < count; ++i) {
        most = numbers[i] > most ? numbers[i] : most;
        bad = bad || !(numbers[i] == numbers[i]);
    }
    return bad ? __builtin_nan("") : most;
}

/// Add to (6, n) what all parts but grippers, contact and drag bound stiffness and damping by.
inline void add_bounds(const Plan& plan, const double* x, double* stiff, double* damp) {
    if (plan.grid) add_grid_bounds(*plan.grid, plan.tables, x, stiff, damp);
    for (const List& list : plan.lists) add_list_bounds(list, x, plan.count, stiff, damp);
}

inline void eigenvalues(const double* blocks, std::int64_t n, double* to) {
    for (std::int64_t i = 0; i < n; i += lanes<double>) {
        Array<double> rest(6 * lanes<double>, 0.0);
        const bool whole = i + lanes<double> <= n;
        if (!whole)
            for (int c = 0; c < 6; ++c)
                for (std::int64_t k = i; k < n; ++k) rest[c * lanes<double> + k - i] = blocks[c * n + k];
        const auto at = [&](int c) { return whole ? load(blocks + c * n + i) : load(rest.data() + c * lanes<double>); };
        const vec<double> found = largest_eigenvalue(Sym3<vec<double>>{at(0), at(1), at(2), at(3), at(4), at(5)});
        if (whole)
            store(to + i, found);
        else
            for (std::int64_t k = i; k < n; ++k) to[k] = found[k - i];
    }
}

struct Rates {
    double omega2, damping;
    /// Of hinges alone, and of what tension and compression of springs do across them; zero without hinges.
    double hinges2 = 0.0, hinge_damping = 0.0, across2 = 0.0;
};
/// Sharper bounds where few particles stand out, as the light ones of an irregular mesh do. Of a sum over its corners an
/// element's square may be shared out by any positive weights of the particles (laws.hpp). A particle that stands out
/// gets a larger one, so its neighbours take more of the common elements. Perron's iteration finds the best weights of a
/// matrix without signs: multiply by what the bound came to, relative to what it may come down to. Whatever it has got to
/// after a few rounds, each round's bound holds, and the lowest is taken.
class Sharpened {
public:
    /// `blocks` (12, n) of all parts with equal weights, and what stiffness and damping come to for each particle; or of
    /// hinges alone.
    Sharpened(const Plan& plan, const double* x, const Array<double>& blocks, const Array<double>& k,
              const Array<double>& c, bool hinges)
        : plan_(plan), sides_{Side(k), Side(c)} {
        if (!sides_[0].unequal && !sides_[1].unequal) return;
        place_.assign(plan.count, -1);
        std::vector<char> stands_out(plan.count, 0);
        for (const Side& side : sides_)
            for (std::int64_t i = 0; side.unequal && i < plan.count; ++i) stands_out[i] |= side.rows[i] > side.among;
        // Whatever pulls at them, their rows have to come down.
        for (std::int64_t i = 0; i < plan.count; ++i)
            if (stands_out[i]) place(i);
        for (const List& list : plan.lists)
            if (list.slow || !hinges) with_law(list.kind, [&](auto law) { take<decltype(law)>(list, x, stands_out); });
        gather(blocks);
        for (int round = 0; round < rounds; ++round) improve(stands_out);
    }
    Rates rates() const { return {sides_[0].best, sides_[1].best}; }

private:
    static constexpr int rounds = 3;
    /// Of the largest: what it may come down to, for where pairs pull, equal weights are off by two at most; what gets a
    /// weight; and what the others are below where it is worth the work.
    static constexpr double least = 0.5, heavy = 0.4, worth = 0.7;
    /// One in so many particles may get a weight, but never fewer than that.
    static constexpr std::int64_t one_in = 16;

    /// Stiffness or damping.
    struct Side {
        explicit Side(const Array<double>& rows) : rows(rows), best(largest_or_nan(rows.data(), rows.size())) {
            const auto count = static_cast<std::int64_t>(rows.size()), most = std::max(count / one_in, one_in);
            if (!(best > 0.0)) return;
            if (most < count) {
                Array<double> sorted = rows;
                std::nth_element(sorted.begin(), sorted.begin() + most, sorted.end(), std::greater<>());
                among = sorted[most];
            }
            unequal = among < worth * best;
            among = std::max(among, heavy * best);
            aim = std::max(least * best, among);
        }
        /// What every particle comes to with equal weights, the largest of those that get no weight, and the bound.
        const Array<double>& rows;
        double among = 0.0, best, aim = 0.0;
        bool unequal = false;
        /// Weights of the particles taken, blocks of what weights leave alone, and with them.
        Array<double> weights, still, blocks, found;
    };
    struct Shared {
        int corners;
        std::int64_t at[4];
        Bound<double> bound[4];
        double total;
    };

    /// Keep the elements that a particle that stands out is a corner of, and their particles.
    template <class Law>
    void take(const List& list, const double* x, const std::vector<char>& stands_out) {
        for (std::int64_t e = 0; e < list.count; ++e) {
            const std::int64_t* const p = list.corners.data() + e * list.width;
            bool any = false;
            for (int i = 0; i < Law::corners; ++i) any = any || stands_out[p[i]];
            if (!any) continue;
            const Seen<Law> s(list, e, x, nullptr, plan_.count);
            Shared shared{Law::corners, {}, {}, 0.0};
            Law::bounds(s.params, s.d, shared.bound);
            for (int i = 0; i < Law::corners; ++i) shared.total += shared.bound[i].norm;
            if (!(shared.total > 0.0)) continue;
            for (int i = 0; i < Law::corners; ++i) shared.at[i] = place(p[i]);
            elements_.push_back(shared);
        }
    }
    /// Where a particle stands among those taken.
    std::int64_t place(std::int64_t i) {
        if (place_[i] < 0) {
            place_[i] = static_cast<std::int64_t>(particles_.size());
            particles_.push_back(i);
        }
        return place_[i];
    }
    static const Sym3<double>& part(const Bound<double>& bound, int side) { return side ? bound.damp : bound.stiff; }

    void gather(const Array<double>& blocks) {
        const auto count = static_cast<std::int64_t>(particles_.size());
        for (int k = 0; k < 2; ++k) {
            Side& side = sides_[k];
            side.weights.assign(count, 1.0);
            side.still.resize(6 * count);
            side.found.resize(count);
            for (std::int64_t j = 0; j < count; ++j) {
                side.found[j] = side.rows[particles_[j]];
                for (int row = 0; row < 6; ++row)
                    side.still[row * count + j] = blocks[(6 * k + row) * plan_.count + particles_[j]];
            }
            for (const Shared& e : elements_)
                for (int i = 0; i < e.corners; ++i) add_times(side.still, count, e.at[i], -1.0, part(e.bound[i], k));
        }
    }
    static void add_times(Array<double>& blocks, std::int64_t n, std::int64_t i, double by, const Sym3<double>& b) {
        add_block(blocks.data(), n, i, {by * b.xx, by * b.yy, by * b.zz, by * b.xy, by * b.xz, by * b.yz});
    }

    void improve(const std::vector<char>& stands_out) {
        const auto count = static_cast<std::int64_t>(particles_.size());
        for (int k = 0; k < 2; ++k) {
            Side& side = sides_[k];
            if (!side.unequal) continue;
            for (std::int64_t j = 0; j < count; ++j) {
                const double over = side.found[j] / side.aim;
                // By more than the bound came to, which gets there in fewer rounds.
                if (stands_out[particles_[j]] && over > 1.0) side.weights[j] *= over * root(over);
            }
            side.blocks = side.still;
            for (const Shared& e : elements_) {
                double total = 0.0;
                for (int i = 0; i < e.corners; ++i) total += e.bound[i].norm * side.weights[e.at[i]];
                total /= e.total;
                for (int i = 0; i < e.corners; ++i)
                    add_times(side.blocks, count, e.at[i], total / side.weights[e.at[i]], part(e.bound[i], k));
            }
            eigenvalues(side.blocks.data(), count, side.found.data());
            double most = side.aim;
            for (std::int64_t j = 0; j < count; ++j) {
                side.found[j] *= plan_.inverse[particles_[j]];
                most = std::max(most, side.found[j]);
            }
            side.best = std::min(side.best, most);
        }
    }

    const Plan& plan_;
    Side sides_[2];
    /// Where each particle stands among those taken, or -1; and those.
    std::vector<std::int64_t> place_, particles_;
    std::vector<Shared> elements_;
};

/// Add what grippers' joints bound the stiffness [N/m] and damping [N s/m] of each particle by. A grip pulls on one
/// particle only: its point moves as commanded. So its blocks are k I, not 2 k I.
inline void add_grips(const Plan& plan, double* stiff, double* damp) {
    for (std::int64_t grip = 0; grip < plan.held.count(); ++grip) {
        stiff[plan.held.particle[grip]] += plan.held.stiffness[grip];
        damp[plan.held.particle[grip]] += plan.held.damping[grip];
    }
}

/// What hinges come to by themselves at x, and springs across, with what the caller's own forces have in `blocks` (12, n)
/// in any direction; the blocks of all of them are added to those.
inline Rates hinge_rates(const Plan& plan, const double* x, double* blocks) {
    const std::int64_t n = plan.count;
    Array<double> own(12 * n, 0.0), across(n), k(n), c(n);
    for (std::int64_t i = 0; i < n; ++i) across[i] = blocks[i] + blocks[n + i] + blocks[2 * n + i];
    if (plan.grid) add_grid_bounds(*plan.grid, plan.tables, x, blocks, blocks + 6 * n, across.data());
    for (const List& list : plan.lists) {
        double* const to = list.slow ? own.data() : blocks;
        add_list_bounds(list, x, n, to, to + 6 * n, list.slow ? nullptr : across.data());
    }
    for (std::int64_t i = 0; i < 12 * n; ++i) blocks[i] += own[i];
    eigenvalues(own.data(), n, k.data());
    eigenvalues(own.data() + 6 * n, n, c.data());
    for (std::int64_t i = 0; i < n; ++i) {
        k[i] *= plan.inverse[i];
        c[i] *= plan.inverse[i];
        across[i] *= plan.inverse[i];
    }
    const Rates bent = Sharpened(plan, x, own, k, c, true).rates();
    Rates r{};
    r.hinges2 = bent.omega2;
    r.hinge_damping = bent.damping;
    r.across2 = largest_or_nan(across.data(), n);
    return r;
}

/// Bounds of the squared highest frequency [1/s^2] and the highest damping rate [1/s], contact aside. `stiff` [N/m] and
/// `damp` [N s/m], (6, n) or null, hold the blocks of the caller's own forces. Those of hinges alone are told if wanted.
inline Rates rates_of(Plan& plan, const double* x, const double* stiff, const double* damp, bool hinges) {
    const std::int64_t n = plan.count;
    Array<double> k(n), c(n, 0.0), blocks;
    Rates rates{};
    plan.place_lists();
    const bool airy = plan.air >= 0;
    if (plan.lists.size() == (airy ? 1 : 0) && plan.grid && !stiff) {
        // Single precision takes half the time. Its rounding is far below the safety margin of a step.
        const Grid& grid = *plan.grid;
        GridBounds<float> bounds(grid, plan.grid_tables<float>(), x, airy ? &plan.cell_table<float>() : nullptr,
                                 airy ? plan.cells_air() : nullptr);
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            bounds.take_row(row);
            for (std::int64_t j = 0; j < grid.columns; j += lanes<float>) {
                Sym3<vec<float>> stiffness, damping;
                bounds.of(row, j, stiffness, damping);
                const vec<float> a = largest_eigenvalue(stiffness);
                const vec<float> b = bounds.damped ? largest_eigenvalue(damping) : vec<float>{};
                const std::int64_t most = std::min<std::int64_t>(lanes<float>, grid.columns - j);
                for (std::int64_t lane = 0; lane < most; ++lane) {
                    k[row * grid.columns + j + lane] = bounds.unit_stiffness * static_cast<double>(a[lane]);
                    c[row * grid.columns + j + lane] = bounds.unit_damping * static_cast<double>(b[lane]);
                }
            }
        }
        add_grips(plan, k.data(), c.data());
    } else {
        blocks.assign(12 * n, 0.0);
        if (stiff) std::copy(stiff, stiff + 6 * n, blocks.begin());
        if (damp) std::copy(damp, damp + 6 * n, blocks.begin() + 6 * n);
        if (hinges && plan.bends())
            rates = hinge_rates(plan, x, blocks.data());
        else
            add_bounds(plan, x, blocks.data(), blocks.data() + 6 * n);
        for (int axis = 0; axis < 3; ++axis) add_grips(plan, &blocks[axis * n], &blocks[(6 + axis) * n]);
        eigenvalues(blocks.data(), n, k.data());
        eigenvalues(blocks.data() + 6 * n, n, c.data());
    }
    bool free = false;
    for (std::int64_t i = 0; i < n; ++i) {
        k[i] *= plan.inverse[i];
        c[i] *= plan.inverse[i];
        free = free || plan.inverse[i] > 0.0;
    }
    const Rates all = blocks.empty() ? Rates{largest_or_nan(k.data(), n), largest_or_nan(c.data(), n)}
                                     : Sharpened(plan, x, blocks, k, c, false).rates();
    rates.omega2 = all.omega2;
    rates.damping = all.damping + (free ? plan.drag : 0.0);
    return rates;
}

}  // namespace cloth
