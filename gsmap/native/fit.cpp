// Optimisation steps: image loss with its gradient, and backward pass and Adam in one sweep over the Gaussians.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <vector>

#include "bindings.h"
#include "rasteriser_view.h"
#include "threads.h"

namespace gsmap {
namespace {

// (1 - s) * Huber + s * (1 - SSIM), means over pixels weighed by mask (H, W); writes the gradient (H, W, 3).
double image_loss(const Floats &image, const Floats &target, const std::optional<Floats> &mask, float ssim_weight,
                  float huber_delta, const FloatsOut &gradient) {
    const int height = int(image.shape(0)), width = int(image.shape(1));
    const float *a = image.data(), *b = target.data(), *m = mask ? mask->data() : nullptr;
    float *g = gradient.data();
    nb::gil_scoped_release release;
    const int64_t pixels = int64_t(height) * width;
    double total = 0;
    if (m)
        for (int64_t i = 0; i < pixels; i++) total += m[i];
    else
        total = double(pixels);
    std::memset(g, 0, pixels * 3 * sizeof(float));
    if (!(total > 0)) return 0.0;
    const double per_value = 1.0 / (3 * total);
    std::vector<double> sums(height);
    parallel_for(height, [&](int64_t r) {
        const int64_t o = r * width;
        sums[r] = kernels->huber(a + 3 * o, b + 3 * o, m ? m + o : nullptr, width, huber_delta,
                                 float((1 - ssim_weight) * per_value), g + 3 * o);
    });
    double differences = 0;
    for (double s : sums) differences += s;
    double loss = (1 - ssim_weight) * differences * per_value;
    if (ssim_weight > 0) {
        const int64_t bands = height / 64 < num_threads() ? std::max(height / 64, 1) : num_threads();
        parallel_for(bands, [&](int64_t band) {
            static thread_local Buffer<float> scratch;
            const int from = int(height * band / bands), to = int(height * (band + 1) / bands);
            kernels->ssim({a, b, m, width, height, from, to, float(-ssim_weight * per_value), g, sums.data()},
                          scratch.reserve(size_t(ssim_scratch(width))));
        });
        double similar = 0;
        for (double s : sums) similar += s;
        loss += ssim_weight * (1 - similar * per_value);
    }
    return loss;
}

struct Statistics {
    float *gradient_norm;
    int32_t *seen;
};

// Backward pass of several rendered views and one Adam step, chunk by chunk, so that gradients stay in the cache.
// `values`, `m`, `v` hold means, quats, log_scales, logit_opacities, sh; rates one per attribute, and SH beyond degree 0.
void fit_step(const std::vector<View *> &views, const Floats &background, const FloatsOut &colour, const FloatsOut &alpha,
              const Floats &g_colour, const std::vector<FloatsOut> &values, const std::vector<FloatsOut> &m,
              const std::vector<FloatsOut> &v, const nb::ndarray<uint32_t, nb::c_contig, nb::device::cpu> &updates,
              const std::optional<Bytes> &frozen, const std::vector<float> &rates, float beta1, float beta2, float epsilon,
              const std::optional<FloatsOut> &gradient_norm, const std::optional<Ints> &seen) {
    if (values.size() != 5 || m.size() != 5 || v.size() != 5 || rates.size() != 6) throw std::runtime_error("five attributes");
    const Scene scene{values[0].data(), values[1].data(), values[2].data(), values[3].data(), values[4].data(),
                      int64_t(values[0].shape(0)), int(values[4].shape(1))};
    const int cols[5] = {3, 4, 3, 1, 3 * scene.k};
    AdamArrays adam[5];
    for (int a = 0; a < 5; a++) adam[a] = {values[a].data(), m[a].data(), v[a].data(), cols[a], rates[a], rates[a]};
    adam[4].rate_rest = rates[5];
    uint32_t *count = updates.data();
    const uint8_t *still = frozen ? frozen->data() : nullptr;
    const Statistics stats{gradient_norm ? gradient_norm->data() : nullptr, seen ? seen->data() : nullptr};
    const int64_t pixels = views.empty() ? 0 : int64_t(views[0]->width()) * views[0]->height();
    Image image = image_of(background, colour, std::nullopt, alpha);
    const float *gradient = g_colour.data();

    nb::gil_scoped_release release;
    for (size_t i = 0; i < views.size(); i++) {
        Image one = image;
        one.colour += 3 * pixels * i, one.alpha += pixels * i;
        views[i]->pixels_backward(one, {gradient + 3 * pixels * i, nullptr, nullptr, still});
    }
    uint32_t most = 0;
    for (int64_t i = 0; i < scene.n; i++) most = count[i] > most ? count[i] : most;
    std::vector<float> corrections(2 * (size_t(most) + 2));
    for (uint32_t t = 1; t <= most + 1; t++) {
        corrections[2 * t] = float(1.0 / (1.0 - std::pow(double(beta1), double(t))));
        corrections[2 * t + 1] = float(1.0 / std::sqrt(1.0 - std::pow(double(beta2), double(t))));
    }
    const AdamStep step{beta1, beta2, epsilon, corrections.data(), count};
    const int per_row = 3 + 4 + 3 + 1 + 3 * scene.k + 2;
    parallel_for((scene.n + kChunk - 1) / kChunk, [&](int64_t chunk) {
        static thread_local std::vector<float> scratch;  // all zero between uses
        static thread_local std::vector<uint8_t> flags(2 * kChunk);
        if (scratch.size() < size_t(per_row) * kChunk) scratch.resize(size_t(per_row) * kChunk);
        float *at = scratch.data(), *parts[6];
        for (int a = 0; a < 5; at += size_t(cols[a]) * kChunk, a++) parts[a] = at;
        parts[5] = at;
        uint8_t *now = flags.data(), *ever = now + kChunk;
        const int64_t begin = chunk * kChunk;
        const int n = int(scene.n - begin < kChunk ? scene.n - begin : kChunk);
        const SceneGradient into{parts[0], parts[1], parts[2], parts[3], parts[4], stats.gradient_norm ? parts[5] : nullptr,
                                 now, still, begin};
        bool any = false;
        for (const View *view : views) {
            view->chunk_backward(chunk, scene, into, nullptr);
            const float half_width = 0.5f * view->width(), half_height = 0.5f * view->height();
            for (int i = 0; i < n; i++) {
                if (!now[i]) continue;
                now[i] = 0, ever[i] = 1, any = true;
                if (stats.gradient_norm) {
                    float *g = parts[5] + 2 * i;
                    stats.gradient_norm[begin + i] += std::hypot(g[0] * half_width, g[1] * half_height);
                    stats.seen[begin + i]++;
                    g[0] = g[1] = 0.f;
                }
            }
        }
        if (!any) return;
        for (int i = 0; i < n; i++) count[begin + i] += ever[i];
        for (int a = 0; a < 5; a++) kernels->adam(adam[a], step, begin, n, ever, parts[a]);
        std::memset(ever, 0, kChunk);
    });
}

}  // namespace

void bind_fit(nb::module_ &m) {
    m.def("image_loss", &image_loss, nb::arg("image"), nb::arg("target"), nb::arg("mask").none(), nb::arg("ssim_weight"),
          nb::arg("huber_delta"), nb::arg("gradient"));
    m.def("fit_step", &fit_step, nb::arg("views"), nb::arg("background"), nb::arg("colour"), nb::arg("alpha"),
          nb::arg("g_colour"), nb::arg("values"), nb::arg("m"), nb::arg("v"), nb::arg("updates"), nb::arg("frozen").none(),
          nb::arg("rates"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"), nb::arg("gradient_norm").none(),
          nb::arg("seen").none());
}

}  // namespace gsmap
