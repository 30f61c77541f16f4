// Runs CUDA kernels on the CPU: every thread of a block is a fiber, blocks run one after the other. Warps exchange values
// in two buffers in turn; a thread waits until all threads of its warp or block that have not returned have come.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <vector>

#define __global__
#define __device__
#define __shared__ static
#define __forceinline__ inline
#define __launch_bounds__(...)
using std::isfinite;
using std::max;

struct float4 {
    float x, y, z, w;
};
struct Dim {
    unsigned x;
};
static Dim threadIdx, blockIdx, blockDim, gridDim;

namespace emulation {

constexpr int kStack = 1 << 17, kWarp = 32;

struct Meeting {  // of the threads of a warp or block
    int expected = 0, arrived = 0;
    uint64_t round = 0;
    uint32_t values[2][1024];
    bool there[2][1024];
};

struct Thread {
    ucontext_t context;
    jmp_buf jump;
    bool started = false, done = false;
    std::vector<char> stack = std::vector<char>(kStack);
};

inline std::vector<Thread> threads;
inline std::vector<Meeting> warps;
inline Meeting block;
inline jmp_buf scheduler;
inline int current;
inline std::function<void()> body;

inline void finish(Meeting &m) {  // all that are still running have come
    if (m.expected && m.arrived == m.expected) m.arrived = 0, m.round++;
}

inline void enter() {
    body();
    threads[current].done = true;
    Meeting &warp = warps[current / kWarp];
    warp.expected--, block.expected--;
    finish(warp), finish(block);
    _longjmp(scheduler, 1);
}

inline void yield() {
    if (!_setjmp(threads[current].jump)) _longjmp(scheduler, 1);
    threadIdx.x = current;
}

// Meets the others; returns which of the two buffers holds what they brought.
inline int meet(Meeting &m, int place, uint32_t value) {
    const uint64_t round = m.round;
    const int side = round & 1;
    if (m.arrived == 0) std::memset(m.there[side], 0, sizeof m.there[side]);
    m.values[side][place] = value, m.there[side][place] = true, m.arrived++;
    finish(m);
    while (m.round == round) yield();
    return side;
}

inline Meeting &warp() { return warps[current / kWarp]; }
inline int lane() { return current % kWarp; }

inline void run(unsigned grid, unsigned size, std::function<void()> kernel) {
    body = std::move(kernel);
    gridDim = {grid}, blockDim = {size};
    if (threads.size() < size) threads.resize(size);
    for (unsigned b = 0; b < grid; b++) {
        blockIdx = {b};
        warps.assign((size + kWarp - 1) / kWarp, {});
        block = {};
        block.expected = int(size);
        for (unsigned i = 0; i < size; i++) warps[i / kWarp].expected++, threads[i].started = threads[i].done = false;
        for (volatile unsigned left = size; left;) {
            left = 0;
            for (volatile unsigned i = 0; i < size; i++) {
                Thread &t = threads[i];
                if (t.done) continue;
                current = int(i), threadIdx = {i};
                if (!_setjmp(scheduler)) {
                    if (t.started) _longjmp(t.jump, 1);
                    t.started = true;
                    getcontext(&t.context);
                    t.context.uc_stack = {t.stack.data(), 0, t.stack.size()};
                    t.context.uc_link = nullptr;
                    makecontext(&t.context, enter, 0);
                    setcontext(&t.context);
                }
                if (!t.done) left = left + 1;
            }
        }
    }
}

}  // namespace emulation

inline void __syncthreads() { emulation::meet(emulation::block, emulation::current, 0); }
inline void __syncwarp() { emulation::meet(emulation::warp(), emulation::lane(), 0); }
template <class T> T from_lane(T value, int lane) {
    static_assert(sizeof(T) == 4);
    uint32_t bits;
    std::memcpy(&bits, &value, 4);
    emulation::Meeting &warp = emulation::warp();
    const int side = emulation::meet(warp, emulation::lane(), bits);
    std::memcpy(&value, &warp.values[side][lane], 4);
    return value;
}
template <class T> T __shfl_xor_sync(unsigned, T value, int step) { return from_lane(value, emulation::lane() ^ step); }
inline unsigned __ballot_sync(unsigned, bool value) {
    emulation::Meeting &warp = emulation::warp();
    const int side = emulation::meet(warp, emulation::lane(), value);
    unsigned out = 0;
    for (int i = 0; i < emulation::kWarp; i++)
        if (warp.there[side][i] && warp.values[side][i]) out |= 1u << i;
    return out;
}
inline bool __syncthreads_or(bool value) {
    emulation::Meeting &block = emulation::block;
    const int side = emulation::meet(block, emulation::current, value);
    for (unsigned i = 0; i < blockDim.x; i++)
        if (block.there[side][i] && block.values[side][i]) return true;
    return false;
}
inline bool __any_sync(unsigned all, bool value) { return __ballot_sync(all, value) != 0; }
inline int __ffs(unsigned value) { return __builtin_ffs(int(value)); }
inline int __float_as_int(float value) {
    int out;
    std::memcpy(&out, &value, 4);
    return out;
}
inline float __int_as_float(int value) {
    float out;
    std::memcpy(&out, &value, 4);
    return out;
}
inline float __fdividef(float a, float b) { return a / b; }
inline void atomicAdd(float *to, float value) { *to += value; }
inline void atomicMax(int *to, int value) { *to = *to < value ? value : *to; }
