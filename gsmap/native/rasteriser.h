// What the parts of the rasteriser share. Plain data only: it crosses between code compiled for different instruction
// sets. The pipeline of one view: project -> sort by depth -> bin into tiles -> blend; backwards: blend -> project.
#pragma once
#include <cstddef>
#include <cstdint>

#include "correspondences.h"
#include "matches.h"
#include "merging.h"
#include "sift.h"

namespace gsmap {

constexpr int kTile = 32;        // pixels; larger tiles make fewer intersections, smaller ones cull better
constexpr int kBlockX = 8, kBlockY = 8;  // pixels; Gaussians are culled exactly against such blocks inside a tile
constexpr int kChunk = 1024;     // Gaussians per task of the projection
constexpr int kRound = 64;      // Gaussians of a tile that are worked on together, in L1
constexpr float kMaxAlpha = 0.99f, kMinTransmittance = 1e-4f;
constexpr float kNear = 0.01f, kDilation = 0.3f;

struct Scene {
    const float *means, *quats, *log_scales, *logit_opacities, *sh;
    int64_t n;
    int k;  // SH coefficients per channel: 1, 4, 9 or 16
};

struct SceneGradient {  // added to
    float *means, *quats, *log_scales, *logit_opacities, *sh;  // all null where only the pose is wanted
    float *mean2d;          // (n, 2) in pixels; may be null
    uint8_t *touched;       // (n,) set to 1 where something was added; may be null
    const uint8_t *frozen;  // (n,) not 0: leave out; may be null; always of the whole scene
    int64_t first;          // the scene's row that row 0 of the arrays above belongs to
};

struct Camera {
    double R[9], t[3];  // world to camera
    double fx, fy, cx, cy;
    int width, height;
};

// A visible Gaussian on the image. The exponent is log2(alpha) = log2_opacity - u^2 - w^2 with
// u = l11 dx + l12 dy, w = l22 dy: the Cholesky factor of the conic, which does not cancel for thin Gaussians.
struct alignas(64) Record {
    float x, y, l11, l12, l22, log2_opacity, r, g, b, depth;
    uint32_t id;                 // row in the scene
    uint32_t slot;               // first of its intersections' slots
    uint16_t tx0, ty0, tx1, ty1;  // tiles touched, half open
    float unused[2];

    __attribute__((always_inline)) uint32_t tiles() const { return uint32_t(tx1 - tx0) * uint32_t(ty1 - ty0); }
};
static_assert(sizeof(Record) == 64, "a record is one cache line");
enum Field { X, Y, L11, L12, L22, LOG2_OPACITY, R, G, B, DEPTH, ID, SLOT, TX, TY, kFields = 16 };

// Sums over one Gaussian's pixels in one tile; g is dL / d ln(alpha).
enum Moment { M_G, M_U, M_W, M_UU, M_UW, M_WW, M_R, M_GREEN, M_B, M_DEPTH, kMoments = 16 };

struct Image {  // any of them may be null, except alpha
    float *colour, *depth, *alpha;
    int32_t *dominant_id;
    float *max_weight;  // (n,) per Gaussian of the scene: largest blending weight, raised only
    float *centre;      // (pixels, 2) mean position on the image of the Gaussians' centres, by blending weight
    float background[3];
    const float *looked_at;  // not 0 where a loss looks: blocks out of its reach (`kSsimReach`) stay empty; null: all
};

struct ImageGradient {
    const float *colour, *depth, *alpha;  // gradients, null for zero
    const uint8_t *frozen;  // (n,) not 0 for Gaussians whose own gradient nobody asks for; may be null
};

struct TileWork {
    const Record *records;
    const uint32_t *list;  // records of this tile, nearest first
    int64_t count;
    int tx, ty, tiles_x;
    int width, height;
};

// A tile may be blended in several calls, of which the first starts and the last writes the image.
enum BlendPart { kBlendOn = 0, kBlendStart = 1, kBlendEnd = 2 };
constexpr size_t kBlendStateBytes = 45056;  // between two calls, aligned to 64

// One attribute of N Gaussians under Adam: values, first and second moments, all (N, cols).
struct AdamArrays {
    float *value, *m, *v;
    int cols;
    float rate, rate_rest;  // learning rates of the first three columns and of the others
};

struct AdamStep {
    float beta1, beta2, epsilon;
    const float *corrections;  // by number of updates t: 1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t)
    uint32_t *updates;         // (N,) how often each Gaussian was updated
};

constexpr int kSsimTaps = 11, kSsimReach = 5, kSsimPad = 16;  // the pad holds the reach of three channels, and a vector

// Rows [from, to) of sum mask * ssim over an image's values: (height, width, 3) a and b, (height, width) mask or null.
struct SsimTask {
    const float *a, *b, *mask;
    int width, height, from, to;
    float scale;
    float *gradient;  // with respect to a, times scale: added to
    double *sums;     // (height,) one for each row
};

__attribute__((always_inline)) inline int64_t ssim_stride(int width) { return (3 * int64_t(width) + 15) / 16 * 16 + 3 * kSsimPad; }
__attribute__((always_inline)) inline int64_t ssim_scratch(int width) { return (5 * kSsimTaps + 6) * ssim_stride(width); }

// One set of these per instruction set.
struct Kernels {
    const char *name;
    // Projects Gaussians [begin, end), end - begin <= kChunk; writes the visible ones to out, returns how many.
    int (*project)(const Scene &, const Camera &, int64_t begin, int64_t end, Record *out);
    // Returns how many (Gaussian, pixel) pairs were evaluated.
    int64_t (*blend)(const TileWork &, const Image &);
    // The same in several calls; `open` has a bit for each block of the tile with a pixel that light still comes through.
    int64_t (*blend_more)(const TileWork &, const Image &, BlendPart, void *state, uint32_t *open);
    // Blends `repeats` rounds into one block, everything in L1: the speed of the inner loop alone. Returns the pairs.
    int64_t (*blend_limit)(int64_t repeats);
    // Writes one slot of kMoments floats for every intersection of the tile.
    void (*blend_backward)(const TileWork &, const Image &, const ImageGradient &, float *slots);
    // From the slots of `count` records to gradients; adds dL/dT_camera_world (rows of R, then t) to pose unless null.
    void (*project_backward)(const Scene &, const Camera &, const Record *, int count, const float *slots,
                             const SceneGradient &, double *pose);
    // One Adam update of rows [begin, begin + n) that are touched; clears their gradients, not `touched`.
    void (*adam)(const AdamArrays &, const AdamStep &, int64_t begin, int n, const uint8_t *touched, float *gradient);
    // One row of pixels of weight * sum mask huber(a - b): adds its gradient to g, returns the sum. mask may be null.
    float (*huber)(const float *a, const float *b, const float *mask, int pixels, float delta, float weight, float *g);
    // Structural similarity of some rows of two images, and its gradient. Scratch: ssim_scratch(width) floats.
    void (*ssim)(const SsimTask &, float *scratch);
    // One correspondence against those after it: which agree, and which bin of log scales each pair votes for (or -1).
    void (*agree)(const Correspondences &, int i, const AgreeTest &, uint8_t *ok);
    void (*vote)(const Correspondences &, int i, const VoteTest &, int32_t *bin);
    // Rows of `count` numbers: their weighted sum, and the highest of each.
    void (*weigh)(const float *const *rows, const float *weights, int n, int64_t count, float *out);
    void (*highest)(const float *const *rows, int n, int64_t count, float *out);
    // Of local features: extrema among three levels of a picture, and slopes as lengths and angles.
    int (*peaks)(const float *const *rows, float bar, int from, int to, int32_t *found);
    void (*polar)(const float *dx, const float *dy, int count, float *length, float *angle);
    void (*add_slopes)(const SlopeGrid &, const float *length, const float *angle, int from, int count, float across,
                       float down, float *bins);
    int64_t (*near)(uint64_t mine, const uint64_t *theirs, int64_t count, int most, int32_t *which, uint8_t *differ);
    // What it costs to draw one in place of each pair, blurred by a variance.
    void (*pair_costs)(const Blob *, Pair *, int64_t count, double blur, double cover);
    // The nearest of the points of a leaf: those of another one are looked at, and in the end only the k nearest left.
    float (*find_nearest)(const Leaf &of, const Leaf &among, int k, Search &);
    float (*settle_nearest)(const Leaf &of, int k, Search &);
    int64_t (*within)(const int16_t *mine, const int8_t *theirs, int64_t stride, int64_t count, int32_t most,
                      int32_t *which, int32_t *squared);
    // Rows of a grid of landmarks, of whose segments flags tell which are filled or wanted.
    void (*blur_across)(const float *const *rows, const uint64_t *filled, const float *taps, int n, uint64_t wanted,
                        float *out);
    void (*blur_along)(const float *line, int step, const float *taps, int n, uint64_t wanted, float *out);
    void (*nearest)(const Descriptors &mine, const Descriptors &theirs, void *room, const MutualNearest &out);
};
extern const Kernels *kernels_avx512, *kernels_avx2;  // null where the compiler could not build them
extern const Kernels *kernels_baseline;

}  // namespace gsmap
