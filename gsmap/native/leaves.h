// Points in the leaves of a k-d tree, and the nearest of all points of a leaf at once (merging_kernel.h).
#pragma once
#include <algorithm>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "merging.h"
#include "rasteriser_view.h"

namespace gsmap {

struct Point {
    float at[3];
    int32_t row;
};

class Leaves {
  public:
    // Puts the points, all finite, in the order of the leaves.
    explicit Leaves(std::vector<Point> &points) : count_((int64_t(points.size()) + kLeaf - 1) / kLeaf) {
        leaves_.reserve(std::size_t(count_));
        if (count_) build(points, 0, int32_t(points.size()));
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

    void build(std::vector<Point> &points, int32_t from, int32_t to) {
        const std::size_t at = nodes_.size();
        Node node{{}, {}, 0, from / kLeaf};
        std::fill_n(node.low, 3, __builtin_inff());
        std::fill_n(node.high, 3, -__builtin_inff());
        for (int32_t i = from; i < to; ++i)
            for (int k = 0; k < 3; ++k) {
                node.low[k] = std::min(node.low[k], points[i].at[k]);
                node.high[k] = std::max(node.high[k], points[i].at[k]);
            }
        nodes_.push_back(node);
        if (to - from <= kLeaf) {
            Leaf &leaf = leaves_.get()[from / kLeaf];
            std::copy_n(node.low, 3, leaf.low);
            std::copy_n(node.high, 3, leaf.high);
            leaf.count = to - from;
            for (int i = 0; i < kLeaf; ++i) {
                leaf.row[i] = i < leaf.count ? points[from + i].row : -1;
                for (int k = 0; k < 3; ++k) leaf.at[k][i] = i < leaf.count ? points[from + i].at[k] : __builtin_inff();
            }
            return;
        }
        int axis = 0;
        for (int k = 1; k < 3; ++k)
            if (node.high[k] - node.low[k] > node.high[axis] - node.low[axis]) axis = k;
        // All leaves but the last are full.
        const int32_t middle = from + ((to - from + 1) / 2 + kLeaf - 1) / kLeaf * kLeaf;
        std::nth_element(points.begin() + from, points.begin() + middle, points.begin() + to,
                         [axis](const Point &a, const Point &b) {
                             return a.at[axis] < b.at[axis] || (a.at[axis] == b.at[axis] && a.row < b.row);
                         });
        build(points, from, middle);
        nodes_[at].right = int32_t(nodes_.size());
        build(points, middle, to);
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
