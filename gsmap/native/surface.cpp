// Surfaces as clouds of cells: their neighbours, local planes and colours, and the equations that lay one on another.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "given.h"
#include "leaves.h"
#include "memory.h"
#include "point_tree.h"
#include "symmetric.h"
#include "threads.h"

namespace gsmap {
namespace {

constexpr int kBlock = 512;  // points of a task; sums are taken by block, so threads change no bit
constexpr int kMostNeighbours = 64;
constexpr double kBeyond = 1.5, kStill = 0.05;  // of the radius, see Partner
constexpr double kOpposed = -0.5;  // cosine of two faces at which a cell is another surface: 120 degrees, for normals are noisy
constexpr double kLeastNoise = 0.03;  // of the radius: planes that fit better than this leave colour its say

using Rows = nb::ndarray<const int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Neighbourhoods = nb::ndarray<const int64_t, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Kept = nb::ndarray<double, nb::shape<-1, 5>, nb::c_contig, nb::device::cpu>;
using Frame = nb::ndarray<const double, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;
using Vector = nb::ndarray<const double, nb::shape<3>, nb::c_contig, nb::device::cpu>;

template <class Body> void over_blocks(int64_t n, const Body &body) {
    parallel_for((n + kBlock - 1) / kBlock,
                 [&](int64_t block) { body(block, block * kBlock, std::min(n, (block + 1) * kBlock)); });
}

double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Which cells a point may be laid on: not those whose other side was seen. A face of zeros is not known and opposes none;
// null where no faces are known.
struct Facing {
    const double *faces, *own;
    bool operator()(int32_t row) const { return !own || dot(faces + 3 * std::size_t(row), own) > kOpposed; }
};

// The unit vector of least spread of a symmetric matrix (xx, xy, xz, yy, yz, zz).
void least_axis(const double *m, double *out) {
    double a[3][3] = {{m[0], m[1], m[2]}, {m[1], m[3], m[4]}, {m[2], m[4], m[5]}}, v[3][3];
    diagonalise(a, v);
    int least = 0;
    for (int k = 1; k < 3; ++k)
        if (a[k][k] < a[least][least]) least = k;
    for (int k = 0; k < 3; ++k) out[k] = v[k][least];
}

// Unit normals of the planes through each point's k nearest, itself included.
std::vector<double> normals(const PointTree &tree, int k) {
    std::vector<double> out(3 * std::size_t(tree.size()));
    over_blocks(tree.size(), [&](int64_t, int64_t begin, int64_t end) {
        Neighbour near[kMostNeighbours];
        for (int64_t i = begin; i < end; ++i) {
            const double *at = tree.point(int32_t(i));
            const int found = tree.nearest(at, k, near);
            double mean[3] = {0, 0, 0}, spread[6] = {0, 0, 0, 0, 0, 0};
            for (int j = 0; j < found; ++j)  // about the point itself, so that nothing cancels far from the origin
                for (int a = 0; a < 3; ++a) mean[a] += (tree.point(near[j].row)[a] - at[a]) / found;
            for (int j = 0; j < found; ++j) {
                double d[3];
                for (int a = 0; a < 3; ++a) d[a] = tree.point(near[j].row)[a] - at[a] - mean[a];
                spread[0] += d[0] * d[0], spread[1] += d[0] * d[1], spread[2] += d[0] * d[2];
                spread[3] += d[1] * d[1], spread[4] += d[1] * d[2], spread[5] += d[2] * d[2];
            }
            least_axis(spread, &out[3 * i]);
        }
    });
    return out;
}

// The plane of each point through some neighbours: unit normals, of arbitrary sign, and flatness: the difference between
// the middle and the least spread, of the largest. Neighbours count less the farther they lie off a rough plane, where there
// is one: exp(-d^2 / 2 width^2). Zeros are no plane.
void planes(const double *points, const int64_t *near, int64_t n, int64_t k, const double *rough, double width,
            double *normal, double *flat) {
    over_blocks(n, [&](int64_t, int64_t begin, int64_t end) {
        std::vector<double> weight(k);
        for (int64_t i = begin; i < end; ++i) {
            const double *at = points + 3 * i, *own = rough ? rough + 3 * i : nullptr;
            if (own && dot(own, own) == 0) own = nullptr;
            double mean[3] = {}, total = 0, spread[6] = {};
            for (int64_t j = 0; j < k; ++j) {
                const double *other = points + 3 * near[i * k + j];
                const double d[3] = {other[0] - at[0], other[1] - at[1], other[2] - at[2]};
                const double off = own ? dot(d, own) / width : 0;
                weight[j] = own ? std::exp(-0.5 * off * off) + 1e-6 : 1;
                total += weight[j];
                for (int a = 0; a < 3; ++a) mean[a] += weight[j] * d[a];
            }
            for (int a = 0; a < 3; ++a) mean[a] /= total;
            for (int64_t j = 0; j < k; ++j) {
                const double *other = points + 3 * near[i * k + j], w = weight[j];
                const double d[3] = {other[0] - at[0] - mean[0], other[1] - at[1] - mean[1], other[2] - at[2] - mean[2]};
                spread[0] += w * d[0] * d[0], spread[1] += w * d[0] * d[1], spread[2] += w * d[0] * d[2];
                spread[3] += w * d[1] * d[1], spread[4] += w * d[1] * d[2], spread[5] += w * d[2] * d[2];
            }
            double a[3][3] = {{spread[0], spread[1], spread[2]}, {spread[1], spread[3], spread[4]},
                              {spread[2], spread[4], spread[5]}}, v[3][3];
            diagonalise(a, v);
            int order[3] = {0, 1, 2};
            std::sort(order, order + 3, [&](int x, int y) { return a[x][x] < a[y][y] || (a[x][x] == a[y][y] && x < y); });
            for (int c = 0; c < 3; ++c) normal[3 * i + c] = v[c][order[0]];
            const double least = a[order[0]][order[0]], middle = a[order[1]][order[1]], most = a[order[2]][order[2]];
            flat[i] = (middle - least) / std::max(most, 1e-12);
        }
    });
}

double squared(const float *a, const float *b) {
    double sum = 0;
    for (int k = 0; k < 3; ++k) sum += (double(a[k]) - b[k]) * (double(a[k]) - b[k]);
    return sum;
}

// Distance to the k-th neighbour of each point, and from its values to those of the second most alike of these k.
void unlike(const float *at, const float *values, std::size_t n, int k, double *far, double *second) {
    constexpr float kFarthest = 1e18f;  // squares of differences stay finite
    std::vector<Point> points(n);
    for (std::size_t i = 0; i < n; ++i) {
        for (int a = 0; a < 3; ++a) points[i].at[a] = std::clamp(at[3 * i + a], -kFarthest, kFarthest);
        points[i].row = int32_t(i);
    }
    Leaves leaves(points);  // which brings the points in their order
    leaves.number();
    over_blocks(leaves.count(), [&](int64_t, int64_t begin, int64_t end) {
        std::vector<int32_t> near(std::size_t(kLeaf) * k);
        for (int64_t leaf = begin; leaf < end; ++leaf) {
            const std::size_t first = std::size_t(leaf) * kLeaf;
            leaves.nearest(leaf, k, near.data() - std::ptrdiff_t(first) * k);
            for (std::size_t i = first; i < std::min(n, first + kLeaf); ++i) {
                const int32_t row = points[i].row;
                double farthest = 0, least = __builtin_inf(), next = least;
                for (int j = 0; j < k; ++j) {
                    const Point &other = points[near[(i - first) * k + j]];
                    farthest = std::max(farthest, squared(points[i].at, other.at));
                    const double off = squared(values + 3 * std::size_t(row), values + 3 * std::size_t(other.row));
                    next = std::min(next, std::max(off, least));
                    least = std::min(least, off);
                }
                far[row] = std::sqrt(farthest), second[row] = std::sqrt(next);
            }
        }
    });
}

// Change of a value per metre within each point's tangent plane, by least squares over its k nearest; `ridge_m` damps it,
// and keeps it in the plane.
std::vector<double> tangent_gradients(const PointTree &tree, const double *normal, const double *value, int k,
                                      double ridge_m) {
    std::vector<double> out(3 * std::size_t(tree.size()));
    const double along = ridge_m * ridge_m, damping = 0.1 * along;
    over_blocks(tree.size(), [&](int64_t, int64_t begin, int64_t end) {
        Neighbour near[kMostNeighbours];
        for (int64_t i = begin; i < end; ++i) {
            const double *at = tree.point(int32_t(i)), *n = normal + 3 * i;
            double m[6] = {along * n[0] * n[0] + damping, along * n[0] * n[1], along * n[0] * n[2],
                           along * n[1] * n[1] + damping, along * n[1] * n[2], along * n[2] * n[2] + damping};
            double b[3] = {0, 0, 0};
            for (int j = 0, found = tree.nearest(at, k, near); j < found; ++j) {
                const double *other = tree.point(near[j].row), rise = value[near[j].row] - value[i];
                double d[3] = {other[0] - at[0], other[1] - at[1], other[2] - at[2]};
                const double off = dot(d, n);
                for (int a = 0; a < 3; ++a) d[a] -= off * n[a];
                m[0] += d[0] * d[0], m[1] += d[0] * d[1], m[2] += d[0] * d[2];
                m[3] += d[1] * d[1], m[4] += d[1] * d[2], m[5] += d[2] * d[2];
                for (int a = 0; a < 3; ++a) b[a] += d[a] * rise;
            }
            const double c0 = m[3] * m[5] - m[4] * m[4], c1 = m[2] * m[4] - m[1] * m[5], c2 = m[1] * m[4] - m[2] * m[3];
            const double c3 = m[0] * m[5] - m[2] * m[2], c4 = m[1] * m[2] - m[0] * m[4], c5 = m[0] * m[3] - m[1] * m[1];
            const double det = m[0] * c0 + m[1] * c1 + m[2] * c2;
            out[3 * i] = (c0 * b[0] + c1 * b[1] + c2 * b[2]) / det;
            out[3 * i + 1] = (c1 * b[0] + c3 * b[1] + c4 * b[2]) / det;
            out[3 * i + 2] = (c2 * b[0] + c4 * b[1] + c5 * b[2]) / det;
        }
    });
    return out;
}

double median(std::vector<double> values) {
    if (values.empty()) return 0;
    const auto middle = values.begin() + values.size() / 2;
    std::nth_element(values.begin(), middle, values.end());
    return values.size() % 2 ? *middle : 0.5 * (*middle + *std::max_element(values.begin(), middle));
}

double median_distance(std::vector<double> values, double from) {
    for (double &v : values) v = std::abs(v - from);
    return median(std::move(values));
}

// What a surface lays itself on: cells with their planes and lightness.
struct Cells {
    const PointTree *tree;
    const double *normals, *lightness, *gradients, *faces;
};

// How pairs count; see gsmap/register/refiners/colored_icp.py.
struct Weighing {
    double radius, width, colour_weight;
};

struct Sums {
    double system[7][7] = {}, gradient[7] = {}, squares = 0, lever[3] = {};
    void add(const double *slope, double residual, double weight) {
        for (int i = 0; i < 7; ++i) {
            const double w = weight * slope[i];
            gradient[i] += w * residual;
            for (int j = i; j < 7; ++j) system[i][j] += w * slope[j];
        }
    }
    void add(const Sums &o) {
        squares += o.squares;
        for (int a = 0; a < 3; ++a) lever[a] += o.lever[a];
        for (int i = 0; i < 7; ++i) {
            gradient[i] += o.gradient[i];
            for (int j = i; j < 7; ++j) system[i][j] += o.system[i][j];
        }
    }
};

// A point's nearest cell, as rows of Python's array keep it from pose to pose: where the point was when cells were last
// searched, how near any other cell can have been then (negative: nothing is known yet), and the cell, -1 for none.
// By the triangle inequality it stays the nearest until the point has moved by the difference, so late steps search little.
struct Partner {
    double at[3], others, row;

    // The nearest cell closer than the radius that it may be laid on, or -1.
    int32_t follow(const PointTree &tree, const double *moved, double radius, const Facing &facing) {
        const double step = std::sqrt(PointTree::squared(moved, at)), left = others - step;
        if (others >= 0 && (row < 0 ? left >= radius : left > 0)) {
            if (row < 0) return -1;
            const double distance = std::sqrt(PointTree::squared(moved, tree.point(int32_t(row))));
            if (distance * (1 + 1e-9) < left) return distance < radius ? int32_t(row) : -1;
        }
        std::copy_n(moved, 3, at);
        if (others < 0 || step > kStill * radius) {  // it moves far still: the second nearest would be sought in vain
            const Neighbour best = tree.nearest(moved, Neighbour{radius * radius, -1}, facing);
            others = 0;
            row = best.row;
            return best.row;
        }
        const double reach = kBeyond * radius;
        Neighbour near[2];
        const int found = tree.nearest(moved, 2, near, reach * reach, facing);
        others = found > 1 ? std::sqrt(near[1].squared) : reach;
        row = found ? near[0].row : -1;
        return found && near[0].squared < radius * radius ? near[0].row : -1;
    }
};

static_assert(sizeof(Partner) == 5 * sizeof(double), "rows of five numbers, see icp_equations");

struct Pair {
    double moved[3], lever[3], offset[3], plane;
    int32_t row;
};

struct Equations {
    Sums sums;
    int64_t count = 0;
    double noise = 0;
};

// Pairs every point with the nearest cell, and sums the normal equations of plane distances and lightness differences.
// `backward`: the points are the target's, laid on the source's cells, which a step of the source moves the other way.
Equations equations(const Cells &onto, const double *points, const double *lightness, const double *faces,
                    const int64_t *rows, int64_t n, Partner *partners, const double *pose, const double *centre,
                    bool backward, const Weighing &how) {
    const int64_t blocks = (n + kBlock - 1) / kBlock;
    std::vector<std::vector<Pair>> found(blocks);
    std::vector<std::vector<double>> light(blocks);
    over_blocks(n, [&](int64_t block, int64_t begin, int64_t end) {
        found[block].reserve(end - begin);
        for (int64_t i = begin; i < end; ++i) {
            const double *p = points + 3 * rows[i];
            Pair pair;
            for (int a = 0; a < 3; ++a) pair.moved[a] = dot(pose + 4 * a, p) + pose[4 * a + 3];
            const Facing facing{onto.faces, faces ? faces + 3 * rows[i] : nullptr};
            pair.row = partners[i].follow(*onto.tree, pair.moved, how.radius, facing);
            if (pair.row < 0) continue;
            const double *cell = onto.tree->point(pair.row);
            for (int a = 0; a < 3; ++a) {
                pair.lever[a] = (backward ? pair.moved[a] : p[a]) - centre[a];
                pair.offset[a] = pair.moved[a] - cell[a];
            }
            pair.plane = dot(onto.normals + 3 * std::size_t(pair.row), pair.offset);
            found[block].push_back(pair);
            light[block].push_back(lightness[rows[i]]);
        }
    });
    Equations out;
    for (const auto &some : found) out.count += int64_t(some.size());
    if (!out.count) return out;
    const bool coloured = how.colour_weight > 0;
    double gain = 1, bias = 0, spread = 1;
    std::vector<double> plane, expected, own;
    plane.reserve(out.count);
    for (int64_t block = 0; block < blocks; ++block)
        for (std::size_t i = 0; i < found[block].size(); ++i) {
            const Pair &pair = found[block][i];
            plane.push_back(std::abs(pair.plane));
            if (!coloured) continue;
            expected.push_back(onto.lightness[pair.row] + dot(onto.gradients + 3 * std::size_t(pair.row), pair.offset));
            own.push_back(light[block][i]);
        }
    out.noise = 1.4826 * median(std::move(plane));
    if (coloured) {  // the exposure, by medians: gain and offset that map the one's lightness to the other's
        const double middle_e = median(expected), middle_o = median(own);
        gain = median_distance(expected, middle_e) / std::max(median_distance(own, middle_o), 1e-6);
        gain = std::min(std::max(gain, 0.5), 2.0);
        bias = middle_e - gain * middle_o;
        for (std::size_t i = 0; i < expected.size(); ++i) expected[i] -= gain * own[i] + bias;
        spread = 1.4826 * median_distance(expected, 0) + 1e-6;
    }
    std::vector<int64_t> before(blocks + 1, 0);
    for (int64_t block = 0; block < blocks; ++block) before[block + 1] = before[block] + int64_t(found[block].size());
    std::vector<Sums> sums(blocks);
    parallel_for(blocks, [&](int64_t block) {
        // A direction in the frame of the cells, as one about the lever: of S^T n, or of what moves back.
        const auto slope_of = [&](const Pair &pair, const double *along, double factor, double *slope) {
            double local[3];
            for (int a = 0; a < 3; ++a)
                local[a] = factor * (backward ? -along[a] :
                                     pose[a] * along[0] + pose[4 + a] * along[1] + pose[8 + a] * along[2]);
            const double *x = pair.lever;
            slope[0] = x[1] * local[2] - x[2] * local[1];
            slope[1] = x[2] * local[0] - x[0] * local[2];
            slope[2] = x[0] * local[1] - x[1] * local[0];
            std::copy_n(local, 3, slope + 3);
            slope[6] = dot(x, local);
        };
        const double factor = how.colour_weight * std::max(out.noise, kLeastNoise * how.radius) / spread;
        for (std::size_t i = 0; i < found[block].size(); ++i) {
            const Pair &pair = found[block][i];
            double slope[7];
            const double far = pair.plane / how.width, weight = 1 / ((1 + far * far) * (1 + far * far));
            slope_of(pair, onto.normals + 3 * std::size_t(pair.row), 1, slope);
            sums[block].add(slope, pair.plane, weight);
            sums[block].squares += dot(pair.lever, pair.lever);
            for (int a = 0; a < 3; ++a) sums[block].lever[a] += pair.lever[a];
            if (!coloured) continue;
            const double colour = expected[before[block] + i], unlike = colour / (2 * spread);
            slope_of(pair, onto.gradients + 3 * std::size_t(pair.row), factor, slope);
            sums[block].add(slope, colour * factor, weight / ((1 + unlike * unlike) * (1 + unlike * unlike)));
        }
    });
    for (const Sums &some : sums) out.sums.add(some);
    return out;
}

}  // namespace

void bind_surface(nb::module_ &m) {
    m.def(
        "local_planes",
        [](Points points, Neighbourhoods near, std::optional<Points> rough, double width) {
            const std::size_t n = points.shape(0), k = near.shape(1);
            if (near.shape(0) != n || (rough && rough->shape(0) != n))
                throw std::invalid_argument("points need neighbours each, and rough normals each or none");
            if (!(width > 0)) throw std::invalid_argument("a width is positive");
            for (std::size_t i = 0; i < n * k; ++i)
                if (near.data()[i] < 0 || near.data()[i] >= int64_t(n)) throw std::invalid_argument("neighbours are rows");
            std::vector<double> normal(3 * n), flat(n);
            if (k) {
                nb::gil_scoped_release release;
                planes(points.data(), near.data(), int64_t(n), int64_t(k), rough ? rough->data() : nullptr, width,
                       normal.data(), flat.data());
            }
            return std::make_tuple(numpy_of(std::move(normal), {n, 3}), numpy_of(std::move(flat), {n}));
        },
        nb::arg("points"), nb::arg("neighbours"), nb::arg("rough") = nb::none(), nb::arg("width") = 1.0,
        "Unit normals (n, 3), of arbitrary sign, and flatness (n,) of the planes through the neighbours (n, k) of points.\n"
        "Where a rough normal is not zero, neighbours count exp(-d^2 / 2 width^2) at a distance d from its plane.");
    nb::class_<PointTree>(m, "PointTree", "A search tree of points (n, 3).")
        .def(
            "__init__",
            [](PointTree *self, Points points) {
                if (points.shape(0) > std::size_t(1) << 30) throw std::invalid_argument("too many points for a tree");
                for (std::size_t i = 0; i < 3 * points.shape(0); ++i)
                    if (!std::isfinite(points.data()[i])) throw std::invalid_argument("points of a tree must be finite");
                new (self) PointTree(points.data(), int32_t(points.shape(0)));
            },
            nb::arg("points"))
        .def(
            "nearest",
            [](const PointTree &tree, Points at, double radius, std::optional<Points> faces, std::optional<Points> own) {
                const int64_t n = int64_t(at.shape(0));
                if (bool(faces) != bool(own)) throw std::invalid_argument("faces of both sides, or of none");
                if (faces && (int64_t(faces->shape(0)) != tree.size() || own->shape(0) != at.shape(0)))
                    throw std::invalid_argument("a tree's points and what is sought need a face each");
                Many<double> distance(n);
                Many<int64_t> row(n);
                {
                    nb::gil_scoped_release release;
                    over_blocks(n, [&](int64_t, int64_t begin, int64_t end) {
                        for (int64_t i = begin; i < end; ++i) {
                            const Facing facing{faces ? faces->data() : nullptr, own ? own->data() + 3 * i : nullptr};
                            const Neighbour best = tree.nearest(at.data() + 3 * i, Neighbour{radius * radius, -1}, facing);
                            distance[i] = best.row < 0 ? __builtin_inf() : std::sqrt(best.squared);
                            row[i] = std::max(best.row, 0);
                        }
                    });
                }
                return std::make_tuple(numpy_of(std::move(distance), {std::size_t(n)}), numpy_of(std::move(row), {std::size_t(n)}));
            },
            nb::arg("at"), nb::arg("radius"), nb::arg("faces") = nb::none(), nb::arg("own") = nb::none(),
            "Distance (n,) to and row (n,) of the point nearest to each; inf and 0 where none is nearer than the radius.\n"
            "Points whose face (unit, zero where unknown) is opposed to the `own` of what seeks them are passed over.")
        .def(
            "neighbours",
            [](const PointTree &tree, int k, std::optional<Points> places, double radius) {
                if (k < 1 || k > kMostNeighbours) throw std::invalid_argument("a point has 1 to 64 neighbours");
                const std::size_t n = places ? places->shape(0) : std::size_t(tree.size());
                Many<double> distance(n * k, __builtin_inf());
                Many<int64_t> row(n * k, int64_t(tree.size()));
                {
                    nb::gil_scoped_release release;
                    over_blocks(int64_t(n), [&](int64_t, int64_t begin, int64_t end) {
                        Neighbour near[kMostNeighbours];
                        for (int64_t i = begin; i < end; ++i) {
                            const int64_t at = places ? i : tree.row(i);
                            const double *place = places ? places->data() + 3 * i : tree.point(int32_t(at));
                            for (int j = 0, found = tree.nearest(place, k, near, radius * radius); j < found; ++j) {
                                distance[at * k + j] = std::sqrt(near[j].squared);
                                row[at * k + j] = near[j].row;
                            }
                        }
                    });
                }
                return std::make_tuple(numpy_of(std::move(distance), {n, std::size_t(k)}), numpy_of(std::move(row), {n, std::size_t(k)}));
            },
            nb::arg("k"), nb::arg("at") = nb::none(), nb::arg("radius") = __builtin_inf(),
            "Distances and rows (m, k) of the points nearest to each place, or to each of the points, itself among them;\n"
            "inf and n where there are fewer nearer than the radius.")
        .def(
            "normals",
            [](const PointTree &tree, int k) {
                if (k < 1 || k > kMostNeighbours) throw std::invalid_argument("a plane is that of 1 to 64 points");
                std::vector<double> out;
                {
                    nb::gil_scoped_release release;
                    out = normals(tree, k);
                }
                return numpy_of(std::move(out), {std::size_t(tree.size()), 3});
            },
            nb::arg("k"), "Unit normals (n, 3) of the planes through the k nearest of each point; signs mean nothing.")
        .def(
            "tangent_gradients",
            [](const PointTree &tree, Points normals, Numbers values, int k, double ridge_m) {
                if (k < 1 || k > kMostNeighbours) throw std::invalid_argument("a gradient is that of 1 to 64 points");
                if (int64_t(normals.shape(0)) != tree.size() || int64_t(values.shape(0)) != tree.size())
                    throw std::invalid_argument("a tree's points, normals and values must be as many");
                std::vector<double> out;
                {
                    nb::gil_scoped_release release;
                    out = tangent_gradients(tree, normals.data(), values.data(), k, ridge_m);
                }
                return numpy_of(std::move(out), {std::size_t(tree.size()), 3});
            },
            nb::arg("normals"), nb::arg("values"), nb::arg("k"), nb::arg("ridge_m"),
            "Change (n, 3) of a value per metre within each point's tangent plane, over its k nearest.");
    m.def(
        "unlike",
        [](Rows3 points, Rows3 values, int k) {
            const std::size_t n = points.shape(0);
            if (values.shape(0) != n) throw std::invalid_argument("points need three values each");
            if (k < 2 || k > 20 || n <= std::size_t(k) || n > std::size_t(1) << 30)
                throw std::invalid_argument("the number of neighbours must be 2 to 20, and less than the number of points");
            for (std::size_t i = 0; i < 3 * n; ++i)
                if (!std::isfinite(points.data()[i])) throw std::invalid_argument("points must be finite");
            Many<double> far(n), second(n);
            {
                nb::gil_scoped_release release;
                unlike(points.data(), values.data(), n, k, far.data(), second.data());
            }
            return std::make_tuple(numpy_of(std::move(far), {n}), numpy_of(std::move(second), {n}));
        },
        nb::arg("points"), nb::arg("values"), nb::arg("k"),
        "How far (n,) the k-th neighbour of each point lies, and how far (n,) its three values are from those of the\n"
        "second most alike of these k.");
    m.def(
        "icp_equations",
        [](const PointTree &tree, Points normals, Numbers lightness, std::optional<Points> gradients, Points points,
           Numbers own_lightness, Rows rows, Kept partners, Frame pose, Vector centre, bool backward, double radius_m,
           double width_m, double colour_weight, std::optional<Points> faces, std::optional<Points> own_faces) {
            const auto size = std::size_t(tree.size());
            if (normals.shape(0) != size || lightness.shape(0) != size || (gradients && gradients->shape(0) != size))
                throw std::invalid_argument("a tree's points, normals, lightness and gradients must be as many");
            if (own_lightness.shape(0) != points.shape(0) || partners.shape(0) != rows.shape(0))
                throw std::invalid_argument("points need a lightness each, rows a partner each");
            if (bool(faces) != bool(own_faces)) throw std::invalid_argument("faces of both surfaces, or of none");
            if (faces && (faces->shape(0) != size || own_faces->shape(0) != points.shape(0)))
                throw std::invalid_argument("cells and points need a face each");
            for (std::size_t i = 0; i < rows.shape(0); ++i) {
                if (rows.data()[i] < 0 || rows.data()[i] >= int64_t(points.shape(0)))
                    throw std::invalid_argument("a row that is no point");
                const double *kept = partners.data() + 5 * i;
                if (!(kept[3] < 0) && !(kept[4] >= -1 && kept[4] < double(tree.size())))
                    throw std::invalid_argument("a partner that is no cell");
            }
            Equations out;
            {
                nb::gil_scoped_release release;
                out = equations({&tree, normals.data(), lightness.data(), gradients ? gradients->data() : nullptr,
                                 faces ? faces->data() : nullptr},
                                points.data(), own_lightness.data(), own_faces ? own_faces->data() : nullptr,
                                rows.data(), int64_t(rows.shape(0)),
                                reinterpret_cast<Partner *>(partners.data()), pose.data(), centre.data(), backward,
                                {radius_m, width_m, gradients ? colour_weight : 0.0});
            }
            std::vector<double> system(49), gradient(out.sums.gradient, out.sums.gradient + 7);
            for (int i = 0; i < 7; ++i)
                for (int j = 0; j < 7; ++j) system[7 * i + j] = out.sums.system[std::min(i, j)][std::max(i, j)];
            const double many = out.count ? double(out.count) : 1.0;
            std::vector<double> middle(out.sums.lever, out.sums.lever + 3);
            for (double &v : middle) v /= many;
            return std::make_tuple(numpy_of(std::move(system), {7, 7}), numpy_of(std::move(gradient), {7}), out.count, out.noise,
                                   numpy_of(std::move(middle), {3}), std::sqrt(out.sums.squares / many));
        },
        nb::arg("tree"), nb::arg("normals"), nb::arg("lightness"), nb::arg("gradients").none(), nb::arg("points"),
        nb::arg("own_lightness"), nb::arg("rows"), nb::arg("partners"), nb::arg("pose"), nb::arg("centre"),
        nb::arg("backward"), nb::arg("radius_m"), nb::arg("width_m"), nb::arg("colour_weight"),
        nb::arg("faces") = nb::none(), nb::arg("own_faces") = nb::none(),
        "Normal equations (7, 7), (7,) over [rotation, translation, log scale] about `centre` of points laid on cells by a\n"
        "pose (3, 4), the number of pairs, the robust standard deviation of their plane distances, their mean (3,) less the\n"
        "centre and their root mean square distance from it. `partners` (n, 5), -1 at first, keep each row's nearest cell\n"
        "from pose to pose, for one radius, and are written to. No point is laid on a cell whose face is opposed to its own\n"
        "(`own_faces`, in the cells' frame, for as long as partners are kept).");
}

}  // namespace gsmap
