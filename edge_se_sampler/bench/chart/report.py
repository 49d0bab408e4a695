"""The chart's README.md, pictures, and table of methods for other texts."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.baselines.run import read_baselines
from edge_se_sampler.bench.chart.figures import draw_chart, draw_scenes
from edge_se_sampler.bench.chart.summary import END, by_variant, comparable, mean_psnr_at, runs_on, scenes_of
from edge_se_sampler.bench.chart.trials import ChartSettings
from edge_se_sampler.bench.chart.variants import GROUPS, RECOMMENDED, TOP, VARIANTS
from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.report import decimals, describe_command, fill_template, markdown_table, read_notes
from edge_se_sampler.bench.results import Run, read_result
from edge_se_sampler.engine.figures import save_figure

COLUMNS = {3: "3 s", 7: "7 s", 20: "20 s", 60: "60 s", END: "end"}  # moments -> heads, if trainings are so long
Baselines = Mapping[str, list[Run]]  # label of another program -> its runs


def draw(folder: Path, workplace: Path | None) -> None:
    del workplace
    result, baselines, _ = _read(folder)
    runs, settings = result["runs"], ChartSettings(**result["settings"])
    if len(comparable(by_variant(runs, TOP))) > 1:
        save_figure(draw_chart(runs, baselines, settings), folder / "chart.png")
    if runs:
        save_figure(draw_scenes(runs, baselines, settings), folder / "scenes.png")


def describe(folder: Path) -> str:
    """The README.md, of a single variant one of its own."""
    result, baselines, baseline_results = _read(folder)
    runs, settings = result["runs"], ChartSettings(**result["settings"])
    groups = {group: _describe_group(runs, group, baselines) for group in GROUPS}
    variants = {run["variant"] for run in runs}
    return fill_template(
        __file__,
        folder,
        "one_variant.md" if len(variants) == 1 and not baselines else "report.md",
        **result["settings"],
        **groups,
        unit=settings.unit,
        source=settings.source,
        number=len(runs),
        seeds=len({run["seed"] for run in runs}),
        variant=", ".join(VARIANTS[name].full_label for name in variants),
        table="".join(groups.values()),
        failure_rule=FAILURE_RULE,
        every_scene=_compare_scenes(runs, baselines),
        notes=read_notes(folder),
        reproduce=describe_command(*baseline_results, result),
    )


def tables(folder: Path) -> dict[str, str]:
    """methods: PSNR of methods and baselines after some seconds and at the end, and failures."""
    result, baselines, _ = _read(folder)
    return {"methods": _group_table(result["runs"], "methods", baselines, costs=False)[1]}


def _read(folder: Path) -> tuple[dict[str, Any], Baselines, Iterable[dict[str, Any]]]:
    """The result, the baselines' runs, and their results."""
    result = read_result(folder / "result.json")
    settings = ChartSettings(**result["settings"])
    baselines = read_baselines(folder, threads=settings.threads, image_size=settings.image_size, data=settings.data)
    return result, {label: baseline["runs"] for label, baseline in baselines.items()}, baselines.values()


def _describe_group(runs: list[Run], group: str, baselines: Baselines) -> str:
    """A group's table, and on which scenes it compares; empty if none of the group was trained."""
    if not any(VARIANTS[run["variant"]].group == group for run in runs):
        return ""
    scenes, table = _group_table(runs, group, baselines)
    return f"On {', '.join(scenes) or 'no scene and seed that all have'}:\n\n{table}"


def _group_table(runs: list[Run], group: str, baselines: Baselines, costs: bool = True) -> tuple[list[str], str]:
    """The scenes that a group is compared on, and its variants, and baselines beside methods: PSNR, failures, costs."""
    compared = comparable(by_variant(runs, TOP if group in TOP else [group]))
    scenes = scenes_of(chain(*compared.values()))
    longest = max((run["seconds"] for run in runs), default=0.0)
    moments = [seconds for seconds in COLUMNS if seconds == END or 1.05 * seconds < longest]
    shown = {
        VARIANTS[n].label: found for n, found in compared.items() if VARIANTS[n].group == group or n == RECOMMENDED
    }
    if group == "methods":
        shown |= {label: found for label, all_runs in baselines.items() if (found := runs_on(all_runs, scenes))}
    rows = []
    for label, found in shown.items():
        psnr = [decimals(mean_psnr_at(found, seconds)) for seconds in moments]
        rows.append([label, *psnr, _failures(found), *(_cost_fields(found) if costs else ())])
    head = ["", *(COLUMNS[seconds] for seconds in moments), "failed"]
    return scenes, markdown_table([*head, *(("ms a step", "queries a step", "memory") if costs else ())], rows)


def _compare_scenes(runs: list[Run], baselines: Baselines) -> str:
    """PSNR at the end on each scene, of variants and baselines that were trained on more than one."""
    scenes = scenes_of(runs)
    by_label = {VARIANTS[name].full_label: found for name, found in by_variant(runs).items()} | dict(baselines)
    by_label = {label: found for label, found in by_label.items() if len({*scenes_of(found)}.intersection(scenes)) > 1}
    on_scenes = [{label: runs_on(found, [scene]) for label, found in by_label.items()} for scene in scenes]
    compared = [comparable({label: found for label, found in by.items() if found}) for by in on_scenes]
    rows = []
    for label in by_label:
        columns = [by.get(label, []) for by in compared]
        shown = list(chain(*columns))
        if shown:
            fields = [decimals(mean_psnr_at(found, END)) for found in columns]
            for i, found in enumerate(columns):
                if any("outcome" in run and failed(run) for run in found):
                    fields[i] = f"({fields[i]})"
            mean, least = mean_psnr_at(runs_on(shown, scenes), END), min(run["curve"][-1][-1] for run in shown)
            rows.append([label, *fields, decimals(mean), decimals(least), _failures(shown)])
    return markdown_table(["", *scenes, "mean", "least", "failed"], rows) if rows else ""


def _failures(runs: list[Run]) -> str:
    return f"{sum(map(failed, runs))} of {len(runs)}" if all("outcome" in run for run in runs) else "–"


def _cost_fields(runs: list[Run]) -> list[str]:
    """Milliseconds and queries a step, and memory; not known of baselines, nor lean-nerf's queries."""
    if not all("queries" in run for run in runs):
        return ["–", "–", "–"]
    step = statistics.median(1000 * (run["seconds"] - run["ready_seconds"]) / run["steps"] for run in runs)
    queries = statistics.median(run["queries"] / run["steps"] for run in runs)
    counted = f"{queries:,.0f}" if queries else "–"
    memory = statistics.median(run["peak_bytes"] for run in runs) / 2**20
    return [f"{step:.1f}", counted, f"{memory:,.0f} MiB"]
