// Nodes of a scene beside those in the lists of an index, by their codes (gsmap/retrieve/lookup.py).
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "rasteriser_view.h"

namespace gsmap {
namespace {

constexpr int64_t DIMS = 48, AT_ONCE = 256;
using Codes = nb::ndarray<const int8_t, nb::shape<-1, DIMS>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const uint8_t, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Places = nb::ndarray<const int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Nearest = nb::ndarray<int32_t, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;

}  // namespace

void bind_codes(nb::module_ &m) {
    m.def(
        "near_codes",
        [](Codes mine, Indices asking, Indices begin, Indices end, Rows rows, Places place_of, Nearest nearest) {
            const int64_t pairs = asking.size(), width = rows.shape(1), votes = nearest.shape(1);
            if (begin.size() != asking.size() || end.size() != asking.size() || nearest.shape(0) != mine.shape(0) ||
                votes < 1 || width < DIMS + 4)
                throw std::invalid_argument("every code that asks has lists, and keeps its nearest");
            std::vector<int64_t> who, which, squared, places;
            {
                nb::gil_scoped_release release;
                int32_t at[AT_ONCE + 1], far[AT_ONCE + 1];
                for (int64_t p = 0; p < pairs; ++p) {
                    const int64_t q = asking.data()[p], low = begin.data()[p], high = end.data()[p];
                    if (q < 0 || q >= int64_t(mine.shape(0)) || low < 0 || high > int64_t(rows.shape(0)))
                        throw std::invalid_argument("a list lies outside of the rows");
                    int16_t code[DIMS];
                    std::copy_n(mine.data() + q * DIMS, DIMS, code);
                    int32_t *heap = nearest.data() + q * votes;  // the largest first
                    for (int64_t start = low; start < high; start += AT_ONCE) {
                        const uint8_t *first = rows.data() + start * width;
                        const int64_t found = kernels->within(code, reinterpret_cast<const int8_t *>(first), width,
                                                              std::min(AT_ONCE, high - start), heap[0], at, far);
                        for (int64_t i = 0; i < found; ++i) {
                            if (far[i] > heap[0]) continue;
                            int32_t own;
                            std::memcpy(&own, first + at[i] * width + width - 4, 4);
                            if (own < 0 || own >= int64_t(place_of.size()))
                                throw std::invalid_argument("a row is of a scene that is not there");
                            const int32_t place = place_of.data()[own];
                            if (place < 0) continue;
                            who.push_back(q), which.push_back(start + at[i]);
                            squared.push_back(far[i]), places.push_back(place);
                            if (far[i] < heap[0]) {
                                std::pop_heap(heap, heap + votes);
                                heap[votes - 1] = far[i];
                                std::push_heap(heap, heap + votes);
                            }
                        }
                    }
                }
            }
            const std::size_t n = who.size();
            return std::make_tuple(numpy_of(std::move(who), {n}), numpy_of(std::move(which), {n}),
                                   numpy_of(std::move(squared), {n}), numpy_of(std::move(places), {n}));
        },
        nb::arg("mine"), nb::arg("asking"), nb::arg("begin"), nb::arg("end"), nb::arg("rows"), nb::arg("place_of"),
        nb::arg("nearest"),
        "Of codes (Q, 48), each beside the rows [begin, end) (P,) that the pair `asking` is of, those that are as near as "
        "the last of its nearest: who, which row, squared distance, and the place of its scene. Rows end in four bytes "
        "that say whose they are; `place_of` (members,) says which place that is, -1 of those that do not count. "
        "`nearest` (Q, votes) int32 holds squared distances as a heap, the largest first, and is written: what is farther "
        "than that is left out. Raises ValueError where a row is of no member.");
}

}  // namespace gsmap
