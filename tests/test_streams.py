"""Random numbers as a function of (seed, step, purpose)."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from edge_se_sampler.sampling.random_streams import Stream, stream

MASK = 2**64 - 1


def philox(counter: list[int], key: list[int]) -> list[int]:
    """Philox4x64-10 as Salmon et al. 2011 print it, written apart from numpy's."""
    c, k = list(counter), list(key)
    for _ in range(10):
        first, second = 0xD2E7470EE14C6C93 * c[0], 0xCA5A826395121157 * c[2]
        c = [(second >> 64) ^ c[1] ^ k[0], second & MASK, (first >> 64) ^ c[3] ^ k[1], first & MASK]
        k = [(k[0] + 0x9E3779B97F4A7C15) & MASK, (k[1] + 0xBB67AE8584CAA73B) & MASK]
    return c


@pytest.mark.parametrize("seed", [0, 7, 2**40, 2**64 + 7, -1])
@pytest.mark.parametrize("step", [0, 1, 199_999])
@pytest.mark.parametrize("purpose", Stream)
@pytest.mark.parametrize("rank", [0, 3])
def test_seed_and_purpose_are_the_key_step_and_rank_the_second_and_third_counter_words(
    seed: int, step: int, purpose: Stream, rank: int
) -> None:
    # the first word counts blocks of four numbers; numpy counts before it generates
    blocks = [philox([block, step, rank, 0], [seed % 2**64, int(purpose)]) for block in (1, 2)]
    bits = stream(seed, step, purpose, rank).bit_generator.random_raw(8)
    assert bits.tolist() == [number for block in blocks for number in block]


def test_purposes_never_change_their_number() -> None:
    assert {purpose.name: int(purpose) for purpose in Stream} == {
        "PIXELS": 1,
        "SELECTION": 2,
        "MODEL": 3,
        "WEIGHTS": 4,
        "UNSEEN": 5,
        "PROBE": 6,
    }


def test_no_two_streams_begin_alike() -> None:
    starts = [
        stream(seed, step, purpose).random() for seed, step, purpose in itertools.product(range(20), range(20), Stream)
    ]
    assert len(set(starts)) == len(starts)


def test_neighbouring_steps_are_uncorrelated() -> None:
    draws = np.array([stream(0, step, Stream.PIXELS).random(2000) for step in range(30)])
    correlation = np.corrcoef(draws) - np.eye(30)
    assert np.abs(correlation).max() < 5.5 / np.sqrt(2000)  # 435 pairs, alpha about 1e-5
    assert np.abs(np.corrcoef(draws, np.roll(draws, 1, axis=0)) - 0)[:30, 30:].max() > 0.99  # it would be seen


def test_a_negative_step_is_refused() -> None:
    with pytest.raises(OverflowError):
        stream(0, -1, Stream.PIXELS)
