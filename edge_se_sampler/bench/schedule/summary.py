"""What the runs say of "auto": failures of 28 configurations, and PSNR over planned lengths against fixed shares."""

from __future__ import annotations

import statistics
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.experiment import write_result
from edge_se_sampler.bench.paper.cell import TABLES
from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.schedule.cell import CHOICE_SEEDS, CONFIGURATIONS, FRACTIONS, LENGTHS, OF_LENGTHS
from edge_se_sampler.bench.statistics import paired_difference, wilson
from edge_se_sampler.engine.files import write_atomically
from edge_se_sampler.show import require_pyplot, save_figure

MARGIN = 0.2
"""dB: not worse by more."""


def write_outputs(result: dict[str, Any], output_dir: Path) -> None:
    """Both bars in result.json, table.md, and lengths.png, of the runs that there are.

    Raises:
        InputError: a file cannot be written, or matplotlib is missing.
    """
    runs = result["runs"]
    result["failures"], result["lengths"] = failures(runs), lengths(runs)
    write_result(output_dir / "result.json", result)
    write_atomically(output_dir / "table.md", table(result).encode())
    if result["lengths"]:
        save_figure(draw_lengths(runs), output_dir / "lengths.png")


def failures(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Failed runs of Random and of auto, over the pairs that both have: in all, and of every configuration."""
    place = {(r["table"], r["scene"], r["seed"], r["arm"]): r for r in runs if r["part"] == "failures"}
    pairs = sorted({key[:3] for key in place if (*key[:3], "random") in place and (*key[:3], "auto") in place})
    if not pairs:
        return {}

    def count(arm: str, chosen: list[tuple[Any, ...]]) -> int:
        return sum(place[(*pair, arm)]["outcome"] != "learnt" for pair in chosen)

    told: dict[str, Any] = {"pairs": len(pairs)}
    for arm in ("random", "auto"):
        told[arm] = count(arm, pairs)
        told[f"{arm}_interval"] = [round(bound, 4) for bound in wilson(told[arm], len(pairs))]
        told[f"{arm}_psnr"] = statistics.mean(place[(*pair, arm)]["psnr"] for pair in pairs)
    told["revived"] = sum(place[(*pair, "auto")]["revived"] > 0 for pair in pairs)
    told["configurations"] = [
        {"table": t, "scene": s, "pairs": len(mine), "random": count("random", mine), "auto": count("auto", mine)}
        for t in CONFIGURATIONS
        for s in SCENES
        if (mine := [pair for pair in pairs if pair[:2] == (t, s)])
    ]
    return told


def lengths(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of every planned length: the share chosen on other seeds, and auto's paired difference from it."""
    told = []
    for length in LENGTHS:
        mine = [run for run in runs if run["part"] == "lengths" and run["iterations"] == length]
        chosen_on, reported = ([r for r in mine if (r["seed"] in CHOICE_SEEDS) == on] for on in (True, False))
        means = {
            arm: mean for arm in FRACTIONS if (mean := _mean([r for r in chosen_on if r["arm"] == arm])) is not None
        }
        if len(means) < len(FRACTIONS):
            continue
        best = max(means, key=lambda arm, of=means: of[arm])
        place = {(r["table"], r["scene"], r["seed"], r["arm"]): r["psnr"] for r in reported}
        pairs = [key[:3] for key in place if key[3] == "auto" and (*key[:3], best) in place]
        if pairs:
            found = paired_difference(
                [(f"{t} {s}", place[t, s, seed, "auto"] - place[t, s, seed, best]) for t, s, seed in pairs]
            )
            told.append({"iterations": length, "best": best, "chosen_by": means, **asdict(found)})
    return told


def _mean(runs: list[dict[str, Any]]) -> float | None:
    """Of every scene alike; None if one is missing."""
    by_scene = {place: [r["psnr"] for r in runs if (r["table"], r["scene"]) == place] for place in OF_LENGTHS}
    return statistics.mean(map(statistics.mean, by_scene.values())) if all(by_scene.values()) else None


def table(result: dict[str, Any]) -> str:
    """Markdown of both."""
    parts = []
    if told := result["failures"]:
        low, high = told["auto_interval"]
        parts.append(
            f"Of {told['pairs']} paired runs Random failed in {told['random']}, auto in {told['auto']} "
            f"(95 % Wilson interval of the rate {100 * low:.1f} to {100 * high:.1f} %); in {told['revived']} a dead "
            "network began anew. Failures of Random / of auto, and pairs:"
        )
        lines = ["| | " + " | ".join(SCENES) + " |", "|---" * (len(SCENES) + 1) + "|"]
        for number in CONFIGURATIONS:
            of = {row["scene"]: row for row in told["configurations"] if row["table"] == number}
            fields = [f"{of[s]['random']} / {of[s]['auto']}, {of[s]['pairs']}" if s in of else "–" for s in SCENES]
            lines.append(f"| {TABLES[number].title} | " + " | ".join(fields) + " |")
        parts.append("\n".join(lines))
    if told := result["lengths"]:
        parts.append(
            "PSNR of auto against the fixed share of the iterations that was best on other seeds, dB, with the 95 % "
            f"interval; not inferior where it stays above -{MARGIN}:"
        )
        lines = ["| iterations | best fixed share | auto against it | pairs | not inferior |", "|---" * 5 + "|"]
        for row in told:
            known = row["low"] is not None
            interval = f" [{row['low']:+.2f}, {row['high']:+.2f}]" if known else ""
            verdict = ("yes" if row["low"] > -MARGIN else "no") if known else "too few runs"
            lines.append(
                f"| {row['iterations']:,} | {row['best']} | {row['mean']:+.2f}{interval} | {row['runs']} | {verdict} |"
            )
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def draw_lengths(runs: list[dict[str, Any]]) -> Any:
    """PSNR over the planned length, a panel a scene; every arm a line, its seeds dots."""
    figure, axes = require_pyplot().subplots(1, len(OF_LENGTHS), figsize=(3.1 * len(OF_LENGTHS), 3.2))
    for axis, (number, scene) in zip(axes, OF_LENGTHS, strict=True):
        for i, arm in enumerate((*FRACTIONS, "auto")):
            mine = [
                r
                for r in runs
                if r["part"] == "lengths" and (r["table"], r["scene"], r["arm"]) == (number, scene, arm)
                if r["seed"] not in CHOICE_SEEDS
            ]
            steps = sorted({run["iterations"] for run in mine})
            means = [np.mean([run["psnr"] for run in mine if run["iterations"] == step]) for step in steps]
            color = "#d62728" if arm == "auto" else require_pyplot().get_cmap("Blues")(0.3 + 0.14 * i)
            axis.plot(steps, means, color=color, lw=2 if arm == "auto" else 1.2, label=arm)
            axis.plot([r["iterations"] for r in mine], [r["psnr"] for r in mine], ".", color=color, ms=3)
        axis.set(xscale="log", xlabel="planned iterations", title=f"{scene}, {TABLES[number].title.split(', ')[-1]}")
        axis.title.set_fontsize(9)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("test PSNR [dB]")
    axes[-1].legend(title="early phase", fontsize=7, title_fontsize=7, frameon=False)
    figure.tight_layout()
    return figure
