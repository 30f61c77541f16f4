// Rays against quads: the first hit of each, by a bounding volume hierarchy (gsmap_synthetic/bake.py).
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "threads.h"

namespace gsmap {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr int kLeaf = 4;       // triangles
constexpr int kBins = 12;      // candidate splits along the longest axis, for the surface area heuristic
constexpr int kStack = 64;     // entries waiting; a level adds at most one
constexpr int kMostLevels = 60;
constexpr int64_t kBlock = 1024;  // rays of a task

using Vector = std::array<double, 3>;
using Corners = nb::ndarray<const double, nb::shape<-1, 4, 3>, nb::c_contig, nb::device::cpu>;

Vector minus(const Vector &a, const Vector &b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
double dot(const Vector &a, const Vector &b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
Vector cross(const Vector &a, const Vector &b) {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

struct Box {
    Vector low{kInfinity, kInfinity, kInfinity}, high{-kInfinity, -kInfinity, -kInfinity};
    void add(const Box &b) {
        for (int k = 0; k < 3; ++k) low[k] = std::min(low[k], b.low[k]), high[k] = std::max(high[k], b.high[k]);
    }
    void add(const Vector &p) { add(Box{p, p}); }
    double area() const {
        const Vector d = minus(high, low);
        return d[0] < 0 ? 0 : d[0] * d[1] + d[1] * d[2] + d[2] * d[0];
    }
};

struct Triangle {
    Vector corner, edge1, edge2;
    int32_t id;
};

struct Node {
    Box box;
    int32_t first, count;  // triangles of a leaf; count 0: children are the next node and node `first`
};

struct Hit {
    double t = kInfinity, u = 0, v = 0;
    int32_t id = -1;
};

struct Ray {
    Vector origin, direction, inverse;
    Ray(const double *o, const double *d) : origin{o[0], o[1], o[2]}, direction{d[0], d[1], d[2]} {
        for (int k = 0; k < 3; ++k) inverse[k] = 1 / direction[k];
    }
    // Where the ray enters a box, infinity where it does not before `far`. A comparison with NaN (a ray within the plane
    // of a face) is false, which leaves the interval as it is.
    double enters(const Box &box, double far) const {
        double near = 0;
        for (int k = 0; k < 3; ++k) {
            double a = (box.low[k] - origin[k]) * inverse[k], b = (box.high[k] - origin[k]) * inverse[k];
            if (a > b) std::swap(a, b);
            if (a > near) near = a;
            if (b < far) far = b;
        }
        return near <= far * (1 + 1e-12) ? near : kInfinity;
    }
};

// Möller and Trumbore (1997); both sides count.
void intersect(const Ray &ray, const Triangle &triangle, Hit &best) {
    const Vector p = cross(ray.direction, triangle.edge2);
    const double det = dot(triangle.edge1, p);
    if (det == 0) return;
    const Vector s = minus(ray.origin, triangle.corner), q = cross(s, triangle.edge1);
    const double u = dot(s, p) / det, v = dot(ray.direction, q) / det, t = dot(triangle.edge2, q) / det;
    if (!(u >= 0 && v >= 0 && u + v <= 1 && t >= 0)) return;
    if (t < best.t || (t == best.t && triangle.id < best.id)) best = {t, u, v, triangle.id};
}

class QuadRays {
public:
    explicit QuadRays(Corners corners) {
        const int64_t quads = corners.shape(0);
        if (quads > (int64_t(1) << 29)) throw std::invalid_argument("too many quads");
        auto corner = [&](int64_t q, int k) {
            const double *at = corners.data() + 12 * q + 3 * k;
            return Vector{at[0], at[1], at[2]};
        };
        std::vector<Triangle> triangles;
        std::vector<Box> boxes;
        for (int64_t q = 0; q < quads; ++q)
            for (int half = 0; half < 2; ++half) {
                const Vector a = corner(q, 0), b = corner(q, 1 + half), c = corner(q, 2 + half);
                for (const Vector &p : {a, b, c})
                    if (!std::isfinite(p[0] + p[1] + p[2])) throw std::invalid_argument("a corner is not finite");
                triangles.push_back({a, minus(b, a), minus(c, a), int32_t(2 * q + half)});
                Box box;
                box.add(a), box.add(b), box.add(c);
                boxes.push_back(box);
            }
        std::vector<int32_t> order(triangles.size());
        for (std::size_t i = 0; i < order.size(); ++i) order[i] = int32_t(i);
        if (!order.empty()) build(boxes, order, 0, int32_t(order.size()), 0);
        for (int32_t i : order) triangles_.push_back(triangles[i]);
    }

    Hit first(const Ray &ray, double far, bool any) const {
        Hit best;
        best.t = far;
        struct Waiting {
            int32_t node;
            double near;
        } stack[kStack];
        int depth = 0;
        if (!nodes_.empty()) stack[depth++] = {0, ray.enters(nodes_[0].box, best.t)};
        while (depth) {
            const Waiting at = stack[--depth];
            if (at.near > best.t) continue;
            const Node &node = nodes_[at.node];
            if (node.count) {
                for (int32_t i = node.first; i < node.first + node.count; ++i) intersect(ray, triangles_[i], best);
                if (any && best.id >= 0) return best;
                continue;
            }
            Waiting one{at.node + 1, ray.enters(nodes_[at.node + 1].box, best.t)};
            Waiting two{node.first, ray.enters(nodes_[node.first].box, best.t)};
            if (one.near < two.near) std::swap(one, two);
            if (one.near < kInfinity) stack[depth++] = one;
            if (two.near < kInfinity) stack[depth++] = two;
        }
        return best;
    }

private:
    std::vector<Node> nodes_;
    std::vector<Triangle> triangles_;

    void build(const std::vector<Box> &boxes, std::vector<int32_t> &order, int32_t begin, int32_t end, int level) {
        const int32_t self = int32_t(nodes_.size());
        nodes_.emplace_back();
        Box box, centres;
        auto centre = [&](int32_t i, int axis) { return 0.5 * (boxes[i].low[axis] + boxes[i].high[axis]); };
        for (int32_t i = begin; i < end; ++i) {
            box.add(boxes[order[i]]);
            centres.add(Vector{centre(order[i], 0), centre(order[i], 1), centre(order[i], 2)});
        }
        nodes_[self] = {box, begin, end - begin};
        const Vector extent = minus(centres.high, centres.low);
        const int axis = int(std::max_element(extent.begin(), extent.end()) - extent.begin());
        if (end - begin <= kLeaf || level >= kMostLevels || !(extent[axis] > 0)) return;
        auto bin = [&](int32_t i) {
            return std::min(int((centre(i, axis) - centres.low[axis]) / extent[axis] * kBins), kBins - 1);
        };
        std::array<Box, kBins> bins;
        std::array<int32_t, kBins> counts{};
        for (int32_t i = begin; i < end; ++i) bins[bin(order[i])].add(boxes[order[i]]), ++counts[bin(order[i])];
        double least = kInfinity;
        int split = 0;
        for (int cut = 1; cut < kBins; ++cut) {
            Box left, right;
            int32_t below = 0;
            for (int k = 0; k < kBins; ++k) (k < cut ? left : right).add(bins[k]), below += k < cut ? counts[k] : 0;
            if (below == 0 || below == end - begin) continue;
            const double cost = left.area() * below + right.area() * (end - begin - below);
            if (cost < least) least = cost, split = cut;
        }
        const auto middle = std::stable_partition(order.begin() + begin, order.begin() + end,
                                                  [&](int32_t i) { return bin(i) < split; });
        const int32_t cut = int32_t(middle - order.begin());
        build(boxes, order, begin, cut, level + 1);
        nodes_[self].first = int32_t(nodes_.size());
        nodes_[self].count = 0;
        build(boxes, order, cut, end, level + 1);
    }
};

template <class Body> void over_rays(Points origins, Points directions, const Body &body) {
    if (origins.shape(0) != directions.shape(0)) throw std::invalid_argument("every ray has an origin and a direction");
    const int64_t n = origins.shape(0);
    nb::gil_scoped_release release;
    parallel_for((n + kBlock - 1) / kBlock, [&](int64_t block) {
        for (int64_t i = block * kBlock; i < std::min(n, (block + 1) * kBlock); ++i)
            body(i, Ray(origins.data() + 3 * i, directions.data() + 3 * i));
    });
}

}  // namespace

void bind_rays(nb::module_ &m) {
    nb::class_<QuadRays>(m, "QuadRays",
                         "Quads (Q, 4, 3), corners in order, that rays are cast against. Each is the triangles of its "
                         "corners 0 1 2 and 0 2 3.")
        .def(nb::init<Corners>(), nb::arg("corners"))
        .def(
            "cast",
            [](const QuadRays &self, Points origins, Points directions) {
                const std::size_t n = origins.shape(0);
                std::vector<double> t(n), u(n), v(n);
                std::vector<int64_t> id(n);
                over_rays(origins, directions, [&](int64_t i, const Ray &ray) {
                    const Hit hit = self.first(ray, kInfinity, false);
                    t[i] = hit.t, u[i] = hit.u, v[i] = hit.v, id[i] = hit.id;
                });
                return std::make_tuple(numpy_of(std::move(t), {n}), numpy_of(std::move(id), {n}),
                                       numpy_of(std::move(u), {n}), numpy_of(std::move(v), {n}));
            },
            nb::arg("origins"), nb::arg("directions"),
            "First hits of rays (N, 3): distance in lengths of the direction (inf for none), triangle (2 q or 2 q + 1 of "
            "quad q, -1 for none), and the weights of its second and third corner.")
        .def(
            "occluded",
            [](const QuadRays &self, Points origins, Points directions, double far) {
                const std::size_t n = origins.shape(0);
                std::vector<uint8_t> out(n);
                over_rays(origins, directions,
                          [&](int64_t i, const Ray &ray) { out[i] = self.first(ray, far, true).id >= 0; });
                return numpy_of(std::move(out), {n});
            },
            nb::arg("origins"), nb::arg("directions"), nb::arg("far"),
            "1 for each ray (N, 3) that hits something before `far` lengths of its direction, else 0.");
}

}  // namespace gsmap
