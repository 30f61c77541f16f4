// Votes for a scale: the histogram of distance ratios over all pairs of correspondences.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cmath>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <vector>

namespace nb = nanobind;

namespace gsmap {

using Points = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Numbers = nb::ndarray<const double, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Ids = nb::ndarray<const std::int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

// Coordinate `axis` of n points about their mean: float then keeps 1e-6 of the extent, wherever the origin lies.
static std::vector<float> centred(const double *values, std::size_t n, int stride, int axis) {
    double mean = 0;
    for (std::size_t i = 0; i < n; ++i) mean += values[i * stride + axis] / double(n);
    std::vector<float> out(n);
    for (std::size_t i = 0; i < n; ++i) out[i] = float(values[i * stride + axis] - mean);
    return out;
}

// Adds log(|target_i - target_j| / |source_i - source_j|) of every usable pair to `counts` bins over [-limit, limit].
static void ratio_histogram(std::size_t n, const double *target, const double *source, const std::int32_t *target_ids,
                            const std::int32_t *source_ids, const double *target_heights, const double *source_heights,
                            float min_distance, float rise_tolerance, float limit, std::int64_t *counts, int bins) {
    std::vector<float> t[3], s[3], rise_t(n, 0.f), rise_s(n, 0.f), place(n);
    for (int k = 0; k < 3; ++k) t[k] = centred(target, n, 3, k), s[k] = centred(source, n, 3, k);
    if (target_heights) rise_t = centred(target_heights, n, 1, 0), rise_s = centred(source_heights, n, 1, 0);
    const float *tx = t[0].data(), *ty = t[1].data(), *tz = t[2].data(), *th = rise_t.data();
    const float *sx = s[0].data(), *sy = s[1].data(), *sz = s[2].data(), *sh = rise_s.data();
    float *out = place.data();
    std::vector<int> bin(n + 1);
    const float per_bin = float(bins) / (2 * limit), nowhere = -1.f;
    for (std::size_t i = 0; i < n; ++i) {
        const float ax = tx[i], ay = ty[i], az = tz[i], bx = sx[i], by = sy[i], bz = sz[i], ah = th[i], bh = sh[i];
        const std::int32_t it = target_ids[i], is = source_ids[i];
        for (std::size_t j = i + 1; j < n; ++j) {
            float x = ax - tx[j], y = ay - ty[j], z = az - tz[j];
            float dt = std::sqrt(x * x + y * y + z * z);
            x = bx - sx[j], y = by - sy[j], z = bz - sz[j];
            float ds = std::sqrt(x * x + y * y + z * z);
            // log(dt / ds) = 2 atanh(q), by its series: 1e-6 within a factor of 2, a thousandth within one of 4.
            float q = (dt - ds) / (dt + ds + 1e-30f), q2 = q * q;
            float log_ratio = 2 * q * (1 + q2 * (1 / 3.f + q2 * (1 / 5.f + q2 * (1 / 7.f + q2 * (1 / 9.f + q2 / 11.f)))));
            float at = (log_ratio + limit) * per_bin;
            float slopes = std::fabs((ah - th[j]) * ds - (bh - sh[j]) * dt);
            bool use = (dt > min_distance) & (ds > min_distance) & (it != target_ids[j]) & (is != source_ids[j]) &
                       (slopes <= rise_tolerance * dt * ds) & (at >= 0) & (at < float(bins));
            out[j] = use ? at : nowhere;
        }
        std::size_t used = 0;  // few pairs are: gathered without a branch, which would be foreseen badly
        for (std::size_t j = i + 1; j < n; ++j) {
            bin[used] = int(out[j]);
            used += out[j] >= 0;
        }
        for (std::size_t k = 0; k < used; ++k) ++counts[bin[k]];
    }
}

void bind_ratios(nb::module_ &m) {
    m.def(
        "ratio_histogram",
        [](Points target, Points source, Ids target_ids, Ids source_ids, std::optional<Numbers> target_heights,
           std::optional<Numbers> source_heights, float min_distance, float rise_tolerance, float limit, int bins) {
            std::size_t n = target.shape(0);
            if (source.shape(0) != n || target_ids.shape(0) != n || source_ids.shape(0) != n ||
                target_heights.has_value() != source_heights.has_value() ||
                (target_heights && (target_heights->shape(0) != n || source_heights->shape(0) != n)) || bins < 1)
                throw std::invalid_argument("ratio_histogram needs arrays of one length and a bin");
            auto *counts = new std::int64_t[bins]();
            nb::capsule owner(counts, [](void *p) noexcept { delete[] static_cast<std::int64_t *>(p); });
            {
                nb::gil_scoped_release release;
                ratio_histogram(n, target.data(), source.data(), target_ids.data(), source_ids.data(),
                                target_heights ? target_heights->data() : nullptr,
                                source_heights ? source_heights->data() : nullptr, min_distance, rise_tolerance, limit,
                                counts, bins);
            }
            return nb::ndarray<nb::numpy, std::int64_t, nb::ndim<1>>(counts, {std::size_t(bins)}, owner);
        },
        nb::arg("target"), nb::arg("source"), nb::arg("target_ids"), nb::arg("source_ids"),
        nb::arg("target_heights").none(), nb::arg("source_heights").none(), nb::arg("min_distance"),
        nb::arg("rise_tolerance"), nb::arg("limit"), nb::arg("bins"),
        "Counts (bins,) of the logarithms of distance ratios, target over source, over [-limit, limit].");
}

}  // namespace gsmap
