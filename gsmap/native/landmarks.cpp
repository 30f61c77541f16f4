// Landmarks: extrema of colour and density on a block of a grid.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <vector>

#include "arrays.h"

namespace gsmap {
namespace {

constexpr int SEGMENT = 16;  // cells along the last axis that are worked on, or left out, together
constexpr int WINDOW = 2;    // a maximum is one among so many cells to either side

// Taps of a normalised Gaussian, three standard deviations to either side.
std::vector<float> taps_of(double sigma) {
    int reach = int(3.0 * sigma + 0.5);
    std::vector<double> taps(2 * reach + 1);
    double total = 0;
    for (int k = -reach; k <= reach; ++k) total += taps[k + reach] = std::exp(-0.5 * k * k / (sigma * sigma));
    std::vector<float> out;
    for (double t : taps) out.push_back(float(t / total));
    return out;
}

// A dense block of cells, and which of its segments hold, or need, anything: surfaces fill little of a place.
struct Grid {
    int nx, ny, nz, segments;

    Grid(int x, int y, int z)
        : nx(x), ny(y), nz((z + SEGMENT - 1) / SEGMENT * SEGMENT), segments(nz / SEGMENT) {}
    std::size_t row(int x, int y) const { return (std::size_t(x) * ny + y) * nz; }
    std::size_t flag(int x, int y) const { return (std::size_t(x) * ny + y) * segments; }
    std::size_t cells() const { return std::size_t(nx) * ny * nz; }
    std::size_t flags() const { return std::size_t(nx) * ny * segments; }
};

using Field = std::vector<float>;
using Flags = std::vector<std::uint8_t>;

// Segments that have a flagged one within `reach` steps along an axis (along the last one: of segments).
Flags dilated(const Grid &g, const Flags &in, int axis, int reach) {
    Flags out(g.flags(), 0);
    const int n[3] = {g.nx, g.ny, g.segments};
    const std::size_t step[3] = {std::size_t(g.ny) * g.segments, std::size_t(g.segments), 1};
    const int a = (axis + 1) % 3, b = (axis + 2) % 3;
    for (int i = 0; i < n[a]; ++i)
        for (int j = 0; j < n[b]; ++j) {
            const std::size_t base = i * step[a] + j * step[b];
            int last = -reach - 1;
            for (int k = 0; k < n[axis] + reach; ++k) {
                if (k < n[axis] && in[base + k * step[axis]]) last = k;
                const int at = k - reach;  // the latest flag up to k tells of at, and so does any from at - reach on
                if (at >= 0 && last >= at - reach) out[base + at * step[axis]] = 1;
            }
        }
    return out;
}

void both(Flags &flags, const Flags &others) {
    for (std::size_t i = 0; i < flags.size(); ++i) flags[i] &= others[i];
}

// Wider vectors where the processor has them; nothing is contracted, so all give the same bits.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

// One pass along the first or second axis into the wanted segments.
WIDE void pass_across(const Grid &g, int axis, const std::vector<float> &taps, const Field &in, const Flags &filled,
                 Field &out, const Flags &wanted) {
    const int reach = int(taps.size()) / 2, length = axis == 0 ? g.nx : g.ny;
    const std::ptrdiff_t step = axis == 0 ? g.row(1, 0) : g.nz, flag_step = axis == 0 ? g.flag(1, 0) : g.segments;
    for (int x = 0; x < g.nx; ++x)
        for (int y = 0; y < g.ny; ++y) {
            const int at = axis == 0 ? x : y, from = std::max(-reach, -at), to = std::min(reach, length - 1 - at);
            for (int s = 0; s < g.segments; ++s) {
                const std::size_t flag = g.flag(x, y) + s, cell = g.row(x, y) + std::size_t(s) * SEGMENT;
                if (!wanted[flag]) continue;
                float sum[SEGMENT] = {};
                for (int k = from; k <= to; ++k) {
                    if (!filled[flag + k * flag_step]) continue;
                    const float *source = &in[cell + k * step], tap = taps[k + reach];
                    for (int c = 0; c < SEGMENT; ++c) sum[c] += tap * source[c];
                }
                std::memcpy(&out[cell], sum, sizeof sum);
            }
        }
}

// One pass along the last axis into the wanted segments.
WIDE void pass_along(const Grid &g, const std::vector<float> &taps, const Field &in, const Flags &filled, Field &out,
                const Flags &wanted) {
    const int reach = int(taps.size()) / 2;  // less than a segment
    Field line(g.nz + 2 * SEGMENT, 0.f);
    for (int x = 0; x < g.nx; ++x)
        for (int y = 0; y < g.ny; ++y) {
            const std::size_t flag = g.flag(x, y), row = g.row(x, y);
            if (!std::memchr(&wanted[flag], 1, g.segments)) continue;
            for (int s = 0; s < g.segments; ++s) {
                float *to = &line[(s + 1) * SEGMENT];
                if (filled[flag + s]) std::memcpy(to, &in[row + s * SEGMENT], SEGMENT * sizeof(float));
                else std::memset(to, 0, SEGMENT * sizeof(float));
            }
            for (int s = 0; s < g.segments; ++s) {
                if (!wanted[flag + s]) continue;
                float sum[SEGMENT] = {};
                const float *source = &line[(s + 1) * SEGMENT - reach];
                for (std::size_t k = 0; k < taps.size(); ++k)
                    for (int c = 0; c < SEGMENT; ++c) sum[c] += taps[k] * source[k + c];
                std::memcpy(&out[row + s * SEGMENT], sum, sizeof sum);
            }
        }
}

// A Gaussian convolution, zero beyond the block, of what is filled into what is wanted.
struct Blur {
    std::vector<float> taps;
    Flags after_x, after_y, after_z;

    Blur(const Grid &g, double sigma, const Flags &filled, const Flags *wanted) : taps(taps_of(sigma)) {
        const int reach = int(taps.size()) / 2;
        after_x = dilated(g, filled, 0, reach);
        after_y = dilated(g, after_x, 1, reach);
        after_z = dilated(g, after_y, 2, 1);
        if (wanted) {
            after_z = *wanted;
            const Flags around = dilated(g, after_z, 2, 1);
            both(after_y, around);
            both(after_x, dilated(g, around, 1, reach));
        }
    }

    void operator()(const Grid &g, const Field &in, const Flags &filled, Field &a, Field &b, Field &out) const {
        pass_across(g, 0, taps, in, filled, a, after_x);
        pass_across(g, 1, taps, a, after_x, b, after_y);
        pass_along(g, taps, b, after_y, out, after_z);
    }
};

struct Extremum {
    double position[3], ratio;
    int channel, negative;
};

// Points of one block and its halo, in cells, their colours and areas; and the block's least corner and shape.
struct Block {
    std::vector<double> points, lab, areas;
    double low[3] = {};
    int shape[3] = {};

    Block(const Points &all, const Points &colours, const Numbers &sizes, const double *core, double edge, double halo) {
        double high[3] = {};
        for (std::size_t i = 0; i < all.shape(0); ++i) {
            const double *at = all.data() + 3 * i;
            bool inside = true;
            for (int k = 0; k < 3; ++k) inside &= at[k] >= core[k] - halo && at[k] < core[k] + edge + halo;
            if (!inside) continue;
            for (int k = 0; k < 3; ++k) {
                low[k] = areas.empty() ? at[k] : std::min(low[k], at[k]);
                high[k] = areas.empty() ? at[k] : std::max(high[k], at[k]);
            }
            points.insert(points.end(), at, at + 3);
            lab.insert(lab.end(), colours.data() + 3 * i, colours.data() + 3 * i + 3);
            areas.push_back(sizes.data()[i]);
        }
        for (int k = 0; k < 3; ++k) {  // room for extrema just off the surface
            low[k] = std::floor(low[k]) - 3;
            shape[k] = int(std::floor(high[k]) - low[k]) + 4;
        }
    }
};

// Trilinear splatting of values of points (in cells of the block) into its cells.
void splat(const Grid &g, const Block &block, const std::vector<double> &values, Field &out) {
    for (std::size_t i = 0; i < values.size(); ++i) {
        int base[3];
        double t[3];
        for (int k = 0; k < 3; ++k) {
            const double at = block.points[3 * i + k] - block.low[k] - 0.5;
            base[k] = int(std::floor(at));
            t[k] = at - base[k];
        }
        for (int corner = 0; corner < 8; ++corner) {
            const int dx = corner >> 2, dy = corner >> 1 & 1, dz = corner & 1;
            const double share = (dx ? t[0] : 1 - t[0]) * (dy ? t[1] : 1 - t[1]) * (dz ? t[2] : 1 - t[2]);
            out[g.row(base[0] + dx, base[1] + dy) + base[2] + dz] += float(share * values[i]);
        }
    }
}

void maxima(const Grid &g, const Field &response, const Flags &surface, const int *shape, float sign, double threshold,
            int channel, std::vector<Extremum> &found) {
    for (int x = 0; x < shape[0]; ++x)
        for (int y = 0; y < shape[1]; ++y)
            for (int s = 0; s < g.segments; ++s) {
                if (!surface[g.flag(x, y) + s]) continue;
                for (int z = s * SEGMENT; z < std::min((s + 1) * SEGMENT, shape[2]); ++z) {
                    const float top = sign * response[g.row(x, y) + z];
                    if (!(top > threshold)) continue;
                    const int x0 = std::max(x - WINDOW, 0), x1 = std::min(x + WINDOW, shape[0] - 1);
                    const int y0 = std::max(y - WINDOW, 0), y1 = std::min(y + WINDOW, shape[1] - 1);
                    const int z0 = std::max(z - WINDOW, 0), z1 = std::min(z + WINDOW, shape[2] - 1);
                    bool highest = true;
                    double total = 0, mean[3] = {};
                    for (int i = x0; highest && i <= x1; ++i)
                        for (int j = y0; highest && j <= y1; ++j)
                            for (int k = z0; k <= z1; ++k) {
                                const float value = sign * response[g.row(i, j) + k];
                                if (value > top) {
                                    highest = false;
                                    break;
                                }
                                if (value > 0.6 * top) {
                                    total += value;
                                    mean[0] += double(value) * i, mean[1] += double(value) * j;
                                    mean[2] += double(value) * k;
                                }
                            }
                    if (highest)
                        found.push_back({{mean[0] / total, mean[1] / total, mean[2] / total},
                                         double(top) / threshold, channel, sign < 0});
                }
            }
}

// Cells of a block, kept from one to the next: making them anew costs as much as filling them.
struct Work {
    Field field, response;           // zero between blocks
    Field a, b, mass, wide, smooth;  // anything

    void fit(std::size_t cells) {
        for (Field *f : {&field, &response, &a, &b, &mass, &wide, &smooth})
            if (f->size() < cells) f->resize(cells, 0.f);
    }
};

void empty(Field &field, const Flags &flags) {
    for (std::size_t i = 0; i < flags.size(); ++i)
        if (flags[i]) std::fill_n(&field[i * SEGMENT], SEGMENT, 0.f);
}

// See gsmap/describe/landmarks/detect.py.
std::vector<Extremum> extrema(const Block &block, Work &work, const double *thresholds, double sigma, double surround) {
    const int *shape = block.shape;
    const Grid g(shape[0], shape[1], shape[2]);
    const std::size_t n = block.areas.size();
    work.fit(g.cells());
    auto &[field, response, a, b, mass, wide, smooth] = work;
    std::vector<double> values(block.areas);
    splat(g, block, values, field);
    Flags filled(g.flags());
    for (std::size_t i = 0; i < filled.size(); ++i)
        filled[i] = std::any_of(&field[i * SEGMENT], &field[i * SEGMENT] + SEGMENT, [](float v) { return v > 0; });
    const Blur near(g, sigma, filled, nullptr);
    near(g, field, filled, a, b, mass);
    const float plane = float(std::sqrt(2 * 3.14159265358979323846) * sigma);
    const auto is_surface = [&](std::size_t cell) { return mass[cell] * plane > 0.3f; };
    Flags surface(g.flags(), 0);
    for (std::size_t i = 0; i < surface.size(); ++i)
        if (near.after_z[i])
            for (int c = 0; c < SEGMENT; ++c) surface[i] |= is_surface(i * SEGMENT + c);
    const Blur far(g, sigma * std::sqrt(surround * surround - 1), near.after_z, &surface);
    far(g, mass, near.after_z, a, b, wide);
    std::vector<Extremum> found;
    for (int channel = 0; channel < 4; ++channel) {
        if (channel < 3) {
            empty(field, filled);
            for (std::size_t i = 0; i < n; ++i)
                values[i] = block.areas[i] * (block.lab[3 * i + channel] - (channel == 0 ? 50.0 : 0.0));
            splat(g, block, values, field);
            near(g, field, filled, a, b, smooth);
            far(g, smooth, near.after_z, a, b, field);  // leaves more filled than was: emptied below
        }
        for (std::size_t i = 0; i < surface.size(); ++i) {
            if (!surface[i]) continue;
            for (std::size_t cell = i * SEGMENT; cell < (i + 1) * SEGMENT; ++cell) {
                if (channel == 3) response[cell] = mass[cell] * plane - 1;
                else if (is_surface(cell))
                    response[cell] = smooth[cell] / std::max(mass[cell], 1e-9f) - field[cell] / std::max(wide[cell], 1e-9f);
                else response[cell] = 0;
                field[cell] = 0;
            }
        }
        maxima(g, response, surface, shape, 1.f, thresholds[channel], channel, found);
        if (channel < 3) maxima(g, response, surface, shape, -1.f, thresholds[channel], channel, found);
    }
    empty(field, filled);
    empty(response, surface);
    return found;
}

}  // namespace

void bind_landmarks(nb::module_ &m) {
    m.def(
        "landmark_extrema",
        [](Points points, Points lab, Numbers areas, Numbers thresholds, Points cores, double edge,
           double halo, double sigma, double surround) {
            const std::size_t n = points.shape(0);
            if (lab.shape(0) != n || areas.shape(0) != n || thresholds.shape(0) != 4)
                throw std::invalid_argument("extrema need as many colours and areas as points, and 4 thresholds");
            if (!(edge > 0 && edge <= 1024 && halo >= 0 && halo <= 64))
                throw std::invalid_argument("a block has at most 1024 cells a side, and 64 around");
            std::vector<double> rows;
            {
                nb::gil_scoped_release release;
                Work work;
                for (std::size_t c = 0; c < cores.shape(0); ++c) {
                    const double *core = cores.data() + 3 * c;
                    const Block block(points, lab, areas, core, edge, halo);
                    if (block.areas.empty()) continue;
                    for (Extremum &e : extrema(block, work, thresholds.data(), sigma, surround)) {
                        bool own = true;
                        for (int k = 0; k < 3; ++k) {
                            e.position[k] = e.position[k] + block.low[k] + 0.5;
                            own &= e.position[k] >= core[k] && e.position[k] < core[k] + edge;
                        }
                        if (own)
                            rows.insert(rows.end(), {double(e.channel), double(e.negative), e.position[0],
                                                     e.position[1], e.position[2], e.ratio});
                    }
                }
            }
            const std::size_t count = rows.size() / 6;
            return numpy_of(std::move(rows), {count, 6});
        },
        nb::arg("points"), nb::arg("lab"), nb::arg("areas"), nb::arg("thresholds"), nb::arg("cores"),
        nb::arg("edge"), nb::arg("halo"), nb::arg("sigma"), nb::arg("surround"),
        "Rows (channel, negative, x, y, z, response over threshold) of the extrema within blocks of cells, each looked at "
        "with its halo; all lengths in cells.");
}

}  // namespace gsmap
