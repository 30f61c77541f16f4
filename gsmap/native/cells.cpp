// Points by the cells of a grid: which share one.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <numeric>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"

namespace gsmap {
namespace {

using Keys = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

struct Keyed {
    uint64_t key;
    int64_t row;
};

// Sorts by the key, equal ones as they come: digit by digit from the lowest, digits that all have in common left out.
void sort(std::vector<Keyed> &values) {
    constexpr int kBits = 11;
    constexpr uint64_t kDigits = 1 << kBits;
    uint64_t most = 0;
    for (const Keyed &v : values) most = std::max(most, v.key);
    std::vector<Keyed> other(values.size());
    for (int shift = 0; shift < 64 && most >> shift; shift += kBits) {
        std::array<std::size_t, kDigits + 1> begin{};
        for (const Keyed &v : values) ++begin[(v.key >> shift) % kDigits + 1];
        if (std::find(begin.begin(), begin.end(), values.size()) != begin.end()) continue;
        std::partial_sum(begin.begin(), begin.end(), begin.begin());
        for (const Keyed &v : values) other[begin[(v.key >> shift) % kDigits]++] = v;
        values.swap(other);
    }
}

// The rank of each key among those that occur, and how often each of these does.
void rank(const int64_t *keys, std::size_t count, std::vector<int64_t> &label, std::vector<int64_t> &times) {
    std::vector<Keyed> sorted(count);
    for (std::size_t i = 0; i < count; ++i) sorted[i] = {uint64_t(keys[i]), int64_t(i)};
    sort(sorted);
    label.resize(count);
    for (std::size_t i = 0; i < count; ++i) {
        if (!i || sorted[i].key != sorted[i - 1].key) times.push_back(0);
        ++times.back();
        label[sorted[i].row] = int64_t(times.size()) - 1;
    }
}

}  // namespace

void bind_cells(nb::module_ &m) {
    m.def(
        "ranks",
        [](Keys keys) {
            for (std::size_t i = 0; i < keys.shape(0); ++i)
                if (keys.data()[i] < 0) throw std::invalid_argument("keys must not be negative");
            std::vector<int64_t> label, times;
            {
                nb::gil_scoped_release release;
                rank(keys.data(), keys.shape(0), label, times);
            }
            const std::size_t kinds = times.size();
            return std::make_tuple(numpy_of(std::move(label), {keys.shape(0)}), numpy_of(std::move(times), {kinds}));
        },
        nb::arg("keys"), "Rank (n,) of each key, 0 or more, among those that occur, and how often each of these does.");
}

}  // namespace gsmap
