// Small pictures of two captures: what they show around each pixel, where points fall in them, and what that tells of these.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"

namespace gsmap {
namespace {

using Floats = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Plane = nb::ndarray<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Colours = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Hues = nb::ndarray<const float, nb::shape<-1, -1, 2>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const bool, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;
using Lens = nb::ndarray<const double, nb::shape<4>, nb::c_contig, nb::device::cpu>;
using Line = nb::ndarray<const float, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Depths = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Counts = nb::ndarray<int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Sums = nb::ndarray<float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Bits = nb::ndarray<uint32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Spans = nb::ndarray<const int64_t, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Axes = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using HueSums = nb::ndarray<float, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

constexpr int64_t kBand = 8;  // rows

float lower(float a, float b) { return b < a ? b : a; }
float higher(float a, float b) { return a < b ? b : a; }

// Over 3 x 3 pixels, one after the other along each axis.
template <float (*pick)(float, float)>
void over_3x3(const float *in, int64_t height, int64_t width, float *between, float *out) {
    for (int64_t y = 0; y < height; ++y) {
        const float *here = in + y * width, *above = y ? here - width : here, *below = y + 1 < height ? here + width : here;
        for (int64_t x = 0; x < width; ++x) between[y * width + x] = pick(pick(above[x], here[x]), below[x]);
    }
    for (int64_t y = 0; y < height; ++y) {
        const float *row = between + y * width;
        float *to = out + y * width;
        if (width == 1) {
            to[0] = row[0];
            continue;
        }
        to[0] = pick(row[0], row[1]);
        for (int64_t x = 1; x + 1 < width; ++x) to[x] = pick(pick(row[x - 1], row[x]), row[x + 1]);
        to[width - 1] = pick(row[width - 2], row[width - 1]);
    }
}

// A picture's worth of numbers for a while.
struct Scratch {
    explicit Scratch(int64_t size) : values(new float[std::size_t(std::max<int64_t>(size, 1))]) {}
    operator float *() { return values.get(); }
    std::unique_ptr<float[]> values;
};

// The lowest and the highest around each pixel of a channel, to which `off` adds what puts those out that do not count.
void range(const float *channel, const float *off, int64_t height, int64_t width, float *in, float *between, float *low,
           float *high) {
    const int64_t size = height * width;
    for (int64_t p = 0; p < size; ++p) in[p] = channel[p] + off[p];
    over_3x3<lower>(in, height, width, between, low);
    for (int64_t p = 0; p < size; ++p) in[p] = channel[p] - off[p];
    over_3x3<higher>(in, height, width, between, high);
}

// Red over green, blue over green, lightness, and the largest of three logarithms, each as a plane.
void tones(const float *logs, int64_t size, const float *slope, const float *offset, float *out) {
    for (int64_t p = 0; p < size; ++p, logs += 3) {
        const float red = logs[0] * slope[0] + offset[0], green = logs[1] * slope[1] + offset[1];
        const float blue = logs[2] * slope[2] + offset[2];
        out[p] = red - green, out[size + p] = blue - green, out[2 * size + p] = (red + green + blue) / 3;
        out[3 * size + p] = higher(higher(red, green), blue);
    }
}

template <class A, class B> void same_size(const A &a, const B &b) {
    if (a.shape(0) != b.shape(0) || a.shape(1) != b.shape(1)) throw std::invalid_argument("pictures of one view are of one size");
}

// Points that fall in a picture are looked up in it: `index` of N points, on pixels of the picture.
template <class P> void check(const Rows &index, const Rows &row, const Rows &column, const Depths &z, const P &picture, std::size_t n) {
    const std::size_t count = index.shape(0);
    if (row.shape(0) != count || column.shape(0) != count || z.shape(0) != count)
        throw std::invalid_argument("what is placed needs a row, a column and a depth each");
    for (std::size_t i = 0; i < count; ++i)
        if (index.data()[i] < 0 || std::size_t(index.data()[i]) >= n || row.data()[i] < 0 || column.data()[i] < 0 ||
            std::size_t(row.data()[i]) >= picture.shape(0) || std::size_t(column.data()[i]) >= picture.shape(1))
            throw std::invalid_argument("a point that is none, or outside of the picture");
}

// Where points fall in the picture of a camera (frame to camera, fx fy cx cy).
struct Projection {
    float m[3][4], k[4], width, height, nearest;
    int row, column;
    float depth;
    Projection(const Pose &pose, const Lens &lens, int width, int height, double nearest)
        : width(float(width)), height(float(height)), nearest(float(nearest)) {
        for (int i = 0; i < 12; ++i) m[i / 4][i % 4] = float(pose.data()[i]);
        for (int i = 0; i < 4; ++i) k[i] = float(lens.data()[i]);
    }
    // Whether a point falls in it, beyond `nearest`; then row, column and depth are those of the point.
    bool shows(const float *p) {
        depth = m[2][0] * p[0] + m[2][1] * p[1] + m[2][2] * p[2] + m[2][3];
        if (!(depth > nearest)) return false;
        const float x = k[0] * (m[0][0] * p[0] + m[0][1] * p[1] + m[0][2] * p[2] + m[0][3]) / depth + k[2];
        if (!(x >= 0 && x < width)) return false;
        const float y = k[1] * (m[1][0] * p[0] + m[1][1] * p[1] + m[1][2] * p[2] + m[1][3]) / depth + k[3];
        if (!(y >= 0 && y < height)) return false;
        row = int(y), column = int(x);
        return true;
    }
};

void add_colour(std::size_t pixel, int32_t point, const Hues &chroma, const Plane &lightness, const Counts &seen,
                const HueSums &chroma_sum, const Sums &lightness_sum) {
    ++seen.data()[point];
    for (int k = 0; k < 2; ++k) chroma_sum.data()[2 * point + k] += chroma.data()[2 * pixel + k];
    lightness_sum.data()[point] += lightness.data()[pixel];
}

}  // namespace

void bind_pictures(nb::module_ &m) {
    m.def(
        "points_on_surface",
        [](Points points, Pose view, Lens lens, Plane depth, double tolerance) {
            const double *T = view.data(), fx = lens.data()[0], fy = lens.data()[1], cx = lens.data()[2], cy = lens.data()[3];
            const int64_t height = int64_t(depth.shape(0)), width = int64_t(depth.shape(1));
            std::vector<int64_t> rows, pixels;
            {
                nb::gil_scoped_release release;
                for (std::size_t i = 0; i < points.shape(0); ++i) {
                    const double *p = points.data() + 3 * i;
                    const double z = T[8] * p[0] + T[9] * p[1] + T[10] * p[2] + T[11];
                    if (!(z > 1e-9)) continue;
                    const double column = fx * (T[0] * p[0] + T[1] * p[1] + T[2] * p[2] + T[3]) / z + cx;
                    if (!(column >= 0 && column < double(width))) continue;
                    const double line = fy * (T[4] * p[0] + T[5] * p[1] + T[6] * p[2] + T[7]) / z + cy;
                    if (!(line >= 0 && line < double(height))) continue;
                    const float surface = depth.data()[int64_t(line) * width + int64_t(column)];
                    if (!(surface > 0) || !(std::abs(z - double(surface)) < double(float(tolerance) * surface))) continue;
                    rows.push_back(int64_t(i));
                    pixels.push_back(int64_t(column)), pixels.push_back(int64_t(line));
                }
            }
            const std::size_t found = rows.size();
            return std::make_tuple(numpy_of(std::move(rows), {found}), numpy_of(std::move(pixels), {found, 2}));
        },
        nb::arg("points"), nb::arg("T_camera_frame"), nb::arg("intrinsics"), nb::arg("depth"), nb::arg("tolerance"),
        "Rows (n,) of the points that lie on the surface of a depth image (0 without one), within a share of its depth; and\n"
        "their pixels (n, 2), column and row.");
    m.def(
        "depth_ranges",
        [](Plane depth, Mask opaque) {
            same_size(depth, opaque);
            const int64_t height = int64_t(depth.shape(0)), width = int64_t(depth.shape(1)), size = height * width;
            std::vector<float> low(size), high(size);
            {
                nb::gil_scoped_release release;
                Scratch off(size), in(size), between(size);
                for (int64_t p = 0; p < size; ++p) off[p] = opaque.data()[p] ? 0 : __builtin_inff();
                range(depth.data(), off, height, width, in, between, low.data(), high.data());
            }
            const std::size_t h = depth.shape(0), w = depth.shape(1);
            return std::make_tuple(numpy_of(std::move(low), {h, w}), numpy_of(std::move(high), {h, w}));
        },
        nb::arg("depth"), nb::arg("opaque"),
        "(H, W) lowest and highest opaque depth over 3 x 3 pixels; inf and -inf where nothing is opaque.");
    m.def(
        "tones_apart",
        [](Colours a, Colours b, Mask both, Line slope, Line offset) {
            same_size(a, both), same_size(b, both);
            const int64_t height = int64_t(a.shape(0)), width = int64_t(a.shape(1)), size = height * width;
            std::vector<float> out(3 * size), brightest(size);
            {
                nb::gil_scoped_release release;
                const float still[3] = {1, 1, 1}, none[3] = {0, 0, 0};
                // By bands of rows, which stay in the cache; each with the rows beside it.
                const int64_t most = (kBand + 2) * width;
                Scratch tones_a(4 * most), tones_b(4 * most), off(most), in(most), between(most);
                Scratch low_a(most), high_a(most), low_b(most), high_b(most);
                for (int64_t first = 0; first < height; first += kBand) {
                    const int64_t from = std::max<int64_t>(first - 1, 0), to = std::min(first + kBand + 1, height);
                    const int64_t rows = to - from, band = rows * width, skip = (first - from) * width;
                    const int64_t count = (std::min(first + kBand, height) - first) * width;
                    tones(a.data() + 3 * from * width, band, slope.data(), offset.data(), tones_a);
                    tones(b.data() + 3 * from * width, band, still, none, tones_b);
                    const bool *counts = both.data() + from * width;
                    for (int64_t p = 0; p < band; ++p) off[p] = counts[p] ? 0 : 1e3f;  // beyond all logarithms of colours
                    for (int k = 0; k < 3; ++k) {
                        range(tones_a + k * band, off, rows, width, in, between, low_a, high_a);
                        range(tones_b + k * band, off, rows, width, in, between, low_b, high_b);
                        float *to_pixel = &out[3 * first * width + k];
                        for (int64_t p = skip; p < skip + count; ++p, to_pixel += 3) {
                            const float apart = higher(low_b[p] - high_a[p], 0) + lower(high_b[p] - low_a[p], 0);
                            *to_pixel = counts[p] ? apart : 0;
                        }
                    }
                    for (int64_t p = 0; p < count; ++p)
                        brightest[first * width + p] = higher(tones_a[3 * band + skip + p], tones_b[3 * band + skip + p]);
                }
            }
            const std::size_t h = a.shape(0), w = a.shape(1);
            return std::make_tuple(numpy_of(std::move(out), {h, w, 3}), numpy_of(std::move(brightest), {h, w}));
        },
        nb::arg("a"), nb::arg("b"), nb::arg("both"), nb::arg("slope"), nb::arg("offset"),
        "By how much (H, W, 3) red over green, blue over green and lightness of logarithms of colours b (H, W, 3) lie above\n"
        "those of a (below: negative), which a line brings to b's exposure, beyond the ranges of both over those of 3 x 3\n"
        "pixels that count, 0 at others; and the largest logarithm (H, W) of either.");
    m.def(
        "beyond_ranges",
        [](Colours a, Colours b) {
            same_size(a, b);
            const int64_t height = int64_t(a.shape(0)), width = int64_t(a.shape(1)), size = height * width;
            std::vector<float> out(3 * size);
            {
                nb::gil_scoped_release release;
                Scratch channel(size), between(size), low(size), high(size);
                for (int k = 0; k < 3; ++k) {
                    for (int64_t p = 0; p < size; ++p) channel[p] = a.data()[3 * p + k];
                    over_3x3<lower>(channel, height, width, between, low);
                    over_3x3<higher>(channel, height, width, between, high);
                    for (int64_t p = 0; p < size; ++p) {
                        const float value = b.data()[3 * p + k];
                        out[3 * p + k] = value - lower(higher(value, low[p]), high[p]);
                    }
                }
            }
            return numpy_of(std::move(out), {a.shape(0), a.shape(1), 3});
        },
        nb::arg("a"), nb::arg("b"), "How far (H, W, 3) b lies beyond the range of a over 3 x 3 pixels, channel by channel.");
    m.def(
        "place_points",
        [](Floats points, Pose pose, Lens lens, int width, int height, double nearest) {
            std::vector<int32_t> index, row, column;
            std::vector<float> z;
            {
                nb::gil_scoped_release release;
                Projection to(pose, lens, width, height, nearest);
                for (std::size_t i = 0; i < points.shape(0); ++i)
                    if (to.shows(points.data() + 3 * i)) {
                        index.push_back(int32_t(i)), row.push_back(to.row), column.push_back(to.column);
                        z.push_back(to.depth);
                    }
            }
            const std::size_t count = index.size();
            return std::make_tuple(numpy_of(std::move(index), {count}), numpy_of(std::move(row), {count}),
                                   numpy_of(std::move(column), {count}), numpy_of(std::move(z), {count}));
        },
        nb::arg("points"), nb::arg("pose"), nb::arg("lens"), nb::arg("width"), nb::arg("height"), nb::arg("nearest"),
        "Which points (n,) fall in the picture of a camera (frame to camera (4, 4), fx fy cx cy) beyond `nearest`; their row\n"
        "(n,) and column (n,) there, and their depth (n,).");
    m.def(
        "count_observations",
        [](Floats points, Spans spans, Pose pose, Lens lens, Plane near, Plane far, double nearest, double margin, Axes axes,
           double min_cosine, Counts times_seen, Bits directions, Sums sharpness) {
            const std::size_t n = points.shape(0);
            same_size(near, far);
            if (times_seen.shape(0) != n || directions.shape(0) != n || sharpness.shape(0) != n || axes.shape(0) > 32)
                throw std::invalid_argument("counts of other points, or more than 32 directions");
            for (std::size_t i = 0; i < spans.shape(0); ++i)
                if (spans.data()[2 * i] < 0 || spans.data()[2 * i + 1] > int64_t(n)) throw std::invalid_argument("no such points");
            nb::gil_scoped_release release;
            Projection to(pose, lens, int(near.shape(1)), int(near.shape(0)), nearest);
            double centre[3] = {};
            for (int c = 0; c < 3; ++c)
                for (int r = 0; r < 3; ++r) centre[c] -= pose.data()[4 * r + c] * pose.data()[4 * r + 3];
            for (std::size_t span = 0; span < spans.shape(0); ++span)
                for (int64_t i = spans.data()[2 * span]; i < spans.data()[2 * span + 1]; ++i) {
                    const float *p = points.data() + 3 * i;
                    if (!to.shows(p)) continue;
                    const std::size_t pixel = std::size_t(to.row) * near.shape(1) + std::size_t(to.column);
                    if (!(to.depth > near.data()[pixel] - float(margin) && to.depth < far.data()[pixel] + float(margin))) continue;
                    ++times_seen.data()[i];
                    const float fine = float(lens.data()[0] / double(to.depth));
                    sharpness.data()[i] += fine * fine;
                    double ray[3], squared = 0;
                    for (int c = 0; c < 3; ++c) ray[c] = centre[c] - double(p[c]), squared += ray[c] * ray[c];
                    const double length = std::max(std::sqrt(squared), 1e-9);
                    for (double &c : ray) c /= length;
                    uint32_t near_axes = 0;
                    for (std::size_t d = 0; d < axes.shape(0); ++d) {
                        const double *axis = axes.data() + 3 * d;
                        const bool is_near = ray[0] * axis[0] + ray[1] * axis[1] + ray[2] * axis[2] > min_cosine;
                        near_axes |= uint32_t(is_near) << d;
                    }
                    directions.data()[i] |= near_axes;
                }
        },
        nb::arg("points"), nb::arg("spans"), nb::arg("pose"), nb::arg("lens"), nb::arg("near"), nb::arg("far"),
        nb::arg("nearest"), nb::arg("margin"), nb::arg("axes"), nb::arg("min_cosine"), nb::arg("times_seen"),
        nb::arg("directions"), nb::arg("sharpness"),
        "Adds to the counts (N,) of points, of which those in spans (S, 2) of rows are looked at, that one view observes them:\n"
        "they lie within a margin of the depths near and far (H, W) of its surface. `directions` has a bit for each axis (D, 3)\n"
        "that the ray to the camera is near to, `sharpness` the square of pixels a metre.");
    m.def(
        "count_looks",
        [](Rows index, Rows row, Rows column, Depths z, Plane near, Plane far, Plane depth, Mask solid, Mask opaque, Mask sure,
           Mask covered, Mask one, Hues chroma, Plane lightness, double focal, double base, double share, Counts through,
           Counts on_surface, Counts hidden, Counts grazed, Counts behind, Counts well, Sums sharpness, Counts colour_seen,
           HueSums chroma_sum, Sums lightness_sum) {
            const std::size_t n = through.shape(0);
            check(index, row, column, z, near, n);
            for (const Plane &of : {far, depth, lightness}) same_size(near, of);
            for (const Mask &of : {solid, opaque, sure, covered, one}) same_size(near, of);
            same_size(near, chroma);
            for (const Counts &of : {on_surface, hidden, grazed, behind, well, colour_seen})
                if (of.shape(0) != n) throw std::invalid_argument("counts are of the same points");
            if (sharpness.shape(0) != n || chroma_sum.shape(0) != n || lightness_sum.shape(0) != n)
                throw std::invalid_argument("sums are of the same points");
            nb::gil_scoped_release release;
            for (std::size_t i = 0; i < index.shape(0); ++i) {
                const std::size_t p = std::size_t(row.data()[i]) * near.shape(1) + std::size_t(column.data()[i]);
                const int32_t g = index.data()[i];
                const float at = z.data()[i], gap = float(base) + float(share) * at, low = near.data()[p], high = far.data()[p];
                if (opaque.data()[p] && at < depth.data()[p] - gap) ++grazed.data()[g];
                if (!solid.data()[p]) continue;
                if (at < low - gap) {
                    ++through.data()[g];
                } else if (at > high + gap) {
                    ++hidden.data()[g];
                    continue;
                } else if (high - low < 4 * gap) {  // where depths jump, lying somewhere between proves nothing
                    ++on_surface.data()[g];
                    behind.data()[g] += covered.data()[p];
                    if (one.data()[p]) add_colour(p, g, chroma, lightness, colour_seen, chroma_sum, lightness_sum);
                } else {
                    continue;
                }
                well.data()[g] += sure.data()[p];
                const float fine = float(focal / double(at));
                sharpness.data()[g] += fine * fine;
            }
        },
        nb::arg("index"), nb::arg("row"), nb::arg("column"), nb::arg("z"), nb::arg("near"), nb::arg("far"), nb::arg("depth"),
        nb::arg("solid"), nb::arg("opaque"), nb::arg("sure"), nb::arg("covered"), nb::arg("one"), nb::arg("chroma"),
        nb::arg("lightness"), nb::arg("focal"), nb::arg("base"), nb::arg("share"), nb::arg("through"), nb::arg("on_surface"),
        nb::arg("hidden"), nb::arg("grazed"), nb::arg("behind"), nb::arg("well"), nb::arg("sharpness"), nb::arg("colour_seen"),
        nb::arg("chroma_sum"), nb::arg("lightness_sum"),
        "Adds to the counts (N,) of points what one view says of those that are placed in it; see gsmap/compare/evidence.py.");
    m.def(
        "add_colours",
        [](Rows index, Rows row, Rows column, Depths z, Plane depth, Mask one, Hues chroma, Plane lightness, double base,
           double share, Counts colour_seen, HueSums chroma_sum, Sums lightness_sum) {
            const std::size_t n = colour_seen.shape(0);
            check(index, row, column, z, depth, n);
            same_size(depth, one), same_size(depth, chroma), same_size(depth, lightness);
            if (chroma_sum.shape(0) != n || lightness_sum.shape(0) != n)
                throw std::invalid_argument("sums are of the same points");
            nb::gil_scoped_release release;
            for (std::size_t i = 0; i < index.shape(0); ++i) {
                const std::size_t p = std::size_t(row.data()[i]) * depth.shape(1) + std::size_t(column.data()[i]);
                const float at = z.data()[i];
                if (one.data()[p] && std::abs(at - depth.data()[p]) <= float(base) + float(share) * at)
                    add_colour(p, index.data()[i], chroma, lightness, colour_seen, chroma_sum, lightness_sum);
            }
        },
        nb::arg("index"), nb::arg("row"), nb::arg("column"), nb::arg("z"), nb::arg("depth"), nb::arg("one"), nb::arg("chroma"),
        nb::arg("lightness"), nb::arg("base"), nb::arg("share"), nb::arg("colour_seen"), nb::arg("chroma_sum"),
        nb::arg("lightness_sum"),
        "Adds to the sums (N,) of points the differences of colour that one view has of those that lie on its surface.");
}

}  // namespace gsmap
