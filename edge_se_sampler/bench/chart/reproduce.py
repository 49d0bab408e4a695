"""The commands that train exactly what a chart's folder holds."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.chart.summary import runs_of, scenes_of
from edge_se_sampler.bench.chart.trials import ChartSettings
from edge_se_sampler.bench.chart.variants import VARIANTS
from edge_se_sampler.bench.runner import Run


def commands_of(
    folder: Path, runs: list[Run], settings: ChartSettings, baselines: Sequence[dict[str, Any]]
) -> list[str]:
    """Commands that train exactly the runs that there are, baselines first."""
    output = ["--output-dir", f"configs/{folder.name}"]
    shared = []
    if settings.seconds != ChartSettings.seconds:
        shared += ["--seconds", f"{settings.seconds:g}"]
    if settings.threads != ChartSettings.threads:
        shared += ["--threads", f"{settings.threads}"]
    if settings.image_size != ChartSettings.image_size:
        shared += ["--data", "DIR"]
    commands = []
    for baseline in baselines:
        of = baseline["settings"]
        words = ["baselines", *output, "--program", of["program"], "--label", of["label"]]
        words += ["--checkout", of["program"]] if not of["program"].startswith("nerfstudio-") else []
        for _, scenes, seeds in _blocks([{**run, "variant": of["program"]} for run in baseline["runs"]]):
            commands.append([*words, *_scene_flags(scenes, seeds), *shared, f"--flags={of['flags']}"])
    for variants, scenes, seeds in _blocks(runs):
        chosen = [] if set(variants) == set(VARIANTS) else ["--variants", *variants]
        commands.append(["chart", *output, *chosen, *_scene_flags(scenes, seeds), *shared])
    return [shlex.join(["edge-se", "bench", *words]) for words in commands]


def _blocks(runs: list[Run]) -> list[tuple[list[str], list[str], list[int]]]:
    """Runs as blocks of variants x scenes x seeds that share none."""
    scenes_by_seeds: dict[str, dict[tuple[int, ...], list[str]]] = {}
    for name in dict.fromkeys([*VARIANTS, *(run["variant"] for run in runs)]):
        found = runs_of(runs, name)
        for scene in scenes_of(found):
            seeds = tuple(sorted(run["seed"] for run in found if run["scene"] == scene))
            scenes_by_seeds.setdefault(name, {}).setdefault(seeds, []).append(scene)
    blocks: dict[tuple[tuple[str, ...], tuple[int, ...]], list[str]] = {}
    for name, by_seeds in scenes_by_seeds.items():
        for seeds, scenes in by_seeds.items():
            blocks.setdefault((tuple(scenes), seeds), []).append(name)
    return [(variants, list(scenes), list(seeds)) for (scenes, seeds), variants in blocks.items()]


def _scene_flags(scenes: Sequence[str], seeds: Sequence[int]) -> list[str]:
    flags = [] if list(scenes) == ["bricks"] else ["--scenes", *scenes]
    return flags if list(seeds) == [0, 1, 2] else [*flags, "--seeds", *map(str, seeds)]
