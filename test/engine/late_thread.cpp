// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Runs of two threads, one of which is late on purpose. Prints whether each later run used two threads.
#include <cstdio>

#include "core/thread_pool.hpp"

namespace {

using std::chrono::milliseconds;

/// Execute a run; return its number of threads. The second thread is late by `late`; `duration` is set to its time.
int run(milliseconds work, milliseconds late, cloth::Clock::duration* duration = nullptr) {
    std::atomic<int> threads{0};
    const auto begin = cloth::Clock::now();
    cloth::ThreadPool::shared().run(
        2,
        [&](int thread) {
            std::this_thread::sleep_for(thread == 1 ? work + late : work);
            ++threads;
        },
        [&] { threads = 1; });
    if (duration) *duration = cloth::Clock::now() - begin;
    return threads;
}

/// Reset the back-off of the pool.
void settle() {
    for (int together = 0; together < 12;) together = run(milliseconds{10}, milliseconds{0}) == 2 ? together + 1 : 0;
}

/// A number of late runs in a row, then one run after half of the back-off and one after all of it. Return false if the
/// machine itself was too late for a valid result.
bool trial(int late) {
    constexpr milliseconds min_wait{100}, none{0};
    const int times = 1 << (late - 1);
    cloth::Clock::duration duration{};
    settle();
    for (int k = 0; k < late; ++k) {
        if (k > 0) std::this_thread::sleep_for(duration * (1 << (k - 1)));
        if (run(none, min_wait, &duration) != 2) return false;
    }
    const auto end = cloth::Clock::now();
    std::this_thread::sleep_until(end + min_wait * times / 2);
    const int meanwhile = run(none, none);
    // The back-off is at least the time slept, and at most the time measured.
    if (cloth::Clock::now() - end >= min_wait * times) return false;
    std::this_thread::sleep_until(end + duration * times);
    const int later = run(none, none);
    std::printf("%d late: %d meanwhile, %d later\n", late, meanwhile, later);
    return true;
}

}  // namespace

int main() {
    for (int late = 1; late <= 3; ++late) {
        int tries = 0;
        while (!trial(late))
            if (++tries == 10) return 1;
    }
}
