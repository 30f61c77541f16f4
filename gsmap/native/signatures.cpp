// Features of a photograph beside those in the lists of an index, by their signatures (gsmap/localize/retrieval.py).
#include <nanobind/stl/tuple.h>

#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "rasteriser_view.h"

namespace gsmap {
namespace {

using Signs = nb::ndarray<const uint64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

}  // namespace

void bind_signatures(nb::module_ &m) {
    m.def(
        "near_signatures",
        [](Signs mine, Rows begin, Rows end, Signs theirs, int most) {
            if (begin.size() != mine.size() || end.size() != mine.size())
                throw std::invalid_argument("every signature is looked for in one list");
            std::vector<int64_t> who, which, differ;
            {
                nb::gil_scoped_release release;
                std::vector<int32_t> at(theirs.size() + 1);
                std::vector<uint8_t> signs(theirs.size() + 1);
                for (std::size_t k = 0; k < mine.size(); ++k) {
                    const int64_t low = begin.data()[k], high = end.data()[k];
                    if (low < 0 || high < low || high > int64_t(theirs.size()))
                        throw std::invalid_argument("a list lies outside of the signatures");
                    const int64_t found =
                        kernels->near(mine.data()[k], theirs.data() + low, high - low, most, at.data(), signs.data());
                    for (int64_t i = 0; i < found; ++i)
                        who.push_back(int64_t(k)), which.push_back(low + at[i]), differ.push_back(signs[i]);
                }
            }
            const std::size_t n = who.size();
            return std::make_tuple(numpy_of(std::move(who), {n}), numpy_of(std::move(which), {n}),
                                   numpy_of(std::move(differ), {n}));
        },
        nb::arg("mine"), nb::arg("begin"), nb::arg("end"), nb::arg("theirs"), nb::arg("most"),
        "Pairs of signatures (P,) and rows [begin, end) of others that differ in at most so many signs: who, which, in how "
        "many; in order.");
}

}  // namespace gsmap
