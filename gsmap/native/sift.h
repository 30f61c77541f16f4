// A grid of cells, turned with a local feature, in which slopes are counted by direction. Plain data only.
#pragma once

namespace gsmap {

constexpr int kSlopeCells = 4, kSlopeTurns = 8;  // along each side of a descriptor, and in a full turn

struct SlopeGrid {
    float x, cosine, sine;  // the middle's column; the grid's axes, in cells of the grid
    float turned;           // direction of the feature
    const float *fading;    // exp(-x), entry by entry, one more than `fading_entries`
    float fading_per_unit;  // entries of x from 0 to 1
    int fading_entries;
};

}  // namespace gsmap
