"""A float64 renderer in plain torch: every pixel against every Gaussian, nothing approximated. For small scenes."""

from __future__ import annotations

import math

import torch

_C0, _C1 = 0.28209479177387814, 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def sh_basis(d, k):
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, _C0), -_C1 * y, _C1 * z, -_C1 * x]
    basis += [_C2[0] * x * y, _C2[1] * y * z, _C2[2] * (2 * zz - xx - yy), _C2[3] * x * z, _C2[4] * (xx - yy)]
    basis += [_C3[0] * y * (3 * xx - yy), _C3[1] * x * y * z, _C3[2] * y * (4 * zz - xx - yy)]
    basis += [_C3[3] * z * (2 * zz - 3 * xx - 3 * yy), _C3[4] * x * (4 * zz - xx - yy), _C3[5] * z * (xx - yy)]
    basis += [_C3[6] * x * (xx - 3 * yy)]
    return torch.stack(basis[:k], -1)


def rotations(q):
    w, x, y, z = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def render_reference(means, quats, log_scales, logits, sh, pose, intrinsics, width, height, background=(0, 0, 0)):
    """float64 (colour, depth, alpha, dominant_id, max_weight) of one view; every tensor float64, pose (4, 4)."""
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    R, t = pose[:3, :3], pose[:3, 3]
    p = means @ R.T + t
    keep = (p[:, 2] > 0.01).nonzero()[:, 0]
    p, z = p[keep], p[keep, 2]
    M = rotations(quats[keep]) * log_scales[keep].exp()[:, None, :]
    cov = R @ (M @ M.transpose(1, 2)) @ R.T
    lx = ((width - cx) / fx + 0.15 * width / fx, cx / fx + 0.15 * width / fx)
    ly = ((height - cy) / fy + 0.15 * height / fy, cy / fy + 0.15 * height / fy)
    ux = (p[:, 0] / z).clamp(-lx[1], lx[0])
    uy = (p[:, 1] / z).clamp(-ly[1], ly[0])
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * ux / z, zero, fy / z, -fy * uy / z], -1).reshape(-1, 2, 3)
    cov2 = J @ cov @ J.transpose(1, 2) + 0.3 * torch.eye(2, dtype=means.dtype)
    mean2 = torch.stack([fx * p[:, 0] / z + cx, fy * p[:, 1] / z + cy], -1)
    conic = torch.linalg.inv(cov2)
    direction = means[keep] + R.T @ t
    direction = direction / direction.norm(dim=-1, keepdim=True)
    colour = (torch.einsum("nk,nkc->nc", sh_basis(direction, sh.shape[1]), sh[keep]) + 0.5).clamp_min(0)
    opacity = torch.sigmoid(logits[keep])
    order = torch.argsort(z.to(torch.float32), stable=True)
    ys, xs = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixel = torch.stack([xs, ys], -1).reshape(-1, 2).to(means.dtype)
    d = pixel[:, None] - mean2[order][None]
    c = conic[order]
    power = 0.5 * (c[:, 0, 0] * d[..., 0] ** 2 + c[:, 1, 1] * d[..., 1] ** 2) + c[:, 0, 1] * d[..., 0] * d[..., 1]
    raw = opacity[order] * torch.exp(-power)
    alpha = raw.clamp_max(0.99)
    alpha = torch.where(raw >= 1 / 255, alpha, torch.zeros_like(alpha))
    T_after = torch.cumprod(1 - alpha, 1)
    T = torch.cat([torch.ones_like(T_after[:, :1]), T_after[:, :-1]], 1)
    weight = torch.where(T_after > 1e-4, alpha * T, torch.zeros_like(alpha))
    total = weight.sum(1)
    image = weight @ colour[order] + (1 - total)[:, None] * torch.as_tensor(background, dtype=means.dtype)
    depth = (weight @ z[order]) / total.clamp_min(1e-300)
    best, which = weight.max(1) if len(keep) else (total, total.long())
    dominant = torch.where(best > 0, keep[order][which], -1) if len(keep) else torch.full_like(which, -1)
    max_weight = torch.zeros(len(means), dtype=means.dtype)
    if len(keep):
        max_weight[keep[order]] = weight.max(0).values.detach()
    shape = (height, width)
    # how near each pixel is to one of the two cuts, for tests that compare away from them
    cut = torch.minimum(
        ((raw * 255 - 1).abs()).amin(1) if len(keep) else torch.ones_like(total),
        ((T_after / 1e-4 - 1).abs()).amin(1) if len(keep) else torch.ones_like(total),
    )
    return {
        "colour": image.reshape(*shape, 3),
        "depth": depth.reshape(shape),
        "alpha": total.reshape(shape),
        "dominant_id": dominant.reshape(shape),
        "max_weight": max_weight,
        "cut": cut.reshape(shape),
        "weight": weight,
    }


def log_opacity(o: float) -> float:
    return math.log(o / (1 - o))
