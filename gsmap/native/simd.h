// Float vectors of the width the translation unit is compiled for: 16 lanes (AVX-512), 8 (AVX2) or 4 (anything else,
// plain GCC/Clang vectors, which become SSE2 or NEON). Sources that include this file are compiled once per instruction
// set with GSMAP_ISA naming the namespace, and may use nothing with external linkage from the standard library: the
// linker would keep one copy of an inline function, perhaps the one with instructions this machine does not have.
#pragma once
#include <cstdint>
#include <utility>

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512BW__) && defined(__AVX512VL__)
#define GSMAP_AVX512 1
#include <immintrin.h>
#elif defined(__AVX2__) && defined(__FMA__)
#define GSMAP_AVX2 1
#include <immintrin.h>
#endif

#define INLINE inline __attribute__((always_inline))

namespace GSMAP_ISA {

#if GSMAP_AVX512
constexpr int W = 16;
#elif GSMAP_AVX2
constexpr int W = 8;
#else
constexpr int W = 4;
#endif

typedef float V __attribute__((vector_size(W * 4)));
typedef int32_t I __attribute__((vector_size(W * 4)));
typedef uint32_t U __attribute__((vector_size(W * 4)));  // wraps around, where I may not
typedef float VU __attribute__((vector_size(W * 4), aligned(4), may_alias));

INLINE V set1(float x) { return V{} + x; }
INLINE V load(const float *p) { return *reinterpret_cast<const V *>(p); }
INLINE V loadu(const float *p) { return *reinterpret_cast<const VU *>(p); }
INLINE void store(float *p, V v) { *reinterpret_cast<V *>(p) = v; }
INLINE void storeu(float *p, V v) { *reinterpret_cast<VU *>(p) = v; }

template <int... J> INLINE V iota(std::integer_sequence<int, J...>) { return V{float(J)...}; }
INLINE V iota() { return iota(std::make_integer_sequence<int, W>{}); }

#if GSMAP_AVX512
typedef __mmask16 M;
INLINE V fma(V a, V b, V c) { return (V)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
INLINE V fnma(V a, V b, V c) { return (V)_mm512_fnmadd_ps((__m512)a, (__m512)b, (__m512)c); }
INLINE V max(V a, V b) { return (V)_mm512_max_ps((__m512)a, (__m512)b); }
INLINE V min(V a, V b) { return (V)_mm512_min_ps((__m512)a, (__m512)b); }
INLINE V sqrt(V a) { return (V)_mm512_sqrt_ps((__m512)a); }
INLINE M lt(V a, V b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_LT_OQ); }
INLINE M gt(V a, V b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
INLINE M ge(V a, V b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
INLINE M gt(M m, V a, V b) { return _mm512_mask_cmp_ps_mask(m, (__m512)a, (__m512)b, _CMP_GT_OQ); }
// written as intrinsics to stay in mask registers: the way through an integer register costs 8 cycles
INLINE M both(M a, M b) { return _kand_mask16(a, b); }
INLINE M either(M a, M b) { return _kor_mask16(a, b); }
INLINE M differ(M a, M b) { return _kxor_mask16(a, b); }
INLINE M first_not_second(M a, M b) { return _kandn_mask16(b, a); }
INLINE uint32_t bits(M m) { return m; }
INLINE bool any(M m) { return m != 0; }
INLINE M first_lanes(int n) { return n >= W ? 0xffff : (M)((1u << n) - 1); }
INLINE V select(M m, V a, V b) { return (V)_mm512_mask_mov_ps((__m512)b, m, (__m512)a); }
INLINE V zero_unless(M m, V a) { return (V)_mm512_maskz_mov_ps(m, (__m512)a); }
// acc + a * b in the lanes of m, acc elsewhere
INLINE V fma_where(M m, V a, V b, V acc) { return (V)_mm512_mask3_fmadd_ps((__m512)a, (__m512)b, (__m512)acc, m); }
// 1 / x to about 1 ulp: the hardware estimate and one Newton step
INLINE V reciprocal(V x) {
    V r = (V)_mm512_rcp14_ps((__m512)x);
    return fma(fnma(x, r, set1(1.f)), r, r);
}
// 2^x for -126 < x < 127, relative error 5e-7; anything but a trap elsewhere. A table of 16 steps in one register and a
// parabola: half the multiplications of a longer polynomial, and the rest runs on other units.
INLINE V exp2_in_range(V x) {
    const __m512i table = _mm512_setr_epi32(0x3f800000, 0x3f7daac3, 0x3f7b95c2, 0x3f79c3d3, 0x3f7837f0, 0x3f76f532, 0x3f75fed7, 0x3f75583f, 0x3f7504f3, 0x3f7508a4, 0x3f75672a, 0x3f76248c, 0x3f7744fd, 0x3f78ccdf, 0x3f7ac0c7, 0x3f7d257d);
    const V shifted = x + 786432.f;  // 1.5 * 2^19: adding it rounds to sixteenths, in the low bits
    const V r = x - (shifted - 786432.f);
    const __m512i bits = (__m512i)shifted;
    const V step = (V)_mm512_add_epi32(_mm512_permutexvar_epi32(bits, table), _mm512_slli_epi32(bits, 19));
    return fma(step * r, fma(r, set1(0.24022786f), set1(0.69318777f)), step);
}
// 2^x, relative error 8e-8; 0 below the range
INLINE V exp2(V x) {
    const V r = (V)_mm512_reduce_ps((__m512)x, 1);  // x - floor(x)
    V p = set1(0.0018775759963318706f);
    p = fma(p, r, set1(0.00898934155702591f));
    p = fma(p, r, set1(0.05582631751894951f));
    p = fma(p, r, set1(0.24015361070632935f));
    p = fma(p, r, set1(0.6931530833244324f));
    p = fma(p, r, set1(0.9999999403953552f));
    return (V)_mm512_scalef_ps((__m512)p, (__m512)x);
}
#else
typedef I M;
#if GSMAP_AVX2
INLINE V fma(V a, V b, V c) { return (V)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
INLINE V fnma(V a, V b, V c) { return (V)_mm256_fnmadd_ps((__m256)a, (__m256)b, (__m256)c); }
INLINE V max(V a, V b) { return (V)_mm256_max_ps((__m256)a, (__m256)b); }
INLINE V min(V a, V b) { return (V)_mm256_min_ps((__m256)a, (__m256)b); }
INLINE V sqrt(V a) { return (V)_mm256_sqrt_ps((__m256)a); }
INLINE uint32_t bits(M m) { return (uint32_t)_mm256_movemask_ps((__m256)m); }
INLINE V select(M m, V a, V b) { return (V)_mm256_blendv_ps((__m256)b, (__m256)a, (__m256)m); }
#else
INLINE V select(M m, V a, V b) { return (V)((m & (I)a) | (~m & (I)b)); }
INLINE V fma(V a, V b, V c) { return a * b + c; }
INLINE V fnma(V a, V b, V c) { return c - a * b; }
INLINE V max(V a, V b) { return select((M)(a > b), a, b); }  // b where either is NaN, as the x86 instruction
INLINE V min(V a, V b) { return select((M)(a < b), a, b); }
INLINE V sqrt(V a) {
    for (int i = 0; i < W; i++) a[i] = __builtin_sqrtf(a[i]);
    return a;
}
INLINE uint32_t bits(M m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
#endif
INLINE M lt(V a, V b) { return (M)(a < b); }
INLINE M gt(V a, V b) { return (M)(a > b); }
INLINE M ge(V a, V b) { return (M)(a >= b); }
INLINE M both(M a, M b) { return a & b; }
INLINE M either(M a, M b) { return a | b; }
INLINE M differ(M a, M b) { return a ^ b; }
INLINE M gt(M m, V a, V b) { return m & (M)(a > b); }
INLINE M first_not_second(M a, M b) { return a & ~b; }
INLINE bool any(M m) { return bits(m) != 0; }
INLINE M first_lanes(int n) { return (M)(iota() < set1(float(n))); }
INLINE V zero_unless(M m, V a) { return (V)(m & (I)a); }
INLINE V fma_where(M m, V a, V b, V acc) { return fma(zero_unless(m, a), b, acc); }
INLINE V reciprocal(V x) { return set1(1.f) / x; }
// 2^x for -126 < x < 127, relative error 8e-8; anything but a trap elsewhere
INLINE V exp2_in_range(V x) {
    const V shifted = x + 12582912.f;  // 1.5 * 2^23: adding it rounds to the nearest integer, in the low bits
    const V r = x - (shifted - 12582912.f);
    V p = set1(0.0013276466634124517f);
    p = fma(p, r, set1(0.009675540961325169f));
    p = fma(p, r, set1(0.05550713464617729f));
    p = fma(p, r, set1(0.24022120237350464f));
    p = fma(p, r, set1(0.6931469440460205f));
    p = fma(p, r, set1(1.0000001192092896f));
    return (V)((U)p + ((U)shifted << 23));
}
// 2^x, held at 2^-126 and 2^127 where it would leave the normal numbers; a NaN gives 2^-126
INLINE V exp2(V x) { return exp2_in_range(min(max(x, set1(-126.f)), set1(127.f))); }
#endif

// Writes the numbers of the lanes of m, plus `first`, to `out` and whatever after them, up to W bytes in all; returns how
// many lanes there are.
INLINE int list_lanes(M m, int first, uint8_t *out) {
#if GSMAP_AVX512
    const __m512i lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const __m512i chosen = _mm512_maskz_compress_epi32(m, _mm512_add_epi32(lanes, _mm512_set1_epi32(first)));
    _mm_storeu_si128((__m128i *)out, _mm512_cvtepi32_epi8(chosen));  // without branches, which short lists mislead
    return __builtin_popcount(m);
#else
    int count = 0;
    for (uint32_t left = bits(m); left; left &= left - 1) out[count++] = uint8_t(first + __builtin_ctz(left));
    return count;
#endif
}

INLINE V abs(V a) { return (V)((I)a & 0x7fffffff); }
INLINE M finite(V a) { return lt(abs(a), set1(3.4e38f)); }
INLINE V exp(V x) { return exp2(x * 1.44269504088896341f); }

// log2 of positive normal numbers, absolute error 1e-7 near 1
INLINE V log2(V x) {
    const I e = (((I)x - 0x3f3504f3) >> 23);  // so that the mantissa lies in [sqrt(1/2), sqrt(2))
    const V m = (V)((U)x - ((U)e << 23));
    const V s = (m - 1.f) / (m + 1.f), s2 = s * s;
    V p = fma(s2, set1(2.88539008f / 9), set1(2.88539008f / 7));
    p = fma(p, s2, set1(2.88539008f / 5));
    p = fma(p, s2, set1(2.88539008f / 3));
    p = fma(p, s2, set1(2.88539008f));
    return fma(p, s, __builtin_convertvector(e, V));
}

template <int S, int... J> INLINE V mix_low(V a, V b, std::integer_sequence<int, J...>) {
    return __builtin_shufflevector(a, b, ((J & S) == 0 ? J : W + J - S)...);
}
template <int S, int... J> INLINE V mix_high(V a, V b, std::integer_sequence<int, J...>) {
    return __builtin_shufflevector(a, b, ((J & S) == 0 ? J + S : W + J)...);
}
template <int S> INLINE V mix_low(V a, V b) { return mix_low<S>(a, b, std::make_integer_sequence<int, W>{}); }
template <int S> INLINE V mix_high(V a, V b) { return mix_high<S>(a, b, std::make_integer_sequence<int, W>{}); }

template <int S> INLINE void transpose_step(V *r) {
    if constexpr (S > 0) {
        for (int i = 0; i < W; i++) {
            if (i & S) continue;
            const V a = r[i], b = r[i + S];
            r[i] = mix_low<S>(a, b);
            r[i + S] = mix_high<S>(a, b);
        }
        transpose_step<S / 2>(r);
    }
}
// In place: lane j of r[i] <-> lane i of r[j].
INLINE void transpose(V *r) { transpose_step<W / 2>(r); }

template <int S, int... J> INLINE V swap_lanes(V a, std::integer_sequence<int, J...>) {
    return __builtin_shufflevector(a, a, (J ^ S)...);
}
template <int S> INLINE V max_step(V a) {
    if constexpr (S > 0) return max_step<S / 2>(max(a, swap_lanes<S>(a, std::make_integer_sequence<int, W>{})));
    return a;
}
// The largest lane.
INLINE float max_of_lanes(V a) { return max_step<W / 2>(a)[0]; }

template <int S> INLINE void sum_step(V *r) {
    if constexpr (S > 0) {
        for (int i = 0; i < S; i++) r[i] = mix_low<S>(r[i], r[i + S]) + mix_high<S>(r[i], r[i + S]);
        sum_step<S / 2>(r);
    }
}
// Lane i of the result is the sum over the lanes of r[i].
INLINE V sums_of_lanes(V *r) {
    sum_step<W / 2>(r);
    return r[0];
}

// Reads `fields` consecutive floats of W rows and hands them over by field: out[f] has lane l = row[l][f].
// Rows need not be aligned; reads never go past row[l] + fields.
INLINE void load_rows(const float *const *row, int fields, V *out) {
    int f = 0;
    for (; f + W <= fields; f += W) {
        for (int l = 0; l < W; l++) out[f + l] = loadu(row[l] + f);
        transpose(out + f);
    }
    for (; f < fields; f++) {
        alignas(64) float lane[W];
        for (int l = 0; l < W; l++) lane[l] = row[l][f];
        out[f] = load(lane);
    }
}

// The reverse: row[l][f] += lane l of in[f], for the first `rows` rows. Clobbers in.
INLINE void add_to_rows(V *in, int fields, float *const *row, int rows) {
    int f = 0;
    for (; f + W <= fields; f += W) {
        transpose(in + f);
        for (int l = 0; l < rows; l++) storeu(row[l] + f, loadu(row[l] + f) + in[f + l]);
    }
    for (; f < fields; f++) {
        alignas(64) float lane[W];
        store(lane, in[f]);
        for (int l = 0; l < rows; l++) row[l][f] += lane[l];
    }
}

}  // namespace GSMAP_ISA
