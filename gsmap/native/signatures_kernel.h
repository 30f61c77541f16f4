// Signatures of local features that differ in few signs.
#pragma once
#include <cstdint>

namespace GSMAP_ISA {

// Which of `count` signatures differ from one in at most `most` signs, and in how many. Returns how many there are;
// `which` and `differ` have room for all and are written past the last.
int64_t near(uint64_t mine, const uint64_t *theirs, int64_t count, int most, int32_t *which, uint8_t *differ) {
    int64_t found = 0;
    for (int64_t i = 0; i < count; ++i) {
        const int signs = __builtin_popcountll(mine ^ theirs[i]);
        which[found] = int32_t(i), differ[found] = uint8_t(signs);
        found += signs <= most;
    }
    return found;
}

}  // namespace GSMAP_ISA
