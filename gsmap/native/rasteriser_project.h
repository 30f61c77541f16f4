// Projection of Gaussians to the image and back. Conventions and clamps follow gsplat's fully fused projection.
#pragma once
#include "rasteriser.h"
#include "rasteriser_sh.h"
#include "simd.h"

namespace GSMAP_ISA {
using namespace gsmap;

constexpr float kLn2 = 0.693147180559945309f;
constexpr float kMaxSigmas = 3.3290429f;  // sqrt(2 ln 255): beyond it alpha < 1/255 whatever the opacity
constexpr int kPadded = kChunk + 16;      // not a multiple of 4 KiB, so that the arrays do not alias in L1

struct ProjectScratch {
    alignas(64) float xc[kPadded], yc[kPadded], zc[kPadded], x[kPadded], y[kPadded], size[kPadded];
    int32_t visible[kPadded];
};

struct View {  // the camera in floats, broadcast
    V r[9], t[3], fx, fy, min_ux, max_ux, min_uy, max_uy;
    explicit View(const Camera &c) {
        for (int i = 0; i < 9; i++) r[i] = set1(float(c.R[i]));
        for (int i = 0; i < 3; i++) t[i] = set1(float(c.t[i]));
        fx = set1(float(c.fx)), fy = set1(float(c.fy));
        // x/z is clamped 30 % of the field of view outside the image where the Jacobian is taken
        const double mx = 0.15 * c.width / c.fx, my = 0.15 * c.height / c.fy;
        min_ux = set1(float(-(c.cx / c.fx + mx))), max_ux = set1(float((c.width - c.cx) / c.fx + mx));
        min_uy = set1(float(-(c.cy / c.fy + my))), max_uy = set1(float((c.height - c.cy) / c.fy + my));
    }
};

struct Shape {  // of W Gaussians, and what the backward pass needs of how it came about
    V q[4], inverse_norm, R[9], s[3], rz, ux, uy, r1[3], r2[3], t[3], p[3];
    V a, b, c, det;  // 2D covariance, dilated
};

INLINE void rotation(const V *raw, Shape &g) {
    const V n2 = raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3];
    const M good = gt(n2, set1(1e-30f));  // a zero quaternion is the identity
    g.inverse_norm = zero_unless(good, set1(1.f) / sqrt(n2));
    g.q[0] = select(good, raw[0] * g.inverse_norm, set1(1.f));
    for (int i = 1; i < 4; i++) g.q[i] = raw[i] * g.inverse_norm;
    const V w = g.q[0], x = g.q[1], y = g.q[2], z = g.q[3];
    g.R[0] = 1.f - 2.f * (y * y + z * z), g.R[1] = 2.f * (x * y - w * z), g.R[2] = 2.f * (x * z + w * y);
    g.R[3] = 2.f * (x * y + w * z), g.R[4] = 1.f - 2.f * (x * x + z * z), g.R[5] = 2.f * (y * z - w * x);
    g.R[6] = 2.f * (x * z - w * y), g.R[7] = 2.f * (y * z + w * x), g.R[8] = 1.f - 2.f * (x * x + y * y);
}

// Fills g from camera-space centre (xc, yc, zc), raw quaternion and log-scales.
INLINE void shape(const View &view, V xc, V yc, V zc, const V *quat, const V *log_scale, Shape &g) {
    rotation(quat, g);
    for (int i = 0; i < 3; i++) g.s[i] = exp(log_scale[i]);
    g.rz = set1(1.f) / zc;
    g.ux = min(max(xc * g.rz, view.min_ux), view.max_ux);
    g.uy = min(max(yc * g.rz, view.min_uy), view.max_uy);
    const V jx = view.fx * g.rz, jy = view.fy * g.rz;
    for (int i = 0; i < 3; i++) {  // rows of J R_camera_world
        g.r1[i] = jx * fnma(g.ux, view.r[6 + i], view.r[i]);
        g.r2[i] = jy * fnma(g.uy, view.r[6 + i], view.r[3 + i]);
    }
    for (int i = 0; i < 3; i++) {  // times the columns of R: t_i, p_i
        g.t[i] = fma(g.r1[0], g.R[i], fma(g.r1[1], g.R[3 + i], g.r1[2] * g.R[6 + i]));
        g.p[i] = fma(g.r2[0], g.R[i], fma(g.r2[1], g.R[3 + i], g.r2[2] * g.R[6 + i]));
    }
    const V t0 = g.t[0] * g.s[0], t1 = g.t[1] * g.s[1], t2 = g.t[2] * g.s[2];
    const V p0 = g.p[0] * g.s[0], p1 = g.p[1] * g.s[1], p2 = g.p[2] * g.s[2];
    const V a0 = fma(t0, t0, fma(t1, t1, t2 * t2)), c0 = fma(p0, p0, fma(p1, p1, p2 * p2));
    g.b = fma(t0, p0, fma(t1, p1, t2 * p2));
    g.a = a0 + kDilation, g.c = c0 + kDilation;
    // det(Sigma + d I) = det(Sigma) + d tr(Sigma) + d^2, and det(Sigma) as a sum of squared minors (Cauchy-Binet):
    // a * c - b * b would cancel for thin Gaussians.
    const V m0 = fnma(t2, p1, t1 * p2), m1 = fnma(t0, p2, t2 * p0), m2 = fnma(t1, p0, t0 * p1);
    g.det = fma(m0, m0, fma(m1, m1, fma(m2, m2, kDilation * (a0 + c0) + kDilation * kDilation)));
}

// Camera-space centres and image positions of a chunk, in double until the subtractions are done.
INLINE void centres(const Scene &scene, const Camera &camera, int64_t begin, int n, ProjectScratch &s) {
    const float *m = scene.means + 3 * begin;
    const double *R = camera.R, *t = camera.t;
    for (int i = 0; i < n; i++) {
        const double mx = m[3 * i], my = m[3 * i + 1], mz = m[3 * i + 2];
        const double x = R[0] * mx + R[1] * my + R[2] * mz + t[0];
        const double y = R[3] * mx + R[4] * my + R[5] * mz + t[1];
        const double z = R[6] * mx + R[7] * my + R[8] * mz + t[2];
        const double rz = 1.0 / z;
        s.xc[i] = float(x), s.yc[i] = float(y), s.zc[i] = float(z);
        s.x[i] = float(camera.fx * x * rz + camera.cx), s.y[i] = float(camera.fy * y * rz + camera.cy);
    }
    const float *ls = scene.log_scales + 3 * begin;
    for (int i = 0; i < n; i++) {
        const float a = ls[3 * i], b = ls[3 * i + 1], c = ls[3 * i + 2];
        const float ab = a > b ? a : b;
        s.size[i] = ab > c ? ab : c;
    }
}

// Indices (within the chunk) of what may touch the image: a bound by the largest scale, never wrong, sometimes loose.
INLINE int cull(const View &view, const Camera &camera, int n, ProjectScratch &s) {
    int count = 0;
    const V width = set1(float(camera.width)), height = set1(float(camera.height));
    const V ux = max(abs(view.min_ux), abs(view.max_ux)), uy = max(abs(view.min_uy), abs(view.max_uy));
    const V gx = (1.f + ux * ux) * view.fx * view.fx, gy = (1.f + uy * uy) * view.fy * view.fy;
    for (int i = 0; i < n; i += W) {
        const V z = load(s.zc + i), x = load(s.x + i), y = load(s.y + i);
        M live = both(gt(z, set1(kNear)), both(lt(z, set1(1e10f)), first_lanes(n - i)));
        const V sr = exp(load(s.size + i)) / z, sr2 = sr * sr;
        const V rx = kMaxSigmas * sqrt(fma(gx, sr2, set1(kDilation))) + 1.f;
        const V ry = kMaxSigmas * sqrt(fma(gy, sr2, set1(kDilation))) + 1.f;
        live = both(live, both(gt(x + rx, V{}), lt(x - rx, width)));
        live = both(live, both(gt(y + ry, V{}), lt(y - ry, height)));
        for (uint32_t m = bits(live); m; m &= m - 1) s.visible[count++] = i + __builtin_ctz(m);
    }
    return count;
}

INLINE V pick(const float *array, const int32_t *index) {
    alignas(64) float lane[W];
    for (int l = 0; l < W; l++) lane[l] = array[index[l]];
    return load(lane);
}

int project(const Scene &scene, const Camera &camera, int64_t begin, int64_t end, Record *out) {
    ProjectScratch s;
    const View view(camera);
    const int n = int(end - begin);
    centres(scene, camera, begin, n, s);
    const int visible = cull(view, camera, n, s);
    if (!visible) return 0;
    for (int i = visible; i < visible + W; i++) s.visible[i] = s.visible[visible - 1];
    const int tiles_x = (camera.width + kTile - 1) / kTile, tiles_y = (camera.height + kTile - 1) / kTile;

    int count = 0;
    for (int first = 0; first < visible; first += W) {
        const int32_t *index = s.visible + first;
        const float *quat[W], *scale[W], *sh[W];
        alignas(64) float logit[W];
        for (int l = 0; l < W; l++) {
            const int64_t id = begin + index[l];
            quat[l] = scene.quats + 4 * id, scale[l] = scene.log_scales + 3 * id, sh[l] = scene.sh + 3 * scene.k * id;
            logit[l] = scene.logit_opacities[id];
        }
        V q[4], ls[3], coefficients[48];
        load_rows(quat, 4, q);
        load_rows(scale, 3, ls);
        load_rows(sh, 3 * scene.k, coefficients);
        const V xc = pick(s.xc, index), yc = pick(s.yc, index), zc = pick(s.zc, index);
        const V x = pick(s.x, index), y = pick(s.y, index);

        Shape g;
        shape(view, xc, yc, zc, q, ls, g);
        // log2 sigmoid(v) = -log2(1 + e^-v), from the side where the exponential cannot overflow
        const V v = load(logit), e = exp(V{} - abs(v));
        const V log2_opacity = min(v, V{}) * (1 / kLn2) - log2(1.f + e);
        const V reach = log2_opacity + 7.99435343685886f;  // log2 255: how far the exponent may fall
        const V k = max(reach, V{}) * (2 * kLn2);
        const V ex = sqrt(k * g.a), ey = sqrt(k * g.c);

        V colour[3];
        const V dx = fma(view.r[0], xc, fma(view.r[3], yc, view.r[6] * zc));
        const V dy = fma(view.r[1], xc, fma(view.r[4], yc, view.r[7] * zc));
        const V dz = fma(view.r[2], xc, fma(view.r[5], yc, view.r[8] * zc));
        sh_colour(scene.k, dx, dy, dz, coefficients, colour);

        // NaN and overflow anywhere: not drawn. A scale of zero is fine, it leaves the dilation.
        const V norm2 = fma(q[0], q[0], fma(q[1], q[1], fma(q[2], q[2], q[3] * q[3])));
        M live = both(first_lanes(visible - first), both(gt(reach, V{}), gt(g.det, V{})));
        const V values[] = {g.a, g.b, g.c, g.det, norm2, colour[0], colour[1], colour[2]};
        for (const V value : values) live = both(live, finite(value));
        for (const V value : ls) live = both(live, lt(value, set1(80.f)));
        live = both(live, ge(v, v));  // min and exp may lose a NaN

        V record[kFields];
        const V l11 = sqrt(g.c / g.det * (0.5f / kLn2));
        record[X] = x, record[Y] = y;
        record[L11] = l11, record[L12] = V{} - g.b / g.c * l11, record[L22] = sqrt(set1(0.5f / kLn2) / g.c);
        record[LOG2_OPACITY] = log2_opacity;
        for (int i = 0; i < 3; i++) record[R + i] = max(colour[i], V{});
        record[DEPTH] = zc;
        alignas(64) float x0[W], x1[W], y0[W], y1[W];
        store(x0, x - ex), store(x1, x + ex), store(y0, y - ey), store(y1, y + ey);
        for (int i = ID; i < kFields; i++) record[i] = V{};
        alignas(64) float rows[W][kFields];
        for (int f = 0; f < kFields; f += W) {
            transpose(record + f);
            for (int l = 0; l < W; l++) storeu(&rows[l][f], record[f + l]);
        }
        for (uint32_t m = bits(live); m; m &= m - 1) {
            const int l = __builtin_ctz(m);
            // first and last pixel whose centre is in reach, clamped to the image before they become integers
            const float left = __builtin_fmaxf(x0[l] - 0.5f, -1.f), right = __builtin_fminf(x1[l] - 0.5f, camera.width);
            const float top = __builtin_fmaxf(y0[l] - 0.5f, -1.f), bottom = __builtin_fminf(y1[l] - 0.5f, camera.height);
            const int px0 = int(__builtin_ceilf(left)), px1 = int(__builtin_floorf(right));
            const int py0 = int(__builtin_ceilf(top)), py1 = int(__builtin_floorf(bottom));
            if (px0 > px1 || py0 > py1 || px1 < 0 || py1 < 0 || px0 >= camera.width || py0 >= camera.height) continue;
            Record &r = out[count++];
            __builtin_memcpy(&r, rows[l], sizeof(Record));
            r.id = uint32_t(begin + index[l]);
            r.tx0 = uint16_t((px0 < 0 ? 0 : px0) / kTile), r.ty0 = uint16_t((py0 < 0 ? 0 : py0) / kTile);
            const int tx1 = px1 / kTile + 1, ty1 = py1 / kTile + 1;
            r.tx1 = uint16_t(tx1 < tiles_x ? tx1 : tiles_x), r.ty1 = uint16_t(ty1 < tiles_y ? ty1 : tiles_y);
        }
    }
    return count;
}

}  // namespace GSMAP_ISA
