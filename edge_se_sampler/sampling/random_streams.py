"""Random numbers that need no state: every draw is a function of (seed, step, stream).

Philox is counter-based (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"): its key is the seed and the
stream, the second and third words of its counter are the step and the rank. So streams never overlap (each step owns
2^64 blocks), a resumed run needs no saved generator, and the global generators are neither read nor moved.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """What a random number is for; the value is part of the key and must never change."""

    PIXELS = 1  # which pixels a step draws
    SELECTION = 2  # which candidates squared-error sampling keeps
    MODEL = 3  # jitter of samples along rays, density noise, random backgrounds
    WEIGHTS = 4  # initial weights of the networks
    UNSEEN = 5  # poses and pixels of unseen rays (InfoNeRF)
    PROBE = 6  # rays that show whether a network is dead


def stream(seed: int, step: int, purpose: Stream, rank: int = 0) -> np.random.Generator:
    """The generator of one purpose in one training step.

    Args:
        seed: any integer; taken modulo 2^64.
        step: >= 0.
        rank: of the process in a distributed run, where each needs numbers of its own.
    """
    if step < 0:
        raise OverflowError(f"step is {step}, and must be >= 0")  # which numpy 2 says
    key = np.array([seed % 2**64, int(purpose)], dtype=np.uint64)
    counter = np.array([0, step, rank, 0], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))
