#include "threads.h"

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace gsmap {
namespace {

struct Job {
    const std::function<void(int64_t)> *body;
    int64_t tasks;
    std::atomic<int64_t> next{0};
    std::atomic<bool> failed{false};
    std::exception_ptr error;

    void work() {
        for (int64_t t; !failed && (t = next++) < tasks;) {
            try {
                (*body)(t);
            } catch (...) {
                if (!failed.exchange(true)) error = std::current_exception();
            }
        }
    }
};

class Pool {
  public:
    explicit Pool(int extra) {
        for (int i = 0; i < extra; i++) threads_.emplace_back([this] { loop(); });
    }
    ~Pool() {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            quit_ = true;
        }
        wake_.notify_all();
        for (auto &t : threads_) t.join();
    }
    void run(Job &job) {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            job_ = &job;
            generation_++;
            busy_ = static_cast<int>(threads_.size());
        }
        wake_.notify_all();
        job.work();
        std::unique_lock<std::mutex> lock(mutex_);
        done_.wait(lock, [this] { return busy_ == 0; });
        job_ = nullptr;
    }
    const int pid = getpid();  // threads do not survive a fork; the child makes its own pool

  private:
    void loop() {
        uint64_t seen = 0;
        std::unique_lock<std::mutex> lock(mutex_);
        for (;;) {
            wake_.wait(lock, [&] { return quit_ || generation_ != seen; });
            if (quit_) return;
            seen = generation_;
            Job *job = job_;
            lock.unlock();
            job->work();
            lock.lock();
            if (--busy_ == 0) done_.notify_one();
        }
    }
    std::mutex mutex_;
    std::condition_variable wake_, done_;
    std::vector<std::thread> threads_;
    Job *job_ = nullptr;
    uint64_t generation_ = 0;
    int busy_ = 0;
    bool quit_ = false;
};

std::atomic<int> wanted{1};
std::mutex entry;      // one parallel region at a time; a second caller runs alone
Pool *pool = nullptr;  // leaked at exit on purpose: joining from a static destructor can deadlock
int pool_size = 0;

}  // namespace

int num_threads() { return wanted; }
void set_num_threads(int n) { wanted = n < 1 ? 1 : n; }

void parallel_for(int64_t tasks, const std::function<void(int64_t)> &body) {
    Job job;
    job.body = &body;
    job.tasks = tasks;
    const int size = wanted;
    std::unique_lock<std::mutex> lock(entry, std::defer_lock);
    if (size > 1 && tasks > 1 && lock.try_lock()) {
        if (pool && pool->pid != getpid()) pool = nullptr;
        if (!pool || pool_size != size) {
            delete pool;
            pool = nullptr;
            pool = new Pool(size - 1);
            pool_size = size;
        }
        pool->run(job);
    } else {
        job.work();
    }
    if (job.error) std::rethrow_exception(job.error);
}

}  // namespace gsmap
