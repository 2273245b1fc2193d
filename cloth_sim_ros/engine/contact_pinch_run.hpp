// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Pads over a run: they are stepped as particles are, by what all blocks of particles did to them in the step before.
#pragma once

#include "plan.hpp"

namespace cloth {

class PinchRun {
public:
    PinchRun(const Contacts& contacts, const Run& run, int threads, std::int64_t blocks)
        : contacts_(contacts), run_(run), blocks_(blocks + 1), law_(contacts.law<double>()),
          felt_(contacts.pinches.empty() ? 0 : 2 * contacts.count() * blocks_ * Felt::numbers, 0.0) {
        const std::int64_t count = static_cast<std::int64_t>(contacts.pinches.size());
        for (int k = 0; k < threads && count; ++k) {
            threads_.emplace_back();
            for (std::int64_t pinch = 0; pinch < count; ++pinch) {
                const double *const at = contacts.pinched.data() + pinch * pinch_numbers;
                threads_.back().pads.push_back({at[0], at[1], at[1], 0.0});
            }
        }
    }

    /// What a block of particles does to a pad: the force that moves it outward, and the mass in contact.
    struct Felt {
        static constexpr int numbers = 2;
        double force = 0.0, mass = 0.0;
    };
    void feel(std::int64_t obstacle, std::int64_t block, std::int64_t step, const Felt& felt) {
        double* const at = place(obstacle, block, step);
        at[0] = felt.force;
        at[1] = felt.mass;
    }
    /// What the cloth between particles does to a pad.
    void feel_between(std::int64_t obstacle, std::int64_t step, const Felt& felt) {
        feel(obstacle, blocks_ - 1, step, felt);
    }
    /// Pose of a pad at a step, from its gripper's, as particles see it.
    Pose pose(int thread, std::int64_t obstacle, const Pose& gripper) const {
        const Moving& pad = threads_[thread].pads[contacts_.obstacles[obstacle].pinch];
        return contacts_.shifted(gripper, obstacle, pad.way, pad.seen);
    }
    /// Move the pads to step `step`: all blocks have felt those of the step before. Each thread does it for itself, so that
    /// none has to wait for another one's.
    void follow(int thread, std::int64_t step) {
        if (threads_.empty() || step < 0) return;
        Mine& mine = threads_[thread];
        const Motion<double> m = motion_of<double>(run_, step - 1);
        for (std::size_t k = 0; k < contacts_.pinches.size(); ++k) {
            const Pinch& pinch = contacts_.pinches[k];
            if (!pinch.present) continue;
            Felt felt;
            for (std::int64_t obstacle = 0; obstacle < contacts_.count(); ++obstacle) {
                if (contacts_.obstacles[obstacle].pinch != static_cast<std::int64_t>(k)) continue;
                for (std::int64_t block = 0; block < blocks_; ++block) {
                    const double* const at = place(obstacle, block, step - 1);
                    felt.force += at[0];
                    felt.mass += at[1];
                }
            }
            Moving& pad = mine.pads[k];
            const double thickness = contacts_.thickness;
            mine.share = larger(felt.mass / pinch.mass, mine.share);
            mine.stopped = larger(pinch.stopped(law_, thickness, pad.way, pad.seen, 2.0 * run_.step), mine.stopped);
            const double a = pinch.acceleration(law_, thickness, pad.way, pad.seen, felt.force);
            pad.rate = fma(m.kick, a, pad.rate);
            pad.seen = fma(m.now, a, fma(m.before, pad.before, pad.rate));
            pad.before = a;
            pad.way = fma(m.drift, pad.rate, pad.way);
        }
    }
    /// Move the pads to the run's end and write where they are to `run_.pinched`. `reached` is the largest energy per
    /// mass, in U^2/2, that contact with other obstacles had to take up, `pinched` the largest with pads. Return the
    /// largest of all, with that of pads raised because a pad and a particle between pads are stiffer than a single
    /// contact.
    double finish(double reached, double pinched) {
        if (threads_.empty()) return larger(pinched, reached);
        follow(0, run_.steps);
        const Mine& mine = threads_[0];
        for (std::size_t k = 0; run_.pinched && k < mine.pads.size(); ++k) {
            run_.pinched[k * pinch_numbers] = mine.pads[k].way;
            run_.pinched[k * pinch_numbers + 1] = mine.pads[k].rate;
        }
        // A particle between two pads, and pads between particles: docs/contact.md has the bound.
        const double times = 2.0 + mine.share + (mine.stopped > 0.0 ? 1.0 : 0.0);
        const double most = larger(mine.stopped, pinched);
        return larger(stiffened(law_, contacts_.thickness, most, times), reached);
    }

private:
    /// As the leapfrog keeps a particle: place, rate, the rate that damping sees, and the acceleration before.
    struct Moving {
        double way, rate, seen, before;
    };
    struct alignas(128) Mine {
        std::vector<Moving> pads;
        double share = 0.0, stopped = 0.0;
    };
    double* place(std::int64_t obstacle, std::int64_t block, std::int64_t step) {
        return felt_.data() + (((step & 1) * contacts_.count() + obstacle) * blocks_ + block) * Felt::numbers;
    }

    const Contacts& contacts_;
    const Run& run_;
    std::int64_t blocks_;  ///< and one for what acts between particles
    ContactLaw<double> law_;
    std::vector<double> felt_;
    std::vector<Mine> threads_;
};

}  // namespace cloth
