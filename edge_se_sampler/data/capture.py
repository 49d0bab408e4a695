"""What a folder that does not split its images for us lists: frames, and which of them are held out."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar, get_args

import numpy as np

from edge_se_sampler.data.frames import Frame
from edge_se_sampler.data.scene_file import SourceFile, SourceLocation, quote

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
EVAL_EVERY = 8
"""Every how many images one is held out, where the data does not say: as LLFF's and mip-NeRF 360's results have it."""
Item = TypeVar("Item")


@dataclass(frozen=True)
class Capture:
    """The frames of a folder, in the order of their names."""

    frames: list[Frame]
    left_out: list[str]
    """Lines that say what the folder lists or has, but is not used."""
    splits: dict[Split, list[int]] | None = None
    """Indices of the frames of each split; None: the data has none."""
    points: list[np.ndarray] | None = None
    """Of each frame: (m, 3) points of the scene that it sees, world units."""

    def select(self, split: Split, eval_every: int) -> list[int]:
        """Indices of a split's frames. Where the data has none, frames 0, eval_every, ... are both val and test."""
        if self.splits is not None:
            return self.splits.get(split, [])
        return [i for i in range(len(self.frames)) if (i % eval_every == 0) != (split == "train")]


def keep_existing(
    items: Sequence[Item], images: Sequence[SourceFile], listing: SourceLocation
) -> tuple[list[Item], list[str]]:
    """The items whose images exist, and a line about the others, if any; InputError if fewer than half of them do."""
    exist = [image.is_there() for image in images]
    kept = list(itertools.compress(items, exist))
    if len(kept) == len(items):
        return kept, []
    first = images[exist.index(False)]
    found = f"{len(items) - len(kept)} of the {len(items)} listed images do not exist, {quote(first.name)} for one"
    if 2 * len(kept) < len(items):
        raise listing.error(found, "put them there, or list only what is there")
    return kept, [f"{listing.file}: {found}: left out"]
