"""What the chart's runs say: PSNR against training time, the front, and what each part is worth.

A variant's curve is, at every look, the mean over scenes of the median over seeds; a run that has ended stays at what
it ended with. The front is, at every moment, the variant that is best then.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from edge_se_sampler.bench.chart.train import LOOKS
from edge_se_sampler.bench.chart.variants import GROUPS, VARIANTS, Group

Run = dict[str, Any]
RECOMMENDED = "lean"
TOP: tuple[Group, ...] = ("methods", "scorings")
"""Kinds of variants on the chart itself; the others are parts of the recommended method."""


def scenes_of(runs: list[Run]) -> list[str]:
    """Scenes, in the order of their names."""
    return sorted({run["scene"] for run in runs})


def at(curve: Sequence[Sequence[float]], seconds: float) -> float | None:
    """PSNR at a moment of training, between looks by the logarithm of time; None before the first look,
    which comes a step late."""
    times, psnr = [point[0] for point in curve], [point[-1] for point in curve]
    if not times or seconds < times[0] * 0.99:
        return None
    return float(np.interp(np.log(seconds), np.log(times), psnr))


def over_scenes(runs: list[Run], seconds: float, of_seeds: Callable[[Any], Any] = np.median) -> float | None:
    """Mean over scenes of the median (or what else) over seeds; None if a run had nothing to show yet."""
    values = {scene: [at(r["curve"], seconds) for r in runs if r["scene"] == scene] for scene in scenes_of(runs)}
    if not values or any(value is None for found in values.values() for value in found):
        return None
    return statistics.mean(float(of_seeds(found)) for found in values.values())


def comparable(runs: list[Run], groups: Collection[Group] = tuple(GROUPS)) -> dict[str, list[Run]]:
    """Variants of some groups, and the recommended one, -> their runs on the scenes and seeds that all of them have."""
    names = [name for name, variant in VARIANTS.items() if variant.group in groups or name == RECOMMENDED]
    by_variant = {name: mine for name in names if (mine := [run for run in runs if run["variant"] == name])}
    if not by_variant:
        return {}
    common = set.intersection(*({(run["scene"], run["seed"]) for run in mine} for mine in by_variant.values()))
    if not common:
        return {}
    return {name: [run for run in mine if (run["scene"], run["seed"]) in common] for name, mine in by_variant.items()}


def front(runs: list[Run]) -> list[dict[str, Any]]:
    """At every look the best variant, and how far the recommended one is from it, dB."""
    told = []
    for seconds in (look for look in LOOKS if any(run["seconds"] >= look for run in runs)):
        known = {name: over_scenes(mine, seconds) for name, mine in comparable(runs).items()}
        values = {name: value for name, value in known.items() if value is not None}
        if values:
            best = max(values, key=lambda name, of=values: of[name])
            mine = values.get(RECOMMENDED)
            behind = None if mine is None else round(values[best] - mine, 3)
            told.append(
                {"seconds": seconds, "best": best, "psnr": round(values[best], 3), "recommended_behind": behind}
            )
    return told


def dominating(runs: list[Run]) -> list[str]:
    """Variants better than the recommended one at every look that both have: with one, it is off the front."""
    told = []
    for name in {run["variant"] for run in runs} - {RECOMMENDED}:
        both = comparable([run for run in runs if run["variant"] in (name, RECOMMENDED)])
        pairs = [(over_scenes(both[RECOMMENDED], look), over_scenes(both[name], look)) for look in LOOKS]
        known = [(ours, theirs) for ours, theirs in pairs if ours is not None and theirs is not None]
        if known and all(theirs > ours for ours, theirs in known):
            told.append(name)
    return sorted(told)


def rows_of(runs: list[Run]) -> tuple[list[str], dict[Group, list[list[str]]]]:
    """The table's head, and of every group its variants' rows: PSNR at looks and at the end, failures, costs."""
    looks = _shown_looks(runs)
    head = ["", *(f"{look} s" for look in looks), "end", "failed", "ms a step", "evaluations a step", "memory"]
    told: dict[Group, list[list[str]]] = {}
    for group in GROUPS:
        mine = comparable(runs, TOP if group in TOP else (group,))
        if any(VARIANTS[name].group == group for name in mine):
            shown = [name for name in mine if VARIANTS[name].group == group or name == RECOMMENDED]
            told[group] = [[VARIANTS[name].label, *_fields(mine[name], looks)] for name in shown]
    return head, told


def rows_of_scenes(runs: list[Run], external: Sequence[dict[str, Any]] = ()) -> tuple[list[str], list[list[str]]]:
    """Of methods and scorings, and other programs, that were trained on all scenes with one seed, the least: PSNR at
    the end on each, in brackets where nothing was learnt, as far as that is known. No rows where there is one scene."""
    scenes, seed = scenes_of(runs), min(run["seed"] for run in runs)
    ends = {(run["variant"], run["scene"]): run for run in runs if run["seed"] == seed}
    top = [name for name, variant in VARIANTS.items() if variant.group in TOP]
    names = [name for name in top if all((name, scene) in ends for scene in scenes)]
    told = [[VARIANTS[name].label, *(_end(ends[name, scene]) for scene in scenes)] for name in names]
    for program in external:
        theirs = {run["scene"]: run["curve"][-1][1] for run in program["runs"] if run["seed"] == seed}
        if theirs.keys() >= set(scenes):
            told.append([program["name"], *(_shown(theirs[scene]) for scene in scenes)])
    return ["", *scenes], told if len(scenes) > 1 else []


def beside(program: dict[str, Any], shown: dict[str, list[Run]]) -> list[Run]:
    """Another program's runs on the scenes of what is shown; none, where it lacks one of them."""
    scenes = {run["scene"] for mine in shown.values() for run in mine}
    mine = [run for run in program["runs"] if run["scene"] in scenes]
    return mine if scenes == {run["scene"] for run in mine} else []


def rows_of_others(runs: list[Run], external: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Of every other program its name, version, flags, and PSNR at the same looks and at the end."""
    shown = comparable(runs, TOP)
    told = []
    for program in external:
        mine = beside(program, shown)
        values = [over_scenes(mine, look) for look in (*_shown_looks(runs), float("inf"))]
        told.append([*(str(program[key]) for key in ("name", "version", "command")), *map(_shown, values)])
    return told


def table(runs: list[Run], external: Sequence[dict[str, Any]]) -> str:
    """Markdown of both."""
    head, rows = rows_of(runs)
    tables = {GROUPS[group]: (head, mine) for group, mine in rows.items()}
    scenes, ends = rows_of_scenes(runs, external)
    if ends:
        tables["Every scene, one seed, at the end"] = (scenes, ends)
    if external:
        looks = head[1 : head.index("failed")]
        tables["Other programs"] = (["", "version", "flags", *looks], rows_of_others(runs, external))
    parts = [
        "Mean over scenes of test PSNR in dB, medians over seeds, by seconds of training; in each table the scenes and "
        "seeds that all of its variants have."
    ]
    for title, (top, mine) in tables.items():
        lines = [f"| {' | '.join(row)} |" for row in (top, *mine)]
        lines.insert(1, "|---" * len(top) + "|")
        parts.append(f"**{title}**\n\n" + "\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _shown_looks(runs: list[Run]) -> list[int]:
    return [look for look in (3, 7, 20, 60) if any(run["seconds"] > 1.05 * look for run in runs)]


def _end(run: Run) -> str:
    return f"{run['psnr']:.2f}" if run["outcome"] == "learnt" else f"({run['psnr']:.2f})"


def _shown(psnr: float | None) -> str:
    return "–" if psnr is None else f"{psnr:.2f}"


def _fields(runs: list[Run], looks: list[int]) -> list[str]:
    values = [over_scenes(runs, look) for look in looks]
    end = statistics.mean(
        statistics.median(run["psnr"] for run in runs if run["scene"] == scene) for scene in scenes_of(runs)
    )
    failed = sum(run["outcome"] != "learnt" for run in runs)
    step = statistics.median(1000 * (run["seconds"] - run["ready_seconds"]) / run["steps"] for run in runs)
    asked = statistics.median(run["evaluations"] / run["steps"] for run in runs)
    memory = statistics.median(run["peak_bytes"] for run in runs) / 2**20
    return [
        *map(_shown, (*values, end)),
        f"{failed} of {len(runs)}",
        f"{step:.1f}",
        f"{asked:,.0f}",
        f"{memory:,.0f} MiB",
    ]
