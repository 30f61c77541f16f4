// Quaternions as three numbers, which compressed formats keep: the largest component follows from the others.
// See gsmap/formats/quantise.py.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "given.h"

namespace gsmap {
namespace {

using Which = nb::ndarray<const uint8_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

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
    constexpr auto about = "Unit quaternions (n, 4) float32 of what `smallest_three` gives.";
    m.def("from_smallest_three", &quats_of<float>, nb::arg("largest"), nb::arg("three"), about);
    m.def("from_smallest_three", &quats_of<double>, nb::arg("largest"), nb::arg("three"), about);
}

}  // namespace gsmap
