"""What distributions that learn from errors have in common: a table of cells whose values they change."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from edge_se_sampler.sampling.cells import CellTable
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.parts import Distribution
from edge_se_sampler.sampling.settings import SamplingSettings


class LearnedDistribution(Distribution):
    """Draws in proportion to the values of cells, see `CellTable`; a subclass's `update` changes them.

    In nerfstudio's distributed runs every process learns from the errors of its own pixels; our own processes, which
    draw the same pixels, learn from all.
    """

    needs_errors = True

    def __init__(self, settings: SamplingSettings, side: int, *, across_images: bool = False) -> None:
        super().__init__(settings)
        self.cells = CellTable(side, across_images=across_images)

    def tables(self, batch: ImageBatch) -> tuple[CellTable, Tensor]:
        """The table of cells, and the index of each image in it."""
        return self.cells, self.cells.add(batch)

    def state_dict(self) -> dict[str, Any]:
        """The cells'."""
        return {"cells": self.cells.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what `state_dict` returned."""
        self.cells = CellTable.from_state(state["cells"])
