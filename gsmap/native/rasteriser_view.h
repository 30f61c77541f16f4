// One view through the pipeline: owns the workspaces and splits the work over threads.
#pragma once
#include <cstdlib>
#include <memory>
#include <new>
#include <vector>

#include "rasteriser.h"

namespace gsmap {

// The kernels in use: the best this machine can run, unless a test chose others.
extern const Kernels *kernels;

// Memory that is not cleared and only grows: workspaces are used again for the next view.
template <class T> class Buffer {
  public:
    T *reserve(size_t count) {
        if (count > capacity_) {
            data_.reset();
            capacity_ = 0;
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

struct Chunk {
    int64_t begin, end, first;  // Gaussians, and the first of its records
    int count;                  // visible
    uint32_t visible_before, slots, slots_before;
};

// A run of Gaussians that may be visible: none is nearer than `depth`, and none reaches a block of pixels outside of the box.
struct Candidates {
    int64_t begin, end;
    float depth;
    int32_t x0, y0, x1, y1;  // in blocks of the image, half open
};

class View {
  public:
    // Renders without what a backward pass needs, in less time and memory: what lies behind opaque Gaussians is left out.
    // The candidates come nearest first. The image is the same, bit by bit.
    void draw(const Scene &, const Camera &, const std::vector<Candidates> &, const Image &);
    // Renders; ranges are (num_ranges, 2) rows of Gaussians that may be visible, or null for all.
    void forward(const Scene &, const Camera &, const int64_t *ranges, int64_t num_ranges, const Image &);
    // The backward pass in two halves: pixels to slots, then the slots of one chunk to gradients.
    void pixels_backward(const Image &, const ImageGradient &);
    void chunk_backward(int64_t chunk, const Scene &, const SceneGradient &, double *pose) const;
    // Both halves, for all chunks; pose is (3, 4) row major and added to, or null.
    void backward(const Scene &, const Image &, const ImageGradient &, const SceneGradient &, double *pose);

    const std::vector<Chunk> &chunks() const { return chunks_; }
    int64_t visible() const { return visible_; }
    int64_t intersections() const { return intersections_; }
    int64_t pairs() const { return pairs_; }
    int64_t workspace_bytes() const;
    int width() const { return camera_.width; }
    int height() const { return camera_.height; }

  private:
    struct Rect {
        uint16_t tx0, ty0, tx1, ty1;
    };
    // Records of a round of `draw`, and how many of those before them are ready to be blended, and are kept for the next.
    struct Part {
        int64_t first, count, ready_before, kept_before;
    };
    void open_image(const Camera &);
    void project(const Scene &, const int64_t *ranges, int64_t num_ranges);
    int64_t split(const std::vector<Part> &, float limit);
    void order_ties();
    void sort();
    void bin();
    TileWork work(int64_t tile) const;

    Camera camera_{};
    int tiles_x_ = 0, tiles_y_ = 0;
    std::vector<Chunk> chunks_;
    Buffer<Record> records_, kept_records_;
    Buffer<uint8_t> states_;  // of the tiles, for `draw`
    Buffer<Rect> rects_;
    Buffer<uint64_t> keys_, spare_;
    Buffer<uint32_t> list_, starts_;
    Buffer<float> slots_;
    const uint64_t *order_ = nullptr;
    std::vector<uint32_t> open_;  // of each tile, the blocks that light still comes through; empty: all tiles
    int64_t visible_ = 0, intersections_ = 0, pairs_ = 0;
};

}  // namespace gsmap
