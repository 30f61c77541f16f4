// The maximum clique of a graph.
//
// Graphs are symmetric bit matrices: row i holds ceil(n / 64) words of 64 bits, bit j set where i and j agree. Everything
// is single-threaded and deterministic: the limit counts steps of work (words of bits touched), never time.
#include "clique.h"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "arrays.h"

using Word = std::uint64_t;

namespace {

inline int popcount(Word w) { return __builtin_popcountll(w); }
inline int lowest(Word w) { return __builtin_ctzll(w); }
inline bool has(const Word *row, int i) { return (row[i >> 6] >> (i & 63)) & 1; }
inline void set(Word *row, int i) { row[i >> 6] |= Word(1) << (i & 63); }
inline void unset(Word *row, int i) { row[i >> 6] &= ~(Word(1) << (i & 63)); }

template <class F> inline void for_each_bit(const Word *row, int words, F &&f) {
    for (int w = 0; w < words; ++w)
        for (Word bits = row[w]; bits; bits &= bits - 1) f(w * 64 + lowest(bits));
}

// A square bit matrix.
struct BitGraph {
    int n = 0, words = 0;
    std::vector<Word> bits;
    BitGraph() = default;
    explicit BitGraph(int n_) : n(n_), words((n_ + 63) / 64), bits(std::size_t(n_) * words, 0) {}
    Word *row(int i) { return bits.data() + std::size_t(i) * words; }
    const Word *row(int i) const { return bits.data() + std::size_t(i) * words; }
};

int count(const Word *a, int words) {
    int c = 0;
    for (int w = 0; w < words; ++w) c += popcount(a[w]);
    return c;
}

// The subgraph induced by `members`, renumbered 0, 1, ... in their order.
BitGraph induced(const BitGraph &of, const std::vector<int> &members, long long &steps) {
    BitGraph g(int(members.size()));
    std::vector<Word> among(of.words, 0);
    std::vector<int> place(of.n);
    for (int i = 0; i < g.n; ++i) set(among.data(), members[i]), place[members[i]] = i;
    for (int i = 0; i < g.n; ++i) {
        const Word *row = of.row(members[i]);
        Word *out = g.row(i);
        for (int w = 0; w < of.words; ++w)
            for (Word both = row[w] & among[w]; both; both &= both - 1, ++steps) set(out, place[w * 64 + lowest(both)]);
    }
    steps += (long long)g.n * of.words;
    return g;
}

// Order that removes a vertex of lowest remaining degree each time, and each vertex's core number.
void degeneracy(const BitGraph &g, std::vector<int> &order, std::vector<int> &core) {
    int n = g.n;
    std::vector<int> degree(n);
    int top = 0;
    for (int i = 0; i < n; ++i) top = std::max(top, degree[i] = count(g.row(i), g.words));
    std::vector<int> start(top + 2, 0), position(n);
    for (int d : degree) ++start[d + 1];
    for (int d = 0; d <= top; ++d) start[d + 1] += start[d];
    order.assign(n, 0);
    auto next = start;
    for (int i = 0; i < n; ++i) order[position[i] = next[degree[i]]++] = i;
    core.assign(n, 0);
    // Batagelj and Zaversnik: vertices stay sorted by degree; `start[d]` is the first of degree d.
    for (int k = 0; k < n; ++k) {
        int v = order[k];
        core[v] = degree[v];
        for_each_bit(g.row(v), g.words, [&](int u) {
            if (degree[u] <= degree[v]) return;
            int d = degree[u], pu = position[u], pw = std::max(start[d], k + 1), w = order[pw];
            if (u != w) std::swap(order[pu], order[pw]), position[u] = pw, position[w] = pu;
            start[d] = pw + 1;
            --degree[u];
        });
    }
}

// A clique grown from `first` by always taking the candidate that keeps most candidates.
std::vector<int> grow(const BitGraph &g, int first, long long &steps) {
    std::vector<int> members;
    for_each_bit(g.row(first), g.words, [&](int u) { members.push_back(u); });
    BitGraph sub = induced(g, members, steps);
    std::vector<Word> left(sub.words, 0);
    std::vector<int> degree(sub.n), clique{first};
    for (int i = 0; i < sub.n; ++i) set(left.data(), i), degree[i] = count(sub.row(i), sub.words);
    int remaining = sub.n;
    while (remaining) {
        int best = -1;
        for_each_bit(left.data(), sub.words, [&](int i) {
            if (best < 0 || degree[i] > degree[best]) best = i;
        });
        clique.push_back(members[best]);
        unset(left.data(), best);
        --remaining;
        for (int w = 0; w < sub.words; ++w) {
            Word gone = left[w] & ~sub.row(best)[w];
            left[w] &= ~gone;
            for (; gone; gone &= gone - 1) {
                int u = w * 64 + lowest(gone);
                --remaining;
                for_each_bit(sub.row(u), sub.words, [&](int x) { --degree[x]; });
            }
        }
    }
    return clique;
}

// Whether greedy colouring of `candidates` needs no more than `colours`: then no clique among them is larger.
bool colourable(const BitGraph &g, std::vector<Word> candidates, int colours, long long &steps) {
    int words = int(candidates.size()), first = 0;
    std::vector<Word> available;
    for (int k = 0;; ++k) {
        while (first < words && !candidates[first]) ++first;
        if (first == words) return true;
        if (k == colours) return false;
        available = candidates;
        for (int w = first; w < words; ++w) {
            while (available[w]) {
                int v = w * 64 + lowest(available[w]);
                unset(candidates.data(), v);
                unset(available.data(), v);
                for (int x = w; x < words; ++x) available[x] &= ~g.row(v)[x];
                steps += words - w;
            }
        }
    }
}

// Exact branch and bound inside one subgraph, bounded by greedy colouring with one-step recolouring
// (San Segundo et al. 2011, "An exact bit-parallel algorithm for the maximum clique problem", with Re-NUMBER of
// Tomita et al. 2010).
struct Search {
    const BitGraph &g;
    long long limit, &steps;
    std::vector<int> current, best;
    std::size_t bound;  // cliques must be larger than this to count
    bool stopped = false;
    std::vector<std::vector<Word>> classes;

    Search(const BitGraph &g_, std::size_t bound_, long long limit_, long long &steps_)
        : g(g_), limit(limit_), steps(steps_), bound(bound_) {}

    // Tries to move `v` into a class <= keep by evicting its only neighbour there into another such class.
    bool recolour(int v, int keep) {
        for (int k = 1; k <= keep; ++k) {
            steps += g.words;
            int neighbour = -1, hits = 0;
            for (int w = 0; w < g.words && hits < 2; ++w)
                if (Word both = classes[k][w] & g.row(v)[w]) hits += both & (both - 1) ? 2 : 1, neighbour = w * 64 + lowest(both);
            if (hits == 0) return set(classes[k].data(), v), true;
            if (hits > 1) continue;
            for (int other = k + 1; other <= keep; ++other) {
                bool free = true;
                steps += g.words;
                for (int w = 0; w < g.words && free; ++w) free = !(classes[other][w] & g.row(neighbour)[w]);
                if (!free) continue;
                unset(classes[k].data(), neighbour);
                set(classes[other].data(), neighbour);
                set(classes[k].data(), v);
                return true;
            }
        }
        return false;
    }

    // Colours `candidates`; returns those that could extend `current` past `bound`, by rising colour.
    void colour(const std::vector<Word> &candidates, std::vector<int> &vertices, std::vector<int> &colours) {
        int keep = int(bound) - int(current.size());
        std::vector<Word> left(candidates), available(g.words);
        int remaining = count(left.data(), g.words);
        for (int k = 1; remaining; ++k) {
            if (int(classes.size()) <= k) classes.resize(k + 1);
            classes[k].assign(g.words, 0);
            available = left;
            for (int w = 0; w < g.words; ++w) {
                while (available[w]) {
                    int v = w * 64 + lowest(available[w]);
                    unset(left.data(), v);
                    unset(available.data(), v);
                    for (int x = w; x < g.words; ++x) available[x] &= ~g.row(v)[x];
                    --remaining;
                    steps += g.words;
                    set(classes[k].data(), v);
                    if (k <= keep) continue;
                    if (keep >= 2) {
                        unset(classes[k].data(), v);
                        if (recolour(v, keep)) continue;
                        set(classes[k].data(), v);
                    }
                    vertices.push_back(v);
                    colours.push_back(k);
                }
            }
        }
    }

    void expand(std::vector<Word> &candidates) {
        if (steps > limit) {
            stopped = true;
            return;
        }
        std::vector<int> vertices, colours;
        colour(candidates, vertices, colours);
        std::vector<Word> next(g.words);
        for (int i = int(vertices.size()) - 1; i >= 0 && !stopped; --i) {
            if (current.size() + colours[i] <= bound) return;
            int v = vertices[i];
            current.push_back(v);
            Word any = 0;
            for (int w = 0; w < g.words; ++w) any |= next[w] = candidates[w] & g.row(v)[w];
            if (any)
                expand(next);
            else if (current.size() > bound)
                best = current, bound = current.size();
            current.pop_back();
            unset(candidates.data(), v);
        }
    }
};

}  // namespace

// Maximum clique of a graph given as bit rows, if it has more than `floor` vertices. Returns (members ascending, exact,
// steps).
static std::tuple<std::vector<int>, bool, long long> maximum_clique(const Word *bits, int n, int words, int floor,
                                                                    long long limit) {
    if (n == 0) return {{}, true, 0};
    BitGraph raw(n);
    std::memcpy(raw.bits.data(), bits, raw.bits.size() * sizeof(Word));
    for (int i = 0; i < n; ++i) unset(raw.row(i), i);
    std::vector<int> order, core;
    degeneracy(raw, order, core);
    // Dense cores, last removed, come first: a clique is found from its last vertex, among few vertices before it, and
    // in this order greedy colouring needs few colours.
    std::reverse(order.begin(), order.end());
    long long steps = 0;
    BitGraph g = induced(raw, order, steps);

    // Start from good cliques: grown from the vertices of the densest cores, spread over the order.
    std::vector<int> best;
    int bound = std::max(floor, 1);  // only larger cliques count
    if (floor < 1) best = {0};
    std::vector<char> covered(n, 0);
    for (int v = 0, done = 0; v < n && core[order[v]] >= bound && done < 24 && (done < 3 || steps < limit / 8); ++v) {
        if (covered[v]) continue;
        auto clique = grow(g, v, steps);
        for (int u : clique) covered[u] = 1;
        ++done;
        if (int(clique.size()) > bound) best = clique, bound = int(best.size());
    }

    bool exact = true;
    std::vector<int> members;
    for (int v = 0; v < n && core[order[v]] >= bound && exact; ++v) {
        if (!(exact = steps <= limit)) break;
        std::vector<Word> candidates(g.row(v), g.row(v) + (v >> 6) + 1);
        candidates.back() &= (Word(1) << (v & 63)) - 1;
        members.clear();
        for_each_bit(candidates.data(), int(candidates.size()), [&](int u) { members.push_back(u); });
        if (int(members.size()) < bound || colourable(g, candidates, bound - 1, steps)) continue;
        BitGraph sub = induced(g, members, steps);
        Search search(sub, bound - 1, limit, steps);
        std::vector<Word> all(sub.words, 0);
        for (int i = 0; i < sub.n; ++i) set(all.data(), i);
        search.expand(all);
        if (!search.best.empty()) {
            best = {v};
            for (int i : search.best) best.push_back(members[i]);
            bound = int(best.size());
        }
        exact = !search.stopped;
    }
    for (int &v : best) v = order[v];
    std::sort(best.begin(), best.end());
    return {best, exact, steps};
}

using Bits = nb::ndarray<const Word, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;

void bind_clique(nb::module_ &m) {
    m.def(
        "maximum_clique",
        [](Bits bits, int floor, long long step_limit) {
            std::size_t n = bits.shape(0), words = bits.shape(1);
            if (words != (n + 63) / 64) throw std::invalid_argument("bit rows must hold ceil(n / 64) words");
            std::tuple<std::vector<int>, bool, long long> found;
            {
                nb::gil_scoped_release release;
                found = maximum_clique(bits.data(), int(n), int(words), floor, step_limit);
            }
            auto &[members, exact, steps] = found;
            const std::size_t size = members.size();
            return nb::make_tuple(gsmap::numpy_of(std::move(members), {size}), exact, steps);
        },
        nb::arg("bits"), nb::arg("floor"), nb::arg("step_limit"),
        "Largest clique of more than `floor` vertices: (members, exact, steps of work).");
}
