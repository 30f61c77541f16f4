// One correspondence against all that come after it: these loops over all pairs are most of what matching computes.
#pragma once
#include "correspondences.h"
#include "simd.h"

namespace GSMAP_ISA {
using namespace gsmap;

// ok[j] = whether i and j agree, for j > i.
void agree(const Correspondences &c, int i, const AgreeTest &test, uint8_t *__restrict ok) {
    const float *tx = c.target[0], *ty = c.target[1], *tz = c.target[2], *th = c.target_heights;
    const float *sx = c.source[0], *sy = c.source[1], *sz = c.source[2], *sh = c.source_heights;
    const float ax = tx[i], ay = ty[i], az = tz[i], bx = sx[i], by = sy[i], bz = sz[i], ah = th[i], bh = sh[i];
    const int32_t *ids_t = c.target_ids, *ids_s = c.source_ids, it = ids_t[i], is = ids_s[i], n = c.n;
    const AgreeTest t = test;
    for (int j = i + 1; j < n; ++j) {
        float x = ax - tx[j], y = ay - ty[j], z = az - tz[j];
        const float dt = __builtin_sqrtf(x * x + y * y + z * z);
        x = bx - sx[j], y = by - sy[j], z = bz - sz[j];
        const float ds = __builtin_sqrtf(x * x + y * y + z * z);
        const float low = dt < ds ? dt : ds, high = dt < ds ? ds : dt;
        const float allowed = t.ratio > 0 ? t.ratio * high : t.slack + t.relative_slack * low;
        const float dh = __builtin_fabsf((ah - th[j]) - (bh - sh[j]));
        ok[j] = (high - low < allowed) & (low >= t.min_distance) & (it != ids_t[j]) & (is != ids_s[j]) &
                (dh < t.height_slack + t.height_slope * high);
    }
}

// bin[j] = where log(|target_i - target_j| / |source_i - source_j|) falls, or -1 where the pair does not vote, for j > i.
void vote(const Correspondences &c, int i, const VoteTest &test, int32_t *__restrict bin) {
    const float *tx = c.target[0], *ty = c.target[1], *tz = c.target[2], *th = c.target_heights;
    const float *sx = c.source[0], *sy = c.source[1], *sz = c.source[2], *sh = c.source_heights;
    const float ax = tx[i], ay = ty[i], az = tz[i], bx = sx[i], by = sy[i], bz = sz[i], ah = th[i], bh = sh[i];
    const int32_t *ids_t = c.target_ids, *ids_s = c.source_ids, it = ids_t[i], is = ids_s[i], n = c.n;
    const VoteTest t = test;
    const float bins = float(t.bins), per_bin = bins / (2 * t.limit);
    for (int j = i + 1; j < n; ++j) {
        float x = ax - tx[j], y = ay - ty[j], z = az - tz[j];
        const float dt = __builtin_sqrtf(x * x + y * y + z * z);
        x = bx - sx[j], y = by - sy[j], z = bz - sz[j];
        const float ds = __builtin_sqrtf(x * x + y * y + z * z);
        // log(dt / ds) = 2 atanh(q), by its series: 1e-6 within a factor of 2, a thousandth within one of 4.
        const float q = (dt - ds) / (dt + ds + 1e-30f), q2 = q * q;
        const float series = 1 / 3.f + q2 * (1 / 5.f + q2 * (1 / 7.f + q2 * (1 / 9.f + q2 / 11.f)));
        const float at = (2 * q * (1 + q2 * series) + t.limit) * per_bin;
        const float slopes = __builtin_fabsf((ah - th[j]) * ds - (bh - sh[j]) * dt);
        const bool use = (dt > t.min_distance) & (ds > t.min_distance) & (it != ids_t[j]) & (is != ids_s[j]) &
                         (slopes <= t.rise_tolerance * dt * ds) & (at >= 0) & (at < bins);
        bin[j] = use ? int32_t(at) : -1;
    }
}

}  // namespace GSMAP_ISA
