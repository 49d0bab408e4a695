"""Progress: a bar on a terminal, whole lines elsewhere."""

from __future__ import annotations

import errno
import io
import sys

import pytest

from edge_se_sampler.engine.progress import Progress, write_line


class Clock:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Full(io.StringIO):
    """A log on a full disk."""

    def write(self, text: str) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")


class GoneTerminal(Terminal):
    """One that is closed after the bar's first drawing."""

    def write(self, text: str) -> int:
        if self.getvalue():
            raise OSError(errno.EIO, "Input/output error")
        return super().write(text)


def times_of_lines(seconds_a_step: float, steps: int, capsys: pytest.CaptureFixture[str]) -> list[float]:
    """When a job of equally long steps has written a line; seconds since its start."""
    clock, times = Clock(), []
    with Progress(steps, "job", clock=clock) as progress:
        for step in range(steps):
            clock.now += seconds_a_step
            progress.update(step + 1)
            written = capsys.readouterr().err
            if written:
                assert written.count("\n") == 1
                assert written.endswith("\n")
                times.append(clock.now - 1000)
    return times


@pytest.mark.parametrize("seconds_a_step", [0.07, 1.0, 7.0, 20.0])
def test_a_log_gets_a_line_at_least_every_30_seconds(seconds_a_step: float, capsys: pytest.CaptureFixture[str]) -> None:
    times = times_of_lines(seconds_a_step, round(200 / seconds_a_step), capsys)
    gaps = [later - earlier for earlier, later in zip([0, *times], times, strict=False)]
    assert max(gaps) <= 30
    assert min(gaps) > 30 - seconds_a_step - 1e-6  # and not more often than that needs
    assert times[-1] > 170


def test_steps_longer_than_that_get_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert times_of_lines(50, 3, capsys) == [50, 100, 150]


def test_a_short_job_leaves_a_log_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert times_of_lines(0.5, 50, capsys) == []


def test_a_line_has_steps_percent_time_left_and_the_note(capsys: pytest.CaptureFixture[str]) -> None:
    """30 of 90 remaining steps took 40 s: the other 60 will take 80 s."""
    clock = Clock()
    progress = Progress(100, "edge-nerf", start=10, clock=clock)
    clock.now += 40
    progress.update(40, note="5,000 rays/s, loss 0.01, PSNR 20.0")
    assert capsys.readouterr().err == "edge-nerf: 40/100, 40 %, 01:20 left, 5,000 rays/s, loss 0.01, PSNR 20.0\n"


def test_the_total_may_be_known_later(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    progress = Progress(0, "padding", clock=clock)
    clock.now += 40
    progress.update(2, 8)
    assert capsys.readouterr().err == "padding: 2/8, 25 %, 02:00 left\n"


def test_a_terminal_gets_a_bar_that_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress(10, "edge-nerf") as progress:
        progress._bar.mininterval = 0
        progress.update(4, note="loss 0.01")
        progress.update(9, note="loss 0.005")
    assert "edge-nerf:  90%" in terminal.getvalue()
    assert "9/10" in terminal.getvalue()
    assert "loss 0.005" in terminal.getvalue()
    assert "\n" not in terminal.getvalue()
    assert terminal.getvalue().rsplit("\r", 2)[1].strip() == ""


@pytest.mark.parametrize("log", [Full, GoneTerminal])
def test_work_goes_on_without_a_log_that_takes_no_more(log: type, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", log())
    clock, done = Clock(), 0
    with Progress(3, "job", clock=clock) as progress:
        for step in range(3):
            clock.now += 40
            progress.update(step + 1)
            write_line("a line")
            done += 1
    assert done == 3
