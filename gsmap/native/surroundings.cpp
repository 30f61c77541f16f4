// What surrounds a landmark: colours and counts of the points in rings, or in shells.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "arrays.h"
#include "threads.h"

namespace gsmap {
namespace {

// A point and its three values.
struct Valued {
    double at[3], values[3];
};

// Points sorted into square columns of a plane, and by height within each, so that those near a place are found in few
// runs.
struct Columns {
    double low[2] = {}, size;
    int n[2] = {};
    std::vector<std::int64_t> starts;
    std::vector<Valued> sorted;

    Columns(const Points &points, const Points &values, double cell) : size(cell) {
        const std::size_t count = points.shape(0);
        double high[2] = {};
        for (std::size_t i = 0; i < count; ++i)
            for (int k = 0; k < 2; ++k) {
                const double v = points.data()[3 * i + k];
                low[k] = i ? std::min(low[k], v) : v;
                high[k] = i ? std::max(high[k], v) : v;
            }
        for (int k = 0; k < 2; ++k) {  // however far the points reach, there are no more columns than these
            const double columns = std::floor((high[k] - low[k]) / size) + 1;
            if (columns > 4096) size = (high[k] - low[k]) / 4095;
        }
        for (int k = 0; k < 2; ++k) n[k] = int(std::floor((high[k] - low[k]) / size)) + 1;
        starts.assign(std::size_t(n[0]) * n[1] + 1, 0);
        std::vector<std::int64_t> column(count);
        for (std::size_t i = 0; i < count; ++i) {
            const double *p = points.data() + 3 * i;
            column[i] = std::int64_t(at(p[0], 0)) * n[1] + at(p[1], 1);
            ++starts[column[i] + 1];
        }
        for (std::size_t i = 1; i < starts.size(); ++i) starts[i] += starts[i - 1];
        std::vector<std::int64_t> next(starts.begin(), starts.end() - 1);
        sorted.resize(count);
        for (std::size_t i = 0; i < count; ++i) {
            Valued &to = sorted[next[column[i]]++];
            std::copy_n(points.data() + 3 * i, 3, to.at);
            std::copy_n(values.data() + 3 * i, 3, to.values);
        }
        for (std::size_t c = 0; c + 1 < starts.size(); ++c)
            std::stable_sort(sorted.begin() + starts[c], sorted.begin() + starts[c + 1],
                             [](const Valued &a, const Valued &b) { return a.at[2] < b.at[2]; });
    }

    // The first point of a column above a height, or at it.
    std::int64_t from(std::size_t column, double height) const {
        return std::lower_bound(sorted.begin() + starts[column], sorted.begin() + starts[column + 1], height,
                                [](const Valued &v, double z) { return v.at[2] < z; }) -
               sorted.begin();
    }

    int at(double v, int axis) const {
        return int(std::clamp(std::floor((v - low[axis]) / size), 0.0, double(n[axis] - 1)));
    }
};

// The largest number whose root is no larger than a length: what is held against it needs no root.
double square_of(double length) {
    if (length < 0) return -1;  // none is
    double square = length * length, next = square;
    while (std::sqrt(square) > length) square = std::nextafter(square, 0.0);
    while ((next = std::nextafter(square, __builtin_inf())) > square && std::sqrt(next) <= length) square = next;
    return square;
}

// How many of the edges, which rise, lie below a value.
int below(const std::vector<double> &edges, double value) {
    int count = 0;
    for (double edge : edges) count += edge < value;
    return count;
}

// See gsmap/describe/landmarks/context.py: sums of values (M, bins, 3) and counts (M, bins), in rings of an upright
// cylinder where there are heights, else in shells.
void surroundings(const Points &positions, const Points &points, const Points &values, const Numbers &radii,
                  const Numbers &given_heights, double *sums, double *counts) {
    const std::vector<double> heights(given_heights.data(), given_heights.data() + given_heights.shape(0));
    std::vector<double> squares;
    for (std::size_t i = 0; i < radii.shape(0); ++i) squares.push_back(square_of(radii.data()[i]));
    const int rings = int(squares.size()), levels = std::max(int(heights.size()) - 1, 1);
    const double reach = radii.data()[rings - 1], farthest = squares.back();
    const bool upright = !heights.empty();
    const Columns columns(points, values, reach / 6);
    const double bottom = upright ? heights.front() : -reach, top = upright ? heights.back() : reach;
    parallel_for(int64_t(positions.shape(0)), [&](int64_t m) {
        const double *p = positions.data() + 3 * m;
        double *sum = sums + m * rings * levels * 3, *count = counts + m * rings * levels;
        const int x1 = columns.at(p[0] + reach, 0);
        for (int x = columns.at(p[0] - reach, 0); x <= x1; ++x) {
            // The columns of this row that reach into the circle.
            const double left = columns.low[0] + x * columns.size, right = left + columns.size;
            const double off = x == 0 || x == columns.n[0] - 1 ? 0 : std::max({left - p[0], p[0] - right, 0.0});
            const double half = std::sqrt(std::max(reach * reach - off * off, 0.0)) + 1e-6 * columns.size;
            const int y1 = columns.at(p[1] + half, 1);
            for (int y = columns.at(p[1] - half, 1); y <= y1; ++y) {
                const std::size_t column = std::size_t(x) * columns.n[1] + y;
                const std::int64_t end = columns.starts[column + 1];
                const double over = p[2] + top + 1e-9 * reach;
                int level = 0;  // rises with the points
                for (std::int64_t i = columns.from(column, p[2] + bottom - 1e-9 * reach); i < end; ++i) {
                    const Valued &q = columns.sorted[i];
                    if (q.at[2] > over) break;
                    const double dx = q.at[0] - p[0], dy = q.at[1] - p[1], dz = q.at[2] - p[2];
                    double distance = dx * dx + dy * dy;
                    if (!upright) distance += dz * dz;
                    if (distance > farthest || (upright && (dz <= bottom || dz > top))) continue;
                    while (upright && dz > heights[level + 1]) ++level;
                    const int bin = below(squares, distance) * levels + level;
                    count[bin] += 1;
                    for (int c = 0; c < 3; ++c) sum[3 * bin + c] += q.values[c];
                }
            }
        }
    });
}

}  // namespace

void bind_surroundings(nb::module_ &m) {
    m.def(
        "landmark_surroundings",
        [](Points positions, Points points, Points values, Numbers radii, Numbers heights) {
            if (values.shape(0) != points.shape(0) || radii.shape(0) < 1 || heights.shape(0) == 1)
                throw std::invalid_argument("surroundings need a value for each point, a radius, and heights or none");
            const std::size_t levels = std::max<std::size_t>(heights.shape(0), 2) - 1;
            const std::size_t count = positions.shape(0), bins = radii.shape(0) * levels;
            std::vector<double> sums(count * bins * 3), counts(count * bins);
            if (points.shape(0)) {
                nb::gil_scoped_release release;
                surroundings(positions, points, values, radii, heights, sums.data(), counts.data());
            }
            return nb::make_tuple(numpy_of(std::move(sums), {count, bins, 3}), numpy_of(std::move(counts), {count, bins}));
        },
        nb::arg("positions"), nb::arg("points"), nb::arg("values"), nb::arg("radii"), nb::arg("heights"),
        "Sums (M, bins, 3) of the values and counts (M, bins) of the points around each position.");
}

}  // namespace gsmap
