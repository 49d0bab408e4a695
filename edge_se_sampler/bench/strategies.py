"""The paper's six strategies as its tables name them."""

from __future__ import annotations

LABELS = {
    "vanilla-nerf": "Random",
    "precrop-nerf": "Precrop + Random",
    "se-nerf": "SE",
    "precrop-se-nerf": "Precrop + SE",
    "edge-nerf": "Edge",
    "edge-se-nerf": "Edge + SE",
}
"""Method -> label, in the order of the paper's tables."""
