"""Compare two images by PSNR, SSIM and LPIPS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsmap.errors import InputError, MissingDependencyError, NotFoundError
from gsmap.networks import ModelProcess, refuse_external_data
from gsmap.types.model import ModelLimits

_SSIM_SIGMA_PX = 1.5
_SSIM_RADIUS_PX = 5


def psnr(image: np.ndarray, reference: np.ndarray, known: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB of two images (H, W, 3) in [0, 1]; infinite for equal images.

    Args:
        known: (H, W) mask of pixels to compare; None for all.
    """
    image, reference = _pair(image, reference)
    squared = (image - reference) ** 2
    error = np.mean(squared if known is None else squared[known])
    return float(-10 * np.log10(error)) if error > 0 else float("inf")


def ssim(image: np.ndarray, reference: np.ndarray, known: np.ndarray | None = None) -> float:
    """Return the structural similarity of two images (H, W, 3) in [0, 1], averaged over channels and pixels.

    As in Wang et al. 2004: an 11 x 11 Gaussian window of 1.5 px, K1 = 0.01, K2 = 0.03, only where the window fits into
    the image.

    Args:
        known: (H, W) mask of pixels to compare; windows with other pixels do not count. None for all.

    Raises:
        InputError: the images, or their known parts, are smaller than the window.
    """
    from scipy.ndimage import binary_erosion, gaussian_filter

    image, reference = _pair(image, reference)
    if min(image.shape[:2]) <= 2 * _SSIM_RADIUS_PX:
        raise InputError(
            f"SSIM needs images of at least 11 x 11 pixels, got {image.shape[1]} x {image.shape[0]}",
            code="picture_too_small",
        )

    def blur(values: np.ndarray) -> np.ndarray:
        r = _SSIM_RADIUS_PX
        return gaussian_filter(values, (_SSIM_SIGMA_PX, _SSIM_SIGMA_PX, 0), radius=(r, r, 0))[r:-r, r:-r]

    mean_a, mean_b = blur(image), blur(reference)
    variance_a = blur(image * image) - mean_a * mean_a
    variance_b = blur(reference * reference) - mean_b * mean_b
    covariance = blur(image * reference) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    likeness = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    likeness /= (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    if known is not None:
        r = _SSIM_RADIUS_PX
        likeness = likeness[binary_erosion(known, np.ones((2 * r + 1, 2 * r + 1)))[r:-r, r:-r]]
        if not len(likeness):
            raise InputError("SSIM needs 11 x 11 known pixels, and an image has none", code="picture_too_small")
    return float(np.mean(likeness))


class Lpips:
    """Learned perceptual distance (Zhang et al. 2018), computed by a network that the user supplies; 0 for equal
    images.

    Args:
        path: an ONNX file with two image inputs (1, 3, H, W), RGB in [-1, 1], whose first output is the distance.
        limits: limits of memory and time.

    Raises:
        MissingDependencyError: no file was specified; gsmap does not ship the weights.
        NotFoundError: the file does not exist.
        InputError: the file is not an LPIPS network, or it exceeds the limits.
    """

    def __init__(self, path: str | Path | None, limits: ModelLimits | None = None) -> None:
        if path is None:
            raise MissingDependencyError(
                "LPIPS needs network weights that gsmap does not ship: pass lpips.LPIPS exported to ONNX"
            )
        if not Path(path).is_file():
            raise NotFoundError(f"there is no LPIPS network {path}", code="file_not_found")
        refuse_external_data(Path(path))
        self._model = ModelProcess(str(path), limits or ModelLimits())
        self._inputs = [tensor.name for tensor in self._model.inputs]
        if len(self._inputs) != 2:
            raise InputError(
                f"{path} takes {len(self._inputs)} inputs, but an LPIPS network takes two images", code="model_misfit"
            )

    def __call__(self, image: np.ndarray, reference: np.ndarray) -> float:
        """Return the distance between two images (H, W, 3) with values in [0, 1]."""
        pair = [np.ascontiguousarray(v.transpose(2, 0, 1)[None] * 2 - 1, np.float32) for v in _pair(image, reference)]
        try:
            return float(np.mean(self._model.run(None, dict(zip(self._inputs, pair, strict=True)))[0]))
        except RuntimeError as error:
            raise InputError(
                f"the LPIPS network {self._model.path} does not run on {image.shape}: {error}", code="model_failed"
            ) from error


def _pair(image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    image, reference = (np.clip(np.asarray(v, dtype=np.float64), 0, 1) for v in (image, reference))
    if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InputError(
            f"images to compare must both be (H, W, 3), got {image.shape} and {reference.shape}", code="shape_mismatch"
        )
    return image, reference
