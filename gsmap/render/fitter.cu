// Optimisation steps on the GPU: projection, tile lists, blending, image loss, and all of it backwards up to Adam.
//
// It is the CPU's rasteriser (gsmap/native/rasteriser*.h, fit*.h) with other loops: the same records, moments and
// clamps. One warp blends a block of 8 x 8 pixels, a quarter of a tile; Gaussians that miss the block are left out
// before. Backwards a warp takes 64 places of the lists, wherever their tiles begin and end, from the transmittance that
// blending left there, so that long lists are not waited for. Compiled by NVRTC when it is first used.

constexpr int WARP = 32, TILE = 16, BLOCK = 8, BUCKET = 64, MOMENTS = 9, REACH = 5, TAPS = 11;
constexpr int HUBER = 0, SIMILAR = 1, WEIGHT = 2, LOSS = 3, OVERFLOW = 4;  // of the sums of a view
constexpr unsigned ALL = 0xffffffffu;
constexpr float LN2 = 0.693147180559945309f, LOG2_255 = 7.99435343685886f;
#define INFINITE __int_as_float(0x7f800000)
constexpr float MAX_ALPHA = 0.99f, MIN_TRANSMITTANCE = 1e-4f, NEAR = 0.01f, DILATION = 0.3f;

#ifndef SHARED_FLOATS
#define SHARED_FLOATS(name) extern __shared__ float name[]  // as many as the launch says
#endif
#ifndef NUM_SH
#define NUM_SH num_sh  // coefficients for each channel; a constant where the compiler is told it
#endif

struct Step {  // one view: camera (world to camera), target image and mask on the GPU
    double R[9], t[3], fx, fy, cx, cy;
    const void *target, *mask;  // (height, width, 3) and (height, width) or null
    int width, height, tiles_x, tiles_y, target_bytes, mask_bytes;  // bytes: uint8, 255 is 1; else float
    int unused[2];
};

struct Options {
    float ssim_weight, huber_delta, background[3], beta1, beta2, epsilon, rates[6];
    int views, statistics, last_correction, unused;
};

__device__ __forceinline__ float target_at(const Step &v, int at) {
    return v.target_bytes ? ((const unsigned char *)v.target)[at] * (1.f / 255.f) : ((const float *)v.target)[at];
}

__device__ __forceinline__ float mask_at(const Step &v, int pixel) {
    if (!v.mask) return 1.f;
    return v.mask_bytes ? ((const unsigned char *)v.mask)[pixel] * (1.f / 255.f) : ((const float *)v.mask)[pixel];
}

#ifdef __CUDA_ARCH__
__device__ __forceinline__ float power_of_two(float x) {
    float out;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(out) : "f"(x));
    return out;
}
#else
inline float power_of_two(float x) { return exp2f(x); }
#endif

struct Record {  // see gsmap/native/rasteriser.h: log2(alpha) = log2_opacity - u^2 - w^2
    float x, y, l11, l12, l22, log2_opacity, depth, frozen, r, g, b, unused;
};

__device__ __forceinline__ Record load(const float4 *records, int id) {
    const float4 a = records[3 * id], b = records[3 * id + 1], c = records[3 * id + 2];
    return {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w};
}

// --- projection ------------------------------------------------------------------------------------------------------

struct Shape {  // of a Gaussian, and what the backward pass needs of how it came about
    float q[4], inverse_norm, R[9], s[3], rz, ux, uy, jx, jy, r1[3], r2[3], t[3], p[3];
    float a, b, c, det;  // 2D covariance, dilated
};

struct Clamp {  // x/z is clamped 30 % of the field of view outside the image where the Jacobian is taken
    float min_ux, max_ux, min_uy, max_uy;
};

__device__ Clamp clamp_of(const Step &v) {
    const double mx = 0.15 * v.width / v.fx, my = 0.15 * v.height / v.fy;
    return {float(-(v.cx / v.fx + mx)), float((v.width - v.cx) / v.fx + mx), float(-(v.cy / v.fy + my)),
            float((v.height - v.cy) / v.fy + my)};
}

__device__ void shape(const Step &view, const float *camera, const float *quat, const float *log_scale, Shape &g) {
    const float n2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
    const bool good = n2 > 1e-30f;  // a zero quaternion is the identity
    g.inverse_norm = good ? 1.f / sqrtf(n2) : 0.f;
    g.q[0] = good ? quat[0] * g.inverse_norm : 1.f;
    for (int i = 1; i < 4; i++) g.q[i] = quat[i] * g.inverse_norm;
    const float w = g.q[0], x = g.q[1], y = g.q[2], z = g.q[3];
    g.R[0] = 1.f - 2.f * (y * y + z * z), g.R[1] = 2.f * (x * y - w * z), g.R[2] = 2.f * (x * z + w * y);
    g.R[3] = 2.f * (x * y + w * z), g.R[4] = 1.f - 2.f * (x * x + z * z), g.R[5] = 2.f * (y * z - w * x);
    g.R[6] = 2.f * (x * z - w * y), g.R[7] = 2.f * (y * z + w * x), g.R[8] = 1.f - 2.f * (x * x + y * y);
    for (int i = 0; i < 3; i++) g.s[i] = expf(log_scale[i]);
    const Clamp limit = clamp_of(view);
    g.rz = 1.f / camera[2];
    g.ux = fminf(fmaxf(camera[0] * g.rz, limit.min_ux), limit.max_ux);
    g.uy = fminf(fmaxf(camera[1] * g.rz, limit.min_uy), limit.max_uy);
    g.jx = float(view.fx) * g.rz, g.jy = float(view.fy) * g.rz;
    for (int i = 0; i < 3; i++) {  // rows of J R_camera_world
        g.r1[i] = g.jx * (float(view.R[i]) - g.ux * float(view.R[6 + i]));
        g.r2[i] = g.jy * (float(view.R[3 + i]) - g.uy * float(view.R[6 + i]));
    }
    float t[3], p[3];
    for (int i = 0; i < 3; i++) {  // times the columns of R
        g.t[i] = g.r1[0] * g.R[i] + g.r1[1] * g.R[3 + i] + g.r1[2] * g.R[6 + i];
        g.p[i] = g.r2[0] * g.R[i] + g.r2[1] * g.R[3 + i] + g.r2[2] * g.R[6 + i];
        t[i] = g.t[i] * g.s[i], p[i] = g.p[i] * g.s[i];
    }
    const float a0 = t[0] * t[0] + t[1] * t[1] + t[2] * t[2], c0 = p[0] * p[0] + p[1] * p[1] + p[2] * p[2];
    g.b = t[0] * p[0] + t[1] * p[1] + t[2] * p[2];
    g.a = a0 + DILATION, g.c = c0 + DILATION;
    // det(Sigma) as a sum of squared minors (Cauchy-Binet): a * c - b * b would cancel for thin Gaussians.
    const float m0 = t[1] * p[2] - t[2] * p[1], m1 = t[2] * p[0] - t[0] * p[2], m2 = t[0] * p[1] - t[1] * p[0];
    g.det = m0 * m0 + m1 * m1 + m2 * m2 + DILATION * (a0 + c0) + DILATION * DILATION;
}

__device__ __forceinline__ void cholesky(const Shape &g, float &l11, float &l12, float &l22) {
    l11 = sqrtf(g.c / g.det * (0.5f / LN2));
    l12 = -g.b / g.c * l11;
    l22 = sqrtf((0.5f / LN2) / g.c);
}

__device__ void centre(const Step &v, const float *mean, double *camera) {
    for (int i = 0; i < 3; i++)
        camera[i] = v.R[3 * i] * mean[0] + v.R[3 * i + 1] * mean[1] + v.R[3 * i + 2] * mean[2] + v.t[i];
}

// Unit vector from the camera to a Gaussian, and the inverse of its distance.
__device__ float direction(const Step &v, const float *camera, float *d) {
    for (int j = 0; j < 3; j++)
        d[j] = float(v.R[j]) * camera[0] + float(v.R[3 + j]) * camera[1] + float(v.R[6 + j]) * camera[2];
    const float r = 1.f / sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    for (int j = 0; j < 3; j++) d[j] *= r;
    return r;
}

// Real spherical harmonics up to degree 3, see gsmap/native/rasteriser_sh.h.
constexpr float SH0 = 0.28209479177387814f, SH1 = 0.4886025119029199f;
constexpr float A0 = 1.0925484305920792f, A1 = -1.0925484305920792f, A2 = 0.31539156525252005f, A3 = -1.0925484305920792f,
                A4 = 0.5462742152960396f;
constexpr float B0 = -0.5900435899266435f, B1 = 2.890611442640554f, B2 = -0.4570457994644658f, B3 = 0.3731763325901154f,
                B4 = -0.4570457994644658f, B5 = 1.445305721320277f, B6 = -0.5900435899266435f;

__device__ void sh_basis(int k, float x, float y, float z, float *basis) {
    basis[0] = SH0;
    if (k < 4) return;
    basis[1] = -SH1 * y, basis[2] = SH1 * z, basis[3] = -SH1 * x;
    if (k < 9) return;
    const float xx = x * x, yy = y * y, zz = z * z;
    basis[4] = A0 * x * y, basis[5] = A1 * y * z, basis[6] = A2 * (2.f * zz - xx - yy);
    basis[7] = A3 * x * z, basis[8] = A4 * (xx - yy);
    if (k < 16) return;
    basis[9] = B0 * y * (3.f * xx - yy), basis[10] = B1 * x * y * z, basis[11] = B2 * y * (4.f * zz - xx - yy);
    basis[12] = B3 * z * (2.f * zz - 3.f * xx - 3.f * yy), basis[13] = B4 * x * (4.f * zz - xx - yy);
    basis[14] = B5 * z * (xx - yy), basis[15] = B6 * x * (xx - 3.f * yy);
}

// Gradient with respect to (x, y, z) of sum_j w[j] * basis[j].
__device__ void sh_basis_backward(int k, float x, float y, float z, const float *w, float *g) {
    g[0] = g[1] = g[2] = 0.f;
    if (k < 4) return;
    g[0] = -SH1 * w[3], g[1] = -SH1 * w[1], g[2] = SH1 * w[2];
    if (k < 9) return;
    const float xx = x * x, yy = y * y, zz = z * z;
    g[0] += A0 * y * w[4] - 2.f * A2 * x * w[6] + A3 * z * w[7] + 2.f * A4 * x * w[8];
    g[1] += A0 * x * w[4] + A1 * z * w[5] - 2.f * A2 * y * w[6] - 2.f * A4 * y * w[8];
    g[2] += A1 * y * w[5] + 4.f * A2 * z * w[6] + A3 * x * w[7];
    if (k < 16) return;
    g[0] += 6.f * B0 * x * y * w[9] + B1 * y * z * w[10] - 2.f * B2 * x * y * w[11] - 6.f * B3 * x * z * w[12] +
            B4 * (4.f * zz - 3.f * xx - yy) * w[13] + 2.f * B5 * x * z * w[14] + 3.f * B6 * (xx - yy) * w[15];
    g[1] += 3.f * B0 * (xx - yy) * w[9] + B1 * x * z * w[10] + B2 * (4.f * zz - xx - 3.f * yy) * w[11] -
            6.f * B3 * y * z * w[12] - 2.f * B4 * x * y * w[13] - 2.f * B5 * y * z * w[14] - 6.f * B6 * x * y * w[15];
    g[2] += B1 * x * y * w[10] + 8.f * B2 * y * z * w[11] + B3 * (6.f * zz - 3.f * xx - 3.f * yy) * w[12] +
            8.f * B4 * x * z * w[13] + B5 * (xx - yy) * w[14];
}

// Columns of tiles that a Gaussian touches in a row of tiles: the first, and how many.
__device__ int row_of_tiles(const Record &g, int row, int tiles_x, int &first) {
    const float k = g.log2_opacity + LOG2_255 + 0.01f, m = g.l12 / g.l22, most = sqrtf(k);
    const float low = fmaxf((TILE * row + 0.5f - g.y) * g.l22, -most), high = fminf((TILE * row + 15.5f - g.y) * g.l22, most);
    if (low > high) return 0;
    const float turn = m * most / sqrtf(1.f + m * m);  // -w where the ellipse reaches farthest to the right
    const float wr = fminf(fmaxf(-turn, low), high), wl = fminf(fmaxf(turn, low), high);
    const float right = g.x + (sqrtf(fmaxf(k - wr * wr, 0.f)) - m * wr) / g.l11 + 0.02f;
    const float left = g.x - (sqrtf(fmaxf(k - wl * wl, 0.f)) + m * wl) / g.l11 - 0.02f;
    const int begin = int(ceilf(fminf(fmaxf((left - 15.5f) / TILE, 0.f), float(tiles_x))));
    const int end = int(floorf(fminf(fmaxf((right - 0.5f) / TILE, -1.f), float(tiles_x - 1)))) + 1;
    first = begin;
    return end > begin ? end - begin : 0;
}

__device__ void rows_of_tiles(const Record &g, int tiles_y, int &begin, int &end) {
    const float reach = sqrtf(g.log2_opacity + LOG2_255 + 0.01f) / g.l22 + 0.02f;
    begin = int(ceilf(fminf(fmaxf((g.y - reach - 15.5f) / TILE, 0.f), float(tiles_y))));
    end = int(floorf(fminf(fmaxf((g.y + reach - 0.5f) / TILE, -1.f), float(tiles_y - 1)))) + 1;
}

// One thread for each Gaussian. Writes its record, depth (infinite where it is not drawn) and number of tiles.
// Shared memory: 32 * (3 k + 1) floats for each warp.
extern "C" __global__ void project(const Step *step, const float *means, const float *quats, const float *log_scales,
                                   const float *logits, const float *sh, const unsigned char *frozen, int n, int num_sh,
                                   int first_view, float4 *records, float *depths, int *counts, float *sums) {
    SHARED_FLOATS(staged);
    const int k = NUM_SH;
    const int id = blockIdx.x * blockDim.x + threadIdx.x, lane = threadIdx.x % WARP;
    if (id < LOSS || (id == LOSS && first_view)) sums[id] = 0.f;
    const Step &view = *step;
    Record out{};
    Shape g;
    float camera[3] = {0.f, 0.f, 1.f};
    bool live = false;
    if (id < n) {
        double p[3];
        float mean[3], quat[4], log_scale[3];
        for (int i = 0; i < 3; i++) mean[i] = means[3 * id + i], log_scale[i] = log_scales[3 * id + i];
        for (int i = 0; i < 4; i++) quat[i] = quats[4 * id + i];
        centre(view, mean, p);
        for (int i = 0; i < 3; i++) camera[i] = float(p[i]);
        const float logit = logits[id];
        // log2 sigmoid, from the side where the exponential cannot overflow
        out.log2_opacity = fminf(logit, 0.f) * (1 / LN2) - log2f(1.f + expf(-fabsf(logit)));
        live = camera[2] > NEAR && camera[2] < 1e10f && out.log2_opacity > -LOG2_255 && logit == logit;
        for (int i = 0; i < 3; i++) live = live && log_scale[i] < 80.f;
        if (live) {
            shape(view, camera, quat, log_scale, g);
            const double rz = 1.0 / p[2];
            out.x = float(view.fx * p[0] * rz + view.cx), out.y = float(view.fy * p[1] * rz + view.cy);
            cholesky(g, out.l11, out.l12, out.l22);
            out.depth = camera[2];
            out.frozen = frozen[id] ? 1.f : 0.f;
            const float norm2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
            live = g.det > 0.f && isfinite(g.a) && isfinite(g.b) && isfinite(g.c) && isfinite(g.det) && isfinite(norm2) &&
                   isfinite(out.x) && isfinite(out.y);
        }
    }
    int count = 0, begin = 0, end = 0, first;
    if (live) rows_of_tiles(out, view.tiles_y, begin, end);
    for (int row = begin; row < end; row++) count += row_of_tiles(out, row, view.tiles_x, first);
    live = live && count > 0;

    // Coefficients of the warp's visible Gaussians, read side by side.
    float *mine = staged + (threadIdx.x / WARP) * WARP * (3 * k + 1);
    const unsigned visible = __ballot_sync(ALL, live);
    if (!visible) {
        if (id < n) depths[id] = INFINITE, counts[id] = 0;
        return;
    }
    const float *from = sh + 3ll * k * (id - lane);
    for (int i = lane; i < WARP * 3 * k; i += WARP)
        if (visible >> (i / (3 * k)) & 1) mine[i / (3 * k) * (3 * k + 1) + i % (3 * k)] = from[i];
    __syncwarp();
    if (live) {
        float d[3], basis[16], colour[3];
        direction(view, camera, d);
        sh_basis(k, d[0], d[1], d[2], basis);
        const float *row = mine + lane * (3 * k + 1);
        for (int c = 0; c < 3; c++) {
            colour[c] = 0.5f;
            for (int j = 0; j < k; j++) colour[c] += basis[j] * row[3 * j + c];
            live = live && isfinite(colour[c]);
        }
        out.r = fmaxf(colour[0], 0.f), out.g = fmaxf(colour[1], 0.f), out.b = fmaxf(colour[2], 0.f);
    }
    if (id >= n) return;
    depths[id] = live ? out.depth : INFINITE;
    counts[id] = live ? count : 0;
    if (!live) return;
    records[3 * id] = {out.x, out.y, out.l11, out.l12};
    records[3 * id + 1] = {out.l22, out.log2_opacity, out.depth, out.frozen};
    records[3 * id + 2] = {out.r, out.g, out.b, 0.f};
}

// One thread for each Gaussian in order of depth. Writes the tile and the Gaussian of every entry; what lies beyond the
// last entry gets the largest number as its tile. If there are more entries than room, it sets OVERFLOW, and the kernels
// after it do nothing.
extern "C" __global__ void list_tiles(const Step *step, const float4 *records, const long long *order,
                                      const long long *upto, const int *counts, int n, int capacity, int narrow,
                                      void *tiles, int *listed, float *sums) {
    const int rank = blockIdx.x * blockDim.x + threadIdx.x;
    auto write = [&](long long at, int tile, int id) {
        if (narrow)
            ((short *)tiles)[at] = short(tile);
        else
            ((int *)tiles)[at] = tile;
        listed[at] = id;
    };
    const long long total = upto[n - 1];
    if (rank == 0) sums[OVERFLOW] = total > capacity;
    if (total > capacity) return;
    for (long long at = total + rank; at < capacity; at += (long long)gridDim.x * blockDim.x)
        write(at, narrow ? 32767 : 2147483647, 0);
    if (rank >= n) return;
    const int id = int(order[rank]);
    if (!counts[id]) return;
    const Record g = load(records, id);
    long long at = upto[rank] - counts[id];
    int begin, end, first;
    rows_of_tiles(g, step->tiles_y, begin, end);
    for (int row = begin; row < end; row++) {
        const int count = row_of_tiles(g, row, step->tiles_x, first);
        for (int i = 0; i < count; i++, at++) write(at, row * step->tiles_x + first + i, id);
    }
}

// --- blending --------------------------------------------------------------------------------------------------------

// Returns true if a Gaussian may reach alpha 1/255 at the centres of a block of pixels whose first is (x, y).
__device__ bool touches(const Record &g, int x, int y) {
    const float x0 = x + 0.5f - g.x, x1 = x0 + (BLOCK - 1), y0 = y + 0.5f - g.y, y1 = y0 + (BLOCK - 1);
    const float dx = fminf(fmaxf(0.f, x0), x1), dy = fminf(fmaxf(0.f, y0), y1);
    if (dx == 0.f && dy == 0.f) return true;
    // The least exponent lies on an edge that faces the centre.
    float least = INFINITE;
    if (dx != 0.f) {
        const float along = fminf(fmaxf(-g.l11 * g.l12 * dx / (g.l12 * g.l12 + g.l22 * g.l22), y0), y1);
        const float u = g.l11 * dx + g.l12 * along, w = g.l22 * along;
        least = u * u + w * w;
    }
    if (dy != 0.f) {
        const float along = fminf(fmaxf(-g.l12 * dy / g.l11, x0), x1);
        const float u = g.l11 * along + g.l12 * dy, w = g.l22 * dy;
        least = fminf(least, u * u + w * w);
    }
    return least <= g.log2_opacity + LOG2_255 + 0.01f;
}

// Returns true if the loss looks at a block of pixels or within reach of it; called by a whole warp.
__device__ bool is_looked_at(const Step &view, int x0, int y0) {
    constexpr int REACHED = BLOCK + 2 * REACH;
    bool any = !view.mask;
    for (int i = threadIdx.x % WARP; i < REACHED * REACHED && !any; i += WARP) {
        const int x = x0 - REACH + i % REACHED, y = y0 - REACH + i / REACHED;
        any = x >= 0 && y >= 0 && x < view.width && y < view.height && mask_at(view, y * view.width + x) != 0.f;
    }
    return __any_sync(ALL, any);
}

// Four warps for each tile, one for each of its blocks; a lane has two pixels of a column. Blocks that no loss looks at
// stay empty, unless statistics are kept.
extern "C" __global__ void blend(const Step *step, const Options *options, const float4 *records, const int *listed,
                                 const int *starts, float *colour, int plane, int *last,
                                 int *block_last, float4 *checkpoints, float *max_weight, const float *sums) {
    if (sums[OVERFLOW] != 0.f) return;
    __shared__ Record kept[4][WARP];
    __shared__ int ids[4][WARP];
    const int tile = blockIdx.x, warp = threadIdx.x / WARP, lane = threadIdx.x % WARP;
    const Step &view = *step;
    if (tile >= view.tiles_x * view.tiles_y) return;
    const int x0 = tile % view.tiles_x * TILE + warp % 2 * BLOCK, y0 = tile / view.tiles_x * TILE + warp / 2 * BLOCK;
    const int x = x0 + lane % BLOCK;
    float t[2] = {1.f, 1.f}, c[2][3] = {};
    int final[2] = {-1, -1}, y[2];
    bool alive[2];
    const bool statistics = options->statistics, wanted = statistics || is_looked_at(view, x0, y0);
    for (int p = 0; p < 2; p++) {
        y[p] = y0 + lane / BLOCK + 4 * p;
        alive[p] = wanted && x < view.width && y[p] < view.height;
    }
    const int start = starts[tile], end = starts[tile + 1];
    for (int base = start / WARP * WARP; base < end; base += WARP) {
        if (!__any_sync(ALL, alive[0] || alive[1])) break;
        if (base % BUCKET == 0 && base > start)
            for (int p = 0; p < 2; p++)
                checkpoints[base / BUCKET * (TILE * TILE) + warp * (2 * WARP) + p * WARP + lane] =
                    {t[p], c[p][0], c[p][1], c[p][2]};
        const int at = base + lane;
        bool hit = false;
        if (at >= start && at < end) {
            const int id = listed[at];
            const Record g = load(records, id);
            hit = touches(g, x0, y0);
            if (hit) kept[warp][lane] = g, ids[warp][lane] = id;
        }
        unsigned hits = __ballot_sync(ALL, hit);
        __syncwarp();
        for (; hits; hits &= hits - 1) {
            const int k = __ffs(hits) - 1;
            const Record &g = kept[warp][k];
            const float dx = x + 0.5f - g.x;
            float most = 0.f;
            for (int p = 0; p < 2; p++) {
                const float dy = y[p] + 0.5f - g.y, u = g.l11 * dx + g.l12 * dy, w = g.l22 * dy;
                const float exponent = g.log2_opacity - u * u - w * w;
                if (!alive[p] || exponent < -LOG2_255) continue;
                const float alpha = fminf(power_of_two(exponent), MAX_ALPHA), weight = alpha * t[p], rest = t[p] - weight;
                if (!(rest > MIN_TRANSMITTANCE)) {  // a pixel that would fall to 1e-4 stops before
                    alive[p] = false;
                    continue;
                }
                c[p][0] += weight * g.r, c[p][1] += weight * g.g, c[p][2] += weight * g.b;
                t[p] = rest, final[p] = base + k, most = fmaxf(most, weight);
            }
            if (statistics) {
                for (int step = WARP / 2; step; step /= 2) most = fmaxf(most, __shfl_xor_sync(ALL, most, step));
                if (lane == 0 && most > 0.f) atomicMax((int *)max_weight + ids[warp][k], __float_as_int(most));
            }
        }
        __syncwarp();
    }
    int latest = final[0] > final[1] ? final[0] : final[1];
    for (int step = WARP / 2; step; step /= 2) latest = max(latest, __shfl_xor_sync(ALL, latest, step));
    if (lane == 0) block_last[4 * tile + warp] = latest;
    for (int p = 0; p < 2; p++) {
        if (x >= view.width || y[p] >= view.height) continue;
        const int at = y[p] * view.width + x;
        for (int i = 0; i < 3; i++) colour[i * plane + at] = c[p][i] + t[p] * options->background[i];
        last[at] = final[p];
    }
}

// Sum nine values over the lanes of a warp; lanes 0, 4, ..., 28 return the first eight, lane 1 the ninth.
__device__ __forceinline__ float sum_of_lanes(const float *v, int lane) {
    float a[4], b[2];
    const bool upper16 = lane & 16, upper8 = lane & 8, upper4 = lane & 4;
    for (int i = 0; i < 4; i++)
        a[i] = (upper16 ? v[i + 4] : v[i]) + __shfl_xor_sync(ALL, upper16 ? v[i] : v[i + 4], 16);
    for (int i = 0; i < 2; i++)
        b[i] = (upper8 ? a[i + 2] : a[i]) + __shfl_xor_sync(ALL, upper8 ? a[i] : a[i + 2], 8);
    float c = (upper4 ? b[1] : b[0]) + __shfl_xor_sync(ALL, upper4 ? b[0] : b[1], 4), ninth = v[8];
    for (int step = 2; step; step /= 2) c += __shfl_xor_sync(ALL, c, step);
    for (int step = 16; step; step /= 2) ninth += __shfl_xor_sync(ALL, ninth, step);
    return lane == 1 ? ninth : c;
}

// Four warps for each bucket of the lists, one for each block of the tiles in it. Adds to the moments (n, 9) of each
// Gaussian: of g = dL / d ln(alpha) the sums of g, g u, g w, g u u, g u w, g w w, then dL / dcolour.
extern "C" __global__ void blend_backward(const Step *step, const float4 *records, const int *listed, const int *starts,
                                          const void *tiles, int narrow, const float *colour, const float *gradient,
                                          int plane, const int *last, const int *block_last, const float4 *checkpoints,
                                          float *moments, const float *sums) {
    if (sums[OVERFLOW] != 0.f) return;
    __shared__ Record kept[4][BUCKET];
    __shared__ int ids[4][BUCKET], where[4][BUCKET];
    const int warp = threadIdx.x / WARP, lane = threadIdx.x % WARP;
    const Step &view = *step;
    const int total = starts[view.tiles_x * view.tiles_y], begin = blockIdx.x * BUCKET;
    if (begin >= total) return;
    int tile = -1, x = 0, y[2] = {}, final[2] = {-1, -1};
    float t[2], rest[2], v[2][3];
    bool looked_at = false;
    unsigned hits[BUCKET / WARP];
    for (int half = 0; half < BUCKET / WARP; half++) {
        const int place = half * WARP + lane, at = begin + place;
        const bool there = at < total;
        const int own = !there ? 0 : narrow ? ((const short *)tiles)[at] : ((const int *)tiles)[at];
        const int id = there ? listed[at] : 0;
        Record g{};
        bool hit = there && at <= block_last[4 * own + warp];
        if (there) g = load(records, id);
        hit = hit && touches(g, own % view.tiles_x * TILE + warp % 2 * BLOCK, own / view.tiles_x * TILE + warp / 2 * BLOCK);
        if (hit) kept[warp][place] = g, ids[warp][place] = id, where[warp][place] = own;
        hits[half] = __ballot_sync(ALL, hit);
    }
    __syncwarp();
    for (int half = 0; half < BUCKET / WARP; half++) {
        for (unsigned left = hits[half]; left; left &= left - 1) {
            const int k = half * WARP + __ffs(left) - 1;
            if (where[warp][k] != tile) {
                tile = where[warp][k];
                x = tile % view.tiles_x * TILE + warp % 2 * BLOCK + lane % BLOCK;
                const bool fresh = starts[tile] >= begin;
                bool any = false;
                for (int p = 0; p < 2; p++) {
                    y[p] = tile / view.tiles_x * TILE + warp / 2 * BLOCK + lane / BLOCK + 4 * p;
                    final[p] = -1, t[p] = 1.f, rest[p] = 0.f;
                    if (x >= view.width || y[p] >= view.height) continue;
                    const int pixel = y[p] * view.width + x;
                    final[p] = last[pixel];
                    float before[3] = {};
                    if (!fresh) {
                        const float4 c = checkpoints[begin / BUCKET * (TILE * TILE) + warp * (2 * WARP) + p * WARP + lane];
                        t[p] = c.x, before[0] = c.y, before[1] = c.z, before[2] = c.w;
                    }
                    for (int i = 0; i < 3; i++) {
                        v[p][i] = gradient[i * plane + pixel];
                        any = any || v[p][i] != 0.f;
                        rest[p] += v[p][i] * (colour[i * plane + pixel] - before[i]);  // all that is still to come
                    }
                }
                looked_at = __any_sync(ALL, any);
            }
            if (!looked_at) continue;
            const Record &g = kept[warp][k];
            const float dx = x + 0.5f - g.x;
            float m[MOMENTS] = {};
            bool some = false;
            for (int p = 0; p < 2; p++) {
                const float dy = y[p] + 0.5f - g.y, u = g.l11 * dx + g.l12 * dy, w = g.l22 * dy;
                const float exponent = g.log2_opacity - u * u - w * w;
                if (begin + k > final[p] || exponent < -LOG2_255) continue;
                some = true;
                const float raw = power_of_two(exponent), alpha = fminf(raw, MAX_ALPHA), weight = alpha * t[p];
                const float value = g.r * v[p][0] + g.g * v[p][1] + g.b * v[p][2];
                rest[p] -= weight * value;
                t[p] -= weight;
                for (int i = 0; i < 3; i++) m[6 + i] += weight * v[p][i];
                if (raw > MAX_ALPHA) continue;  // no gradient where alpha is clamped
                const float s = weight * value - __fdividef(alpha * rest[p], 1.f - alpha), su = s * u, sw = s * w;
                m[0] += s, m[1] += su, m[2] += sw, m[3] += su * u, m[4] += su * w, m[5] += sw * w;
            }
            if (g.frozen != 0.f || !__any_sync(ALL, some)) continue;
            const float sum = sum_of_lanes(m, lane);
            const int of = lane == 1 ? 8 : lane / 4;
            if (lane % 4 == 0 || lane == 1) atomicAdd(moments + (long long)ids[warp][k] * MOMENTS + of, sum);
        }
    }
}

// --- image loss ------------------------------------------------------------------------------------------------------

__device__ const float WINDOW[TAPS] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601173f,
                                       0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
__device__ __forceinline__ float sum_of_warp(float value) {
    for (int step = WARP / 2; step; step /= 2) value += __shfl_xor_sync(ALL, value, step);
    return value;
}

// The loss works on squares of pixels, one channel at a time, each thread on four neighbours: what it reads for one
// serves the next. Images are three planes.
constexpr int SQUARE = 32, WIDE = SQUARE + 2 * REACH, THREADS = 256, FOUR = 4;

struct Square {
    int x, y, channel;
};

__device__ __forceinline__ int num_squares(const Step &v) { return (v.tiles_x + 1) / 2 * ((v.tiles_y + 1) / 2) * 3; }

__device__ __forceinline__ Square square_of(const Step &v, int index) {
    const int across = (v.tiles_x + 1) / 2, of = index / 3;
    return {of % across * SQUARE, of / across * SQUARE, index % 3};
}

// Blur three maps along rows.
__device__ __forceinline__ void blur_rows(const float (*maps)[WIDE][WIDE + 1], float (*across)[WIDE][SQUARE + 1]) {
    constexpr int M = 3;
    for (int i = threadIdx.x; i < WIDE * (SQUARE / FOUR); i += THREADS) {
        const int row = i % WIDE, column = i / WIDE * FOUR;
        float sum[M][FOUR] = {};
        for (int j = 0; j < TAPS + FOUR - 1; j++)
            for (int m = 0; m < M; m++) {
                const float value = maps[m][row][column + j];
                for (int o = 0; o < FOUR; o++)
                    if (j - o >= 0 && j - o < TAPS) sum[m][o] += WINDOW[j - o] * value;
            }
        for (int m = 0; m < M; m++)
            for (int o = 0; o < FOUR; o++) across[m][row][column + o] = sum[m][o];
    }
}

// Blur M maps along a column of the square, at four rows from the given one.
template <int M>
__device__ __forceinline__ void blur_column(const float (*across)[WIDE][SQUARE + 1], int row, int column,
                                            float (*sum)[FOUR]) {
    for (int m = 0; m < M; m++)
        for (int o = 0; o < FOUR; o++) sum[m][o] = 0.f;
    for (int j = 0; j < TAPS + FOUR - 1; j++)
        for (int m = 0; m < M; m++) {
            const float value = across[m][row + j][column];
            for (int o = 0; o < FOUR; o++)
                if (j - o >= 0 && j - o < TAPS) sum[m][o] += WINDOW[j - o] * value;
        }
}

// Adds to the sums: the mask times Huber's loss, the mask times SSIM, and the mask, each over all channels. Writes the slopes
// of SSIM by the blurred image, its square and its product with the target: nine planes.
extern "C" __global__ void loss_slopes(const Step *step, const Options *options, const float *image, int plane,
                                       float *slopes, float *sums) {
    if (sums[OVERFLOW] != 0.f) return;
    __shared__ float across[5][WIDE][SQUARE + 1], maps[2][WIDE][WIDE + 1], total[3][THREADS / WARP];
    const Step &view = *step;
    const bool ssim = options->ssim_weight > 0.f;
    const float delta = options->huber_delta;
    float mine[3] = {};
    for (int index = blockIdx.x; index < num_squares(view); index += gridDim.x) {
        const Square at = square_of(view, index);
        const float *channel = image + at.channel * plane;
        const int column = threadIdx.x % SQUARE, row = threadIdx.x / SQUARE * FOUR, x = at.x + column;
        float sum[5][FOUR];
        if (ssim) {
            for (int i = threadIdx.x; i < WIDE * WIDE; i += THREADS) {
                const int px = at.x + i % WIDE - REACH, py = at.y + i / WIDE - REACH, pixel = py * view.width + px;
                const bool there = px >= 0 && px < view.width && py >= 0 && py < view.height;
                maps[0][i / WIDE][i % WIDE] = there ? channel[pixel] : 0.f;
                maps[1][i / WIDE][i % WIDE] = there ? target_at(view, 3 * pixel + at.channel) : 0.f;
            }
            __syncthreads();
            for (int i = threadIdx.x; i < WIDE * (SQUARE / FOUR); i += THREADS) {
                const int line = i % WIDE, first = i / WIDE * FOUR;
                float products[5][FOUR] = {};
                for (int j = 0; j < TAPS + FOUR - 1; j++) {
                    const float p = maps[0][line][first + j], q = maps[1][line][first + j];
                    const float values[5] = {p, q, p * p, q * q, p * q};
                    for (int o = 0; o < FOUR; o++)
                        for (int m = 0; m < 5; m++)
                            if (j - o >= 0 && j - o < TAPS) products[m][o] += WINDOW[j - o] * values[m];
                }
                for (int m = 0; m < 5; m++)
                    for (int o = 0; o < FOUR; o++) across[m][line][first + o] = products[m][o];
            }
            __syncthreads();
            blur_column<5>(across, row, column, sum);
        }
        for (int o = 0; o < FOUR; o++) {
            const int y = at.y + row + o, pixel = y * view.width + x;
            if (x >= view.width || y >= view.height) continue;
            const float w = mask_at(view, pixel);
            if (w == 0.f) {  // whatever the target is there
                if (ssim)
                    for (int m = 0; m < 3; m++) slopes[(3 * m + at.channel) * plane + pixel] = 0.f;
                continue;
            }
            const float d = fabsf(channel[pixel] - target_at(view, 3 * pixel + at.channel));
            mine[HUBER] += w * (d < delta ? d * d / (2.f * delta) : d - 0.5f * delta);
            mine[WEIGHT] += w;
            if (!ssim) continue;
            const float ma = sum[0][o], mb = sum[1][o], aa = sum[2][o], bb = sum[3][o], ab = sum[4][o];
            const float light = 2.f * ma * mb + 0.0001f, contrast = 2.f * (ab - ma * mb) + 0.0009f;
            const float light_norm = ma * ma + mb * mb + 0.0001f, contrast_norm = (aa - ma * ma) + (bb - mb * mb) + 0.0009f;
            const float inverse = 1.f / (light_norm * contrast_norm), value = light * contrast * inverse;
            const float by_ab = 2.f * light * inverse, by_aa = -value * inverse * light_norm;
            const float by_a = 2.f * mb * contrast * inverse - 2.f * ma * value * inverse * contrast_norm - by_ab * mb -
                               2.f * by_aa * ma;
            mine[SIMILAR] += w * value;
            float *to = slopes + at.channel * plane + pixel;
            to[0] = w * by_a, to[3 * plane] = w * by_aa, to[6 * plane] = w * by_ab;
        }
        if (ssim) __syncthreads();
    }
    for (int i = 0; i < 3; i++) {
        const float sum = sum_of_warp(mine[i]);
        if (threadIdx.x % WARP == 0) total[i][threadIdx.x / WARP] = sum;
    }
    __syncthreads();
    if (threadIdx.x < 3) {
        float sum = 0.f;
        for (int i = 0; i < THREADS / WARP; i++) sum += total[threadIdx.x][i];
        atomicAdd(sums + threadIdx.x, sum);
    }
}

// Writes the gradient of the loss divided by the number of views, and adds the loss to its sum.
extern "C" __global__ void loss_gradient(const Step *step, const Options *options, const float *image, int plane,
                                         const float *slopes, float *sums, float *gradient) {
    if (sums[OVERFLOW] != 0.f) return;
    __shared__ float across[3][WIDE][SQUARE + 1], maps[3][WIDE][WIDE + 1];
    const Step &view = *step;
    const float ssim = options->ssim_weight, delta = options->huber_delta;
    const float scale = (sums[WEIGHT] > 0.f ? 1.f / sums[WEIGHT] : 0.f) / options->views;
    if (blockIdx.x == 0 && threadIdx.x == 0)
        sums[LOSS] += scale * ((1.f - ssim) * sums[HUBER] + ssim * (sums[WEIGHT] - sums[SIMILAR]));  // 0 without weights
    for (int index = blockIdx.x; index < num_squares(view); index += gridDim.x) {
        const Square at = square_of(view, index);
        const int column = threadIdx.x % SQUARE, row = threadIdx.x / SQUARE * FOUR, x = at.x + column;
        float sum[3][FOUR];
        if (ssim > 0.f) {
            for (int i = threadIdx.x; i < WIDE * WIDE; i += THREADS) {
                const int px = at.x + i % WIDE - REACH, py = at.y + i / WIDE - REACH;
                const bool there = px >= 0 && px < view.width && py >= 0 && py < view.height;
                const float *from = slopes + at.channel * plane + py * view.width + px;
                for (int m = 0; m < 3; m++) maps[m][i / WIDE][i % WIDE] = there ? from[3 * m * plane] : 0.f;
            }
            __syncthreads();
            blur_rows(maps, across);
            __syncthreads();
            blur_column<3>(across, row, column, sum);
        }
        for (int o = 0; o < FOUR; o++) {
            const int y = at.y + row + o, pixel = y * view.width + x;
            if (x >= view.width || y >= view.height) continue;
            const float w = mask_at(view, pixel), p = image[at.channel * plane + pixel];
            float q = target_at(view, 3 * pixel + at.channel);
            if (w == 0.f && !isfinite(q)) q = 0.f;  // whatever the target is there
            const float d = p - q;
            const float slope = fabsf(d) < delta ? d / delta : d > 0.f ? 1.f : d < 0.f ? -1.f : 0.f;
            float out = (1.f - ssim) * w * slope;
            if (ssim > 0.f) out -= ssim * (sum[0][o] + 2.f * p * sum[1][o] + q * sum[2][o]);
            gradient[at.channel * plane + pixel] = scale > 0.f ? scale * out : 0.f;
        }
        if (ssim > 0.f) __syncthreads();
    }
}

// --- backwards to the Gaussians, and Adam ----------------------------------------------------------------------------

struct Gradient {
    float mean[3], quat[4], log_scale[3], logit;
};

// From a Gaussian's moments in one view to its gradients, which are added, and those of its coefficients (3 k).
__device__ void project_backward(const Step &view, int k, const float *mean, const float *quat, const float *log_scale,
                                 float logit, const float *coefficients, const float *m, Gradient &out, float *sh,
                                 float *mean2d) {
    double centred[3];
    float p[3], l11, l12, l22;
    centre(view, mean, centred);
    for (int i = 0; i < 3; i++) p[i] = float(centred[i]);
    Shape g;
    shape(view, p, quat, log_scale, g);
    cholesky(g, l11, l12, l22);

    out.logit += m[0] / (1.f + expf(logit));  // d ln(o) / d logit = 1 - o
    const float gx = 2.f * LN2 * l11 * m[1], gy = 2.f * LN2 * (l12 * m[1] + l22 * m[2]);
    mean2d[0] = gx, mean2d[1] = gy;
    // dL/dSigma = P M P / 2 with P = 2 ln2 L^T L, M the second moments
    const float h = 2.f * LN2 * LN2, b1 = l12 * m[3] + l22 * m[4], b2 = l12 * m[4] + l22 * m[5];
    const float ga = h * l11 * l11 * m[3], gb = h * l11 * b1, gc = h * (l12 * b1 + l22 * b2);
    float g1[3], g2[3], gR[9], r1[3], r2[3];
    for (int i = 0; i < 3; i++) {
        const float y1 = g.t[i] * g.s[i], y2 = g.p[i] * g.s[i];
        const float d1 = 2.f * (ga * y1 + gb * y2), d2 = 2.f * (gb * y1 + gc * y2);
        out.log_scale[i] += d1 * y1 + d2 * y2;
        g1[i] = d1 * g.s[i], g2[i] = d2 * g.s[i];
    }
    for (int j = 0; j < 3; j++) {
        for (int i = 0; i < 3; i++) gR[3 * j + i] = g1[i] * g.r1[j] + g2[i] * g.r2[j];
        r1[j] = g1[0] * g.R[3 * j] + g1[1] * g.R[3 * j + 1] + g1[2] * g.R[3 * j + 2];
        r2[j] = g2[0] * g.R[3 * j] + g2[1] * g.R[3 * j + 1] + g2[2] * g.R[3 * j + 2];
    }
    const float w = g.q[0], x = g.q[1], y = g.q[2], z = g.q[3];
    const float d[4] = {
        2.f * (x * (gR[7] - gR[5]) + y * (gR[2] - gR[6]) + z * (gR[3] - gR[1])),
        2.f * (y * (gR[1] + gR[3]) + z * (gR[2] + gR[6]) + w * (gR[7] - gR[5]) - 2.f * x * (gR[4] + gR[8])),
        2.f * (x * (gR[1] + gR[3]) + z * (gR[5] + gR[7]) + w * (gR[2] - gR[6]) - 2.f * y * (gR[0] + gR[8])),
        2.f * (x * (gR[2] + gR[6]) + y * (gR[5] + gR[7]) + w * (gR[3] - gR[1]) - 2.f * z * (gR[0] + gR[4]))};
    const float turn = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
    for (int i = 0; i < 4; i++) out.quat[i] += (d[i] - turn * g.q[i]) * g.inverse_norm;

    // r1 = fx/z (R0 - ux R2) with ux = x/z, held where it is clamped
    const Clamp limit = clamp_of(view);
    const float x_z = p[0] * g.rz, y_z = p[1] * g.rz;
    const float R6 = float(view.R[6]), R7 = float(view.R[7]), R8 = float(view.R[8]);
    const float gux = x_z >= limit.min_ux && x_z <= limit.max_ux ? -g.jx * (r1[0] * R6 + r1[1] * R7 + r1[2] * R8) : 0.f;
    const float guy = y_z >= limit.min_uy && y_z <= limit.max_uy ? -g.jy * (r2[0] * R6 + r2[1] * R7 + r2[2] * R8) : 0.f;
    const float shrink = r1[0] * g.r1[0] + r1[1] * g.r1[1] + r1[2] * g.r1[2] + r2[0] * g.r2[0] + r2[1] * g.r2[1] + r2[2] * g.r2[2];
    const float gp[3] = {g.rz * (gx * float(view.fx) + gux), g.rz * (gy * float(view.fy) + guy),
                         -g.rz * (shrink + gux * g.ux + guy * g.uy + gx * g.jx * p[0] + gy * g.jy * p[1])};
    for (int j = 0; j < 3; j++)
        out.mean[j] += float(view.R[j]) * gp[0] + float(view.R[3 + j]) * gp[1] + float(view.R[6 + j]) * gp[2];

    // colour = max(0, SH(d / |d|) + 0.5), d = mean - centre
    float dir[3], basis[16], colour[3], weight[16], gd[3];
    const float r = direction(view, p, dir);
    sh_basis(k, dir[0], dir[1], dir[2], basis);
    for (int c = 0; c < 3; c++) {
        float value = 0.5f;
        for (int j = 0; j < k; j++) value += basis[j] * coefficients[3 * j + c];
        colour[c] = value > 0.f ? m[6 + c] : 0.f;
    }
    for (int j = 0; j < k; j++) {
        weight[j] = 0.f;
        for (int c = 0; c < 3; c++) sh[3 * j + c] += basis[j] * colour[c], weight[j] += coefficients[3 * j + c] * colour[c];
    }
    sh_basis_backward(k, dir[0], dir[1], dir[2], weight, gd);
    const float along = gd[0] * dir[0] + gd[1] * dir[1] + gd[2] * dir[2];
    for (int j = 0; j < 3; j++) out.mean[j] += (gd[j] - along * dir[j]) * r;
}

struct Adam {
    const float *first, *second;  // corrections of each lane's Gaussian
    const float *gradients;       // a row of each lane's Gaussian
    float beta1, beta2, epsilon;
    int row;
    unsigned lanes;  // whose Gaussians are updated

    // Updates one attribute of the warp's Gaussians, side by side in memory.
    template <class Count>
    __device__ __forceinline__ void update(Count columns, float *values, float *means, float *squares, long long from,
                                           int place, float rate, float rate_rest) const {
        constexpr int AHEAD = 4;  // so many values are read before the first is needed
        for (int first_of = threadIdx.x % WARP; first_of < WARP * columns; first_of += AHEAD * WARP) {
            float m[AHEAD], v[AHEAD], p[AHEAD];
            bool on[AHEAD];
            for (int a = 0; a < AHEAD; a++) {
                const int i = first_of + a * WARP;
                on[a] = i < WARP * columns && lanes >> (i / columns) & 1;
                if (!on[a]) continue;
                const long long at = from * columns + i;
                m[a] = means[at], v[a] = squares[at], p[a] = values[at];
            }
            for (int a = 0; a < AHEAD; a++) {
                if (!on[a]) continue;
                const int i = first_of + a * WARP, of = i / columns, column = i % columns;
                const long long at = from * columns + i;
                const float g = gradients[of * row + place + column];
                const float mean = beta1 * m[a] + (1.f - beta1) * g, square = beta2 * v[a] + (1.f - beta2) * g * g;
                const float step = (column < 3 ? rate : rate_rest) * first[of] * mean;
                means[at] = mean, squares[at] = square;
                values[at] = p[a] - step / (sqrtf(square) * second[of] + epsilon);
            }
        }
    }
};

template <int N> struct Constant {
    __device__ constexpr operator int() const { return N; }
};

// One thread for each Gaussian: from the moments in all views, which are set to zero, to an Adam update of those that
// any view saw. Shared memory: 32 * (3 num_sh + 1 + 3 num_sh + 12 + 2) floats for each warp.
extern "C" __global__ void __launch_bounds__(64, 8) update(const Step *steps, const Options *options, const float *corrections, int n, int num_sh,
                                  float *moments, int *updates, float *means, float *quats, float *log_scales,
                                  float *logits, float *sh, float *m_means, float *m_quats, float *m_scales,
                                  float *m_logits, float *m_sh, float *v_means, float *v_quats, float *v_scales,
                                  float *v_logits, float *v_sh, float *gradient_norm, int *seen, const float *sums) {
    if (sums[OVERFLOW] != 0.f) return;
    SHARED_FLOATS(staged);
    const int k = NUM_SH, id = blockIdx.x * blockDim.x + threadIdx.x, lane = threadIdx.x % WARP;
    const int row = 3 * k + 1, gradient_row = 11 + 3 * k | 1;
    float *sh_here = staged + (threadIdx.x / WARP) * WARP * (row + gradient_row + 2), *gradients = sh_here + WARP * row;
    float *first_here = gradients + WARP * gradient_row, *second_here = first_here + WARP;

    // All that does not depend on anything is read at once.
    bool touched = false;
    float mean[3] = {}, quat[4] = {}, log_scale[3] = {}, logit = 0.f;
    int count = 0;
    if (id < n) {
        for (int v = 0; v < options->views; v++)
            for (int i = 0; i < MOMENTS; i++) touched |= moments[((long long)v * n + id) * MOMENTS + i] != 0.f;
        for (int i = 0; i < 3; i++) mean[i] = means[3 * id + i], log_scale[i] = log_scales[3 * id + i];
        for (int i = 0; i < 4; i++) quat[i] = quats[4 * id + i];
        logit = logits[id], count = updates[id] + 1;
    }
    const unsigned lanes = __ballot_sync(ALL, touched);
    if (!lanes) return;
    const float *coefficients = sh + 3ll * k * (id - lane);
    for (int i = lane; i < WARP * 3 * k; i += WARP)
        if (lanes >> (i / (3 * k)) & 1) sh_here[i / (3 * k) * row + i % (3 * k)] = coefficients[i];
    __syncwarp();
    if (touched) {
        Gradient g{};
        float m[MOMENTS], mean2d[2], *mine = gradients + lane * gradient_row;
        const int at = count < options->last_correction ? count : options->last_correction;
        updates[id] = count, first_here[lane] = corrections[2 * at], second_here[lane] = corrections[2 * at + 1];
        for (int i = 0; i < 3 * k; i++) mine[11 + i] = 0.f;
        for (int v = 0; v < options->views; v++) {
            bool here = false;
            for (int i = 0; i < MOMENTS; i++) {
                float &moment = moments[((long long)v * n + id) * MOMENTS + i];
                m[i] = moment, here = here || m[i] != 0.f, moment = 0.f;
            }
            if (!here) continue;
            project_backward(steps[v], k, mean, quat, log_scale, logit, sh_here + lane * row, m, g, mine + 11, mean2d);
            if (options->statistics) {
                const float across = mean2d[0] * 0.5f * steps[v].width, down = mean2d[1] * 0.5f * steps[v].height;
                gradient_norm[id] += sqrtf(across * across + down * down);
                seen[id]++;
            }
        }
        for (int i = 0; i < 3; i++) mine[i] = g.mean[i], mine[7 + i] = g.log_scale[i];
        for (int i = 0; i < 4; i++) mine[3 + i] = g.quat[i];
        mine[10] = g.logit;
    }
    __syncwarp();
    const float *rates = options->rates;
    const Adam adam{first_here,      second_here,      gradients, options->beta1,
                    options->beta2, options->epsilon, gradient_row, lanes};
    const long long from = id - lane;
    adam.update(Constant<3>(), means, m_means, v_means, from, 0, rates[0], rates[0]);
    adam.update(Constant<4>(), quats, m_quats, v_quats, from, 3, rates[1], rates[1]);
    adam.update(Constant<3>(), log_scales, m_scales, v_scales, from, 7, rates[2], rates[2]);
    adam.update(Constant<1>(), logits, m_logits, v_logits, from, 10, rates[3], rates[3]);
    adam.update(3 * k, sh, m_sh, v_sh, from, 11, rates[4], rates[5]);
}
