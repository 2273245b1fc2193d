// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Frames that run out of memory: each allocation of a frame fails once, in a process of its own, and the same frame is
// executed again. Prints a line per scene: the number of allocations whose failure was reported, and of worse outcomes.
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <new>
#include <vector>

static std::atomic<long> allocated{0}, failing{0};

static void* allocate(std::size_t size, std::size_t alignment) {
    if (failing && ++allocated == failing) throw std::bad_alloc();
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
#include "grid/grid.hpp"
#include "mesh/elements.hpp"

using namespace cloth::api;
using cloth::plan::Plan;

constexpr std::int64_t rows = 8, columns = 9, n = rows * columns, runs = 4;

/// The springs of a sheet: listed, or those along rows and columns on a grid and the others listed; listed ones of a
/// sheet that touches itself.
enum Scene { listed, grid, layers };
constexpr const char* names[] = {"list", "grid", "layers"};

/// Let a surface touch itself within 40 mm.
static void add_self_contact(Plan* plan) {
    std::vector<std::int64_t> triangles;
    for (std::int64_t i = 0; i + columns < n; ++i)
        if (i % columns + 1 < columns) {
            const std::int64_t a = i, b = i + 1, d = i + columns, e = d + 1;
            triangles.insert(triangles.end(), {a, b, d, b, e, d});
        }
    cloth_plan_contact(plan, 0, nullptr, nullptr, nullptr, nullptr, nullptr, 0.04, 10.0, 2000.0);
    cloth_plan_self(plan, static_cast<std::int64_t>(triangles.size() / 3), triangles.data(), 0.1);
}
static Plan* make_plan(Scene scene) {
    const std::vector<double> masses(n, 0.01), inverse(n, 100.0);
    Plan* const plan = cloth_plan_new(n, masses.data(), inverse.data());
    std::vector<std::int64_t> first, second;
    for (std::int64_t i = 0; i < n; ++i) {
        if (i % columns + 1 < columns) first.push_back(i), second.push_back(i + 1);
        if (i + columns < n) first.push_back(i), second.push_back(i + columns);
    }
    const auto count = static_cast<std::int64_t>(first.size());
    first.insert(first.end(), second.begin(), second.end());
    std::vector<double> numbers(count, 5.0);
    numbers.resize(2 * count, 0.1);
    numbers.resize(3 * count, 0.01);
    double families[6 * cloth::grid::family_count] = {1, 5.0, 0.1, 0.01, 1, 0, 1, 5.0, 0.1, 0.01, 1, 0};
    if (scene == grid) cloth_plan_grid(plan, rows, columns, families);
    cloth_plan_list(plan, static_cast<int>(cloth::mesh::Kind::spring), count, first.data(), numbers.data(), nullptr);
    if (scene == layers) add_self_contact(plan);
    return plan;
}

/// Execute a frame of four runs of the plan, in turn or concurrently; set their end states and return the status.
static int run_frame(Plan* plan, Scene scene, std::int64_t concurrency, std::vector<double>& out) {
    static const std::int64_t steps[runs] = {9, 18, 27, 36}, few_steps[runs] = {3, 6, 9, 12};
    static const double weights[2] = {-0.5, 1.5};
    static std::vector<double> x(3 * n), v(3 * n), result(6 * n), notes(16 * runs);
    for (std::int64_t i = 0; i < n; ++i) {
        x[i] = 0.1 * static_cast<double>(i % columns), x[n + i] = 0.1 * static_cast<double>(i / columns);
        x[2 * n + i] = 0.01 * static_cast<double>(i * 13 % 7);
        if (scene != layers) continue;
        // Folded in the middle, the halves 30 mm apart.
        const std::int64_t row = i / columns;
        x[n + i] = 0.1 * static_cast<double>(std::min(row, rows - 1 - row)) + (row < rows / 2 ? 0.0 : 0.013);
        x[2 * n + i] = (row < rows / 2 ? 0.0 : 0.03) + 0.001 * static_cast<double>(i * 13 % 7);
    }
    std::fill(out.begin(), out.end(), 0.0);
    cloth::plan::FrameRequest frame{};
    // A step with contact allocates several times.
    frame.duration = scene == layers ? 3e-3 : 1e-2, frame.runs = runs,
    frame.steps = scene == layers ? few_steps : steps, frame.weights = weights, frame.bands = 2;
    frame.x0 = x.data(), frame.v0 = v.data(), frame.out = out.data(), frame.result = result.data();
    frame.records = notes.data(), frame.multirate = 1, frame.combined = 2, frame.concurrency = concurrency;
    return cloth_frame(plan, &frame);
}

int main() {
    enum Outcome { reported, unharmed, wrong, failed_later, done };
    for (const Scene scene : {listed, grid, layers})
        for (const std::int64_t concurrency : {1, 2}) {
            std::vector<double> expected(6 * n * runs), out(expected);
            run_frame(make_plan(scene), scene, 1, expected);
            int outcomes[done] = {}, crashed = 0;
            for (long k = 1;; ++k) {
                std::fflush(stdout);
                const pid_t child = fork();
                if (child == 0) {
                    alarm(20);
                    Plan* const plan = make_plan(scene);
                    failing = k;
                    const int first = run_frame(plan, scene, concurrency, out);
                    if (allocated < k) _exit(done);
                    for (int again = 0; again < 2; ++again) {
                        if (run_frame(plan, scene, concurrency, out) != 0) _exit(failed_later);
                        if (out != expected) _exit(wrong);
                    }
                    _exit(first ? reported : unharmed);
                }
                int status = 0;
                waitpid(child, &status, 0);
                if (WIFEXITED(status) && WEXITSTATUS(status) == done) break;
                if (WIFEXITED(status))
                    ++outcomes[WEXITSTATUS(status)];
                else
                    ++crashed;
            }
            std::printf("%s, %s: %d reported, %d crashed, %d wrong, %d failed later\n", names[scene],
                        concurrency > 1 ? "at once" : "in turn", outcomes[reported], crashed, outcomes[wrong],
                        outcomes[failed_later]);
        }
}
