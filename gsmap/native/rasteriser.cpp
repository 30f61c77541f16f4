// One view through the pipeline: owns the workspaces, splits the work over threads, picks the instruction set.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "rasteriser.h"
#include "threads.h"

namespace nb = nanobind;

namespace gsmap {
#ifndef GSMAP_X86_KERNELS
const Kernels *kernels_avx512 = nullptr, *kernels_avx2 = nullptr;
#endif

namespace {

const Kernels *best_kernels() {
#ifdef GSMAP_X86_KERNELS
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl"))
        return kernels_avx512;
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return kernels_avx2;
#endif
    return kernels_baseline;
}
const Kernels *kernels = best_kernels();

// Memory that is not cleared and only grows: workspaces are used again for the next view.
template <class T> class Buffer {
  public:
    T *reserve(size_t count) {
        if (count > capacity_) {
            data_.reset();
            const size_t bytes = (count * sizeof(T) + 63) / 64 * 64;
            data_.reset(static_cast<T *>(std::aligned_alloc(64, bytes)));
            if (!data_) throw std::bad_alloc();
            capacity_ = count;
        }
        return data_.get();
    }
    T *get() const { return data_.get(); }
    size_t bytes() const { return capacity_ * sizeof(T); }

  private:
    struct Free {
        void operator()(T *p) const { std::free(p); }
    };
    std::unique_ptr<T, Free> data_;
    size_t capacity_ = 0;
};

struct Rect {
    uint16_t tx0, ty0, tx1, ty1;
};
struct Chunk {
    int64_t begin, end, first;  // Gaussians, and the first of its records
    int count;                  // visible
    uint32_t visible_before, slots, slots_before;
};

using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using FloatsOut = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using DoublesOut = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Ints = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;
using Ranges = nb::ndarray<const int64_t, nb::c_contig, nb::device::cpu>;

Scene scene_of(const Floats &means, const Floats &quats, const Floats &log_scales, const Floats &logits, const Floats &sh) {
    return {means.data(), quats.data(), log_scales.data(), logits.data(), sh.data(), int64_t(means.shape(0)), int(sh.shape(1))};
}

class View {
  public:
    // T_camera_world (3, 4), intrinsics fx fy cx cy; ranges (m, 2) of Gaussians that may be visible, or none for all.
    void forward(Floats means, Floats quats, Floats log_scales, Floats logits, Floats sh, Doubles pose, Doubles intrinsics,
                 int width, int height, std::optional<Ranges> ranges, Floats background, FloatsOut colour,
                 std::optional<FloatsOut> depth, FloatsOut alpha, std::optional<Ints> dominant_id,
                 std::optional<FloatsOut> max_weight) {
        const Scene scene = scene_of(means, quats, log_scales, logits, sh);
        for (int r = 0; r < 3; r++) {
            for (int c = 0; c < 3; c++) camera_.R[3 * r + c] = pose.data()[4 * r + c];
            camera_.t[r] = pose.data()[4 * r + 3];
        }
        const double *k = intrinsics.data();
        camera_.fx = k[0], camera_.fy = k[1], camera_.cx = k[2], camera_.cy = k[3];
        camera_.width = width, camera_.height = height;
        tiles_x_ = (width + kTile - 1) / kTile, tiles_y_ = (height + kTile - 1) / kTile;
        std::memcpy(background_, background.data(), sizeof background_);
        nb::gil_scoped_release release;
        project(scene, ranges ? ranges->data() : nullptr, ranges ? int64_t(ranges->shape(0)) : 0);
        sort();
        bin();
        Image image{colour.data(), depth ? depth->data() : nullptr, alpha.data(),
                    dominant_id ? dominant_id->data() : nullptr, max_weight ? max_weight->data() : nullptr, {}};
        std::memcpy(image.background, background_, sizeof background_);
        std::vector<int64_t> pairs(size_t(tiles_x_) * tiles_y_);
        parallel_for(int64_t(pairs.size()), [&](int64_t tile, int) { pairs[tile] = kernels->blend(work(tile), image); });
        pairs_ = 0;
        for (int64_t p : pairs) pairs_ += p;
    }

    // Adds to the gradients given; what was rendered must be unchanged since forward().
    void backward(Floats means, Floats quats, Floats log_scales, Floats logits, Floats sh, FloatsOut colour,
                  std::optional<FloatsOut> depth, FloatsOut alpha, std::optional<Floats> g_colour,
                  std::optional<Floats> g_depth, std::optional<Floats> g_alpha, FloatsOut g_means, FloatsOut g_quats,
                  FloatsOut g_log_scales, FloatsOut g_logits, FloatsOut g_sh, std::optional<FloatsOut> g_mean2d,
                  std::optional<DoublesOut> g_pose) {
        const Scene scene = scene_of(means, quats, log_scales, logits, sh);
        const SceneGradient gradient{g_means.data(), g_quats.data(), g_log_scales.data(), g_logits.data(), g_sh.data(),
                                     g_mean2d ? g_mean2d->data() : nullptr};
        Image image{colour.data(), depth ? depth->data() : nullptr, alpha.data(), nullptr, nullptr, {}};
        std::memcpy(image.background, background_, sizeof background_);
        const ImageGradient g{g_colour ? g_colour->data() : nullptr, g_depth ? g_depth->data() : nullptr,
                              g_alpha ? g_alpha->data() : nullptr};
        double *pose = g_pose ? g_pose->data() : nullptr;
        nb::gil_scoped_release release;
        float *slots = slots_.reserve(size_t(intersections_) * kMoments);
        parallel_for(int64_t(tiles_x_) * tiles_y_,
                     [&](int64_t tile, int) { kernels->blend_backward(work(tile), image, g, slots); });
        struct Pose {
            double d[12] = {};
        };
        std::vector<Pose> part(pose ? chunks_.size() : 0);  // summed in order: the same for any number of threads
        parallel_for(int64_t(chunks_.size()), [&](int64_t i, int) {
            const Chunk &c = chunks_[i];
            kernels->project_backward(scene, camera_, records_.get() + c.first, c.count, slots, gradient,
                                      pose ? part[i].d : nullptr);
        });
        for (const Pose &p : part)
            for (int r = 0; r < 3; r++) {
                for (int c = 0; c < 3; c++) pose[4 * r + c] += p.d[3 * r + c];
                pose[4 * r + 3] += p.d[9 + r];
            }
    }

    int64_t visible() const { return visible_; }
    int64_t intersections() const { return intersections_; }
    int64_t pairs() const { return pairs_; }
    int64_t workspace_bytes() const {
        return int64_t(records_.bytes() + rects_.bytes() + keys_.bytes() + spare_.bytes() + list_.bytes() + slots_.bytes() +
                       starts_.bytes() + chunks_.capacity() * sizeof(Chunk));
    }

  private:
    void project(const Scene &scene, const int64_t *ranges, int64_t num_ranges) {
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
        parallel_for(int64_t(chunks_.size()), [&](int64_t i, int) {
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
        parallel_for(int64_t(chunks_.size()), [&](int64_t i, int) {
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
    void sort() {
        constexpr int kBits = 11, kBuckets = 1 << kBits;
        uint64_t *from = keys_.get(), *to = spare_.reserve(visible_);
        const int64_t parts = visible_ < 8192 ? 1 : num_threads(), n = visible_;
        std::vector<uint32_t> counts(parts * kBuckets);
        for (int shift = 32; shift < 64; shift += kBits) {
            std::fill(counts.begin(), counts.end(), 0u);
            parallel_for(parts, [&](int64_t p, int) {
                uint32_t *count = &counts[p * kBuckets];
                for (int64_t i = n * p / parts; i < n * (p + 1) / parts; i++) count[from[i] >> shift & (kBuckets - 1)]++;
            });
            uint32_t sum = 0;
            for (int b = 0; b < kBuckets; b++)
                for (int64_t p = 0; p < parts; p++) {
                    const uint32_t c = counts[p * kBuckets + b];
                    counts[p * kBuckets + b] = sum, sum += c;
                }
            parallel_for(parts, [&](int64_t p, int) {
                uint32_t *at = &counts[p * kBuckets];
                for (int64_t i = n * p / parts; i < n * (p + 1) / parts; i++)
                    to[at[from[i] >> shift & (kBuckets - 1)]++] = from[i];
            });
            std::swap(from, to);
        }
        order_ = from;
    }

    // Counting sort into tiles, stable, so that every tile's list is in order of depth.
    void bin() {
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
                    for (int tx = r.tx0; tx < r.tx1; tx++) body(ty * tiles_x_ + tx, record);
            }
        };
        parallel_for(parts, [&](int64_t p, int) {
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
        parallel_for(parts, [&](int64_t p, int) {
            uint32_t *at = &counts[p * tiles];
            visit(p, [&](int tile, uint32_t record) { list[at[tile]++] = record; });
        });
    }

    TileWork work(int64_t tile) const {
        const uint32_t *starts = starts_.get();
        return {records_.get(), list_.get() + starts[tile], int64_t(starts[tile + 1] - starts[tile]),
                int(tile % tiles_x_), int(tile / tiles_x_), tiles_x_, camera_.width, camera_.height};
    }

    Camera camera_{};
    float background_[3] = {};
    int tiles_x_ = 0, tiles_y_ = 0;
    std::vector<Chunk> chunks_;
    Buffer<Record> records_;
    Buffer<Rect> rects_;
    Buffer<uint64_t> keys_, spare_;
    Buffer<uint32_t> list_, starts_;
    Buffer<float> slots_;
    const uint64_t *order_ = nullptr;
    int64_t visible_ = 0, intersections_ = 0, pairs_ = 0;
};

std::string use_instruction_set(const std::string &name) {
    const Kernels *best = best_kernels();
    const Kernels *offered[] = {kernels_baseline, kernels_avx2, kernels_avx512};
    if (name == "best") kernels = best;
    for (const Kernels *k : offered) {
        if (k && name == k->name) kernels = k;
        if (k == best) break;  // what follows cannot run here
    }
    return kernels->name;
}

}  // namespace

void bind_rasteriser(nb::module_ &m) {
    nb::class_<View>(m, "View", "One rendered view and what its backward pass needs.")
        .def(nb::init<>())
        .def("forward", &View::forward, nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"), nb::arg("logit_opacities"),
             nb::arg("sh"), nb::arg("pose"), nb::arg("intrinsics"), nb::arg("width"), nb::arg("height"),
             nb::arg("ranges").none(), nb::arg("background"), nb::arg("colour"), nb::arg("depth").none(), nb::arg("alpha"),
             nb::arg("dominant_id").none(), nb::arg("max_weight").none())
        .def("backward", &View::backward, nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"),
             nb::arg("logit_opacities"), nb::arg("sh"), nb::arg("colour"), nb::arg("depth").none(), nb::arg("alpha"),
             nb::arg("g_colour").none(), nb::arg("g_depth").none(), nb::arg("g_alpha").none(), nb::arg("g_means"),
             nb::arg("g_quats"), nb::arg("g_log_scales"), nb::arg("g_logit_opacities"), nb::arg("g_sh"),
             nb::arg("g_mean2d").none(), nb::arg("g_pose").none())
        .def_prop_ro("visible", &View::visible)
        .def_prop_ro("intersections", &View::intersections)
        .def_prop_ro("pairs", &View::pairs)
        .def_prop_ro("workspace_bytes", &View::workspace_bytes);
    m.def("use_instruction_set", &use_instruction_set, nb::arg("name"),
          "Chooses baseline, avx2, avx512 or best, where this machine can run it; returns the one in use.");
    m.def("num_threads", &num_threads);
    m.def("set_num_threads", &set_num_threads);
}

}  // namespace gsmap
