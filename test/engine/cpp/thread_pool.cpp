// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Thread pool: each job once, exceptions, and the choice of serial calls.
#include "core/thread_pool.hpp"

#include <array>
#include <set>
#include <stdexcept>

#include "doctest/doctest.h"

namespace cloth::tests {

namespace {

/// Call `attempt` until it returns true, at most ten seconds long: a busy machine makes the pool avoid its threads.
template <class F>
bool succeeds(F&& attempt) {
    const auto end = Clock::now() + std::chrono::seconds(10);
    while (Clock::now() < end)
        if (attempt()) return true;
    return false;
}

}  // namespace

TEST_CASE("a run calls each job once on a thread of its own, or the serial job") {
    CHECK(succeeds([] {
        std::array<std::atomic<int>, 4> calls{};
        std::array<std::thread::id, 4> threads;
        int serial_calls = 0;
        ThreadPool::shared().run(
            4,
            [&](int thread) {
                ++calls[thread];
                threads[thread] = std::this_thread::get_id();
            },
            [&] { ++serial_calls; });
        for (const auto& count : calls) CHECK(count == 1 - serial_calls);
        if (serial_calls) return false;
        CHECK(std::set<std::thread::id>(threads.begin(), threads.end()).size() == 4);
        CHECK(threads[0] == std::this_thread::get_id());
        return true;
    }));
}

TEST_CASE("one worker is serial") {
    int jobs = 0, serial_calls = 0;
    ThreadPool::shared().run(1, [&](int) { ++jobs; }, [&] { ++serial_calls; });
    CHECK(jobs == 0);
    CHECK(serial_calls == 1);
}

TEST_CASE("a run within another thread's run is serial") {
    CHECK(succeeds([] {
        std::atomic<int> inner_jobs{0}, inner_serial_calls{0};
        bool threaded = true;
        ThreadPool::shared().run(
            2,
            [&](int thread) {
                if (thread == 1) ThreadPool::shared().run(2, [&](int) { ++inner_jobs; }, [&] { ++inner_serial_calls; });
            },
            [&] { threaded = false; });
        if (!threaded) return false;
        CHECK(inner_jobs == 0);
        CHECK(inner_serial_calls == 1);
        return true;
    }));
}

TEST_CASE("jobs of any number are called once each, by workers below their number") {
    for (const int workers : {1, 2, 3, 5})
        for (const int jobs : {0, 1, 2, 100}) {
            std::vector<std::atomic<int>> calls(jobs);
            std::atomic<bool> within{true};
            ThreadPool::shared().for_each_job(jobs, workers, [&](int k, int worker) {
                ++calls[k];
                if (worker < 0 || worker >= workers) within = false;
            });
            for (const auto& count : calls) CHECK(count == 1);
            CHECK(within);
        }
}

TEST_CASE("one worker takes the last job first") {
    std::vector<int> order;
    ThreadPool::shared().for_each_job(4, 1, [&](int k, int) { order.push_back(k); });
    CHECK(order == std::vector<int>{3, 2, 1, 0});
}

TEST_CASE("an exception of a job reaches the caller, and the pool stays usable") {
    for (const int workers : {1, 3}) {
        for (int round = 0; round < 20; ++round) {
            const auto failing = [&](int k, int) {
                if (k == 5) throw std::runtime_error("job 5");
            };
            CHECK_THROWS_WITH_AS(ThreadPool::shared().for_each_job(10, workers, failing), "job 5", std::runtime_error);
        }
        std::atomic<int> calls{0};
        ThreadPool::shared().for_each_job(10, workers, [&](int, int) { ++calls; });
        CHECK(calls == 10);
    }
}

TEST_CASE("no thread passes a barrier before all have arrived") {
    constexpr int n_threads = 3, phases = 200;
    Barrier barrier(n_threads);
    std::atomic<int> arrived{0};
    std::atomic<bool> early{false};
    const auto work = [&] {
        for (int phase = 1; phase <= phases; ++phase) {
            ++arrived;
            barrier.wait();
            if (arrived < phase * n_threads) early = true;
            barrier.wait();
        }
    };
    std::vector<std::thread> threads;
    for (int k = 1; k < n_threads; ++k) threads.emplace_back(work);
    work();
    for (std::thread& thread : threads) thread.join();
    CHECK_FALSE(early);
    CHECK(arrived == n_threads * phases);
}

}  // namespace cloth::tests
