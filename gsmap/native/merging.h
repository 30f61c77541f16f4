// What the parts of merging share: plain data, as in rasteriser.h.
#pragma once
#include <cstdint>

namespace gsmap {

// One Gaussian as merging sees it. Covariances are symmetric 3x3: xx, xy, xz, yy, yz, zz.
struct alignas(64) Blob {
    double mean[3], covariance[6];
    double mass;      // its optical depth times its mean projected area: the light it stops
    double strength;  // of its light when blurred: opacity times the root of its area
    double colour[3];
    double root;  // fourth root of the determinant of its blurred covariance
    double weight;
};
static_assert(sizeof(Blob) == 128, "a blob is two cache lines");

struct Pair {
    int32_t a, b;
    float cost;
};

constexpr int kLeaf = 16;  // points of a leaf, at most

// Some points that lie together: x of all, then y, then z, infinite where there are fewer; their rows, and the box around.
struct alignas(64) Leaf {
    float at[3][kLeaf];
    int32_t row[kLeaf];
    float low[3], high[3];
    int32_t count;
};

// What was found near the points of a leaf: squared distances and rows. Has room for a leaf more than are ever kept.
struct alignas(64) Search {
    static constexpr int kRoom = 64;
    float bound[kLeaf];  // what is farther (squared) from a point does not count for it
    int32_t count[kLeaf];
    float squared[kLeaf][kRoom];
    int32_t row[kLeaf][kRoom];
};

}  // namespace gsmap
