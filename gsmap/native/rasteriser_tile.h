// One tile: its Gaussians in rounds that fit L1, culled exactly against 8x8 blocks; the pixels of a block in registers.
#pragma once
#include "rasteriser.h"
#include "simd.h"

namespace GSMAP_ISA {
using namespace gsmap;

constexpr int kAcross = kTile / kBlockX, kDown = kTile / kBlockY;
constexpr int kBlocks = kAcross * kDown, kPixels = kBlockX * kBlockY;
constexpr int kColumns = W < kBlockX ? kBlockX / W : 1;  // vectors side by side in a block's row
constexpr int kRows = W > kBlockX ? W / kBlockX : 1;     // rows of a block in one vector
constexpr int kVectors = kPixels / W;

constexpr float kMinLog2Alpha = -7.99435343685886f;  // alpha = 1/255

// Offsets of a vector's pixel centres from its block's first corner.
struct Lanes {
    V x[kColumns], y;
    Lanes() {
        for (int l = 0; l < W; l++) y[l] = 0.5f + float(l / kBlockX);
        for (int c = 0; c < kColumns; c++)
            for (int l = 0; l < W; l++) x[c][l] = 0.5f + float(c * W + l % kBlockX);
    }
    // The same for block b, from the tile's first corner, beginning with a row of vectors.
    INLINE Lanes in_tile(int b, int row) const {
        Lanes moved = *this;
        for (int c = 0; c < kColumns; c++) moved.x[c] += float(b % kAcross * kBlockX);
        moved.y += float(b / kAcross * kBlockY + row * kRows);
        return moved;
    }
};

// N Gaussians of a tile, listed for each of the kStrips parts of a block, which are rows of its vectors.
template <int N, int kStrips> struct RoundOf {
    static_assert(N <= 256, "lists hold bytes");
    int count;
    int listed[kBlocks * kStrips];  // how many of the round may touch each strip
    alignas(64) float field[kFields][N + 16];  // padded against 4 KiB aliasing
    uint8_t list[kBlocks * kStrips][N + W];

    // Brings in `n` records, positions relative to the tile; fetches what comes after them into the cache.
    void gather(const TileWork &work, int64_t first, int n) {
        count = n;
        const uint32_t *index = work.list + first;
        const float left = float(work.tx * kTile), top = float(work.ty * kTile);
        for (int i = 0; i < n; i += W) {
            const float *row[W];
            for (int l = 0; l < W; l++) {
                row[l] = &work.records[index[i + l < n ? i + l : n - 1]].x;
                if (first + i + l + N < work.count) __builtin_prefetch(&work.records[index[i + l + N]]);
            }
            V v[kFields];
            load_rows(row, kFields, v);
            v[X] -= left, v[Y] -= top;
            for (int f = 0; f < kFields; f++) store(&field[f][i], v[f]);
        }
    }

    // For every block with a bit in `alive`, which of the round have alpha >= 1/255 somewhere in its box of pixel
    // centres, and somewhere in the rows of a strip.
    void cull(uint32_t alive) {
        for (int b = 0; b < kBlocks * kStrips; b++) listed[b] = 0;
        for (int i = 0; i < count; i += W) {
            const V x = load(&field[X][i]), y = load(&field[Y][i]);
            const V l11 = load(&field[L11][i]), l12 = load(&field[L12][i]), l22 = load(&field[L22][i]);
            const V reach = load(&field[LOG2_OPACITY][i]) + (1e-3f - kMinLog2Alpha);
            const V per_dy = V{} - l12 / l11, per_dx = V{} - l11 * l12 / fma(l12, l12, l22 * l22);
            // the smallest u^2 + w^2 over a box lies on the side of it that faces the centre, in x or in y
            V x0[kAcross], x1[kAcross], lx[kAcross], best_y[kAcross];
            for (int c = 0; c < kAcross; c++) {
                x0[c] = (c * kBlockX + 0.5f) - x, x1[c] = x0[c] + float(kBlockX - 1);
                const V near = min(max(V{}, x0[c]), x1[c]);
                lx[c] = l11 * near, best_y[c] = per_dx * near;
            }
            const M valid = first_lanes(count - i);
            for (int r = 0; r < kDown; r++) {
                const V y0 = (r * kBlockY + 0.5f) - y, y1 = y0 + float(kBlockY - 1);
                const V near = min(max(V{}, y0), y1);
                const V ly = l12 * near, best_x = per_dy * near, wy = l22 * near, ww = wy * wy;
                M rows[kStrips];
                for (int k = 0; k < kStrips; k++) {
                    const V top = y0 + float(k * kBlockY / kStrips), bottom = top + float(kBlockY / kStrips - 1);
                    const V least = l22 * min(max(V{}, top), bottom);
                    rows[k] = kStrips == 1 ? valid : both(valid, ge(reach, least * least));
                }
                for (int c = 0; c < kAcross; c++) {
                    const int b = r * kAcross + c;
                    if (!(alive >> b & 1)) continue;
                    const V u1 = fma(l11, min(max(best_x, x0[c]), x1[c]), ly);
                    const V dy = min(max(best_y[c], y0), y1), u2 = fma(l12, dy, lx[c]), w2 = l22 * dy;
                    const V least = min(fma(u1, u1, ww), fma(u2, u2, w2 * w2));
                    const M touched = ge(reach, least);
                    for (int k = b * kStrips, row = 0; row < kStrips; k++, row++)
                        listed[k] += list_lanes(both(rows[row], touched), i, &list[k][listed[k]]);
                }
            }
        }
    }
};

using Round = RoundOf<kRound, 1>;

// Visits the pixels of the tile that lie in the image: body(block, pixel in block, index in image).
template <class Body> INLINE void for_pixels(const TileWork &work, Body body) {
    for (int y = 0; y < kTile; y++) {
        const int py = work.ty * kTile + y;
        if (py >= work.height) break;
        for (int x = 0; x < kTile; x++) {
            const int px = work.tx * kTile + x;
            if (px >= work.width) break;
            body(y / kBlockY * kAcross + x / kBlockX, y % kBlockY * kBlockX + x % kBlockX, int64_t(py) * work.width + px);
        }
    }
}

// Whether a window of SSIM around some pixel of [x0, x1) x [y0, y1) holds one that is looked at.
INLINE bool any_looked_at(const float *looked_at, int width, int height, int x0, int y0, int x1, int y1) {
    const auto within = [](int at, int most) { return at < 0 ? 0 : at < most ? at : most; };
    const int left = within(x0 - kSsimReach, width), right = within(x1 + kSsimReach, width);
    for (int y = within(y0 - kSsimReach, height); y < within(y1 + kSsimReach, height); y++)
        for (int x = left; x < right; x++)
            if (looked_at[int64_t(y) * width + x] != 0.f) return true;
    return false;
}

// The blocks that are to be drawn: those in the image, or of them those that are looked at.
INLINE uint32_t blocks_in_image(const TileWork &work, const float *looked_at) {
    uint32_t blocks = 0;
    for (int b = 0; b < kBlocks; b++) {
        const int x = work.tx * kTile + b % kAcross * kBlockX, y = work.ty * kTile + b / kAcross * kBlockY;
        if (x >= work.width || y >= work.height) continue;
        if (!looked_at || any_looked_at(looked_at, work.width, work.height, x, y, x + kBlockX, y + kBlockY))
            blocks |= 1u << b;
    }
    return blocks;
}

// Marks the pixels of a block that lie in the image.
INLINE void start_alive(const TileWork &work, const Lanes &lanes, int b, M *alive) {
    const V width = set1(float(work.width - work.tx * kTile - b % kAcross * kBlockX));
    const V height = set1(float(work.height - work.ty * kTile - b / kAcross * kBlockY));
    for (int k = 0; k < kVectors; k++)
        alive[k] = both(lt(lanes.x[k % kColumns], width), lt(lanes.y + float(k / kColumns * kRows), height));
}

// One Gaussian over the pixels of a block, row of vectors after row of vectors: (u, w) at a pixel and alpha there.
// From one vector to the next only additions are left, which other units do than the multiplications that follow.
struct Splat {
    V across[kColumns], u, w, du, dw, log2_opacity;
    template <class R> INLINE Splat(const R &round, const Lanes &first, int j) {
        const V l11 = set1(round.field[L11][j]), l12 = set1(round.field[L12][j]), l22 = set1(round.field[L22][j]);
        const V x = set1(round.field[X][j]), dy = first.y - set1(round.field[Y][j]);
        for (int c = 0; c < kColumns; c++) across[c] = l11 * (first.x[c] - x);
        u = l12 * dy, w = l22 * dy;
        du = kRows == 2 ? l12 + l12 : l12, dw = kRows == 2 ? l22 + l22 : l22;
        log2_opacity = set1(round.field[LOG2_OPACITY][j]);
    }
    INLINE V u_at(int column) const { return u + across[column]; }
    // log2(alpha) before the clamp; alpha itself may only be taken where this is at least kMinLog2Alpha
    INLINE V exponent(V u) const { return fnma(u, u, fnma(w, w, log2_opacity)); }
    INLINE void next_row() { u += du, w += dw; }
};

}  // namespace GSMAP_ISA
