// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Translation unit of the C ABI, which api/cloth_sim.hpp describes, and of the frame.

#include "api/band.hpp"
#include "api/guard.hpp"
#include "plan/frame.hpp"
#include "plan/paths.hpp"
#include "plan/queries.hpp"
#include "plan/tables.hpp"
#include "plan/velocity_displacement.hpp"

namespace cloth::api {

CLOTH_API int cloth_engine_abi() { return 31; }
CLOTH_API const char* cloth_engine_name() {
#if defined(__AVX512F__)
    return "avx512";
#elif defined(__AVX2__)
    return "avx2";
#elif defined(__aarch64__)
    return "neon";
#else
    return "baseline";
#endif
}

CLOTH_API Plan* cloth_plan_new(std::int64_t count, const double* masses, const double* inverse) {
    try {
        auto plan = std::make_unique<Plan>();
        plan->count = count;
        plan->masses.assign(masses, masses + count);
        plan->inverse.assign(inverse, inverse + count);
        plan->free_inverse = plan->inverse;
        std::vector<std::int64_t> ranks(count);
        std::iota(ranks.begin(), ranks.end(), std::int64_t{0});
        plan->set_ranks(std::move(ranks));
        return plan.release();
    } catch (const std::bad_alloc&) {
        return nullptr;
    }
}
CLOTH_API void cloth_plan_free(Plan* plan) { delete plan; }

CLOTH_API int cloth_plan_grid(Plan* plan, std::int64_t rows, std::int64_t columns, const double* families) {
    return guarded(plan, [&] {
        grid::Grid grid;
        grid.rows = rows;
        grid.columns = columns;
        for (int f = 0; f < grid::family_count; ++f) {
            const double* const row = families + 6 * f;
            grid.families[f] = {.present = row[0] != 0.0,
                                .stiffness = row[1],
                                .rest_length = row[2],
                                .damping = row[3],
                                .border = row[4],
                                .parity = static_cast<int>(row[5])};
        }
        plan->grid = grid;
        plan->tables = grid::GridTables<double>(grid, plan->inverse.data());
    });
}
CLOTH_API int cloth_plan_list(Plan* plan, int kind, std::int64_t count, const std::int64_t* corners,
                              const double* params, const double* common) {
    return guarded(plan, [&] { plan->add_list({static_cast<mesh::Kind>(kind), count, corners, params, common}); });
}
CLOTH_API int cloth_plan_uniform(Plan* plan, const double* gravity, const double* wind, double drag) {
    return guarded(plan, [&] {
        std::copy(gravity, gravity + 3, plan->gravity);
        std::copy(wind, wind + 3, plan->wind);
        plan->drag = drag;
    });
}
CLOTH_API int cloth_plan_air(Plan* plan, const double* common) {
    return guarded(plan, [&] {
        for (mesh::List& list : plan->lists)
            if (!list.numbers)
                std::copy(common + (mesh::is_mass(list.kind) ? 2 : 0), common + 5,
                          list.common + (mesh::is_mass(list.kind) ? 2 : 0));
    });
}
CLOTH_API int cloth_plan_plastic_lengths(Plan* plan, const double* lengths) {
    return guarded(plan, [&] {
        for (std::int64_t e = 0; e < plan->plastic_count(); ++e) {
            mesh::List& list = plan->lists[plan->plastic_list];
            list.params[e * list.numbers] = lengths[e];
        }
    });
}
CLOTH_API int cloth_plan_order(Plan* plan, const std::int64_t* rank) {
    return guarded(plan, [&] { plan->set_ranks({rank, rank + plan->count}); });
}
CLOTH_API int cloth_plan_callback(Plan* plan, Callback callback) {
    return guarded(plan, [&] { plan->callback = callback; });
}
CLOTH_API int cloth_plan_grips(Plan* plan, std::int64_t grippers, std::int64_t count, const std::int64_t* particles,
                               const std::int64_t* owners, const double* offsets, const double* stiffness,
                               const double* damping, const std::int64_t* prescribed) {
    return guarded(plan, [&] {
        std::vector<std::int64_t> order(count);
        std::iota(order.begin(), order.end(), std::int64_t{0});
        std::stable_sort(order.begin(), order.end(), [&](auto a, auto b) { return particles[a] < particles[b]; });
        plan::Grips grips;
        grips.grippers = grippers;
        grips.paths.assign(grippers * plan::path_numbers, 0.0);
        for (std::int64_t k : order) {
            grips.particle.push_back(particles[k]);
            grips.gripper.push_back(owners[k]);
            grips.offset.push_back({offsets[3 * k], offsets[3 * k + 1], offsets[3 * k + 2]});
            grips.stiffness.push_back(stiffness[k]);
            grips.damping.push_back(damping[k]);
            // An anchored particle keeps its position.
            grips.prescribed.push_back(prescribed[k] && plan->inverse[particles[k]] > 0.0);
            grips.has_prescribed = grips.has_prescribed || grips.prescribed.back();
        }
        grips.velocity_before.resize(count);
        plan->set_grips(std::move(grips));
    });
}

CLOTH_API int cloth_plan_gripper_paths(Plan* plan, const double* paths) {
    int status = ok;
    const int call_status = guarded(plan, [&] {
        const double* const end = paths + plan->grips.grippers * plan::path_numbers;
        if (std::all_of(paths, end, [](double a) { return std::isfinite(a); }))
            plan->grips.paths.assign(paths, end);
        else
            status = not_finite;
    });
    return call_status ? call_status : status;
}

CLOTH_API int cloth_frame(Plan* plan, const FrameRequest* frame) {
    int status = ok;
    const int call_status = guarded(plan, [&] {
        if (plan::execute_frame(*plan, *frame) != plan::RunStatus::ok) status = callback_failed;
    });
    return call_status ? call_status : status;
}
CLOTH_API int cloth_accelerations(Plan* plan, double t, const double* x, const double* v, double* out) {
    int status = ok;
    const int call_status = guarded(plan, [&] {
        if (plan::free_accelerations(*plan, t, x, v, out) != plan::RunStatus::ok) status = callback_failed;
    });
    return call_status ? call_status : status;
}

CLOTH_API int cloth_velocity_displacement(Plan* plan, double t, const double* x, const double* errors, double time,
                                          double* out) {
    return guarded(plan, [&] {
        const plan::DisplacementEstimate estimate = plan::velocity_displacement(*plan, t, x, errors, time);
        out[0] = estimate.displacement;
        out[1] = estimate.evaluations;
    });
}

CLOTH_API int cloth_energy(Plan* plan, double t, const double* x, const double* v, double* out) {
    return guarded(plan, [&] {
        const plan::Energy e = plan::energy_of(*plan, t, x, v);
        out[0] = e.kinetic;
        out[1] = e.potential;
    });
}
CLOTH_API int cloth_mass_blocks(const Plan* plan, const double* x, double* blocks) {
    return guarded(plan, [&] { plan::mass_blocks(*plan, x, blocks); });
}
CLOTH_API int cloth_powers(Plan* plan, double t, const double* x, const double* v, double* out) {
    return guarded(plan, [&] {
        out[0] = out[1] = 0.0;
        plan::total_powers(*plan, t, x, v, out[0], out[1]);
    });
}
CLOTH_API int cloth_grip_wrenches(Plan* plan, double t, const double* x, const double* v, double weight, double* out) {
    int status = ok;
    const int call_status = guarded(plan, [&] {
        const std::size_t size = plan->grips.grippers * plan::record_numbers;
        std::vector<double> wrenches(size, 0.0);
        plan::add_grip_wrenches(*plan, t, x, v, wrenches.data());
        if (plan::add_prescribed_wrenches(*plan, t, x, v, wrenches.data()) != plan::RunStatus::ok)
            status = callback_failed;
        for (std::size_t k = 0; k < size; ++k) out[k] += weight * wrenches[k];
    });
    return call_status ? call_status : status;
}
CLOTH_API int cloth_prescribe(Plan* plan, double t, double* x, double* v, double* out) {
    return guarded(plan, [&] {
        std::vector<double> wrenches(plan->grips.grippers * plan::record_numbers, 0.0);
        plan::prescribe(*plan, t, x, v, wrenches.data());
        if (out) std::copy(wrenches.begin(), wrenches.end(), out);
    });
}
CLOTH_API int cloth_spectral_bounds(Plan* plan, const double* x, const double* stiff, const double* damp,
                                    std::int64_t hinges, double* out) {
    return guarded(plan, [&] {
        const plan::SpectralBounds r = plan::spectral_bounds(*plan, x, stiff, damp, hinges != 0);
        const double numbers[5] = {r.omega2, r.damping, r.hinge_omega2, r.hinge_damping, r.transverse_omega2};
        std::copy(numbers, numbers + 5, out);
    });
}
CLOTH_API int cloth_turn_in_step(const Plan* plan, const double* x0, const double* x, std::int64_t steps,
                                 std::int64_t runs, double* out) {
    return guarded(plan, [&] { *out = plan::turn_in_step(*plan, x0, x, steps, runs); });
}
CLOTH_API int cloth_bounds(const Plan* plan, const double* x, double* stiff, double* damp) {
    return guarded(plan, [&] { plan::add_bounds(*plan, x, stiff, damp); });
}
CLOTH_API int cloth_eigenvalues(const double* blocks, std::int64_t n, double* out) {
    return guarded([&] { plan::eigenvalues(blocks, n, out); });
}
CLOTH_API int cloth_derivative_product(Plan* plan, double t, const double* x, const double* v, const double* dx,
                                       const double* dv, double* out) {
    return guarded(plan, [&] { plan::add_product(*plan, t, x, v, dx, dv, out); });
}
CLOTH_API int cloth_hinge_jerk(Plan* plan, const double* x, const double* v, double* out) {
    return guarded(plan, [&] { plan::hinge_jerk(*plan, x, v, out); });
}
CLOTH_API int cloth_kink_velocities(Plan* plan, const double* x0, const double* v0, const double* x1, const double* v1,
                                    const double* plastic0, const double* plastic1, double duration, double step,
                                    double* out) {
    return guarded(plan,
                   [&] { plan::kink_velocities(*plan, {x0, v0, x1, v1, plastic0, plastic1, duration, step}, out); });
}
CLOTH_API int cloth_pair_blocks(const Plan* plan, std::int64_t list, const double* x, double stiffness, double damping,
                                double* out) {
    return guarded(plan, [&] { plan::pair_blocks(plan->lists[list], x, plan->count, stiffness, damping, out); });
}
CLOTH_API int cloth_membrane_blocks(const Plan* plan, std::int64_t list, const double* x, double stiffness,
                                    double damping, double* out) {
    return guarded(plan, [&] { plan::membrane_blocks(plan->lists[list], x, plan->count, stiffness, damping, out); });
}
CLOTH_API int cloth_paths(std::int64_t count, double t, double duration, const double* poses, const double* twists,
                          const double* previous, const double* targets, double* paths, double* end_twists,
                          double* motions, double* changes) {
    return guarded([&] {
        for (std::int64_t k = 0; k < count; ++k) {
            const double *const previous_motion = previous + 6 * k, *const motion = motions + 6 * k;
            plan::path_to(t, duration, poses + 7 * k, twists + 6 * k, previous_motion, targets + 7 * k,
                          paths + k * plan::path_numbers, end_twists + 6 * k, motions + 6 * k);
            changes[k] = 0.0;
            for (int i = 0; i < 3; ++i) changes[k] = std::max(changes[k], std::abs(motion[i] - previous_motion[i]));
        }
    });
}
CLOTH_API int cloth_rotation_vector(const double* start, const double* end, double* out) {
    return guarded([&] { plan::rotation_vector(start, end, out); });
}
CLOTH_API int cloth_pose(const double* path, double t, double* out) {
    return guarded([&] {
        const plan::Pose p = plan::pose_at(path, t);
        const auto put = [&](int at, Vec3<double> a) { out[at] = a.x, out[at + 1] = a.y, out[at + 2] = a.z; };
        put(0, p.position);
        put(3, p.velocity);
        for (int j = 0; j < 3; ++j)
            out[6 + j] = p.rotation[j].x, out[9 + j] = p.rotation[j].y, out[12 + j] = p.rotation[j].z;
        put(15, p.spin);
    });
}

CLOTH_API int cloth_combine(std::int64_t arrays, const double* const* from, const double* weights, std::int64_t size,
                            double* out) {
    return guarded([&] { plan::combine(arrays, from, weights, size, out); });
}
CLOTH_API int cloth_distance(const double* x, const double* y, std::int64_t n, double* out) {
    return guarded([&] { *out = plan::largest_distance(x, y, n); });
}
CLOTH_API int cloth_weighted_dot(const double* m, const double* a, const double* b, std::int64_t n, double* out) {
    return guarded([&] {
        double sum = 0.0;
        for (std::int64_t i = 0; i < n; ++i) sum += m[i] * dot(plan::particle(a, n, i), plan::particle(b, n, i));
        *out = sum;
    });
}
CLOTH_API int cloth_combine_plastic_lengths(const Plan* plan, const double* x, std::int64_t runs, const double* weights,
                                            const double* ends, double* out, double* work) {
    return guarded(plan, [&] { *work = plan::combine_plastic_lengths(*plan, x, runs, weights, ends, out); });
}
CLOTH_API int cloth_hinge_lengths(int kind, std::int64_t count, const std::int64_t* corners, const double* x,
                                  std::int64_t n, double* lengths, double* squares) {
    return guarded([&] {
        const std::vector<double> params(3 * count, 0.0);
        const mesh::List list(static_cast<mesh::Kind>(kind), count, corners, params.data(), nullptr);
        plan::hinge_lengths(list, x, n, lengths, squares);
    });
}

}  // namespace cloth::api
