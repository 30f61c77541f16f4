// Consistency graphs of point correspondences, and the votes of their pairs for a scale.
#include "correspondences.h"

#include <nanobind/stl/optional.h>

#include <cstring>
#include <optional>
#include <stdexcept>
#include <vector>

#include "arrays.h"
#include "rasteriser_view.h"

namespace gsmap {
namespace {

using Word = std::uint64_t;
using Heights = std::optional<Numbers>;
using Ids = nb::ndarray<const std::int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

// What Python gave, checked, in floats about the mean: these keep 1e-6 of the extent, wherever the origin lies.
struct Table {
    std::vector<float> columns[8];
    Correspondences rows;

    Table(const Points &target, const Points &source, const Ids &target_ids, const Ids &source_ids,
          const Heights &target_heights, const Heights &source_heights, double scale) {
        std::size_t n = target.shape(0);
        if (source.shape(0) != n || target_ids.shape(0) != n || source_ids.shape(0) != n ||
            target_heights.has_value() != source_heights.has_value() ||
            (target_heights && (target_heights->shape(0) != n || source_heights->shape(0) != n)))
            throw std::invalid_argument("correspondences need arrays of one length, and both heights or none");
        for (int k = 0; k < 3; ++k) {
            columns[k] = centred(target.data() + k, n, 3, 1.0);
            columns[3 + k] = centred(source.data() + k, n, 3, scale);
        }
        columns[6] = target_heights ? centred(target_heights->data(), n, 1, 1.0) : std::vector<float>(n, 0.f);
        columns[7] = target_heights ? centred(source_heights->data(), n, 1, scale) : std::vector<float>(n, 0.f);
        const auto &c = columns;
        rows = {int(n), {c[0].data(), c[1].data(), c[2].data()}, {c[3].data(), c[4].data(), c[5].data()},
                c[6].data(), c[7].data(), target_ids.data(), source_ids.data()};
    }

    static std::vector<float> centred(const double *values, std::size_t n, int stride, double scale) {
        double mean = 0;
        for (std::size_t i = 0; i < n; ++i) mean += values[i * stride] / double(n);
        std::vector<float> out(n);
        for (std::size_t i = 0; i < n; ++i) out[i] = float(scale * (values[i * stride] - mean));
        return out;
    }
};

// Bit rows, zero before, of the graph in which correspondences i and j agree.
void consistency_graph(const Correspondences &c, const AgreeTest &test, Word *out) {
    int words = (c.n + 63) / 64;
    std::vector<std::uint8_t> ok(words * 64 + 1, 0);  // of the pairs (i, j > i)
    for (int i = 0; i < c.n; ++i) {
        kernels->agree(c, i, test, ok.data());
        for (int w = (i + 1) / 64; w < words; ++w) {
            Word bits = 0;
            for (int k = 0; k < 8; ++k) {  // eight bytes of 0 or 1 to eight bits at a time
                Word eight;
                std::memcpy(&eight, &ok[w * 64 + k * 8], 8);
                bits |= (eight * 0x0102040810204080u >> 56) << (k * 8);
            }
            out[std::size_t(i) * words + w] |= bits;
            for (; bits; bits &= bits - 1)
                out[std::size_t(w * 64 + __builtin_ctzll(bits)) * words + (i >> 6)] |= Word(1) << (i & 63);
        }
        ok[i + 1] = 0;
    }
}

void ratio_histogram(const Correspondences &c, const VoteTest &test, std::int64_t *counts) {
    std::vector<std::int32_t> bin(c.n);
    for (int i = 0; i < c.n; ++i) {
        kernels->vote(c, i, test, bin.data());
        int used = i;  // few pairs are: gathered without a branch, which would be foreseen badly
        for (int j = i + 1; j < c.n; ++j) {
            bin[used] = bin[j];
            used += bin[j] >= 0;
        }
        for (int k = i; k < used; ++k) ++counts[bin[k]];
    }
}

}  // namespace

void bind_correspondences(nb::module_ &m) {
    m.def(
        "consistency_graph",
        [](Points target, Points source, Ids target_ids, Ids source_ids, Heights target_heights, Heights source_heights,
           double scale, float slack, float relative_slack, float ratio, float min_distance, float height_slack,
           float height_slope) {
            Table table(target, source, target_ids, source_ids, target_heights, source_heights, scale);
            std::size_t n = target.shape(0), words = (n + 63) / 64;
            std::vector<Word> out(n * words);
            {
                nb::gil_scoped_release release;
                consistency_graph(table.rows,
                                  {slack, relative_slack, ratio, min_distance, height_slack, height_slope}, out.data());
            }
            return numpy_of(std::move(out), {n, words});
        },
        nb::arg("target"), nb::arg("source"), nb::arg("target_ids"), nb::arg("source_ids"),
        nb::arg("target_heights").none(), nb::arg("source_heights").none(), nb::arg("scale"), nb::arg("slack"),
        nb::arg("relative_slack"), nb::arg("ratio"), nb::arg("min_distance"), nb::arg("height_slack"),
        nb::arg("height_slope"), "Bit rows (n, ceil(n / 64)) of the graph in which correspondences agree.");
    m.def(
        "ratio_histogram",
        [](Points target, Points source, Ids target_ids, Ids source_ids, Heights target_heights, Heights source_heights,
           float min_distance, float rise_tolerance, float limit, int bins) {
            if (bins < 1) throw std::invalid_argument("a histogram needs a bin");
            Table table(target, source, target_ids, source_ids, target_heights, source_heights, 1.0);
            std::vector<std::int64_t> counts(bins);
            {
                nb::gil_scoped_release release;
                ratio_histogram(table.rows, {min_distance, rise_tolerance, limit, bins}, counts.data());
            }
            return numpy_of(std::move(counts), {std::size_t(bins)});
        },
        nb::arg("target"), nb::arg("source"), nb::arg("target_ids"), nb::arg("source_ids"),
        nb::arg("target_heights").none(), nb::arg("source_heights").none(), nb::arg("min_distance"),
        nb::arg("rise_tolerance"), nb::arg("limit"), nb::arg("bins"),
        "Counts (bins,) of the logarithms of distance ratios, target over source, over [-limit, limit].");
}

}  // namespace gsmap
