"""Ctrl-C while processes are started: it reaches all of a terminal's, but only the first is to answer."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupts_delayed() -> Iterator[None]:
    """Delays Ctrl-C until the end: what multiprocessing starts is not left half made."""
    if threading.current_thread() is not threading.main_thread():  # no other is interrupted
        yield
        return
    pressed: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if pressed:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Blocks Ctrl-C in processes started meanwhile, for good: their parent stops them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows: that they ignore it once started must do
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
