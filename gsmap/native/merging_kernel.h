// What it costs, in light, to draw one Gaussian in place of two. Every operation is IEEE's and none is fused, so that all
// instruction sets give the same bits: which pairs are merged must not depend on the machine.
#pragma once
#include "merging.h"
#include "simd.h"

namespace GSMAP_ISA {

constexpr int kWide = W / 2;  // lanes of float64
typedef double F64 __attribute__((vector_size(kWide * 8)));
typedef int64_t I64 __attribute__((vector_size(kWide * 8)));
typedef uint64_t U64 __attribute__((vector_size(kWide * 8)));

INLINE F64 sqrt(F64 x) {
#if GSMAP_AVX512
    return (F64)_mm512_sqrt_pd((__m512d)x);
#elif GSMAP_AVX2
    return (F64)_mm256_sqrt_pd((__m256d)x);
#else
    for (int l = 0; l < kWide; ++l) x[l] = __builtin_sqrt(x[l]);
    return x;
#endif
}
INLINE F64 choose(I64 m, F64 a, F64 b) { return (F64)((m & (I64)a) | (~m & (I64)b)); }
INLINE F64 least(F64 a, F64 b) { return choose((I64)(a < b), a, b); }
INLINE F64 most(F64 a, F64 b) { return choose((I64)(a > b), a, b); }

// e^x for x <= 0, relative error 1e-11; 1e-308 where it would be less.
INLINE F64 exp_negative(F64 x) {
    const F64 t = most(x, F64{} - 708.0) * 1.4426950408889634;
    const F64 shifted = t + 6755399441055744.0;  // 1.5 * 2^52: adding it rounds to the nearest integer, in the low bits
    const F64 r = t - (shifted - 6755399441055744.0);
    F64 p = F64{} + 1.0178086009239699e-07;
    p = p * r + 1.3215486790144309e-06;
    p = p * r + 1.525273380405984e-05;
    p = p * r + 1.5403530393381610e-04;
    p = p * r + 1.3333558146428443e-03;
    p = p * r + 9.6181291076284772e-03;
    p = p * r + 5.5504108664821580e-02;
    p = p * r + 2.4022650695910071e-01;
    p = p * r + 6.9314718055994531e-01;
    p = p * r + 1.0;
    return (F64)((U64)p + ((U64)shifted << 52));
}

struct Symmetric {
    F64 xx, xy, xz, yy, yz, zz;

    // Mean area of the ellipsoid's shadows, by the root mean square of those along its axes.
    INLINE F64 area() const {
        const F64 minors = xx * yy - xy * xy + (xx * zz - xz * xz) + (yy * zz - yz * yz);
        return 3.141592653589793 * sqrt(most(minors, F64{}) / 3.0);
    }
    INLINE F64 determinant() const {
        return xx * (yy * zz - yz * yz) + xy * (xz * yz - xy * zz) + xz * (xy * yz - xz * yy);
    }
};

// Bhattacharyya's coefficient of two Gaussians with the mean covariance s, a difference (x, y, z) of means apart; `roots`
// are the fourth roots of their determinants, multiplied.
INLINE F64 overlap(const Symmetric &s, F64 roots, F64 x, F64 y, F64 z) {
    const F64 A = s.yy * s.zz - s.yz * s.yz, G = s.xz * s.yz - s.xy * s.zz, H = s.xy * s.yz - s.xz * s.yy,
            E = s.xx * s.zz - s.xz * s.xz, F = s.xy * s.xz - s.xx * s.yz, J = s.xx * s.yy - s.xy * s.xy;
    const F64 per_det = 1.0 / (s.xx * A + s.xy * G + s.xz * H);
    const F64 quadratic = (A * x * x + E * y * y + J * z * z + 2.0 * (G * x * y + H * x * z + F * y * z)) * per_det;
    return roots * sqrt(per_det) * exp_negative(quadratic * -0.125);
}

INLINE Symmetric mean_of(const Symmetric &s, const Symmetric &t, double more) {
    return {(s.xx + t.xx) * 0.5 + more, (s.xy + t.xy) * 0.5, (s.xz + t.xz) * 0.5,
            (s.yy + t.yy) * 0.5 + more, (s.yz + t.yz) * 0.5, (s.zz + t.zz) * 0.5 + more};
}

// Writes the lanes that a mask names one after the other, and anything up to a vector's end; returns how many.
INLINE int append(M which, V squared, const int32_t *rows, float *to_squared, int32_t *to_rows) {
    const uint32_t named = bits(which);
#if GSMAP_AVX512
    const __m512i row = _mm512_load_si512(rows);
    _mm512_storeu_ps(to_squared, _mm512_maskz_compress_ps(which, (__m512)squared));
    _mm512_storeu_si512(to_rows, _mm512_maskz_compress_epi32(which, row));
#else
    int count = 0;
    for (uint32_t left = named; left; left &= left - 1, ++count) {
        const int l = __builtin_ctz(left);
        to_squared[count] = squared[l], to_rows[count] = rows[l];
    }
#endif
    return __builtin_popcount(named);
}

// How many of some numbers, whole vectors of them, are no larger than a limit.
INLINE int count_within(const float *values, int count, float limit) {
    int within = 0;
    for (int i = 0; i < count; i += W) within += __builtin_popcount(bits(ge(set1(limit), load(values + i))));
    return within;
}

// A number with k of the others at it or below; negative where equal ones leave none, or none is found soon.
INLINE float limit_of(const float *values, int count, int k) {
    V most{};
    for (int i = 0; i < count; i += W) most = max(most, zero_unless(first_lanes(count - i), load(values + i)));
    float low = 0, high = max_of_lanes(most);
    int below = count_within(values, count, 0.f), within = count;
    for (int step = 0; within != k; ++step) {
        if (step == 12 || below >= k) return -1;
        const float share = step % 3 == 2 ? 0.5f : float(k - below) / float(within - below);  // as if they lay evenly
        const float middle = low + share * (high - low);
        if (!(middle > low && middle < high)) return -1;
        const int found = count_within(values, count, middle);
        if (found >= k)
            high = middle, within = found;
        else
            low = middle, below = found;
    }
    return high;
}

// Leaves the k nearest of what was found for a point, of equally near ones those found first; farther ones count no more.
INLINE void keep_nearest(gsmap::Search &search, int point, int k) {
    float *squared = search.squared[point];
    int32_t *row = search.row[point];
    const int count = search.count[point];
    if (count < k) return;
    for (int i = count; i % W; ++i) squared[i] = __builtin_inff();
    int kept = 0;
    const float limit = limit_of(squared, count, k);
    if (limit >= 0) {
        V most{};
        for (int i = 0; i < count; i += W) {
            const V d = load(squared + i);
            const M stays = ge(set1(limit), d);
            most = max(most, zero_unless(stays, d));
            kept += append(stays, d, row + i, squared + kept, row + kept);
        }
        search.count[point] = kept;
        search.bound[point] = max_of_lanes(most);
        return;
    }
    int8_t nearer[gsmap::Search::kRoom];
    int before_last = 0;  // how many are nearer than the k-th, whose equals are left in what room remains
    for (int i = 0; i < count; ++i) {
        int before = 0;
        for (int first = 0; first < count; first += W)
            before += __builtin_popcount(bits(gt(set1(squared[i]), load(squared + first))));
        nearer[i] = int8_t(before);
        before_last = before < k && before > before_last ? before : before_last;
    }
    float bound = 0;
    int room = k - before_last;
    for (int i = 0; i < count; ++i) {
        const bool stays = nearer[i] < before_last || (nearer[i] == before_last && room-- > 0);
        const float d = squared[i];
        squared[kept] = d, row[kept] = row[i];
        bound = stays && d > bound ? d : bound;
        kept += stays;
    }
    search.count[point] = kept;
    search.bound[point] = bound;
}

// Looks for the k nearest of each point of a leaf among those of another one. Returns the largest bound. Distances to boxes
// are rounded as those of points are, in the same order: they are never more than that of a point inside.
float find_nearest(const gsmap::Leaf &of, const gsmap::Leaf &among, int k, gsmap::Search &search) {
    static_assert(gsmap::kLeaf % W == 0, "whole vectors");
    for (int part = 0; part < gsmap::kLeaf; part += W) {
        V away[3];
        for (int axis = 0; axis < 3; ++axis) {
            const V at = load(of.at[axis] + part);
            away[axis] = max(V{}, max(among.low[axis] - at, at - among.high[axis]));
        }
        const V to_box = away[0] * away[0] + away[1] * away[1] + away[2] * away[2];
        for (uint32_t near = bits(ge(load(search.bound + part), to_box)); near; near &= near - 1) {
            const int point = part + __builtin_ctz(near);
            if (point >= of.count) break;
            int count = search.count[point];
            for (int first = 0; first < gsmap::kLeaf; first += W) {
                const V x = load(among.at[0] + first) - of.at[0][point], y = load(among.at[1] + first) - of.at[1][point],
                        z = load(among.at[2] + first) - of.at[2][point];
                const V d = x * x + y * y + z * z;
                count += append(ge(set1(search.bound[point]), d), d, among.row + first, search.squared[point] + count,
                                search.row[point] + count);
            }
            search.count[point] = count;
            if (count > 2 * k) keep_nearest(search, point, k);
        }
    }
    float bound = 0;
    for (int point = 0; point < of.count; ++point) bound = search.bound[point] > bound ? search.bound[point] : bound;
    return bound;
}

// Leaves the k nearest of every point alone; returns the largest bound.
float settle_nearest(const gsmap::Leaf &of, int k, gsmap::Search &search) {
    float bound = 0;
    for (int point = 0; point < of.count; ++point) {
        keep_nearest(search, point, k);
        bound = search.bound[point] > bound ? search.bound[point] : bound;
    }
    return bound;
}

// The cost of each pair: blurred by a variance, with so much of `cover` beside the three colours.
void pair_costs(const gsmap::Blob *blobs, gsmap::Pair *pairs, int64_t count, double blur, double cover) {
    constexpr int kFields = 16;
    alignas(64) double lanes[2][kFields][kWide];
    for (int64_t first = 0; first < count; first += kWide) {
        const int used = count - first < kWide ? int(count - first) : kWide;
        for (int l = 0; l < kWide; ++l) {
            const gsmap::Pair &pair = pairs[first + (l < used ? l : 0)];
            const double *a = blobs[pair.a].mean, *b = blobs[pair.b].mean;
            for (int f = 0; f < kFields; ++f) lanes[0][f][l] = a[f], lanes[1][f][l] = b[f];
        }
        const F64 *u = reinterpret_cast<const F64 *>(lanes[0]), *v = reinterpret_cast<const F64 *>(lanes[1]);
        const F64 mass = u[9] + v[9], a = u[9] / mass, b = 1.0 - a, ab = a * b;
        const F64 x = u[0] - v[0], y = u[1] - v[1], z = u[2] - v[2];
        const Symmetric s{u[3], u[4], u[5], u[6], u[7], u[8]}, t{v[3], v[4], v[5], v[6], v[7], v[8]};
        Symmetric m{a * s.xx + b * t.xx + ab * x * x, a * s.xy + b * t.xy + ab * x * y, a * s.xz + b * t.xz + ab * x * z,
                    a * s.yy + b * t.yy + ab * y * y, a * s.yz + b * t.yz + ab * y * z, a * s.zz + b * t.zz + ab * z * z};
        const F64 sharp = m.area();
        const F64 opacity = least(1.0 - exp_negative(-(mass / most(sharp, F64{} + 1e-300))), F64{} + 0.9999);
        const F64 xy = overlap(mean_of(s, t, blur), u[14] * v[14], x, y, z);
        // With the one that would be drawn: its covariance is blurred by both halves of the mean.
        const Symmetric with_u = mean_of(s, m, blur), with_v = mean_of(t, m, blur);
        m.xx += blur, m.yy += blur, m.zz += blur;
        const F64 strength = opacity * sharp / sqrt(m.area()), root = sqrt(sqrt(m.determinant()));
        const F64 xz = overlap(with_u, u[14] * root, b * x, b * y, b * z), yz = overlap(with_v, v[14] * root, a * x, a * y, a * z);
        F64 uu = F64{} + cover * cover, vv = uu, uv = uu;
        for (int k = 11; k < 14; ++k) uu += u[k] * u[k], vv += v[k] * v[k], uv += u[k] * v[k];
        const F64 um = a * uu + b * uv, vm = a * uv + b * vv, mm = a * um + b * vm, p = u[10], q = v[10];
        const F64 energy = p * p * uu + q * q * vv + strength * strength * mm + 2.0 * p * q * xy * uv -
                         2.0 * p * strength * xz * um - 2.0 * q * strength * yz * vm;
        const F64 weighted = most(energy, F64{}) * (u[15] + v[15]) * 0.5;
        for (int l = 0; l < used; ++l) {
            const float cost = float(weighted[l]);
            pairs[first + l].cost = energy[l] == energy[l] && cost < __builtin_inff() ? cost : __builtin_inff();
        }
    }
}

}  // namespace GSMAP_ISA
