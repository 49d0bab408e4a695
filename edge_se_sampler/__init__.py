"""Pixel samplers for NeRF training: Random, Precrop, Edge and squared error.

What a training loop of one's own needs can be imported from here, and is loaded when it is first used:

    from edge_se_sampler import EdgeSEPixelSampler, EdgeSEPixelSamplerConfig, PixelTable, edge_strength, sample_by_rank
"""
# ruff: noqa: F401  (the imports for type checkers are the public names)

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from edge_se_sampler.errors import InputError
    from edge_se_sampler.protocol import PixelSampler, PixelSamplerConfig
    from edge_se_sampler.sampling.distribution import PixelTable, UniformPixels
    from edge_se_sampler.sampling.edges import edge_strength
    from edge_se_sampler.sampling.error_map import ErrorMap
    from edge_se_sampler.sampling.parts import Distribution, PixelBatch, Selector, TrainingStep
    from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler, ImportantPixels
    from edge_se_sampler.sampling.random_streams import Stream, stream
    from edge_se_sampler.sampling.ranking import Selection, sample_by_rank
    from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES, PixelStrategy
    from edge_se_sampler.sampling.schedule import AdaptiveSchedule, FixedSchedule
    from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

__version__ = "0.1.0"

_NAMES = {
    "errors": ["InputError"],
    "protocol": ["PixelSampler", "PixelSamplerConfig"],
    "sampling.distribution": ["PixelTable", "UniformPixels"],
    "sampling.edges": ["edge_strength"],
    "sampling.error_map": ["ErrorMap"],
    "sampling.parts": ["Distribution", "PixelBatch", "Selector", "TrainingStep"],
    "sampling.pixel_sampler": ["EdgeSEPixelSampler", "ImportantPixels"],
    "sampling.random_streams": ["Stream", "stream"],
    "sampling.ranking": ["Selection", "sample_by_rank"],
    "sampling.registry": ["PIXEL_STRATEGIES", "PixelStrategy"],
    "sampling.schedule": ["AdaptiveSchedule", "FixedSchedule"],
    "sampling.settings": ["EdgeSEPixelSamplerConfig"],
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
