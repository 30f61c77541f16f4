// Optimisation steps: image loss with its gradient, and backward pass and Adam in one sweep over the Gaussians.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <stdexcept>
#include <vector>

#include "bindings.h"
#include "rasteriser_view.h"
#include "threads.h"

namespace gsmap {
namespace {

constexpr int kTaps = 11, kReach = 5;

// Structural similarity of one channel plane and its gradient with respect to a, both (height, width).
class Ssim {
  public:
    Ssim(int width, int height) : width_(width), height_(height), size_(size_t(width) * height) {
        for (auto &plane : planes_) plane.resize(size_);
        spare_.resize(size_);
    }

    // Returns sum mask * ssim; adds scale * its gradient to g[3 * i].
    double add(const float *a, const float *b, const float *mask, float scale, float *g) {
        float *ma = planes_[0].data(), *mb = planes_[1].data(), *aa = planes_[2].data(), *bb = planes_[3].data(),
              *ab = planes_[4].data();
        rows([&](int64_t from, int64_t to) {
            for (int64_t i = from; i < to; i++) {
                const float x = a[3 * i], y = b[3 * i];
                ma[i] = x, mb[i] = y, aa[i] = x * x, bb[i] = y * y, ab[i] = x * y;
            }
        });
        for (auto &plane : planes_) blur(plane);
        std::vector<double> sums(height_);
        parallel_for(height_, [&](int64_t r) {
            const int64_t o = r * width_;
            sums[r] = kernels->ssim(ma + o, mb + o, aa + o, bb + o, ab + o, mask ? mask + o : nullptr, width_);
        });
        blur(planes_[0]), blur(planes_[2]), blur(planes_[4]);
        rows([&](int64_t from, int64_t to) {
            for (int64_t i = from; i < to; i++)
                g[3 * i] += scale * (ma[i] + 2.f * a[3 * i] * aa[i] + b[3 * i] * ab[i]);
        });
        double sum = 0;
        for (double s : sums) sum += s;
        return sum;
    }

  private:
    template <class Body> void rows(Body body) {
        parallel_for(height_, [&](int64_t r) { body(r * width_, (r + 1) * width_); });
    }
    void blur(std::vector<float> &plane) {  // zeros outside the image
        parallel_for(height_, [&](int64_t r) {
            std::vector<float> padded(width_ + 2 * kReach);
            std::memcpy(padded.data() + kReach, &plane[r * width_], width_ * sizeof(float));
            const float *from[kTaps];
            for (int j = 0; j < kTaps; j++) from[j] = padded.data() + j;
            kernels->blur(from, &spare_[r * width_], width_);
        });
        parallel_for(height_, [&](int64_t r) {
            const float *from[kTaps];
            for (int j = 0; j < kTaps; j++) {
                const int64_t y = r + j - kReach;
                from[j] = y < 0 || y >= height_ ? nullptr : &spare_[y * width_];
            }
            kernels->blur(from, &plane[r * width_], width_);
        });
    }
    int width_, height_;
    size_t size_;
    std::vector<float> planes_[5], spare_;
};

// (1 - s) * L1 + s * (1 - SSIM), means over pixels weighed by mask (H, W); writes the gradient (H, W, 3).
double image_loss(const Floats &image, const Floats &target, const std::optional<Floats> &mask, float ssim_weight,
                  const FloatsOut &gradient) {
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
        sums[r] = kernels->l1(a + 3 * o, b + 3 * o, m ? m + o : nullptr, width, float((1 - ssim_weight) * per_value),
                              g + 3 * o);
    });
    double l1 = 0;
    for (double s : sums) l1 += s;
    double loss = (1 - ssim_weight) * l1 * per_value;
    if (ssim_weight > 0) {
        Ssim ssim(width, height);
        double similar = 0;
        for (int c = 0; c < 3; c++) similar += ssim.add(a + c, b + c, m, float(-ssim_weight * per_value), g + c);
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
        views[i]->pixels_backward(one, {gradient + 3 * pixels * i, nullptr, nullptr});
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
          nb::arg("gradient"));
    m.def("fit_step", &fit_step, nb::arg("views"), nb::arg("background"), nb::arg("colour"), nb::arg("alpha"),
          nb::arg("g_colour"), nb::arg("values"), nb::arg("m"), nb::arg("v"), nb::arg("updates"), nb::arg("frozen").none(),
          nb::arg("rates"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"), nb::arg("gradient_norm").none(),
          nb::arg("seen").none());
}

}  // namespace gsmap
