// Rows of numbers weighed and added, or their highest: what windows that move over a picture come to, axis by axis.
#pragma once
#include "simd.h"

namespace GSMAP_ISA {

// `kVectors` vectors of sums from i on: as many as hide how long an addition takes.
template <int kVectors>
INLINE void weigh_some(const float *const *rows, const float *weights, int n, int64_t i, float *out) {
    V sum[kVectors] = {};
    for (int k = 0; k < n; ++k) {
        const V weight = set1(weights[k]);
        for (int l = 0; l < kVectors; ++l) sum[l] = fma(weight, loadu(rows[k] + i + l * W), sum[l]);
    }
    for (int l = 0; l < kVectors; ++l) storeu(out + i + l * W, sum[l]);
}

// out[i] = the sum of weights[k] * rows[k][i], in order of k. What is left of a row ends in a vector that overlaps.
void weigh(const float *const *rows, const float *weights, int n, int64_t count, float *out) {
    int64_t i = 0;
    for (; i + 8 * W <= count; i += 8 * W) weigh_some<8>(rows, weights, n, i, out);
    if (i + 4 * W <= count) weigh_some<4>(rows, weights, n, i, out), i += 4 * W;
    if (i + 2 * W <= count) weigh_some<2>(rows, weights, n, i, out), i += 2 * W;
    if (i + W <= count) weigh_some<1>(rows, weights, n, i, out), i += W;
    if (i < count && count >= W) weigh_some<1>(rows, weights, n, count - W, out), i = count;
    for (; i < count; ++i) {
        V sum{};
        for (int k = 0; k < n; ++k) sum = fma(set1(weights[k]), set1(rows[k][i]), sum);
        out[i] = sum[0];
    }
}

// out[i] = the highest of rows[k][i].
void highest(const float *const *rows, int n, int64_t count, float *out) {
    int64_t i = 0;
    for (; i + W <= count; i += W) {
        V most = loadu(rows[0] + i);
        for (int k = 1; k < n; ++k) most = max(most, loadu(rows[k] + i));
        storeu(out + i, most);
    }
    for (; i < count; ++i) {
        float most = rows[0][i];
        for (int k = 1; k < n; ++k) most = most > rows[k][i] ? most : rows[k][i];
        out[i] = most;
    }
}

// Where in [from, to) the middle of nine rows (of three levels, three rows each) is higher than all 26 neighbours and at
// least `bar`, or lower than all and at most -bar. Returns how many. Rows are readable for a vector past `to`.
int peaks(const float *const *rows, float bar, int from, int to, int32_t *found) {
    int count = 0;
    for (int i = from; i < to; i += W) {
        const V own = loadu(rows[4] + i);
        const M live = both(first_lanes(to - i), ge(abs(own), set1(bar)));
        if (!any(live)) continue;
        V most = max(loadu(rows[4] + i - 1), loadu(rows[4] + i + 1));
        V least = min(loadu(rows[4] + i - 1), loadu(rows[4] + i + 1));
        for (int k = 0; k < 9; ++k)
            for (int l = k == 4 ? 2 : -1; l < 2; ++l) {
                const V other = loadu(rows[k] + i + l);
                most = max(most, other), least = min(least, other);
            }
        const M high = both(gt(own, most), gt(own, V{})), low = both(lt(own, least), lt(own, V{}));
        for (uint32_t m = bits(both(live, either(high, low))); m; m &= m - 1) found[count++] = i + __builtin_ctz(m);
    }
    return count;
}

// Lengths and angles in [0, 2 pi) of slopes (dx, dy); angles to a hundredth, as VLFeat's.
void polar(const float *dx, const float *dy, int count, float *__restrict length, float *__restrict angle) {
    for (int i = 0; i < count; ++i) {
        const float x = dx[i], y = dy[i], up = __builtin_fabsf(y) + 1.19209290e-07f;
        const float ratio = x >= 0 ? (x - up) / (x + up) : (x + up) / (up - x);
        const float turn = (x >= 0 ? 0.78539816f : 2.35619449f) + (0.1821f * ratio * ratio - 0.9675f) * ratio;
        length[i] = __builtin_sqrtf(x * x + y * y);
        angle[i] = y < 0 ? 6.28318531f - turn : turn;
    }
}

}  // namespace GSMAP_ISA
