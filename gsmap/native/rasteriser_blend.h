// Blending of one tile, front to back.
#pragma once
#include "rasteriser_tile.h"

namespace GSMAP_ISA {

struct BlendScratch {
    Round round;
    alignas(64) TilePixels t, r, g, b, depth, best;
    alignas(64) int32_t id[kBlocks][kPixels];
    M alive[kBlocks][kVectors];
};
static thread_local BlendScratch blend_scratch;

template <bool kDepth, bool kId, bool kWeight>
INLINE void blend_group(BlendScratch &s, const Lanes &lanes, int b, int column, int row, const TileWork &work,
                        const uint32_t *ids, float *max_weight) {
    constexpr int kGroup = W == 16 ? 4 : 2;  // vectors whose state fits the registers
    const Round &round = s.round;
    const float left = float(b % kAcross * kBlock), top = float(b / kAcross * kBlock);
    V t[kGroup], r[kGroup], g[kGroup], bl[kGroup], d[kGroup], best[kGroup], py[kGroup];
    I id[kGroup];
    M alive[kGroup];
    int at[kGroup];
    const V px = lanes.x[column];
    for (int v = 0; v < kGroup; v++) {
        const int k = (row + v) * kColumns + column;
        at[v] = k;
        t[v] = load(&s.t[b][k * W]), r[v] = load(&s.r[b][k * W]), g[v] = load(&s.g[b][k * W]);
        bl[v] = load(&s.b[b][k * W]), alive[v] = s.alive[b][k];
        if (kDepth) d[v] = load(&s.depth[b][k * W]);
        if (kId) best[v] = load(&s.best[b][k * W]), id[v] = *(const I *)&s.id[b][k * W];
        py[v] = lanes.y + float((row + v) * kRows);
    }
    for (int i = 0; i < round.listed[b]; i++) {
        const int j = round.list[b][i];
        const Splat splat(round, j, left, top);
        const V cr = set1(round.field[R][j]), cg = set1(round.field[G][j]), cb = set1(round.field[B][j]);
        const V depth = kDepth ? set1(round.field[DEPTH][j]) : V{};
        V most{};
        for (int v = 0; v < kGroup; v++) {
            V u, w;
            const V alpha = min(splat.alpha(px, py[v], u, w), set1(kMaxAlpha));
            const V weight = alpha * t[v], rest = t[v] - weight;
            const M touched = ge(alive[v], alpha, set1(kMinAlpha));
            const M drawn = gt(touched, rest, set1(kMinTransmittance));
            alive[v] = (M)(alive[v] ^ touched ^ drawn);  // whoever would fall to 1e-4 stops before
            r[v] = fma_where(drawn, weight, cr, r[v]);
            g[v] = fma_where(drawn, weight, cg, g[v]);
            bl[v] = fma_where(drawn, weight, cb, bl[v]);
            if (kDepth) d[v] = fma_where(drawn, weight, depth, d[v]);
            t[v] = select(drawn, rest, t[v]);
            if (kId) {
                const M more = gt(drawn, weight, best[v]);
                best[v] = select(more, weight, best[v]);
                id[v] = (I)select(more, (V)(I{} + int32_t(ids[j])), (V)id[v]);
            }
            if (kWeight) most = max(most, zero_unless(drawn, weight));
        }
        if (kWeight) {
            float largest = 0.f;
            for (int l = 0; l < W; l++) largest = most[l] > largest ? most[l] : largest;
            if (largest > 0.f) {  // positive floats order as integers; raising a maximum does not depend on the order
                int32_t *cell = (int32_t *)max_weight + ids[j], mine, seen = __atomic_load_n(cell, __ATOMIC_RELAXED);
                __builtin_memcpy(&mine, &largest, 4);
                while (seen < mine && !__atomic_compare_exchange_n(cell, &seen, mine, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
                }
            }
        }
    }
    for (int v = 0; v < kGroup; v++) {
        const int k = at[v];
        store(&s.t[b][k * W], t[v]), store(&s.r[b][k * W], r[v]), store(&s.g[b][k * W], g[v]);
        store(&s.b[b][k * W], bl[v]), s.alive[b][k] = alive[v];
        if (kDepth) store(&s.depth[b][k * W], d[v]);
        if (kId) store(&s.best[b][k * W], best[v]), *(I *)&s.id[b][k * W] = id[v];
    }
}

template <bool kDepth, bool kId, bool kWeight> int64_t blend_tile(const TileWork &work, const Image &image) {
    constexpr int kGroup = W == 16 ? 4 : 2;
    BlendScratch &s = blend_scratch;
    const Lanes lanes;
    for (int b = 0; b < kBlocks; b++)
        for (int i = 0; i < kPixels; i++) {
            s.t[b][i] = 1.f, s.r[b][i] = s.g[b][i] = s.b[b][i] = 0.f;
            if (kDepth) s.depth[b][i] = 0.f;
            if (kId) s.best[b][i] = 0.f, s.id[b][i] = -1;
        }
    start_alive(work, lanes, s.alive);

    int64_t pairs = 0;
    uint32_t blocks = blocks_in_image(work);
    for (int64_t first = 0; first < work.count && blocks; first += kRound) {
        const int n = int(work.count - first < kRound ? work.count - first : kRound);
        s.round.gather(work, first, n);
        s.round.cull(blocks);
        const uint32_t *ids = (const uint32_t *)s.round.field[ID];
        for (int b = 0; b < kBlocks; b++) {
            if (!(blocks >> b & 1) || !s.round.listed[b]) continue;
            for (int row = 0; row < kBlock / kRows; row += kGroup)
                for (int column = 0; column < kColumns; column++)
                    blend_group<kDepth, kId, kWeight>(s, lanes, b, column, row, work, ids, image.max_weight);
            pairs += s.round.listed[b] * int64_t(kPixels);
            bool any_alive = false;
            for (int k = 0; k < kVectors; k++) any_alive |= any(s.alive[b][k]);
            if (!any_alive) blocks &= ~(1u << b);
        }
    }
    for_pixels(work, [&](int b, int i, int64_t p) {
        const float t = s.t[b][i], alpha = 1.f - t;
        image.alpha[p] = alpha;
        if (image.colour) {
            image.colour[3 * p] = s.r[b][i] + t * image.background[0];
            image.colour[3 * p + 1] = s.g[b][i] + t * image.background[1];
            image.colour[3 * p + 2] = s.b[b][i] + t * image.background[2];
        }
        if (kDepth) image.depth[p] = alpha > 0.f ? s.depth[b][i] / alpha : 0.f;
        if (kId) image.dominant_id[p] = s.id[b][i];
    });
    return pairs;
}

int64_t blend(const TileWork &work, const Image &image) {
    const int which = (image.depth ? 1 : 0) | (image.dominant_id ? 2 : 0) | (image.max_weight ? 4 : 0);
    switch (which) {
        case 0: return blend_tile<false, false, false>(work, image);
        case 1: return blend_tile<true, false, false>(work, image);
        case 2: return blend_tile<false, true, false>(work, image);
        case 3: return blend_tile<true, true, false>(work, image);
        case 4: return blend_tile<false, false, true>(work, image);
        case 5: return blend_tile<true, false, true>(work, image);
        case 6: return blend_tile<false, true, true>(work, image);
        default: return blend_tile<true, true, true>(work, image);
    }
}

}  // namespace GSMAP_ISA
