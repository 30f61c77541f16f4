// Blends the Gaussians listed for each tile once more, near to far, as gsplat does: the dominant Gaussian of each pixel,
// and the largest weight of each Gaussian. One thread for each pixel of a tile.

constexpr int SIDE = 16, PIXELS = SIDE * SIDE;
constexpr float MAX_ALPHA_GSPLAT = 0.999f;  // from version 1.5 on
constexpr unsigned EVERY_LANE = 0xffffffffu;

extern "C" __global__ void blend_weights(const float *means2d, const float *conics, const float *opacities,
                                         const int *listed, const int *starts, const int *ends, int *shown, float *largest,
                                         int height, int width, int down, int across, int want_largest) {
    __shared__ float kept[PIXELS][6];
    __shared__ int ids[PIXELS];
    const int tile = blockIdx.x, thread = threadIdx.x, lane = thread % 32;
    const int x = tile % across * SIDE + thread % SIDE, y = tile / across % down * SIDE + thread / SIDE;
    const bool inside = x < width && y < height;
    bool alive = inside;
    float clear = 1.f, best = 0.f;
    int dominant = -1;
    for (int base = starts[tile]; base < ends[tile]; base += PIXELS) {
        if (!__syncthreads_or(alive)) break;
        if (base + thread < ends[tile]) {
            const long long id = listed[base + thread];
            ids[thread] = int(id);
            kept[thread][0] = means2d[2 * id], kept[thread][1] = means2d[2 * id + 1];
            for (int i = 0; i < 3; i++) kept[thread][2 + i] = conics[3 * id + i];
            kept[thread][5] = opacities[id];
        }
        __syncthreads();
        for (int k = 0; k < PIXELS && base + k < ends[tile]; k++) {
            const float *g = kept[k], dx = x + 0.5f - g[0], dy = y + 0.5f - g[1];
            const float power = 0.5f * (g[2] * dx * dx + g[4] * dy * dy) + g[3] * dx * dy;
            const float alpha = fminf(g[5] * expf(-power), MAX_ALPHA_GSPLAT), behind = clear * (1.f - alpha);
            float weight = 0.f;
            if (alive && power >= 0.f && alpha >= 1.f / 255.f) {
                if (behind > 1e-4f) {
                    weight = alpha * clear, clear = behind;
                    if (weight > best) best = weight, dominant = ids[k];
                } else {
                    alive = false;
                }
            }
            if (!want_largest || !__any_sync(EVERY_LANE, weight > 0.f)) continue;
            for (int step = 16; step; step /= 2) weight = fmaxf(weight, __shfl_xor_sync(EVERY_LANE, weight, step));
            if (lane == 0) atomicMax((int *)largest + ids[k], __float_as_int(weight));
        }
    }
    if (inside) shown[(tile / across / down * height + y) * width + x] = dominant;
}
