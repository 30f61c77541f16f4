// Clusters of points that lie within reach of each other.
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <vector>

#include "arrays.h"

namespace gsmap {
namespace {

using Kinds = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Cell = std::array<int64_t, 4>;  // kind, x, y, z

struct Placed {
    Cell cell;
    int64_t row;
};

// In cells so small that all points of one are within reach, only cells are left to be linked: those at most two apart.
std::vector<int64_t> clusters(const double *points, std::size_t count, const int64_t *kind, double reach) {
    const double edge = reach / std::sqrt(3.0) * (1 - 1e-6);
    std::vector<Placed> placed(count);
    for (std::size_t i = 0; i < count; ++i) {
        placed[i] = {{kind ? kind[i] : 0, 0, 0, 0}, int64_t(i)};
        for (int k = 0; k < 3; ++k) placed[i].cell[k + 1] = int64_t(std::floor(points[3 * i + k] / edge));
    }
    std::sort(placed.begin(), placed.end(),
              [](const Placed &a, const Placed &b) { return a.cell < b.cell || (a.cell == b.cell && a.row < b.row); });
    std::vector<std::size_t> begin;  // of each cell, in their order
    for (std::size_t i = 0; i < count; ++i)
        if (!i || placed[i].cell != placed[i - 1].cell) begin.push_back(i);
    const std::size_t cells = begin.size();
    begin.push_back(count);
    std::vector<int64_t> parent(cells);
    std::iota(parent.begin(), parent.end(), 0);
    const auto find = [&](int64_t i) {
        while (parent[i] != i) i = parent[i] = parent[parent[i]];
        return i;
    };
    const auto touch = [&](std::size_t a, std::size_t b) {
        for (std::size_t i = begin[a]; i < begin[a + 1]; ++i)
            for (std::size_t j = begin[b]; j < begin[b + 1]; ++j) {
                double squared = 0;
                for (int k = 0; k < 3; ++k) {
                    const double off = points[3 * placed[i].row + k] - points[3 * placed[j].row + k];
                    squared += off * off;
                }
                if (squared <= reach * reach) return true;
            }
        return false;
    };
    // Of the cells around each, those that come after it: runs along z, whose starts only move on as cells do.
    for (int64_t dx = 0; dx <= 2; ++dx)
        for (int64_t dy = dx ? -2 : 0; dy <= 2; ++dy)
            for (std::size_t at = 0, next = 0; at < cells; ++at) {
                Cell from = placed[begin[at]].cell;
                const int64_t last = from[3] + 2;
                from[1] += dx, from[2] += dy, from[3] += dx || dy ? -2 : 1;
                while (next < cells && placed[begin[next]].cell < from) ++next;
                for (std::size_t other = next; other < cells; ++other) {
                    const Cell &cell = placed[begin[other]].cell;
                    if (cell[0] != from[0] || cell[1] != from[1] || cell[2] != from[2] || cell[3] > last) break;
                    const int64_t a = find(int64_t(at)), b = find(int64_t(other));
                    if (a != b && touch(at, other)) parent[b] = a;
                }
            }
    std::vector<int64_t> of(count), name(cells, -1);
    for (std::size_t c = 0; c < cells; ++c)
        for (std::size_t i = begin[c]; i < begin[c + 1]; ++i) of[placed[i].row] = find(int64_t(c));
    int64_t named = 0;
    for (int64_t &label : of) {
        if (name[label] < 0) name[label] = named++;
        label = name[label];
    }
    return of;
}

}  // namespace

void bind_clusters(nb::module_ &m) {
    m.def(
        "clusters",
        [](Points points, double reach, std::optional<Kinds> kind) {
            const std::size_t count = points.shape(0);
            if (kind && kind->shape(0) != count) throw std::invalid_argument("points need a kind each");
            if (!(reach > 0)) throw std::invalid_argument("a reach is positive");
            for (std::size_t i = 0; i < 3 * count; ++i)
                if (!(std::abs(points.data()[i]) < 0x1p60 * reach))
                    throw std::invalid_argument("points must be finite, and not out of all reach");
            std::vector<int64_t> out;
            {
                nb::gil_scoped_release release;
                out = clusters(points.data(), count, kind ? kind->data() : nullptr, reach);
            }
            return numpy_of(std::move(out), {count});
        },
        nb::arg("points"), nb::arg("reach"), nb::arg("kind").none(),
        "Label (n,) of the cluster of each point, in the order of their first points: points of one kind (n,) that lie\n"
        "within reach of each other are of one.");
}

}  // namespace gsmap
