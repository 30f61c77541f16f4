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
template <class T, class Room> auto numpy_of(std::vector<T, Room> &&values, std::initializer_list<std::size_t> shape) {
    using Kept = std::vector<T, Room>;
    if (values.empty()) values.reserve(1);  // numpy wants an address even for nothing
    auto *kept = new Kept(std::move(values));
    nb::capsule owner(kept, [](void *p) noexcept { delete static_cast<Kept *>(p); });
    return nb::ndarray<nb::numpy, T>(kept->data(), shape, owner);
}

}  // namespace gsmap
