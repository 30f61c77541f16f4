// A k-d tree of points of so many numbers: their nearest neighbours, the same whatever the order of the search.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "memory.h"
#include "threads.h"

namespace gsmap {

struct Neighbour {
    double squared;
    int32_t row;
    bool operator<(const Neighbour &o) const { return squared < o.squared || (squared == o.squared && row < o.row); }
};

template <int kAxes> class Tree {
  public:
    // Copies n rows of finite numbers.
    Tree(const double *points, int32_t n) : points_(points, points + kAxes * std::size_t(n)), sorted_(n) {
        if (!n) return;
        for (int32_t i = 0; i < n; ++i) std::copy_n(point(i), kAxes, sorted_[i].at), sorted_[i].row = i;
        nodes_.resize(nodes_of(n));
        std::vector<Part> parts{{0, 0, n}};
        while (parts.size() < kParts && n / int32_t(parts.size()) > kLargest) {
            parallel_for(int64_t(parts.size()), [&](int64_t i) { split(parts[i]); });
            std::vector<Part> halves;
            for (const Part &part : parts) halves.push_back(half(part, 0)), halves.push_back(half(part, 1));
            parts.swap(halves);
        }
        parallel_for(int64_t(parts.size()), [&](int64_t i) { build(parts[i]); });
    }
    int32_t size() const { return int32_t(sorted_.size()); }
    // The row of a place in an order in which rows near each other are together.
    int32_t row(int64_t place) const { return sorted_[place].row; }
    const double *point(int32_t row) const { return &points_[kAxes * std::size_t(row)]; }

    static double squared(const double *a, const double *b) {
        double sum = 0;
        for (int k = 0; k < kAxes; ++k) sum += (a[k] - b[k]) * (a[k] - b[k]);
        return sum;
    }

    struct Any {
        bool operator()(int32_t) const { return true; }
    };

    // The nearest point closer than the bound that counts, by its row; of equally near ones the first.
    template <class Counts = Any> Neighbour nearest(const double *at, Neighbour bound, const Counts &counts = {}) const {
        if (size()) {
            double away[kAxes] = {};
            search(0, at, away, 0, bound, [&](Neighbour &best, const Neighbour &found) {
                if (found < best && counts(found.row)) best = found;
            });
        }
        return bound;
    }
    // Up to k nearest points that count and whose squared distance is below a bound, nearest first; returns how many.
    template <class Counts = Any>
    int nearest(const double *at, int k, Neighbour *out, double bound = __builtin_inf(), const Counts &counts = {}) const {
        struct Best : Neighbour {
            Neighbour *list;
            int k, count;
        } best{{bound, -1}, out, k, 0};
        if (size() && k > 0) {
            double away[kAxes] = {};
            search(0, at, away, 0, best, [&](Best &b, const Neighbour &found) {
                if (b.count == b.k ? !(found < b.list[b.k - 1]) : !(found.squared < b.squared)) return;
                if (!counts(found.row)) return;
                int i = b.count < b.k ? b.count++ : b.k - 1;
                for (; i > 0 && found < b.list[i - 1]; --i) b.list[i] = b.list[i - 1];
                b.list[i] = found;
                if (b.count == b.k) b.squared = b.list[b.k - 1].squared;
            });
        }
        return best.count;
    }

  private:
    static constexpr int32_t kLeaf = 12;
    static constexpr int kDeepest = 32;  // halves of what an int32_t counts
    static constexpr int32_t kParts = 128, kLargest = 8192;  // parts of larger trees are built side by side
    struct Item {
        double at[kAxes];
        int32_t row;
        bool before(const Item &o, int axis) const {
            return at[axis] < o.at[axis] || (at[axis] == o.at[axis] && row < o.row);
        }
    };
    struct Node {
        double split;
        int32_t begin, end, right;  // of a leaf right is 0; the left child is the next node
        int axis;
    };
    struct Part {
        int32_t node, begin, end;
    };

    // Nodes of a tree of n points, whose parts of one level differ by one point at most.
    static int32_t nodes_of(int32_t n) {
        int32_t parts = 1;
        while (n / parts > kLeaf) parts *= 2;
        return 2 * parts - 1 + 2 * std::max(n - parts * kLeaf, 0);
    }
    Part half(const Part &part, int which) const {
        const int32_t middle = part.begin + (part.end - part.begin) / 2;
        return which ? Part{nodes_[part.node].right, middle, part.end} : Part{part.node + 1, part.begin, middle};
    }
    // Makes a node, and returns whether it has halves.
    bool split(const Part &part) {
        const auto [at, begin, end] = part;
        nodes_[at] = {0, begin, end, 0, 0};
        if (end - begin <= kLeaf) return false;
        double low[kAxes], high[kAxes];
        std::copy_n(sorted_[begin].at, kAxes, low), std::copy_n(low, kAxes, high);
        for (int32_t i = begin; i < end; ++i)
            for (int a = 0; a < kAxes; ++a) {
                low[a] = std::min(low[a], sorted_[i].at[a]);
                high[a] = std::max(high[a], sorted_[i].at[a]);
            }
        int axis = 0;
        for (int a = 1; a < kAxes; ++a)
            if (high[a] - low[a] > high[axis] - low[axis]) axis = a;
        const int32_t middle = begin + (end - begin) / 2;
        std::nth_element(sorted_.begin() + begin, sorted_.begin() + middle, sorted_.begin() + end,
                         [axis](const Item &a, const Item &b) { return a.before(b, axis); });
        nodes_[at].axis = axis;
        nodes_[at].split = sorted_[middle].at[axis];
        nodes_[at].right = at + 1 + nodes_of(middle - begin);
        return true;
    }
    void build(const Part &part) {
        if (split(part)) build(half(part, 0)), build(half(part, 1));
    }

    // A half that was passed by on the way down: how far its box lies from `at`, along the axis of the split and in all.
    struct Passed {
        int32_t node, axis;
        double offset, distance;
    };

    // Calls take(best, found) for every point that may come before `best`, whose distance bounds the search; `away` is how
    // far the node's box lies from `at` along each axis, `distance` the sum of its squares.
    template <class Best, class Take>
    void search(int32_t node, const double *at, double *away, double distance, Best &best, const Take &take) const {
        Passed passed[kDeepest];
        int deep = 0;
        const Node *n = &nodes_[node];
        for (; n->right; n = &nodes_[node]) {
            const double offset = at[n->axis] - n->split, before = away[n->axis];
            const bool left = offset < 0;
            passed[deep++] = {left ? n->right : node + 1, n->axis, offset, distance - before * before + offset * offset};
            node = left ? node + 1 : n->right;
        }
        for (int32_t i = n->begin; i < n->end; ++i) {
            const Neighbour found{squared(at, sorted_[i].at), sorted_[i].row};
            if (found.squared <= best.squared) take(best, found);
        }
        while (deep) {
            const Passed &p = passed[--deep];
            // Rounding must not hide an equally near point, of which the first counts.
            if (!(p.distance <= best.squared * (1 + 1e-9))) continue;
            const double before = away[p.axis];
            away[p.axis] = p.offset;
            search(p.node, at, away, p.distance, best, take);
            away[p.axis] = before;
        }
    }

    Many<double> points_;
    Many<Item> sorted_;
    Many<Node> nodes_;
};

using PointTree = Tree<3>;

}  // namespace gsmap
