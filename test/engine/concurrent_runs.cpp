// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Frames of four runs with each kind of contact, in turn and concurrently. Prints a line per scene: whether anything is
// in contact, the number of threads that executed runs, and whether all bits are those of the runs in turn.
#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <new>
#include <thread>
#include <vector>

/// Whether allocations are observed, and whether a thread other than the caller of the frame has allocated.
static std::atomic<bool> observing{false}, has_other{false};
static std::thread::id caller;
static int waits = 0;

/// Runs allocate often. The caller waits a little each time, until another thread takes part, two seconds at most.
static void observe() {
    if (!observing) return;
    if (std::this_thread::get_id() != caller)
        has_other = true;
    else if (!has_other && ++waits <= 200)
        std::this_thread::sleep_for(std::chrono::milliseconds{10});
}
static void* allocate(std::size_t size, std::size_t alignment) {
    observe();
    void* const memory =
        alignment ? std::aligned_alloc(alignment, (size / alignment + 1) * alignment) : std::malloc(size + 1);
    if (!memory) throw std::bad_alloc();
    return memory;
}
void* operator new(std::size_t size) { return allocate(size, 0); }
void* operator new(std::size_t size, std::align_val_t alignment) {
    return allocate(size, static_cast<std::size_t>(alignment));
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }
void operator delete(void* memory, std::align_val_t) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t, std::align_val_t) noexcept { std::free(memory); }

#include "api/cloth_sim.hpp"
#include "contact/shapes.hpp"
#include "grid/grid.hpp"
#include "mesh/elements.hpp"
#include "plan/grips.hpp"

using namespace cloth::api;
using cloth::contact::Shape, cloth::plan::Plan;

namespace {

constexpr std::int64_t rows = 12, columns = 9, n = rows * columns, runs = 4;
constexpr double spacing = 0.02, thickness = 4e-3;

struct Scene {
    const char* name;
    bool folded = false, layers = false, table = false, point = false, jaws = false, listed = false, calls_back = false;
};

int add_nothing(double, const double*, const double*, double*, double*) { return cloth::plan::callback_ok; }

/// The springs along rows and columns of a sheet, on a grid or listed, with the contact of a scene.
Plan* make_plan(const Scene& scene) {
    const std::vector<double> masses(n, 1e-3), inverse(n, 1e3);
    Plan* const plan = cloth_plan_new(n, masses.data(), inverse.data());
    std::vector<std::int64_t> first, second, triangles;
    for (std::int64_t i = 0; i < n; ++i) {
        const bool has_right = i % columns + 1 < columns, has_below = i + columns < n;
        if (has_right) first.push_back(i), second.push_back(i + 1);
        if (has_below) first.push_back(i), second.push_back(i + columns);
        if (has_right && has_below)
            triangles.insert(triangles.end(), {i, i + 1, i + columns, i + 1, i + columns + 1, i + columns});
    }
    const auto count = static_cast<std::int64_t>(first.size()),
               triangle_count = static_cast<std::int64_t>(triangles.size()) / 3;
    const double families[6 * cloth::grid::family_count] = {1, 5.0, spacing, 1e-3, 1, -1, 1, 5.0, spacing, 1e-3, 1, -1};
    if (scene.listed) {
        first.insert(first.end(), second.begin(), second.end());
        std::vector<double> numbers(count, 5.0);
        numbers.resize(2 * count, spacing);
        numbers.resize(3 * count, 1e-3);
        cloth_plan_list(plan, static_cast<int>(cloth::mesh::Kind::spring), count, first.data(), numbers.data(),
                        nullptr);
    } else {
        cloth_plan_grid(plan, rows, columns, families);
    }
    if (scene.layers) cloth_plan_self(plan, triangle_count, triangles.data(), spacing);
    if (scene.layers) cloth_self_friction(plan, 0.5, 0.4);
    if (scene.point) cloth_plan_faces(plan, triangle_count, triangles.data(), spacing);
    // A table below the sheet, with a point that comes nearer than its face; pads above and below the sheet.
    const std::int64_t pads = scene.table ? 1 : 0, obstacles = pads + 2 * scene.jaws;
    std::vector<std::int64_t> shapes(obstacles, static_cast<std::int64_t>(Shape::box));
    std::vector<double> sizes, radii(obstacles, 1.0), frictions, paths(obstacles * cloth::plan::path_numbers, 0.0);
    for (std::int64_t k = 0; k < obstacles; ++k) {
        const bool is_table = k < pads;
        sizes.insert(sizes.end(), {is_table ? 0.5 : 0.06, is_table ? 0.5 : 0.01, is_table ? 0.02 : 0.06});
        frictions.insert(frictions.end(), {0.5, 0.4});
        double* const path = paths.data() + k * cloth::plan::path_numbers;
        path[1] = 0.07, path[2] = 0.05, path[3] = is_table ? -0.0125 : 0.0015;
        // The closing axis of the pads is vertical.
        path[13] = is_table ? 0.0 : 0.70710678118654752, path[16] = is_table ? 1.0 : 0.70710678118654752;
    }
    if (obstacles || scene.layers)
        cloth_plan_contact(plan, obstacles, shapes.data(), sizes.data(), radii.data(), frictions.data(), paths.data(),
                           thickness, 10.0, 100.0);
    const double point[3] = {0.004, 0.003, 0.0111};
    if (scene.point) cloth_plan_features(plan, 0, 1, point, 0, nullptr, 0.0);
    const std::int64_t jaws[2] = {pads, pads + 1};
    const double drive[8] = {1, 1, 0.01, 1.0, 0.5, 0.006, 0.005, 0.0};
    if (scene.jaws) cloth_plan_jaws(plan, 1, jaws, drive);
    if (scene.calls_back) cloth_plan_callback(plan, add_nothing);
    return plan;
}

/// Numbers of a run's record: powers, obstacles, contact.
std::int64_t record_size(const Scene& scene) {
    return 2 + (scene.table + 2 * scene.jaws) * cloth::plan::record_numbers + 7;
}
/// Whether the first of some runs was in contact with particles, and on the surface if it should be.
bool is_in_contact(const Scene& scene, const std::vector<double>& all) {
    const double* const summary = all.data() + 6 * n * runs + record_size(scene) - 7;
    const bool has_contact = scene.layers || scene.table || scene.jaws, on_surface = scene.folded && scene.layers;
    return has_contact && summary[1] < thickness && (summary[3] > 0.0 || !(on_surface || scene.point));
}

/// Results of a frame of four runs: end states, records, anchors, jaw states, combination, summary, activities.
std::vector<double> run_frame(const Scene& scene, std::int64_t concurrency) {
    static const std::int64_t steps[runs] = {200, 250, 300, 400};
    static const double weights[runs] = {-0.25, 0.25, -0.5, 1.5};
    std::vector<double> x(3 * n), v(3 * n, 0.0);
    for (std::int64_t i = 0; i < n; ++i) {
        const std::int64_t row = i / columns;
        const bool upper = scene.folded && row >= rows / 2;
        x[i] = spacing * static_cast<double>(i % columns);
        x[n + i] = spacing * static_cast<double>(upper ? rows - 1 - row : row) + (upper ? 1e-3 : 0.0);
        x[2 * n + i] = upper ? 3e-3 : 1e-4 * static_cast<double>(i * 13 % 7);
        v[n + i] = upper ? 0.1 : 0.0;
        v[2 * n + i] = 0.02 * static_cast<double>(i * 5 % 3) - (upper ? 0.3 : 0.0);
    }
    const std::int64_t anchors = 5 * 4 * n;
    const std::int64_t sizes[] = {6 * n * runs, record_size(scene) * runs, anchors * runs, 2 * runs, 6 * n, 11,
                                  2 * runs};
    std::vector<double> all;
    std::int64_t at[8] = {};
    for (int k = 0; k < 7; ++k) at[k + 1] = at[k] + sizes[k];
    all.assign(at[7], 0.0);
    cloth::plan::FrameRequest frame{};
    frame.duration = 5e-3, frame.runs = runs, frame.steps = steps, frame.weights = weights, frame.bands = 2;
    frame.x0 = x.data(), frame.v0 = v.data(), frame.out = all.data(), frame.result = all.data() + at[4];
    frame.records = all.data() + at[1], frame.anchors = all.data() + at[2], frame.jaw_states = all.data() + at[3];
    frame.summary = all.data() + at[5], frame.activities = all.data() + at[6], frame.record_obstacles = 1;
    frame.multirate = 1, frame.combined = runs, frame.concurrency = concurrency;
    Plan* const plan = make_plan(scene);
    caller = std::this_thread::get_id();
    has_other = false;
    waits = 0;
    observing = concurrency > 1;
    const int status = cloth_frame(plan, &frame);
    observing = false;
    cloth_plan_free(plan);
    if (status || !(all[at[5]] < 1e30)) std::exit(1);
    return all;
}

}  // namespace

int main() {
    const Scene scenes[] = {
        {.name = "no contact"},
        {.name = "separated sheet", .layers = true},
        {.name = "layers", .folded = true, .layers = true},
        {.name = "listed layers", .folded = true, .layers = true, .listed = true},
        {.name = "table", .table = true},
        {.name = "table and point", .table = true, .point = true},
        {.name = "jaws", .folded = true, .jaws = true},
        {.name = "all", .folded = true, .layers = true, .table = true, .point = true, .jaws = true},
        {.name = "callback", .folded = true, .layers = true, .calls_back = true},
    };
    for (const Scene& scene : scenes) {
        const std::vector<double> expected = run_frame(scene, 1);
        bool same = true;
        int threads = 0;
        for (const std::int64_t concurrency : {2, 4, 8}) {
            const std::vector<double> all = run_frame(scene, concurrency);
            same = same && !std::memcmp(all.data(), expected.data(), all.size() * sizeof(double));
            threads = std::max(threads, has_other ? 2 : 1);
        }
        std::printf("%s: %s, %d threads, %s bits\n", scene.name,
                    is_in_contact(scene, expected) ? "in contact" : "clear", threads, same ? "same" : "other");
    }
}
