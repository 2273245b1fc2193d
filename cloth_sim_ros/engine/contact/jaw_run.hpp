// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Jaws over a run: integrated like particles, with the forces of all blocks of particles in the step before.
#pragma once

#include "contact/parallel_jaw.hpp"
#include "plan/plan.hpp"

namespace cloth::contact {

using grid::StepFactors, plan::Run;

class JawRun {
public:
    JawRun(const Contacts& contacts, const Run& run, int threads, std::int64_t blocks)
        : contacts_(contacts), run_(run), blocks_(blocks + 1), law_(contacts.law<double>()),
          loads_(contacts.parallel_jaws.empty() ? 0 : 2 * contacts.count() * blocks_ * JawLoad::numbers, 0.0) {
        const std::int64_t count = static_cast<std::int64_t>(contacts.parallel_jaws.size());
        for (int k = 0; k < threads && count; ++k) {
            threads_.emplace_back();
            for (std::int64_t jaw = 0; jaw < count; ++jaw) {
                const double* const at = contacts.jaw_states.data() + jaw * jaw_state_size;
                threads_.back().jaws.push_back({at[0], at[1], at[1], 0.0});
            }
        }
    }

    /// Load of a block of particles on a jaw: opening force, and mass in contact.
    struct JawLoad {
        static constexpr int numbers = 2;
        double force = 0.0, mass = 0.0;
    };
    void record_load(std::int64_t obstacle, std::int64_t block, std::int64_t step, const JawLoad& jaw_load) {
        double* const at = slot(obstacle, block, step);
        at[0] = jaw_load.force;
        at[1] = jaw_load.mass;
    }
    /// Record the load of the surface between particles on a jaw.
    void record_surface_load(std::int64_t obstacle, std::int64_t step, const JawLoad& jaw_load) {
        record_load(obstacle, blocks_ - 1, step, jaw_load);
    }
    /// Pose of a jaw as particles see it, from the pose of its gripper.
    Pose pose(int thread, std::int64_t obstacle, const Pose& gripper) const {
        const JawMotion& jaw = threads_[thread].jaws[contacts_.obstacles[obstacle].parallel_jaw];
        return contacts_.shifted_pose(gripper, obstacle, jaw.half_opening, jaw.damping_speed);
    }
    /// Advance the jaws to a step, after all blocks have recorded their loads of the step before. Each thread does so
    /// for itself, so that none waits for another.
    void advance(int thread, std::int64_t step) {
        if (threads_.empty() || step < 0) return;
        ThreadState& state = threads_[thread];
        const StepFactors<double> m = motion_of<double>(run_, step - 1);
        for (std::size_t k = 0; k < contacts_.parallel_jaws.size(); ++k) {
            const ParallelJaw& drive = contacts_.parallel_jaws[k];
            if (!drive.present) continue;
            JawLoad jaw_load;
            for (std::int64_t obstacle = 0; obstacle < contacts_.count(); ++obstacle) {
                if (contacts_.obstacles[obstacle].parallel_jaw != static_cast<std::int64_t>(k)) continue;
                for (std::int64_t block = 0; block < blocks_; ++block) {
                    const double* const at = slot(obstacle, block, step - 1);
                    jaw_load.force += at[0];
                    jaw_load.mass += at[1];
                }
            }
            JawMotion& jaw = state.jaws[k];
            const double thickness = contacts_.thickness;
            state.mass_ratio = larger(jaw_load.mass / drive.mass, state.mass_ratio);
            state.stop_energy =
                larger(drive.stop_energy(law_, thickness, jaw.half_opening, jaw.damping_speed, 2.0 * run_.step),
                       state.stop_energy);
            const double a = drive.acceleration(law_, thickness, jaw.half_opening, jaw.damping_speed, jaw_load.force);
            jaw.speed = fma(m.kick, a, jaw.speed);
            jaw.damping_speed = fma(m.predict, a, fma(m.predict_previous, jaw.previous_acceleration, jaw.speed));
            jaw.previous_acceleration = a;
            jaw.half_opening = fma(m.drift, jaw.speed, jaw.half_opening);
        }
    }
    /// Advance the jaws to the end of the run and write their states. `obstacle_energy`: largest energy per mass, in
    /// U^2/2, of contact with other obstacles; `jaw_energy`: with jaws. Return the largest of all; that of jaws is
    /// raised, because a jaw and a particle between jaws are stiffer than a single contact.
    double finish(double obstacle_energy, double jaw_energy) {
        if (threads_.empty()) return larger(jaw_energy, obstacle_energy);
        advance(0, run_.steps);
        const ThreadState& state = threads_[0];
        for (std::size_t k = 0; run_.jaw_states && k < state.jaws.size(); ++k) {
            run_.jaw_states[k * jaw_state_size] = state.jaws[k].half_opening;
            run_.jaw_states[k * jaw_state_size + 1] = state.jaws[k].speed;
        }
        return larger(stiffened_energy(law_, contacts_.thickness, jaw_energy, state.stop_energy, state.mass_ratio),
                      obstacle_energy);
    }

private:
    /// State of a jaw in the leapfrog: half opening, speed, damping speed, and acceleration of the step before.
    struct JawMotion {
        double half_opening, speed, damping_speed, previous_acceleration;
    };
    struct alignas(128) ThreadState {
        std::vector<JawMotion> jaws;
        double mass_ratio = 0.0, stop_energy = 0.0;
    };
    double* slot(std::int64_t obstacle, std::int64_t block, std::int64_t step) {
        return loads_.data() + (((step & 1) * contacts_.count() + obstacle) * blocks_ + block) * JawLoad::numbers;
    }

    const Contacts& contacts_;
    const Run& run_;
    std::int64_t blocks_;  ///< with one for the surface between particles
    ContactLaw<double> law_;
    std::vector<double> loads_;
    std::vector<ThreadState> threads_;
};

}  // namespace cloth::contact
