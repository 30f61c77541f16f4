"""What is wrong with the captures that people have: exposure, fog, strays, a bent sensor, few cameras, a part missing.

Every function takes a trained capture (Gaussians and cameras of one frame, metres) and gives it back worse; the frame
stays, so that the capture's truth holds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.geometry.sh import rgb_of_sh0, sh0_of_rgb
from gsmap.geometry.umeyama import umeyama
from gsmap.types import Cameras, Gaussians
from gsmap_synthetic.capture import Frames


def tinted(gaussians: Gaussians, gain: np.ndarray, gamma: float) -> Gaussians:
    """Another exposure and white balance: mean colours become ``gain * colour ** gamma``, gain (3,)."""
    colour = np.clip(rgb_of_sh0(gaussians.sh[:, 0]), 1e-3, None)
    sh = gaussians.sh.copy()
    sh[:, 0] = sh0_of_rgb(gain * colour**gamma)
    sh[:, 1:] *= np.asarray(gain, np.float32)
    return replace(gaussians, sh=sh)


def strewn(gaussians: Gaussians, rng: np.random.Generator, share: float, *, size_m: float, opacity: float) -> Gaussians:
    """Strays within the capture's box: ``share`` times as many Gaussians of any colour, ``size_m`` across in the mean.

    Small and opaque ones are what trainers leave in free air; large and faint ones are haze.
    """
    count = int(share * len(gaussians))
    low, high = np.percentile(gaussians.means, [2, 98], axis=0)
    base = gaussians[rng.integers(0, len(gaussians), count)]
    sh = np.zeros_like(base.sh)
    sh[:, 0] = sh0_of_rgb(rng.uniform(0.1, 0.9, (count, 3)))
    stray = replace(
        base,
        means=rng.uniform(low, high, (count, 3)).astype(np.float32),
        log_scales=np.log(size_m * rng.lognormal(0, 0.5, (count, 3))).astype(np.float32),
        logit_opacities=np.full_like(base.logit_opacities, np.log(opacity / (1 - opacity))),
        sh=sh,
    )
    return Gaussians.concatenate([gaussians, stray])


def bent(gaussians: Gaussians, rng: np.random.Generator, noise_m: float, bend_m: float) -> Gaussians:
    """A real sensor's geometry: every centre off by ``noise_m`` (standard deviation), and the whole bent smoothly.

    The bend is a sum of waves some 3 to 8 m long, ``bend_m`` root mean square an axis, less the similarity that comes
    nearest to it: that would be another pose, not a bend.
    """
    x = gaussians.means.astype(np.float64)
    off = np.zeros_like(x)
    waves = 6
    for _ in range(waves):
        direction = rng.normal(size=3)
        wave = 2 * np.pi * direction / np.linalg.norm(direction) / rng.uniform(3, 8)
        off += rng.normal(size=3) * np.sin(x @ wave + rng.uniform(0, 2 * np.pi))[:, None]
    off *= bend_m / max(float(np.sqrt((off**2).mean())), 1e-9)
    moved = umeyama(x, x + off, with_scale=True).apply(x + off)
    noise = rng.normal(size=x.shape) * noise_m
    return replace(gaussians, means=(moved + noise).astype(np.float32))


def cut(gaussians: Gaussians, cameras: Cameras, rng: np.random.Generator, share: float) -> tuple[Gaussians, Cameras]:
    """Only ``share`` of the capture, on one side of an upright plane of its own; cameras that stand beyond it go."""
    directions = rng.normal(size=3)
    middle = np.median(gaussians.means, axis=0)
    along = (gaussians.means - middle) @ directions
    bar = np.quantile(along, share)
    stands = np.flatnonzero((cameras.centers - middle) @ directions <= bar)
    if len(stands) < 6:  # Too few stand on this side: those nearest to it stay.
        stands = np.sort(np.argsort((cameras.centers - middle) @ directions)[:6])
    return gaussians[np.flatnonzero(along <= bar)], cameras[stands]


def sensed(frames: Frames, rng: np.random.Generator, strength: float) -> Frames:
    """Frames as a hand-held depth sensor delivers them; ``strength`` 1 is a structured-light camera of the first years.

    Depth is off by noise that grows with its square (Khoshelham and Elberink 2012: 1.5 mm at 1 m) and smoothly over the
    image (a lens that nobody calibrated), colour lies up to some pixels beside it, is blurred by motion, and changes
    its exposure from frame to frame.
    """
    from scipy.ndimage import gaussian_filter, shift

    assert frames.depths_m is not None
    count, height, width = frames.depths_m.shape
    v, u = np.mgrid[0:height, 0:width] / [[[height]], [[width]]] - 0.5
    lens = 1 + strength * 0.02 * (rng.normal() * (u**2 + v**2) + rng.normal() * u + rng.normal() * v)
    beside = rng.uniform(-3, 3, 2) * strength * width / 320
    images, depths = np.empty_like(frames.images), np.empty_like(frames.depths_m)
    for i in range(count):
        depth = frames.depths_m[i]
        coarse = gaussian_filter(rng.normal(size=depth.shape), 1.0)
        noise = coarse / coarse.std() * 0.0015 * strength * depth**2
        depths[i] = np.where(depth > 0, depth * lens + noise, 0)
        colour = shift(frames.images[i].astype(np.float32), (*beside, 0), order=1, mode="nearest")
        colour = gaussian_filter(colour, (0.5 * strength, 0.5 * strength, 0)) * rng.normal(1, 0.05 * strength)
        images[i] = np.clip(colour + rng.normal(0, 4 * strength, colour.shape), 0, 255).astype(np.uint8)
    return Frames(images, frames.cameras, depths)
