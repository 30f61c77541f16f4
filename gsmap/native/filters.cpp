// Windows that move over a picture: weighted sums and highest values, one axis after the other.
#include "filters.h"

#include <stdexcept>
#include <vector>

#include "arrays.h"
#include "rasteriser_view.h"

namespace gsmap {
namespace {

using Picture = nb::ndarray<const float, nb::shape<-1, -1, -1>, nb::c_contig, nb::device::cpu>;
using Weights = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

}  // namespace

void bind_filters(nb::module_ &m) {
    m.def(
        "smoothed",
        [](Picture image, Weights weights, bool reflect, int first, int step) {
            if (first < 0 || step < 1) throw std::invalid_argument("pixels are asked for from one on, every so many");
            if (weights.size() % 2 == 0) throw std::invalid_argument("a window that is weighed has a middle");
            const std::size_t reach = weights.size() / 2, h = image.shape(0), w = image.shape(1), c = image.shape(2);
            const Every every{first, step};
            const std::size_t rows = every.count(h), columns = every.count(w);
            std::vector<float> out(rows * columns * c);
            if (image.size()) {
                nb::gil_scoped_release release;
                windowed(image.data(), h, w, c, reach, reach, reflect ? Edge::kReflect : Edge::kNearest, out.data(),
                         [&](const float *const *rows, int n, int64_t count, float *to) {
                             kernels->weigh(rows, weights.data(), n, count, to);
                         }, every);
            }
            return numpy_of(std::move(out), {rows, columns, c});
        },
        nb::arg("image"), nb::arg("weights"), nb::arg("reflect"), nb::arg("first") = 0, nb::arg("step") = 1,
        "(H, W, C) an image weighed along both of its axes, of the pixels [first::step] alone; beyond its edges it goes on "
        "as its last row, or reflected.");
    m.def(
        "slopes",
        [](Picture image) {
            const std::size_t h = image.shape(0), w = image.shape(1), c = image.shape(2), row = w * c;
            if (h < 2 || w < 2) throw std::invalid_argument("a slope is that of two pixels");
            std::vector<float> out(2 * image.size());
            const float *at = image.data();
            float *to = out.data();
            for (std::size_t y = 0; y < h; ++y)
                for (std::size_t x = 0; x < w; ++x, at += c, to += 2 * c) {
                    const std::ptrdiff_t above = y ? row : 0, below = y + 1 < h ? row : 0;
                    const std::ptrdiff_t left = x ? c : 0, right = x + 1 < w ? c : 0;
                    for (std::size_t k = 0; k < c; ++k) {
                        to[k] = (at[k + below] - *(at + k - above)) * (above && below ? 0.5f : 1.f);
                        to[c + k] = (at[k + right] - *(at + k - left)) * (left && right ? 0.5f : 1.f);
                    }
                }
            return numpy_of(std::move(out), {h, w, std::size_t(2), c});
        },
        nb::arg("image"), "(H, W, 2, C) how an image changes along its columns and its rows, by central differences.");
    m.def(
        "highest",
        [](Picture image, int before, int after) {
            if (before < 0 || after < 0) throw std::invalid_argument("a window holds its own pixel");
            const std::size_t h = image.shape(0), w = image.shape(1), c = image.shape(2);
            std::vector<float> out(image.size());
            if (image.size()) {
                nb::gil_scoped_release release;
                windowed(image.data(), h, w, c, before, after, Edge::kNearest, out.data(),
                         [](const float *const *rows, int n, int64_t count, float *to) {
                             kernels->highest(rows, n, count, to);
                         });
            }
            return numpy_of(std::move(out), {h, w, c});
        },
        nb::arg("image"), nb::arg("before"), nb::arg("after"),
        "(H, W, C) the highest values within windows that reach so far before and after a pixel, along both axes.");
}

}  // namespace gsmap
