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
        [](Picture image, Weights weights, bool reflect) {
            if (weights.size() % 2 == 0) throw std::invalid_argument("a window that is weighed has a middle");
            const std::size_t reach = weights.size() / 2, h = image.shape(0), w = image.shape(1), c = image.shape(2);
            std::vector<float> out(image.size());
            if (image.size()) {
                nb::gil_scoped_release release;
                windowed(image.data(), h, w, c, reach, reach, reflect ? Edge::kReflect : Edge::kNearest, out.data(),
                         [&](const float *const *rows, int n, int64_t count, float *to) {
                             kernels->weigh(rows, weights.data(), n, count, to);
                         });
            }
            return numpy_of(std::move(out), {h, w, c});
        },
        nb::arg("image"), nb::arg("weights"), nb::arg("reflect"),
        "(H, W, C) an image weighed along both of its axes; beyond its edges it goes on as its last row, or reflected.");
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
