"""README.md of the robustness sweep: failures by setting and strategy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.outcomes import COLLAPSED_SHARE, MIN_GAIN
from edge_se_sampler.bench.report import describe_command, fill_template, markdown_table, read_notes
from edge_se_sampler.bench.results import Run, read_result
from edge_se_sampler.bench.stability.settings import REAL_SETTINGS, SETTINGS, STRATEGIES
from edge_se_sampler.bench.statistics import wilson_interval

FAILURE_MODES = {
    "dead at the start": "dead", "emptied": "emptied", "opaque background": "opaque", "underfit": "underfit",
}  # fmt: skip
"""Failure mode -> its name in tables."""
Modes = Counter[Any]
"""How many trainings ended in each failure mode; None counts those that converged."""


def describe(folder: Path) -> str:
    """README.md of the sweep in a folder."""
    result = read_result(folder / "result.json")
    runs, real_runs = (
        [run for run in result["runs"] if (run["setting"] in REAL_SETTINGS) == is_real] for is_real in (False, True)
    )
    counts, real_counts = count_failure_modes(runs), count_failure_modes(real_runs)
    return fill_template(
        __file__,
        folder,
        **result["settings"],
        seeds=len({run["seed"] for run in runs}),
        collapsed_share=COLLAPSED_SHARE,
        min_gain=MIN_GAIN,
        strategies=tabulate_strategies(counts),
        settings=tabulate_settings(counts),
        real_seeds=len({run["seed"] for run in real_runs}) or "",
        real_settings=tabulate_settings(real_counts) if real_runs else "",
        notes=read_notes(folder),
        reproduce=describe_command(result),
    )


def count_failure_modes(runs: Sequence[Run]) -> dict[str, dict[str, Modes]]:
    """Setting -> strategy -> how its runs ended; both in the order of the sweep, without those that no run has."""
    settings, strategies = ({run[key] for run in runs} for key in ("setting", "strategy"))
    counts = {
        setting: {strategy: Counter() for strategy in STRATEGIES if strategy in strategies}
        for setting in SETTINGS
        if setting in settings
    }
    for run in runs:
        counts[run["setting"]][run["strategy"]][run["failure_mode"]] += 1
    return counts


def _failures(modes: Modes) -> int:
    return modes.total() - modes[None]


def tabulate_strategies(counts: dict[str, dict[str, Modes]]) -> str:
    """Failures of each strategy over all settings."""
    head = ("", "failed", *FAILURE_MODES.values(), "settings without failure", "settings with nothing but failures")
    rows = []
    for strategy in _strategies(counts):
        by_setting = [row[strategy] for row in counts.values() if row[strategy]]
        modes = sum(by_setting, Counter())
        never = sum(_failures(modes) == 0 for modes in by_setting)
        always = sum(modes[None] == 0 for modes in by_setting)
        numbers = [*(modes[mode] for mode in FAILURE_MODES), never, always]
        rows.append((STRATEGIES[strategy].label, f"{_failures(modes)} of {modes.total()}", *map(str, numbers)))
    return markdown_table(head, rows)


def tabulate_settings(counts: dict[str, dict[str, Modes]]) -> str:
    """Failures of each strategy in each setting, with intervals and failure modes."""
    head = ("", *(STRATEGIES[strategy].label for strategy in _strategies(counts)))
    return markdown_table(head, [(setting, *map(_describe_modes, row.values())) for setting, row in counts.items()])


def _strategies(counts: dict[str, dict[str, Modes]]) -> list[str]:
    return list(next(iter(counts.values()), {}))


def _describe_modes(modes: Modes) -> str:
    if not modes:
        return "–"
    failures, runs = _failures(modes), modes.total()
    low, high = wilson_interval(failures, runs)
    count = f"**{failures}/{runs}**" if 2 * failures > runs else f"{failures}/{runs}"
    text = f"{count} [{100 * low:.0f}–{100 * high:.0f}%]"
    words = ", ".join(f"{modes[mode]} {word}" for mode, word in FAILURE_MODES.items() if modes[mode])
    return f"{text} ({words})" if words else text
