// SIFT (Lowe 2004) step by step as VLFeat and COLMAP have it, descriptors as RootSIFT: a quarter of their time, by kernels
// for the processor at hand and by describing nothing that is not kept. tests/localize holds it against pycolmap.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"
#include "filters.h"
#include "rasteriser_view.h"
#include "sift.h"

namespace gsmap {
namespace {

using Grey = nb::ndarray<const uint8_t, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;

constexpr int kLevels = 3, kOctaves = 4;      // levels of an octave that features lie on
constexpr int kBlurred = kLevels + 3;         // ... and those that are made: one below, two above
constexpr int kCells = kSlopeCells, kTurns = kSlopeTurns;
constexpr int kSlack = 64;                    // floats past a row that vectors may read
constexpr float kPi = 3.14159265f;
const float kStep = std::pow(2.f, 1.f / kLevels), kSigma = 1.6f * kStep, kSigmaStep = kSigma * std::sqrt(1 - 1 / (kStep * kStep));

// A picture whose memory is not cleared: much of the time would go into that.
struct Image {
    int width = 0, height = 0;
    std::unique_ptr<float[]> values;
    Image() = default;
    Image(int w, int h) : width(w), height(h), values(new float[std::size_t(w) * h + kSlack]) {}
    float *row(int y) { return values.get() + std::size_t(y) * width; }
    const float *row(int y) const { return values.get() + std::size_t(y) * width; }
};

Image blurred(const Image &image, float sigma) {
    const int reach = std::max(1, int(std::ceil(4.f * sigma)));
    std::vector<float> weights(2 * reach + 1);
    float total = 0;
    for (int k = -reach; k <= reach; ++k) total += weights[k + reach] = std::exp(-0.5f * (k / sigma) * (k / sigma));
    for (float &weight : weights) weight /= total;
    Image out(image.width, image.height);
    windowed(image.row(0), image.height, image.width, 1, reach, reach, Edge::kNearest, out.row(0),
             [&](const float *const *rows, int n, int64_t count, float *to) {
                 kernels->weigh(rows, weights.data(), n, count, to);
             });
    return out;
}

// Every other pixel, or as many between them.
Image halved(const Image &image) {
    Image out(image.width / 2, image.height / 2);
    for (int y = 0; y < out.height; ++y)
        for (int x = 0; x < out.width; ++x) out.row(y)[x] = image.row(2 * y)[2 * x];
    return out;
}

Image doubled(const Image &image) {
    Image out(2 * image.width, 2 * image.height);
    for (int y = 0; y < image.height; ++y) {
        float *row = out.row(2 * y);
        for (int x = 0; x < image.width; ++x) {
            const float here = image.row(y)[x];
            row[2 * x] = here, row[2 * x + 1] = (here + image.row(y)[std::min(x + 1, image.width - 1)]) / 2;
        }
    }
    for (int y = 0; y < image.height; ++y) {
        const float *above = out.row(2 * y), *below = out.row(std::min(2 * y + 2, out.height - 2));
        for (int x = 0; x < out.width; ++x) out.row(2 * y + 1)[x] = (above[x] + below[x]) / 2;
    }
    return out;
}

struct Keypoint {
    float x, y, sigma;  // of the octave's pixels
};

// One level of one octave: its picture, blurred, and what lies on it.
struct Level {
    float pixel = 1;  // of the octave, in those of the picture
    Image image;
    std::vector<Keypoint> keypoints;
};

// Moves an extremum of differences to where a parabola is highest; false where it has little contrast or is an edge.
bool refined(const Image *blur, int x, int y, int level, double peak, double edge, Keypoint &out) {
    const int width = blur->width, height = blur->height;
    double A[3][3], b[3], D[3], value, xx, yy, xy;
    for (int round = 0, dx = 0, dy = 0; round < 5; ++round) {
        x += dx, y += dy;
        const auto at = [&](int i, int j, int k) {
            return double(blur[level + k + 1].row(y + j)[x + i] - blur[level + k].row(y + j)[x + i]);
        };
        value = at(0, 0, 0);
        D[0] = (at(1, 0, 0) - at(-1, 0, 0)) / 2;
        D[1] = (at(0, 1, 0) - at(0, -1, 0)) / 2;
        D[2] = (at(0, 0, 1) - at(0, 0, -1)) / 2;
        xx = at(1, 0, 0) + at(-1, 0, 0) - 2 * value;
        yy = at(0, 1, 0) + at(0, -1, 0) - 2 * value;
        xy = (at(1, 1, 0) + at(-1, -1, 0) - at(-1, 1, 0) - at(1, -1, 0)) / 4;
        A[0][0] = xx, A[1][1] = yy, A[2][2] = at(0, 0, 1) + at(0, 0, -1) - 2 * value;
        A[0][1] = A[1][0] = xy;
        A[0][2] = A[2][0] = (at(1, 0, 1) + at(-1, 0, -1) - at(-1, 0, 1) - at(1, 0, -1)) / 4;
        A[1][2] = A[2][1] = (at(0, 1, 1) + at(0, -1, -1) - at(0, -1, 1) - at(0, 1, -1)) / 4;
        for (int k = 0; k < 3; ++k) b[k] = -D[k];
        for (int j = 0; j < 3; ++j) {  // Gauss's elimination, largest first
            int best = j;
            for (int i = j + 1; i < 3; ++i)
                if (std::abs(A[i][j]) > std::abs(A[best][j])) best = i;
            if (std::abs(A[best][j]) < 1e-10) {
                b[0] = b[1] = b[2] = 0;
                break;
            }
            std::swap(A[best], A[j]), std::swap(b[best], b[j]);
            const double by = 1 / A[j][j];
            for (int k = j; k < 3; ++k) A[j][k] *= by;
            b[j] *= by;
            for (int i = j + 1; i < 3; ++i) {
                const double share = A[i][j];
                for (int k = j; k < 3; ++k) A[i][k] -= share * A[j][k];
                b[i] -= share * b[j];
            }
        }
        for (int i = 2; i > 0; --i)
            for (int k = i - 1; k >= 0; --k) b[k] -= b[i] * A[k][i];
        dx = (b[0] > 0.6 && x < width - 2) - (b[0] < -0.6 && x > 1);
        dy = (b[1] > 0.6 && y < height - 2) - (b[1] < -0.6 && y > 1);
        if (!dx && !dy) break;
    }
    const double high = value + (D[0] * b[0] + D[1] * b[1] + D[2] * b[2]) / 2;
    const double bend = (xx + yy) * (xx + yy) / (xx * yy - xy * xy), at = level - 1 + b[2];
    out = {float(x + b[0]), float(y + b[1]), kSigma * std::pow(2.f, float(at) / kLevels)};
    return std::abs(high) > peak && bend >= 0 && bend < (edge + 1) * (edge + 1) / edge && std::abs(b[0]) < 1.5 &&
           std::abs(b[1]) < 1.5 && std::abs(b[2]) < 1.5 && out.x >= 0 && out.x <= width - 1 && out.y >= 0 &&
           out.y <= height - 1 && at >= -1 && at <= kLevels + 1;
}

// The levels of every octave on which anything lies, small things first.
std::vector<Level> detected(Image base, bool twice, double peak, double edge) {
    std::vector<Level> out;
    if (twice) base = doubled(base);
    float pixel = twice ? 0.5f : 1.f, known = 0.5f / pixel;  // a picture is as blurred as half of its pixels
    const float first = kSigma / kStep;
    for (int octave = 0; octave < kOctaves; ++octave, pixel *= 2) {
        std::array<Image, kBlurred> blur;
        if (std::min(base.width, base.height) < 4) break;
        blur[0] = !octave && first > known ? blurred(base, std::sqrt(first * first - known * known)) : std::move(base);
        for (int s = 1; s < kBlurred; ++s) blur[s] = blurred(blur[s - 1], kSigmaStep * std::pow(kStep, s - 1.f));
        const int width = blur[0].width, height = blur[0].height;
        Level levels[kLevels];
        const std::size_t stride = width + kSlack;
        std::vector<float> differences(3 * (kBlurred - 1) * stride);  // of three rows of each level and the next
        const auto row_of = [&](int s, int y) { return differences.data() + (3 * s + y % 3) * stride; };
        std::vector<int32_t> found(width);
        for (int y = 0; y < height; ++y) {
            for (int s = 0; s + 1 < kBlurred; ++s) {
                const float *finer = blur[s].row(y), *coarser = blur[s + 1].row(y);
                float *to = row_of(s, y);
                for (int x = 0; x < width; ++x) to[x] = coarser[x] - finer[x];
            }
            if (y < 2) continue;
            for (int s = 1; s <= kLevels; ++s) {
                const float *rows[9];
                for (int k = 0; k < 9; ++k) rows[k] = row_of(s + k / 3 - 1, y + k % 3 - 2);
                const int count = kernels->peaks(rows, float(0.8 * peak), 1, width - 1, found.data());
                Keypoint one;
                for (int k = 0; k < count; ++k)
                    if (refined(blur.data(), found[k], y - 1, s, peak, edge, one))
                        levels[s - 1].keypoints.push_back(one);
            }
        }
        base = halved(blur[kLevels]);
        for (int s = 1; s <= kLevels; ++s) {
            if (levels[s - 1].keypoints.empty()) continue;
            levels[s - 1].pixel = pixel, levels[s - 1].image = std::move(blur[s]);
            out.push_back(std::move(levels[s - 1]));
        }
    }
    return out;
}

// exp(-x) between the entries of a table.
struct Fading {
    static constexpr int kSize = 256;
    static constexpr float kMost = 25;
    float table[kSize + 2];
    Fading() {
        for (int k = 0; k < kSize + 2; ++k) table[k] = std::exp(-k * kMost / kSize);
    }
    float operator()(float x) const {
        if (x > kMost) return 0;
        x *= kSize / kMost;
        const int k = int(x);
        return table[k] + (x - k) * (table[k + 1] - table[k]);
    }
};
const Fading fading;

// The slopes of a level's picture, and then of another's of the same size or smaller.
struct Slopes {
    Image length, angle;
    void of(const Image &image) {
        const int width = image.width, height = image.height;
        if (length.width < width) length = Image(width, height), angle = Image(width, height);
        length.width = angle.width = width, length.height = angle.height = height;
        std::vector<float> dx(width), dy(width);
        for (int y = 0; y < height; ++y) {
            const float *row = image.row(y), *above = image.row(std::max(y - 1, 0)), *below = image.row(std::min(y + 1, height - 1));
            const float half = y && y + 1 < height ? 0.5f : 1.f;
            for (int x = 0; x < width; ++x) dy[x] = half * (below[x] - above[x]);
            for (int x = 1; x + 1 < width; ++x) dx[x] = 0.5f * (row[x + 1] - row[x - 1]);
            dx[0] = row[1] - row[0], dx[width - 1] = row[width - 1] - row[width - 2];
            kernels->polar(dx.data(), dy.data(), width, length.row(y), angle.row(y));
        }
    }
};

// Up to two directions in which most of the picture rises around a keypoint.
int directions(const Slopes &slopes, const Keypoint &at, float *out) {
    constexpr int kBins = 36;
    const int width = slopes.length.width, height = slopes.length.height;
    const float sigma = 1.5f * at.sigma;
    const int reach = std::max(int(3 * sigma), 1), xi = int(at.x + 0.5f), yi = int(at.y + 0.5f);
    if (xi < 0 || xi > width - 1 || yi < 0 || yi > height - 1) return 0;
    double bins[kBins] = {};
    for (int y = std::max(-reach, -yi); y <= std::min(reach, height - 1 - yi); ++y)
        for (int x = std::max(-reach, -xi); x <= std::min(reach, width - 1 - xi); ++x) {
            const float dx = xi + x - at.x, dy = yi + y - at.y, far = dx * dx + dy * dy;
            if (far >= reach * reach + 0.6f) continue;
            const float turn = kBins * slopes.angle.row(yi + y)[xi + x] / (2 * kPi);
            const float weight = slopes.length.row(yi + y)[xi + x] * fading(far / (2 * sigma * sigma));
            const int bin = int(std::floor(turn - 0.5f));
            const float share = turn - bin - 0.5f;
            bins[(bin + kBins) % kBins] += (1 - share) * weight;
            bins[(bin + 1) % kBins] += share * weight;
        }
    for (int round = 0; round < 6; ++round) {
        double before = bins[kBins - 1];
        const double first = bins[0];
        for (int k = 0; k < kBins; ++k) {
            const double mean = (before + bins[k] + (k + 1 < kBins ? bins[k + 1] : first)) / 3;
            before = bins[k], bins[k] = mean;
        }
    }
    const double bar = 0.8 * *std::max_element(bins, bins + kBins);
    int count = 0;
    for (int k = 0; k < kBins && count < 2; ++k) {
        const double here = bins[k], before = bins[(k + kBins - 1) % kBins], after = bins[(k + 1) % kBins];
        if (!(here > bar && here > before && here > after)) continue;
        const double between = -0.5 * (after - before) / (after + before - 2 * here);
        out[count++] = float(2 * kPi * (k + between + 0.5) / kBins);
    }
    return count;
}

// Histograms of slopes over a grid that is turned with the keypoint, 128 shares in [0, 1] whose squares sum to 1.
void described(const Slopes &slopes, const Keypoint &at, float turned, float *out) {
    const int width = slopes.length.width, height = slopes.length.height;
    const float cell = 3 * at.sigma, cosine = std::cos(turned) / cell, sine = std::sin(turned) / cell;
    const int reach = int(std::sqrt(2.f) * cell * (kCells + 1) / 2 + 0.5f), xi = int(at.x + 0.5f), yi = int(at.y + 0.5f);
    constexpr float kHalf = kCells / 2.f + 0.5f;  // what lies farther from the middle is in no cell
    float bins[kCells + 2][kCells + 2][kTurns + 1] = {};
    const SlopeGrid grid{at.x, cosine, sine, turned, fading.table, Fading::kSize / Fading::kMost, Fading::kSize};
    for (int y = std::max(-reach, 1 - yi); y <= std::min(reach, height - yi - 2); ++y) {
        const float dy = yi + y - at.y;
        float low = float(std::max(-reach, 1 - xi)), high = float(std::min(reach, width - xi - 2));
        // Between these columns cosine * dx + sine * dy and cosine * dy - sine * dx lie within the grid.
        for (const auto &[slope, offset] : {std::pair(cosine, sine * dy), std::pair(-sine, cosine * dy)}) {
            if (std::abs(slope) < 1e-6f) {
                if (std::abs(offset) >= kHalf) high = low - 1;
                continue;
            }
            const float one = (-kHalf - offset) / slope, other = (kHalf - offset) / slope, shift = at.x - xi;
            low = std::max(low, std::ceil(std::min(one, other) + shift));
            high = std::min(high, std::floor(std::max(one, other) + shift));
        }
        if (low > high) continue;
        const int from = xi + int(low);
        kernels->add_slopes(grid, slopes.length.row(yi + y) + from, slopes.angle.row(yi + y) + from, from,
                            int(high) - int(low) + 1, sine * dy, cosine * dy, bins[0][0]);
    }
    constexpr int kAll = kCells * kCells * kTurns;
    float squares = 0, shares = 0;
    for (int i = 0; i < kCells; ++i)
        for (int j = 0; j < kCells; ++j) {
            float *bin = bins[i + 1][j + 1], *to = out + kTurns * (j + kCells * i);
            bin[0] += bin[kTurns];
            for (int k = 0; k < kTurns; ++k) to[(kTurns - k) % kTurns] = bin[k], squares += bin[k] * bin[k];
        }
    const float norm = std::sqrt(squares) + 1.19209290e-07f;
    for (int k = 0; k < kAll; ++k) shares += out[k] = std::min(out[k] / norm, 0.2f);  // light that glares counts no more
    for (int k = 0; k < kAll; ++k)
        out[k] = std::min(std::round(512 * std::sqrt(out[k] / std::max(shares, 1e-30f))), 255.f) / 512;
}

void sift(const Grey &grey, int most, double peak, double edge, bool twice, std::vector<float> &keypoints,
          std::vector<float> &descriptors) {
    Image base(int(grey.shape(1)), int(grey.shape(0)));
    for (std::size_t k = 0; k < grey.size(); ++k) base.values[k] = float(grey.data()[k]) / 255.f;
    const std::vector<Level> levels = detected(std::move(base), twice, peak, edge);
    std::size_t first = levels.size(), count = 0;
    while (first && count <= std::size_t(most)) count += levels[--first].keypoints.size();
    Slopes slopes;
    for (; first < levels.size(); ++first) {
        const Level &level = levels[first];
        slopes.of(level.image);
        for (const Keypoint &one : level.keypoints) {
            float turned[2];
            const int turns = directions(slopes, one, turned);
            for (int k = 0; k < turns; ++k) {
                const float angle = turned[k] > kPi ? turned[k] - 2 * kPi : turned[k];
                keypoints.insert(keypoints.end(), {one.x * level.pixel + 0.5f, one.y * level.pixel + 0.5f,
                                                   one.sigma * level.pixel, angle});
                descriptors.resize(descriptors.size() + kCells * kCells * kTurns);
                described(slopes, one, turned[k], &*descriptors.end() - kCells * kCells * kTurns);
            }
        }
    }
}

}  // namespace

void bind_sift(nb::module_ &m) {
    m.def(
        "sift",
        [](Grey grey, int most, double peak, double edge, bool twice) {
            if (grey.shape(0) < 4 || grey.shape(1) < 4) throw std::invalid_argument("the picture is too small");
            std::vector<float> keypoints, descriptors;
            {
                nb::gil_scoped_release release;
                sift(grey, most, peak, edge, twice, keypoints, descriptors);
            }
            const std::size_t n = keypoints.size() / 4;
            return std::make_tuple(numpy_of(std::move(keypoints), {n, 4}), numpy_of(std::move(descriptors), {n, 128}));
        },
        nb::arg("grey"), nb::arg("most"), nb::arg("peak"), nb::arg("edge"), nb::arg("twice"),
        "Features (N, 4) x, y, sigma, angle, small ones first, and descriptors (N, 128) of a grey picture (H, W).");
}

}  // namespace gsmap
