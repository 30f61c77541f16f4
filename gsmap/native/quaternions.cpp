// Quaternions: as three numbers, which compressed formats keep, since the largest component follows from the others
// (gsmap/formats/quantise.py), and of the axes of covariances (gsmap/geometry/voxels.py).
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "given.h"
#include "symmetric.h"

namespace gsmap {
namespace {

using Which = nb::ndarray<const uint8_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

using Covariances3 = nb::ndarray<const double, nb::shape<-1, 3, 3>, nb::c_contig, nb::device::cpu>;

// Leaves a quaternion at unit length.
void normalise(float *q) {
    const float squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    const float length = std::max(std::sqrt(squared), 1e-30f);
    for (int k = 0; k < 4; ++k) q[k] /= length;
}

template <class T>
auto quats_of(Which largest, nb::ndarray<const T, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu> three) {
    const std::size_t n = largest.shape(0);
    if (three.shape(0) != n) throw std::invalid_argument("three numbers for each");
    std::vector<float> quats(4 * n);
    for (std::size_t i = 0; i < n; ++i) {
        const T *t = three.data() + 3 * i;
        const int most = largest.data()[i];
        if (most > 3) throw std::invalid_argument("a quaternion has four components");
        float *q = &quats[4 * i];
        for (int k = 0, at = 0; k < 4; ++k)
            if (k != most) q[k] = float(t[at++]);
        q[most] = float(std::sqrt(std::max(T(0), 1 - (t[0] * t[0] + t[1] * t[1] + t[2] * t[2]))));
        normalise(q);
    }
    return numpy_of(std::move(quats), {n, 4});
}

// Quaternion wxyz, w >= 0, of a rotation, from whichever component is largest (Shepperd, 1978).
void quat_of(const double (&R)[3][3], double *q) {
    const double trace = R[0][0] + R[1][1] + R[2][2];
    int most = 0;
    for (int k = 1; k < 3; ++k)
        if (R[k][k] > R[most][most]) most = k;
    if (trace > R[most][most]) {
        const double twice = std::sqrt(1 + trace);
        q[0] = twice / 2;
        for (int k = 0; k < 3; ++k) q[1 + k] = (R[(k + 2) % 3][(k + 1) % 3] - R[(k + 1) % 3][(k + 2) % 3]) / (2 * twice);
        return;
    }
    const int i = most, j = (i + 1) % 3, k = (i + 2) % 3;
    const double twice = std::sqrt(std::max(1 + R[i][i] - R[j][j] - R[k][k], 0.0));
    q[0] = (R[k][j] - R[j][k]) / (2 * twice);
    q[1 + i] = twice / 2;
    q[1 + j] = (R[j][i] + R[i][j]) / (2 * twice);
    q[1 + k] = (R[k][i] + R[i][k]) / (2 * twice);
    if (q[0] < 0)
        for (int m = 0; m < 4; ++m) q[m] = -q[m];
}

}  // namespace

void bind_quaternions(nb::module_ &m) {
    m.def(
        "smallest_three",
        [](Rows4 quats) {
            const std::size_t n = quats.shape(0);
            std::vector<uint8_t> largest(n);
            std::vector<float> three(3 * n);
            for (std::size_t i = 0; i < n; ++i) {
                float q[4];
                std::copy_n(quats.data() + 4 * i, 4, q);
                normalise(q);
                int most = 0;
                for (int k = 1; k < 4; ++k)
                    if (std::abs(q[k]) > std::abs(q[most])) most = k;
                for (int k = 0, at = 0; k < 4; ++k)
                    if (k != most) three[3 * i + at++] = q[most] < 0 ? -q[k] : q[k];
                largest[i] = uint8_t(most);
            }
            return std::make_tuple(numpy_of(std::move(largest), {n}), numpy_of(std::move(three), {n, 3}));
        },
        nb::arg("quats"),
        "The number (n,) of the largest component of normalised quaternions, and the others (n, 3), signed so that it is\n"
        "positive.");
    m.def(
        "principal_axes",
        [](Covariances3 covariances) {
            const std::size_t n = covariances.shape(0);
            std::vector<double> quats(4 * n), variances(3 * n);
            for (std::size_t i = 0; i < n; ++i) {
                double a[3][3], v[3][3];
                std::copy_n(covariances.data() + 9 * i, 9, &a[0][0]);
                diagonalise(a, v);
                quat_of(v, &quats[4 * i]);
                for (int k = 0; k < 3; ++k) variances[3 * i + k] = a[k][k];
            }
            return std::make_tuple(numpy_of(std::move(quats), {n, 4}), numpy_of(std::move(variances), {n, 3}));
        },
        nb::arg("covariances"),
        "Quaternions (n, 4) wxyz, w >= 0, of the rotations whose columns are the axes of symmetric matrices (n, 3, 3),\n"
        "and the variances (n, 3) along them, in their order.");
    constexpr auto about = "Unit quaternions (n, 4) float32 of what `smallest_three` gives.";
    m.def("from_smallest_three", &quats_of<float>, nb::arg("largest"), nb::arg("three"), about);
    m.def("from_smallest_three", &quats_of<double>, nb::arg("largest"), nb::arg("three"), about);
}

}  // namespace gsmap
