"""Runs on real scenes in panels, a scene at a size each, and what other programs reach there at equal seconds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from edge_se_sampler.bench.real.published import PIXELS, PUBLISHED
from edge_se_sampler.bench.results import Run

BASELINE, UNIFORM, WITHOUT_MASKS = "lean-nerf", "uniform pixels", "no hull"
"""Variants: the one that others are compared with, that without edges, and the one that knows no masks in advance."""
STEPS = " steps"
"""Ends a budget that is a number of training steps."""
Panel = tuple[str, tuple[int, int]]
"""A scene, and its images' width and height in pixels."""
Trainings = list[Run]
"""Of a program on a panel with the same flags: one a seed."""


def panel_of(run: Run) -> Panel:
    width, height = run.get("size") or [PIXELS // run["downscale"]] * 2  # the first runs, of NeRF's scenes, have none
    return run["scene"], (width, height)


def panels_of(runs: list[Run]) -> list[Panel]:
    """NeRF's scenes first, small before large."""
    order = {panel_of(run): (run.get("val_psnr") is None, -run["downscale"], run["scene"]) for run in runs}
    return sorted(order, key=lambda panel: order[panel])


def is_published(panel: Panel) -> bool:
    """Whether others have published results of a scene at that size."""
    scene, size = panel
    return size == (PIXELS, PIXELS) and any(scene in published.psnr for published in PUBLISHED)


def label_of(panel: Panel) -> str:
    scene, (width, height) = panel
    return f"{scene}, {width} px" if width == height else f"{scene}, {width} x {height} px"


def name_of(variant: str) -> str:
    return variant if variant == BASELINE else f"{BASELINE}, {variant}"


def is_time(budget: str) -> bool:
    """Whether a budget is a time; the others are numbers of steps, "2000 steps", the same on any machine."""
    return not budget.endswith(STEPS)


def timed(runs: list[Run]) -> list[Run]:
    """The runs with a time budget."""
    return [run for run in runs if is_time(run["budget"])]


def length_of(budget: str) -> tuple[bool, float]:
    """What sorts budgets: times, shortest first, before numbers of steps."""
    return (False, seconds_of(budget)) if is_time(budget) else (True, float(budget.removesuffix(STEPS)))


def seconds_of(budget: str) -> float:
    number = budget.strip()
    return float(number.rstrip("smh")) * {"m": 60, "h": 3600}.get(number[-1], 1)


def psnr_by_budget(runs: list[Run]) -> dict[str, list[float]]:
    """Of the seeds, for every time budget, shortest first."""
    budgets = sorted({run["budget"] for run in timed(runs)}, key=seconds_of)
    return {budget: [run["psnr"] for run in runs if run["budget"] == budget] for budget in budgets}


def by_program(results: Mapping[str, Mapping[str, Any]], panel: Panel) -> dict[str, list[Trainings]]:
    """Name and version of another program -> its trainings on a panel, a list for every file of results."""
    scene, size = panel
    programs: dict[str, list[Trainings]] = {}
    for result in results.values():
        settings = result["settings"]
        runs = [run for run in result["runs"] if run["scene"] == scene and settings["image_size"] == max(size)]
        if runs:
            programs.setdefault(f"{settings['program']} ({settings['program_version']})", []).append(runs)
    return programs


def best_psnr_at(trainings: list[Trainings], seconds: float) -> float | None:
    """The best of a program's trainings that were looked at then, or a step later; of each the median over seeds."""
    found = []
    for runs in trainings:
        looks = [[psnr for at, psnr in run["curve"] if 0.99 * seconds < at < 1.05 * seconds] for run in runs]
        if all(looks):
            found.append(statistics.median(look[0] for look in looks))
    return max(found, default=None)
