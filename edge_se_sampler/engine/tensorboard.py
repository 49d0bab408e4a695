"""TensorBoard event files beside metrics.jsonl, where the [tensorboard] extra is installed."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any


class EventWriter:
    """Writes the numbers of metrics.jsonl's lines as scalars; without the extra it does nothing."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._writer = folder, None

    def write(self, line: dict[str, Any]) -> None:
        if find_spec("tensorboard") is None:
            return
        if self._writer is None:
            from torch.utils.tensorboard import SummaryWriter

            self._writer = SummaryWriter(str(self._folder))
        for key, value in line.items():
            if key != "step" and isinstance(value, int | float):
                self._writer.add_scalar(key, value, line["step"])

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
