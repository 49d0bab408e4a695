"""A figure of what a sampler does to images: view, probability of every pixel, and the pixels of a batch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from edge_se_sampler.data.datamanager import image_batch
from edge_se_sampler.data.scene_file import quote
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.figures import printable, require_pyplot, save_figure
from edge_se_sampler.engine.metrics import composite_on
from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.distribution import PixelTable
from edge_se_sampler.sampling.edges import luma, unit_float
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import Distribution
from edge_se_sampler.sampling.random_streams import Stream, stream
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

MOST_VIEWS = 100
"""A figure of more is larger than matplotlib draws."""


def probability_map(distribution: Distribution, batch: ImageBatch, k: int) -> np.ndarray:
    """Probability of every pixel of the kth view, (H, W); it sums to 1, or to 0 if all pixels are masked."""
    if type(distribution).strength is Distribution.strength:  # it has tables of its own
        height, width = batch.sizes[k]
        pixels = torch.cartesian_prod(torch.tensor([k]), torch.arange(height), torch.arange(width))
        p = distribution.density_ratio(batch, pixels).reshape(height, width).numpy()
        p = p if batch.mask is None else p * batch.valid(k).numpy()
        return p / max(p.sum(), 1e-30)
    table = PixelTable()
    strength = torch.from_numpy(distribution.strength(batch.image(k), batch.background_color))
    table.add([strength if batch.mask is None else strength * batch.valid(k)])
    return table.probability(0).numpy()


def show(views: Views, config: EdgeSEPixelSamplerConfig, strategy: str, path: Path, num_views: int, seed: int) -> None:
    """Draw num_views of the training views, MOST_VIEWS at most, evenly spaced, with num_rays_per_batch pixels each,
    as a PNG. InputError if matplotlib is missing, or the settings do not fit the images."""
    pyplot = require_pyplot()
    config.check()
    distribution = PIXEL_STRATEGIES[strategy].load()(config)
    batch = ImageBatch.of(image_batch(views), use_mask=not config.ignore_mask)
    last = len(views.images) - 1
    chosen = np.unique(np.linspace(0, last, min(num_views, last + 1, MOST_VIEWS)).round().astype(int)).tolist()
    figure, axes = pyplot.subplots(len(chosen), 3, figsize=(9.6, 3.35 * len(chosen)), squeeze=False)
    for row, k in zip(axes, chosen, strict=True):
        try:
            p = probability_map(distribution, batch, k)
        except ValueError as problem:
            raise InputError(f"{quote(views.names[k])}: {problem}") from problem
        _show_view(row, views, k, p, strategy, config.num_rays_per_batch, stream(seed, k, Stream.PIXELS))
    figure.tight_layout()
    save_figure(figure, path)


def _show_view(axes, views: Views, k: int, p: np.ndarray, strategy: str, count: int, rng: np.random.Generator) -> None:
    image = unit_float(views.images[k])
    height, width = p.shape
    axes[0].imshow(composite_on(image), interpolation="nearest")
    axes[0].set_title(f"view {k}: {printable(views.names[k])}", fontsize=9, parse_math=False)
    relative = p * max(np.count_nonzero(p), 1)
    shown = axes[1].imshow(relative, cmap="magma", interpolation="nearest", vmin=0)
    axes[1].set_title(f"{strategy}: probability, 1 = uniform", fontsize=9)
    axes[1].figure.colorbar(shown, ax=axes[1], fraction=0.046, pad=0.03).ax.tick_params(labelsize=7)
    axes[2].imshow(0.75 + 0.25 * luma(image), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    caption = "all masked: never drawn"
    if p.any():
        table = PixelTable()
        table.add([torch.from_numpy(p)])
        drawn = table.draw(torch.tensor([0]), count, rng).numpy()
        axes[2].scatter(drawn[:, 2], drawn[:, 1], s=max(2e4 / (height * width), 0.6) ** 0.5 * 2, c="#d62728", lw=0)
        caption = f"{count} drawn pixels"
        if image.shape[2] == 4:
            inside = (image[drawn[:, 1], drawn[:, 2], 3] > 0).mean()
            covered = (image[..., 3] > 0).mean()
            caption = f"{count} drawn: {inside:.0%} on the object,\nwhich covers {covered:.0%} of the image"
    axes[2].set_title(caption, fontsize=9)
    for axis in axes:
        axis.set(xticks=[], yticks=[], xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
