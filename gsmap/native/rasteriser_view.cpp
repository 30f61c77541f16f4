#include "rasteriser_view.h"

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <utility>

#include "threads.h"

namespace gsmap {

void View::forward(const Scene &scene, const Camera &camera, const int64_t *ranges, int64_t num_ranges,
                   const Image &image) {
    open_image(camera);
    project(scene, ranges, num_ranges);
    sort();
    bin();
    std::vector<int64_t> pairs(size_t(tiles_x_) * tiles_y_);
    parallel_for(int64_t(pairs.size()), [&](int64_t tile) { pairs[tile] = kernels->blend(work(tile), image); });
    pairs_ = 0;
    for (int64_t p : pairs) pairs_ += p;
}

void View::open_image(const Camera &camera) {
    camera_ = camera;
    tiles_x_ = (camera.width + kTile - 1) / kTile, tiles_y_ = (camera.height + kTile - 1) / kTile;
    open_.clear();
}

void View::draw(const Scene &scene, const Camera &camera, const std::vector<Candidates> &candidates, const Image &image) {
    constexpr int64_t kAtOnce = 1 << 16;  // Gaussians of a round: their records stay in the cache
    open_image(camera);
    const int64_t tiles = int64_t(tiles_x_) * tiles_y_;
    uint8_t *states = states_.reserve(size_t(tiles) * kBlendStateBytes);
    open_.resize(tiles);
    std::vector<int64_t> pairs(tiles);
    const auto blend = [&](BlendPart part, bool any) {
        parallel_for(tiles, [&](int64_t tile) {
            TileWork list{nullptr, nullptr, 0, int(tile % tiles_x_), int(tile / tiles_x_), tiles_x_, camera.width, camera.height};
            if (any) list = work(tile);
            if (part != kBlendOn || (open_[tile] && list.count))
                pairs[tile] += kernels->blend_more(list, image, part, states + tile * kBlendStateBytes, &open_[tile]);
        });
    };
    blend(kBlendStart, false);
    constexpr int kAcross = kTile / kBlockX, kDown = kTile / kBlockY;
    const auto is_open = [&](const Candidates &c) {
        for (int y = c.y0; y < c.y1; y++)
            for (int x = c.x0; x < c.x1; x++)
                if (open_[y / kDown * tiles_x_ + x / kAcross] >> (y % kDown * kAcross + x % kAcross) & 1) return true;
        return false;
    };
    std::vector<Part> parts;
    int64_t kept = 0;
    visible_ = intersections_ = 0;
    for (size_t next = 0; next < candidates.size() || kept;) {
        int64_t room = kept;
        chunks_.clear();
        for (; next < candidates.size() && room - kept < kAtOnce * num_threads(); next++) {
            const Candidates &c = candidates[next];
            if (!is_open(c)) continue;
            for (int64_t b = c.begin; b < c.end; b += kChunk) {
                const int64_t e = std::min(c.end, b + kChunk);
                chunks_.push_back({b, e, room, 0, 0, 0, 0});
                room += e - b;
            }
        }
        Record *records = records_.reserve(room);
        std::copy_n(kept_records_.get(), kept, records);
        parallel_for(int64_t(chunks_.size()), [&](int64_t i) {
            Chunk &c = chunks_[i];
            c.count = kernels->project(scene, camera, c.begin, c.end, records + c.first);
        });
        parts.assign(1, {0, kept, 0, 0});
        for (const Chunk &c : chunks_) parts.push_back({c.first, c.count, 0, 0});
        kept = split(parts, next < candidates.size() ? candidates[next].depth : __builtin_inff());
        sort();
        order_ties();
        bin();
        blend(kBlendOn, true);
    }
    blend(kBlendEnd, false);
    pairs_ = 0;
    for (int64_t p : pairs) pairs_ += p;
}

// Keeps the records that may have others before them for the next round, and returns how many; the rest gets keys.
int64_t View::split(const std::vector<Part> &given, float limit) {
    std::vector<Part> parts(given);
    const Record *records = records_.get();
    std::vector<int64_t> slots(parts.size());  // the kept records alone may touch more tiles than 32 bits count
    const auto is_seen = [&](const Record &r) {
        for (int ty = r.ty0; ty < r.ty1; ty++)
            for (int tx = r.tx0; tx < r.tx1; tx++)
                if (open_[ty * tiles_x_ + tx]) return true;
        return false;
    };
    parallel_for(int64_t(parts.size()), [&](int64_t p) {
        Part &part = parts[p];
        for (int64_t i = part.first; i < part.first + part.count; i++) {
            if (!is_seen(records[i])) continue;
            const bool ready = records[i].depth < limit;
            part.ready_before += ready, part.kept_before += !ready;
            slots[p] += ready ? records[i].tiles() : 0;
        }
    });
    int64_t ready = 0, kept = 0, room = 0, touched = 0;
    for (size_t p = 0; p < parts.size(); p++) {
        Part &part = parts[p];
        touched += slots[p];
        ready += std::exchange(part.ready_before, ready), kept += std::exchange(part.kept_before, kept);
        room = std::max(room, part.first + part.count);
    }
    if (touched > int64_t(UINT32_MAX)) throw std::runtime_error("more than 4e9 tile intersections in one view");
    visible_ = ready, intersections_ = touched;
    uint64_t *keys = keys_.reserve(ready);
    Rect *rects = rects_.reserve(room);
    Record *later = kept_records_.reserve(kept);
    parallel_for(int64_t(parts.size()), [&](int64_t p) {
        Part part = parts[p];
        for (int64_t i = part.first; i < part.first + part.count; i++) {
            const Record &r = records[i];
            if (!is_seen(r)) continue;
            if (!(r.depth < limit)) {
                later[part.kept_before++] = r;
                continue;
            }
            rects[i] = {r.tx0, r.ty0, r.tx1, r.ty1};
            uint32_t depth;
            std::memcpy(&depth, &r.depth, 4);  // positive floats order as integers
            keys[part.ready_before++] = uint64_t(depth) << 32 | uint32_t(i);
        }
    });
    return kept;
}

// Brings those of equal depth in the order of the scene.
void View::order_ties() {
    uint64_t *keys = const_cast<uint64_t *>(order_);
    const Record *records = records_.get();
    for (int64_t i = 0, end; i < visible_; i = end) {
        for (end = i + 1; end < visible_ && keys[end] >> 32 == keys[i] >> 32;) ++end;
        if (end - i > 1)
            std::sort(keys + i, keys + end, [&](uint64_t a, uint64_t b) {
                return records[uint32_t(a)].id < records[uint32_t(b)].id;
            });
    }
}

void View::pixels_backward(const Image &image, const ImageGradient &gradient) {
    float *slots = slots_.reserve(size_t(intersections_) * kMoments);
    parallel_for(int64_t(tiles_x_) * tiles_y_,
                 [&](int64_t tile) { kernels->blend_backward(work(tile), image, gradient, slots); });
}

void View::chunk_backward(int64_t chunk, const Scene &scene, const SceneGradient &gradient, double *pose) const {
    const Chunk &c = chunks_[chunk];
    kernels->project_backward(scene, camera_, records_.get() + c.first, c.count, slots_.get(), gradient, pose);
}

void View::backward(const Scene &scene, const Image &image, const ImageGradient &image_gradient,
                    const SceneGradient &gradient, double *pose) {
    pixels_backward(image, image_gradient);
    struct Pose {
        double d[12] = {};
    };
    std::vector<Pose> part(pose ? chunks_.size() : 0);  // summed in order: the same for any number of threads
    parallel_for(int64_t(chunks_.size()),
                 [&](int64_t i) { chunk_backward(i, scene, gradient, pose ? part[i].d : nullptr); });
    for (const Pose &p : part)
        for (int r = 0; r < 3; r++) {
            for (int c = 0; c < 3; c++) pose[4 * r + c] += p.d[3 * r + c];
            pose[4 * r + 3] += p.d[9 + r];
        }
}

int64_t View::workspace_bytes() const {
    return int64_t(records_.bytes() + kept_records_.bytes() + states_.bytes() + rects_.bytes() + keys_.bytes() +
                   spare_.bytes() + list_.bytes() + slots_.bytes() + starts_.bytes() + chunks_.capacity() * sizeof(Chunk));
}

void View::project(const Scene &scene, const int64_t *ranges, int64_t num_ranges) {
    chunks_.clear();
    const int64_t all[2] = {0, scene.n};
    if (!ranges) ranges = all, num_ranges = 1;
    int64_t candidates = 0;
    for (int64_t i = 0; i < num_ranges; i++)
        for (int64_t b = ranges[2 * i]; b < ranges[2 * i + 1]; b += kChunk) {
            const int64_t e = b + kChunk < ranges[2 * i + 1] ? b + kChunk : ranges[2 * i + 1];
            chunks_.push_back({b, e, candidates, 0, 0, 0, 0});
            candidates += e - b;
        }
    Record *records = records_.reserve(candidates);
    Rect *rects = rects_.reserve(candidates);
    parallel_for(int64_t(chunks_.size()), [&](int64_t i) {
        Chunk &c = chunks_[i];
        c.count = kernels->project(scene, camera_, c.begin, c.end, records + c.first);
        c.slots = 0;
        for (int64_t r = c.first; r < c.first + c.count; r++) c.slots += records[r].tiles();
    });
    int64_t visible = 0, slots = 0;
    for (Chunk &c : chunks_) {
        c.visible_before = uint32_t(visible), c.slots_before = uint32_t(slots);
        visible += c.count, slots += c.slots;
    }
    if (slots > int64_t(UINT32_MAX)) throw std::runtime_error("more than 4e9 tile intersections in one view");
    visible_ = visible, intersections_ = slots;
    uint64_t *keys = keys_.reserve(visible);
    parallel_for(int64_t(chunks_.size()), [&](int64_t i) {
        const Chunk &c = chunks_[i];
        uint32_t slot = c.slots_before;
        for (int j = 0; j < c.count; j++) {
            Record &r = records[c.first + j];
            r.slot = slot, slot += r.tiles();
            rects[c.first + j] = {r.tx0, r.ty0, r.tx1, r.ty1};
            uint32_t depth;
            std::memcpy(&depth, &r.depth, 4);  // positive floats order as integers
            keys[c.visible_before + j] = uint64_t(depth) << 32 | uint32_t(c.first + j);
        }
    });
}

// Radix sort by depth, stable, so that ties keep the order of the scene.
void View::sort() {
    constexpr int kBits = 11, kBuckets = 1 << kBits;
    uint64_t *from = keys_.get(), *to = spare_.reserve(visible_);
    const int64_t parts = visible_ < 8192 ? 1 : num_threads(), n = visible_;
    std::vector<uint32_t> counts(parts * kBuckets);
    for (int shift = 32; shift < 64; shift += kBits) {
        std::fill(counts.begin(), counts.end(), 0u);
        parallel_for(parts, [&](int64_t p) {
            uint32_t *count = &counts[p * kBuckets];
            for (int64_t i = n * p / parts; i < n * (p + 1) / parts; i++) count[from[i] >> shift & (kBuckets - 1)]++;
        });
        uint32_t sum = 0;
        for (int b = 0; b < kBuckets; b++)
            for (int64_t p = 0; p < parts; p++) {
                const uint32_t c = counts[p * kBuckets + b];
                counts[p * kBuckets + b] = sum, sum += c;
            }
        parallel_for(parts, [&](int64_t p) {
            uint32_t *at = &counts[p * kBuckets];
            for (int64_t i = n * p / parts; i < n * (p + 1) / parts; i++)
                to[at[from[i] >> shift & (kBuckets - 1)]++] = from[i];
        });
        std::swap(from, to);
    }
    order_ = from;
}

// Counting sort into tiles, stable, so that every tile's list is in order of depth.
void View::bin() {
    const int64_t tiles = int64_t(tiles_x_) * tiles_y_, n = visible_, parts = n < 8192 ? 1 : num_threads();
    std::vector<uint32_t> counts(parts * tiles);
    const Rect *rects = rects_.get();
    auto visit = [&](int64_t p, auto &&body) {
        const int64_t end = n * (p + 1) / parts;
        for (int64_t i = n * p / parts; i < end; i++) {
            if (i + 16 < end) __builtin_prefetch(&rects[uint32_t(order_[i + 16])]);
            const uint32_t record = uint32_t(order_[i]);
            const Rect r = rects[record];
            for (int ty = r.ty0; ty < r.ty1; ty++)
                for (int tx = r.tx0; tx < r.tx1; tx++)
                    if (open_.empty() || open_[ty * tiles_x_ + tx]) body(ty * tiles_x_ + tx, record);
        }
    };
    parallel_for(parts, [&](int64_t p) {
        uint32_t *count = &counts[p * tiles];
        visit(p, [&](int tile, uint32_t) { count[tile]++; });
    });
    uint32_t *starts = starts_.reserve(tiles + 1), sum = 0;
    for (int64_t t = 0; t < tiles; t++) {
        starts[t] = sum;
        for (int64_t p = 0; p < parts; p++) {
            const uint32_t c = counts[p * tiles + t];
            counts[p * tiles + t] = sum, sum += c;
        }
    }
    starts[tiles] = sum;
    uint32_t *list = list_.reserve(intersections_);
    parallel_for(parts, [&](int64_t p) {
        uint32_t *at = &counts[p * tiles];
        visit(p, [&](int tile, uint32_t record) { list[at[tile]++] = record; });
    });
}

TileWork View::work(int64_t tile) const {
    const uint32_t *starts = starts_.get();
    return {records_.get(), list_.get() + starts[tile], int64_t(starts[tile + 1] - starts[tile]),
            int(tile % tiles_x_), int(tile / tiles_x_), tiles_x_, camera_.width, camera_.height};
}

}  // namespace gsmap
