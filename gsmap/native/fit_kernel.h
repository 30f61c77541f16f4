// The parts of an optimisation step beside rendering: Adam and the image losses.
#pragma once
#include "rasteriser.h"
#include "simd.h"

namespace GSMAP_ISA {
using namespace gsmap;

// Kingma & Ba 2015; every Gaussian counts its own updates, so one that no camera saw stays as it is.
void adam(const AdamArrays &a, const AdamStep &step, int64_t begin, int n, const uint8_t *touched, float *gradient) {
    const float b1 = step.beta1, b2 = step.beta2;
    for (int i = 0; i < n; i++) {
        if (!touched[i]) continue;
        const int64_t at = (begin + i) * a.cols;
        float *p = a.value + at, *m = a.m + at, *v = a.v + at, *g = gradient + int64_t(i) * a.cols;
        const float *c = step.corrections + 2 * int64_t(step.updates[begin + i]);
        for (int j = 0; j < a.cols; j++) {
            const float gj = g[j];
            m[j] = b1 * m[j] + (1.f - b1) * gj;
            v[j] = b2 * v[j] + (1.f - b2) * gj * gj;
            const float rate = j < 3 ? a.rate : a.rate_rest;
            p[j] -= rate * c[0] * m[j] / (__builtin_sqrtf(v[j]) * c[1] + step.epsilon);
            g[j] = 0.f;
        }
    }
}

float l1(const float *a, const float *b, const float *mask, int pixels, float weight, float *g) {
    float sum = 0.f;
    for (int i = 0; i < pixels; i++) {
        const float w = mask ? mask[i] : 1.f;
        for (int c = 0; c < 3; c++) {
            const float d = a[3 * i + c] - b[3 * i + c];
            sum += w * __builtin_fabsf(d);
            g[3 * i + c] += d == 0.f ? 0.f : __builtin_copysignf(w * weight, d);
        }
    }
    return sum;
}

void blur(const float *const *rows, float *out, int n) {
    // Gaussian, sigma 1.5, 11 taps, as Wang et al. 2004
    constexpr float taps[6] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601173f};
    for (int i = 0; i < n; i++) out[i] = 0.f;
    for (int j = 0; j < 11; j++) {
        if (!rows[j]) continue;
        const float *in = rows[j], tap = taps[j < 6 ? j : 10 - j];
        for (int i = 0; i < n; i++) out[i] += tap * in[i];
    }
}

float ssim(float *a, const float *b, float *aa, const float *bb, float *ab, const float *mask, int n) {
    constexpr float c1 = 0.01f * 0.01f, c2 = 0.03f * 0.03f;
    float sum = 0.f;
    for (int i = 0; i < n; i++) {
        const float w = mask ? mask[i] : 1.f, ma = a[i], mb = b[i];
        const float va = aa[i] - ma * ma, vb = bb[i] - mb * mb, cov = ab[i] - ma * mb;
        const float l = 2.f * ma * mb + c1, s = 2.f * cov + c2, dl = ma * ma + mb * mb + c1, ds = va + vb + c2;
        const float inverse = 1.f / (dl * ds), value = l * s * inverse;
        sum += w * value;
        const float d_cov = 2.f * l * inverse, d_var = -value / ds;
        a[i] = w * (2.f * mb * s * inverse - 2.f * ma * value / dl - d_cov * mb - 2.f * d_var * ma);
        aa[i] = w * d_var;
        ab[i] = w * d_cov;
    }
    return sum;
}

}  // namespace GSMAP_ISA
