// The reverse of rasteriser_project.h: from sums over pixels to gradients of the scene and of the camera pose.
#pragma once
#include "rasteriser_project.h"

namespace GSMAP_ISA {

// Gradients of everything one group of W Gaussians depends on.
struct GroupGradient {
    V mean[3], quat[4], log_scale[3], logit, sh[48];
    V Rc[9], tc[3];  // camera pose
};

INLINE void rotation_backward(const Shape &g, const V *gR, V *out) {
    const V w = g.q[0], x = g.q[1], y = g.q[2], z = g.q[3];
    V d[4];
    d[0] = 2.f * (x * (gR[7] - gR[5]) + y * (gR[2] - gR[6]) + z * (gR[3] - gR[1]));
    d[1] = 2.f * (y * (gR[1] + gR[3]) + z * (gR[2] + gR[6]) + w * (gR[7] - gR[5]) - 2.f * x * (gR[4] + gR[8]));
    d[2] = 2.f * (x * (gR[1] + gR[3]) + z * (gR[5] + gR[7]) + w * (gR[2] - gR[6]) - 2.f * y * (gR[0] + gR[8]));
    d[3] = 2.f * (x * (gR[2] + gR[6]) + y * (gR[5] + gR[7]) + w * (gR[3] - gR[1]) - 2.f * z * (gR[0] + gR[4]));
    const V along = fma(d[0], w, fma(d[1], x, fma(d[2], y, d[3] * z)));
    for (int i = 0; i < 4; i++) out[i] = fnma(along, g.q[i], d[i]) * g.inverse_norm;
}

// m: the kMoments sums; rec: the records' fields; the rest as in project().
INLINE void group_backward(const Scene &scene, const View &view, const V *mean, const V *quat, const V *log_scale,
                           V logit, const V *coefficients, const V *rec, const V *m, GroupGradient &out, V *mean2d) {
    const V *Rc = view.r;
    V p[3];
    for (int i = 0; i < 3; i++)
        p[i] = fma(Rc[3 * i], mean[0], fma(Rc[3 * i + 1], mean[1], fma(Rc[3 * i + 2], mean[2], view.t[i])));
    Shape g;
    shape(view, p[0], p[1], rec[DEPTH], quat, log_scale, g);

    // ln(alpha) = ln(o) - ln2 (u^2 + w^2), (u, w) = L d
    const V l11 = rec[L11], l12 = rec[L12], l22 = rec[L22];
    out.logit = m[M_G] / (1.f + exp(logit));  // d ln(o) / d logit = 1 - o
    const V gx = 2.f * kLn2 * l11 * m[M_U], gy = 2.f * kLn2 * fma(l12, m[M_U], l22 * m[M_W]);
    mean2d[0] = gx, mean2d[1] = gy;
    // dL/dSigma = P M P / 2 with P = 2 ln2 L^T L, M the second moments of d
    const V h = set1(2.f * kLn2 * kLn2), b1 = fma(l12, m[M_UU], l22 * m[M_UW]), b2 = fma(l12, m[M_UW], l22 * m[M_WW]);
    const V ga = h * l11 * l11 * m[M_UU], gb = h * l11 * b1, gc = h * fma(l12, b1, l22 * b2);

    V g1[3], g2[3];
    for (int i = 0; i < 3; i++) {
        const V y1 = g.t[i] * g.s[i], y2 = g.p[i] * g.s[i];
        const V d1 = 2.f * fma(ga, y1, gb * y2), d2 = 2.f * fma(gb, y1, gc * y2);
        out.log_scale[i] = fma(d1, y1, d2 * y2);
        g1[i] = d1 * g.s[i], g2[i] = d2 * g.s[i];
    }
    V gR[9], r1[3], r2[3];
    for (int j = 0; j < 3; j++) {
        for (int i = 0; i < 3; i++) gR[3 * j + i] = fma(g1[i], g.r1[j], g2[i] * g.r2[j]);
        r1[j] = fma(g1[0], g.R[3 * j], fma(g1[1], g.R[3 * j + 1], g1[2] * g.R[3 * j + 2]));
        r2[j] = fma(g2[0], g.R[3 * j], fma(g2[1], g.R[3 * j + 1], g2[2] * g.R[3 * j + 2]));
    }
    rotation_backward(g, gR, out.quat);

    // r1 = fx/z (Rc0 - ux Rc2) with ux = x/z, held where it is clamped
    const V jx = view.fx * g.rz, jy = view.fy * g.rz;
    const V x_z = p[0] * g.rz, y_z = p[1] * g.rz;
    const V gux = zero_unless(both(ge(x_z, view.min_ux), ge(view.max_ux, x_z)),
                              V{} - jx * fma(r1[0], Rc[6], fma(r1[1], Rc[7], r1[2] * Rc[8])));
    const V guy = zero_unless(both(ge(y_z, view.min_uy), ge(view.max_uy, y_z)),
                              V{} - jy * fma(r2[0], Rc[6], fma(r2[1], Rc[7], r2[2] * Rc[8])));
    V gp[3];
    gp[0] = g.rz * fma(gx, view.fx, gux);
    gp[1] = g.rz * fma(gy, view.fy, guy);
    const V shrink = fma(r1[0], g.r1[0], fma(r1[1], g.r1[1], r1[2] * g.r1[2])) +
                     fma(r2[0], g.r2[0], fma(r2[1], g.r2[1], r2[2] * g.r2[2]));
    gp[2] = m[M_DEPTH] - g.rz * (shrink + gux * g.ux + guy * g.uy + gx * jx * p[0] + gy * jy * p[1]);
    for (int j = 0; j < 3; j++) {
        out.Rc[j] = fma(gp[0], mean[j], jx * r1[j]);
        out.Rc[3 + j] = fma(gp[1], mean[j], jy * r2[j]);
        out.Rc[6 + j] = fma(gp[2], mean[j], V{} - fma(jx * g.ux, r1[j], jy * g.uy * r2[j]));
        out.tc[j] = gp[j];
        out.mean[j] = fma(Rc[j], gp[0], fma(Rc[3 + j], gp[1], Rc[6 + j] * gp[2]));
    }

    // colour = max(0, SH(d / |d|) + 0.5), d = mean - centre = mean + Rc^T t
    const V zero{}, gcol[3] = {zero_unless(gt(rec[R], zero), m[M_R]), zero_unless(gt(rec[G], zero), m[M_GREEN]),
                               zero_unless(gt(rec[B], zero), m[M_B])};
    V d[3], basis[16];
    for (int j = 0; j < 3; j++) d[j] = fma(Rc[j], p[0], fma(Rc[3 + j], p[1], Rc[6 + j] * p[2]));
    const V r = set1(1.f) / sqrt(fma(d[0], d[0], fma(d[1], d[1], d[2] * d[2])));
    for (int j = 0; j < 3; j++) d[j] *= r;
    sh_basis(scene.k, d[0], d[1], d[2], basis);
    for (int j = 0; j < scene.k; j++)
        for (int c = 0; c < 3; c++) out.sh[3 * j + c] = basis[j] * gcol[c];
    if (scene.k > 1) {
        V weight[16], gd[3];
        for (int j = 0; j < scene.k; j++)
            weight[j] = fma(coefficients[3 * j], gcol[0],
                            fma(coefficients[3 * j + 1], gcol[1], coefficients[3 * j + 2] * gcol[2]));
        sh_basis_backward(scene.k, d[0], d[1], d[2], weight, gd);
        const V along = fma(gd[0], d[0], fma(gd[1], d[1], gd[2] * d[2]));
        for (int j = 0; j < 3; j++) gd[j] = fnma(along, d[j], gd[j]) * r;
        for (int j = 0; j < 3; j++) {
            out.mean[j] += gd[j];
            out.tc[j] += fma(Rc[3 * j], gd[0], fma(Rc[3 * j + 1], gd[1], Rc[3 * j + 2] * gd[2]));
            for (int i = 0; i < 3; i++) out.Rc[3 * j + i] += view.t[j] * gd[i];
        }
    }
}

// Sums a Gaussian's slots over its tiles; false where they are all zero: hidden, nothing to add.
INLINE bool sum_slots(const Record &record, const float *slots, float *moments) {
    V sum[kMoments / W] = {};
    const float *slot = slots + int64_t(record.slot) * kMoments;
    for (uint32_t s = record.tiles(); s; s--, slot += kMoments)
        for (int i = 0; i < kMoments / W; i++) sum[i] += load(slot + i * W);
    bool some = false;
    for (int i = 0; i < kMoments / W; i++) {
        some |= any(gt(abs(sum[i]), V{}));
        store(moments + i * W, sum[i]);
    }
    return some;
}

// Up to W Gaussians whose moments are not zero.
struct Group {
    int rows = 0;
    const Record *record[W];
    alignas(64) float moments[W][kMoments];
};

void finish_group(const Scene &scene, const View &view, Group &group, const SceneGradient &gradient, V *pose) {
    const int rows = group.rows, k3 = 3 * scene.k;
    for (int l = rows; l < W; l++) {  // repeat the last one with zero weight
        group.record[l] = group.record[rows - 1];
        for (int i = 0; i < kMoments; i++) group.moments[l][i] = 0.f;
    }
    group.rows = 0;
    const float *mean[W], *quat[W], *scale[W], *sh[W], *record[W], *moment[W];
    alignas(64) float logit[W];
    int64_t id[W];
    for (int l = 0; l < W; l++) {
        id[l] = group.record[l]->id;
        mean[l] = scene.means + 3 * id[l], quat[l] = scene.quats + 4 * id[l], scale[l] = scene.log_scales + 3 * id[l];
        sh[l] = scene.sh + k3 * id[l], logit[l] = scene.logit_opacities[id[l]];
        record[l] = &group.record[l]->x, moment[l] = group.moments[l];
    }
    V means[3], quats[4], log_scales[3], coefficients[48], fields[kFields], moments[kMoments], mean2d[2];
    load_rows(mean, 3, means);
    load_rows(quat, 4, quats);
    load_rows(scale, 3, log_scales);
    load_rows(sh, k3, coefficients);
    load_rows(record, kFields, fields);
    load_rows(moment, kMoments, moments);
    GroupGradient g;
    group_backward(scene, view, means, quats, log_scales, load(logit), coefficients, fields, moments, g, mean2d);
    if (pose) {
        for (int i = 0; i < 9; i++) pose[i] += g.Rc[i];
        for (int i = 0; i < 3; i++) pose[9 + i] += g.tc[i];
    }
    const auto add = [&](float *array, V *values, int cols) {
        float *row[W];
        for (int l = 0; l < rows; l++) row[l] = array + cols * (id[l] - gradient.first);
        add_to_rows(values, cols, row, rows);
    };
    if (!gradient.means) return;  // only the pose is wanted
    add(gradient.means, g.mean, 3);
    add(gradient.quats, g.quat, 4);
    add(gradient.log_scales, g.log_scale, 3);
    add(gradient.logit_opacities, &g.logit, 1);
    add(gradient.sh, g.sh, k3);
    if (gradient.mean2d) add(gradient.mean2d, mean2d, 2);
    if (gradient.touched)
        for (int l = 0; l < rows; l++) gradient.touched[id[l] - gradient.first] = 1;
}

void project_backward(const Scene &scene, const Camera &camera, const Record *records, int count, const float *slots,
                      const SceneGradient &gradient, double *pose) {
    const View view(camera);
    V pose_sum[12] = {};
    Group group;
    for (int i = 0; i < count; i++) {
        if (gradient.frozen && gradient.frozen[records[i].id]) continue;
        if (!sum_slots(records[i], slots, group.moments[group.rows])) continue;
        group.record[group.rows++] = &records[i];
        if (group.rows == W) finish_group(scene, view, group, gradient, pose ? pose_sum : nullptr);
    }
    if (group.rows) finish_group(scene, view, group, gradient, pose ? pose_sum : nullptr);
    if (pose)
        for (int i = 0; i < 12; i++)
            for (int l = 0; l < W; l++) pose[i] += double(pose_sum[i][l]);
}

}  // namespace GSMAP_ISA
