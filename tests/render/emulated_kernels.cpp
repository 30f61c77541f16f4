// The CUDA kernels on the CPU, called by name as the CUDA driver calls them.
#include "cuda_emulation.h"

#include <algorithm>
#include <string>
#include <utility>

constexpr size_t kFloats = 1 << 16;
constexpr float kGuard = 12345.f;
static float shared_floats[kFloats];
#define SHARED_FLOATS(name) float *name = shared_floats
#include "blending_weights.cu"
#include "fitter.cu"

template <class... T, size_t... I>
void call(void (*kernel)(T...), void **arguments, unsigned grid, unsigned size, std::index_sequence<I...>) {
    emulation::run(grid, size, [=] { kernel(*(T *)arguments[I]...); });
}

template <class... T> void call(void (*kernel)(T...), void **arguments, unsigned grid, unsigned size) {
    call(kernel, arguments, grid, size, std::index_sequence_for<T...>());
}

// Returns 1 if there is no such kernel, 2 if it writes beyond its bytes of shared memory.
extern "C" int launch(const char *name, unsigned grid, unsigned size, unsigned shared, void **arguments) {
    const std::string wanted = name;
    std::fill(shared_floats + shared / sizeof(float), shared_floats + kFloats, kGuard);
#define KERNEL(one)                                                 \
    if (wanted == #one) {                                           \
        call(one, arguments, grid, size);                           \
        return shared_floats[shared / sizeof(float)] == kGuard ? 0 : 2; \
    }
    KERNEL(blend_weights)
    KERNEL(project)
    KERNEL(list_tiles)
    KERNEL(blend)
    KERNEL(blend_backward)
    KERNEL(loss_slopes)
    KERNEL(loss_gradient)
    KERNEL(update)
    return 1;
}
