"""README.md and picture of the trainings on real scenes."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.baselines.run import read_baselines
from edge_se_sampler.bench.real.figures import LINES, describe_lines, draw_chart
from edge_se_sampler.bench.real.published import PUBLISHED
from edge_se_sampler.bench.real.summary import (
    BASELINE,
    UNIFORM,
    WITHOUT_MASKS,
    best_psnr_at,
    by_program,
    is_published,
    label_of,
    length_of,
    name_of,
    panel_of,
    panels_of,
    psnr_by_budget,
    seconds_of,
    timed,
)
from edge_se_sampler.bench.real.trials import VARIANTS
from edge_se_sampler.bench.report import (
    decimals,
    describe_command,
    fill_template,
    markdown_table,
    read_notes,
    read_title,
)
from edge_se_sampler.bench.results import Run, read_result
from edge_se_sampler.engine.figures import save_figure

Key = tuple[str, str]
"""What was trained: scene, size, and what was changed, if anything; budget."""
TABULATED = BASELINE, UNIFORM
"""Variants with rows of their own; others are looked at where one thing is changed."""
Baselines = Mapping[str, Mapping[str, Any]]
"""Results of other programs."""
ORIGINS = {
    "of NeRF-synthetic, Mildenhall et al. 2020, in its official splits, premultiplied colors averaged to the size, in "
    "front of white": ("chair", "lego"),
    "photographed, with masks, split as their folders are": ("dtu_scan24", "ethiopianHead"),
    "photographed, without masks: lenses undone, colors averaged to the size, and every eighth image, in the order of "
    "their names, held out": ("colmap_mug", "fox"),
}
"""What is said of scenes -> their names."""


def draw(folder: Path, workplace: Path | None) -> None:
    del workplace
    result, baselines = _read(folder)
    if runs := [run for run in timed(result["runs"]) if run["variant"] in LINES]:
        save_figure(draw_chart(runs, baselines), folder / "chart.png")


def describe(folder: Path) -> str:
    """The README.md of a folder with a result.json."""
    result, baselines = _read(folder)
    runs, changes = _tabulated(result["runs"]), _table_of_variants(result["runs"])
    return fill_template(
        __file__,
        folder,
        title=read_title(folder, "lean-nerf on real scenes"),
        scenes=_describe_scenes(result["runs"]),
        caption=describe_lines(timed(result["runs"]), baselines),
        psnr=_table_of_psnr(runs),
        baselines=_table_of_baselines(timed(result["runs"]), baselines),
        published=_table_of_published() if any(map(is_published, panels_of(runs))) else "",
        gaps=_table_of(runs, {"test": "psnr", "SSIM": "ssim", "validation": "val_psnr", "training": "train_psnr"}),
        costs=_table_of_costs(runs),
        variants=changes,
        flags=_list_flags(result["runs"]) if changes else "",
        notes=read_notes(folder),
        reproduce=describe_command(*baselines.values(), result),
    )


def tables(folder: Path) -> dict[str, str]:
    """Tables that other texts show, by name."""
    runs = read_result(folder / "result.json")["runs"]
    return {"real": _table_of_psnr(_tabulated(runs))}


def _read(folder: Path) -> tuple[dict[str, Any], Baselines]:
    """The result, and those of other programs beside it, which had as many threads."""
    result = read_result(folder / "result.json")
    return result, read_baselines(folder, threads=result["machine"]["threads"])


def _tabulated(runs: list[Run]) -> list[Run]:
    """Those with a time budget that have rows of their own."""
    return [run for run in timed(runs) if run["variant"] in TABULATED]


def _describe_scenes(runs: list[Run]) -> str:
    """The scenes by where they are from; those that are from elsewhere by their names alone."""
    scenes = {run["scene"] for run in runs}
    known = {origin: sorted(scenes.intersection(names)) for origin, names in ORIGINS.items()}
    parts = [f"{' and '.join(names)} ({origin})" for origin, names in known.items() if names]
    return "; ".join([*parts, *sorted(scenes.difference(*known.values()))])


def _list_flags(runs: list[Run]) -> str:
    """What was changed as flags, a line a variant; empty where nothing was."""
    lines = []
    for variant in sorted({run["variant"] for run in runs}):
        changes = VARIANTS.get(variant, {})
        flags = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in changes.items())
        lines += [f"- *{variant}*: `{flags}`"] * bool(flags)
    return "\n".join(lines)


def _by_key(runs: list[Run]) -> dict[Key, list[Run]]:
    groups = {}
    for panel, variant in product(panels_of(runs), TABULATED):
        label = label_of(panel) + (f", {variant}" if variant != BASELINE else "")
        found = [run for run in runs if panel_of(run) == panel and run["variant"] == variant]
        for budget in _budgets(found):
            groups[label, budget] = [run for run in found if run["budget"] == budget]
    return groups


def _budgets(runs: list[Run]) -> list[str]:
    return sorted({run["budget"] for run in runs}, key=length_of)


def _median(runs: list[Run], name: str) -> float:
    return statistics.median(run[name] for run in runs)


def _show_median(runs: list[Run], name: str) -> str:
    """A dash where there is none: captures have no validation views of their own."""
    return "–" if any(run[name] is None for run in runs) else decimals(_median(runs, name))


def _table_of_psnr(runs: list[Run]) -> str:
    """Scenes and sizes by budgets; in brackets the least and the largest of several seeds."""
    budgets, rows = _budgets(runs), {}
    for (label, budget), group in _by_key(runs).items():
        psnrs = sorted(run["psnr"] for run in group)
        spread = f" ({decimals(psnrs[0])} to {decimals(psnrs[-1])})" if len(psnrs) > 1 else ""
        row = rows.setdefault(label, dict.fromkeys(budgets, "–"))
        row[budget] = decimals(_median(group, "psnr")) + spread
    return markdown_table(["", *budgets], ([label, *row.values()] for label, row in rows.items()))


def _table_of_baselines(runs: list[Run], baselines: Baselines) -> str:
    """Ours and other programs where both were trained, at the seconds of our budgets; empty where none was."""
    budgets, rows = _budgets(runs), []
    for panel in panels_of(runs):
        ours = [run for run in runs if panel_of(run) == panel]
        psnr: dict[str, dict[str, float | None]] = {}
        for variant in (BASELINE, WITHOUT_MASKS):
            found = psnr_by_budget([run for run in ours if run["variant"] == variant])
            psnr[name_of(variant)] = {budget: statistics.median(of_seeds) for budget, of_seeds in found.items()}
        programs = by_program(baselines, panel)
        for name, trainings in programs.items():
            psnr[name] = {budget: best_psnr_at(trainings, seconds_of(budget)) for budget in budgets}
        rows += [
            [label_of(panel), name, *(decimals(found.get(budget)) for budget in budgets)]
            for name, found in psnr.items()
            if programs and found
        ]
    return markdown_table(["", "program", *budgets], rows) if rows else ""


def _table_of_published() -> str:
    scenes = list(dict.fromkeys(scene for published in PUBLISHED for scene in published.psnr))
    rows = (
        [f"{p.method} ({p.source})", *(decimals(p.psnr.get(scene)) for scene in scenes), p.training] for p in PUBLISHED
    )
    return markdown_table(["", *scenes, "training"], rows)


def _table_of(runs: list[Run], columns: dict[str, str]) -> str:
    rows = (
        [label, budget, *(_show_median(group, name) for name in columns.values())]
        for (label, budget), group in _by_key(runs).items()
    )
    return markdown_table(["", "budget", *columns], rows)


def _table_of_costs(runs: list[Run]) -> str:
    columns: dict[str, Callable[[list[Run]], str]] = {
        "seconds": lambda group: f"{_median(group, 'seconds'):.1f}",
        "CPU seconds": lambda group: f"{_median(group, 'cpu_seconds'):.0f}",
        "steps": lambda group: f"{_median(group, 'steps'):,.0f}",
        "rows": lambda group: f"{_median(group, 'rows') / 1e6:.1f} M",
        "memory": lambda group: f"{_median(group, 'memory'):.1f} GiB",
        "rendering and measuring a view": lambda group: f"{_median(group, 'seconds_per_view'):.2f} s",
    }
    rows = (
        [label, budget, *(show(group) for show in columns.values())] for (label, budget), group in _by_key(runs).items()
    )
    return markdown_table(["", "budget", *columns], rows)


def _table_of_variants(runs: list[Run]) -> str:
    """Empty where nothing was changed."""
    rows: list[list[Any]] = []
    variants = sorted({run["variant"] for run in runs} - {BASELINE})
    for panel in panels_of(runs):
        of_panel = [run for run in runs if panel_of(run) == panel]
        for budget, variant in product(_budgets(of_panel), variants):
            group = [run for run in of_panel if run["budget"] == budget]
            changed = [run for run in group if run["variant"] == variant]
            seeds = {run["seed"] for run in changed}
            baseline = [run for run in group if run["variant"] == BASELINE and run["seed"] in seeds]
            if changed and len(baseline) == len(changed):
                psnr, before = _median(changed, "psnr"), _median(baseline, "psnr")
                row = [label_of(panel), budget, variant, decimals(psnr), f"{psnr - before:+.2f}", str(len(seeds))]
                rows.append([*row, f"{_median(changed, 'cpu_seconds') / _median(baseline, 'cpu_seconds'):.2f}"])
    return markdown_table(["", "budget", "changed", "PSNR", "difference", "seeds", "CPU time"], rows) if rows else ""
