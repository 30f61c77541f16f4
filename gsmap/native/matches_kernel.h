// Descriptors of two pictures, each beside all of the other's: the nearest both ways, and the next one.
#pragma once
#include "matches.h"
#include "simd.h"

namespace GSMAP_ISA {
using namespace gsmap;

typedef I IU __attribute__((aligned(4), may_alias));

constexpr int kAtOnce = W == 16 ? 8 : W == 8 ? 6 : 4;  // rows, as registers allow

// What is known of a row after some of the columns, by lane.
struct Best {
    V top, next;
    I column;
};

INLINE I whole(V v) { return __builtin_convertvector(v, I); }
INLINE I select_whole(M m, I a, I b) { return (I)select(m, (V)a, (V)b); }

// Products of R rows with the columns of one block enter what is known of both.
template <int R> INLINE void enter(const V *product, Best *best, int row, int block, const MutualNearest &out) {
    const I column = whole(iota()) + block * W;
    float *top = out.column_top + block * W;
    IU *whose = reinterpret_cast<IU *>(out.column_row + block * W);
    V highest = loadu(top);
    I mine = *whose;
    for (int r = 0; r < R; ++r) {
        const V p = product[r];
        const M above = gt(p, best[r].top);
        best[r].next = max(best[r].next, min(p, best[r].top));
        best[r].column = select_whole(above, column, best[r].column);
        best[r].top = max(p, best[r].top);
        mine = select_whole(gt(p, highest), I{} + (row + r), mine);
        highest = max(p, highest);
    }
    storeu(top, highest);
    *whose = mine;
}

// A row after all of them: of what is as high the first.
INLINE void leave(const Best &best, int row, const MutualNearest &out) {
    float top = kNone, next = kNone;
    int column = 0;
    for (int lane = 0; lane < W; ++lane) {
        const float here = best.top[lane], other = best.next[lane];
        const bool above = here > top || (here == top && best.column[lane] < column);
        const float lower = here > top ? top : here;
        next = lower > next ? lower : next;
        next = other > next ? other : next;
        column = above ? best.column[lane] : column;
        top = here > top ? here : top;
    }
    out.row_column[row] = column, out.row_top[row] = top, out.row_next[row] = next;
}

// Rows [row, row + R) with all columns; `Products::of<R>(row, block, product)` are those with W of them.
template <int R, class Products> INLINE void rows_of(const Products &products, int row, int columns, const MutualNearest &out) {
    Best best[R];
    for (int r = 0; r < R; ++r) best[r] = {set1(kNone), set1(kNone), I{}};
    for (int block = 0; block * W < columns; ++block) {
        V product[R];
        products.template of<R>(row, block, product);
        const int left = columns - block * W;
        if (left < W)
            for (int r = 0; r < R; ++r) product[r] = select(first_lanes(left), product[r], set1(kNone));
        enter<R>(product, best, row, block, out);
    }
    for (int r = 0; r < R; ++r) leave(best[r], row + r, out);
}

template <class Products> INLINE void all_rows(const Products &products, int rows, int columns, const MutualNearest &out) {
    for (int j = 0; j < columns; ++j) out.column_top[j] = kNone, out.column_row[j] = 0;
    for (int j = columns; j % W; ++j) out.column_top[j] = kNone, out.column_row[j] = 0;
    int row = 0;
    for (; row + kAtOnce <= rows; row += kAtOnce) rows_of<kAtOnce>(products, row, columns, out);
    for (; row < rows; ++row) rows_of<1>(products, row, columns, out);
}

// By floats, which hold these whole numbers.
struct ByFloats {
    const float *mine, *theirs;  // (rows, width), and W columns at a time (width, W)
    int width;

    template <int R> INLINE void of(int row, int block, V *product) const {
        const float *one = mine + int64_t(row) * width, *other = theirs + int64_t(block) * W * width;
        V sum[R];
        for (int r = 0; r < R; ++r) sum[r] = V{};
        for (int k = 0; k < width; ++k) {
            const V column = loadu(other + k * W);
            for (int r = 0; r < R; ++r) sum[r] = fma(set1(one[r * width + k]), column, sum[r]);
        }
        for (int r = 0; r < R; ++r) product[r] = sum[r];
    }
};

void nearest_by_floats(const Descriptors &mine, const Descriptors &theirs, void *room, const MutualNearest &out) {
    float *rows = static_cast<float *>(room), *columns = rows + int64_t(mine.count) * mine.width;
    for (int64_t i = 0; i < int64_t(mine.count) * mine.width; ++i) rows[i] = mine.rows[i];
    const int width = theirs.width;
    for (int j = 0; j < theirs.count || j % W; ++j)
        for (int k = 0; k < width; ++k)
            columns[(int64_t(j / W) * width + k) * W + j % W] =
                j < theirs.count ? float(theirs.rows[int64_t(j) * width + k]) : 0.f;
    all_rows(ByFloats{rows, columns, width}, mine.count, theirs.count, out);
}

#if GSMAP_AVX512
// sum + the products of four unsigned and four signed bytes, in each lane. As an instruction, and not as an intrinsic: the
// compiler is told of processors that lack it.
INLINE __m512i with_products(__m512i sum, __m512i unsigned_bytes, __m512i signed_bytes) {
    __asm__("vpdpbusd %2, %1, %0" : "+v"(sum) : "v"(unsigned_bytes), "v"(signed_bytes));
    return sum;
}

// By whole numbers, four at a time: processors that can (VNNI) take a quarter of the time.
struct ByBytes {
    const int32_t *mine, *theirs;  // (rows, words) signed, and W columns at a time (words, W), each 128 more
    const int32_t *less;           // (rows,) 128 times the sum of a row
    int words;

    template <int R> INLINE void of(int row, int block, V *product) const {
        const int32_t *one = mine + int64_t(row) * words, *other = theirs + int64_t(block) * W * words;
        __m512i sum[R];
        for (int r = 0; r < R; ++r) sum[r] = _mm512_set1_epi32(-less[row + r]);
        for (int k = 0; k < words; ++k) {
            const __m512i column = _mm512_loadu_si512(other + k * W);
            for (int r = 0; r < R; ++r)
                sum[r] = with_products(sum[r], column, _mm512_set1_epi32(one[r * words + k]));
        }
        for (int r = 0; r < R; ++r) product[r] = (V)_mm512_cvtepi32_ps(sum[r]);
    }
};

// Four numbers of a row; zeros past its end.
INLINE int32_t word_of(const int8_t *row, int k, int width) {
    int32_t out = 0;
    if (4 * k + 4 <= width)
        __builtin_memcpy(&out, row + 4 * k, 4);
    else if (4 * k < width)
        __builtin_memcpy(&out, row + 4 * k, width - 4 * k);
    return out;
}

void nearest_by_bytes(const Descriptors &mine, const Descriptors &theirs, void *room, const MutualNearest &out) {
    const int words = (mine.width + 3) / 4;
    int32_t *rows = static_cast<int32_t *>(room), *less = rows + int64_t(mine.count) * words;
    int32_t *columns = less + mine.count;
    for (int i = 0; i < mine.count; ++i) {
        const int8_t *row = mine.rows + int64_t(i) * mine.width;
        int32_t sum = 0;
        for (int k = 0; k < mine.width; ++k) sum += row[k];
        less[i] = 128 * sum;
        for (int k = 0; k < words; ++k) rows[int64_t(i) * words + k] = word_of(row, k, mine.width);
    }
    for (int j = 0; j < theirs.count || j % W; ++j) {
        const int8_t *row = theirs.rows + int64_t(j) * theirs.width;
        int32_t *column = columns + int64_t(j / W) * words * W + j % W;
        const int width = j < theirs.count ? theirs.width : 0;
        for (int k = 0; k < words; ++k) column[k * W] = word_of(row, k, width) ^ int32_t(0x80808080);  // 128 more
    }
    all_rows(ByBytes{rows, columns, less, words}, mine.count, theirs.count, out);
}
#endif

// `room` holds 4 bytes for every number of both, of multiples of 16 columns and of 4 numbers, and for every row.
void nearest(const Descriptors &mine, const Descriptors &theirs, void *room, const MutualNearest &out) {
#if GSMAP_AVX512
    static const bool by_bytes = __builtin_cpu_supports("avx512vnni");
    if (by_bytes) return nearest_by_bytes(mine, theirs, room, out);
#endif
    nearest_by_floats(mine, theirs, room, out);
}

}  // namespace GSMAP_ISA
