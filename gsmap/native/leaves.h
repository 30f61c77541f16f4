// Points in the leaves of a k-d tree, and the nearest of all points of a leaf at once (merging_kernel.h).
#pragma once
#include <algorithm>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "merging.h"
#include "rasteriser_view.h"
#include "threads.h"

namespace gsmap {

struct Point {
    float at[3];
    int32_t row;
};

class Leaves {
  public:
    // Puts the points, all finite, in the order of the leaves.
    explicit Leaves(std::vector<Point> &points) : count_(leaves_of(int32_t(points.size()))) {
        leaves_.reserve(std::size_t(count_));
        if (!count_) return;
        nodes_.resize(std::size_t(2 * count_ - 1));
        std::vector<Part> parts{{0, 0, int32_t(points.size())}};
        while (parts.size() < kParts && points.size() / parts.size() > kLargest) {
            parallel_for(int64_t(parts.size()), [&](int64_t i) { split(points, parts[i]); });
            std::vector<Part> halves;
            for (const Part &part : parts) halves.push_back(half(part, 0)), halves.push_back(half(part, 1));
            parts.swap(halves);
        }
        parallel_for(int64_t(parts.size()), [&](int64_t i) { build(points, parts[i]); });
    }
    int64_t count() const { return count_; }
    // Lets rows be the places of the points in the order of the leaves.
    void number() {
        for (int64_t leaf = 0; leaf < count_; ++leaf)
            for (int i = 0; i < leaves_.get()[leaf].count; ++i) leaves_.get()[leaf].row[i] = int32_t(leaf * kLeaf + i);
    }

    // The k nearest others of each point of a leaf, by row, in any order; fewer than there are points. out: k for each row.
    void nearest(int64_t at, int k, int32_t *out) const {
        const Leaf &leaf = leaves_.get()[at];
        Search search;
        std::fill_n(search.bound, kLeaf, std::numeric_limits<float>::max());
        std::fill_n(search.count, kLeaf, 0);
        kernels->find_nearest(leaf, leaf, k + 1, search);  // each finds itself, too
        float bound = kernels->settle_nearest(leaf, k + 1, search);
        struct Todo {
            int32_t node;
            float squared;
        } todo[64];
        int left = 0;
        todo[left++] = {0, 0.f};
        while (left) {
            const Todo now = todo[--left];
            if (now.squared > bound) continue;
            const Node &node = nodes_[now.node];
            if (node.right) {
                Todo one{now.node + 1, apart(leaf, nodes_[now.node + 1])}, other{node.right, apart(leaf, nodes_[node.right])};
                if (one.squared < other.squared) std::swap(one, other);
                if (one.squared <= bound) todo[left++] = one;
                if (other.squared <= bound) todo[left++] = other;
            } else if (node.leaf != at) {
                bound = kernels->find_nearest(leaf, leaves_.get()[node.leaf], k + 1, search);
            }
        }
        kernels->settle_nearest(leaf, k + 1, search);
        for (int i = 0; i < leaf.count; ++i) {
            int32_t *next = out + int64_t(leaf.row[i]) * k;
            // Without itself, unless so many coincide with it that it is not among them.
            for (int j = 0, missing = k; missing; ++j)
                if (search.row[i][j] != leaf.row[i]) *next++ = search.row[i][j], --missing;
        }
    }

  private:
    struct Node {
        float low[3], high[3];
        int32_t right, leaf;  // the left child is the next; of a leaf right is 0
    };

    struct Part {
        int32_t node, from, to;
    };
    static constexpr std::size_t kParts = 128, kLargest = 8192;  // parts of larger trees are built side by side

    static int32_t leaves_of(int32_t points) { return (points + kLeaf - 1) / kLeaf; }
    // Where a part is split: all leaves but the last are full.
    static int32_t middle_of(const Part &part) { return part.from + (leaves_of(part.to - part.from) + 1) / 2 * kLeaf; }
    Part half(const Part &part, int which) const {
        const int32_t middle = middle_of(part);
        return which ? Part{nodes_[part.node].right, middle, part.to} : Part{part.node + 1, part.from, middle};
    }
    // Makes a node, and returns whether it has halves.
    bool split(std::vector<Point> &points, const Part &part) {
        const auto [at, from, to] = part;
        Node &node = nodes_[at] = {{}, {}, 0, from / kLeaf};
        std::fill_n(node.low, 3, __builtin_inff());
        std::fill_n(node.high, 3, -__builtin_inff());
        for (int32_t i = from; i < to; ++i)
            for (int k = 0; k < 3; ++k) {
                node.low[k] = std::min(node.low[k], points[i].at[k]);
                node.high[k] = std::max(node.high[k], points[i].at[k]);
            }
        if (to - from <= kLeaf) {
            Leaf &leaf = leaves_.get()[from / kLeaf];
            std::copy_n(node.low, 3, leaf.low);
            std::copy_n(node.high, 3, leaf.high);
            leaf.count = to - from;
            for (int i = 0; i < kLeaf; ++i) {
                leaf.row[i] = i < leaf.count ? points[from + i].row : -1;
                for (int k = 0; k < 3; ++k) leaf.at[k][i] = i < leaf.count ? points[from + i].at[k] : __builtin_inff();
            }
            return false;
        }
        int axis = 0;
        for (int k = 1; k < 3; ++k)
            if (node.high[k] - node.low[k] > node.high[axis] - node.low[axis]) axis = k;
        const int32_t middle = middle_of(part);
        std::nth_element(points.begin() + from, points.begin() + middle, points.begin() + to,
                         [axis](const Point &a, const Point &b) {
                             return a.at[axis] < b.at[axis] || (a.at[axis] == b.at[axis] && a.row < b.row);
                         });
        node.right = at + 2 * leaves_of(middle - from);
        return true;
    }
    void build(std::vector<Point> &points, const Part &part) {
        if (split(points, part)) build(points, half(part, 0)), build(points, half(part, 1));
    }
    // Between the boxes around a leaf and a node, squared.
    static float apart(const Leaf &a, const Node &b) {
        float d[3];
        for (int k = 0; k < 3; ++k) d[k] = std::max(0.f, std::max(a.low[k] - b.high[k], b.low[k] - a.high[k]));
        return d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    }

    int64_t count_;
    std::vector<Node> nodes_;
    Buffer<Leaf> leaves_;
};

}  // namespace gsmap
