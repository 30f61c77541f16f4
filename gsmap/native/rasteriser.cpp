// What Python sees of the rasteriser.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdlib>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "bindings.h"
#include "rasteriser_view.h"
#include "threads.h"

namespace gsmap {
#ifndef GSMAP_X86_KERNELS
const Kernels *kernels_avx512 = nullptr, *kernels_avx2 = nullptr;
#endif

// The widest that this machine can run.
static const Kernels *widest_kernels() {
#ifdef GSMAP_X86_KERNELS
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl"))
        return kernels_avx512;
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return kernels_avx2;
#endif
    return kernels_baseline;
}
static const Kernels *best = widest_kernels();
const Kernels *kernels = best;

namespace {

// T_camera_world (3, 4), intrinsics fx fy cx cy.
Camera camera_of(const Doubles &pose, const Doubles &intrinsics, int width, int height) {
    Camera camera{};
    for (int r = 0; r < 3; r++) {
        for (int c = 0; c < 3; c++) camera.R[3 * r + c] = pose.data()[4 * r + c];
        camera.t[r] = pose.data()[4 * r + 3];
    }
    const double *k = intrinsics.data();
    camera.fx = k[0], camera.fy = k[1], camera.cx = k[2], camera.cy = k[3];
    camera.width = width, camera.height = height;
    return camera;
}

// Of each candidate, nearest first: rows (begin, end), the least depth, and the blocks (x0, y0, x1, y1) that it may touch.
void draw(View &view, const Floats &means, const Floats &quats, const Floats &log_scales, const Floats &logits,
          const Floats &sh, const Doubles &pose, const Doubles &intrinsics, int width, int height, const Ranges &ranges,
          const Floats &depths, const Ranges &blocks, const Floats &background, const FloatsOut &colour,
          const std::optional<FloatsOut> &depth, const FloatsOut &alpha, const std::optional<Ints> &dominant_id,
          const std::optional<FloatsOut> &max_weight, const std::optional<FloatsOut> &centre) {
    const Camera camera = camera_of(pose, intrinsics, width, height);
    const Scene scene = scene_of(means, quats, log_scales, logits, sh);
    Image image = image_of(background, colour, depth, alpha);
    image.dominant_id = dominant_id ? dominant_id->data() : nullptr;
    image.max_weight = max_weight ? max_weight->data() : nullptr;
    image.centre = centre ? centre->data() : nullptr;
    if (centre && (!depth || dominant_id || max_weight)) throw std::invalid_argument("centres come with depths alone");
    const size_t n = depths.size();
    if (ranges.size() != 2 * n || blocks.size() != 4 * n) throw std::invalid_argument("candidates need rows, a depth, a box");
    std::vector<Candidates> candidates(n);
    const int64_t across = (width + kBlockX - 1) / kBlockX, down = (height + kBlockY - 1) / kBlockY;
    for (size_t i = 0; i < n; i++) {
        const int64_t *rows = ranges.data() + 2 * i, *box = blocks.data() + 4 * i;
        if (rows[0] < 0 || rows[1] > scene.n || box[0] < 0 || box[1] < 0 || box[2] > across || box[3] > down)
            throw std::invalid_argument("candidates lie in the scene and in the image");
        candidates[i] = {rows[0], rows[1], depths.data()[i], int(box[0]), int(box[1]), int(box[2]), int(box[3])};
    }
    nb::gil_scoped_release release;
    view.draw(scene, camera, candidates, image);
}

// See draw; ranges (m, 2) of Gaussians that may be visible, or none for all.
void forward(View &view, const Floats &means, const Floats &quats, const Floats &log_scales, const Floats &logits,
             const Floats &sh, const Doubles &pose, const Doubles &intrinsics, int width, int height,
             const std::optional<Ranges> &ranges, const Floats &background, const FloatsOut &colour,
             const std::optional<FloatsOut> &depth, const FloatsOut &alpha, const std::optional<Ints> &dominant_id,
             const std::optional<FloatsOut> &max_weight, const std::optional<Floats> &looked_at) {
    const Camera camera = camera_of(pose, intrinsics, width, height);
    const Scene scene = scene_of(means, quats, log_scales, logits, sh);
    Image image = image_of(background, colour, depth, alpha);
    image.dominant_id = dominant_id ? dominant_id->data() : nullptr;
    image.max_weight = max_weight ? max_weight->data() : nullptr;
    image.looked_at = looked_at ? looked_at->data() : nullptr;
    nb::gil_scoped_release release;
    view.forward(scene, camera, ranges ? ranges->data() : nullptr, ranges ? int64_t(ranges->shape(0)) : 0, image);
}

// Adds to the gradients given (of means, quats, log-scales, logit-opacities, SH; or none of them); what was rendered must be unchanged since forward().
void backward(View &view, const Floats &means, const Floats &quats, const Floats &log_scales, const Floats &logits,
              const Floats &sh, const Floats &background, const FloatsOut &colour, const std::optional<FloatsOut> &depth,
              const FloatsOut &alpha, const std::optional<Floats> &g_colour, const std::optional<Floats> &g_depth,
              const std::optional<Floats> &g_alpha, const std::optional<std::vector<FloatsOut>> &gradients,
              const std::optional<DoublesOut> &g_pose) {
    const Scene scene = scene_of(means, quats, log_scales, logits, sh);
    SceneGradient gradient{};
    if (gradients) {
        const auto &g = *gradients;
        if (g.size() != 5) throw std::invalid_argument("five gradients or none");
        gradient.means = g[0].data(), gradient.quats = g[1].data(), gradient.log_scales = g[2].data();
        gradient.logit_opacities = g[3].data(), gradient.sh = g[4].data();
    }
    const Image image = image_of(background, colour, depth, alpha);
    const ImageGradient g{g_colour ? g_colour->data() : nullptr, g_depth ? g_depth->data() : nullptr,
                          g_alpha ? g_alpha->data() : nullptr, nullptr};
    double *pose = g_pose ? g_pose->data() : nullptr;
    nb::gil_scoped_release release;
    view.backward(scene, image, g, gradient, pose);
}

std::string use_instruction_set(const std::string &name) {
    const Kernels *offered[] = {kernels_baseline, kernels_avx2, kernels_avx512}, *widest = widest_kernels();
    if (name == "best") kernels = best;
    for (const Kernels *k : offered) {
        if (k && name == k->name) kernels = k;
        if (k == widest) break;  // what follows cannot run here
    }
    return kernels->name;
}

// Other instructions round otherwise: machines that share a map's work can be told to use the same.
void obey_environment() {
    const char *told = std::getenv("GSMAP_INSTRUCTION_SET");
    if (!told || !*told) return;
    if (use_instruction_set(told) != told)
        throw std::runtime_error(std::string("GSMAP_INSTRUCTION_SET=") + told + ": this machine runs " +
                                 widest_kernels()->name + " and what is narrower of baseline, avx2, avx512");
    best = kernels;
}

}  // namespace

void bind_rasteriser(nb::module_ &m) {
    obey_environment();
    const auto none = [](const char *name) { return nb::arg(name).none(); };
    nb::class_<View>(m, "View", "One rendered view and what its backward pass needs.")
        .def(nb::init<>())
        .def("forward", &forward, nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"), nb::arg("logit_opacities"),
             nb::arg("sh"), nb::arg("pose"), nb::arg("intrinsics"), nb::arg("width"), nb::arg("height"), none("ranges"),
             nb::arg("background"), nb::arg("colour"), none("depth"), nb::arg("alpha"), none("dominant_id"),
             none("max_weight"), none("looked_at"))
        .def("draw", &draw, nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"), nb::arg("logit_opacities"),
             nb::arg("sh"), nb::arg("pose"), nb::arg("intrinsics"), nb::arg("width"), nb::arg("height"), nb::arg("ranges"),
             nb::arg("depths"), nb::arg("blocks"), nb::arg("background"), nb::arg("colour"), none("depth"), nb::arg("alpha"),
             none("dominant_id"), none("max_weight"), none("centre"))
        .def("backward", &backward, nb::arg("means"), nb::arg("quats"), nb::arg("log_scales"), nb::arg("logit_opacities"),
             nb::arg("sh"), nb::arg("background"), nb::arg("colour"), none("depth"), nb::arg("alpha"), none("g_colour"),
             none("g_depth"), none("g_alpha"), none("gradients"), none("g_pose"))
        .def_prop_ro("visible", &View::visible)
        .def_prop_ro("intersections", &View::intersections)
        .def_prop_ro("pairs", &View::pairs)
        .def_prop_ro("workspace_bytes", &View::workspace_bytes);
    m.def("use_instruction_set", &use_instruction_set, nb::arg("name"),
          "Chooses baseline, avx2, avx512 or best (what the environment says, else the widest), where this machine can run "
          "it; returns the one in use.");
    m.def("blend_limit", [](int64_t repeats) { return kernels->blend_limit(repeats); }, nb::arg("repeats"),
          nb::call_guard<nb::gil_scoped_release>(),
          "Runs the blending loop alone on data in L1; returns how many (Gaussian, pixel) pairs it blended.");
    m.def("num_threads", &num_threads);
    m.def("set_num_threads", &set_num_threads);
}

}  // namespace gsmap
