// Pairs of neighbours become one, those first that are seen least. See gsmap/geometry/decimate.py.
#include "merging.h"

#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <optional>
#include <stdexcept>
#include <vector>

#include "arrays.h"
#include "given.h"
#include "leaves.h"
#include "threads.h"

namespace gsmap {
namespace {

using Covariances = nb::ndarray<const double, nb::shape<-1, 6>, nb::c_contig, nb::device::cpu>;
using Pairs = nb::ndarray<const int32_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

constexpr double kColourOfBase = 0.28209479177387814;  // spherical harmonic of degree 0

// A number for a cost and its pair, in the order of both: floats that are not negative sort as their bits do.
uint64_t key_of(float cost, uint32_t pair) {
    uint32_t bits;
    std::memcpy(&bits, &cost, sizeof bits);
    return uint64_t(bits) << 32 | pair;
}

double area_of(const double *s) {
    const double minors = s[0] * s[3] - s[1] * s[1] + s[0] * s[5] - s[2] * s[2] + s[3] * s[5] - s[4] * s[4];
    return kPi * std::sqrt(std::max(minors, 0.0) / 3);
}
double determinant(const double *s) {
    return s[0] * (s[3] * s[5] - s[4] * s[4]) + s[1] * (s[2] * s[4] - s[1] * s[5]) + s[2] * (s[1] * s[4] - s[2] * s[3]);
}
// The eigenvalues of a covariance, the largest first.
void eigenvalues(const double *s, double *out) {
    const double off = s[1] * s[1] + s[2] * s[2] + s[4] * s[4], mean = (s[0] + s[3] + s[5]) / 3;
    const double a = s[0] - mean, b = s[3] - mean, c = s[5] - mean;
    const double spread = std::sqrt((a * a + b * b + c * c + 2 * off) / 6);
    std::fill_n(out, 3, mean);
    if (!(spread > 0)) return;
    const double n[6] = {a / spread, s[1] / spread, s[2] / spread, b / spread, s[4] / spread, c / spread};
    const double angle = std::acos(std::clamp(determinant(n) / 2, -1.0, 1.0)) / 3;
    out[0] = mean + 2 * spread * std::cos(angle);
    out[2] = mean + 2 * spread * std::cos(angle + 2 * kPi / 3);
    out[1] = 3 * mean - out[0] - out[2];
}

// Strength and root of a blob that is drawn with this opacity, blurred by a variance.
void light(Blob &blob, double opacity, double blur) {
    double s[6];
    std::copy(blob.covariance, blob.covariance + 6, s);
    const double sharp = area_of(s);
    for (int k : {0, 3, 5}) s[k] += blur;
    blob.strength = opacity * sharp / std::sqrt(area_of(s));
    blob.root = std::sqrt(std::sqrt(determinant(s)));
}

constexpr int32_t kBlock = 1 << 15;  // Gaussians that are merged together, if there are more: what a cache holds of them

struct Rules {
    int neighbours, passes;
    double blur, cover;
};

// Gaussians that are left, and those that they stand for.
struct Left {
    std::vector<Blob> blobs;
    std::vector<double> opacities;
    std::vector<float> sizes;     // largest variance
    std::vector<int32_t> lowest;  // row of those it stands for
};

// Each Gaussian with a few nearest to it, each pair once. Rows of the leaves are those of the blobs.
std::vector<Pair> neighbour_pairs(const Leaves &leaves, std::size_t n, int most) {
    const int k = std::min<int>(most, int(n) - 1);
    constexpr int64_t kAtOnce = 64;
    std::vector<int32_t> near(n * std::size_t(k));
    const int64_t tasks = (leaves.count() + kAtOnce - 1) / kAtOnce;
    parallel_for(tasks, [&](int64_t task) {
        for (int64_t leaf = task * kAtOnce; leaf < std::min(leaves.count(), (task + 1) * kAtOnce); ++leaf)
            leaves.nearest(leaf, k, near.data());
    });
    std::vector<Pair> pairs;
    pairs.reserve(n * std::size_t(k) * 3 / 4);
    for (int32_t i = 0; i < int32_t(n); ++i)
        for (int j = 0; j < k; ++j) {
            const int32_t other = near[std::size_t(i) * k + j];
            const int32_t *theirs = &near[std::size_t(other) * k];
            // Each pair once, by whichever is first of those that know the other.
            if (other < i && std::find(theirs, theirs + k, i) != theirs + k) continue;
            pairs.push_back({std::min(i, other), std::max(i, other), 0.f});
        }
    return pairs;
}

// The pairs of what they went into, each once, without those that became one.
std::vector<Pair> inherited(const std::vector<Pair> &pairs, const std::vector<int32_t> &into, std::size_t n) {
    std::vector<int32_t> begin(n + 2), others(pairs.size()), last(n, -1);
    const auto joined = [&](const Pair &pair) { return std::minmax(into[pair.a], into[pair.b]); };
    for (const Pair &pair : pairs) ++begin[std::size_t(joined(pair).first) + 2];
    for (std::size_t i = 2; i < begin.size(); ++i) begin[i] += begin[i - 1];
    for (const Pair &pair : pairs) {
        const auto [a, b] = joined(pair);
        others[begin[std::size_t(a) + 1]++] = b;
    }
    std::vector<Pair> out;
    out.reserve(pairs.size());
    for (int32_t i = 0; i < int32_t(n); ++i)
        for (int32_t at = begin[i]; at < begin[i + 1]; ++at) {
            const int32_t other = others[at];
            if (other == i || last[other] == i) continue;
            last[other] = i;
            out.push_back({i, other, 0.f});
        }
    return out;
}

// Pairs that have nothing in common, those that are cheapest for both, again and again; at most so many, the cheapest.
std::vector<Pair> cheapest(const std::vector<Pair> &pairs, std::size_t n, int passes, std::size_t most) {
    std::vector<uint64_t> keys(pairs.size()), chosen;
    for (std::size_t p = 0; p < pairs.size(); ++p) keys[p] = key_of(pairs[p].cost, uint32_t(p));
    std::vector<uint64_t> best(n);
    std::vector<uint8_t> taken(n);
    for (int pass = 0; pass < passes && !keys.empty(); ++pass) {
        std::fill(best.begin(), best.end(), ~uint64_t(0));
        for (const uint64_t key : keys) {
            const Pair &pair = pairs[uint32_t(key)];
            best[pair.a] = std::min(best[pair.a], key);
            best[pair.b] = std::min(best[pair.b], key);
        }
        for (const uint64_t key : keys) {
            const Pair &pair = pairs[uint32_t(key)];
            if (best[pair.a] != key || best[pair.b] != key) continue;
            chosen.push_back(key);
            taken[pair.a] = taken[pair.b] = 1;
        }
        keys.erase(std::remove_if(keys.begin(), keys.end(),
                                  [&](uint64_t key) { return taken[pairs[uint32_t(key)].a] | taken[pairs[uint32_t(key)].b]; }),
                   keys.end());
    }
    if (chosen.size() > most) {
        std::nth_element(chosen.begin(), chosen.begin() + most, chosen.end());
        chosen.resize(most);
    }
    std::vector<Pair> out;
    for (const uint64_t key : chosen) out.push_back(pairs[uint32_t(key)]);
    return out;
}

void merge(Blob &into, const Blob &other) {
    const double mass = into.mass + other.mass, a = into.mass / mass, b = 1 - a;
    double d[3];
    for (int k = 0; k < 3; ++k) d[k] = into.mean[k] - other.mean[k];
    const double outer[6] = {d[0] * d[0], d[0] * d[1], d[0] * d[2], d[1] * d[1], d[1] * d[2], d[2] * d[2]};
    for (int k = 0; k < 6; ++k)
        into.covariance[k] = a * into.covariance[k] + b * other.covariance[k] + a * b * outer[k];
    for (int k = 0; k < 3; ++k) {
        into.mean[k] = a * into.mean[k] + b * other.mean[k];
        into.colour[k] = a * into.colour[k] + b * other.colour[k];
    }
    into.mass = mass;
    into.weight = std::max(into.weight, other.weight);
}

// One round: as many of the pairs become one as are cheapest for both. Tells of each that was left which it went into.
std::vector<int32_t> one_round(Left &left, std::vector<Pair> &pairs, const Rules &rules, std::size_t most) {
    const std::size_t n = left.blobs.size();
    std::vector<float> sizes = left.sizes;
    std::nth_element(sizes.begin(), sizes.begin() + n / 2, sizes.end());
    const double blur = rules.blur * rules.blur * double(sizes[n / 2]);
    for (std::size_t i = 0; i < n; ++i) light(left.blobs[i], left.opacities[i], blur);
    constexpr int64_t kAtOnce = 4096;
    const auto count = int64_t(pairs.size());
    parallel_for((count + kAtOnce - 1) / kAtOnce, [&](int64_t task) {
        const int64_t from = task * kAtOnce;
        kernels->pair_costs(left.blobs.data(), pairs.data() + from, std::min(kAtOnce, count - from), blur, rules.cover);
    });
    std::vector<int32_t> with(n, -1), into(n, -1);
    for (const Pair &pair : cheapest(pairs, n, rules.passes, most)) with[pair.a] = pair.b;
    int32_t kept = 0;
    for (std::size_t i = 0; i < n; ++i) {
        if (into[i] >= 0) continue;  // the other of an earlier one
        Blob blob = left.blobs[i];
        double opacity = left.opacities[i];
        float size = left.sizes[i];
        int32_t lowest = left.lowest[i];
        if (with[i] >= 0) {
            merge(blob, left.blobs[with[i]]);
            double variances[3];
            eigenvalues(blob.covariance, variances);
            size = float(variances[0]);
            for (double &variance : variances) variance = std::log(std::max(variance, 1e-20)) / 2;
            const double area = shadow(variances[0], variances[1], variances[2]);
            opacity = std::min(-std::expm1(-blob.mass / area), kMaxOpacity);
            lowest = std::min(lowest, left.lowest[with[i]]);
            into[with[i]] = kept;
        }
        into[i] = kept;
        left.blobs[kept] = blob, left.opacities[kept] = opacity, left.sizes[kept] = size, left.lowest[kept] = lowest;
        ++kept;
    }
    left.blobs.resize(kept), left.opacities.resize(kept), left.sizes.resize(kept), left.lowest.resize(kept);
    return into;
}

// Cuts points into blocks that lie together, of so many at most: in halves, across the longest side.
void cut(Point *points, int32_t begin, int32_t end, int32_t most, std::vector<int32_t> &ends) {
    if (end - begin <= most) {
        ends.push_back(end);
        return;
    }
    float low[3], high[3];
    std::fill_n(low, 3, __builtin_inff()), std::fill_n(high, 3, -__builtin_inff());
    for (int32_t i = begin; i < end; ++i)
        for (int k = 0; k < 3; ++k) {
            low[k] = std::min(low[k], points[i].at[k]);
            high[k] = std::max(high[k], points[i].at[k]);
        }
    int axis = 0;
    for (int k = 1; k < 3; ++k)
        if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    const int32_t middle = begin + (end - begin) / 2;
    std::nth_element(points + begin, points + middle, points + end, [axis](const Point &a, const Point &b) {
        return a.at[axis] < b.at[axis] || (a.at[axis] == b.at[axis] && a.row < b.row);
    });
    cut(points, begin, middle, most, ends);
    cut(points, middle, end, most, ends);
}

// Merges the Gaussians that some points are, down to a number of them. first: of each row the lowest one of its group.
void merge_block(const Given &given, const float *base, const double *weights, std::vector<Point> points,
                 std::size_t max_count, const Rules &rules, int32_t *first) {
    const std::size_t count = points.size();
    std::vector<int32_t> rows(count), at(count);
    Left left;
    left.blobs.resize(count), left.opacities.resize(count), left.sizes.resize(count), left.lowest.resize(count);
    Leaves leaves(points);  // in whose order neighbours lie near each other in memory, too
    leaves.number();
    for (std::size_t i = 0; i < count; ++i) {
        const int32_t row = rows[i] = points[i].row;
        Blob &blob = left.blobs[i];
        left.sizes[i] = float(given.covariance(row, blob.covariance));
        left.opacities[i] = given.opacity(row);
        left.lowest[i] = row;
        for (int k = 0; k < 3; ++k) {
            blob.mean[k] = given.means[3 * int64_t(row) + k];
            blob.colour[k] = 0.5 + kColourOfBase * base[3 * int64_t(row) + k];
        }
        blob.mass = optical_depth(left.opacities[i]) * given.shadow(row) + 1e-30;
        blob.weight = weights ? weights[row] : 1.0;
        at[i] = int32_t(i);
    }
    std::vector<Pair> pairs = neighbour_pairs(leaves, count, rules.neighbours);
    while (left.blobs.size() > max_count) {
        const std::vector<int32_t> into = one_round(left, pairs, rules, left.blobs.size() - max_count);
        for (int32_t &place : at) place = into[place];
        const std::size_t n = left.blobs.size();
        pairs = inherited(pairs, into, n);
        if (pairs.size() >= 2 * n || n <= max_count) continue;
        // What was near each other is one by now: look further.
        points.resize(n);
        for (std::size_t i = 0; i < n; ++i) {
            for (int k = 0; k < 3; ++k) points[i].at[k] = float(left.blobs[i].mean[k] - left.blobs[0].mean[k]);
            points[i].row = int32_t(i);
        }
        pairs = neighbour_pairs(Leaves(points), n, rules.neighbours);
    }
    for (std::size_t i = 0; i < count; ++i) first[rows[i]] = left.lowest[at[i]];
}

std::vector<int64_t> labels_of(const Given &given, const float *base, const double *weights, std::size_t max_count,
                               const Rules &rules) {
    double centre[3];
    for (int k = 0; k < 3; ++k) {
        float low = __builtin_inff(), high = -low;
        for (int64_t i = 0; i < given.n; ++i) {
            low = std::min(low, given.means[3 * i + k]);
            high = std::max(high, given.means[3 * i + k]);
        }
        centre[k] = (double(low) + high) / 2;
    }
    std::vector<Point> points(given.n);
    for (int64_t i = 0; i < given.n; ++i) {
        for (int k = 0; k < 3; ++k) points[i].at[k] = float(given.means[3 * i + k] - centre[k]);
        points[i].row = int32_t(i);
    }
    // Each block by itself, as it then stays in the cache; a level has room for at least one Gaussian of each.
    std::vector<int32_t> ends{0}, first(given.n);
    cut(points.data(), 0, int32_t(given.n), std::max<int32_t>(kBlock, 2 * (int32_t(given.n / int64_t(max_count)) + 1)), ends);
    const auto merge_one = [&](int64_t block) {
        const int64_t begin = ends[block], end = ends[block + 1];
        // Shares that add up to what may be left.
        const std::size_t most = end * max_count / given.n - begin * max_count / given.n;
        merge_block(given, base, weights, {points.begin() + begin, points.begin() + end}, most, rules, first.data());
    };
    if (ends.size() == 2) merge_one(0);  // which then has all threads for itself
    else parallel_for(int64_t(ends.size()) - 1, merge_one);
    // Numbered in the order of the lowest rows.
    std::vector<int64_t> out(given.n);
    int64_t next = 0;
    for (int32_t i = 0; i < given.n; ++i) out[i] = first[i] == i ? next++ : out[first[i]];
    return out;
}

std::vector<double> costs_of(const Points &means, const Covariances &covariances, const Numbers &masses,
                             const Numbers &opacities, const Points &colours, const Pairs &pairs, double blur, double cover) {
    const auto n = std::int64_t(means.shape(0));
    if (std::int64_t(covariances.shape(0)) != n || std::int64_t(masses.shape(0)) != n ||
        std::int64_t(opacities.shape(0)) != n || std::int64_t(colours.shape(0)) != n)
        throw std::invalid_argument("arrays of one length");
    std::vector<Blob> blobs(n);
    for (std::int64_t i = 0; i < n; ++i) {
        std::copy_n(means.data() + 3 * i, 3, blobs[i].mean);
        std::copy_n(covariances.data() + 6 * i, 6, blobs[i].covariance);
        std::copy_n(colours.data() + 3 * i, 3, blobs[i].colour);
        blobs[i].mass = masses.data()[i];
        blobs[i].weight = 1;
        light(blobs[i], opacities.data()[i], blur * blur);
    }
    std::vector<Pair> all(pairs.shape(0));
    for (std::size_t p = 0; p < all.size(); ++p) {
        all[p] = {pairs.data()[2 * p], pairs.data()[2 * p + 1], 0.f};
        if (std::min(all[p].a, all[p].b) < 0 || std::max(all[p].a, all[p].b) >= n)
            throw std::invalid_argument("a pair of a row that is not there");
    }
    kernels->pair_costs(blobs.data(), all.data(), std::int64_t(all.size()), blur * blur, cover);
    std::vector<double> out;
    for (const Pair &pair : all) out.push_back(pair.cost);
    return out;
}

}  // namespace

void bind_merging(nb::module_ &m) {
    m.def(
        "pair_costs",
        [](Points means, Covariances covariances, Numbers masses, Numbers opacities, Points colours, Pairs pairs,
           double blur, double cover) {
            const std::size_t count = pairs.shape(0);
            return numpy_of(costs_of(means, covariances, masses, opacities, colours, pairs, blur, cover), {count});
        },
        nb::arg("means"), nb::arg("covariances"), nb::arg("masses"), nb::arg("opacities"), nb::arg("colours"),
        nb::arg("pairs"), nb::arg("blur"), nb::arg("cover"),
        "(E,) energy of the difference between two Gaussians and the one that keeps their moments, for each pair.");
    m.def(
        "merged_pairs",
        [](Rows3 means, Rows4 quats, Rows3 log_scales, Values logits, Rows3 base, std::optional<Numbers> weights,
           int64_t max_count, int neighbours, int passes, double blur, double cover) {
            const Given given = given_of(means, quats, log_scales, logits);
            const std::size_t n = means.shape(0);
            if (base.shape(0) != n || (weights && weights->shape(0) != n))
                throw std::invalid_argument("arrays of one length");
            if (max_count < 1 || neighbours < 1 || neighbours > 16 || passes < 1)
                throw std::invalid_argument("at least one is left, of 1 to 16 neighbours, in one pass or more");
            for (std::size_t i = 0; i < 3 * n; ++i)
                if (!(std::abs(means.data()[i]) < 1e15f)) throw std::invalid_argument("means must be finite");
            std::vector<int64_t> labels;
            {
                nb::gil_scoped_release release;
                labels = labels_of(given, base.data(), weights ? weights->data() : nullptr, std::size_t(max_count),
                                   {neighbours, passes, blur, cover});
            }
            return numpy_of(std::move(labels), {n});
        },
        nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"), nb::arg("logit_opacities"), nb::arg("base"),
        nb::arg("weights").none(), nb::arg("max_count"), nb::arg("neighbours"), nb::arg("passes"), nb::arg("blur"),
        nb::arg("cover"),
        "Which of at most max_count groups each Gaussian (n,) goes into; groups are in the order of their first rows.");
}

}  // namespace gsmap
