// Blending of one tile, front to back.
#pragma once
#include "rasteriser_tile.h"

namespace GSMAP_ISA {

// Vectors that are blended together: as many as fit the registers. Wide ones are blended one by one, each with a list of
// its own (a strip), because small Gaussians reach few of them, and branches cannot predict which.
constexpr int kGroup = W == 16 ? 1 : 4;
constexpr int kStrips = W == 16 ? kVectors : 1, kListed = W == 16 ? 128 : kRound;
static_assert(kStrips == 1 || (kStrips == 4 && kColumns == 1), "blend_block has one call for each strip");
using BlendRound = RoundOf<kListed, kStrips>;

// The pixels of one block: transmittance, what is blended so far, the largest weight and whose it was. A pixel stops
// before its transmittance falls to 1e-4: `left` falls on, so that the next Gaussian need not wait for what was decided.
struct alignas(64) BlendBlock {
    float left[kPixels], t[kPixels], r[kPixels], g[kPixels], b[kPixels], depth[kPixels], best[kPixels];
    float x[kPixels], y[kPixels];  // of the centres, from the tile's first corner
    int32_t id[kPixels];
    INLINE bool is_open() const {
        M any_left{};
        for (int k = 0; k < kVectors; k++) any_left = either(any_left, gt(load(&left[k * W]), set1(kMinTransmittance)));
        return any(any_left);
    }
};

// Blends what is listed for a block, or for strip kStrip of it, into the vectors of a group that begins with `row`.
template <bool kDepth, bool kId, bool kWeight, bool kCentre, int kStrip>
INLINE void blend_group(const BlendRound &round, BlendBlock &s, const Lanes &lanes, int b, int column, int row, V *most) {
    const uint32_t *ids = (const uint32_t *)round.field[ID];
    const Lanes first = lanes.in_tile(b, kStrips > 1 ? 0 : row);
    V left[kGroup], t[kGroup], r[kGroup], g[kGroup], bl[kGroup], d[kGroup], best[kGroup], x[kGroup], y[kGroup];
    I id[kGroup];
    int at[kGroup];
    for (int v = 0; v < kGroup; v++) {
        const int k = (row + v) * kColumns + column;
        at[v] = k;
        left[v] = load(&s.left[k * W]), t[v] = load(&s.t[k * W]);
        r[v] = load(&s.r[k * W]), g[v] = load(&s.g[k * W]), bl[v] = load(&s.b[k * W]);
        if (kDepth) d[v] = load(&s.depth[k * W]);
        if (kCentre) x[v] = load(&s.x[k * W]), y[v] = load(&s.y[k * W]);
        if (kId) best[v] = load(&s.best[k * W]), id[v] = *(const I *)&s.id[k * W];
    }
    const int listed = b * kStrips + kStrip;
    for (int i = 0; i < round.listed[listed]; i++) {
        const int j = round.list[listed][i];
        Splat splat(round, first, j);
        for (int v = 0; v < kStrip; v++) splat.next_row();
        const V cr = set1(round.field[R][j]), cg = set1(round.field[G][j]), cb = set1(round.field[B][j]);
        const V depth = kDepth ? set1(round.field[DEPTH][j]) : V{};
        const V cx = kCentre ? set1(round.field[X][j]) : V{}, cy = kCentre ? set1(round.field[Y][j]) : V{};
        for (int v = 0; v < kGroup; v++) {
            const V exponent = splat.exponent(splat.u_at(column));
            splat.next_row();
            const M touched = ge(exponent, set1(kMinLog2Alpha));
            if (kStrips == 1 && !any(gt(touched, left[v], set1(kMinTransmittance)))) continue;
            const V alpha = min(exp2_in_range(exponent), set1(kMaxAlpha));
            const V weight = alpha * left[v], rest = fnma(alpha, left[v], left[v]);
            const M drawn = gt(touched, rest, set1(kMinTransmittance));
            left[v] = select(touched, rest, left[v]);
            r[v] = fma_where(drawn, weight, cr, r[v]);
            g[v] = fma_where(drawn, weight, cg, g[v]);
            bl[v] = fma_where(drawn, weight, cb, bl[v]);
            if (kDepth) d[v] = fma_where(drawn, weight, depth, d[v]);
            if (kCentre) x[v] = fma_where(drawn, weight, cx, x[v]), y[v] = fma_where(drawn, weight, cy, y[v]);
            t[v] = select(drawn, rest, t[v]);
            if (kId) {
                const M more = gt(drawn, weight, best[v]);
                best[v] = select(more, weight, best[v]);
                id[v] = (I)select(more, (V)(I{} + int32_t(ids[j])), (V)id[v]);
            }
            if (kWeight) most[j] = max(most[j], zero_unless(drawn, weight));
        }
    }
    for (int v = 0; v < kGroup; v++) {
        const int k = at[v];
        store(&s.left[k * W], left[v]), store(&s.t[k * W], t[v]);
        store(&s.r[k * W], r[v]), store(&s.g[k * W], g[v]), store(&s.b[k * W], bl[v]);
        if (kDepth) store(&s.depth[k * W], d[v]);
        if (kCentre) store(&s.x[k * W], x[v]), store(&s.y[k * W], y[v]);
        if (kId) store(&s.best[k * W], best[v]), *(I *)&s.id[k * W] = id[v];
    }
}

// All of one block's vectors; returns how many pairs of a Gaussian and a pixel were looked at.
template <bool kDepth, bool kId, bool kWeight, bool kCentre>
INLINE int64_t blend_block(const BlendRound &round, BlendBlock &s, const Lanes &lanes, int b, V *most) {
    if constexpr (kStrips > 1) {
        blend_group<kDepth, kId, kWeight, kCentre, 0>(round, s, lanes, b, 0, 0, most);
        blend_group<kDepth, kId, kWeight, kCentre, 1>(round, s, lanes, b, 0, 1, most);
        blend_group<kDepth, kId, kWeight, kCentre, 2>(round, s, lanes, b, 0, 2, most);
        blend_group<kDepth, kId, kWeight, kCentre, 3>(round, s, lanes, b, 0, 3, most);
    } else {
        for (int row = 0; row < kBlockY / kRows; row += kGroup)
            for (int column = 0; column < kColumns; column++)
                blend_group<kDepth, kId, kWeight, kCentre, 0>(round, s, lanes, b, column, row, most);
    }
    int64_t pairs = 0;
    for (int k = 0; k < kStrips; k++) pairs += round.listed[b * kStrips + k] * int64_t(kPixels / kStrips);
    return pairs;
}

// Raises the largest weight of each Gaussian of a round to the largest over the lanes of `most`, which is cleared.
INLINE void raise_weights(const BlendRound &round, V *most, float *max_weight) {
    const uint32_t *ids = (const uint32_t *)round.field[ID];
    for (int i = 0; i < round.count; i += W) {
        transpose(most + i);
        V largest = most[i];
        for (int l = 1; l < W; l++) largest = max(largest, most[i + l]);
        alignas(64) int32_t mine[W];
        store((float *)mine, largest);
        for (int l = 0; l < W; l++) most[i + l] = V{};
        for (uint32_t m = bits(gt(largest, V{})); m; m &= m - 1) {
            // positive floats order as integers; raising a maximum does not depend on the order
            const int l = __builtin_ctz(m);
            int32_t *cell = (int32_t *)max_weight + ids[i + l], seen = __atomic_load_n(cell, __ATOMIC_RELAXED);
            while (seen < mine[l] && !__atomic_compare_exchange_n(cell, &seen, mine[l], true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
            }
        }
    }
}

// A tile between two calls: its blocks, and which of them still have a pixel that light comes through.
struct BlendState {
    BlendBlock block[kBlocks];
    uint32_t open;
};
static_assert(sizeof(BlendState) <= kBlendStateBytes, "there is room for it");

INLINE void start_blend(const TileWork &work, const Image &image, const Lanes &lanes, BlendState &state) {
    for (int b = 0; b < kBlocks; b++) {
        BlendBlock &s = state.block[b];
        for (int i = 0; i < kPixels; i++) {
            s.t[i] = 1.f, s.r[i] = s.g[i] = s.b[i] = 0.f;
            s.depth[i] = s.best[i] = s.x[i] = s.y[i] = 0.f, s.id[i] = -1;
        }
        M alive[kVectors];
        start_alive(work, lanes, b, alive);
        for (int k = 0; k < kVectors; k++) store(&s.left[k * W], zero_unless(alive[k], set1(1.f)));
    }
    state.open = blocks_in_image(work, image.looked_at);
}

template <bool kDepth, bool kId, bool kWeight, bool kCentre>
INLINE int64_t go_on_blending(const TileWork &work, const Image &image, const Lanes &lanes, BlendState &state) {
    BlendRound round;
    V most[kWeight ? kListed + W : 1] = {};
    int64_t pairs = 0;
    uint32_t blocks = state.open;
    for (int64_t first = 0; first < work.count && blocks; first += kListed) {
        const int n = int(work.count - first < kListed ? work.count - first : kListed);
        round.gather(work, first, n);
        round.cull(blocks);
        for (int b = 0; b < kBlocks; b++) {
            if (!(blocks >> b & 1)) continue;
            BlendBlock &s = state.block[b];
            const int64_t looked = blend_block<kDepth, kId, kWeight, kCentre>(round, s, lanes, b, most);
            if (!looked) continue;
            pairs += looked;
            if (!s.is_open()) blocks &= ~(1u << b);
        }
        if (kWeight) raise_weights(round, most, image.max_weight);
    }
    state.open = blocks;
    return pairs;
}

template <bool kDepth, bool kId, bool kCentre> INLINE void end_blend(const TileWork &work, const Image &image, const BlendState &state) {
    for_pixels(work, [&](int b, int i, int64_t p) {
        const BlendBlock &s = state.block[b];
        const float t = s.t[i], alpha = 1.f - t;
        image.alpha[p] = alpha;
        if (image.colour) {
            image.colour[3 * p] = s.r[i] + t * image.background[0];
            image.colour[3 * p + 1] = s.g[i] + t * image.background[1];
            image.colour[3 * p + 2] = s.b[i] + t * image.background[2];
        }
        if (kDepth) image.depth[p] = alpha > 0.f ? s.depth[i] / alpha : 0.f;
        if (kId) image.dominant_id[p] = s.id[i];
        if (kCentre) {
            image.centre[2 * p] = alpha > 0.f ? s.x[i] / alpha + float(work.tx * kTile) : 0.f;
            image.centre[2 * p + 1] = alpha > 0.f ? s.y[i] / alpha + float(work.ty * kTile) : 0.f;
        }
    });
}

template <bool kDepth, bool kId, bool kWeight, bool kCentre>
int64_t blend_part(const TileWork &work, const Image &image, BlendPart part, BlendState &state) {
    const Lanes lanes;
    if (part & kBlendStart) start_blend(work, image, lanes, state);
    const int64_t pairs = go_on_blending<kDepth, kId, kWeight, kCentre>(work, image, lanes, state);
    if (part & kBlendEnd) end_blend<kDepth, kId, kCentre>(work, image, state);
    return pairs;
}

// Not inlined: the compiler would see that nobody looks at most of the result.
__attribute__((noinline)) void blend_again(const BlendRound &round, BlendBlock &s, const Lanes &lanes) {
    for (int i = 0; i < kPixels; i++) s.left[i] = 1.f;
    blend_block<false, false, false, false>(round, s, lanes, 0, nullptr);
}

int64_t blend_limit(int64_t repeats) {
    BlendRound round;
    BlendBlock block;
    const Lanes lanes;
    __builtin_memset(&round, 0, sizeof round);
    __builtin_memset(&block, 0, sizeof block);
    round.count = kListed;
    for (int j = 0; j < kListed; j++) {
        for (int k = 0; k < kStrips; k++) round.list[k][j] = uint8_t(j), round.listed[k] = kListed;
        round.field[X][j] = round.field[Y][j] = 4.f;
        round.field[L11][j] = round.field[L22][j] = 0.1f;
        round.field[LOG2_OPACITY][j] = -7.5f;
    }
    for (int64_t i = 0; i < repeats; i++) blend_again(round, block, lanes);
    return repeats * kListed * kPixels;
}

int64_t blend_parts(const TileWork &work, const Image &image, BlendPart part, BlendState &state) {
    const int which = (image.depth ? 1 : 0) | (image.dominant_id ? 2 : 0) | (image.max_weight ? 4 : 0);
    if (image.centre) return blend_part<true, false, false, true>(work, image, part, state);
    switch (which) {
        case 0: return blend_part<false, false, false, false>(work, image, part, state);
        case 1: return blend_part<true, false, false, false>(work, image, part, state);
        case 2: return blend_part<false, true, false, false>(work, image, part, state);
        case 3: return blend_part<true, true, false, false>(work, image, part, state);
        case 4: return blend_part<false, false, true, false>(work, image, part, state);
        case 5: return blend_part<true, false, true, false>(work, image, part, state);
        case 6: return blend_part<false, true, true, false>(work, image, part, state);
        default: return blend_part<true, true, true, false>(work, image, part, state);
    }
}

int64_t blend(const TileWork &work, const Image &image) {
    BlendState state;
    return blend_parts(work, image, BlendPart(kBlendStart | kBlendEnd), state);
}

int64_t blend_more(const TileWork &work, const Image &image, BlendPart part, void *state, uint32_t *open) {
    BlendState &kept = *static_cast<BlendState *>(state);
    const int64_t pairs = blend_parts(work, image, part, kept);
    *open = kept.open;
    return pairs;
}

}  // namespace GSMAP_ISA
