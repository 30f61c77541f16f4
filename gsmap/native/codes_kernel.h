// Codes of whole numbers that lie near one.
#pragma once
#include <cstdint>

namespace GSMAP_ISA {

// Which of `count` codes of 48 numbers, `stride` bytes apart, have a squared distance of at most `most` from one, and
// which distance. Returns how many; `which` and `squared` have room for all and are written past the last.
int64_t within(const int16_t *mine, const int8_t *theirs, int64_t stride, int64_t count, int32_t most, int32_t *which,
               int32_t *squared) {
    int64_t found = 0;
    for (int64_t i = 0; i < count; ++i) {
        const int8_t *code = theirs + i * stride;
        int32_t sum = 0;
        for (int k = 0; k < 48; ++k) {
            const int16_t d = int16_t(mine[k] - int16_t(code[k]));
            sum += int32_t(d) * int32_t(d);
        }
        which[found] = int32_t(i), squared[found] = sum;
        found += sum <= most;
    }
    return found;
}

}  // namespace GSMAP_ISA
