// One tile: its Gaussians in rounds that fit L1, culled exactly against 8x8 blocks; the pixels of a block in registers.
#pragma once
#include "rasteriser.h"
#include "simd.h"

namespace GSMAP_ISA {
using namespace gsmap;

constexpr int kBlocks = (kTile / kBlock) * (kTile / kBlock), kPixels = kBlock * kBlock;
constexpr int kAcross = kTile / kBlock;
constexpr int kColumns = W < kBlock ? kBlock / W : 1;   // vectors side by side in a block's row
constexpr int kRows = W > kBlock ? W / kBlock : 1;      // rows of a block in one vector
constexpr int kVectors = kPixels / W;

// Offsets of a vector's pixel centres from its block's first corner.
struct Lanes {
    V x[kColumns], y;
    Lanes() {
        for (int l = 0; l < W; l++) y[l] = 0.5f + float(l / kBlock);
        for (int c = 0; c < kColumns; c++)
            for (int l = 0; l < W; l++) x[c][l] = 0.5f + float(c * W + l % kBlock);
    }
};

struct Round {
    int count;
    int listed[kBlocks];  // how many of the round may touch each block
    alignas(64) float field[kFields][kRound + 16];  // padded against 4 KiB aliasing
    uint16_t list[kBlocks][kRound];

    // Brings in `n` records, positions relative to the tile; fetches what comes after them into the cache.
    void gather(const TileWork &work, int64_t first, int n) {
        count = n;
        const uint32_t *index = work.list + first;
        const float left = float(work.tx * kTile), top = float(work.ty * kTile);
        for (int i = 0; i < n; i += W) {
            const float *row[W];
            for (int l = 0; l < W; l++) {
                row[l] = &work.records[index[i + l < n ? i + l : n - 1]].x;
                if (first + i + l + kRound < work.count)
                    __builtin_prefetch(&work.records[index[i + l + kRound]]);
            }
            V v[kFields];
            load_rows(row, kFields, v);
            v[X] -= left, v[Y] -= top;
            for (int f = 0; f < kFields; f++) store(&field[f][i], v[f]);
        }
    }

    // For every block with a bit in `alive`, which of the round have alpha >= 1/255 somewhere in its box of pixel centres.
    void cull(uint32_t alive) {
        for (int b = 0; b < kBlocks; b++) listed[b] = 0;
        for (int i = 0; i < count; i += W) {
            const V x = load(&field[X][i]), y = load(&field[Y][i]);
            const V l11 = load(&field[L11][i]), l12 = load(&field[L12][i]), l22 = load(&field[L22][i]);
            const V reach = load(&field[LOG2_OPACITY][i]) + (7.99435343685886f + 1e-3f);
            const V per_dy = V{} - l12 / l11, per_dx = V{} - l11 * l12 / fma(l12, l12, l22 * l22);
            // the smallest u^2 + w^2 over a box lies on the side of it that faces the centre, in x or in y
            V x0[kAcross], x1[kAcross], lx[kAcross], best_y[kAcross];
            for (int c = 0; c < kAcross; c++) {
                x0[c] = (c * kBlock + 0.5f) - x, x1[c] = x0[c] + (kBlock - 1);
                const V near = min(max(V{}, x0[c]), x1[c]);
                lx[c] = l11 * near, best_y[c] = per_dx * near;
            }
            const M valid = first_lanes(count - i);
            for (int r = 0; r < kAcross; r++) {
                const V y0 = (r * kBlock + 0.5f) - y, y1 = y0 + (kBlock - 1);
                const V near = min(max(V{}, y0), y1);
                const V ly = l12 * near, best_x = per_dy * near, wy = l22 * near, ww = wy * wy;
                for (int c = 0; c < kAcross; c++) {
                    const int b = r * kAcross + c;
                    if (!(alive >> b & 1)) continue;
                    const V u1 = fma(l11, min(max(best_x, x0[c]), x1[c]), ly);
                    const V dy = min(max(best_y[c], y0), y1), u2 = fma(l12, dy, lx[c]), w2 = l22 * dy;
                    const V least = min(fma(u1, u1, ww), fma(u2, u2, w2 * w2));
                    for (uint32_t m = bits(both(valid, ge(reach, least))); m; m &= m - 1)
                        list[b][listed[b]++] = uint16_t(i + __builtin_ctz(m));
                }
            }
        }
    }
};

// Pixels of a tile, block by block.
typedef float TilePixels[kBlocks][kPixels];

// Visits the pixels of the tile that lie in the image: body(block, pixel in block, index in image).
template <class Body> INLINE void for_pixels(const TileWork &work, Body body) {
    for (int y = 0; y < kTile; y++) {
        const int py = work.ty * kTile + y;
        if (py >= work.height) break;
        for (int x = 0; x < kTile; x++) {
            const int px = work.tx * kTile + x;
            if (px >= work.width) break;
            body(y / kBlock * kAcross + x / kBlock, y % kBlock * kBlock + x % kBlock, int64_t(py) * work.width + px);
        }
    }
}

INLINE uint32_t blocks_in_image(const TileWork &work) {
    uint32_t blocks = 0;
    for (int b = 0; b < kBlocks; b++)
        if (work.tx * kTile + b % kAcross * kBlock < work.width && work.ty * kTile + b / kAcross * kBlock < work.height)
            blocks |= 1u << b;
    return blocks;
}

// Marks the pixels of the tile that lie in the image.
INLINE void start_alive(const TileWork &work, const Lanes &lanes, M alive[kBlocks][kVectors]) {
    for (int b = 0; b < kBlocks; b++) {
        const V width = set1(float(work.width - work.tx * kTile - b % kAcross * kBlock));
        const V height = set1(float(work.height - work.ty * kTile - b / kAcross * kBlock));
        for (int k = 0; k < kVectors; k++)
            alive[b][k] = both(lt(lanes.x[k % kColumns], width), lt(lanes.y + float(k / kColumns * kRows), height));
    }
}

// The exponent of Gaussian j at the pixels of one vector, and the opacity there.
struct Splat {
    V l11, l12, l22, log2_opacity, x, y;
    INLINE Splat(const Round &round, int j, float left, float top) {
        l11 = set1(round.field[L11][j]), l12 = set1(round.field[L12][j]), l22 = set1(round.field[L22][j]);
        log2_opacity = set1(round.field[LOG2_OPACITY][j]);
        x = set1(round.field[X][j] - left), y = set1(round.field[Y][j] - top);
    }
    INLINE V alpha(V px, V py, V &u, V &w) const {
        const V dy = py - y;
        u = fma(l11, px - x, l12 * dy), w = l22 * dy;
        return exp2(fnma(u, u, fnma(w, w, log2_opacity)));
    }
};

}  // namespace GSMAP_ISA
