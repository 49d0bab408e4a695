"""Memory in which the kernels keep the samples of rays between forward and backward."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edge_se_sampler.models.voxel_kernels.simd import LANES

CHUNK = 64
"""Rays that are rendered one after the other, in a slot of their own."""
FEATURES, HARMONICS = 16, 16
"""Of the network's inputs: constants, so that the compiler knows how often its loops run."""


class Buffers(NamedTuple):
    """S slots with room for M samples of CHUNK rays, of which as many may have a color, by a hidden layer of W neurons.
    Of a slot, all that has several numbers for each sample or ray is flat."""

    next_sample: np.ndarray  # (S, CHUNK) int64: of each ray, while it is marched; -1: none
    inverse: np.ndarray  # (S, 3 CHUNK): 1 / direction
    ends: np.ndarray  # (S, CHUNK) int32: end of each ray's samples
    num_colored: np.ndarray  # (S,) int32
    rows: np.ndarray  # (S, 8 M) int32: of a sample's corners; in the backward pass they become places among all touched
    weights: np.ndarray  # (S, 8 M): of the corners
    t: np.ndarray  # (S, M)
    tau: np.ndarray  # (S, M); in the backward pass it becomes the gradient of the raw density
    transmittance: np.ndarray  # (S, M): before each sample
    color_index: np.ndarray  # (S, M) int32: row of what follows; -1: without a color
    features: np.ndarray  # (S, FEATURES M); in the backward pass they become their gradient
    hidden: np.ndarray  # (S, W M); in the backward pass it becomes its gradient
    color: np.ndarray  # (S, 3 M + LANES); in the backward pass it becomes the gradient of the network's outputs
    color_weight: np.ndarray  # (S, M)
    color_cell: np.ndarray  # (S, M) int32: row of the sample's cell
    harmonics: np.ndarray  # (S, HARMONICS CHUNK)
    of_ray: np.ndarray  # (S, W CHUNK): a direction's part of the hidden layer; in the backward pass its gradient

    @classmethod
    def allocate(cls, slots: int, samples: int, width: int) -> Buffers:
        """Of memory that is not used before something is written into it."""

        def empty(*size: int, dtype: type = np.float32) -> np.ndarray:
            return np.empty((slots, *size), dtype)

        return cls(
            next_sample=empty(CHUNK, dtype=np.int64),
            inverse=empty(3 * CHUNK),
            ends=empty(CHUNK, dtype=np.int32),
            num_colored=empty(dtype=np.int32),
            rows=empty(8 * samples, dtype=np.int32),
            weights=empty(8 * samples),
            t=empty(samples),
            tau=empty(samples),
            transmittance=empty(samples),
            color_index=empty(samples, dtype=np.int32),
            features=empty(FEATURES * samples),
            hidden=empty(width * samples),
            color=empty(3 * samples + LANES),
            color_weight=empty(samples),
            color_cell=empty(samples, dtype=np.int32),
            harmonics=empty(HARMONICS * CHUNK),
            of_ray=empty(width * CHUNK),
        )
