// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs of a regular sheet. It is cut into bands of rows, each with a copy of the rows next to it, which it moves too, so
// that neighbours meet once for several steps; and those steps are taken in one sweep, each two rows behind the one before
// it, so that a row is still in the cache. No bit depends on either.
#pragma once

#include "beside.hpp"
#include "grid_air.hpp"
#include "grid_bends.hpp"
#include "grid_takers.hpp"
#include "threads.hpp"

namespace cloth {

template <class T>
class GridRun {
public:
    GridRun(Plan& plan, const Run& run)
        : plan_(plan), run_(run), grid_(*plan.grid), tables_(plan.grid_tables<T>()), beside_(plan, run),
          bends_(plan.row_tables<T>()), cells_(plan.cell_table<T>()), mode_(plan.mode()), state_(plan.room<T>(run.room).state),
          ring_(plan.room<T>(run.room).ring), boxes_(plan.room<T>(run.room).boxes), pitch_(tables_.pitch),
          length_(row_length<T>(grid_.columns)),
          stride_(components<T> * pitch_) {
        const bool more = beside_.needed();
        const std::int64_t most = std::max<std::int64_t>(1, grid_.rows / reach);
        bands_ = beside_.alone() ? 1 : static_cast<int>(std::clamp<std::int64_t>(run.bands, 1, most));
        beside_.hold(bands_);
        beside_.touch_rows(bands_, pitch_);
        // An anchor moves with its particle, once a step: copies of rows at a border would need copies of theirs. Pads move
        // once a step by what all rows do to them.
        meet_ = !plan.contacts.pinches.empty();
        levels_ = more || meet_ || (beside_.contact && plan.contacts.rough()) ? 1 : levels();
        halo_ = reach * levels_;
        for (int b = 0; b <= bands_; ++b) border_.push_back(grid_.rows * b / bands_);
        if (more) {
            std::vector<std::int64_t> particles;
            for (std::int64_t row : border_) particles.push_back(row * grid_.columns);
            beside_.make(particles);
        }
        state_.resize(std::max<std::size_t>(bands_, state_.size()));
        ring_.resize(state_.size());
        for (int b = 0; b < bands_; ++b) {
            state_[b].resize((border_[b + 1] - border_[b] + 2 * halo_ + reach) * stride_ + 64 / sizeof(T));
            ring_[b].resize(levels_ * numbers_of_level() + 64 / sizeof(T));
        }
        boxes_.resize(std::max<std::size_t>((bands_ - 1) * 4, boxes_.size()));
        for (auto& box : boxes_) box.resize(halo_ * stride_);
        done_ = std::vector<Counter>(bands_);
        take_ = row_taker<T>(grid_.shape(), mode_);
        constants_ = grid_constants<T>(plan);
    }

    Done go() {
        const std::int64_t turns = 1 + (run_.steps + levels_ - 1) / levels_;
        const Done done = beside_.needed() ? go_together(turns) : go_apart(turns);
        for (int b = 0; (beside_.self || beside_.features) && b < bands_; ++b) export_rows(b);
        // One thread works where powers are noted.
        if (run_.powers) {
            run_.powers[0] += run_.step * powers_.sum(powers_.lost);
            run_.powers[1] += run_.step * powers_.sum(powers_.given);
        }
        if (done == Done::well) beside_.finish();
        return done;
    }

private:
    struct alignas(128) Counter {
        std::atomic<std::int64_t> turns{0};
        Counter() = default;
        Counter(const Counter&) {}
    };

    /// Steps of a sweep: more where a band does not fit the second cache, or neighbours wait for each other.
    int levels() const {
        const std::int64_t rows = grid_.rows / bands_, bytes = rows * stride_ * static_cast<std::int64_t>(sizeof(T));
        const std::int64_t wanted = bytes > (std::int64_t{3} << 18) ? 4 : std::min(bands_, 2);
        return static_cast<int>(std::max<std::int64_t>(1, std::min(wanted, rows / (4 * reach))));
    }
    /// Rings of three rows of forces: the springs', and one for what else is taken by rows.
    int rings() const { return bends_.empty() ? 1 : 2; }
    /// Those of one step of a sweep, and what air keeps of two rows of cells.
    std::int64_t numbers_of_level() const {
        return rings() * 9 * pitch_ + (cells_.empty() ? 0 : 2 * air_row_size<T>(pitch_));
    }
    T* row_of(int b, std::int64_t row) { return state_[b].data() + (row - border_[b] + halo_) * stride_; }

    /// Sheets with nothing beside: neighbours alone wait for each other.
    Done go_apart(std::int64_t turns) {
        const auto work = [&](int first, int last) {
            for (std::int64_t turn = 0; turn < turns; ++turn)
                for (int b = first; b < last; ++b) {
                    begin(b, turn);
                    end(b, turn, turns);
                }
        };
        // Asked for once: the system reads it from a file, which takes as long as a short run.
        static const int cores = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
        const int workers = std::min(bands_, cores);
        Pool::shared().run(
            workers, [&](int w) { work(bands_ * w / workers, bands_ * (w + 1) / workers); }, [&] { work(0, bands_); });
        return Done::well;
    }
    /// Listed elements may join any particles: all threads wait until all positions are known, and read.
    Done go_together(std::int64_t turns) {
        Done done = Done::well;
        Barrier barrier(bands_);
        const auto prepare = [&](int b, std::int64_t turn) {
            begin(b, turn);
            if (beside_.acts(turn - 1)) export_rows(b);
        };
        Pool::shared().run(
            bands_,
            [&](int b) {
                for (std::int64_t turn = 0; turn < turns; ++turn) {
                    prepare(b, turn);
                    barrier.wait();
                    if (beside_.acts(turn - 1)) beside_.forces(turn - 1, b);
                    barrier.wait();
                    end(b, turn, turns);
                }
            },
            [&] {
                for (std::int64_t turn = 0; turn < turns && done == Done::well; ++turn) {
                    for (int b = 0; b < bands_; ++b) prepare(b, turn);
                    if (beside_.acts(turn - 1))
                        for (int b = 0; b < bands_ && done == Done::well; ++b) done = beside_.forces(turn - 1, b);
                    for (int b = 0; b < bands_ && done == Done::well; ++b) end(b, turn, turns);
                }
            });
        return done;
    }

    /// A turn is the start, or one sweep of `levels` steps. First the band is loaded, or its neighbours' rows are taken in,
    /// and pads are moved: all bands have been at the step before.
    void begin(int b, std::int64_t turn) {
        if (turn == 0) {
            load_band(b);
            return;
        }
        for (int side = meet_ ? 0 : b - 1; side <= (meet_ ? bands_ - 1 : b + 1); ++side)
            if (side >= 0 && side < bands_ && side != b)
                wait_until([&] { return done_[side].turns.load(std::memory_order_acquire) >= turn; });
        take_in(b, turn - 1);
        beside_.follow(b, (turn - 1) * levels_);
    }
    void end(int b, std::int64_t turn, std::int64_t turns) {
        if (turn == 0) {
            start(b);
        } else {
            const std::int64_t begin = (turn - 1) * levels_;
            sweep(b, begin, std::min<std::int64_t>(levels_, run_.steps - begin));
        }
        if (turn + 1 < turns)
            post(b, turn);
        else
            unload_band(b);
        done_[b].turns.store(turn + 1, std::memory_order_release);
    }

    /// Every number of a band is written, so that what was there before makes no difference.
    void load_band(int b) {
        for (std::int64_t row = border_[b]; row < border_[b + 1]; ++row) load_row(b, row, true);
        const std::int64_t size = static_cast<std::int64_t>(state_[b].size());
        T* const begin = state_[b].data();
        std::fill(begin, row_of(b, border_[b]), T(0));
        std::fill(row_of(b, border_[b + 1]), begin + size, T(0));
    }
    void load_row(int b, std::int64_t row, bool whole) {
        const std::int64_t n = plan_.count, columns = grid_.columns;
        T* const to = row_of(b, row);
        const auto put = [&](int slot, const double* from, double origin) {
            T* const at = to + slot * pitch_;
            for (std::int64_t j = 0; j < columns; ++j) at[j] = static_cast<T>(from[j] - origin);
            std::fill(at + columns, at + pitch_, T(0));
        };
        for (int c = 0; c < 3; ++c) {
            const double *const x = run_.x0 + c * n + row * columns, *const v = run_.v0 + c * n + row * columns;
            put(position + c, x, beside_.origin[c]);
            put(seen + c, v, 0.0);
            if (whole) put(velocity + c, v, 0.0);
        }
        if (whole) std::fill(to + last * pitch_, to + stride_, T(0));
    }
    void unload_band(int b) {
        const std::int64_t n = plan_.count, columns = grid_.columns;
        for (std::int64_t row = border_[b]; row < border_[b + 1]; ++row) {
            const T* const from = row_of(b, row);
            for (int c = 0; c < 3; ++c) {
                const std::int64_t at = c * n + row * columns;
                const T *const x = from + (position + c) * pitch_, *const v = from + (velocity + c) * pitch_;
                const T* const carry = from + (sizeof(T) == 4 ? carried + c : 0) * pitch_;
                const double* const x0 = run_.x0 + at;
                for (std::int64_t j = 0; run_.x && j < columns; ++j)
                    run_.x[at + j] = ended<T>(x0[j], beside_.origin[c], x[j], sizeof(T) == 4 ? carry[j] : T(0));
                const double* const v0 = run_.v0 + at;
                for (std::int64_t j = 0; run_.v && j < columns; ++j) run_.v[at + j] = ended<T>(v0[j], 0.0, v[j], T(0));
            }
        }
    }

    /// The first half step: where no velocity has to be predicted, positions alone move.
    void start(int b) {
        if (mode_ == Mode::still) {
            const T half = static_cast<T>(0.5 * run_.step);
            for (std::int64_t row = border_[b]; row < border_[b + 1]; ++row) {
                T* const at = row_of(b, row);
                for (std::int64_t j = 0; j < 3 * pitch_; ++j) {
                    const T x = at[j], way = half * at[velocity * pitch_ + j], end = x + way;
                    if constexpr (sizeof(T) == 4) at[carried * pitch_ + j] = way - (end - x);
                    at[j] = sizeof(T) == 4 ? end : fma(half, at[velocity * pitch_ + j], x);
                }
            }
            return;
        }
        // Other bands are not known yet: the rows above and below are loaded from where all began.
        if (bands_ > 1) load_around(b);
        sweep(b, -1, 1);
    }
    void load_around(int b) {
        for (std::int64_t row = border_[b] - reach; row < border_[b + 1] + reach; ++row)
            if (row >= 0 && row < grid_.rows && (row < border_[b] || row >= border_[b + 1])) load_row(b, row, false);
    }

    /// Steps `begin` to `begin` + `levels` - 1 in one sweep. Next to a neighbour a step also moves the rows, two fewer with
    /// each step, that later ones will look at.
    void sweep(int b, std::int64_t begin, std::int64_t levels) {
        std::fill(ring_[b].begin(), ring_[b].end(), T(0));
        const std::int64_t margin = reach * (levels - 1), first = border_[b], last = border_[b + 1];
        const std::int64_t from = std::max<std::int64_t>(first - margin - reach, 0);
        for (std::int64_t front = from; front < std::min(last, grid_.rows) + margin; ++front)
            for (std::int64_t level = 0; level < levels; ++level) {
                const std::int64_t row = front - reach * level, here = margin - reach * level;
                const std::int64_t top = std::max<std::int64_t>(first - here, 0);
                if (row < std::max<std::int64_t>(top - reach, 0) || row >= std::min(last + here, grid_.rows)) continue;
                step_row(b, level, row, row >= top, begin + level);
            }
    }
    void step_row(int b, std::int64_t level, std::int64_t row, bool own, std::int64_t step) {
        RowPlace<T> at;
        T* sums[3];
        const std::int64_t turn = (row - border_[b] + halo_) % 3;
        for (int k = 0; k < 3; ++k) {
            at.row[k] = row_of(b, row + k);
            at.ring[k] = ring_[b].data() + (3 * level + (turn + k) % 3) * 3 * pitch_;
            sums[k] = at.ring[k] + levels_ * 9 * pitch_;
        }
        at.entry = tables_.of(row);
        at.pitch = pitch_;
        at.length = length_;
        if (own) beside_.add_row(b, row, step, at, row >= border_[b] && row < border_[b + 1]);
        Powers* const powers = run_.powers && step >= 0 ? &powers_ : nullptr;
        if (!bends_.empty()) take_bends(bends_, row, at, sums, own, powers, beside_.sparse);
        if (!cells_.empty()) {
            T* const kept = ring_[b].data() + levels_ * rings() * 9 * pitch_ + 2 * level * air_row_size<T>(pitch_);
            take_air(at, cells_.of(row), plan_.cells_air(), kept, row, own, powers);
        }
        take_(at, constants_, motion_of<T>(run_, step), own);
    }
    void export_rows(int b) {
        for (std::int64_t row = border_[b]; row < border_[b + 1]; ++row) {
            const T* const from = row_of(b, row);
            beside_.show(position, row, from + position * pitch_, pitch_);
            beside_.show(seen, row, from + seen * pitch_, pitch_);
        }
    }

    /// A band's outer rows for its neighbours. Two boxes in turn are enough: a band posts for turn n + 2 after its
    /// neighbours have done turn n + 1, so have taken in n.
    Array<T>& box(int border, int side, std::int64_t turn) { return boxes_[(border * 2 + side) * 2 + turn % 2]; }
    void post(int b, std::int64_t turn) {
        const std::size_t bytes = halo_ * stride_ * sizeof(T);
        if (b > 0) std::memcpy(box(b - 1, 0, turn).data(), row_of(b, border_[b]), bytes);
        if (b + 1 < bands_) std::memcpy(box(b, 1, turn).data(), row_of(b, border_[b + 1] - halo_), bytes);
    }
    void take_in(int b, std::int64_t turn) {
        const std::size_t bytes = halo_ * stride_ * sizeof(T);
        if (b > 0) std::memcpy(row_of(b, border_[b] - halo_), box(b - 1, 1, turn).data(), bytes);
        if (b + 1 < bands_) std::memcpy(row_of(b, border_[b + 1]), box(b, 0, turn).data(), bytes);
    }

    Plan& plan_;
    const Run& run_;
    const Grid& grid_;
    const Tables<T>& tables_;
    Beside<T> beside_;
    const std::vector<RowTable<T>>& bends_;
    const CellTable<T>& cells_;
    Powers powers_;
    Mode mode_;
    std::vector<Array<T>>&state_, &ring_, &boxes_;
    std::int64_t pitch_, length_, stride_, halo_ = 0;
    int bands_ = 1, levels_ = 1;
    bool meet_ = false;  ///< whether all bands wait for each other before each step
    std::vector<std::int64_t> border_;
    std::vector<Counter> done_;
    TakeRow<T> take_ = nullptr;
    GridConstants<T> constants_;
};

}  // namespace cloth
