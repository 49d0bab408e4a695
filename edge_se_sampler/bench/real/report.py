"""README.md of the trainings on real scenes."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.report import decimals, describe_command, fill_template, markdown_table
from edge_se_sampler.bench.runner import Run, read_result

BASELINE = "lean-nerf"
NERF_PIXELS = 800
TEST_VIEWS = 25
Key = tuple[str, int, str]
"""Scene, downscale, budget."""


def describe(folder: Path) -> str:
    """The README.md of a folder with a result.json; notes.md has remarks by hand, which no number shows."""
    result, notes = read_result(folder / "result.json"), folder / "notes.md"
    runs = [run for run in result["runs"] if run["variant"] == BASELINE]
    return fill_template(
        __file__,
        folder,
        test_views=TEST_VIEWS,
        psnr=_table_of_psnr(runs),
        notes=notes.read_text(encoding="utf-8").strip() if notes.exists() else "",
        gaps=_table_of(runs, {"test": "psnr", "SSIM": "ssim", "validation": "val_psnr", "training": "train_psnr"}),
        costs=_table_of_costs(runs),
        variants=_table_of_variants(result["runs"]),
        reproduce=describe_command(result),
    )


def tables(folder: Path) -> dict[str, str]:
    """Tables that other texts show, by name."""
    runs = read_result(folder / "result.json")["runs"]
    return {"real": _table_of_psnr([run for run in runs if run["variant"] == BASELINE])}


def _key(run: Run) -> Key:
    return run["scene"], run["downscale"], run["budget"]


def _by_key(runs: list[Run]) -> dict[Key, list[Run]]:
    keys = sorted({_key(run) for run in runs}, key=lambda key: (-key[1], key[0], _seconds(key[2])))
    return {key: [run for run in runs if _key(run) == key] for key in keys}


def _seconds(budget: str) -> float:
    return float(budget.rstrip("smh")) * {"m": 60, "h": 3600}.get(budget[-1], 1)


def _label(key: Key) -> str:
    return f"{key[0]}, {NERF_PIXELS // key[1]} px"


def _median(runs: list[Run], name: str) -> float:
    return statistics.median(run[name] for run in runs)


def _table_of_psnr(runs: list[Run]) -> str:
    """Scenes and sizes by budgets; in brackets the least and the largest of several seeds."""
    groups = _by_key(runs)
    budgets = sorted({key[2] for key in groups}, key=_seconds)
    rows = {}
    for key, group in groups.items():
        psnrs = sorted(run["psnr"] for run in group)
        spread = f" ({decimals(psnrs[0])} to {decimals(psnrs[-1])})" if len(psnrs) > 1 else ""
        rows.setdefault(_label(key), dict.fromkeys(budgets, "–"))[key[2]] = decimals(_median(group, "psnr")) + spread
    return markdown_table(["", *budgets], ([label, *row.values()] for label, row in rows.items()))


def _table_of(runs: list[Run], columns: dict[str, str]) -> str:
    rows = (
        [_label(key), key[2], *(decimals(_median(group, name)) for name in columns.values())]
        for key, group in _by_key(runs).items()
    )
    return markdown_table(["", "budget", *columns], rows)


def _table_of_costs(runs: list[Run]) -> str:
    columns: dict[str, Callable[[list[Run]], str]] = {
        "seconds": lambda group: f"{_median(group, 'seconds'):.1f}",
        "CPU seconds": lambda group: f"{_median(group, 'cpu_seconds'):.0f}",
        "steps": lambda group: f"{_median(group, 'steps'):,.0f}",
        "rows": lambda group: f"{_median(group, 'rows') / 1e6:.1f} M",
        "memory": lambda group: f"{_median(group, 'memory'):.1f} GiB",
        "rendering a view": lambda group: f"{_median(group, 'seconds_per_view'):.2f} s",
    }
    rows = ([_label(key), key[2], *(show(group) for show in columns.values())] for key, group in _by_key(runs).items())
    return markdown_table(["", "budget", *columns], rows)


def _table_of_variants(runs: list[Run]) -> str:
    """Empty where nothing was changed."""
    rows: list[list[Any]] = []
    for key, group in _by_key(runs).items():
        for variant in sorted({run["variant"] for run in group} - {BASELINE}):
            changed = [run for run in group if run["variant"] == variant]
            seeds = {run["seed"] for run in changed}
            baseline = [run for run in group if run["variant"] == BASELINE and run["seed"] in seeds]
            if len(baseline) == len(changed):
                psnr, before = _median(changed, "psnr"), _median(baseline, "psnr")
                rows.append([_label(key), key[2], variant, decimals(psnr), f"{psnr - before:+.2f}", str(len(seeds))])
    return markdown_table(["", "budget", "changed", "PSNR", "difference", "seeds"], rows) if rows else ""
