"""Triton kernels of the CUDA backend: blending weights, image loss and Adam. They are imported only if they can run.

Each kernel computes the same as a torch function beside its caller, in one launch instead of dozens. Kernels are not
specialized on image sizes, because every new size would be compiled again.
"""

import triton
import triton.language as tl


@triton.jit(do_not_specialize=["height", "width", "down", "across"])
def blend_tile(
    means2d,
    conics,
    opacities,
    listed,
    starts,
    ends,
    shown,
    largest,
    height,
    width,
    down,
    across,
    SIZE: tl.constexpr,
    MAX_WEIGHT: tl.constexpr,
    MIN_ALPHA: tl.constexpr,
    MAX_ALPHA: tl.constexpr,
    MIN_TRANSMITTANCE: tl.constexpr,
):
    """Blend the Gaussians listed for one tile of one view, near to far, as gsplat does."""
    tile = tl.program_id(0)
    view = tile // (down * across)
    inner = tl.arange(0, SIZE * SIZE)
    row = tile // across % down * SIZE + inner // SIZE
    column = tile % across * SIZE + inner % SIZE
    inside = (row < height) & (column < width)
    alive = tl.where(inside, 1, 0)
    clear = tl.full((SIZE * SIZE,), 1.0, tl.float32)
    best = tl.zeros((SIZE * SIZE,), tl.float32)
    dominant = tl.full((SIZE * SIZE,), -1, tl.int32)
    at = tl.load(starts + tile)
    end = tl.load(ends + tile)
    going = tl.max(alive, 0)
    while (at < end) & (going > 0):
        g = tl.load(listed + at).to(tl.int64)
        dx = column + 0.5 - tl.load(means2d + 2 * g)
        dy = row + 0.5 - tl.load(means2d + 2 * g + 1)
        a = tl.load(conics + 3 * g)
        b = tl.load(conics + 3 * g + 1)
        c = tl.load(conics + 3 * g + 2)
        power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = tl.minimum(tl.load(opacities + g) * tl.exp(-power), MAX_ALPHA)
        hit = (alive > 0) & (power >= 0) & (alpha >= MIN_ALPHA)
        behind = clear * (1 - alpha)
        drawn = hit & (behind > MIN_TRANSMITTANCE)
        alive = tl.where(hit & (behind <= MIN_TRANSMITTANCE), 0, alive)
        weight = tl.where(drawn, alpha * clear, 0.0)
        clear = tl.where(drawn, behind, clear)
        better = weight > best
        dominant = tl.where(better, g.to(tl.int32), dominant)
        best = tl.where(better, weight, best)
        if MAX_WEIGHT:
            most = tl.max(weight, 0)
            if most > 0:
                tl.atomic_max(largest + g, most)
        at += 1
        going = tl.max(alive, 0)
    tl.store(shown + (view * height + row) * width + column, dominant, mask=inside)


@triton.jit(do_not_specialize=["last", "n"])
def adam_rows(
    means,
    quats,
    log_scales,
    logits,
    sh,
    g_means,
    g_quats,
    g_scales,
    g_opacities,
    g_sh,
    m_means,
    m_quats,
    m_scales,
    m_opacities,
    m_sh,
    v_means,
    v_quats,
    v_scales,
    v_opacities,
    v_sh,
    scales,
    opacities,
    frozen,
    updates,
    counted,
    corrections,
    last,
    n,
    rates,
    beta1,
    beta2,
    epsilon,
    SH: tl.constexpr,
    SH_PADDED: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Apply one Adam step of all attributes to the rows that have a gradient and are not frozen.

    Gradients are with respect to the activated scales and opacities; the kernel applies the chain rule to logarithms
    and logits.
    """
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    free = (row < n) & (tl.load(frozen + row, mask=row < n, other=1) == 0)
    touched = tl.load(g_opacities + row, mask=free, other=0.0) != 0
    for j in tl.static_range(3):
        touched = touched | (tl.load(g_means + row.to(tl.int64) * 3 + j, mask=free, other=0.0) != 0)
        touched = touched | (tl.load(g_scales + row.to(tl.int64) * 3 + j, mask=free, other=0.0) != 0)
        touched = touched | (tl.load(g_sh + row.to(tl.int64) * SH + j, mask=free, other=0.0) != 0)
    for j in tl.static_range(4):
        touched = touched | (tl.load(g_quats + row.to(tl.int64) * 4 + j, mask=free, other=0.0) != 0)
    # Do not count in place: several threads process a row, and one might read a value that another has written.
    count = tl.load(updates + row, mask=row < n, other=0) + touched.to(tl.int32)
    tl.store(counted + row, count, mask=row < n)
    corrected = tl.minimum(count, last)
    first = tl.load(corrections + 2 * corrected, mask=touched, other=1.0)
    second = tl.load(corrections + 2 * corrected + 1, mask=touched, other=1.0)
    rate_means = tl.load(rates)
    rate_quats = tl.load(rates + 1)
    rate_scales = tl.load(rates + 2)
    rate_opacities = tl.load(rates + 3)
    rate_base = tl.load(rates + 4)
    rate_rest = tl.load(rates + 5)
    alpha = tl.load(opacities + row, mask=touched, other=0.0)
    _adam_part(
        means,
        g_means,
        m_means,
        v_means,
        scales,
        row,
        touched,
        first,
        second,
        rate_means,
        rate_means,
        beta1,
        beta2,
        epsilon,
        3,
        4,
        0,
        ROWS,
    )
    _adam_part(
        quats,
        g_quats,
        m_quats,
        v_quats,
        scales,
        row,
        touched,
        first,
        second,
        rate_quats,
        rate_quats,
        beta1,
        beta2,
        epsilon,
        4,
        4,
        0,
        ROWS,
    )
    _adam_part(
        log_scales,
        g_scales,
        m_scales,
        v_scales,
        scales,
        row,
        touched,
        first,
        second,
        rate_scales,
        rate_scales,
        beta1,
        beta2,
        epsilon,
        3,
        4,
        1,
        ROWS,
    )
    _adam_part(
        sh,
        g_sh,
        m_sh,
        v_sh,
        scales,
        row,
        touched,
        first,
        second,
        rate_base,
        rate_rest,
        beta1,
        beta2,
        epsilon,
        SH,
        SH_PADDED,
        0,
        ROWS,
    )
    g = tl.load(g_opacities + row, mask=touched, other=0.0) * alpha * (1 - alpha)
    m = beta1 * tl.load(m_opacities + row, mask=touched, other=0.0) + (1 - beta1) * g
    v = beta2 * tl.load(v_opacities + row, mask=touched, other=0.0) + (1 - beta2) * g * g
    value = tl.load(logits + row, mask=touched, other=0.0)
    tl.store(m_opacities + row, m, mask=touched)
    tl.store(v_opacities + row, v, mask=touched)
    tl.store(logits + row, value - rate_opacities * first * m / (tl.sqrt(v) * second + epsilon), mask=touched)


@triton.jit
def _adam_part(
    values,
    gradients,
    means,
    squares,
    scales,
    row,
    touched,
    first,
    second,
    rate_base,
    rate_rest,
    beta1,
    beta2,
    epsilon,
    COLUMNS: tl.constexpr,
    PADDED: tl.constexpr,
    SCALED: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Apply `adam_rows` to one attribute with several columns; the first three columns of SH have their own rate."""
    column = tl.arange(0, PADDED)
    at = row.to(tl.int64)[:, None] * COLUMNS + column[None, :]
    mask = touched[:, None] & (column < COLUMNS)[None, :]
    g = tl.load(gradients + at, mask=mask, other=0.0)
    if SCALED:
        g = g * tl.load(scales + at, mask=mask, other=0.0)
    m = beta1 * tl.load(means + at, mask=mask, other=0.0) + (1 - beta1) * g
    v = beta2 * tl.load(squares + at, mask=mask, other=0.0) + (1 - beta2) * g * g
    rate = tl.where(column < 3, rate_base, rate_rest)[None, :]
    value = tl.load(values + at, mask=mask, other=0.0)
    tl.store(means + at, m, mask=mask)
    tl.store(squares + at, v, mask=mask)
    tl.store(values + at, value - rate * first[:, None] * m / (tl.sqrt(v) * second[:, None] + epsilon), mask=mask)


@triton.jit(do_not_specialize=["height", "width3"], do_not_specialize_on_alignment=["images", "targets", "maps"])
def ssim_columns(images, targets, maps, window, height, width3, BYTES: tl.constexpr, BLOCK: tl.constexpr):
    """Blur images, targets and their products along columns; rows of 3 * width values, as (H, W, 3) lie in memory."""
    y = tl.program_id(0)
    x = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = x < width3
    a = tl.zeros((BLOCK,), tl.float32)
    b = tl.zeros((BLOCK,), tl.float32)
    aa = tl.zeros((BLOCK,), tl.float32)
    bb = tl.zeros((BLOCK,), tl.float32)
    ab = tl.zeros((BLOCK,), tl.float32)
    for j in tl.static_range(11):
        row = y + j - 5
        there = inside & (row >= 0) & (row < height)
        w = tl.load(window + j)
        p = tl.load(images + row * width3 + x, mask=there, other=0.0)
        q = tl.load(targets + row * width3 + x, mask=there, other=0).to(tl.float32)
        if BYTES:
            q = q / 255.0
        a += w * p
        b += w * q
        aa += w * p * p
        bb += w * q * q
        ab += w * p * q
    at = y * width3 + x
    size = height * width3
    tl.store(maps + at, a, mask=inside)
    tl.store(maps + size + at, b, mask=inside)
    tl.store(maps + 2 * size + at, aa, mask=inside)
    tl.store(maps + 3 * size + at, bb, mask=inside)
    tl.store(maps + 4 * size + at, ab, mask=inside)


@triton.jit(
    do_not_specialize=["height", "width3"],
    do_not_specialize_on_alignment=["images", "targets", "masks", "maps", "slopes", "sums"],
)
def ssim_rows(
    images,
    targets,
    masks,
    maps,
    slopes,
    sums,
    window,
    height,
    width3,
    huber_delta,
    BYTES: tl.constexpr,
    MASKED: tl.constexpr,
    MASK_BYTES: tl.constexpr,
    SSIM: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Finish the blur along rows; compute SSIM and its slopes from the three blurred maps, and the sums of both losses
    and of weights."""
    y = tl.program_id(0)
    x = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = x < width3
    at = y * width3 + x
    size = height * width3
    w = tl.where(inside, 1.0, 0.0)
    if MASKED:
        w = tl.load(masks + at // 3, mask=inside, other=0).to(tl.float32)
        if MASK_BYTES:
            w = w / 255.0
    p = tl.load(images + at, mask=inside, other=0.0)
    q = tl.load(targets + at, mask=inside, other=0).to(tl.float32)
    if BYTES:
        q = q / 255.0
    difference = tl.abs(p - q)
    loss = tl.where(
        difference < huber_delta,
        difference * difference / (2 * tl.maximum(huber_delta, 1e-30)),
        difference - 0.5 * huber_delta,
    )
    tl.atomic_add(sums, tl.sum(w * loss, 0))
    tl.atomic_add(sums + 2, tl.sum(w, 0))
    if SSIM:
        a = tl.zeros((BLOCK,), tl.float32)
        b = tl.zeros((BLOCK,), tl.float32)
        aa = tl.zeros((BLOCK,), tl.float32)
        bb = tl.zeros((BLOCK,), tl.float32)
        ab = tl.zeros((BLOCK,), tl.float32)
        for j in tl.static_range(11):
            column = x + 3 * (j - 5)
            there = inside & (column >= 0) & (column < width3)
            k = tl.load(window + j)
            from_ = maps + y * width3 + column
            a += k * tl.load(from_, mask=there, other=0.0)
            b += k * tl.load(from_ + size, mask=there, other=0.0)
            aa += k * tl.load(from_ + 2 * size, mask=there, other=0.0)
            bb += k * tl.load(from_ + 3 * size, mask=there, other=0.0)
            ab += k * tl.load(from_ + 4 * size, mask=there, other=0.0)
        light = 2 * a * b + 0.0001
        structure = 2 * (ab - a * b) + 0.0009
        light_norm = a * a + b * b + 0.0001
        structure_norm = (aa - a * a) + (bb - b * b) + 0.0009
        inverse = 1.0 / (light_norm * structure_norm)
        value = light * structure * inverse
        by_ab = 2 * light * inverse
        by_aa = -value / structure_norm
        by_a = 2 * b * structure * inverse - 2 * a * value / light_norm - by_ab * b - 2 * by_aa * a
        tl.atomic_add(sums + 1, tl.sum(w * value, 0))
        tl.store(slopes + at, w * by_a, mask=inside)
        tl.store(slopes + size + at, w * by_aa, mask=inside)
        tl.store(slopes + 2 * size + at, w * by_ab, mask=inside)


@triton.jit(do_not_specialize=["height", "width3"], do_not_specialize_on_alignment=["slopes", "blurred"])
def slope_columns(slopes, blurred, window, height, width3, BLOCK: tl.constexpr):
    """Blur the slopes of SSIM along columns."""
    y = tl.program_id(0)
    x = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = x < width3
    size = height * width3
    a = tl.zeros((BLOCK,), tl.float32)
    aa = tl.zeros((BLOCK,), tl.float32)
    ab = tl.zeros((BLOCK,), tl.float32)
    for j in tl.static_range(11):
        row = y + j - 5
        there = inside & (row >= 0) & (row < height)
        w = tl.load(window + j)
        from_ = slopes + row * width3 + x
        a += w * tl.load(from_, mask=there, other=0.0)
        aa += w * tl.load(from_ + size, mask=there, other=0.0)
        ab += w * tl.load(from_ + 2 * size, mask=there, other=0.0)
    at = y * width3 + x
    tl.store(blurred + at, a, mask=inside)
    tl.store(blurred + size + at, aa, mask=inside)
    tl.store(blurred + 2 * size + at, ab, mask=inside)


@triton.jit(
    do_not_specialize=["height", "width3"],
    do_not_specialize_on_alignment=["images", "targets", "masks", "blurred", "sums", "gradient", "losses"],
)
def loss_gradient(
    images,
    targets,
    masks,
    blurred,
    sums,
    window,
    gradient,
    losses,
    height,
    width3,
    ssim_weight,
    huber_delta,
    share,
    BYTES: tl.constexpr,
    MASKED: tl.constexpr,
    MASK_BYTES: tl.constexpr,
    SSIM: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute the gradient of the loss of one view, multiplied by its share; also store the loss once."""
    y = tl.program_id(0)
    x = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = x < width3
    at = y * width3 + x
    size = height * width3
    total = tl.load(sums + 2)  # sum over three channels
    scale = tl.where(total > 0, 1.0 / tl.maximum(total, 1e-30), 0.0)
    w = tl.where(inside, 1.0, 0.0)
    if MASKED:
        w = tl.load(masks + at // 3, mask=inside, other=0).to(tl.float32)
        if MASK_BYTES:
            w = w / 255.0
    p = tl.load(images + at, mask=inside, other=0.0)
    q = tl.load(targets + at, mask=inside, other=0).to(tl.float32)
    if BYTES:
        q = q / 255.0
    d = p - q
    sign = tl.where(d > 0, 1.0, tl.where(d < 0, -1.0, 0.0))
    slope = tl.where(tl.abs(d) < huber_delta, d / tl.maximum(huber_delta, 1e-30), sign)
    out = (1 - ssim_weight) * w * slope
    if SSIM:
        a = tl.zeros((BLOCK,), tl.float32)
        aa = tl.zeros((BLOCK,), tl.float32)
        ab = tl.zeros((BLOCK,), tl.float32)
        for j in tl.static_range(11):
            column = x + 3 * (j - 5)
            there = inside & (column >= 0) & (column < width3)
            k = tl.load(window + j)
            from_ = blurred + y * width3 + column
            a += k * tl.load(from_, mask=there, other=0.0)
            aa += k * tl.load(from_ + size, mask=there, other=0.0)
            ab += k * tl.load(from_ + 2 * size, mask=there, other=0.0)
        out -= ssim_weight * (a + 2 * p * aa + q * ab)
    tl.store(gradient + at, share * scale * out, mask=inside)
    if (y == 0) & (tl.program_id(1) == 0):
        loss = (1 - ssim_weight) * tl.load(sums) * scale
        if SSIM:
            loss += tl.where(total > 0, ssim_weight * (1 - tl.load(sums + 1) * scale), 0.0)
        tl.store(losses, loss)
