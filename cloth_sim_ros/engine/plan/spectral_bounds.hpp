// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Bounds of the squared highest frequency and the highest damping rate of a scene, which limit explicit steps.
// Positions are (3, n).
#pragma once

#include "grid/bounds.hpp"
#include "grid/cell_bounds.hpp"
#include "laws/added_mass.hpp"
#include "mesh/queries.hpp"
#include "plan/plan.hpp"
#include "plan/queries.hpp"

namespace cloth::plan {

using grid::BlockRow, grid::GridBounds, grid::largest_eigenvalue, grid::PaddedRows, laws::Bound, mesh::ElementState;

/// Largest number of an array, or NaN if it contains one.
inline double largest_or_nan(const double* numbers, std::int64_t count) {
    double max = 0.0;
    bool has_nan = false;
    for (std::int64_t i = 0; i < count; ++i) {
        max = numbers[i] > max ? numbers[i] : max;
        has_nan = has_nan || !(numbers[i] == numbers[i]);
    }
    return has_nan ? __builtin_nan("") : max;
}

/// Store the stiffness that each quadratic hinge of `curvature_list` adds to its particles, in the list's order.
inline void make_curvature_terms(Plan& plan) {
    const List& list = plan.lists[plan.curvature_list];
    std::vector<std::vector<double>> terms(plan.count);
    for (std::int64_t e = 0; e < list.count; ++e) {
        const double* const numbers = list.params.data() + e * list.numbers;
        const auto params = laws::law_params<laws::QuadraticHinge, double>(numbers, list.common);
        const Vec3<double> anywhere[3]{};
        Bound<double> bounds[4];
        laws::QuadraticHinge::bounds(params, anywhere, bounds);
        for (int c = 0; c < 4; ++c) terms[list.corners[e * list.width + c]].push_back(bounds[c].stiff.xx);
    }
    plan.curvature_terms = CurvatureBounds(*plan.grid, list.common[0], terms);
}

/// Bounds of the lists that rows evaluate as `add_list_bounds` does: panels, added mass and quadratic hinges.
class RowBounds {
public:
    RowBounds(Plan& plan, const PaddedRows<double>& positions) : plan_(plan) {
        if (plan.air_in_order) air_.emplace(*plan.grid, plan.cell_table<double>(), plan.cells_air(), positions);
        if (plan.mass_in_order) mass_.emplace(*plan.grid, plan.mass_table<double>(), plan.cells_mass(), positions);
        if (plan.curvature_list >= 0 && plan.curvature_terms.empty()) make_curvature_terms(plan);
    }
    static bool covers(const Plan& plan, std::size_t list) {
        const auto k = static_cast<std::int64_t>(list);
        return k == plan.curvature_list || (k == plan.air_list && plan.air_in_order) ||
               (k == plan.mass_list && plan.mass_in_order);
    }
    /// Add the bounds of a list. Rows have to be processed in order from the first.
    void add_row(std::size_t list, std::int64_t row, BlockRow& to) {
        const auto k = static_cast<std::int64_t>(list);
        if (k == plan_.air_list) air_->add_row(row, to);
        // Air at rest adds no bound.
        if (k == plan_.mass_list && plan_.lists[k].has_wind()) mass_->add_row(row, to);
        if (k == plan_.curvature_list) plan_.curvature_terms.add_row(row, to);
    }

private:
    Plan& plan_;
    std::optional<grid::CellBounds<laws::Panel<4>>> air_;
    std::optional<grid::CellBounds<laws::AddedMass<4>>> mass_;
};

/// Add the blocks of all parts to stiff and damp, each (6, n) or null.
void add_bounds(const Plan& plan, const double* x, double* stiff, double* damp) {
    if (plan.grid) add_grid_bounds(*plan.grid, plan.tables, x, stiff, damp);
    for (const List& list : plan.lists) add_list_bounds(list, x, plan.count, stiff, damp);
}

/// Bounds of a sheet all of whose lists `RowBounds` covers, for each particle: those of `add_bounds` and `eigenvalues`,
/// bit for bit.
inline void bounds_by_rows(Plan& plan, const double* x, double* stiff, double* damp) {
    using V = vec<double>;
    const Grid& grid = *plan.grid;
    GridBounds<double> springs(grid, plan.tables, x);
    RowBounds lists(plan, springs.positions());
    BlockRow blocks(grid);
    for (std::int64_t row = 0; row < grid.rows; ++row) {
        const std::int64_t first = row * grid.columns;
        springs.process_row(row);
        for (std::int64_t j = 0; j < grid.columns; j += lanes<double>) {
            Sym3<V> k, c;
            springs.of(row, j, k, c);
            const V parts[12] = {k.xx, k.yy, k.zz, k.xy, k.xz, k.yz, c.xx, c.yy, c.zz, c.xy, c.xz, c.yz};
            for (int part = 0; part < 12; ++part) store(blocks.stiff(part) + j, parts[part]);
        }
        for (std::size_t list = 0; list < plan.lists.size(); ++list) lists.add_row(list, row, blocks);
        for (std::int64_t grip = 0; grip < plan.grips.count(); ++grip) {
            const std::int64_t j = plan.grips.particle[grip] - first;
            for (int axis = 0; j >= 0 && j < grid.columns && axis < 3; ++axis) {
                blocks.stiff(axis)[j] += plan.grips.stiffness[grip];
                blocks.damp(axis)[j] += plan.grips.damping[grip];
            }
        }
        for (std::int64_t j = 0; j < grid.columns; j += lanes<double>) {
            const auto largest = [&](double* from, double* to) {
                const auto at = [&](int c) { return load(from + c * blocks.pitch + j); };
                const V value = largest_eigenvalue(Sym3<V>{at(0), at(1), at(2), at(3), at(4), at(5)});
                const std::int64_t n_lanes = std::min<std::int64_t>(lanes<double>, grid.columns - j);
                std::memcpy(to + first + j, &value, n_lanes * sizeof(double));
            };
            largest(blocks.stiff(0), stiff), largest(blocks.damp(0), damp);
        }
    }
}

void eigenvalues(const double* blocks, std::int64_t n, double* to) {
    for (std::int64_t i = 0; i < n; i += lanes<double>) {
        Array<double> tail(6 * lanes<double>, 0.0);
        const bool whole = i + lanes<double> <= n;
        if (!whole)
            for (int c = 0; c < 6; ++c)
                for (std::int64_t k = i; k < n; ++k) tail[c * lanes<double> + k - i] = blocks[c * n + k];
        const auto at = [&](int c) { return whole ? load(blocks + c * n + i) : load(tail.data() + c * lanes<double>); };
        const vec<double> largest = largest_eigenvalue(Sym3<vec<double>>{at(0), at(1), at(2), at(3), at(4), at(5)});
        if (whole)
            store(to + i, largest);
        else
            for (std::int64_t k = i; k < n; ++k) to[k] = largest[k - i];
    }
}

/// Refined bounds if few particles are outliers, such as the light ones of an irregular mesh. The square of an
/// element's sum over its corners may be distributed by any positive weights of the particles (laws/bound.hpp). An
/// outlier gets a larger weight, so its neighbours carry more of the common elements. Perron's iteration finds the best
/// weights of a non-negative matrix: multiply each by the ratio of its bound to the target. The bound of each round is
/// valid, and the lowest is used.
class PerronBound {
public:
    /// `blocks` makes the blocks (12, n) of all parts with equal weights; the resulting stiffness and damping of each
    /// particle; or of hinges alone.
    template <class F>
    PerronBound(const Plan& plan, const double* x, F&& blocks, const Array<double>& k, const Array<double>& c,
                bool hinges)
        : plan_(plan), quantities_{Quantity(k), Quantity(c)} {
        if (!quantities_[0].has_outliers && !quantities_[1].has_outliers) return;
        index_.assign(plan.count, -1);
        std::vector<char> is_outlier(plan.count, 0);
        for (const Quantity& quantity : quantities_)
            for (std::int64_t i = 0; quantity.has_outliers && i < plan.count; ++i)
                is_outlier[i] |= quantity.rows[i] > quantity.typical;
        // The rows of outliers have to decrease.
        for (std::int64_t i = 0; i < plan.count; ++i)
            if (is_outlier[i]) index_of(i);
        for (const List& list : plan.lists)
            if (list.slow || !hinges)
                with_law(list.kind, [&](auto law) { collect<decltype(law)>(list, x, is_outlier); });
        gather(blocks());
        for (int round = 0; round < rounds; ++round) refine_weights(is_outlier);
    }
    SpectralBounds result() const { return {quantities_[0].best, quantities_[1].best}; }

private:
    static constexpr int rounds = 3;
    /// Fractions of the largest row: the target, because equal weights are off by two at most for pairs; the threshold
    /// for a weight; and the limit of the other rows for which the refinement is worth its cost.
    static constexpr double target_fraction = 0.5, weight_fraction = 0.4, work_fraction = 0.7;
    /// One in this many particles may get a weight, but at least this many.
    static constexpr std::int64_t particles_per_weight = 16;

    /// Stiffness or damping.
    struct Quantity {
        explicit Quantity(const Array<double>& rows) : rows(rows), best(largest_or_nan(rows.data(), rows.size())) {
            const auto count = static_cast<std::int64_t>(rows.size()),
                       n_weights = std::max(count / particles_per_weight, particles_per_weight);
            if (!(best > 0.0)) return;
            std::int64_t n_large = 0;
            for (const double row : rows) n_large += row >= work_fraction * best;
            has_outliers = n_weights >= count || n_large <= n_weights;
            if (!has_outliers) return;
            if (n_weights < count) {
                Array<double> sorted = rows;
                std::nth_element(sorted.begin(), sorted.begin() + n_weights, sorted.end(), std::greater<>());
                typical = sorted[n_weights];
            }
            typical = std::max(typical, weight_fraction * best);
            target = std::max(target_fraction * best, typical);
        }
        /// Row of each particle with equal weights, the largest of those without a weight, and the bound.
        const Array<double>& rows;
        double typical = 0.0, best, target = 0.0;
        bool has_outliers = false;
        /// Weights of the collected particles, blocks independent of the weights, and all blocks.
        Array<double> weights, fixed, blocks, current;
    };
    struct SharedElement {
        int corners;
        std::int64_t at[4];
        Bound<double> bound[4];
        double total;
    };

    /// Collect the elements with an outlier as a corner, and their particles.
    template <class Law>
    void collect(const List& list, const double* x, const std::vector<char>& is_outlier) {
        for (std::int64_t e = 0; e < list.count; ++e) {
            const std::int64_t* const p = list.corners.data() + e * list.width;
            bool any = false;
            for (int i = 0; i < Law::corners; ++i) any = any || is_outlier[p[i]];
            if (!any) continue;
            const ElementState<Law> s(list, e, x, nullptr, plan_.count);
            if constexpr (requires { Law::squares; }) {
                for (int square = 0; square < Law::squares; ++square)
                    collect<Law>(p, [&](Bound<double>* bound) { Law::square(s.params, s.d, square, bound); });
            } else {
                collect<Law>(p, [&](Bound<double>* bound) { Law::bounds(s.params, s.d, bound); });
            }
        }
    }
    /// Collect an element, or one of its squares, whose bounds `bounds` writes.
    template <class Law, class F>
    void collect(const std::int64_t* corners, F&& bounds) {
        SharedElement element{Law::corners, {}, {}, 0.0};
        bounds(element.bound);
        for (int i = 0; i < Law::corners; ++i) element.total += element.bound[i].norm;
        if (!(element.total > 0.0)) return;
        for (int i = 0; i < Law::corners; ++i) element.at[i] = index_of(corners[i]);
        elements_.push_back(element);
    }
    /// Index of a particle among the collected ones.
    std::int64_t index_of(std::int64_t i) {
        if (index_[i] < 0) {
            index_[i] = static_cast<std::int64_t>(particles_.size());
            particles_.push_back(i);
        }
        return index_[i];
    }
    static const Sym3<double>& block_of(const Bound<double>& bound, int quantity) {
        return quantity ? bound.damp : bound.stiff;
    }

    void gather(const Array<double>& blocks) {
        const auto count = static_cast<std::int64_t>(particles_.size());
        for (int k = 0; k < 2; ++k) {
            Quantity& quantity = quantities_[k];
            quantity.weights.assign(count, 1.0);
            quantity.fixed.resize(6 * count);
            quantity.current.resize(count);
            for (std::int64_t j = 0; j < count; ++j) {
                quantity.current[j] = quantity.rows[particles_[j]];
                for (int row = 0; row < 6; ++row)
                    quantity.fixed[row * count + j] = blocks[(6 * k + row) * plan_.count + particles_[j]];
            }
            for (const SharedElement& e : elements_)
                for (int i = 0; i < e.corners; ++i)
                    add_scaled(quantity.fixed, count, e.at[i], -1.0, block_of(e.bound[i], k));
        }
    }
    static void add_scaled(Array<double>& blocks, std::int64_t n, std::int64_t i, double by, const Sym3<double>& b) {
        add_block(blocks.data(), n, i, {by * b.xx, by * b.yy, by * b.zz, by * b.xy, by * b.xz, by * b.yz});
    }

    void refine_weights(const std::vector<char>& is_outlier) {
        const auto count = static_cast<std::int64_t>(particles_.size());
        for (int k = 0; k < 2; ++k) {
            Quantity& quantity = quantities_[k];
            if (!quantity.has_outliers) continue;
            for (std::int64_t j = 0; j < count; ++j) {
                const double ratio = quantity.current[j] / quantity.target;
                // By more than the ratio, which needs fewer rounds.
                if (is_outlier[particles_[j]] && ratio > 1.0) quantity.weights[j] *= ratio * root(ratio);
            }
            quantity.blocks = quantity.fixed;
            for (const SharedElement& e : elements_) {
                double total = 0.0;
                for (int i = 0; i < e.corners; ++i) total += e.bound[i].norm * quantity.weights[e.at[i]];
                total /= e.total;
                for (int i = 0; i < e.corners; ++i)
                    add_scaled(quantity.blocks, count, e.at[i], total / quantity.weights[e.at[i]],
                               block_of(e.bound[i], k));
            }
            eigenvalues(quantity.blocks.data(), count, quantity.current.data());
            double bound = quantity.target;
            for (std::int64_t j = 0; j < count; ++j) {
                quantity.current[j] *= plan_.free_inverse[particles_[j]];
                bound = std::max(bound, quantity.current[j]);
            }
            quantity.best = std::min(quantity.best, bound);
        }
    }

    const Plan& plan_;
    Quantity quantities_[2];
    /// Index of each particle among the collected ones, or -1; and those.
    std::vector<std::int64_t> index_, particles_;
    std::vector<SharedElement> elements_;
};

/// Add the bounds of the grippers' joints to the stiffness [N/m] and damping [N s/m] of each particle. A grip acts on
/// one particle, because its point is prescribed. Therefore its blocks are k I, not 2 k I.
inline void add_grips(const Plan& plan, double* stiff, double* damp) {
    for (std::int64_t grip = 0; grip < plan.grips.count(); ++grip) {
        stiff[plan.grips.particle[grip]] += plan.grips.stiffness[grip];
        damp[plan.grips.particle[grip]] += plan.grips.damping[grip];
    }
}

/// Bounds of hinges alone at x, and of transverse springs, with the isotropic part of `blocks` (12, n) of forces in
/// Python. The blocks of all parts are added to `blocks`.
inline SpectralBounds hinge_bounds(const Plan& plan, const double* x, double* blocks) {
    const std::int64_t n = plan.count;
    Array<double> hinge_blocks(12 * n, 0.0), transverse(n), k(n), c(n);
    for (std::int64_t i = 0; i < n; ++i) transverse[i] = blocks[i] + blocks[n + i] + blocks[2 * n + i];
    if (plan.grid) add_grid_bounds(*plan.grid, plan.tables, x, blocks, blocks + 6 * n, transverse.data());
    for (const List& list : plan.lists) {
        double* const to = list.slow ? hinge_blocks.data() : blocks;
        add_list_bounds(list, x, n, to, to + 6 * n, list.slow ? nullptr : transverse.data());
    }
    for (std::int64_t i = 0; i < 12 * n; ++i) blocks[i] += hinge_blocks[i];
    eigenvalues(hinge_blocks.data(), n, k.data());
    eigenvalues(hinge_blocks.data() + 6 * n, n, c.data());
    for (std::int64_t i = 0; i < n; ++i) {
        k[i] *= plan.free_inverse[i];
        c[i] *= plan.free_inverse[i];
        transverse[i] *= plan.free_inverse[i];
    }
    const SpectralBounds hinges =
        PerronBound(plan, x, [&]() -> const Array<double>& { return hinge_blocks; }, k, c, true).result();
    SpectralBounds r{};
    r.hinge_omega2 = hinges.omega2;
    r.hinge_damping = hinges.damping;
    r.transverse_omega2 = largest_or_nan(transverse.data(), n);
    return r;
}

/// Add the bounds of quadratic hinges evaluated by rows, which do not depend on positions and are multiples of I.
inline void add_curvature_bounds(Plan& plan, const double* x, double* stiff, double* damp) {
    const List& list = plan.lists[plan.curvature_list];
    if (plan.curvature_bounds.empty()) {
        Array<double> blocks(6 * plan.count, 0.0);
        add_list_bounds(list, x, plan.count, blocks.data(), nullptr);
        plan.curvature_bounds.assign(blocks.begin(), blocks.begin() + plan.count);
    }
    for (std::int64_t i = 0; i < plan.count; ++i) {
        stiff[i] += plan.curvature_bounds[i];
        damp[i] = fma(list.common[0], plan.curvature_bounds[i], damp[i]);
    }
}

SpectralBounds spectral_bounds(Plan& plan, const double* x, const double* stiff, const double* damp, bool hinges) {
    const std::int64_t n = plan.count;
    Array<double> k(n), c(n, 0.0), blocks;
    SpectralBounds result{};
    plan.assign_lists();
    bool by_rows = true, refines = false;
    for (std::size_t list = 0; list < plan.lists.size(); ++list) by_rows = by_rows && RowBounds::covers(plan, list);
    const auto make_blocks = [&]() -> const Array<double>& {
        if (!blocks.empty()) return blocks;
        blocks.assign(12 * n, 0.0);
        if (stiff) std::copy(stiff, stiff + 6 * n, blocks.begin());
        if (damp) std::copy(damp, damp + 6 * n, blocks.begin() + 6 * n);
        if (hinges && plan.has_hinges())
            result = hinge_bounds(plan, x, blocks.data());
        else
            add_bounds(plan, x, blocks.data(), blocks.data() + 6 * n);
        for (int axis = 0; axis < 3; ++axis) add_grips(plan, &blocks[axis * n], &blocks[(6 + axis) * n]);
        return blocks;
    };
    const bool has_panels = plan.air_list >= 0;
    // Air at rest adds no bound.
    const bool has_mass = plan.mass_list >= 0 && !plan.lists[plan.mass_list].has_wind();
    const bool has_curvature = plan.curvature_list >= 0;
    if (plan.lists.size() == std::size_t{has_panels} + std::size_t{has_mass} + std::size_t{has_curvature} &&
        plan.grid && !stiff) {
        // Single precision halves the time. Its rounding is far below the safety margin of a step.
        const Grid& grid = *plan.grid;
        GridBounds<float> bounds(grid, plan.grid_tables<float>(), x, has_panels ? &plan.cell_table<float>() : nullptr,
                                 has_panels ? plan.cells_air() : nullptr);
        for (std::int64_t row = 0; row < grid.rows; ++row) {
            bounds.process_row(row);
            for (std::int64_t j = 0; j < grid.columns; j += lanes<float>) {
                Sym3<vec<float>> stiffness, damping;
                bounds.of(row, j, stiffness, damping);
                const vec<float> a = largest_eigenvalue(stiffness);
                const vec<float> b = bounds.damped ? largest_eigenvalue(damping) : vec<float>{};
                const std::int64_t n_lanes = std::min<std::int64_t>(lanes<float>, grid.columns - j);
                for (std::int64_t lane = 0; lane < n_lanes; ++lane) {
                    k[row * grid.columns + j + lane] = bounds.unit_stiffness * static_cast<double>(a[lane]);
                    c[row * grid.columns + j + lane] = bounds.unit_damping * static_cast<double>(b[lane]);
                }
            }
        }
        if (has_curvature) add_curvature_bounds(plan, x, k.data(), c.data());
        add_grips(plan, k.data(), c.data());
    } else if (plan.grid && by_rows && !stiff && !damp) {
        bounds_by_rows(plan, x, k.data(), c.data());
        refines = true;
    } else {
        make_blocks();
        refines = true;
        eigenvalues(blocks.data(), n, k.data());
        eigenvalues(blocks.data() + 6 * n, n, c.data());
    }
    bool free = false;
    for (std::int64_t i = 0; i < n; ++i) {
        k[i] *= plan.free_inverse[i];
        c[i] *= plan.free_inverse[i];
        free = free || plan.free_inverse[i] > 0.0;
    }
    const SpectralBounds all = refines ? PerronBound(plan, x, make_blocks, k, c, false).result()
                                       : SpectralBounds{largest_or_nan(k.data(), n), largest_or_nan(c.data(), n)};
    result.omega2 = all.omega2;
    result.damping = all.damping + (free ? plan.drag : 0.0);
    return result;
}

}  // namespace cloth::plan
