// Windows that move over a picture, one axis after the other.
#pragma once
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

namespace gsmap {

enum class Edge { kNearest, kReflect };

// Where a row outside lies inside: the last one, or as in a mirror that stands at the edge.
inline int64_t inside(int64_t at, int64_t count, Edge edge) {
    if (edge == Edge::kNearest) return std::clamp<int64_t>(at, 0, count - 1);
    at = ((at % (2 * count)) + 2 * count) % (2 * count);
    return at < count ? at : 2 * count - 1 - at;
}

// Which pixels are asked for, along both axes: the first, and every so many after it.
struct Every {
    int64_t first = 0, step = 1;
    int64_t count(int64_t pixels) const { return pixels > first ? (pixels - first + step - 1) / step : 0; }
};

// Applies `combine(rows, n, count, out)` to windows from `before` rows above to `after` below, and then along rows, of
// an image (height, width, channels); out is another, of the pixels that are asked for.
template <class Combine>
void windowed(const float *image, int64_t height, int64_t width, int64_t channels, int64_t before, int64_t after,
              Edge edge, float *out, Combine combine, Every every = {}) {
    const int64_t stride = width * channels, n = before + after + 1;
    std::vector<float> line(std::size_t((width + n - 1) * channels));
    std::vector<const float *> rows(n);
    std::vector<float> whole(every.step > 1 || every.first ? stride : 0);
    for (int64_t y = every.first; y < height; y += every.step) {
        for (int64_t k = 0; k < n; ++k) rows[k] = image + inside(y + k - before, height, edge) * stride;
        combine(rows.data(), int(n), stride, line.data() + before * channels);
        for (int64_t k = 0; k < n - 1; ++k) {
            const int64_t to = k < before ? k : width + k, from = before + inside(to - before, width, edge);
            std::memcpy(line.data() + to * channels, line.data() + from * channels, channels * sizeof(float));
        }
        for (int64_t k = 0; k < n; ++k) rows[k] = line.data() + k * channels;
        if (whole.empty()) {
            combine(rows.data(), int(n), stride, out);
            out += stride;
            continue;
        }
        combine(rows.data(), int(n), stride, whole.data());
        for (int64_t x = every.first; x < width; x += every.step)
            out = std::copy_n(whole.data() + x * channels, channels, out);
    }
}

}  // namespace gsmap
