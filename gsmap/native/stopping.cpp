// Ends a process that was told to stop and does not: see gsmap/cli/stopping.py.
//
// A thread without the interpreter, since libraries keep that to themselves while they compute.
#include <nanobind/nanobind.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/string.h>

#include <atomic>
#include <cerrno>
#include <chrono>
#include <csignal>
#include <map>
#include <memory>
#include <string>
#include <thread>

#include <poll.h>
#include <unistd.h>

namespace nb = nanobind;

namespace {

struct State {
    int ears;
    std::chrono::milliseconds grace;
    std::map<int, std::string> lines;
    std::atomic<bool> said{false};
};

using Clock = std::chrono::steady_clock;

// The next signal that asks to stop: its number; 0 at the end of the pipe; -1 where none comes in time.
int hear(const State &state, Clock::time_point until) {
    for (;;) {
        pollfd pipe{state.ears, POLLIN, 0};
        int wait_ms = -1;
        if (until != Clock::time_point::max()) {
            const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(until - Clock::now()).count();
            wait_ms = left > 0 ? static_cast<int>(left) : 0;
        }
        const int found = poll(&pipe, 1, wait_ms);
        if (found == 0) return -1;
        if (found < 0 && errno == EINTR) continue;
        unsigned char signum;
        const ssize_t got = read(state.ears, &signum, 1);
        if (got == 1 && state.lines.count(signum)) return signum;
        if (got == 0 || (got < 0 && errno != EINTR)) return 0;
    }
}

void watch(const std::shared_ptr<State> &state) {
    const int signum = hear(*state, Clock::time_point::max());
    // Another signal ends it now; the end of the pipe says that the first was taken for an answer.
    if (signum == 0 || hear(*state, Clock::now() + state->grace) == 0) {
        close(state->ears);
        return;
    }
    pollfd out{STDERR_FILENO, POLLOUT, 0};
    if (!state->said.exchange(true) && poll(&out, 1, 0) > 0) {
        const std::string &line = state->lines.at(signum);
        [[maybe_unused]] const ssize_t told = write(STDERR_FILENO, line.data(), line.size());
    }
    _exit(128 + signum);
}

struct Watch {
    std::shared_ptr<State> state = std::make_shared<State>();

    Watch(int ears, double grace_s, std::map<int, std::string> lines) {
        state->ears = ears;
        state->grace = std::chrono::milliseconds(static_cast<int>(grace_s * 1000));
        state->lines = std::move(lines);
        sigset_t all, before;  // signals are for the other threads
        sigfillset(&all);
        pthread_sigmask(SIG_SETMASK, &all, &before);
        std::thread([state = state] { watch(state); }).detach();
        pthread_sigmask(SIG_SETMASK, &before, nullptr);
    }
};

}  // namespace

namespace gsmap {
void bind_stopping(nb::module_ &m) {
    nb::class_<Watch>(m, "StopWatch", "Ends the process some time after the number of a signal comes from a pipe.")
        .def(nb::init<int, double, std::map<int, std::string>>(), nb::arg("ears"), nb::arg("grace_s"), nb::arg("lines"),
             "Reads from `ears`, which it closes; at the first signal that has a line, waits for another one or\n"
             "`grace_s` seconds, writes its line to stderr and exits with 128 + its number.")
        .def("claim", [](Watch &self) { return !self.state->said.exchange(true); },
             "Whether the caller is the first, and so the one to write a line.");
}
}  // namespace gsmap
