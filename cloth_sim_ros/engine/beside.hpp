// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What acts in a run beside a sheet's own springs: listed elements, forces of the caller's own, grippers.
#pragma once

#include <limits>

#include "contact_feature_run.hpp"
#include "contact_run.hpp"
#include "list_forces.hpp"
#include "self_run.hpp"

namespace cloth {

/// Powers that a sheet's damping and drag take and that wind gives at x and v, (3, n); lists and joints of grippers aside.
void other_powers(const Plan& plan, const double* x, const double* v, double& lost, double& given);

/// What a run keeps of it between its steps.
template <class T>
struct Beside {
    Plan& plan;
    const Run& run;
    const bool sparse;  ///< whether hinges are asked for less often
    const bool lists;   ///< whether there are any that no rows take
    const bool fast;    ///< whether any of them are others than hinges
    double origin[3] = {};
    Array<T>&x, &v;                  ///< positions and velocities that damping sees, a quad a particle
    std::vector<Share<T>>* shares = nullptr;  ///< with the forces
    std::vector<double> ox, ov, of;  ///< the same for the caller, (3, n)
    std::vector<Poses> poses;        ///< of each thread
    std::vector<double> grips;       ///< (grips, booked_numbers)
    std::vector<T> quarters;         ///< what hinges' forces are multiplied by for a quarter of an impulse over mass
    std::optional<ContactRun<T>> contact;
    std::optional<SelfRun> self;
    std::optional<FeatureRun> features;

    Beside(Plan& plan, const Run& run)
        : plan(plan), run(run), sparse(run.every > 1 && plan.bends()), lists(sparse || plan.lists_beside()),
          fast(plan.springs_beside()), x(plan.room<T>(run.room).quads[0]), v(plan.room<T>(run.room).quads[1]) {
        if constexpr (sizeof(T) == 4)
            for (int c = 0; c < 3; ++c) origin[c] = run.x0[c * plan.count];
        grips.assign(plan.held.count() * booked_numbers, 0.0);
        if constexpr (sizeof(T) == 8) {
            if (plan.self_acts()) {
                self.emplace(*plan.self, plan.contacts.thickness, plan.contacts.damping, run.step);
                if (plan.self->rubs()) self->rub(plan.contacts.frequency, plan.layer_anchors());
                if (plan.contacts.reduced.any()) self->reduce(plan, run);
            }
            if (plan.features_act()) features.emplace(*plan.features, plan.contacts, run);
        }
    }
    bool needed() const { return lists || alone(); }
    /// Whether any of that acts in a step, or asks where particles are.
    bool acts(std::int64_t step) const {
        return needed() && (!sparse || run.bends(step) || fast || self || features || whole());
    }
    /// Whether something asks for all positions at once, by component.
    bool whole() const { return plan.callback || run.powers; }
    /// Whether one thread works.
    bool alone() const { return whole() || plan.surface_acts(); }
    /// Whether any obstacle is near enough to be met, or pads move.
    bool near() const { return !plan.contacts.active.empty() || !plan.contacts.pinches.empty(); }
    void hold(int threads) {
        for (int k = 0; plan.held.count() && k < threads; ++k) poses.emplace_back(plan.held.paths, run.t, run.step);
    }
    /// Contact of a sheet's rows, of so many numbers each, and of particles by their rank.
    void touch_rows(int threads, std::int64_t pitch) {
        const std::int64_t columns = plan.grid->columns;
        const auto place_of = [&](std::int64_t i) { return i / columns * pitch + i % columns; };
        touch(threads, plan.grid->rows, pitch, place_of);
    }
    void touch_ranks(int threads) {
        const std::int64_t blocks = (plan.count + contact_block - 1) / contact_block;
        const auto place_of = [&](std::int64_t i) { return plan.rank[i]; };
        touch(threads, blocks, contact_block, place_of);
    }
    template <class F>
    void touch(int threads, std::int64_t blocks, std::int64_t pitch, F&& place_of) {
        if (!near()) return;
        contact.emplace(plan, run, origin, threads, blocks, pitch, place_of);
        if (features) features->pinch(contact->pinches());
    }
    void make(const std::vector<std::int64_t>& borders) {
        shares = &plan.shares<T>(borders, sparse, run.room);
        x.assign(4 * (plan.count + 1), T(0));
        v.assign(4 * (plan.count + 1), T(0));
        if (sparse) {
            for (Array<T>& lead : plan.room<T>(run.room).leads) lead.assign(4 * (plan.count + 1), T(0));
            quarters.resize(plan.count);
            for (std::int64_t i = 0; i < plan.count; ++i)
                quarters[plan.rank[i]] = static_cast<T>(0.25 * run.every * run.step * plan.inverse[i]);
            for (Share<T>& share : *shares) {
                share.bent.resize(4 * (plan.count + 1));
                share.seen.resize(4 * (plan.count + 1));
            }
        }
        if (whole()) {
            ox.resize(3 * plan.count);
            ov.resize(3 * plan.count);
            of.resize(3 * plan.count);
        }
    }
    /// Forces of lists and of the caller on a share's particles at step `step`, in its f; powers booked.
    Done forces(std::int64_t step, int number) {
        Share<T>& share = (*shares)[number];
        T* const f = share.f.data();
        std::fill(f + 4 * share.low, f + 4 * share.high, T(0));
        std::fill(f + 4 * plan.count, f + 4 * plan.count + 4, T(0));
        const bool booked = run.powers && step >= 0;
        Powers seen;
        for (std::size_t k = 0; k < share.lists.size(); ++k)
            if (!(sparse && plan.lists[k].slow))
                add_forces<T>(plan.lists[k], share.lists[k], x.data(), v.data(), f, booked ? &seen : nullptr);
        if (sparse && run.bends(step)) bend(step, share, booked ? &seen : nullptr);
        if constexpr (sizeof(T) == 8) {
            if (self) self->add(step, x.data(), v.data(), f, booked ? seen.lost : nullptr);
            if (features) features->add(step, x.data(), v.data(), f);
        }
        return whole() ? asked(step, f, booked, seen) : Done::well;
    }
    /// Hinges in a step that stands for `every` of them: their impulse, and what they lose, is that of all. Velocities just
    /// before such an impulse lack half of it, and damping of hinges has to see the mean: the half is foretold by the mean
    /// of the last two, as steps foretell theirs.
    void bend(std::int64_t step, Share<T>& share, Powers* booked) {
        const std::int64_t turn = step < 0 ? 0 : step / run.every + 1;
        auto& leads = plan.room<T>(run.room).leads;
        const T* const lead = leads[(turn + 1) % 2].data();
        T *const next = leads[turn % 2].data(), *const last = leads[2].data();
        for (std::int64_t i = 4 * share.low; i < 4 * share.high; i += 4)
            store4(share.seen.data() + i, quad<T>(load4(v.data() + i) + load4(lead + i)));
        std::fill(share.bent.begin() + 4 * share.low, share.bent.begin() + 4 * share.high, T(0));
        Powers lost;
        for (std::size_t k = 0; k < share.lists.size(); ++k)
            if (plan.lists[k].slow)
                add_forces<T>(plan.lists[k], share.lists[k], x.data(), share.seen.data(), share.bent.data(),
                              booked ? &lost : nullptr);
        for (int k = 0; booked && k < 16; ++k) booked->lost[k] += static_cast<double>(run.every) * lost.lost[k];
        const T weight = static_cast<T>(step < 0 ? 0 : run.every);
        T* const f = share.f.data();
        for (std::int64_t p = share.first; p < share.last; ++p) {
            const quad<T> bent = load4(share.bent.data() + 4 * p), all{weight, weight, weight, weight};
            const quad<T> quarter{quarters[p], quarters[p], quarters[p], quarters[p]}, now = quarter * bent;
            store4(f + 4 * p, fma(all, bent, load4(f + 4 * p)));
            store4(next + 4 * p, quad<T>(now + (step < 0 ? now : load4(last + 4 * p))));
            store4(last + 4 * p, now);
        }
    }
    Done asked(std::int64_t step, T* f, bool booked, const Powers& seen) {
        const std::int64_t n = plan.count;
        for (int c = 0; c < 3; ++c)
            for (std::int64_t i = 0; i < n; ++i) {
                const std::int64_t at = 4 * plan.rank[i] + c;
                ox[c * n + i] = origin[c] + static_cast<double>(x[at]);
                ov[c * n + i] = static_cast<double>(v[at]);
            }
        double now[2] = {seen.sum(seen.lost), seen.sum(seen.given)};
        if (plan.callback) {
            std::fill(of.begin(), of.end(), 0.0);
            double* const powers = booked ? now : nullptr;
            if (plan.callback(middle_of(run, step), ox.data(), ov.data(), of.data(), powers) != called_well)
                return Done::callback_failed;
        }
        if (booked) {
            other_powers(plan, ox.data(), ov.data(), now[0], now[1]);
            run.powers[0] += run.step * now[0];
            run.powers[1] += run.step * now[1];
        }
        if (!plan.callback) return Done::well;
        for (int c = 0; c < 3; ++c)
            for (std::int64_t i = 0; i < n; ++i) f[4 * plan.rank[i] + c] += static_cast<T>(of[c * n + i]);
        return Done::well;
    }
    /// Take positions or velocities of a sheet's row in, components `pitch` numbers apart.
    void show(Slot what, std::int64_t row, const T* from, std::int64_t pitch) {
        const std::int64_t columns = plan.grid->columns;
        T* const to = (what == position ? x : v).data() + 4 * row * columns;
        for (std::int64_t j = 0; j < columns; j += lanes<T>) {
            quad<T> rows[lanes<T>];
            together(load(from + j), load(from + pitch + j), load(from + 2 * pitch + j), rows);
            const std::int64_t most = std::min<std::int64_t>(lanes<T>, columns - j);
            for (std::int64_t k = 0; k < most; ++k) store4(to + 4 * (j + k), rows[k]);
        }
    }
    /// Move pads to a step, once all threads have been at the one before.
    void follow(int thread, std::int64_t step) {
        if (contact) contact->follow(thread, step);
    }
    /// Add what obstacles do to a share's particles.
    void add_contact(int thread, std::int64_t step, T* f) {
        const Share<T>& share = (*shares)[thread];
        for (std::int64_t first = share.first; contact && first < share.last; first += contact_block) {
            const std::int64_t count = std::min(contact_block, share.last - first);
            contact->add_quads(thread, first / contact_block, step, x.data() + 4 * first, v.data() + 4 * first,
                               f + 4 * first, count);
        }
    }
    /// Add what obstacles, grippers, lists and the caller do to a sheet's row to its forces in the ring.
    void add_row(int thread, std::int64_t row, std::int64_t step, const RowPlace<T>& at, bool book) {
        const std::int64_t columns = plan.grid->columns, first = row * columns, last = first + columns;
        T* const ring = at.ring[0];
        if (contact)
            contact->add(thread, row, step, at.row[0] + position * at.pitch, at.row[0] + seen * at.pitch, ring, columns,
                         book);
        const auto& particles = plan.held.particle;
        auto place = particles.empty() ? particles.end() : std::lower_bound(particles.begin(), particles.end(), first);
        for (; place != particles.end() && *place < last; ++place) {
            const std::int64_t j = *place - first;
            const T *const here = at.row[0] + position * at.pitch + j, *const moving = at.row[0] + seen * at.pitch + j;
            const Vec3<T> f = pull(thread, place - particles.begin(), step, {here[0], here[at.pitch], here[2 * at.pitch]},
                                   {moving[0], moving[at.pitch], moving[2 * at.pitch]}, book);
            ring[j] += f.x, ring[at.pitch + j] += f.y, ring[2 * at.pitch + j] += f.z;
        }
        if (!acts(step)) return;
        const T* const from = (*shares)[thread].f.data() + 4 * first;
        std::int64_t j = 0;
        for (; j + lanes<T> <= columns; j += lanes<T>) {
            quad<T> rows[lanes<T>];
            for (int k = 0; k < lanes<T>; ++k) rows[k] = load4(from + 4 * (j + k));
            vec<T> f[3];
            apart(rows, f[0], f[1], f[2]);
            for (int c = 0; c < 3; ++c) store_as(ring + c * at.pitch + j, load(ring + c * at.pitch + j) + f[c]);
        }
        for (; j < columns; ++j)
            for (int c = 0; c < 3; ++c) ring[c * at.pitch + j] += from[4 * j + c];
    }
    /// Force on the particle of a grip at step `step`, from its place and velocity as the run keeps them.
    Vec3<T> pull(int thread, std::int64_t grip, std::int64_t step, Vec3<T> x_, Vec3<T> v_, bool book) {
        const Held& held = plan.held;
        const Vec3<double> at{origin[0] + x_.x, origin[1] + x_.y, origin[2] + x_.z};
        const Vec3<double> moving{double(v_.x), double(v_.y), double(v_.z)};
        const auto point = held.point(poses[thread].at(held.gripper[grip], step), grip);
        const Vec3<double> force = held.force(grip, point, at, moving);
        if (book && step >= 0) {
            // Each grip for itself, in its own sum: threads book in any order.
            held.book(grips.data() + grip * booked_numbers, grip, point, force, moving, run.step);
        }
        return {T(force.x), T(force.y), T(force.z)};
    }
    /// A run in which something may have passed through something has no result.
    void finish_surface() {
        const bool clear = !features || features->finish(x.data());
        if ((self && !self->finish(x.data())) || !clear) {
            std::fill(run.x, run.x + 3 * plan.count, std::numeric_limits<double>::quiet_NaN());
            std::fill(run.v, run.v + 3 * plan.count, std::numeric_limits<double>::quiet_NaN());
        }
        if (!run.touched) return;
        double* const touched = run.touched + plan.contacts.count() * booked_numbers;
        const SelfRates own = self ? self->rates() : SelfRates{}, met = features ? features->rates() : SelfRates{};
        if (self) touched[1] = smaller(self->gap(), touched[1]);
        if (features) touched[1] = smaller(features->gap(), touched[1]);
        touched[Touched::numbers] = own.omega2 + met.omega2;
        touched[Touched::numbers + 1] = own.damping + met.damping;
        touched[Touched::numbers + 3] += (self ? self->grown() : 0.0) + (features ? features->grown() : 0.0);
        if (!self) return;
        touched[Touched::numbers + 2] = self->rubbed();
        if (run.anchors) self->anchors(run.steps, plan.own.data(), run.anchors + plan.contacts.obstacle_anchors(plan.count));
    }
    /// What a run tells that no obstacle was near.
    void met_nothing() {
        const Contacts& contacts = plan.contacts;
        if (run.touched) Touched().to(run.touched + contacts.count() * booked_numbers);
    }
    /// Sum up what was booked, in order of the grips and of the blocks.
    void finish() {
        // What is not met keeps what it has: none.
        if (run.anchors) std::copy(plan.contacts.anchors.begin(), plan.contacts.anchors.end(), run.anchors);
        if (contact)
            contact->finish();
        else
            met_nothing();
        if constexpr (sizeof(T) == 8)
            if ((self || features) && run.steps) finish_surface();
        if (!run.booked) return;
        for (std::int64_t grip = 0; grip < plan.held.count(); ++grip)
            for (int k = 0; k < booked_numbers; ++k)
                run.booked[plan.held.gripper[grip] * booked_numbers + k] += grips[grip * booked_numbers + k];
    }
};

}  // namespace cloth
