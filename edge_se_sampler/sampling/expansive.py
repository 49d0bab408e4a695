"""Expansive supervision: errors of a few pixels, expanded over the image (Zhang et al. 2024, "Expansive Supervision for
Neural Radiance Field", arXiv 2409.08056).

A      anchors, |A| = alpha |R|: where the image's edges are, and large errors are expected
S      sources, drawn from the rest, R without A; their errors stand for all of it
beta   share of a step's pixels that are drawn from A

The loss is that of the whole image, estimated: A's mean plus (1 - alpha) / alpha times S's, which here are
inverse-probability loss weights. alpha and beta are those of its public code. The paper's anchors are Canny edges,
dilated, with thresholds searched until there are enough; decided here: the pixels with the strongest edges by the
settings' filter, and none without any edge. Its code lets the factor of S fade to 1, its paper does not; here neither.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import Distribution, PixelBatch, TrainingStep

ANCHOR_AREA = 0.25
"""alpha."""
ANCHOR_PIXELS = 0.5
"""beta."""
LEVELS = 1000


def anchors(edges: np.ndarray) -> np.ndarray:
    """(H, W) bool: A, from edge strengths (H, W) in LEVELS steps; all pixels of the last step that is needed."""
    level = (edges * np.float32(LEVELS / max(float(edges.max()), 1e-9))).astype(np.int64)
    at_least = np.bincount(level.reshape(-1))[::-1].cumsum()
    weakest = level.max() - np.searchsorted(at_least, ANCHOR_AREA * edges.size)
    return (level >= weakest) & (edges > 0)


class Expansive(Distribution):
    """Half of the pixels from the strongest edges, half from the rest, each uniformly; losses weighted accordingly.
    Under a mask, shares are those of what it leaves of both."""

    name = "expansive"

    def strength(self, image: np.ndarray, background_color: tuple[float, float, float]) -> np.ndarray:
        """beta / |A| or (1 - beta) / |S|; 1 if there is no anchor; raises as `edge_strength`."""
        edge_filter, source = self.settings.edge_filter, self.settings.edge_source
        anchor = anchors(edge_strength(image, edge_filter=edge_filter, source=source, background=background_color))
        area = float(anchor.mean())
        if area in (0, 1):
            return np.ones(anchor.shape, dtype=np.float32)
        return np.where(anchor, np.float32(ANCHOR_PIXELS / area), np.float32((1 - ANCHOR_PIXELS) / (1 - area)))

    def draw(self, batch: ImageBatch, count: int, step: TrainingStep) -> PixelBatch:
        """As `Distribution.draw`, with loss weights."""
        drawn = super().draw(batch, count, step)
        return replace(drawn, loss_weight=(1 / drawn.density_ratio()).float())
