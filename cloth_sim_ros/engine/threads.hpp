// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// A few threads that are kept between calls. No bit depends on how many there are.
#pragma once

#include <sched.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>

#include "storage.hpp"

namespace cloth {

inline void pause_briefly() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ __volatile__("yield");
#endif
}

using Clock = std::chrono::steady_clock;

/// Time that threads of the present run have waited for each other beyond a moment [ns].
inline std::atomic<std::int64_t> waited{0};

inline std::int64_t since(Clock::time_point begin) {
    return std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now() - begin).count();
}

/// Wait until a condition that another thread makes true: at first without leaving the core.
template <class F>
inline void wait_until(F&& done) {
    for (int tries = 0; tries < 4000; ++tries) {
        if (done()) return;
        pause_briefly();
    }
    const auto begin = Clock::now();
    while (!done()) sched_yield();
    waited.fetch_add(since(begin), std::memory_order_relaxed);
}

/// Threads that wait for each other.
class Barrier {
public:
    explicit Barrier(int threads) : threads_(threads) {}
    void wait() {
        const std::int64_t turn = turn_.load(std::memory_order_acquire);
        if (come_.fetch_add(1, std::memory_order_acq_rel) + 1 == threads_) {
            come_.store(0, std::memory_order_relaxed);
            turn_.store(turn + 1, std::memory_order_release);
        } else {
            wait_until([&] { return turn_.load(std::memory_order_acquire) != turn; });
        }
    }

private:
    const int threads_;
    std::atomic<int> come_{0};
    std::atomic<std::int64_t> turn_{0};
};

class Pool {
public:
    static Pool& shared() {
        static Pool* pool = new Pool;  // never destroyed: its threads may outlive static objects
        return *pool;
    }
    /// Call job(0) to job(workers - 1) at once, each on a thread of its own. Call `alone` instead where the pool is
    /// busy with another call or no thread can be started. Where other processes hold the cores, all threads wait for one
    /// that the system has suspended: after a run in which they waited, all together, for more than a quarter of its time,
    /// the next runs call `alone` too. They do so as long as that run took, and after each further one twice as many times
    /// as long: what is lost by trying stays small, and what is lost by not trying is no more than the cores were held. No
    /// bit of the result depends on this choice, so a clock may make it.
    template <class Job, class Alone>
    void run(int workers, Job&& job, Alone&& alone) {
        // A call that works alone releases the lock, so that another call can use the threads.
        std::unique_lock lock(mutex_, std::defer_lock);
        if (workers <= 1 || !lock.try_lock() || rests() || !grow(workers - 1)) {
            if (lock) lock.unlock();
            alone();
            return;
        }
        const auto begin = Clock::now();
        waited.store(0, std::memory_order_relaxed);
        const Work work = [&](int number) { job(number); };
        for (int k = 0; k < workers - 1; ++k) threads_[k]->give(work);
        job(0);
        for (int k = 0; k < workers - 1; ++k) threads_[k]->wait();
        const auto end = Clock::now();
        const auto took = end - begin;
        const bool busy = std::chrono::nanoseconds(waited.load(std::memory_order_relaxed)) > took / 4;
        times_ = busy ? std::min(std::max(2 * times_, 1), 1024) : times_ / 2;
        rested_ = busy ? end + times_ * took : end;
    }
    /// Call job(number, worker) for each number below `jobs`, the last one first, each on whichever of so many threads is
    /// free. They do not wait for each other: one that the system is late to start has nothing to do then.
    template <class Job>
    void share(int jobs, int workers, Job&& job) {
        std::unique_lock lock(mutex_, std::defer_lock);
        const int others = workers > 1 && lock.try_lock() && grow(workers - 1) ? workers - 1 : 0;
        std::atomic<int> left{jobs};
        std::vector<std::exception_ptr> troubles(1 + others);
        const Work work = [&](int worker) {
            try {
                for (int k = --left; k >= 0; k = --left) job(k, worker);
            } catch (...) {
                troubles[worker] = std::current_exception();
            }
        };
        for (int k = 0; k < others; ++k) threads_[k]->give(work);
        work(0);
        for (int k = 0; k < others; ++k)
            if (!threads_[k]->take_back(work)) threads_[k]->wait();
        for (const std::exception_ptr& trouble : troubles)
            if (trouble) std::rethrow_exception(trouble);
    }

private:
    using Work = std::function<void(int)>;

    /// Whether a run is to do without threads, after one that mostly waited.
    bool rests() const { return times_ > 0 && Clock::now() < rested_; }

    struct Worker {
        /// What is to be done; `begun` while it is; null once it has been.
        std::atomic<const Work*> work{nullptr};
        std::thread thread;

        void give(const Work& what) {
            work.store(&what, std::memory_order_release);
            work.notify_one();
        }
        /// Whether what was given has not been begun, and will not be.
        bool take_back(const Work& what) {
            const Work* given = &what;
            return work.compare_exchange_strong(given, nullptr, std::memory_order_acq_rel);
        }
        void wait() {
            wait_until([&] { return work.load(std::memory_order_acquire) == nullptr; });
        }
    };

    bool grow(int count) {
        if (process_ != getpid()) {
            // A forked child has none of its parent's threads; what describes them is left behind.
            for (auto& worker : threads_) static_cast<void>(worker.release());
            threads_.clear();
            process_ = getpid();
        }
        try {
            threads_.reserve(count);
            while (static_cast<int>(threads_.size()) < count) {
                auto worker = std::make_unique<Worker>();
                Worker* const own = worker.get();
                const int number = static_cast<int>(threads_.size()) + 1;
                worker->thread = std::thread([own, number] { serve(*own, number); });
                worker->thread.detach();
                threads_.push_back(std::move(worker));
            }
        } catch (const std::system_error&) {
            return false;
        }
        return true;
    }
    [[noreturn]] static void serve(Worker& own, int number) {
        static const Work begun;
        const Ieee rounding;
        for (;;) {
            const Work* work = nullptr;
            // Runs of one frame follow each other closely: a thread that slept would be late for each.
            for (int tries = 0; tries < 5000 && !work; ++tries) {
                work = own.work.load(std::memory_order_acquire);
                if (!work) pause_briefly();
            }
            if (!work) {
                own.work.wait(nullptr, std::memory_order_acquire);
                continue;
            }
            const Work* given = work;
            if (!own.work.compare_exchange_strong(given, &begun, std::memory_order_acq_rel)) continue;
            (*work)(number);
            own.work.store(nullptr, std::memory_order_release);
        }
    }

    std::mutex mutex_;
    std::vector<std::unique_ptr<Worker>> threads_;
    /// Runs do without threads until `rested_`: `times_` as long as the one before took. That number doubles, from 1 to at
    /// most 1024, with each run that waits too long and halves with each that does not.
    Clock::time_point rested_{};
    int times_ = 0;
    pid_t process_ = getpid();
};

}  // namespace cloth
