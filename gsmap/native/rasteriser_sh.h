// Real spherical harmonics up to degree 3 (the constants and signs of INRIA's 3DGS, as every trainer writes them).
#pragma once
#include "simd.h"

namespace GSMAP_ISA {

constexpr float kSh0 = 0.28209479177387814f, kSh1 = 0.4886025119029199f;
constexpr float kSh2[5] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f, -1.0925484305920792f,
                           0.5462742152960396f};
constexpr float kSh3[7] = {-0.5900435899266435f, 2.890611442640554f, -0.4570457994644658f, 0.3731763325901154f,
                           -0.4570457994644658f, 1.445305721320277f, -0.5900435899266435f};

// Values of the k basis functions in the unit direction (x, y, z).
INLINE void sh_basis(int k, V x, V y, V z, V *basis) {
    basis[0] = set1(kSh0);
    if (k < 4) return;
    basis[1] = -kSh1 * y, basis[2] = kSh1 * z, basis[3] = -kSh1 * x;
    if (k < 9) return;
    const V xx = x * x, yy = y * y, zz = z * z;
    basis[4] = kSh2[0] * x * y, basis[5] = kSh2[1] * y * z, basis[6] = kSh2[2] * (2.f * zz - xx - yy);
    basis[7] = kSh2[3] * x * z, basis[8] = kSh2[4] * (xx - yy);
    if (k < 16) return;
    basis[9] = kSh3[0] * y * (3.f * xx - yy), basis[10] = kSh3[1] * x * y * z;
    basis[11] = kSh3[2] * y * (4.f * zz - xx - yy), basis[12] = kSh3[3] * z * (2.f * zz - 3.f * xx - 3.f * yy);
    basis[13] = kSh3[4] * x * (4.f * zz - xx - yy), basis[14] = kSh3[5] * z * (xx - yy);
    basis[15] = kSh3[6] * x * (xx - 3.f * yy);
}

// Gradient with respect to (x, y, z) of sum_j weight[j] * basis[j]; weight[0] has no influence.
INLINE void sh_basis_backward(int k, V x, V y, V z, const V *weight, V *g) {
    g[0] = g[1] = g[2] = V{};
    if (k < 4) return;
    g[0] = -kSh1 * weight[3], g[1] = -kSh1 * weight[1], g[2] = kSh1 * weight[2];
    if (k < 9) return;
    const V xx = x * x, yy = y * y, zz = z * z, *w = weight;
    g[0] += kSh2[0] * y * w[4] - 2.f * kSh2[2] * x * w[6] + kSh2[3] * z * w[7] + 2.f * kSh2[4] * x * w[8];
    g[1] += kSh2[0] * x * w[4] + kSh2[1] * z * w[5] - 2.f * kSh2[2] * y * w[6] - 2.f * kSh2[4] * y * w[8];
    g[2] += kSh2[1] * y * w[5] + 4.f * kSh2[2] * z * w[6] + kSh2[3] * x * w[7];
    if (k < 16) return;
    g[0] += 6.f * kSh3[0] * x * y * w[9] + kSh3[1] * y * z * w[10] - 2.f * kSh3[2] * x * y * w[11] -
            6.f * kSh3[3] * x * z * w[12] + kSh3[4] * (4.f * zz - 3.f * xx - yy) * w[13] +
            2.f * kSh3[5] * x * z * w[14] + 3.f * kSh3[6] * (xx - yy) * w[15];
    g[1] += 3.f * kSh3[0] * (xx - yy) * w[9] + kSh3[1] * x * z * w[10] +
            kSh3[2] * (4.f * zz - xx - 3.f * yy) * w[11] - 6.f * kSh3[3] * y * z * w[12] -
            2.f * kSh3[4] * x * y * w[13] - 2.f * kSh3[5] * y * z * w[14] - 6.f * kSh3[6] * x * y * w[15];
    g[2] += kSh3[1] * x * y * w[10] + 8.f * kSh3[2] * y * z * w[11] + kSh3[3] * (6.f * zz - 3.f * xx - 3.f * yy) * w[12] +
            8.f * kSh3[4] * x * z * w[13] + kSh3[5] * (xx - yy) * w[14];
}

// Unclamped colour of W Gaussians; (x, y, z) is the direction from the camera, of any length.
INLINE void sh_colour(int k, V x, V y, V z, const V *coefficients, V *colour) {
    V basis[16];
    const V r = set1(1.f) / sqrt(fma(x, x, fma(y, y, z * z)));
    sh_basis(k, x * r, y * r, z * r, basis);
    for (int c = 0; c < 3; c++) {
        colour[c] = fma(basis[0], coefficients[c], set1(0.5f));
        for (int j = 1; j < k; j++) colour[c] = fma(basis[j], coefficients[3 * j + c], colour[c]);
    }
}

}  // namespace GSMAP_ISA
