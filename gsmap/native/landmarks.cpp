// Landmarks: extrema of colour and density on a block of a grid.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "memory.h"
#include "rasteriser_view.h"
#include "threads.h"

namespace gsmap {
namespace {

using Colours = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

constexpr int CHANNELS = 4;  // L*, a*, b* and surface, side by side in memory: one walk over the grid does them all
constexpr int SEGMENT = 4;   // cells along the last axis that are worked on, or left out, together
constexpr int ROOM = 16;     // rows have so many cells, or a multiple; what is blurred beyond their ends is lost
constexpr int MOST = 64 * SEGMENT;  // cells a side of a block: a word has a bit for each segment of a row
constexpr int WINDOW = 2;    // a maximum is one among so many cells to either side
constexpr int SLAB = 8;      // planes across the first axis into which one task spreads points
constexpr std::size_t CHUNK = 16384;  // points of a task

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

// A dense block of cells. Of its rows along the last axis, words say which segments hold, or need, anything: surfaces
// fill little of a place.
struct Grid {
    int nx, ny, nz, segments;

    Grid(int x, int y, int z)
        : nx(x), ny(y), nz((z + ROOM - 1) / ROOM * ROOM), segments(nz / SEGMENT) {}
    std::size_t row(int x, int y) const { return std::size_t(x) * ny + y; }
    std::size_t rows() const { return std::size_t(nx) * ny; }
    std::size_t values() const { return rows() * nz * CHANNELS; }
    // First value of a segment, of a cell.
    std::size_t at(std::size_t row, int segment) const { return (row * segments + segment) * WIDTH; }
    std::size_t cell(int x, int y, int z) const { return (row(x, y) * nz + z) * CHANNELS; }

    static constexpr int WIDTH = SEGMENT * CHANNELS;  // values of a segment
};

// Values of one cell, wherever they lie.
typedef float Cell __attribute__((vector_size(16), aligned(4), may_alias));
static_assert(Grid::WIDTH == 16, "as the kernels take segments");
static_assert(sizeof(Cell) == CHANNELS * sizeof(float));

using Field = Zeros<float>;
using Flags = std::vector<std::uint64_t>;  // a word for each row

// std::floor of what an int holds, without the call that older processors need for it.
inline int floor_of(double v) {
    const int i = int(v);
    return i - (v < i);
}

// Calls visit(segment) for each that is flagged.
template <class Visit> void each(std::uint64_t flags, Visit visit) {
    for (; flags; flags &= flags - 1) visit(__builtin_ctzll(flags));
}

// Segments that have a flagged one within `reach` cells along an axis.
Flags dilated(const Grid &g, const Flags &in, int axis, int reach) {
    Flags out(in);
    if (axis == 2) {
        const std::uint64_t all = g.segments == 64 ? ~std::uint64_t(0) : (std::uint64_t(1) << g.segments) - 1;
        for (int k = 1; k <= (reach + SEGMENT - 1) / SEGMENT; ++k)
            for (std::size_t i = 0; i < out.size(); ++i) out[i] |= (in[i] << k | in[i] >> k) & all;
        return out;
    }
    const std::size_t step = axis == 0 ? g.ny : 1;
    for (int x = 0; x < g.nx; ++x)
        for (int y = 0; y < g.ny; ++y) {
            const int at = axis == 0 ? x : y, length = axis == 0 ? g.nx : g.ny;
            for (int k = std::max(-reach, -at); k <= std::min(reach, length - 1 - at); ++k)
                out[g.row(x, y)] |= in[g.row(x, y) + k * step];
        }
    return out;
}

void both(Flags &flags, const Flags &others) {
    for (std::size_t i = 0; i < flags.size(); ++i) flags[i] &= others[i];
}

// Wider vectors where the processor has them; nothing is contracted, so all give the same bits.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__)
#define WIDE __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define WIDE
#endif

// The rows that are blurred into one, which of their segments hold anything, and what each counts for.
struct Rows {
    std::vector<const float *> at;
    Flags filled;
    std::vector<float> taps;

    void clear() { at.clear(), filled.clear(), taps.clear(); }
    void add(const float *row, std::uint64_t holds, float tap) {
        at.push_back(row), filled.push_back(holds), taps.push_back(tap);
    }
};

// One pass along the first or second axis into the wanted segments of the row (x, y); `in` holds the rows from `first` on.
void pass_across(const Grid &g, int x, int y, int axis, const std::vector<float> &taps, const float *in, std::size_t first,
                 const Flags &filled, std::uint64_t wanted, Rows &rows, float *out) {
    const int reach = int(taps.size()) / 2, at = axis == 0 ? x : y, length = axis == 0 ? g.nx : g.ny;
    const std::ptrdiff_t step = axis == 0 ? g.ny : 1;
    rows.clear();
    for (int k = std::max(-reach, -at); k <= std::min(reach, length - 1 - at); ++k) {
        const std::size_t row = g.row(x, y) + k * step;
        if (filled[row] & wanted) rows.add(in + g.at(row - first, 0), filled[row], taps[k + reach]);
    }
    kernels->blur_across(rows.at.data(), rows.filled.data(), rows.taps.data(), int(rows.at.size()), wanted, out);
}

// A Gaussian convolution, zero beyond the block, of what is filled into what is wanted.
struct Blur {
    std::vector<float> taps;
    Flags after_x, after_y, after_z;

    Blur(const Grid &g, double sigma, const Flags &filled, const Flags *wanted) : taps(taps_of(sigma)) {
        const int reach = int(taps.size()) / 2;
        after_x = dilated(g, filled, 0, reach);
        after_y = dilated(g, after_x, 1, reach);
        after_z = dilated(g, after_y, 2, reach);
        if (wanted) {
            after_z = *wanted;
            const Flags around = dilated(g, after_z, 2, reach);
            both(after_y, around);
            both(after_x, dilated(g, around, 1, reach));
        }
    }

    // Plane by plane: `plane` holds one after the first pass, a line one of its rows after the second.
    void operator()(const Grid &g, const Field &in, const Flags &filled, Field &out) const {
        const int reach = int(taps.size()) / 2, margin = (reach + SEGMENT - 1) / SEGMENT;  // cells, segments
        parallel_for(g.nx, [&](int64_t task) {
            static thread_local std::vector<float> plane;  // anything
            if (plane.size() < g.at(g.ny, 0)) plane.resize(g.at(g.ny, 0));
            std::vector<float> line(std::size_t(g.segments + 2 * margin) * Grid::WIDTH);  // zero but for what the row holds
            float *own = &line[margin * Grid::WIDTH];
            Rows rows;
            const int x = int(task);
            for (int y = 0; y < g.ny; ++y)
                if (const std::uint64_t wanted = after_x[g.row(x, y)])
                    pass_across(g, x, y, 0, taps, &in[0], 0, filled, wanted, rows, &plane[g.at(y, 0)]);
            for (int y = 0; y < g.ny; ++y) {
                const std::size_t row = g.row(x, y);
                if (!after_z[row]) continue;
                pass_across(g, x, y, 1, taps, plane.data(), g.row(x, 0), after_x, after_y[row], rows, own);
                kernels->blur_along(own - reach * CHANNELS, CHANNELS, taps.data(), int(taps.size()), after_z[row],
                                    &out[g.at(row, 0)]);
                each(after_y[row], [&](int s) { std::fill_n(own + s * Grid::WIDTH, Grid::WIDTH, 0.f); });
            }
        });
    }
};

struct Extremum {
    double position[3], ratio;
    int channel, negative;
};

// Which block, of cubes of equal size, something lies in; numbers without a fraction, however far out.
using BlockIndex = std::array<double, 3>;

// Points of one block that follow each other, and the box around them in cells: they come in an order in space, so runs are
// few.
struct Run {
    BlockIndex block;
    std::size_t begin, end;
    double low[3], high[3];

    bool touches(const double *from, double side) const {
        for (int k = 0; k < 3; ++k)
            if (high[k] < from[k] || low[k] >= from[k] + side) return false;
        return true;
    }
};

// std::floor, without the call that older processors need for it.
inline double whole_of(double v) {
    if (!(std::abs(v) < 0x1p52)) return v;  // has no fraction
    const double whole = double(std::int64_t(v));
    return whole - (v < whole);
}

// All points as runs, by their blocks of cells of a size.
std::vector<Run> runs_of(const Points &points, double size, double edge) {
    const std::size_t count = points.shape(0);
    std::vector<std::vector<Run>> parts((count + CHUNK - 1) / CHUNK);
    parallel_for(int64_t(parts.size()), [&](int64_t part) {
        std::vector<Run> &runs = parts[part];
        for (std::size_t i = part * CHUNK; i < std::min(count, (part + 1) * CHUNK); ++i) {
            BlockIndex block;
            double at[3];
            for (int k = 0; k < 3; ++k) block[k] = whole_of((at[k] = points.data()[3 * i + k] / size) / edge);
            if (runs.empty() || runs.back().block != block)
                runs.push_back({block, i, i, {at[0], at[1], at[2]}, {at[0], at[1], at[2]}});
            Run &run = runs.back();
            run.end = i + 1;
            for (int k = 0; k < 3; ++k)
                run.low[k] = std::min(run.low[k], at[k]), run.high[k] = std::max(run.high[k], at[k]);
        }
    });
    std::vector<Run> runs;
    for (const auto &part : parts) runs.insert(runs.end(), part.begin(), part.end());
    std::sort(runs.begin(), runs.end(),
              [](const Run &a, const Run &b) { return std::tie(a.block, a.begin) < std::tie(b.block, b.begin); });
    return runs;
}

// The runs that touch a block and its halo, in the order of their points.
std::vector<Run> runs_near(const std::vector<Run> &runs, const BlockIndex &block, double edge, double halo) {
    const int reach = int(std::ceil(halo / edge));
    const double from[3] = {block[0] * edge - halo, block[1] * edge - halo, block[2] * edge - halo};
    std::vector<Run> near;
    for (int dx = -reach; dx <= reach; ++dx)
        for (int dy = -reach; dy <= reach; ++dy) {
            const BlockIndex first{block[0] + dx, block[1] + dy, block[2] - reach};
            auto run = std::lower_bound(runs.begin(), runs.end(), first,
                                        [](const Run &r, const BlockIndex &b) { return r.block < b; });
            for (; run != runs.end() && run->block[0] == first[0] && run->block[1] == first[1] &&
                   run->block[2] <= block[2] + reach; ++run)
                if (run->touches(from, edge + 2 * halo)) near.push_back(*run);
        }
    std::sort(near.begin(), near.end(), [](const Run &a, const Run &b) { return a.begin < b.begin; });
    // So far out that one more is no other number, a block is its own neighbour.
    near.erase(std::unique(near.begin(), near.end(), [](const Run &a, const Run &b) { return a.begin == b.begin; }),
               near.end());
    return near;
}

// What is spread over the cells: points, their colours and areas, in a unit of which a cell has a side and an area.
struct Cloud {
    const double *points;
    const float *colours;
    const double *areas;
    double size, square;
};

// Where a point lies in the cells of a block: the least of the cells that it is spread over, and how far beyond its middle.
struct Place {
    int cell[3];
    double beyond[3];

    Place(const double *point, double size, const double *low) {
        for (int k = 0; k < 3; ++k) {
            const double at = point[k] / size - low[k] - 0.5;
            cell[k] = floor_of(at);
            beyond[k] = at - cell[k];
        }
    }
};

// One block and its halo: its least corner and shape, and the points in each slab of planes across the first axis.
struct Block {
    double low[3], high[3];
    int shape[3] = {};
    std::vector<Many<std::uint32_t>> rows;  // by slab, then by run, in the order of the points

    Block(const Cloud &cloud, const std::vector<Run> &near, const double *core, double edge, double halo) {
        std::vector<Run> inside(near);  // their boxes become those of the points inside
        const auto holds = [&](const double *at) {
            for (int k = 0; k < 3; ++k)
                if (!(at[k] >= core[k] - halo && at[k] < core[k] + edge + halo)) return false;
            return true;
        };
        const auto is_inside = [&](std::size_t i) {
            const double *p = cloud.points + 3 * i, at[3] = {p[0] / cloud.size, p[1] / cloud.size, p[2] / cloud.size};
            return holds(at);
        };
        parallel_for(int64_t(near.size()), [&](int64_t r) {
            Run &run = inside[r];
            if (holds(run.low) && holds(run.high)) return;
            std::fill_n(run.low, 3, __builtin_inf()), std::fill_n(run.high, 3, -__builtin_inf());
            for (std::size_t i = run.begin; i < run.end; ++i)
                if (is_inside(i))
                    for (int k = 0; k < 3; ++k) {
                        const double at = cloud.points[3 * i + k] / cloud.size;
                        run.low[k] = std::min(run.low[k], at), run.high[k] = std::max(run.high[k], at);
                    }
        });
        std::fill_n(low, 3, __builtin_inf()), std::fill_n(high, 3, -__builtin_inf());
        for (const Run &run : inside)
            for (int k = 0; k < 3; ++k) low[k] = std::min(low[k], run.low[k]), high[k] = std::max(high[k], run.high[k]);
        if (is_empty()) return;
        for (int k = 0; k < 3; ++k) {  // room for extrema just off the surface
            low[k] = std::floor(low[k]) - 3;
            shape[k] = int(std::floor(high[k]) - low[k]) + 4;
        }
        rows.resize(slabs() * near.size());
        parallel_for(int64_t(near.size()), [&](int64_t r) {
            const bool whole = holds(near[r].low) && holds(near[r].high);
            for (std::size_t i = near[r].begin; i < near[r].end; ++i) {
                if (!whole && !is_inside(i)) continue;
                const int cell = Place(cloud.points + 3 * i, cloud.size, low).cell[0];
                for (int slab = cell / SLAB; slab <= (cell + 1) / SLAB; ++slab)
                    rows[slab * near.size() + r].push_back(std::uint32_t(i));
            }
        });
    }
    bool is_empty() const { return low[0] > high[0]; }
    int slabs() const { return (shape[0] + SLAB - 1) / SLAB; }
};

// Trilinear splatting of the points' surface, and of it times their colours, into the cells of a slab; flags the segments.
WIDE void splat(const Grid &g, const Cloud &cloud, const Block &block, int slab, Field &out, Flags &filled) {
    typedef double Values __attribute__((vector_size(32)));
    const std::size_t runs = block.rows.size() / block.slabs();
    for (std::size_t r = slab * runs; r < (slab + 1) * runs; ++r)
        for (const std::uint32_t i : block.rows[r]) {
            const float *lab = cloud.colours + 3 * std::size_t(i);
            const double area = cloud.areas[i] / cloud.square;
            const Values values = {area * (lab[0] - 50.0), area * lab[1], area * lab[2], area};
            const Place at(cloud.points + 3 * std::size_t(i), cloud.size, block.low);
            const double *t = at.beyond;
            const int segment = at.cell[2] / SEGMENT, next = (at.cell[2] + 1) / SEGMENT;
            for (int side = 0; side < 4; ++side) {
                const int x = at.cell[0] + (side >> 1), y = at.cell[1] + (side & 1);
                if (x / SLAB != slab) continue;
                const double across = (side >> 1 ? t[0] : 1 - t[0]) * (side & 1 ? t[1] : 1 - t[1]);
                float *cell = &out[g.cell(x, y, at.cell[2])];
                *reinterpret_cast<Cell *>(cell) += __builtin_convertvector(across * (1 - t[2]) * values, Cell);
                *reinterpret_cast<Cell *>(cell + CHANNELS) += __builtin_convertvector(across * t[2] * values, Cell);
                filled[g.row(x, y)] |= std::uint64_t(1) << segment | std::uint64_t(1) << next;
            }
        }
}

// The maxima of a channel times a sign within their windows, at one cell.
void maximum(const Grid &g, const Field &response, const int *shape, int x, int y, int z, int channel, float sign,
             double threshold, std::vector<Extremum> &found) {
    const auto value_at = [&](int i, int j, int k) { return sign * response[g.cell(i, j, k) + channel]; };
    const float top = value_at(x, y, z);
    // Most cells have a higher neighbour.
    if ((z > 0 && value_at(x, y, z - 1) > top) || (z + 1 < shape[2] && value_at(x, y, z + 1) > top) ||
        (y > 0 && value_at(x, y - 1, z) > top) || (y + 1 < shape[1] && value_at(x, y + 1, z) > top) ||
        (x > 0 && value_at(x - 1, y, z) > top) || (x + 1 < shape[0] && value_at(x + 1, y, z) > top))
        return;
    const int x0 = std::max(x - WINDOW, 0), x1 = std::min(x + WINDOW, shape[0] - 1);
    const int y0 = std::max(y - WINDOW, 0), y1 = std::min(y + WINDOW, shape[1] - 1);
    const int z0 = std::max(z - WINDOW, 0), z1 = std::min(z + WINDOW, shape[2] - 1);
    double total = 0, mean[3] = {};
    for (int i = x0; i <= x1; ++i)
        for (int j = y0; j <= y1; ++j)
            for (int k = z0; k <= z1; ++k) {
                const float value = value_at(i, j, k);
                if (value > top) return;
                if (value > 0.6 * top) {
                    total += value;
                    mean[0] += double(value) * i, mean[1] += double(value) * j;
                    mean[2] += double(value) * k;
                }
            }
    found.push_back({{mean[0] / total, mean[1] / total, mean[2] / total}, double(top) / threshold, channel, sign < 0});
}

// Cells of a block, kept from one block and one call to the next: making them anew costs as much as filling them.
struct Work {
    Field field;   // zero between blocks
    Field smooth;  // anything
    bool whole = true;  // no block was left half done

    // Makes room for the largest block.
    void reserve(const Grid &largest) {
        if (!whole || field.size() < largest.values()) field = Field(), field = Field(largest.values());
        if (smooth.size() < largest.values()) smooth = Field(), smooth = Field(largest.values());
    }
};

// As large a block as any of these points, so many cells a side.
Grid largest(const std::vector<Run> &runs, double cells) {
    int shape[3] = {};
    for (int k = 0; k < 3; ++k) {
        double low = runs.empty() ? 0 : runs[0].low[k], high = low;
        for (const Run &run : runs) low = std::min(low, run.low[k]), high = std::max(high, run.high[k]);
        shape[k] = int(std::min(cells, high - low)) + 9;  // see Block
    }
    return Grid(shape[0], shape[1], shape[2]);
}

inline Cell &cell_of(Field &values, std::size_t cell) { return *reinterpret_cast<Cell *>(&values[cell]); }

// Whether a cell, of this mass after the first blur, belongs to the surface.
inline bool is_surface(float mass, float of_plane) { return mass * of_plane > 0.3f; }

// Empties flagged segments of a plane across the first axis.
void empty(const Grid &g, int x, Field &field, const Flags &flags) {
    for (std::size_t row = g.row(x, 0); row < g.row(x + 1, 0); ++row)
        each(flags[row], [&](int s) { std::fill_n(&field[g.at(row, s)], Grid::WIDTH, 0.f); });
}

// Flags the segments of a plane that hold surface.
WIDE void flag_surface(const Grid &g, int x, const Field &smooth, const Flags &filled, float of_plane, Flags &surface) {
    for (std::size_t row = g.row(x, 0); row < g.row(x + 1, 0); ++row)
        each(filled[row], [&](int s) {
            bool any = false;
            for (int c = 0; c < SEGMENT; ++c) any |= is_surface(smooth[g.at(row, s) + c * CHANNELS + 3], of_plane);
            surface[row] |= std::uint64_t(any) << s;
        });
}

// The differences between the means of both blurs, in place of those of the second; and the excess of surface. Of a plane.
WIDE void respond(const Grid &g, int x, Field &smooth, const Flags &surface, float of_plane, Field &field) {
    for (std::size_t row = g.row(x, 0); row < g.row(x + 1, 0); ++row)
        each(surface[row], [&](int s) {
            for (std::size_t cell = g.at(row, s); cell < g.at(row, s + 1); cell += CHANNELS) {
                const float mass = smooth[cell + 3], around = field[cell + 3];
                cell_of(field, cell) = is_surface(mass, of_plane) ? cell_of(smooth, cell) / std::max(mass, 1e-9f) -
                                                                        cell_of(field, cell) / std::max(around, 1e-9f)
                                                                  : Cell{};
                field[cell + 3] = mass * of_plane - 1;
            }
        });
}

// See gsmap/describe/landmarks/detect.py.
std::vector<Extremum> extrema(const Cloud &cloud, const Block &block, Work &work, const double *thresholds, double sigma,
                              double surround) {
    const int *shape = block.shape;
    const Grid g(shape[0], shape[1], shape[2]);
    Field &field = work.field, &smooth = work.smooth;
    Flags filled(g.rows(), 0), surface(g.rows(), 0);
    parallel_for(block.slabs(), [&](int64_t slab) { splat(g, cloud, block, int(slab), field, filled); });
    const Blur near(g, sigma, filled, nullptr);
    near(g, field, filled, smooth);
    const float of_plane = float(std::sqrt(2 * 3.14159265358979323846) * sigma);
    parallel_for(g.nx, [&](int64_t x) {
        empty(g, int(x), field, filled);
        flag_surface(g, int(x), smooth, near.after_z, of_plane, surface);
    });
    const Blur far(g, sigma * std::sqrt(surround * surround - 1), near.after_z, &surface);
    far(g, smooth, near.after_z, field);
    Field &response = field;  // takes the place of what is around
    parallel_for(g.nx, [&](int64_t x) { respond(g, int(x), smooth, surface, of_plane, response); });
    Cell about;  // no more than the thresholds: most cells are far below
    for (int c = 0; c < CHANNELS; ++c) about[c] = std::nextafter(float(thresholds[c]), 0.f);
    const auto is_far_below = [&](const Cell &cell) {
        const auto high = (cell >= about) | (-cell >= about);  // of all channels at once
        std::int64_t any[2];
        std::memcpy(any, &high, sizeof any);
        return !(any[0] | any[1]);
    };
    std::vector<std::vector<Extremum>> found(g.nx);
    parallel_for(g.nx, [&](int64_t plane) {
        const int x = int(plane);
        for (int y = 0; y < g.ny; ++y)
            each(surface[g.row(x, y)], [&](int s) {
                for (int z = s * SEGMENT; z < std::min((s + 1) * SEGMENT, shape[2]); ++z) {
                    if (is_far_below(cell_of(response, g.cell(x, y, z)))) continue;
                    for (int c = 0; c < CHANNELS; ++c) {
                        const float value = response[g.cell(x, y, z) + c];
                        if (value > thresholds[c])
                            maximum(g, response, shape, x, y, z, c, 1.f, thresholds[c], found[x]);
                        else if (c < 3 && -value > thresholds[c])
                            maximum(g, response, shape, x, y, z, c, -1.f, thresholds[c], found[x]);
                    }
                }
            });
    });
    parallel_for(g.nx, [&](int64_t x) { empty(g, int(x), response, surface); });
    for (int x = 1; x < g.nx; ++x) found[0].insert(found[0].end(), found[x].begin(), found[x].end());
    return std::move(found[0]);
}

}  // namespace

void bind_landmarks(nb::module_ &m) {
    nb::class_<Work>(m, "LandmarkWorkspace", "Memory that calls of `landmark_extrema` use, one after the other.")
        .def(nb::init<>());
    m.def(
        "landmark_extrema",
        [](Work &work, Points points, Colours lab, Numbers areas, Numbers thresholds, double size, double square, double edge,
           double halo, double sigma, double surround) {
            const std::size_t n = points.shape(0);
            if (lab.shape(0) != n || areas.shape(0) != n || thresholds.shape(0) != 4)
                throw std::invalid_argument("extrema need as many colours and areas as points, and 4 thresholds");
            if (!(size > 0 && square > 0)) throw std::invalid_argument("cells have a size");
            // Of a block's cells the first and the last hold parts of a cell, and there is room beside them.
            if (!(edge > 0 && halo >= 0 && edge + 2 * halo <= MOST - 8))
                throw std::invalid_argument("a block has at most 248 cells a side, those around included");
            for (std::size_t i = 0; i < 3 * n; ++i)
                if (!std::isfinite(points.data()[i])) throw std::invalid_argument("points must be finite");
            std::vector<double> rows;
            {
                nb::gil_scoped_release release;
                const Cloud cloud{points.data(), lab.data(), areas.data(), size, square};
                const std::vector<Run> runs = runs_of(points, size, edge);
                work.reserve(largest(runs, edge + 2 * halo));
                work.whole = false;
                for (std::size_t r = 0; r < runs.size(); ++r) {
                    if (r && runs[r].block == runs[r - 1].block) continue;
                    double core[3];
                    for (int k = 0; k < 3; ++k) core[k] = runs[r].block[k] * edge;
                    const auto near = runs_near(runs, runs[r].block, edge, halo);
                    const Block block(cloud, near, core, edge, halo);
                    if (block.is_empty()) continue;
                    for (Extremum &e : extrema(cloud, block, work, thresholds.data(), sigma, surround)) {
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
                work.whole = true;
            }
            const std::size_t count = rows.size() / 6;
            return numpy_of(std::move(rows), {count, 6});
        },
        nb::arg("work"), nb::arg("points"), nb::arg("lab"), nb::arg("areas"), nb::arg("thresholds"), nb::arg("size"),
        nb::arg("square"), nb::arg("edge"), nb::arg("halo"), nb::arg("sigma"), nb::arg("surround"),
        "Rows (channel, negative, x, y, z, response over threshold) of the extrema within blocks of cells, each looked at "
        "with its halo: all in cells. Points and areas are in a unit of which a cell has a side of `size` and an area of\n"
        "`square`. Points that come in an order in space are faster.");
}

}  // namespace gsmap
