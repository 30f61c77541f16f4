// Descriptors as kernels compare them.
#pragma once
#include <cstdint>

namespace gsmap {

// (count, width) whole numbers.
struct Descriptors {
    const int8_t *rows;
    int count, width;
};

// Of each row, the column that it has the largest product with, that product and the next one; and of each column the
// row. What is as large is the first. Products are whole numbers, and floats hold them. There is room for a multiple of
// 16 columns.
struct MutualNearest {
    int32_t *row_column;
    float *row_top, *row_next;
    int32_t *column_row;
    float *column_top;
};

constexpr float kNone = -1e9f;   // no product is so small
constexpr int kMaxWidth = 1024;  // 128 * 128 * 1024 is the last whole number that floats hold

}  // namespace gsmap
