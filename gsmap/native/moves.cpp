// Poses about the vertical that lay what one capture shows on what another does; see gsmap/change/poses.py.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "point_tree.h"

namespace gsmap {
namespace {

using Features = nb::ndarray<const double, nb::shape<-1, 6>, nb::c_contig, nb::device::cpu>;
using Plan = nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Turn = nb::ndarray<const double, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>;
using Shift = nb::ndarray<const double, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

struct FeatureTree : Tree<6> {
    using Tree<6>::Tree;
};

struct Pose {
    double turn[9], shift[3];

    void apply(const double *p, double *out) const {
        for (int i = 0; i < 3; ++i)
            out[i] = turn[3 * i] * p[0] + turn[3 * i + 1] * p[1] + turn[3 * i + 2] * p[2] + shift[i];
    }
};

struct Pair {
    const double *from, *to;
    double weight;
};

// One step of ICP over yaw and shift for each radius; as it is where fewer pairs are found than tell a pose.
void settle(const FeatureTree &tree, const double *moving, std::size_t count, const double *radii, std::size_t steps,
            double sink, int fewest, Pose &pose) {
    const double level = pose.shift[2];
    std::vector<Pair> pairs;
    for (std::size_t s = 0; s < steps; ++s) {
        const double radius = radii[s];
        pairs.clear();
        for (std::size_t i = 0; i < count; ++i) {
            double at[6];
            pose.apply(moving + 6 * i, at);
            std::copy_n(moving + 6 * i + 3, 3, at + 3);
            const Neighbour near = tree.nearest(at, {4 * radius * radius, -1});
            if (near.row < 0) continue;
            const double off = std::sqrt(near.squared) / (0.5 * radius), share = 1 / (1 + off * off);
            pairs.push_back({moving + 6 * i, tree.point(near.row), share * share});
        }
        if (int(pairs.size()) < fewest) return;
        double total = 0, from[3] = {}, to[3] = {}, sine = 0, cosine = 0;
        for (const Pair &p : pairs) {
            total += p.weight;
            for (int k = 0; k < 3; ++k) from[k] += p.weight * p.from[k], to[k] += p.weight * p.to[k];
        }
        for (int k = 0; k < 3; ++k) from[k] /= total, to[k] /= total;
        for (const Pair &p : pairs) {
            const double sx = p.from[0] - from[0], sy = p.from[1] - from[1], tx = p.to[0] - to[0], ty = p.to[1] - to[1];
            sine += p.weight * (sx * ty - sy * tx), cosine += p.weight * (sx * tx + sy * ty);
        }
        const double yaw = std::atan2(sine, cosine), c = std::cos(yaw), z = std::sin(yaw);
        const double turn[9] = {c, -z, 0, z, c, 0, 0, 0, 1}, still[3] = {0, 0, 0};
        std::copy_n(turn, 9, pose.turn), std::copy_n(still, 3, pose.shift);
        double turned[3];
        pose.apply(from, turned);
        for (int k = 0; k < 3; ++k) pose.shift[k] = to[k] - turned[k];
        pose.shift[2] = std::min(std::max(pose.shift[2], level - sink), level + sink);
    }
}

// The most voted cells of the shifts from a to b, rows (votes, x, y), each the mean of what voted for it and its neighbours.
void vote(const double *a, const double *b, const Rows &i, const Rows &j, const double *weight, double c, double s, double bin,
          int peaks, std::vector<double> &shift, std::vector<int64_t> &cell, std::vector<double> &out) {
    const std::size_t pairs = i.shape(0);
    int64_t low[2] = {INT64_MAX, INT64_MAX}, high[2] = {INT64_MIN, INT64_MIN};
    for (std::size_t p = 0; p < pairs; ++p) {
        const double *from = a + 2 * i.data()[p], *to = b + 2 * j.data()[p];
        shift[2 * p] = to[0] - (c * from[0] - s * from[1]), shift[2 * p + 1] = to[1] - (s * from[0] + c * from[1]);
        for (int k = 0; k < 2; ++k) {
            cell[2 * p + k] = int64_t(std::floor(shift[2 * p + k] / bin));
            low[k] = std::min(low[k], cell[2 * p + k]), high[k] = std::max(high[k], cell[2 * p + k]);
        }
    }
    // Two cells of margin, so that neighbours of neighbours need no asking whether they are there.
    const int64_t wide = high[0] - low[0] + 5, deep = high[1] - low[1] + 5;
    if (double(wide) * double(deep) > 0x1p28) throw std::invalid_argument("votes are spread too far for their cells");
    std::vector<double> votes(std::size_t(wide * deep)), total(votes.size());
    for (std::size_t p = 0; p < pairs; ++p) {
        for (int k = 0; k < 2; ++k) cell[2 * p + k] -= low[k] - 2;
        votes[std::size_t(cell[2 * p] * deep + cell[2 * p + 1])] += weight[p];
    }
    for (int64_t x = 1; x + 1 < wide; ++x)
        for (int64_t y = 1; y + 1 < deep; ++y)
            for (int64_t dx = -1; dx <= 1; ++dx)
                for (int64_t dy = -1; dy <= 1; ++dy) total[x * deep + y] += votes[(x + dx) * deep + y + dy];
    for (int k = 0; k < peaks; ++k) {
        const int64_t best = std::max_element(total.begin(), total.end()) - total.begin(), x = best / deep, y = best % deep;
        if (!(total[best] > 0)) return;
        double mean[2] = {}, sum = 0;
        for (std::size_t p = 0; p < pairs; ++p)
            if (std::abs(cell[2 * p] - x) <= 1 && std::abs(cell[2 * p + 1] - y) <= 1) {
                mean[0] += weight[p] * shift[2 * p], mean[1] += weight[p] * shift[2 * p + 1], sum += weight[p];
            }
        out.insert(out.end(), {total[best], mean[0] / sum, mean[1] / sum});
        for (int64_t u = std::max<int64_t>(x - 2, 0); u <= std::min(x + 2, wide - 1); ++u)
            for (int64_t v = std::max<int64_t>(y - 2, 0); v <= std::min(y + 2, deep - 1); ++v) total[u * deep + v] = 0;
    }
}

template <class A> void finite(const A &values, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i)
        if (!std::isfinite(values.data()[i])) throw std::invalid_argument("places must be finite");
}

}  // namespace

void bind_moves(nb::module_ &m) {
    nb::class_<FeatureTree>(m, "FeatureTree", "Places and colours (n, 6), by the nearest in both.")
        .def(
            "__init__",
            [](FeatureTree *self, Features points) {
                if (points.shape(0) > std::size_t(INT32_MAX)) throw std::invalid_argument("a tree holds at most 2^31 points");
                finite(points, 6 * points.shape(0));
                new (self) FeatureTree(points.data(), int32_t(points.shape(0)));
            },
            nb::arg("points"))
        .def(
            "distances",
            [](const FeatureTree &tree, Features at, double radius) {
                std::vector<double> out(at.shape(0));
                {
                    nb::gil_scoped_release release;
                    for (std::size_t i = 0; i < out.size(); ++i) {
                        const Neighbour near = tree.nearest(at.data() + 6 * i, {radius * radius, -1});
                        out[i] = near.row < 0 ? __builtin_inf() : std::sqrt(near.squared);
                    }
                }
                const std::size_t count = out.size();
                return numpy_of(std::move(out), {count});
            },
            nb::arg("at"), nb::arg("radius"), "How far (m,) the nearest is from each of (m, 6); inf where none is within the radius.")
        .def(
            "settled",
            [](const FeatureTree &tree, Features moving, Turn turn, Shift shift, Numbers radii, double sink, int fewest) {
                Pose pose;
                std::copy_n(turn.data(), 9, pose.turn), std::copy_n(shift.data(), 3, pose.shift);
                {
                    nb::gil_scoped_release release;
                    settle(tree, moving.data(), moving.shape(0), radii.data(), radii.shape(0), sink, fewest, pose);
                }
                return std::make_tuple(numpy_of(std::vector<double>(pose.turn, pose.turn + 9), {3, 3}),
                                       numpy_of(std::vector<double>(pose.shift, pose.shift + 3), {3}));
            },
            nb::arg("moving"), nb::arg("turn"), nb::arg("shift"), nb::arg("radii"), nb::arg("sink"), nb::arg("fewest"),
            "Rotation (3, 3) about the vertical and translation (3,) that lay (m, 6) on these from a start, one step of ICP\n"
            "at each radius; the height changes by at most `sink`.");
    m.def(
        "vote_shifts",
        [](Plan a, Plan b, Rows i, Rows j, Numbers weight, Numbers yaws, double bin, int peaks) {
            const std::size_t pairs = i.shape(0);
            if (j.shape(0) != pairs || weight.shape(0) != pairs) throw std::invalid_argument("pairs have two ends and a weight");
            for (std::size_t p = 0; p < pairs; ++p)
                if (i.data()[p] < 0 || i.data()[p] >= int64_t(a.shape(0)) || j.data()[p] < 0 || j.data()[p] >= int64_t(b.shape(0)))
                    throw std::invalid_argument("a pair ends at a point");
            if (!(bin > 0) || peaks < 1) throw std::invalid_argument("votes have cells and peaks");
            finite(a, 2 * a.shape(0)), finite(b, 2 * b.shape(0));
            std::vector<double> out, shift(2 * pairs);
            std::vector<int64_t> cell(2 * pairs), of;
            if (pairs) {
                nb::gil_scoped_release release;
                for (std::size_t y = 0; y < yaws.shape(0); ++y) {
                    vote(a.data(), b.data(), i, j, weight.data(), std::cos(yaws.data()[y]), std::sin(yaws.data()[y]), bin, peaks,
                         shift, cell, out);
                    of.resize(out.size() / 3, int64_t(y));
                }
            }
            const std::size_t found = of.size();
            return std::make_tuple(numpy_of(std::move(of), {found}), numpy_of(std::move(out), {found, 3}));
        },
        nb::arg("a"), nb::arg("b"), nb::arg("i"), nb::arg("j"), nb::arg("weight"), nb::arg("yaws"), nb::arg("bin"), nb::arg("peaks"),
        "Shifts that many pairs of points i of a (n, 2) and j of b (m, 2) share when a is turned by a yaw: which of the yaws\n"
        "(k,), and rows (k, 3) of votes and shift, the most voted of each yaw first.");
}

}  // namespace gsmap
