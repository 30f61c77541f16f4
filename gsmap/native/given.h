// Gaussians as Python has them, in numbers that are merged.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>

#include "arrays.h"

namespace gsmap {

using Rows3 = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Rows4 = nb::ndarray<const float, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

constexpr double kMaxOpacity = 0.9999;  // as in gsmap/geometry/voxels.py

constexpr double kPi = 3.141592653589793;

// Mean area of the shadows of an ellipsoid, from the logarithms of its semi-axes: a quarter of its surface (Cauchy), by
// Thomsen's formula.
inline double shadow(double a, double b, double c) {
    constexpr double kThomsen = 1.6075;
    a = std::exp(kThomsen * a), b = std::exp(kThomsen * b), c = std::exp(kThomsen * c);
    return kPi * std::pow((a * b + a * c + b * c) / 3, 1 / kThomsen);
}

// Gaussians as they were given.
struct Given {
    const float *means, *quats, *log_scales, *logits;
    int64_t n;

    // Returns the largest variance.
    double covariance(int64_t i, double *s) const {
        double q[4], norm = 0, R[9];
        for (int k = 0; k < 4; ++k) q[k] = quats[4 * i + k], norm += q[k] * q[k];
        norm = std::sqrt(norm);
        for (int k = 0; k < 4; ++k) q[k] = norm > 0 ? q[k] / norm : k == 0;  // none is the identity, as everywhere
        const double w = q[0], x = q[1], y = q[2], z = q[3];
        const double turn[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                                2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                                2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
        double largest = 0;
        for (int k = 0; k < 3; ++k) {
            const double scale = std::exp(double(log_scales[3 * i + k]));
            for (int row = 0; row < 9; row += 3) R[row + k] = turn[row + k] * scale;
            largest = std::max(largest, scale * scale);
        }
        for (int row = 0, at = 0; row < 3; ++row)
            for (int column = row; column < 3; ++column, ++at) {
                s[at] = 0;
                for (int k = 0; k < 3; ++k) s[at] += R[3 * row + k] * R[3 * column + k];
            }
        return largest;
    }
    double shadow(int64_t i) const {
        return gsmap::shadow(log_scales[3 * i], log_scales[3 * i + 1], log_scales[3 * i + 2]);
    }
    double opacity(int64_t i) const { return 1 / (1 + std::exp(-double(logits[i]))); }
};

inline double optical_depth(double opacity) { return -std::log1p(-std::min(opacity, kMaxOpacity)); }

inline Given given_of(const Rows3 &means, const Rows4 &quats, const Rows3 &log_scales, const Values &logits) {
    const std::size_t n = means.shape(0);
    if (quats.shape(0) != n || log_scales.shape(0) != n || logits.shape(0) != n || n >= 1u << 28)
        throw std::invalid_argument("arrays of one length, below 2^28");
    return {means.data(), quats.data(), log_scales.data(), logits.data(), int64_t(n)};
}

}  // namespace gsmap
