// The parts of an optimisation step beside rendering: Adam and the image losses.
#pragma once
#include "rasteriser.h"
#include "simd.h"

namespace GSMAP_ISA {
using namespace gsmap;

// Kingma & Ba 2015; every Gaussian counts its own updates, so one that no camera saw stays as it is. The number of
// columns is known where it is compiled, so that a row is a few vectors.
template <int kCols>
void adam_rows(const AdamArrays &a, const AdamStep &step, int64_t begin, int n, const uint8_t *touched, float *gradient) {
    const float b1 = step.beta1, b2 = step.beta2;
    float rates[kCols];
    for (int j = 0; j < kCols; j++) rates[j] = j < 3 ? a.rate : a.rate_rest;
    for (int i = 0; i < n; i++) {
        if (!touched[i]) continue;
        const int64_t at = (begin + i) * kCols;
        float *__restrict p = a.value + at, *__restrict m = a.m + at, *__restrict v = a.v + at;
        float *__restrict g = gradient + int64_t(i) * kCols;
        const float *c = step.corrections + 2 * int64_t(step.updates[begin + i]), first = c[0], second = c[1];
        for (int j = 0; j < kCols; j++) {
            const float gj = g[j];
            m[j] = b1 * m[j] + (1.f - b1) * gj;
            v[j] = b2 * v[j] + (1.f - b2) * gj * gj;
            p[j] -= rates[j] * first * m[j] / (__builtin_sqrtf(v[j]) * second + step.epsilon);
            g[j] = 0.f;
        }
    }
}

void adam(const AdamArrays &a, const AdamStep &step, int64_t begin, int n, const uint8_t *touched, float *gradient) {
    switch (a.cols) {
        case 1: return adam_rows<1>(a, step, begin, n, touched, gradient);
        case 3: return adam_rows<3>(a, step, begin, n, touched, gradient);
        case 4: return adam_rows<4>(a, step, begin, n, touched, gradient);
        case 12: return adam_rows<12>(a, step, begin, n, touched, gradient);
        case 27: return adam_rows<27>(a, step, begin, n, touched, gradient);
        default: return adam_rows<48>(a, step, begin, n, touched, gradient);
    }
}

// |d| - delta / 2, and d^2 / (2 delta) where |d| < delta; of a delta of 0 the slope at 0 is 0: L1.
float huber(const float *a, const float *b, const float *mask, int pixels, float delta, float weight, float *g) {
    const float inverse = delta > 0.f ? 1.f / delta : 0.f;
    float sum = 0.f;
    for (int i = 0; i < pixels; i++) {
        const float w = mask ? mask[i] : 1.f;
        for (int c = 0; c < 3; c++) {
            const float d = a[3 * i + c] - b[3 * i + c], size = __builtin_fabsf(d);
            const bool near = size < delta;
            sum += w * (near ? 0.5f * inverse * d * d : size - 0.5f * delta);
            const float slope = near ? inverse * size : d == 0.f ? 0.f : 1.f;
            g[3 * i + c] += __builtin_copysignf(w * weight * slope, d);
        }
    }
    return sum;
}

// Structural similarity as Wang et al. 2004: windows are a Gaussian of sigma 1.5 and 11 taps. All three channels at once,
// in rows of 3 * width values, where the neighbours of a channel lie 3 apart; outside the image all is zero. A row is
// blurred as soon as the five rows after it are known, so that no more than 11 rows of anything are held, in the cache.
constexpr float kWindow[kSsimTaps] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601173f,
                                      0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};

INLINE V along_row(const float *row) {  // blurred at row[0] to row[W - 1]
    V sum{};
    for (int j = 0; j < kSsimTaps; j++) sum = fma(set1(kWindow[j]), loadu(row + 3 * (j - kSsimReach)), sum);
    return sum;
}

void ssim(const SsimTask &task, float *scratch) {
    constexpr float c1 = 0.01f * 0.01f, c2 = 0.03f * 0.03f;
    const int n = 3 * task.width, stride = int(ssim_stride(task.width));
    float *at = scratch, *inputs[2][kSsimTaps], *slopes[3][kSsimTaps], *blurred[5], *weights;
    auto take = [&](float *&row) { row = at, at += stride; };
    for (auto &rows : inputs)
        for (auto &row : rows) take(row);
    for (auto &rows : slopes)
        for (auto &row : rows) take(row);
    for (auto &row : blurred) take(row), row += kSsimPad;
    take(weights);
    __builtin_memset(scratch, 0, sizeof(float) * (at - scratch));
    auto slot = [](int row) { return (row + 2 * kSsimTaps) % kSsimTaps; };
    auto in_image = [&](int row) { return row >= 0 && row < task.height; };

    for (int r = task.from - 2 * kSsimReach; r < task.to + 2 * kSsimReach; r++) {
        const float *images[2] = {task.a, task.b};
        for (int k = 0; k < 2; k++) {
            float *row = inputs[k][slot(r)];
            if (in_image(r))
                __builtin_memcpy(row, images[k] + int64_t(r) * n, sizeof(float) * n);
            else
                __builtin_memset(row, 0, sizeof(float) * n);
        }
        const int middle = r - kSsimReach;  // all rows of its window are there now
        if (middle < task.from - kSsimReach) continue;
        float *da = slopes[0][slot(middle)], *daa = slopes[1][slot(middle)], *dab = slopes[2][slot(middle)];
        if (!in_image(middle)) {
            for (auto &rows : slopes) __builtin_memset(rows[slot(middle)], 0, sizeof(float) * n);
        } else {
            for (int i = 0; i < n; i += W) {
                V a{}, b{}, aa{}, bb{}, ab{};
                for (int j = 0; j < kSsimTaps; j++) {
                    const int from = slot(middle + j - kSsimReach);
                    const V x = loadu(inputs[0][from] + i), y = loadu(inputs[1][from] + i);
                    const V wx = x * kWindow[j], wy = y * kWindow[j];
                    a += wx, b += wy, aa = fma(wx, x, aa), bb = fma(wy, y, bb), ab = fma(wx, y, ab);
                }
                storeu(blurred[0] + i, a), storeu(blurred[1] + i, b), storeu(blurred[2] + i, aa);
                storeu(blurred[3] + i, bb), storeu(blurred[4] + i, ab);
            }
            for (int k = 0; k < 5; k++)  // what the last vector wrote beyond the row
                __builtin_memset(blurred[k] + n, 0, sizeof(float) * kSsimPad);
            for (int x = 0; x < task.width; x++) {
                const float w = task.mask ? task.mask[int64_t(middle) * task.width + x] : 1.f;
                weights[3 * x] = weights[3 * x + 1] = weights[3 * x + 2] = w;
            }
            V sum{};
            for (int i = 0; i < n; i += W) {
                const V ma = along_row(blurred[0] + i), mb = along_row(blurred[1] + i), w = loadu(weights + i);
                const V va = fnma(ma, ma, along_row(blurred[2] + i)), vb = fnma(mb, mb, along_row(blurred[3] + i));
                const V cov = fnma(ma, mb, along_row(blurred[4] + i));
                const V l = 2.f * ma * mb + c1, s = 2.f * cov + c2, dl = ma * ma + mb * mb + c1, ds = va + vb + c2;
                const V inverse = 1.f / (dl * ds), value = l * s * inverse;
                const V d_cov = 2.f * l * inverse, d_var = -value * inverse * dl;
                sum = fma(w, value, sum);
                storeu(da + i, w * (2.f * mb * s * inverse - 2.f * ma * value * inverse * ds - d_cov * mb - 2.f * d_var * ma));
                storeu(daa + i, w * d_var);
                storeu(dab + i, w * d_cov);
            }
            if (middle >= task.from && middle < task.to) {
                float total = 0.f;
                for (int lane = 0; lane < W; lane++) total += sum[lane];
                task.sums[middle] = total;
            }
        }
        const int row = middle - kSsimReach;  // all that its gradient is made of is there now
        if (row < task.from) continue;
        for (int k = 0; k < 3; k++) {
            for (int i = 0; i < n; i += W) {
                V sum{};
                for (int j = 0; j < kSsimTaps; j++)
                    sum = fma(set1(kWindow[j]), loadu(slopes[k][slot(row + j - kSsimReach)] + i), sum);
                storeu(blurred[k] + i, sum);
            }
            __builtin_memset(blurred[k] + n, 0, sizeof(float) * kSsimPad);
        }
        const float *a = inputs[0][slot(row)], *b = inputs[1][slot(row)];
        float *g = task.gradient + int64_t(row) * n;
        for (int i = 0; i < n; i += W) {
            const V by_a = along_row(blurred[0] + i), by_aa = along_row(blurred[1] + i), by_ab = along_row(blurred[2] + i);
            const V add = task.scale * fma(loadu(b + i), by_ab, fma(2.f * loadu(a + i), by_aa, by_a));
            if (i + W <= n) {
                storeu(g + i, loadu(g + i) + add);
            } else {
                for (int lane = 0; i + lane < n; lane++) g[i + lane] += add[lane];
            }
        }
    }
}

}  // namespace GSMAP_ISA
