"""README.md and pictures of the paper's experiments."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.paper.figures import RunsAndViews, draw_figures
from edge_se_sampler.bench.paper.tables import (
    LEGEND,
    count_failures,
    psnr_tables,
    select_common_seeds,
    summary_table,
)
from edge_se_sampler.bench.paper.trials import PAPER_TABLES, TABLES
from edge_se_sampler.bench.paper.verdicts import ClaimVerdict, ComparedRuns, evaluate_claims
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.bench.statistics import format_difference
from edge_se_sampler.bench.strategies import LABELS
from edge_se_sampler.bench.tables import decimals, describe_machine, markdown_table

CAPTIONS = {
    "sheet": "The first test view of every scene as every strategy rendered it, first seed. Red frame: failed.",
    "figure-2": "The paper's figure 2: Precrop's window (red) on a training view, and what each seed came to.",
    "figure-5": "The paper's figure 5: training losses of Random, Precrop and Edge, a line for each seed.",
    "figure-6": "The paper's figure 6: errors near edges, Precrop against Edge, first seed.",
}

QUESTION = """# The paper's experiments

*Important Pixels Sampling for NeRF Training Based on Edge Values and Squared Errors* (the paper) trains NeRF and
InfoNeRF with six strategies of choosing the pixels of a training step. Does the choice matter as the paper says? This
experiment trains the paper's four tables, and more of ours, and tests every claim.

| strategy | pixels in the first tenth of the iterations | afterwards |
|---|---|---|
| Random | uniform | uniform |
| Precrop + Random | uniform in the centre half of the image, each way | uniform |
| SE | uniform | twice as many candidates, half of them kept by the rank of their squared error |
| Precrop + SE | as Precrop | as SE |
| Edge | by edge strength (Sobel) | uniform |
| Edge + SE | by edge strength | as SE |

*Off centre*: the object is smaller, and moved right and down in the image. A training *failed* if it learnt nothing of
the object (its error there is above 90 % of the plain background's) or ended less than 0.5 dB above the background
alone. *In Random's time*: with so many fewer iterations that SE, which renders its candidates too, costs as much as
Random."""

VERDICT_LEGEND = """A comparison pairs runs of the same scene and seed. *Difference*: of PSNR in dB, the mean over these
scenes with its 95 % interval over seeds, of the pairs in which not both runs failed. *Could show*: the smallest true
difference that so many runs find with 80 % power. *Better* is supported if the interval lies above 0; *not inferior*,
if it lies above -0.3 dB and there are no more failures than the baseline's; *prevents failures*, if no run fails on a
scene where most runs of the baseline do. A claim is supported if all of its comparisons are that have anything to
compare."""


def draw(folder: Path, workplace: Path | None) -> None:
    """Draw the pictures; those with renderings only if the workplace has them.

    Raises:
        InputError: the result cannot be read, matplotlib is missing, or a file cannot be written.
    """
    views = (workplace or folder) / "paper" / "views"
    draw_figures(RunsAndViews(read_result(folder / "result.json")["runs"], views), folder)


def describe(folder: Path) -> str:
    """The README.md of a folder with a result.json and pictures.

    Raises:
        InputError: the result cannot be read.
    """
    result = read_result(folder / "result.json")
    runs = result["runs"]
    parts = [QUESTION, _describe_settings(result), "## Results", summary_table(runs)]
    pictures = {name: caption for name, caption in CAPTIONS.items() if (folder / f"{name}.png").exists()}
    if "sheet" in pictures:
        parts.append(_picture("sheet"))
    claims = evaluate_claims(runs)
    if claims:
        rows = [[entry.claim.text, entry.claim.source, f"**{entry.verdict}**"] for entry in claims]
        parts += ["## Claims", markdown_table(["claim", "whose", "verdict"], rows), *_comment(claims, runs)]
    parts += _help_for_random(runs)
    parts += [_picture(name) for name in pictures if name != "sheet"]
    if claims:
        parts += ["## Comparisons behind the verdicts", VERDICT_LEGEND, *map(_describe_claim, claims)]
    parts += ["## All tables", LEGEND, *psnr_tables(runs), "## What a training costs", _costs(runs)]
    return "\n\n".join([*parts, "## Reproduce", _reproduce(result)]) + "\n"


def tables(folder: Path) -> dict[str, str]:
    """None: no other text shows them."""
    return {}


def _picture(name: str) -> str:
    return f"![{CAPTIONS[name]}]({name}.png)\n\n*{CAPTIONS[name]}*"


def _describe_settings(result: dict[str, Any]) -> str:
    settings, runs = result["settings"], result["runs"]
    samples = " + ".join(map(str, settings["samples"])) if settings["samples"] else "the paper's number of"
    scenes = (
        f"Synthetic scenes of {settings['image_size']} x {settings['image_size']} pixels, {settings['num_train']} "
        f"training views (or 10 of them) and {settings['num_test']} test views"
        if settings["image_size"]
        else "NeRF's scenes"
    )
    dead = sum(bool(run["dead_at_start"]) for run in runs)
    return (
        f"{len(runs)} trainings. {scenes}; coarse and fine network of size `{settings['size']}`, "
        f"{settings['iterations']:,} iterations ({settings['info_iterations']:,} of InfoNeRF) of {settings['rays']} "
        f"rays with {samples} samples, one image a step, Xavier initial weights, ReLU density, white background. The "
        "seed gives every strategy the same initial weights; settings were chosen on other seeds than these. "
        "Differences between strategies can be compared with the paper's, the decibels themselves only where scenes "
        "and size are the paper's. Before its first step a network was dead (no density anywhere, hence no gradient) "
        f"in {dead} of the trainings."
    )


def _comment(claims: list[ClaimVerdict], runs: list[Run]) -> list[str]:
    """What the verdicts alone do not say."""
    sentences = []
    for entry in claims:
        if "at equal" in entry.claim.text:
            compared = [row for row in entry.rows if row.difference.low is not None]
            above = sum((row.difference.low or 0) > 0 for row in compared)
            below = sum((row.difference.high or 0) < 0 for row in compared)
            sentences.append(
                f"{entry.claim.text}: of {len(entry.rows)} comparisons, {len(compared)} have enough pairs in which not "
                f"both runs failed for an interval; it lies above 0 in {above} of them, below 0 in {below}."
            )
    small = [run for run in runs if (run["table"], run["strategy"]) == (16, "precrop-nerf")]
    if small:
        sentences.append(f"Precrop with a centred object as small as the off-centre ones: {count_failures(small)}.")
    return [" ".join(sentences)] if sentences else []


def _help_for_random(runs: list[Run]) -> list[str]:
    """How often Random fails with other densities and initial weights."""
    variants = {
        "Xavier weights, ReLU density": (1, 2),
        "softplus density": (14, 15),
        "torch's initial weights": (7, 8),
        "torch's initial weights, dead networks reinitialised": (17, 18),
    }
    of_tables = {
        n: [run for run in select_common_seeds([run for run in runs if run["table"] == n]) if _is_random(run)]
        for n in (1, 2, 7, 8, 14, 15, 17, 18)
    }
    rows = [[label, *(count_failures(of_tables[n]) for n in pair)] for label, pair in variants.items()]
    if not any(of_tables[n] for n in (14, 15, 17, 18)):
        return []
    return [
        "How much of the cure needs no sampler, NeRF with all views and pixels by Random:",
        markdown_table(["Random with", "centred", "off centre"], rows),
    ]


def _is_random(run: Run) -> bool:
    return run["strategy"] == "vanilla-nerf"


def _describe_claim(entry: ClaimVerdict) -> str:
    head = [
        "",
        "difference",
        "failures",
        "of the baseline",
        "pairs compared",
        "could show",
        "scenes above 0",
        "verdict",
    ]
    table = markdown_table(head, map(_comparison_row, entry.rows))
    return f"**{entry.claim.text}** ({entry.claim.source}; {entry.claim.kind}): {entry.verdict}\n\n{table}"


def _comparison_row(row: ComparedRuns) -> list[str]:
    difference = row.difference
    return [
        row.comparison.label,
        format_difference(difference),
        str(row.failures),
        str(row.baseline_failures),
        f"{difference.runs} of {row.pairs}",
        decimals(difference.detectable),
        f"{difference.scenes_better} of {difference.scenes}",
        row.verdict,
    ]


def _costs(runs: list[Run]) -> str:
    """Median CPU seconds of training, and iterations."""
    numbers = [number for number in TABLES if any(run["table"] == number for run in runs)]
    rows = []
    for number in numbers:
        of_table = [run for run in runs if run["table"] == number]
        seconds = {name: [run["cpu_seconds"] for run in of_table if run["strategy"] == name] for name in LABELS}
        medians = [decimals(statistics.median(values) if values else None, 1) for values in seconds.values()]
        rows.append([f"{number}: {TABLES[number].title}", f"{of_table[0]['steps']:,}", *medians])
    return "Median CPU seconds:\n\n" + markdown_table(["table", "iterations", *LABELS.values()], rows)


def _reproduce(result: dict[str, Any]) -> str:
    runs = result["runs"]
    paper, ours = (
        sum(run["cpu_seconds"] for run in runs if (run["table"] in PAPER_TABLES) == of_paper) / 3600
        for of_paper in (True, False)
    )
    text = (
        f"`{result['command']}`: {paper:.1f} CPU hours for the paper's tables and {ours:.1f} for ours, shared by as "
        "many processes as there are cores; it resumes where it was stopped. `edge-se bench report` with the folder "
        "writes this page and the pictures from result.json. `--preset paper --data DIR` trains the paper's own size "
        "on NeRF's scenes, for which you want GPUs."
    )
    seeds = {(run["table"], run["strategy"]): set[int]() for run in runs}
    for run in runs:
        seeds[run["table"], run["strategy"]].add(run["seed"])
    common = set.intersection(*seeds.values()) if seeds else set()
    if more := [f"{LABELS[name]} in table {table}" for (table, name), own in sorted(seeds.items()) if own - common]:
        text += (
            f" Seeds beside {', '.join(map(str, sorted(common)))} were added (`--tables`, `--strategies`, `--seeds`) "
            f"where a claim was undecided, which makes its intervals a little too narrow: {', '.join(more)}."
        )
    return f"{text}\n\nMeasured on: {describe_machine(result['machine'])}."
