// Histograms of slopes for descriptors of local features.
#pragma once
#include "rasteriser.h"
#include "simd.h"

namespace GSMAP_ISA {

typedef float Two __attribute__((vector_size(8), aligned(4), may_alias));

template <int... J> INLINE void store_pairs(V a, V b, float *out, std::integer_sequence<int, J...>) {
    storeu(out, __builtin_shufflevector(a, b, (J % 2 * W + J / 2)...));
    storeu(out + W, __builtin_shufflevector(a, b, (J % 2 * W + W / 2 + J / 2)...));
}

INLINE void add_two(float *to, const float *from) { *(Two *)to += *(const Two *)from; }

// Adds `count` slopes of a row of pixels, the first in column `from`, to the bins of a grid; `across` and `down` are what
// the row's distance from the middle adds along the grid's axes. Slopes are read for a vector past the last.
void add_slopes(const gsmap::SlopeGrid &grid, const float *length, const float *angle, int from, int count,
                float across, float down, float *bins) {
    using namespace gsmap;
    const V half = set1(kSlopeCells / 2.f + 0.5f);  // what lies farther from the middle is in no cell
    constexpr int kColumn = kSlopeTurns + 1, kRow = (kSlopeCells + 2) * kColumn;
    constexpr float kTurn = 2 * 3.14159265f;
    for (int i = 0; i < count; i += W) {
        const V dx = iota() + float(from + i) - grid.x;
        const V nx = grid.cosine * dx + across, ny = down - grid.sine * dx;
        const V px = nx + half, py = ny + half;
        // Sums are compared, not offsets, because a sum may round up to the end.
        const M inside = both(both(lt(V{}, px), lt(px, half + half)), both(lt(V{}, py), lt(py, half + half)));
        const M live = both(first_lanes(count - i), inside);
        const V turned = loadu(angle + i) - grid.turned;
        const V turn = select(lt(turned, V{}), turned + kTurn, turned) * (kSlopeTurns / kTurn);
        const V far = (nx * nx + ny * ny) / 8.f * grid.fading_per_unit;
        const I entry = __builtin_convertvector(min(far, set1(float(grid.fading_entries - 1))), I);
        V here, next;
        for (int l = 0; l < W; l++) here[l] = grid.fading[entry[l]], next[l] = grid.fading[entry[l] + 1];
        const V weight = loadu(length + i) * (here + (far - __builtin_convertvector(entry, V)) * (next - here));
        const I column = __builtin_convertvector(px, I), row = __builtin_convertvector(py, I);
        const I sector = __builtin_convertvector(min(turn, set1(kSlopeTurns - 1.f)), I);
        const V rx = px - __builtin_convertvector(column, V), ry = py - __builtin_convertvector(row, V);
        const V rt = turn - __builtin_convertvector(sector, V);
        const V up = weight * (1.f - ry), low = weight * ry;
        const V parts[4] = {up * (1.f - rx), up * rx, low * (1.f - rx), low * rx};
        alignas(64) float pairs[4][2 * W];
        for (int k = 0; k < 4; k++)
            store_pairs(parts[k] * (1.f - rt), parts[k] * rt, pairs[k], std::make_integer_sequence<int, W>{});
        alignas(64) int32_t bin[W];
        *(I *)bin = row * kRow + column * kColumn + sector;
        for (uint32_t m = bits(live); m; m &= m - 1) {  // in order, so that sums do not depend on the vectors' width
            const int l = __builtin_ctz(m);
            float *to = bins + bin[l];
            add_two(to, &pairs[0][2 * l]), add_two(to + kColumn, &pairs[1][2 * l]);
            add_two(to + kRow, &pairs[2][2 * l]), add_two(to + kRow + kColumn, &pairs[3][2 * l]);
        }
    }
}

}  // namespace GSMAP_ISA
