"""Image metrics of novel view synthesis. Images are (H, W, 3|4) floats in [0, 1], alpha straight."""

from __future__ import annotations

import math

import cv2
import numpy as np

from edge_se_sampler.sampling.edges import edge_strength

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5  # side and standard deviation of SSIM's Gaussian window, in pixels
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def composite_on(image: np.ndarray, background_color: float = 1.0) -> np.ndarray:
    """The image in front of a gray background (1: white), (H, W, 3)."""
    if image.shape[2] == 3:
        return image
    return image[..., :3] * image[..., 3:] + background_color * (1 - image[..., 3:])


def psnr(mse: float) -> float:
    """-10 log10(mse), in dB; an exact match counts as 100 dB, so that results stay valid json."""
    return 100.0 if mse <= 1e-10 else -10 * math.log10(mse)


def ssim(first: np.ndarray, second: np.ndarray, mask: np.ndarray | None = None) -> float | None:
    """Mean over pixels, those of a mask (H, W) bool if there is one, and channels of the structural similarity (Wang et
    al. 2004) of two (H, W, 3) images, with Gaussian windows within the image; None if there is no such window."""
    if min(first.shape[:2]) < SSIM_WINDOW:
        return None
    border = SSIM_WINDOW // 2

    def local_mean(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (SSIM_WINDOW, SSIM_WINDOW), SSIM_SIGMA)[border:-border, border:-border]

    x, y = (image.astype(np.float32, copy=False) for image in (first, second))  # twice as fast
    mean_x, mean_y = local_mean(x), local_mean(y)
    squares, difference = mean_x * mean_x + mean_y * mean_y, x - y
    variances = local_mean(x * x + y * y) - squares
    # var(x) + var(y) - 2 cov(x, y), of numbers so small that float32 is exact enough where images are flat
    of_difference = local_mean(difference * difference) - (mean_x - mean_y) ** 2
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (squares + SSIM_C1)
    similarity = luminance * (1 - of_difference / (variances + SSIM_C2))
    if mask is not None:
        similarity = similarity[mask[border:-border, border:-border]]
    return float(similarity.mean(dtype=np.float64)) if similarity.size else None


def edge_band(image: np.ndarray) -> np.ndarray:
    """Where an image (H, W, 3) has its strongest 10 % of edges, and their neighbors, (H, W) bool; nowhere in a flat
    one."""
    edges = edge_strength(image)
    band = edges >= max(float(np.quantile(edges, 0.9)), 1e-6)
    return cv2.dilate(band.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def compute_metrics(
    rendered: np.ndarray, image: np.ndarray, background_color: float, mask: np.ndarray | None = None
) -> dict[str, float | None]:
    """All metrics of a rendering (H, W, 3) of an image; None where there is nothing to measure (no alpha, no object).
    mse is over pixels and channels, foreground_psnr where alpha > 0, background_mse where alpha = 0; pixels outside a
    mask (H, W) bool are unknown: they count in none of them."""
    target = composite_on(image, background_color)
    known = np.ones(target.shape[:2], dtype=bool) if mask is None else mask
    rendered = np.where(known[..., None], rendered, target)  # or SSIM's windows would look beyond the mask
    error = ((rendered.astype(np.float64) - target) ** 2).mean(axis=2)
    foreground = image[..., 3] > 0 if image.shape[2] == 4 else None

    def mean_error(pixels: np.ndarray | None) -> float | None:
        return None if pixels is None or not (pixels & known).any() else float(error[pixels & known].mean())

    def psnr_of(mse: float | None) -> float | None:
        return None if mse is None else psnr(mse)

    mse = mean_error(known)
    return {
        "mse": mse,
        "psnr": psnr_of(mse),
        "ssim": ssim(rendered, target, mask),
        "foreground_psnr": psnr_of(mean_error(foreground)),
        "edge_band_psnr": psnr_of(mean_error(edge_band(target))),
        "background_mse": None if foreground is None else mean_error(~foreground),
    }
