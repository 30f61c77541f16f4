// Points by the cells of a grid: which share one.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "memory.h"

namespace gsmap {
namespace {

using Keys = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

struct Keyed {
    uint64_t key;
    int64_t row;
};

// Sorts by the key, equal ones as they come: digit by digit from the lowest, digits that all have in common left out.
void sort(Zeros<Keyed> &values) {
    constexpr int kBits = 11;
    constexpr uint64_t kDigits = 1 << kBits;
    uint64_t most = 0;
    for (const Keyed &v : values) most = std::max(most, v.key);
    Zeros<Keyed> other(values.size());
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
void rank(const int64_t *keys, std::size_t count, Many<int64_t> &label, std::vector<int64_t> &times) {
    Zeros<Keyed> sorted(count);
    for (std::size_t i = 0; i < count; ++i) sorted[i] = {uint64_t(keys[i]), int64_t(i)};
    sort(sorted);
    label.resize(count);
    for (std::size_t i = 0; i < count; ++i) {
        if (!i || sorted[i].key != sorted[i - 1].key) times.push_back(0);
        ++times.back();
        label[sorted[i].row] = int64_t(times.size()) - 1;
    }
}

// std::floor, without the call that older processors need for it.
inline double floor_of(double v) {
    if (!(std::abs(v) < 0x1p52)) return v;  // has no fraction
    const double whole = double(int64_t(v));
    return whole - (v < whole);
}

// Weighted means of the points in each cell of a grid, and of three values of each, in the order of the cells.
struct Means {
    Many<double> points, values, weights;

    Means(const Points &all, const Points &of, const double *weight, const double *origin, double cell) {
        const std::size_t count = all.shape(0);
        Zeros<Keyed> sorted(count);
        double low[3] = {__builtin_inf(), __builtin_inf(), __builtin_inf()}, high[3] = {-low[0], -low[0], -low[0]};
        for (std::size_t i = 0; i < count; ++i)
            for (int k = 0; k < 3; ++k) {
                low[k] = std::min(low[k], all.data()[3 * i + k]);
                high[k] = std::max(high[k], all.data()[3 * i + k]);
            }
        uint64_t side[3] = {};
        double cells = 1;
        for (int k = 0; count && k < 3; ++k) {
            low[k] = std::floor((low[k] - origin[k]) / cell);
            const double wide = std::floor((high[k] - origin[k]) / cell) - low[k] + 1;
            if (!((cells *= wide) < 0x1p62)) throw std::overflow_error("so many cells have no number each");
            side[k] = uint64_t(wide);
        }
        for (std::size_t i = 0; i < count; ++i) {
            uint64_t key = 0;
            for (int k = 0; k < 3; ++k)
                key = key * side[k] + uint64_t(floor_of((all.data()[3 * i + k] - origin[k]) / cell) - low[k]);
            sorted[i] = {key, int64_t(i)};
        }
        sort(sorted);
        std::size_t occupied = 0;
        for (std::size_t i = 0; i < count; ++i) occupied += !i || sorted[i].key != sorted[i - 1].key;
        points.reserve(3 * occupied), values.reserve(3 * occupied), weights.reserve(occupied);
        for (std::size_t i = 0, end = 0; i < count; i = end) {
            double sums[6] = {}, total = 0;
            for (end = i; end < count && sorted[end].key == sorted[i].key; ++end) {
                const int64_t row = sorted[end].row;
                const double share = weight ? weight[row] : 1.0;
                total += share;
                for (int k = 0; k < 3; ++k) {
                    sums[k] += share * all.data()[3 * row + k];
                    sums[3 + k] += share * of.data()[3 * row + k];
                }
            }
            const double divisor = std::max(total, 1e-300);  // a cell without weight has its middle at 0
            for (int k = 0; k < 3; ++k) {
                points.push_back(sums[k] / divisor);
                values.push_back(sums[3 + k] / divisor);
            }
            weights.push_back(divisor);
        }
    }
};

}  // namespace

void bind_cells(nb::module_ &m) {
    m.def(
        "ranks",
        [](Keys keys) {
            for (std::size_t i = 0; i < keys.shape(0); ++i)
                if (keys.data()[i] < 0) throw std::invalid_argument("keys must not be negative");
            Many<int64_t> label;
            std::vector<int64_t> times;
            {
                nb::gil_scoped_release release;
                rank(keys.data(), keys.shape(0), label, times);
            }
            const std::size_t kinds = times.size();
            return std::make_tuple(numpy_of(std::move(label), {keys.shape(0)}), numpy_of(std::move(times), {kinds}));
        },
        nb::arg("keys"), "Rank (n,) of each key, 0 or more, among those that occur, and how often each of these does.");
    m.def(
        "cell_means",
        [](Points points, Points values, std::optional<Numbers> weights, Points origin, double cell) {
            const std::size_t n = points.shape(0);
            if (values.shape(0) != n || (weights && weights->shape(0) != n) || origin.shape(0) != 1)
                throw std::invalid_argument("points need three values each, a weight each, and one origin");
            if (!(cell > 0)) throw std::invalid_argument("cells have a size");
            for (std::size_t i = 0; i < 3 * n; ++i)
                if (!std::isfinite(points.data()[i])) throw std::invalid_argument("points must be finite");
            std::optional<Means> out;
            {
                nb::gil_scoped_release release;
                out.emplace(points, values, weights ? weights->data() : nullptr, origin.data(), cell);
            }
            const std::size_t cells = out->weights.size();
            return std::make_tuple(numpy_of(std::move(out->points), {cells, 3}), numpy_of(std::move(out->values), {cells, 3}),
                                   numpy_of(std::move(out->weights), {cells}));
        },
        nb::arg("points"), nb::arg("values"), nb::arg("weights").none(), nb::arg("origin"), nb::arg("cell"),
        "Weighted means (m, 3) of the points in each occupied cell of a grid from an origin (1, 3), and of their values\n"
        "(n, 3), in the order of the cells; and weights (m,). OverflowError where cells cannot be numbered.");
}

}  // namespace gsmap
