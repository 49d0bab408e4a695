"""README.md of training in several processes: from how many rays a step they pay."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby, takewhile
from operator import itemgetter
from pathlib import Path

from edge_se_sampler.bench.report import describe_machine, fill_template, markdown_table
from edge_se_sampler.bench.results import Run, read_result

MARGIN = 0.05
"""Share of a step's time that several processes must save to pay: less is within the noise."""


def describe(folder: Path) -> str:
    """README.md of the times in a folder."""
    result = read_result(folder / "result.json")
    settings, runs = result["settings"], result["runs"]
    by_method = groupby(runs, itemgetter("method"))
    verdicts = [f"for `{method}` {describe_break_even(list(of_method))}" for method, of_method in by_method]
    head = ("method", "rays a step", "steps of a round", "one process", f"{settings['processes']} processes", "ratio")
    return fill_template(
        __file__,
        folder,
        **settings,
        margin=MARGIN,
        verdict=f"**{settings['processes']} processes pay {'; '.join(verdicts)}.**",
        times=markdown_table(head, map(_tabulate, runs)),
        command=result["command"],
        machine=describe_machine(result["machine"]),
    )


def describe_break_even(runs: Sequence[Run]) -> str:
    """From how many rays on several processes pay, of a method's runs in the order of rays."""
    paying = list(takewhile(lambda run: ratio(run) <= 1 - MARGIN, reversed(runs)))
    if not paying:
        return f"not, up to {runs[-1]['rays']:,} rays a step"
    return f"from {paying[-1]['rays']:,} rays a step on" + ", the fewest timed" * (len(paying) == len(runs))


def ratio(run: Run) -> float:
    """A step's time in several processes as a multiple of its time in one."""
    return run["milliseconds"]["several"] / run["milliseconds"]["one"]


def _tabulate(run: Run) -> tuple[str, ...]:
    times = (f"{run['milliseconds'][name]:.1f}" for name in ("one", "several"))
    return (f"`{run['method']}`", f"{run['rays']:,}", str(run["steps"]), *times, f"{ratio(run):.2f}")
