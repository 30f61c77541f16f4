// What it costs, in light, to draw one Gaussian in place of two. See gsmap/geometry/decimate.py.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "arrays.h"

namespace gsmap {
namespace {

using Covariances = nb::ndarray<const double, nb::shape<-1, 6>, nb::c_contig, nb::device::cpu>;
using Pairs = nb::ndarray<const std::int32_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

// Symmetric 3x3: xx, xy, xz, yy, yz, zz.
struct Spread {
    double v[6];

    double minors() const {
        return v[0] * v[3] - v[1] * v[1] + v[0] * v[5] - v[2] * v[2] + v[3] * v[5] - v[4] * v[4];
    }
    double area() const { return M_PI * std::sqrt(std::max(minors(), 0.0) / 3); }
    // Determinant, and d' S^-1 d.
    double det(const double *d, double *quadratic) const {
        const double a = v[0], b = v[1], c = v[2], e = v[3], f = v[4], h = v[5];
        const double A = e * h - f * f, B = c * f - b * h, C = b * f - c * e, E = a * h - c * c, F = b * c - a * f,
                     H = a * e - b * b, det = a * A + b * B + c * C;
        if (quadratic)
            *quadratic = (A * d[0] * d[0] + E * d[1] * d[1] + H * d[2] * d[2] +
                          2 * (B * d[0] * d[1] + C * d[0] * d[2] + F * d[1] * d[2])) / det;
        return det;
    }
};

Spread mean(const Spread &a, const Spread &b) {
    Spread out;
    for (int k = 0; k < 6; ++k) out.v[k] = (a.v[k] + b.v[k]) / 2;
    return out;
}

// Bhattacharyya's coefficient of two Gaussians a difference d of means apart.
double overlap(const Spread &a, const Spread &b, double det_a, double det_b, const double *d) {
    double quadratic;
    const double det = mean(a, b).det(d, &quadratic);
    return std::pow(det_a * det_b, .25) / std::sqrt(det) * std::exp(-quadratic / 8);
}

// A blurred Gaussian as a source of light: amplitude times the root of its area, and its colour.
struct Light {
    double strength, colour[4];
};

double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]; }

auto pair_costs(const Points &means, const Covariances &covariances, const Numbers &masses, const Numbers &opacities,
                const Points &colours, const Pairs &pairs, double blur, double cover) {
    const auto n = std::int64_t(means.shape(0));
    if (std::int64_t(covariances.shape(0)) != n || std::int64_t(masses.shape(0)) != n ||
        std::int64_t(opacities.shape(0)) != n || std::int64_t(colours.shape(0)) != n)
        throw std::invalid_argument("arrays of one length");
    const std::size_t count = pairs.shape(0);
    std::vector<double> costs(count);
    bool inside = true;
    {
        nb::gil_scoped_release release;
        const double more = blur * blur;
        std::vector<Spread> blurred(n);
        std::vector<Light> lights(n);
        std::vector<double> dets(n);
        for (std::int64_t i = 0; i < n; ++i) {
            const double *v = covariances.data() + 6 * i;
            Spread &s = blurred[i];
            std::copy(v, v + 6, s.v);
            const double sharp = s.area();
            for (int k : {0, 3, 5}) s.v[k] += more;
            const double area = s.area();
            dets[i] = s.det(nullptr, nullptr);
            lights[i].strength = opacities.data()[i] * sharp / std::sqrt(area);
            for (int k = 0; k < 3; ++k) lights[i].colour[k] = colours.data()[3 * i + k];
            lights[i].colour[3] = cover;
        }
        for (std::size_t p = 0; p < count; ++p) {
            const std::int64_t i = pairs.data()[2 * p], j = pairs.data()[2 * p + 1];
            if (i < 0 || j < 0 || i >= n || j >= n) { inside = false; break; }
            const double total = masses.data()[i] + masses.data()[j], a = masses.data()[i] / total, b = 1 - a;
            double d[3], to_i[3], to_j[3];
            for (int k = 0; k < 3; ++k) {
                d[k] = means.data()[3 * i + k] - means.data()[3 * j + k];
                to_i[k] = b * d[k];
                to_j[k] = a * d[k];
            }
            const double *u = covariances.data() + 6 * i, *v = covariances.data() + 6 * j;
            const double outer[6] = {d[0] * d[0], d[0] * d[1], d[0] * d[2], d[1] * d[1], d[1] * d[2], d[2] * d[2]};
            Spread m;
            for (int k = 0; k < 6; ++k) m.v[k] = a * u[k] + b * v[k] + a * b * outer[k];
            const double sharp = m.area(), opacity = std::min(-std::expm1(-total / std::max(sharp, 1e-300)), .9999);
            for (int k : {0, 3, 5}) m.v[k] += more;
            const Light &x = lights[i], &y = lights[j];
            Light z{opacity * sharp / std::sqrt(m.area()), {}};
            for (int k = 0; k < 4; ++k) z.colour[k] = a * x.colour[k] + b * y.colour[k];
            const double det = m.det(nullptr, nullptr);
            const double xy = overlap(blurred[i], blurred[j], dets[i], dets[j], d),
                         xz = overlap(blurred[i], m, dets[i], det, to_i),
                         yz = overlap(blurred[j], m, dets[j], det, to_j);
            const double energy =
                x.strength * x.strength * dot(x.colour, x.colour) + y.strength * y.strength * dot(y.colour, y.colour) +
                z.strength * z.strength * dot(z.colour, z.colour) +
                2 * x.strength * y.strength * xy * dot(x.colour, y.colour) -
                2 * x.strength * z.strength * xz * dot(x.colour, z.colour) -
                2 * y.strength * z.strength * yz * dot(y.colour, z.colour);
            costs[p] = std::isfinite(energy) ? std::max(energy, 0.0) : HUGE_VAL;
        }
    }
    if (!inside) throw std::invalid_argument("a pair of a row that is not there");
    return numpy_of(std::move(costs), {count});
}

}  // namespace

void bind_merging(nb::module_ &m) {
    m.def("pair_costs", &pair_costs, nb::arg("means"), nb::arg("covariances"), nb::arg("masses"), nb::arg("opacities"),
          nb::arg("colours"), nb::arg("pairs"), nb::arg("blur"), nb::arg("cover"),
          "(E,) energy of the difference between two Gaussians and the one that keeps their moments, for each pair.");
}

}  // namespace gsmap
