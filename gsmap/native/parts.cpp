// Parts of a graph whose nodes are alike: Felzenszwalb and Huttenlocher 2004, "Efficient graph-based image segmentation".
#include <algorithm>
#include <cstdint>
#include <numeric>
#include <stdexcept>
#include <utility>
#include <vector>

#include "arrays.h"

namespace gsmap {
namespace {

using Rows = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

// Which nodes are joined, how many to a part, and up to which weight a part takes an edge.
struct Forest {
    std::vector<int64_t> parent, size;
    std::vector<double> limit;

    Forest(int64_t count, double scale) : parent(count), size(count, 1), limit(count, scale) {
        std::iota(parent.begin(), parent.end(), 0);
    }
    int64_t find(int64_t i) {
        while (parent[i] != i) i = parent[i] = parent[parent[i]];
        return i;
    }
    void join(int64_t i, int64_t j) {
        parent[j] = i;
        size[i] += size[j];
    }
};

std::vector<int64_t> parts(int64_t count, const int64_t *a, const int64_t *b, const double *weight, std::size_t edges,
                           double scale, int64_t min_size) {
    Forest forest(count, scale);
    for (std::size_t e = 0; e < edges; ++e) {
        const int64_t i = forest.find(a[e]), j = forest.find(b[e]);
        if (i == j || weight[e] > forest.limit[i] || weight[e] > forest.limit[j]) continue;
        forest.join(i, j);
        forest.limit[i] = weight[e] + scale / double(forest.size[i]);
    }
    for (std::size_t e = 0; e < edges; ++e) {
        const int64_t i = forest.find(a[e]), j = forest.find(b[e]);
        if (i != j && std::min(forest.size[i], forest.size[j]) < min_size) forest.join(i, j);
    }
    std::vector<int64_t> out(count);
    for (int64_t i = 0; i < count; ++i) out[i] = forest.find(i);
    return out;
}

}  // namespace

void bind_parts(nb::module_ &m) {
    m.def(
        "graph_parts",
        [](int64_t count, Rows a, Rows b, Numbers weight, double scale, int64_t min_size) {
            const std::size_t edges = a.shape(0);
            if (b.shape(0) != edges || weight.shape(0) != edges) throw std::invalid_argument("edges have two ends and a weight");
            for (std::size_t e = 0; e < edges; ++e)
                for (int64_t end : {a.data()[e], b.data()[e]})
                    if (end < 0 || end >= count) throw std::invalid_argument("an edge ends at a node");
            std::vector<int64_t> out;
            {
                nb::gil_scoped_release release;
                out = parts(count, a.data(), b.data(), weight.data(), edges, scale, min_size);
            }
            return numpy_of(std::move(out), {std::size_t(count)});
        },
        nb::arg("count"), nb::arg("a"), nb::arg("b"), nb::arg("weight"), nb::arg("scale"), nb::arg("min_size"),
        "The node (count,) that stands for each node's part, of a graph whose edges come in the order of their weights.");
}

}  // namespace gsmap
