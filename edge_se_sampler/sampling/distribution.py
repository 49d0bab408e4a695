"""Strengths -> probabilities -> seeded draws: equations 2, 3 and 5 of the paper.

k       images that a draw may choose from; image first, pixel second (strengths normalised over all images
        would starve smooth ones)
s       strength of a pixel, >= 0 (equation 5: |E| + eps; 0: never drawn)
p       probability of a pixel within its image, s / sum(s)
B       children of a node: B consecutive pixels (row-major) make a block, B blocks a superblock

Every draw inverts a CDF that is searched here: torch.multinomial raises above 2^24 categories and is silently wrong at
2^24, and a flat float64 CDF over 100 images of 800 x 800 costs 8 bytes a pixel and a cache miss at every step of its
search. Three levels keep small what a draw touches: the superblocks' cumulative mass in float64, then within a
superblock and within a block the children's cumulative shares as 30-bit integers, in which search and probabilities are
exact. Draws are with replacement. Tables and draws live on the CPU whatever the images' device (CUDA's cumulative sums
need not be monotone), so that a seed draws the same pixels everywhere.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

B = 32
AHEAD = 16
"""Images whose strengths are held before they are added: they take more room than what is kept of them."""
CDF_SCALE = 2**30
"""The integer that stands for a node's whole mass: two draws within a node fit into one 64-bit random number."""


class UniformPixels:
    """Pixels of each image's centered box, all alike: Random (equation 2) or Precrop (equation 3).

    Args:
        sizes: rows and columns of each image.
        fraction: side of the box as a share of the image's side, in (0, 1]; 0.5 is the paper's Precrop,
            H/4 <= i < 3H/4. A box has at least one pixel.
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
        """n draws with replacement: (n, 3) int64 position in `images`, row, column.

        Args:
            images: (k,) int64, numbers of images in the order of `sizes`.
        """
        u = torch.from_numpy(rng.random((n, 3)))
        which = (u[:, 0] * len(images)).long()
        image = images[which]
        pixel = (self.low[image] + torch.floor(u[:, 1:] * self.extent[image])).long()
        return torch.cat((which[:, None], pixel), dim=1)

    def density_ratio(self, images: Tensor, drawn: Tensor) -> Tensor:
        """(n,) p of drawn pixels times the number of drawable pixels of their image: here 1."""
        return torch.ones(len(drawn), dtype=torch.float64)


class PixelTable:
    """Pixels of many images, each drawn in proportion to its strength (equation 5).

    Images are added once and stay; a draw names the ones it may choose from. 4 + 4/B + 8/B^2 bytes a pixel.
    A pixel or block whose share of its parent is under 2^-31 may round to probability 0.
    """

    def __init__(self) -> None:
        self._mass = np.zeros(0)  # of superblocks, cumulative; slot s spans (s, s + 1]
        self._blocks = np.zeros((0, B), dtype=np.int32)  # a superblock's blocks, cumulative shares
        self._pixels = np.zeros((0, B), dtype=np.int32)  # a block's pixels, cumulative shares
        self._shape = np.zeros((0, 2), dtype=np.int64)
        self._first = np.zeros(1, dtype=np.int64)  # superblock at which an image begins, and the end of all
        self._support = np.zeros(0, dtype=np.int64)
        self._slot = np.zeros(0, dtype=np.int64)  # index among images with mass, which cumulative mass counts; -1: none

    def __len__(self) -> int:
        return len(self._shape)

    @property
    def nbytes(self) -> int:
        """Bytes that the tables hold."""
        return sum(value.nbytes for value in vars(self).values())

    def add(self, strengths: Iterable[Tensor]) -> None:
        """Append images.

        Args:
            strengths: (H, W) of each image, >= 0 and finite; a generator keeps the peak near the finished tables.

        Raises:
            ValueError: a strength that is negative or not finite, or an image without pixels.
        """
        mass, blocks, pixels, shapes = [self._mass], [self._blocks], self._pixels.copy(), []
        slot, support = self._slot.tolist(), self._support.tolist()
        filled, end = sum(index >= 0 for index in slot), len(pixels)
        for strength in strengths:
            share, block_mass = _level(_flat(strength))
            # not a list of parts: of the memory that those were in, little could be given back
            pixels.resize((end + len(share), B), refcheck=False)
            pixels[end:] = share.numpy()
            end += len(share)
            share, superblock_mass = _level(block_mass)
            blocks.append(share.numpy())
            total = np.cumsum(superblock_mass.numpy())
            support.append(int(torch.count_nonzero(strength)))
            slot.append(filled if support[-1] else -1)
            mass.append(total / total[-1] + filled if support[-1] else np.full_like(total, filled))
            filled += support[-1] > 0
            shapes.append(tuple(strength.shape))
        if not shapes:
            return
        self._first = np.append(self._first, self._first[-1] + np.cumsum([len(m) for m in mass[1:]]))
        self._mass, self._blocks, self._pixels = np.concatenate(mass), np.concatenate(blocks), pixels
        self._shape = np.concatenate((self._shape, shapes))
        self._slot, self._support = np.array(slot), np.array(support)

    def drawable(self, images: Tensor) -> Tensor:
        """(k,) bool: the images that have a pixel of strength above 0."""
        return torch.from_numpy(self._slot[images.numpy()] >= 0)

    def draw(self, images: Tensor, n: int, rng: np.random.Generator) -> Tensor:
        """n draws with replacement: (n, 3) int64 position in `images`, row, column.

        They are ordered by image and superblock: a part of them must be taken in strides, not from the beginning.

        Args:
            images: (k,) int64, numbers of images in the order they were added; all `drawable`.
        """
        above, within = rng.bit_generator.random_raw(2 * n).reshape(2, n)
        above.sort()  # a search for ascending targets touches memory in order: 1/4 of the time of a draw
        target = (above >> 11) * 2.0**-53
        if len(images) == 1:  # a search within one image touches less memory
            which, image = 0, int(images[0])
            base, mass = int(self._first[image]), self._mass[self._first[image] : self._first[image + 1]]
        else:
            target *= len(images)
            which = target.astype(np.int64)
            target -= which
            image, base, mass = images.numpy()[which], 0, self._mass
        # slot + u can round up to slot + 1, where the next image begins; so shrink u by more than that rounding
        target *= 1 - 2.0**-36
        target += self._slot[image]
        node = torch.searchsorted(torch.from_numpy(mass), torch.from_numpy(target), right=True).numpy()
        node += base
        node = _child(self._blocks, node, (within >> 34).astype(np.int32))
        pixel = _child(self._pixels, node, (within >> 4).astype(np.int32) & (CDF_SCALE - 1))
        pixel -= self._first[image] * (B * B)
        width = self._shape[image, 1]
        drawn = np.empty((n, 3), dtype=np.int64)
        drawn[:, 0] = which
        np.divmod(pixel, width, out=(drawn[:, 1], drawn[:, 2]))
        return torch.from_numpy(drawn)

    def probability(self, image: int) -> Tensor:
        """p of every pixel of one image as it is drawn, rounding included: (H, W) float64; sums to 1, or is all 0."""
        height, width = self._shape[image].tolist()
        columns = torch.arange(height * width)
        drawn = torch.stack((torch.zeros_like(columns), columns // width, columns % width), dim=1)
        density_ratio = self.density_ratio(torch.tensor([image]), drawn).reshape(height, width)
        return density_ratio / max(int(self._support[image]), 1)

    def density_ratio(self, images: Tensor, drawn: Tensor) -> Tensor:
        """(n,) p of drawn pixels (as `draw` returns them) times the number of drawable pixels of their image."""
        which, row, column = drawn.numpy().T
        image = images.numpy()[which]
        node = row * self._shape[image, 1] + column + self._first[image] * (B * B)
        p = self._support[image].astype(np.float64)
        for children in (self._pixels, self._blocks):
            node, child = np.divmod(node, B)
            below = np.where(child > 0, children[node, child - 1], 0)
            p *= (children[node, child] - below) / CDF_SCALE
        below = np.where(node > self._first[image], self._mass[node - 1], self._slot[image])
        return torch.from_numpy(p * (self._mass[node] - below))


def in_threads(strength: Callable[[int], Tensor], images: Sequence[int]) -> Iterator[Tensor]:
    """Strengths of images for `PixelTable.add`, computed in threads, but never more than `AHEAD` in advance."""
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        for start in range(0, len(images), AHEAD):
            yield from threads.map(strength, images[start : start + AHEAD])


def _flat(strength: Tensor) -> Tensor:
    """One image's strengths in a row, checked, and filled up with zeros to whole superblocks."""
    if strength.ndim != 2 or strength.numel() == 0:
        raise ValueError(f"strengths must be (H, W) with at least one pixel, not {tuple(strength.shape)}")
    flat = strength.detach().cpu().reshape(-1)
    if flat.dtype == torch.float16:
        flat = flat.float()  # old torch finds no extremes of float16 on a CPU
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
    scale = CDF_SCALE / mass.clamp(min=torch.finfo(torch.float64).tiny)
    return cumulative.mul_(scale[:, None]).round_().int(), mass


def _child(cumulative: np.ndarray, node: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The children that targets in [0, CDF_SCALE) fall into, counted through all nodes: (nodes, B), (n,), (n,) -> (n,).

    A binary search in log2(B) gathers: copying the nodes' rows for torch.searchsorted takes twice the time.
    """
    shares = cumulative.reshape(-1)
    child = node * B
    half = B // 2
    while half:
        child += half * (shares.take(child + (half - 1)) <= target)
        half //= 2
    return child
