"""Strengths -> probabilities -> seeded draws: equations 2, 3 and 5 of the paper.

k       images that a draw may choose from; image first, pixel second (strengths normalised over all images
        would starve smooth ones)
H, W    rows and columns of an image; images may differ in size
s       strength of a pixel, >= 0 (equation 5: |E| + eps; 0: never drawn)
p       probability of a pixel within its image, s / sum(s)
B       children of a node: B consecutive pixels (row-major) make a block, B blocks a superblock

Every draw is an inverse CDF in our own arithmetic. torch.multinomial raises above 2^24 categories and was seen
to be silently wrong at 2^24; a flat float64 CDF over 100 images of 800 x 800 costs 8 bytes a pixel and a cache
miss at every step of its search. Three levels keep what a draw touches small: the superblocks' cumulative mass in
float64, then within a superblock and within a block the children's cumulative shares as 31-bit integers, in which
search and probabilities are exact. Draws are with replacement. Tables and draws live on the CPU whatever the
images' device (CUDA's cumulative sums need not be monotone), so that a seed draws the same pixels everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

B = 32
FULL = 2**31 - 1
"""The integer that stands for a node's whole mass."""


class UniformPixels:
    """Every pixel of the centred box of each image alike: Random (equation 2) or Precrop (equation 3).

    Args:
        sizes: (k, 2) rows and columns of each image.
        fraction: side of the box as a share of the image's side, in (0, 1]; 1 is the whole image, 0.5 the
            paper's Precrop, H/4 <= i < 3H/4. A box has at least one pixel.
    """

    def __init__(self, sizes: Sequence[tuple[int, int]], fraction: float = 1.0):
        size = torch.tensor(sizes, dtype=torch.float64).reshape(-1, 2)
        low, high = (torch.ceil(size * share / 2 - 1e-9) for share in (1 - fraction, 1 + fraction))  # 0.1 is not exact
        self.low = torch.minimum(low, size - 1)
        self.extent = torch.maximum(high - self.low, torch.ones(()))

    def drawable(self, images: Tensor) -> Tensor:
        """(k,) bool: the images that have a pixel to draw; here all."""
        return torch.ones(len(images), dtype=torch.bool)

    def draw(self, images: Tensor, n: int, rng: np.random.Generator) -> Tensor:
        """n draws: (n, 3) int64, position in `images`, row, column."""
        u = torch.from_numpy(rng.random((n, 3)))
        which = (u[:, 0] * len(images)).long()
        image = images[which]
        pixel = (self.low[image] + torch.floor(u[:, 1:] * self.extent[image])).long()
        return torch.cat((which[:, None], pixel), dim=1)

    def relative(self, images: Tensor, drawn: Tensor) -> Tensor:
        """(n,) p of the drawn pixels times the number of pixels that can be drawn in their image: here 1."""
        return torch.ones(len(drawn), dtype=torch.float64)


class PixelTable:
    """Pixels of many images, each drawn in proportion to its strength (equation 5).

    Images are added once and stay; a draw names the ones it may choose from. 4 + 4/B + 8/B^2 bytes a pixel.
    A pixel or block whose share of its parent is under 2^-32 may round to probability 0.
    """

    def __init__(self) -> None:
        self._mass = torch.zeros(0, dtype=torch.float64)  # of superblocks, cumulative; slot s spans (s, s + 1]
        self._blocks = torch.zeros((0, B), dtype=torch.int32)  # a superblock's blocks, cumulative shares
        self._pixels = torch.zeros((0, B), dtype=torch.int32)  # a block's pixels, cumulative shares
        self._shape = torch.zeros((0, 2), dtype=torch.int64)
        self._first = torch.zeros(1, dtype=torch.int64)  # superblock at which an image begins, and the end of all
        self._support = torch.zeros(0, dtype=torch.int64)
        self._slot = torch.zeros(0, dtype=torch.int64)  # place in the cumulative mass; -1: no mass at all

    def __len__(self) -> int:
        return len(self._shape)

    @property
    def nbytes(self) -> int:
        """Bytes that the tables hold."""
        return sum(value.nbytes for value in vars(self).values())

    def add(self, strengths: Iterable[Tensor]) -> None:
        """Append images.

        Args:
            strengths: one (H, W) tensor an image, >= 0 and finite; read one at a time, so that a generator
                keeps the peak near the finished tables.

        Raises:
            ValueError: a strength that is negative or not finite, or an image without pixels.
        """
        mass, blocks, pixels, shapes = [self._mass], [self._blocks], [self._pixels], []
        slot, support = self._slot.tolist(), self._support.tolist()
        filled = sum(place >= 0 for place in slot)
        for strength in strengths:
            share, block_mass = _level(_flat(strength))
            pixels.append(share)
            share, superblock_mass = _level(block_mass)
            blocks.append(share)
            total = torch.cumsum(superblock_mass, dim=0)
            support.append(int(torch.count_nonzero(strength)))
            slot.append(filled if support[-1] else -1)
            mass.append(total / total[-1] + filled if support[-1] else torch.full_like(total, filled))
            filled += support[-1] > 0
            shapes.append(strength.shape)
        if not shapes:
            return
        self._first = torch.cat((self._first, self._first[-1] + torch.tensor([len(m) for m in mass[1:]]).cumsum(0)))
        self._mass, self._blocks, self._pixels = torch.cat(mass), torch.cat(blocks), torch.cat(pixels)
        self._shape = torch.cat((self._shape, torch.tensor(shapes)))
        self._slot, self._support = torch.tensor(slot), torch.tensor(support)

    def drawable(self, images: Tensor) -> Tensor:
        """(k,) bool: the images that have a pixel of strength above 0."""
        return self._slot[images] >= 0

    def draw(self, images: Tensor, n: int, rng: np.random.Generator) -> Tensor:
        """n draws with replacement.

        Args:
            images: (k,) int64, numbers of images in the order they were added; all `drawable`.

        Returns:
            (n, 3) int64: position in `images`, row, column; ordered by image and superblock, so a part of the
            draw must be taken in strides, not from its beginning.
        """
        u = rng.random((3, n))
        u[0].sort()  # a search for ascending targets touches memory in order: 1/4 of the time of a draw
        which = (u[0] * len(images)).astype(np.int64)
        target = u[0] * len(images) - which
        if len(images) == 1:  # a search within one image touches less memory
            image = int(images[0])
            first, slot, width = int(self._first[image]), float(self._slot[image]), int(self._shape[image, 1])
            mass, base = self._mass[first : int(self._first[image + 1])], first
        else:
            image = images.numpy()[which]
            first, slot, width = (v.numpy()[image] for v in (self._first, self._slot, self._shape[:, 1]))
            mass, base = self._mass, 0
        # slot + u can round up to slot + 1, where the next image begins; so shrink u by more than that rounding
        target *= 1 - 2.0**-36
        target += slot
        node = torch.searchsorted(mass, torch.from_numpy(target), right=True).numpy()
        node += base
        for children, uniform in ((self._blocks, u[1]), (self._pixels, u[2])):
            within = torch.from_numpy((uniform * FULL).astype(np.int32))[:, None]
            child = torch.searchsorted(children.index_select(0, torch.from_numpy(node)), within, right=True)
            node = node * B + child.numpy()[:, 0]
        pixel = node - first * (B * B)
        row = pixel // width
        return torch.from_numpy(np.stack((which, row, pixel - row * width), axis=1))

    def probability(self, image: int) -> Tensor:
        """p of every pixel of one image as it is really drawn, (H, W) float64; sums to 1, or is all 0."""
        height, width = self._shape[image].tolist()
        columns = torch.arange(height * width)
        drawn = torch.stack((torch.zeros_like(columns), columns // width, columns % width), dim=1)
        relative = self.relative(torch.tensor([image]), drawn).reshape(height, width)
        return relative / self._support[image].clamp(min=1)

    def relative(self, images: Tensor, drawn: Tensor) -> Tensor:
        """(n,) p of drawn pixels (as `draw` returns them) times the number of drawable pixels of their image."""
        image = images[drawn[:, 0]]
        node = drawn[:, 1] * self._shape[image, 1] + drawn[:, 2] + self._first[image] * B * B
        p = self._support[image].double()
        for children in (self._pixels, self._blocks):
            node, child = torch.div(node, B, rounding_mode="floor"), (node % B)[:, None]
            share = children.index_select(0, node)
            below = torch.where(child > 0, share.gather(1, (child - 1).clamp(min=0)), 0)
            p *= (share.gather(1, child) - below)[:, 0].double() / FULL
        below = torch.where(node > self._first[image], self._mass[node - 1], self._slot[image].double())
        return p * (self._mass[node] - below)


def in_threads(strength: Callable[[int], Tensor], images: Sequence[int], ahead: int = 16) -> Iterator[Tensor]:
    """Strengths of images for `PixelTable.add`, computed in threads, but never more than `ahead` in advance."""
    with ThreadPoolExecutor() as threads:
        for start in range(0, len(images), ahead):
            yield from threads.map(strength, images[start : start + ahead])


def _flat(strength: Tensor) -> Tensor:
    """One image's strengths in a row, checked, and filled up with zeros to whole superblocks."""
    if strength.ndim != 2 or strength.numel() == 0:
        raise ValueError(f"strengths must be (H, W) with at least one pixel, not {tuple(strength.shape)}")
    flat = strength.detach().cpu().reshape(-1)
    low, high = (float(extreme) for extreme in torch.aminmax(flat))
    if not (low >= 0 and high < float("inf")):
        raise ValueError("strengths must be finite and >= 0")
    if flat.dtype == torch.float64 and high > 0:
        flat = flat / high  # sums of the largest and inverses of the smallest would overflow
    return torch.nn.functional.pad(flat, (0, -len(flat) % B**2))


def _level(child_mass: Tensor) -> tuple[Tensor, Tensor]:
    """Masses of children (n B,) -> their cumulative shares (n, B) int32 and their parents' masses (n,) float64."""
    cumulative = torch.cumsum(child_mass.reshape(-1, B), dim=1, dtype=torch.float64)
    mass = cumulative[:, -1].clone()
    scale = FULL / mass.clamp(min=torch.finfo(torch.float64).tiny)
    return cumulative.mul_(scale[:, None]).round_().int(), mass
