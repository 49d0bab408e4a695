"""What the runs say of "auto": failures of 28 configurations, and PSNR over planned lengths against fixed shares."""

from __future__ import annotations

import statistics
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from edge_se_sampler.bench.experiment import write_result
from edge_se_sampler.bench.paper.published import SCENES
from edge_se_sampler.bench.paper.trials import TABLES
from edge_se_sampler.bench.schedule.trials import CONFIGURATIONS, FRACTIONS, LENGTHS, OF_LENGTHS, choice_seeds
from edge_se_sampler.bench.statistics import paired_difference, wilson_interval
from edge_se_sampler.engine.figures import require_pyplot, save_figure
from edge_se_sampler.engine.files import write_atomically

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
        save_figure(draw_lengths(result["lengths"]), output_dir / "lengths.png")


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
        told[f"{arm}_interval"] = [round(bound, 4) for bound in wilson_interval(told[arm], len(pairs))]
        told[f"{arm}_psnr"] = statistics.mean(place[(*pair, arm)]["psnr"] for pair in pairs)
    told["revived"] = sum(place[(*pair, "auto")]["revived"] > 0 for pair in pairs)
    told["configurations"] = [
        {"table": t, "scene": s, "pairs": len(mine), "random": count("random", mine), "auto": count("auto", mine)}
        for t in CONFIGURATIONS
        for s in SCENES
        if (mine := [pair for pair in pairs if pair[:2] == (t, s)])
    ]
    return told


def shares(runs: list[dict[str, Any]]) -> dict[int, dict[str, float]]:
    """Planned length -> PSNR of every fixed share on the seeds of choice, of those that have all."""
    told = {}
    for length in LENGTHS:
        chosen_on = [
            r
            for r in runs
            if r["part"] == "lengths" and r["iterations"] == length and r["seed"] in choice_seeds(length)
        ]
        means = {arm: _mean([r for r in chosen_on if r["arm"] == arm]) for arm in FRACTIONS}
        if None not in means.values():
            told[length] = means
    return told


def best_shares(runs: list[dict[str, Any]]) -> dict[int, str]:
    """Planned length -> the fixed share with the highest PSNR on the seeds of choice."""
    return {length: max(means, key=lambda arm, of=means: of[arm]) for length, means in shares(runs).items()}


def lengths(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of every planned length: the share chosen on other seeds, and auto's paired difference from it."""
    told, best = [], best_shares(runs)
    for length, means in shares(runs).items():
        reported = [r for r in runs if r["part"] == "lengths" and r["iterations"] == length]
        place = {
            (r["table"], r["scene"], r["seed"], r["arm"]): r["psnr"]
            for r in reported
            if r["seed"] not in choice_seeds(length)
        }
        pairs = sorted(key[:3] for key in place if key[3] == "auto" and (*key[:3], best[length]) in place)
        if pairs:
            differences = [
                (f"{t} {s}", place[t, s, seed, "auto"] - place[t, s, seed, best[length]]) for t, s, seed in pairs
            ]
            told.append({
                "iterations": length, "best": best[length], "chosen_by": means, "differences": differences,
                **asdict(paired_difference(differences)),
            })  # fmt: skip
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


def draw_lengths(told: list[dict[str, Any]]) -> Any:
    """How much hangs on a fixed share, and how far auto is from the best: a colour a planned length, a dot a pair."""
    figure, (left, right) = require_pyplot().subplots(1, 2, figsize=(9.5, 3.4))
    for place, row in enumerate(told):
        color, means = f"C{place}", row["chosen_by"]
        below = [means[share] - means[row["best"]] for share in FRACTIONS]
        left.plot(range(len(FRACTIONS)), below, "o-", color=color, ms=4, label=f"{row['iterations']:,}")
        values = [value for _, value in row["differences"]]
        right.plot(place + np.linspace(-0.15, 0.15, len(values)), values, ".", color=color, ms=5, alpha=0.6)
        if row["low"] is not None:
            right.vlines(place + 0.28, row["low"], row["high"], color=color, lw=3)
        right.plot(place + 0.28, row["mean"], "_", color=color, ms=12, mew=2)
    left.set_xticks(range(len(FRACTIONS)), FRACTIONS)
    left.set(xlabel="fixed share of the iterations", ylabel="PSNR below the best share [dB]")
    left.set_title("A fixed early phase (seeds of choice)", fontsize=10)
    left.legend(title="planned iterations", fontsize=7, title_fontsize=7, frameon=False)
    right.axhline(-MARGIN, color="black", lw=0.8, ls="--")
    right.axhline(0, color="black", lw=0.8)
    right.text(-0.4, -MARGIN, "not inferior above", fontsize=7, va="bottom")
    right.set_xticks(range(len(told)), [f"{row['iterations']:,}\nagainst {row['best']}" for row in told])
    right.set(xlabel="planned iterations", ylabel="auto - best share [dB]")
    right.set_title("Auto against the best one (other seeds, mean and 95 %)", fontsize=10)
    for axis in (left, right):
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure
