// Gaussians that become one: the moments of each group (gsmap/geometry/voxels.py).
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "given.h"
#include "threads.h"

namespace gsmap {
namespace {

using Labels = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Coefficients = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

// Sums over the members of groups, each weighted by its share of the group's mass.
struct Moments {
    std::vector<double> masses, means, covariances, sh;
    std::vector<int64_t> counts, heaviest;

    Moments(const Given &given, const float *coefficients, int64_t width, const int64_t *labels, int64_t groups)
        : masses(groups), means(3 * groups), covariances(9 * groups), sh(width * groups), counts(groups), heaviest(groups) {
        std::vector<int64_t> begin(groups + 1), rows(given.n);
        for (int64_t i = 0; i < given.n; ++i) ++counts[labels[i]];
        std::partial_sum(counts.begin(), counts.end(), begin.begin() + 1);
        std::vector<int64_t> next(begin.begin(), begin.end() - 1);
        for (int64_t i = 0; i < given.n; ++i) rows[next[labels[i]]++] = i;
        constexpr int64_t kAtOnce = 4096;
        parallel_for((groups + kAtOnce - 1) / kAtOnce, [&](int64_t task) {
            std::vector<double> mass;
            for (int64_t g = task * kAtOnce; g < std::min(groups, (task + 1) * kAtOnce); ++g) {
                if (counts[g] == 1) {  // what is alone stays as it is
                    heaviest[g] = rows[begin[g]];
                    continue;
                }
                mass.clear();
                for (int64_t r = begin[g]; r < begin[g + 1]; ++r) {
                    mass.push_back(optical_depth(given.opacity(rows[r])) * given.shadow(rows[r]) + 1e-30);
                    masses[g] += mass.back();
                }
                heaviest[g] = rows[begin[g] + (std::max_element(mass.begin(), mass.end()) - mass.begin())];
                for (std::size_t m = 0; m < mass.size(); ++m)
                    for (int k = 0; k < 3; ++k)
                        means[3 * g + k] += mass[m] / masses[g] * given.means[3 * rows[begin[g] + m] + k];
                double sum[6] = {};
                for (std::size_t m = 0; m < mass.size(); ++m) {
                    const int64_t row = rows[begin[g] + m];
                    const double share = mass[m] / masses[g];
                    double own[6], d[3];
                    given.covariance(row, own);
                    for (int k = 0; k < 3; ++k) d[k] = given.means[3 * row + k] - means[3 * g + k];
                    const double outer[6] = {d[0] * d[0], d[0] * d[1], d[0] * d[2], d[1] * d[1], d[1] * d[2], d[2] * d[2]};
                    for (int k = 0; k < 6; ++k) sum[k] += share * (own[k] + outer[k]);
                    for (int64_t k = 0; k < width; ++k) sh[width * g + k] += share * coefficients[width * row + k];
                }
                constexpr int kOf[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5};
                for (int k = 0; k < 9; ++k) covariances[9 * g + k] = sum[kOf[k]];
            }
        });
    }
};

}  // namespace

void bind_groups(nb::module_ &m) {
    m.def(
        "group_moments",
        [](Rows3 means, Rows4 quats, Rows3 log_scales, Values logits, Coefficients sh, Labels labels) {
            const Given given = given_of(means, quats, log_scales, logits);
            if (int64_t(sh.shape(0)) != given.n || int64_t(labels.shape(0)) != given.n)
                throw std::invalid_argument("arrays of one length");
            int64_t groups = 0;
            for (int64_t i = 0; i < given.n; ++i) groups = std::max(groups, labels.data()[i] + 1);
            if (groups > given.n) throw std::invalid_argument("a group without members");
            std::vector<uint8_t> used(groups);
            for (int64_t i = 0; i < given.n; ++i) {
                if (labels.data()[i] < 0) throw std::invalid_argument("labels must not be negative");
                used[labels.data()[i]] = 1;
            }
            if (std::find(used.begin(), used.end(), 0) != used.end())
                throw std::invalid_argument("a group without members");
            const std::size_t width = sh.shape(1), count = std::size_t(groups);
            std::optional<Moments> out;
            {
                nb::gil_scoped_release release;
                out.emplace(given, sh.data(), int64_t(width), labels.data(), groups);
            }
            return std::make_tuple(numpy_of(std::move(out->counts), {count}), numpy_of(std::move(out->heaviest), {count}),
                                   numpy_of(std::move(out->masses), {count}), numpy_of(std::move(out->means), {count, 3}),
                                   numpy_of(std::move(out->covariances), {count, 3, 3}),
                                   numpy_of(std::move(out->sh), {count, width}));
        },
        nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"), nb::arg("logit_opacities"), nb::arg("sh"),
        nb::arg("labels"),
        "Of each group of Gaussians: how many (m,), the heaviest row; and, 0 where there is one only, mass, mean (m, 3),\n"
        "covariance (m, 3, 3) and SH (m, k) of the mixture.");
    m.def(
        "reached_box",
        [](Rows3 means, Rows4 quats, Rows3 log_scales, double sigmas) {
            const std::size_t n = means.shape(0);
            if (quats.shape(0) != n || log_scales.shape(0) != n) throw std::invalid_argument("arrays of one length");
            const Given given{means.data(), quats.data(), log_scales.data(), nullptr, int64_t(n)};
            std::vector<double> box{__builtin_inf(), __builtin_inf(), __builtin_inf()};
            box.insert(box.end(), 3, -__builtin_inf());
            nb::gil_scoped_release release;
            for (int64_t i = 0; i < given.n; ++i) {
                double s[6];
                given.covariance(i, s);
                const double variances[3] = {s[0], s[3], s[5]};
                for (int k = 0; k < 3; ++k) {
                    const double at = given.means[3 * i + k], reach = sigmas * std::sqrt(variances[k]);
                    box[k] = std::min(box[k], at - reach);
                    box[3 + k] = std::max(box[3 + k], at + reach);
                }
            }
            nb::gil_scoped_acquire acquire;
            return numpy_of(std::move(box), {2, 3});
        },
        nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"), nb::arg("sigmas"),
        "The box (2, 3) around Gaussians, each widened by so many of its standard deviations along the axes.");
}

}  // namespace gsmap
