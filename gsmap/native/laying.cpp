// One step of laying a render over a photograph; what it computes is in gsmap/localize/aligning.py.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"

namespace gsmap {
namespace {

using Planes = nb::ndarray<const float, nb::shape<-1, -1, 9>, nb::c_contig, nb::device::cpu>;
using Colours = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Slopes = nb::ndarray<const float, nb::shape<-1, 2, 3>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;
using Lens = nb::ndarray<const double, nb::shape<4>, nb::c_contig, nb::device::cpu>;

struct Sums {
    double cost = 0, trust = 0, both = 0, own = 0;  // of Cauchy's loss, of trust, weighed of seen * shown and of shown^2
    double A[7][7] = {}, b[7] = {};
};

// What the photo shows at (x, y), between its pixels: colours, their slopes along rows, and along columns.
void sample(const Planes &planes, double x, double y, float *seen) {
    const int64_t width = planes.shape(1), column = int64_t(x -= 0.5), row = int64_t(y -= 0.5);
    const float a = float(x - column), b = float(y - row);
    const float *upper = planes.data() + (row * width + column) * 9, *lower = upper + width * 9;
    for (int k = 0; k < 9; ++k)
        seen[k] = (upper[k] * (1 - a) + upper[k + 9] * a) * (1 - b) + (lower[k] * (1 - a) + lower[k + 9] * a) * b;
}

Sums laid(const Planes &planes, const Points &points, const Colours &shown, const Slopes &slopes, const Numbers &trusts,
          const Pose &pose, const Lens &lens, double gain, double scale, int dim) {
    const double *T = pose.data(), fx = lens.data()[0], fy = lens.data()[1], cx = lens.data()[2], cy = lens.data()[3];
    const double right = double(planes.shape(1)) - 1, bottom = double(planes.shape(0)) - 1;
    Sums sums;
    for (std::size_t k = 0; k < points.shape(0); ++k) {
        const double *p = points.data() + 3 * k, trust = trusts.data()[k];
        double l[3];
        for (int i = 0; i < 3; ++i)
            l[i] = T[i] * (p[0] - T[3]) + T[4 + i] * (p[1] - T[7]) + T[8 + i] * (p[2] - T[11]);
        if (!(l[2] > 1e-6)) continue;
        const double x = l[0] / l[2], y = l[1] / l[2], u = fx * x + cx, v = fy * y + cy;
        if (!(u > 1 && v > 1 && u < right && v < bottom)) continue;
        float seen[9];
        sample(planes, u, v, seen);
        const float *colour = shown.data() + 3 * k, *slope = slopes.data() + 6 * k;
        double rr = 0, rd = 0, dd = 0, r = 0, d = 0, loss = 1;
        for (int c = 0; c < 3; ++c) {
            const double differ = seen[c] - gain * colour[c], far = differ / scale, cauchy = 1 + far * far;
            const double weight = trust / cauchy;
            const double down = (seen[3 + c] + gain * slope[c]) / 2, across = (seen[6 + c] + gain * slope[3 + c]) / 2;
            rr += weight * across * across, rd += weight * across * down, dd += weight * down * down;
            r += weight * across * differ, d += weight * down * differ;
            sums.both += weight * seen[c] * colour[c];
            sums.own += weight * double(colour[c]) * colour[c];
            loss *= cauchy;
        }
        sums.cost += trust * std::log(loss);
        sums.trust += trust;
        // How the pixel moves with the pose (gsmap.localize.resection.linearised), columns and rows.
        const double a0 = fx / l[2], a2 = -fx * x / l[2], b1 = fy / l[2], b2 = -fy * y / l[2];
        const double J[2][7] = {{-a2 * l[1], a2 * l[0] - a0 * l[2], a0 * l[1], -a0, 0, -a2, fx * x},
                                {b1 * l[2] - b2 * l[1], b2 * l[0], -b1 * l[0], 0, -b1, -b2, fy * y}};
        for (int i = 0; i < dim; ++i) {
            const double across = rr * J[0][i] + rd * J[1][i], down = rd * J[0][i] + dd * J[1][i];
            for (int j = i; j < dim; ++j) sums.A[i][j] += across * J[0][j] + down * J[1][j];
            sums.b[i] -= r * J[0][i] + d * J[1][i];
        }
    }
    return sums;
}

}  // namespace

void bind_laying(nb::module_ &m) {
    m.def(
        "laid",
        [](Planes planes, Points points, Colours shown, Slopes slopes, Numbers trust, Pose pose, Lens lens, double gain,
           double scale, int dim) {
            const std::size_t n = points.shape(0);
            if (shown.shape(0) != n || slopes.shape(0) != n || trust.shape(0) != n)
                throw std::invalid_argument("every point has a colour, slopes and trust");
            if (dim != 6 && dim != 7) throw std::invalid_argument("a pose has 6 dimensions, with its focal length 7");
            Sums sums;
            {
                nb::gil_scoped_release release;
                sums = laid(planes, points, shown, slopes, trust, pose, lens, gain, scale, dim);
            }
            std::vector<double> A(dim * dim), b(sums.b, sums.b + dim);
            for (int i = 0; i < dim; ++i)
                for (int j = 0; j < dim; ++j) A[i * dim + j] = sums.A[std::min(i, j)][std::max(i, j)];
            return std::make_tuple(sums.cost, sums.trust, sums.both, sums.own,
                                   numpy_of(std::move(A), {std::size_t(dim), std::size_t(dim)}),
                                   numpy_of(std::move(b), {std::size_t(dim)}));
        },
        nb::arg("planes"), nb::arg("points"), nb::arg("shown"), nb::arg("slopes"), nb::arg("trust"), nb::arg("pose"),
        nb::arg("lens"), nb::arg("gain"), nb::arg("scale"), nb::arg("dim"),
        "Sums over points of a render that are laid over a photograph: of Cauchy's loss times trust, of trust, weighed "
        "of seen * shown and of shown ** 2, and the normal equations (dim, dim), (dim,) of a step of the pose.");
}

}  // namespace gsmap
