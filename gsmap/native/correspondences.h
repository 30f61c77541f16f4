// Pairs of point correspondences, as the kernels take them.
#pragma once
#include <cstdint>

namespace gsmap {

// n correspondences: both ends' coordinates about their means (the source's in the target's unit), the nodes they join,
// and heights along gravity, zero where it is not known.
struct Correspondences {
    int n;
    const float *target[3], *source[3], *target_heights, *source_heights;
    const int32_t *target_ids, *source_ids;
};

// When two of them agree; see gsmap/register/consistency.py.
struct AgreeTest {
    float slack, relative_slack, ratio, min_distance, height_slack, height_slope;
};

// Which pairs vote for a scale, and for which of `bins` over log scales in [-limit, limit]; see gsmap/register/scale.py.
struct VoteTest {
    float min_distance, rise_tolerance, limit;
    int bins;
};

}  // namespace gsmap
