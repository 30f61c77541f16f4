// Features of two pictures that are each other's nearest (gsmap/localize/matching.py).
#include "matches.h"

#include <nanobind/stl/tuple.h>

#include <climits>
#include <memory>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "rasteriser_view.h"

namespace gsmap {
namespace {

using Given = nb::ndarray<const int8_t, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;

Descriptors descriptors_of(const Given &given) {
    if (given.shape(0) > INT_MAX / 2) throw std::invalid_argument("too many descriptors");
    return {given.data(), int(given.shape(0)), int(given.shape(1))};
}

}  // namespace

void bind_matches(nb::module_ &m) {
    m.def(
        "mutual_nearest",
        [](Given mine, Given theirs) {
            if (mine.shape(1) != theirs.shape(1) || mine.shape(1) < 1 || mine.shape(1) > kMaxWidth)
                throw std::invalid_argument("descriptors need one width, of 1 to 1024");
            const Descriptors one = descriptors_of(mine), other = descriptors_of(theirs);
            std::vector<int64_t> row, column;
            std::vector<float> top, next;
            if (one.count && other.count) {
                nb::gil_scoped_release release;
                const std::size_t columns = (std::size_t(other.count) + 15) / 16 * 16;
                const std::size_t width = (std::size_t(one.width) + 3) / 4 * 4;
                const std::unique_ptr<unsigned char[]> room(
                    new unsigned char[sizeof(float) * ((one.count + columns) * width + one.count)]);
                std::vector<int32_t> row_column(one.count), column_row(columns);
                std::vector<float> row_top(one.count), row_next(one.count), column_top(columns);
                kernels->nearest(one, other, room.get(),
                                 {row_column.data(), row_top.data(), row_next.data(), column_row.data(), column_top.data()});
                for (int i = 0; i < one.count; ++i) {
                    const int j = row_column[i];
                    if (column_row[j] != i) continue;
                    row.push_back(i), column.push_back(j), top.push_back(row_top[i]), next.push_back(row_next[i]);
                }
            }
            const std::size_t n = row.size();
            return std::make_tuple(numpy_of(std::move(row), {n}), numpy_of(std::move(column), {n}),
                                   numpy_of(std::move(top), {n}), numpy_of(std::move(next), {n}));
        },
        nb::arg("mine"), nb::arg("theirs"),
        "Rows of descriptors (N, D) and (M, D) that have the largest product with each other, the first of those that are "
        "as large: rows (K,) of mine, rising, and of theirs, these products, and the next largest of each row of mine.");
}

}  // namespace gsmap
