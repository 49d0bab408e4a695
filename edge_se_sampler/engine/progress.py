"""How far a long job is: tqdm's bar on a terminal; where stderr is a file or a pipe, now and then a line."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from typing import Any

from tqdm import tqdm

from edge_se_sampler.ranks import is_main

SECONDS_PER_LINE = 30
LINE = "{desc}: {n_fmt}/{total_fmt}, {percentage:.0f} %, {remaining} left{postfix}"


class Progress(AbstractContextManager):
    """Shows on stderr what part of a job is done and how long the rest will take. `total` is 0 if only `update` gets to
    know it; `start` steps were done in an earlier session."""

    def __init__(self, total: int, label: str, start: int = 0, clock: Callable[[], float] = time.monotonic) -> None:
        self.total, self.label, self.start, self._clock = total, label, start, clock
        # None: disabled where stderr is no terminal
        disable = None if is_main() else True
        self._bar = tqdm(total=total, desc=label, initial=start, leave=False, dynamic_ncols=True, disable=disable)
        self._began = self._last_line = self._last_update = clock()

    def update(self, done: int, total: int | None = None, note: str = "") -> None:
        with suppress(OSError):  # nobody reads it any more, or its disk is full: no reason to stop the work
            self._update(done, total, note)

    def _update(self, done: int, total: int | None, note: str) -> None:
        self.total = self.total if total is None else total
        if not self._bar.disable:
            self._bar.total = self.total
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(done - self._bar.n)
            return
        now = self._clock()
        next_update, self._last_update = now + (now - self._last_update), now
        if is_main() and self.total and next_update - self._last_line > SECONDS_PER_LINE:
            self._last_line = now
            shown = {"prefix": self.label, "postfix": note, "initial": self.start, "bar_format": LINE}
            print(tqdm.format_meter(done, self.total, now - self._began, **shown), file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the bar."""
        with suppress(OSError):
            self._bar.close()

    def __exit__(self, *_: Any) -> None:
        self.close()


def write_line(line: str) -> None:
    """Print a line to stderr, above a bar if there is one."""
    with suppress(OSError):
        tqdm.write(line, file=sys.stderr)
