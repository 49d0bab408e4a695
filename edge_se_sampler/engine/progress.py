"""One line on the terminal that tells how far a long job is; silent where there is no terminal."""

from __future__ import annotations

import shutil
import sys
import time


class Progress:
    """A line that is written over, at most five times a second.

    Args:
        total: steps of the whole job.
        start: steps done in an earlier session.
        label: what is being done.
    """

    def __init__(self, total: int, label: str, start: int = 0) -> None:
        self.total, self.label, self.start = total, label, start
        self.live = sys.stderr.isatty()
        self._began = time.monotonic()
        self._shown = 0.0

    def update(self, done: int, note: str = "") -> None:
        """Show that `done` of `total` steps are finished."""
        now = time.monotonic()
        if not self.live or (now - self._shown < 0.2 and done < self.total):
            return
        self._shown = now
        elapsed = now - self._began
        left = elapsed / max(done - self.start, 1) * (self.total - done)
        text = f"{self.label}  {done}/{self.total}  {100 * done / max(self.total, 1):.0f} %  {clock(left)} left  {note}"
        width = shutil.get_terminal_size().columns - 1
        sys.stderr.write("\r" + text[:width].ljust(width))
        sys.stderr.flush()

    def close(self) -> None:
        """Clear the line."""
        if self.live and self._shown:
            sys.stderr.write("\r" + " " * (shutil.get_terminal_size().columns - 1) + "\r")
            sys.stderr.flush()


def clock(seconds: float) -> str:
    """Seconds as h:mm:ss or m:ss."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
