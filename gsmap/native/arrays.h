// Arrays that kernels take from Python, and give it. What their types do not say of shapes is checked in each binding.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <initializer_list>
#include <utility>
#include <vector>

namespace nb = nanobind;

namespace gsmap {

using Points = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Numbers = nb::ndarray<const double, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

// A numpy array that owns the values of a vector, without a copy; needs the GIL.
template <class T> auto numpy_of(std::vector<T> &&values, std::initializer_list<std::size_t> shape) {
    if (values.empty()) values.reserve(1);  // numpy wants an address even for nothing
    auto *kept = new std::vector<T>(std::move(values));
    nb::capsule owner(kept, [](void *p) noexcept { delete static_cast<std::vector<T> *>(p); });
    return nb::ndarray<nb::numpy, T>(kept->data(), shape, owner);
}

}  // namespace gsmap
