// Rows of a grid of landmarks, blurred along one axis. Products and sums are rounded one by one, in the order of the taps, so
// that all instruction sets give the same bits. A row is cut into segments of 16 values.
#pragma once
#include "simd.h"

namespace GSMAP_ISA {

constexpr int kSegment = 16, kPerSegment = kSegment / W;

// The wanted segments of a row: the sum of taps[k] * rows[k], where a row's flags say that it holds the segment.
void blur_across(const float *const *rows, const uint64_t *filled, const float *taps, int n, uint64_t wanted, float *out) {
    alignas(64) static const float none[kSegment] = {};  // adds nothing: cheaper than a branch that nobody foresees
    for (; wanted; wanted &= wanted - 1) {
        const int s = __builtin_ctzll(wanted);
        V sum[kPerSegment] = {};
        for (int k = 0; k < n; ++k) {
            const float *in = filled[k] >> s & 1 ? rows[k] + kSegment * s : none;
            for (int v = 0; v < kPerSegment; ++v) sum[v] += taps[k] * loadu(in + v * W);
        }
        for (int v = 0; v < kPerSegment; ++v) storeu(out + kSegment * s + v * W, sum[v]);
    }
}

// The wanted segments of a row: the sum of taps[k] * the values k * step after those of `line`.
void blur_along(const float *line, int step, const float *taps, int n, uint64_t wanted, float *out) {
    for (; wanted; wanted &= wanted - 1) {
        const int s = __builtin_ctzll(wanted);
        const float *in = line + kSegment * s;
        V sum[kPerSegment] = {};
        for (int k = 0; k < n; ++k, in += step)
            for (int v = 0; v < kPerSegment; ++v) sum[v] += taps[k] * loadu(in + v * W);
        for (int v = 0; v < kPerSegment; ++v) storeu(out + kSegment * s + v * W, sum[v]);
    }
}

}  // namespace GSMAP_ISA
