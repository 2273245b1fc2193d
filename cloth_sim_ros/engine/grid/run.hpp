// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs of a regular sheet. The sheet is cut into bands of rows. Each band holds copies of its neighbours' nearest rows
// and advances them too, so that bands exchange data once in several steps. These steps run in one sweep, each two rows
// behind the one before, while the rows are in the cache. No bit depends on bands or sweeps.
#pragma once

#include "core/thread_pool.hpp"
#include "grid/air.hpp"
#include "grid/curvature.hpp"
#include "grid/dispatch.hpp"
#include "grid/hinges.hpp"
#include "plan/off_grid_forces.hpp"

namespace cloth::grid {

using plan::OffGridForces, plan::Run, plan::RunStatus;

template <class T>
class GridRun {
public:
    GridRun(Plan& plan, const Run& run)
        : plan_(plan), run_(run), grid_(*plan.grid), tables_(plan.grid_tables<T>()), off_grid_(plan, run),
          hinges_(plan.row_tables<T>()), cells_(plan.cell_table<T>()), mass_cells_(plan.mass_table<T>()),
          curvature_(plan.curvature_table<T>()), carries_air_(plan.has_added_mass()), mode_(plan.mode()),
          state_(plan.workspace<T>(run.workspace).state), force_rows_(plan.workspace<T>(run.workspace).force_rows),
          messages_(plan.workspace<T>(run.workspace).messages),
          middle_(plan.workspace<T>(run.workspace).middle_velocities), pitch_(tables_.pitch),
          length_(row_length<T>(grid_.columns)), stride_(components<T> * pitch_) {
        const bool has_off_grid = off_grid_.needed();
        const std::int64_t max_bands = std::max<std::int64_t>(1, grid_.rows / row_reach);
        bands_ =
            off_grid_.is_single_threaded() ? 1 : static_cast<int>(std::clamp<std::int64_t>(run.bands, 1, max_bands));
        off_grid_.prepare_poses(bands_);
        off_grid_.init_contact_by_rows(bands_, pitch_);
        // An anchor moves once a step with its particle, so copies of rows would need copies of anchors. Jaws move once
        // a step by the forces of all rows.
        synchronize_all_ = !plan.contacts.parallel_jaws.empty();
        levels_ =
            has_off_grid || synchronize_all_ || (off_grid_.contact && plan.contacts.has_friction()) ? 1 : levels();
        halo_ = row_reach * levels_;
        for (int b = 0; b <= bands_; ++b) border_.push_back(grid_.rows * b / bands_);
        if (has_off_grid) {
            std::vector<std::int64_t> particles;
            particles.reserve(border_.size());
            for (std::int64_t row : border_) particles.push_back(row * grid_.columns);
            off_grid_.allocate(particles);
        }
        state_.resize(std::max<std::size_t>(bands_, state_.size()));
        force_rows_.resize(state_.size());
        for (int b = 0; b < bands_; ++b) {
            state_[b].resize((border_[b + 1] - border_[b] + 2 * halo_ + row_reach) * stride_ + 64 / sizeof(T));
            force_rows_[b].resize(levels_ * numbers_of_level() + 64 / sizeof(T));
        }
        messages_.resize(std::max<std::size_t>((bands_ - 1) * 4, messages_.size()));
        for (auto& message : messages_) message.resize(halo_ * stride_);
        counters_ = std::vector<Counter>(bands_);
        if (run.motion) run.motion->start<T>(plan.count, run.steps, run.step, bands_, run.x0, run.v0, {});
        middle_.resize(run.activity ? 3 * pitch_ * grid_.rows : 0);
        if (run.activity) differences_.assign(bands_, plan::HalfDifference(run));
        step_row_ = select_row_step<T>(grid_.shape(), mode_, carries_air_);
        constants_ = grid_constants<T>(plan);
    }

    RunStatus execute() {
        const std::int64_t rounds = 1 + (run_.steps + levels_ - 1) / levels_;
        const RunStatus done = off_grid_.needed() ? run_with_barrier(rounds) : run_with_neighbors(rounds);
        for (int b = 0; (off_grid_.self || off_grid_.features) && b < bands_; ++b) export_rows(b);
        // Runs that record powers have one thread.
        if (run_.power_integrals) {
            run_.power_integrals[0] += run_.step * powers_.sum(powers_.dissipation);
            run_.power_integrals[1] += run_.step * powers_.sum(powers_.external);
        }
        if (run_.activity) {
            plan::HalfDifference difference(run_);
            for (const plan::HalfDifference& part : differences_) difference.add(part);
            difference.store(run_.activity);
        }
        if (done == RunStatus::ok) off_grid_.finish();
        return done;
    }

private:
    struct alignas(128) Counter {
        std::atomic<std::int64_t> rounds{0};
        Counter() = default;
        Counter(const Counter&) {}
    };

    /// Steps per sweep: more if a band exceeds the second-level cache, or if bands wait for each other.
    int levels() const {
        const std::int64_t rows = grid_.rows / bands_, bytes = rows * stride_ * static_cast<std::int64_t>(sizeof(T));
        const std::int64_t target = bytes > (std::int64_t{3} << 18) ? 4 : std::min(bands_, 2);
        return static_cast<int>(std::max<std::int64_t>(1, std::min(target, rows / (4 * row_reach))));
    }
    /// Sets of three force rows: one for springs, one for hinges, one for quadratic hinges.
    int rings() const { return 1 + (hinges_.empty() ? 0 : 1) + (curvature_.empty() ? 0 : 1); }
    /// Numbers of one step of a sweep: force rows, two rows of cells, and two rows of mass blocks.
    std::int64_t numbers_of_level() const { return rings() * 9 * pitch_ + cell_numbers() + mass_numbers(); }
    std::int64_t cell_numbers() const { return cells_.empty() ? 0 : 2 * air_row_size<T>(pitch_); }
    std::int64_t mass_numbers() const { return carries_air_ ? 2 * block_numbers * pitch_ : 0; }
    T* row_of(int b, std::int64_t row) { return state_[b].data() + (row - border_[b] + halo_) * stride_; }

    /// Sheets without other forces: bands wait for their neighbours only.
    RunStatus run_with_neighbors(std::int64_t rounds) {
        const auto run_bands = [&](int first, int last) {
            for (std::int64_t round = 0; round < rounds; ++round)
                for (int b = first; b < last; ++b) {
                    begin_round(b, round);
                    end_round(b, round, rounds);
                }
        };
        // Cached: the system reads it from a file, which takes as long as a short run.
        static const int cores = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
        const int workers = std::min(bands_, cores);
        ThreadPool::shared().run(
            workers, [&](int w) { run_bands(bands_ * w / workers, bands_ * (w + 1) / workers); },
            [&] { run_bands(0, bands_); });
        return RunStatus::ok;
    }
    /// Listed elements may couple any particles: all threads wait until all positions are known, and again until they
    /// are read.
    RunStatus run_with_barrier(std::int64_t rounds) {
        RunStatus done = RunStatus::ok;
        Barrier barrier(bands_);
        const auto prepare = [&](int b, std::int64_t round) {
            begin_round(b, round);
            if (off_grid_.is_active(round - 1)) export_rows(b);
        };
        ThreadPool::shared().run(
            bands_,
            [&](int b) {
                for (std::int64_t round = 0; round < rounds; ++round) {
                    prepare(b, round);
                    barrier.wait();
                    if (off_grid_.is_active(round - 1)) off_grid_.compute_forces(round - 1, b);
                    barrier.wait();
                    end_round(b, round, rounds);
                }
            },
            [&] {
                for (std::int64_t round = 0; round < rounds && done == RunStatus::ok; ++round) {
                    for (int b = 0; b < bands_; ++b) prepare(b, round);
                    if (off_grid_.is_active(round - 1))
                        for (int b = 0; b < bands_ && done == RunStatus::ok; ++b)
                            done = off_grid_.compute_forces(round - 1, b);
                    for (int b = 0; b < bands_ && done == RunStatus::ok; ++b) end_round(b, round, rounds);
                }
            });
        return done;
    }

    /// A round is the start, or one sweep of `levels` steps. First the band is loaded, or the rows of its neighbours
    /// are received, and the jaws advance: all bands have finished the step before.
    void begin_round(int b, std::int64_t round) {
        if (round == 0) {
            load_band(b);
            return;
        }
        for (int other_band = synchronize_all_ ? 0 : b - 1; other_band <= (synchronize_all_ ? bands_ - 1 : b + 1);
             ++other_band)
            if (other_band >= 0 && other_band < bands_ && other_band != b)
                wait_until([&] { return counters_[other_band].rounds.load(std::memory_order_acquire) >= round; });
        receive_rows(b, round - 1);
        off_grid_.advance_jaws(b, (round - 1) * levels_);
    }
    void end_round(int b, std::int64_t round, std::int64_t rounds) {
        if (round == 0) {
            start(b);
        } else {
            const std::int64_t begin = (round - 1) * levels_;
            sweep(b, begin, std::min<std::int64_t>(levels_, run_.steps - begin));
        }
        if (round + 1 < rounds)
            post_rows(b, round);
        else
            unload_band(b);
        counters_[b].rounds.store(round + 1, std::memory_order_release);
    }

    /// Every number of a band is written, so that previous content makes no difference.
    void load_band(int b) {
        for (std::int64_t row = border_[b]; row < border_[b + 1]; ++row) load_row(b, row, true);
        const std::int64_t size = static_cast<std::int64_t>(state_[b].size());
        T* const begin = state_[b].data();
        std::fill(begin, row_of(b, border_[b]), T(0));
        std::fill(row_of(b, border_[b + 1]), begin + size, T(0));
    }
    void load_row(int b, std::int64_t row, bool full) {
        const std::int64_t n = plan_.count, columns = grid_.columns;
        T* const to = row_of(b, row);
        const auto put = [&](int slot, const double* from, double origin) {
            T* const at = to + slot * pitch_;
            for (std::int64_t j = 0; j < columns; ++j) at[j] = static_cast<T>(from[j] - origin);
            std::fill(at + columns, at + pitch_, T(0));
        };
        for (int c = 0; c < 3; ++c) {
            const double *const x = run_.x0 + c * n + row * columns, *const v = run_.v0 + c * n + row * columns;
            put(position + c, x, off_grid_.origin[c]);
            if constexpr (sizeof(T) == 4) {
                T *const high = to + (position + c) * pitch_, *const low = to + (low_position + c) * pitch_;
                for (std::int64_t j = 0; j < columns; ++j) low[j] = low_part(x[j] - off_grid_.origin[c], high[j]);
                std::fill(low + columns, low + pitch_, T(0));
                T* const low_v = to + (low_velocity + c) * pitch_;
                for (std::int64_t j = 0; full && j < columns; ++j) low_v[j] = low_part(v[j], static_cast<T>(v[j]));
                if (full) std::fill(low_v + columns, low_v + pitch_, T(0));
            }
            put(damping_velocity + c, v, 0.0);
            if (full) put(velocity + c, v, 0.0);
        }
        if (full) std::fill(to + previous_acceleration * pitch_, to + (previous_acceleration + 3) * pitch_, T(0));
    }
    void unload_band(int b) {
        const std::int64_t n = plan_.count, columns = grid_.columns;
        for (std::int64_t row = border_[b]; row < border_[b + 1]; ++row) {
            const T* const from = row_of(b, row);
            for (int c = 0; c < 3; ++c) {
                const std::int64_t at = c * n + row * columns;
                const T *const x = from + (position + c) * pitch_, *const v = from + (velocity + c) * pitch_;
                const T *const low = from + ((sizeof(T) == 4 ? low_position : position) + c) * pitch_,
                               *const low_v = from + ((sizeof(T) == 4 ? low_velocity : velocity) + c) * pitch_;
                const double *const x0 = run_.x0 + at, *const v0 = run_.v0 + at;
                for (std::int64_t j = 0; run_.x && j < columns; ++j)
                    run_.x[at + j] = final_sum<T>(x0[j], off_grid_.origin[c], x[j], low[j]);
                for (std::int64_t j = 0; run_.v && j < columns; ++j)
                    run_.v[at + j] = final_sum<T>(v0[j], 0.0, v[j], low_v[j]);
            }
            for (std::int64_t j = 0; run_.activity && j < columns; ++j)
                if (!off_grid_.has_prescribed() || plan_.free_inverse[row * columns + j] > 0.0)
                    differences_[b].add(row * columns + j, n, middle_.data() + 3 * pitch_ * row + j,
                                        from + velocity * pitch_ + j, pitch_);
        }
    }

    /// The first half step. If forces do not depend on velocities, only positions move.
    void start(int b) {
        if (mode_ == Mode::position_only) {
            const T half = static_cast<T>(0.5 * run_.step);
            for (std::int64_t row = border_[b]; row < border_[b + 1]; ++row) {
                T* const at = row_of(b, row);
                for (std::int64_t j = 0; j < 3 * pitch_; ++j) {
                    const T x = at[j], v = at[velocity * pitch_ + j];
                    if constexpr (sizeof(T) == 8) {
                        at[j] = fma(half, v, x);
                    } else {
                        T& low = at[low_position * pitch_ + j];
                        const T increment = fma(half, v, fma(half, at[low_velocity * pitch_ + j], low));
                        at[j] = x + increment;
                        low = increment - (at[j] - x);
                    }
                }
            }
            return;
        }
        // Rows of other bands are not received yet: the rows above and below are loaded from the start.
        if (bands_ > 1) load_around(b);
        sweep(b, -1, 1);
    }
    void load_around(int b) {
        for (std::int64_t row = border_[b] - row_reach; row < border_[b + 1] + row_reach; ++row)
            if (row >= 0 && row < grid_.rows && (row < border_[b] || row >= border_[b + 1])) load_row(b, row, false);
    }

    /// Steps `begin` to `begin` + `levels` - 1 in one sweep. Next to another band a step also advances the rows that
    /// later steps need, two fewer with each step.
    void sweep(int b, std::int64_t begin, std::int64_t levels) {
        std::fill(force_rows_[b].begin(), force_rows_[b].end(), T(0));
        const std::int64_t margin = row_reach * (levels - 1), first = border_[b], last = border_[b + 1];
        const std::int64_t from = std::max<std::int64_t>(first - margin - row_reach, 0);
        for (std::int64_t front = from; front < std::min(last, grid_.rows) + margin; ++front)
            for (std::int64_t level = 0; level < levels; ++level) {
                const std::int64_t row = front - row_reach * level, halo_rows = margin - row_reach * level;
                const std::int64_t top = std::max<std::int64_t>(first - halo_rows, 0);
                if (row < std::max<std::int64_t>(top - row_reach, 0) || row >= std::min(last + halo_rows, grid_.rows))
                    continue;
                advance_row(b, level, row, row >= top, begin + level);
            }
    }
    void advance_row(int b, std::int64_t level, std::int64_t row, bool owned, std::int64_t step) {
        RowView<T> at;
        T* hinge_rows[3];
        const std::int64_t ring_index = (row - border_[b] + halo_) % 3;
        for (int k = 0; k < 3; ++k) {
            at.row[k] = row_of(b, row + k);
            at.force_rows[k] = force_rows_[b].data() + (3 * level + (ring_index + k) % 3) * 3 * pitch_;
            hinge_rows[k] = at.force_rows[k] + levels_ * 9 * pitch_;
        }
        at.entry = tables_.of(row);
        at.pitch = pitch_;
        at.length = length_;
        T* mass_rows[2]{};
        if (carries_air_) {
            T* const first =
                force_rows_[b].data() + levels_ * (rings() * 9 * pitch_ + cell_numbers()) + level * mass_numbers();
            for (int k = 0; k < 2; ++k) mass_rows[k] = first + ((row & 1) ^ k) * block_numbers * pitch_;
            at.mass = mass_rows[0];
            if (mass_cells_.empty()) std::fill_n(at.mass, block_numbers * pitch_, T(0));
        }
        if (owned) off_grid_.add_row_forces(b, row, step, at, row >= border_[b] && row < border_[b + 1]);
        PowerSums* const powers = run_.power_integrals && step >= 0 ? &powers_ : nullptr;
        if (!hinges_.empty()) add_hinge_row(hinges_, row, at, hinge_rows, owned, powers, off_grid_.multirate);
        if (!curvature_.empty()) {
            T* curvature_rows[3];
            for (int k = 0; k < 3; ++k) curvature_rows[k] = at.force_rows[k] + (rings() - 1) * levels_ * 9 * pitch_;
            add_curvature_row(curvature_, row, at, curvature_rows, owned, powers);
        }
        const T* cells_below = nullptr;
        if (!cells_.empty()) {
            T* const cell_rows =
                force_rows_[b].data() + levels_ * rings() * 9 * pitch_ + 2 * level * air_row_size<T>(pitch_);
            add_air_row(at, cells_.of(row), plan_.cells_air(), cell_rows, row, owned, !mass_cells_.empty(), powers);
            cells_below = air_cells(cell_rows, pitch_, row);
        }
        if (!mass_cells_.empty())
            add_mass_row(at, mass_cells_.cells_of(row), plan_.cells_mass(), cells_below, mass_rows);
        if (owned && carries_air_ && off_grid_.has_prescribed()) off_grid_.hold_row(row, step, at);
        step_row_(at, constants_, motion_of<T>(run_, step), owned);
        if (owned && off_grid_.has_prescribed())
            off_grid_.prescribe_row(b, row, step, at, row >= border_[b] && row < border_[b + 1]);
        if (run_.motion && row >= border_[b] && row < border_[b + 1])
            off_grid_.record_row_motion(b, row, step, row_of(b, row), pitch_);
        if (run_.ends_first_half(step) && row >= border_[b] && row < border_[b + 1]) {
            const T* const from = row_of(b, row) + velocity * pitch_;
            std::copy(from, from + 3 * pitch_, middle_.data() + 3 * pitch_ * row);
        }
    }
    void export_rows(int b) {
        for (std::int64_t row = border_[b]; row < border_[b + 1]; ++row) {
            const T* const from = row_of(b, row);
            off_grid_.import_row(position, row, from + position * pitch_, pitch_);
            off_grid_.import_row(damping_velocity, row, from + damping_velocity * pitch_, pitch_);
        }
    }

    /// Outer rows of a band for its neighbours. Two alternating buffers are enough: a band posts for round n + 2 after
    /// its neighbours have finished round n + 1 and therefore received n.
    Array<T>& message(int border, int direction, std::int64_t round) {
        return messages_[(border * 2 + direction) * 2 + round % 2];
    }
    void post_rows(int b, std::int64_t round) {
        const std::size_t bytes = halo_ * stride_ * sizeof(T);
        if (b > 0) std::memcpy(message(b - 1, 0, round).data(), row_of(b, border_[b]), bytes);
        if (b + 1 < bands_) std::memcpy(message(b, 1, round).data(), row_of(b, border_[b + 1] - halo_), bytes);
    }
    void receive_rows(int b, std::int64_t round) {
        const std::size_t bytes = halo_ * stride_ * sizeof(T);
        if (b > 0) std::memcpy(row_of(b, border_[b] - halo_), message(b - 1, 1, round).data(), bytes);
        if (b + 1 < bands_) std::memcpy(row_of(b, border_[b + 1]), message(b, 0, round).data(), bytes);
    }

    Plan& plan_;
    const Run& run_;
    const Grid& grid_;
    const GridTables<T>& tables_;
    OffGridForces<T> off_grid_;
    const std::vector<RowTable<T>>& hinges_;
    const CellTable<T>&cells_, &mass_cells_;
    const CurvatureTable<T>& curvature_;
    const bool carries_air_;
    PowerSums powers_;
    Mode mode_;
    std::vector<Array<T>>&state_, &force_rows_, &messages_;
    Array<T>& middle_;  ///< velocities in the middle, three parts of a row after another
    std::vector<plan::HalfDifference> differences_;
    std::int64_t pitch_, length_, stride_, halo_ = 0;
    int bands_ = 1, levels_ = 1;
    bool synchronize_all_ = false;  ///< whether all bands wait for each other before each step
    std::vector<std::int64_t> border_;
    std::vector<Counter> counters_;
    StepRow<T> step_row_ = nullptr;
    GridConstants<T> constants_;
};

}  // namespace cloth::grid
