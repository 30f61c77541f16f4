// A small pool of sleeping workers. Ours rather than OpenMP's: torch ships its own libgomp, whose waiting threads spin.
#pragma once
#include <cstdint>
#include <functional>

namespace gsmap {

// Number of threads parallel_for uses, the caller's included (at least 1).
int num_threads();
void set_num_threads(int n);

// Calls body(task) for every task in [0, tasks). Tasks are handed out as threads become free: a result must not depend
// on which thread ran what. Scratch belongs in thread_local variables. A call from inside a body runs alone.
void parallel_for(int64_t tasks, const std::function<void(int64_t task)> &body);

}  // namespace gsmap
