// A small pool of sleeping workers. Ours rather than OpenMP's: torch ships its own libgomp, whose waiting threads spin.
#pragma once
#include <cstdint>
#include <functional>

namespace gsmap {

// Number of threads parallel_for uses, the caller's included (at least 1).
int num_threads();
void set_num_threads(int n);

// Calls body(task, worker) for every task in [0, tasks); worker < num_threads() tells which thread runs it, for scratch.
// Tasks are handed out as threads become free: a result must not depend on which worker ran what.
void parallel_for(int64_t tasks, const std::function<void(int64_t task, int worker)> &body);

}  // namespace gsmap
