// Array types that the rasteriser's bindings share. Shapes are checked in Python.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstring>
#include <optional>

#include "rasteriser.h"

namespace nb = nanobind;

namespace gsmap {

using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using FloatsOut = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using DoublesOut = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using Ints = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;
using Ranges = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const uint8_t, nb::c_contig, nb::device::cpu>;

inline Scene scene_of(const Floats &means, const Floats &quats, const Floats &log_scales, const Floats &logits,
                      const Floats &sh) {
    return {means.data(), quats.data(), log_scales.data(), logits.data(), sh.data(), int64_t(means.shape(0)), int(sh.shape(1))};
}

inline Image image_of(const Floats &background, const FloatsOut &colour, const std::optional<FloatsOut> &depth,
                      const FloatsOut &alpha) {
    Image image{colour.data(), depth ? depth->data() : nullptr, alpha.data(), nullptr, nullptr, nullptr, {}};
    std::memcpy(image.background, background.data(), sizeof image.background);
    return image;
}

}  // namespace gsmap
