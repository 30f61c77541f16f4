// The reverse of rasteriser_blend.h. It too runs front to back: it replays the transmittance and keeps, per pixel, what
// the Gaussians still to come contribute to the loss, so nothing but the image has to be saved.
#pragma once
#include "rasteriser_tile.h"

namespace GSMAP_ISA {

// The pixels of one block: transmittance, what is still to come of the loss, and the image's gradient. One block after
// the other, not one array after the other: those would lie 4 KiB apart, and stores to one would stall loads of the next.
struct alignas(64) BackwardBlock {
    float t[kPixels], rest[kPixels], gr[kPixels], gg[kPixels], gb[kPixels], gd[kPixels], ga[kPixels];
    M alive[kVectors];
};

// One Gaussian over one block. What is frozen only takes its share of what is still to come.
template <bool kDepth, bool kFrozen>
INLINE void backward_splat(const Round &round, BackwardBlock &s, const Lanes &first, int j, float *slot) {
    Splat splat(round, first, j);
    const V cr = set1(round.field[R][j]), cg = set1(round.field[G][j]), cb = set1(round.field[B][j]);
    const V depth = kDepth ? set1(round.field[DEPTH][j]) : V{};
    V sum[W > 10 ? W : (10 + W - 1) / W * W] = {};
    for (int k = 0; k < kVectors; k++) {
        const int at = k * W;
        const V u = splat.u_at(k % kColumns), w = splat.w, exponent = splat.exponent(u);
        const V raw = exp2_in_range(exponent);
        if (k % kColumns == kColumns - 1) splat.next_row();
        const M alive = s.alive[k];
        const M touched = both(ge(exponent, set1(kMinLog2Alpha)), alive);
        if (W < 16 && !any(touched)) continue;
        const V alpha = min(raw, set1(kMaxAlpha)), t = load(&s.t[at]), weight = alpha * t, next = fnma(alpha, t, t);
        const M drawn = gt(touched, next, set1(kMinTransmittance));
        s.alive[k] = first_not_second(alive, differ(touched, drawn));
        const V gr = load(&s.gr[at]), gg = load(&s.gg[at]), gb = load(&s.gb[at]);
        V value = fma(cr, gr, fma(cg, gg, fma(cb, gb, load(&s.ga[at]))));
        if (kDepth) value = fma(depth, load(&s.gd[at]), value);
        const V shown = zero_unless(drawn, weight);
        const V rest = fnma(shown, value, load(&s.rest[at]));
        store(&s.rest[at], rest);
        store(&s.t[at], select(drawn, next, t));
        if (kFrozen) continue;
        // dL/d ln(alpha) = alpha (T v - rest / (1 - alpha)); none where alpha is clamped
        V g = fma(weight, value, V{} - alpha * rest * reciprocal(1.f - alpha));
        g = zero_unless(first_not_second(drawn, gt(raw, set1(kMaxAlpha))), g);
        const V gu = g * u, gw = g * w;
        sum[M_G] += g, sum[M_U] += gu, sum[M_W] += gw;
        sum[M_UU] = fma(gu, u, sum[M_UU]), sum[M_UW] = fma(gu, w, sum[M_UW]), sum[M_WW] = fma(gw, w, sum[M_WW]);
        sum[M_R] = fma(shown, gr, sum[M_R]), sum[M_GREEN] = fma(shown, gg, sum[M_GREEN]);
        sum[M_B] = fma(shown, gb, sum[M_B]);
        if (kDepth) sum[M_DEPTH] = fma(shown, load(&s.gd[at]), sum[M_DEPTH]);
    }
    if (kFrozen) return;
    for (int m = 0; m < 10; m += W) store(slot + m, load(slot + m) + sums_of_lanes(sum + m));
}

// L = sum_i w_i v_i with v = colour . g_colour + depth * g_depth + g_alpha; rest = sum over what is not blended yet.
template <bool kDepth>
INLINE void backward_block(const Round &round, BackwardBlock &s, const Lanes &lanes, int b, const uint8_t *frozen,
                           float (*moments)[kMoments]) {
    const Lanes first = lanes.in_tile(b, 0);
    for (int i = 0; i < round.listed[b]; i++) {
        const int j = round.list[b][i];
        if (frozen[j])
            backward_splat<kDepth, true>(round, s, first, j, nullptr);
        else
            backward_splat<kDepth, false>(round, s, first, j, moments[j]);
    }
}

// Whether the gradient of every pixel of a block is zero.
template <bool kDepth> bool is_zero(const BackwardBlock &s) {
    bool some = false;
    for (int i = 0; i < kPixels; i++) {
        some |= s.gr[i] != 0.f || s.gg[i] != 0.f || s.gb[i] != 0.f || s.ga[i] != 0.f || s.rest[i] != 0.f;
        if (kDepth) some |= s.gd[i] != 0.f;
    }
    return !some;
}

template <bool kDepth>
void backward_tile(const TileWork &work, const Image &image, const ImageGradient &gradient, float *slots) {
    Round round;
    BackwardBlock block[kBlocks];
    alignas(64) float moments[kRound][kMoments];
    uint8_t frozen[kRound] = {};
    const Lanes lanes;
    for (int b = 0; b < kBlocks; b++) {
        BackwardBlock &s = block[b];
        for (int i = 0; i < kPixels; i++) {
            s.t[i] = 1.f, s.rest[i] = s.gr[i] = s.gg[i] = s.gb[i] = s.ga[i] = 0.f;
            if (kDepth) s.gd[i] = 0.f;
        }
        start_alive(work, lanes, b, s.alive);
    }
    for_pixels(work, [&](int b, int i, int64_t p) {
        BackwardBlock &s = block[b];
        const float alpha = image.alpha[p], t = 1.f - alpha;
        float g_alpha = gradient.alpha ? gradient.alpha[p] : 0.f, total = 0.f;
        if (gradient.colour) {
            const float *g = gradient.colour + 3 * p, *c = image.colour + 3 * p, *bg = image.background;
            s.gr[i] = g[0], s.gg[i] = g[1], s.gb[i] = g[2];
            g_alpha -= g[0] * bg[0] + g[1] * bg[1] + g[2] * bg[2];
            total += g[0] * (c[0] - t * bg[0]) + g[1] * (c[1] - t * bg[1]) + g[2] * (c[2] - t * bg[2]);
        }
        if (kDepth && alpha > 0.f) {  // the depth shown is sum(w z) / sum(w)
            const float g = gradient.depth[p] / alpha;
            s.gd[i] = g;
            g_alpha -= g * image.depth[p];
            total += g * image.depth[p] * alpha;
        }
        s.ga[i] = g_alpha;
        s.rest[i] = total + g_alpha * alpha;
    });

    uint32_t blocks = blocks_in_image(work, nullptr);
    for (int b = 0; b < kBlocks; b++)  // what no loss looks at adds nothing but zeros
        if (is_zero<kDepth>(block[b])) blocks &= ~(1u << b);
    for (int64_t first = 0; first < work.count; first += kRound) {
        const int n = int(work.count - first < kRound ? work.count - first : kRound);
        round.gather(work, first, n);
        for (int j = 0; j < n; j++)
            for (int m = 0; m < kMoments; m++) moments[j][m] = 0.f;
        for (int j = 0; gradient.frozen && j < n; j++) frozen[j] = gradient.frozen[work.records[work.list[first + j]].id];
        if (blocks) round.cull(blocks);
        for (int b = 0; b < kBlocks && blocks; b++) {
            if (!(blocks >> b & 1) || !round.listed[b]) continue;
            backward_block<kDepth>(round, block[b], lanes, b, frozen, moments);
            bool any_alive = false;
            for (int k = 0; k < kVectors; k++) any_alive |= any(block[b].alive[k]);
            if (!any_alive) blocks &= ~(1u << b);
        }
        for (int j = 0; j < n; j++) {
            const Record &r = work.records[work.list[first + j]];
            float *slot = slots + (int64_t(r.slot) + uint32_t(work.ty - r.ty0) * uint32_t(r.tx1 - r.tx0) +
                                   uint32_t(work.tx - r.tx0)) * kMoments;
            for (int m = 0; m < kMoments; m += W) store(slot + m, load(&moments[j][m]));
        }
    }
}

void blend_backward(const TileWork &work, const Image &image, const ImageGradient &gradient, float *slots) {
    if (gradient.depth)
        backward_tile<true>(work, image, gradient, slots);
    else
        backward_tile<false>(work, image, gradient, slots);
}

}  // namespace GSMAP_ISA
