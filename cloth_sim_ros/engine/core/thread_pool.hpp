// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Thread pool, kept between calls. No bit depends on the number of threads.
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

#include "core/fpu_guard.hpp"
#include "core/storage.hpp"

namespace cloth::inline core {

inline void pause_briefly() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ __volatile__("yield");
#endif
}

using Clock = std::chrono::steady_clock;

/// Total waiting time of threads for each other in the present run [ns].
inline std::atomic<std::int64_t> wait_time_ns{0};

inline std::int64_t nanoseconds_since(Clock::time_point begin) {
    return std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now() - begin).count();
}

/// Wait for a condition that another thread makes true: spin first, then yield.
template <class F>
inline void wait_until(F&& done) {
    for (int spin = 0; spin < 4000; ++spin) {
        if (done()) return;
        pause_briefly();
    }
    const auto begin = Clock::now();
    while (!done()) sched_yield();
    wait_time_ns.fetch_add(nanoseconds_since(begin), std::memory_order_relaxed);
}

/// Barrier of threads.
class Barrier {
public:
    explicit Barrier(int threads) : threads_(threads) {}
    void wait() {
        const std::int64_t generation = generation_.load(std::memory_order_acquire);
        if (arrived_.fetch_add(1, std::memory_order_acq_rel) + 1 == threads_) {
            arrived_.store(0, std::memory_order_relaxed);
            generation_.store(generation + 1, std::memory_order_release);
        } else {
            wait_until([&] { return generation_.load(std::memory_order_acquire) != generation; });
        }
    }

private:
    const int threads_;
    std::atomic<int> arrived_{0};
    std::atomic<std::int64_t> generation_{0};
};

class ThreadPool {
public:
    static ThreadPool& shared() {
        static ThreadPool* pool = new ThreadPool;  // never destroyed: its threads may outlive static objects
        return *pool;
    }
    /// Call job(0) to job(workers - 1) concurrently, each on a thread of its own. Call `serial` instead if the pool is
    /// busy with another call or no thread can be started. If other processes hold the cores, all threads wait for one
    /// that the system has suspended. After a run in which they waited, in total, for more than a quarter of its time,
    /// the next runs call `serial` too: for as long as that run took, and twice as many times as long after each
    /// further one. Therefore a retry costs little, and the back-off is no longer than the cores were held. No bit of
    /// the result depends on this choice, so a clock may make it.
    template <class Job, class Serial>
    void run(int workers, Job&& job, Serial&& serial) {
        // A serial call releases the lock, so that another call can use the threads.
        std::unique_lock lock(mutex_, std::defer_lock);
        if (workers <= 1 || !lock.try_lock() || is_backing_off() || !ensure_threads(workers - 1)) {
            if (lock) lock.unlock();
            serial();
            return;
        }
        const auto begin = Clock::now();
        wait_time_ns.store(0, std::memory_order_relaxed);
        const Task task = [&](int thread) { job(thread); };
        for (int k = 0; k < workers - 1; ++k) threads_[k]->assign(task);
        job(0);
        for (int k = 0; k < workers - 1; ++k) threads_[k]->wait();
        const auto end = Clock::now();
        const auto duration = end - begin;
        const bool contended = std::chrono::nanoseconds(wait_time_ns.load(std::memory_order_relaxed)) > duration / 4;
        backoff_factor_ = contended ? std::min(std::max(2 * backoff_factor_, 1), 1024) : backoff_factor_ / 2;
        backoff_end_ = contended ? end + backoff_factor_ * duration : end;
    }
    /// Call job(index, worker) for each index below `jobs`, the last one first, on whichever of a number of threads is
    /// free. Threads do not wait for each other: a late one has nothing to do.
    template <class Job>
    void for_each_job(int jobs, int workers, Job&& job) {
        std::unique_lock lock(mutex_, std::defer_lock);
        const int n_workers = workers > 1 && lock.try_lock() && ensure_threads(workers - 1) ? workers - 1 : 0;
        std::atomic<int> remaining{jobs};
        std::vector<std::exception_ptr> exceptions(1 + n_workers);
        const Task task = [&](int worker) {
            try {
                for (int k = --remaining; k >= 0; k = --remaining) job(k, worker);
            } catch (...) {
                exceptions[worker] = std::current_exception();
            }
        };
        for (int k = 0; k < n_workers; ++k) threads_[k]->assign(task);
        task(0);
        for (int k = 0; k < n_workers; ++k)
            if (!threads_[k]->revoke(task)) threads_[k]->wait();
        for (const std::exception_ptr& exception : exceptions)
            if (exception) std::rethrow_exception(exception);
    }

private:
    using Task = std::function<void(int)>;

    /// Whether runs avoid threads, after one that mostly waited.
    bool is_backing_off() const { return backoff_factor_ > 0 && Clock::now() < backoff_end_; }

    struct Worker {
        /// The task; `running` while it is executed; null afterwards.
        std::atomic<const Task*> task{nullptr};
        std::thread thread;

        void assign(const Task& new_task) {
            task.store(&new_task, std::memory_order_release);
            task.notify_one();
        }
        /// Revoke a task. Return whether it has not been started.
        bool revoke(const Task& assigned) {
            const Task* expected = &assigned;
            return task.compare_exchange_strong(expected, nullptr, std::memory_order_acq_rel);
        }
        void wait() {
            wait_until([&] { return task.load(std::memory_order_acquire) == nullptr; });
        }
    };

    bool ensure_threads(int count) {
        if (process_ != getpid()) {
            // A forked child has none of its parent's threads; their descriptions are abandoned.
            for (auto& worker : threads_) static_cast<void>(worker.release());
            threads_.clear();
            process_ = getpid();
        }
        try {
            threads_.reserve(count);
            while (static_cast<int>(threads_.size()) < count) {
                auto worker = std::make_unique<Worker>();
                Worker* const state = worker.get();
                const int index = static_cast<int>(threads_.size()) + 1;
                worker->thread = std::thread([state, index] { worker_loop(*state, index); });
                worker->thread.detach();
                threads_.push_back(std::move(worker));
            }
        } catch (const std::system_error&) {
            return false;
        }
        return true;
    }
    [[noreturn]] static void worker_loop(Worker& state, int index) {
        static const Task running;
        const FpuGuard rounding;
        for (;;) {
            const Task* task = nullptr;
            // Runs of one frame follow each other closely: a sleeping thread would be late for each.
            for (int spin = 0; spin < 5000 && !task; ++spin) {
                task = state.task.load(std::memory_order_acquire);
                if (!task) pause_briefly();
            }
            if (!task) {
                state.task.wait(nullptr, std::memory_order_acquire);
                continue;
            }
            const Task* expected = task;
            if (!state.task.compare_exchange_strong(expected, &running, std::memory_order_acq_rel)) continue;
            (*task)(index);
            state.task.store(nullptr, std::memory_order_release);
        }
    }

    std::mutex mutex_;
    std::vector<std::unique_ptr<Worker>> threads_;
    /// Runs avoid threads until `backoff_end_`: `backoff_factor_` times the duration of the run before. The factor
    /// doubles, from 1 to at most 1024, with each run that waits too long and halves with each that does not.
    Clock::time_point backoff_end_;
    int backoff_factor_ = 0;
    pid_t process_ = getpid();
};

}  // namespace cloth::inline core
