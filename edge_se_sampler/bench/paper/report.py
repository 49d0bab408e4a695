"""README.md and pictures of the paper's experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from edge_se_sampler.bench.outcomes import FAILURE_RULE
from edge_se_sampler.bench.paper.figures import RunsAndViews, draw_figures
from edge_se_sampler.bench.paper.tables import (
    LEGEND,
    count_failures,
    psnr_tables,
    select_runs,
    summary_table,
)
from edge_se_sampler.bench.paper.verdicts import ClaimVerdict, ComparedRuns, evaluate_claims
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.bench.statistics import format_difference
from edge_se_sampler.bench.tables import decimals, describe_command, markdown_table

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

*Off centre*: the object is smaller, and moved right and down in the image. *In Random's time*: with so many fewer
iterations that SE, which renders its candidates too, costs as much as Random."""

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
    runs, claims = result["runs"], evaluate_claims(result["runs"])
    pictures = {
        name: f"![{name}]({name}.png)\n\n*{caption}*"
        for name, caption in CAPTIONS.items()
        if (folder / f"{name}.png").exists()
    }
    verdicts = [[entry.claim.text, entry.claim.source, f"**{entry.verdict}**"] for entry in claims]
    parts = [
        QUESTION,
        _describe_settings(result),
        "## Results",
        summary_table(runs),
        pictures.pop("sheet", ""),
        "## Claims",
        markdown_table(["claim", "whose", "verdict"], verdicts),
        _comment(claims, runs),
        "How much of the cure needs no sampler:",
        _other_cures(runs),
        *pictures.values(),
        "## The comparisons",
        VERDICT_LEGEND,
        *map(_describe_claim, claims),
        "## All tables",
        LEGEND,
        *psnr_tables(runs),
        "## Reproduce",
        "Seeds that only some strategies of a table have were added (`--tables`, `--strategies`, `--seeds`) where a "
        "claim was undecided, which makes its intervals a little too narrow. `--preset paper --data DIR` trains the "
        "paper's own size on NeRF's scenes, for which you want GPUs.",
        describe_command(result),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


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
        f"in {dead} of the trainings. {FAILURE_RULE}"
    )


def _comment(claims: list[ClaimVerdict], runs: list[Run]) -> str:
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
    return " ".join([*sentences, f"Precrop with a centred object as small as off centre: {count_failures(small)}."])


def _other_cures(runs: list[Run]) -> str:
    """How often Random fails with other densities and initial weights."""
    tables = {
        "Xavier weights, ReLU density": (1, 2),
        "softplus density": (14, 15),
        "torch's initial weights": (7, 8),
        "torch's initial weights, dead networks reinitialised": (17, 18),
    }
    rows = [
        [
            label,
            *(count_failures([run for run in select_runs(runs, n) if run["strategy"] == "vanilla-nerf"]) for n in pair),
        ]
        for label, pair in tables.items()
    ]
    return markdown_table(["Random with", "NeRF, all views, centred", "off centre"], rows)


def _describe_claim(entry: ClaimVerdict) -> str:
    fields = "difference, failures, of the baseline, pairs compared, could show, scenes above 0, verdict"
    table = markdown_table(["", *fields.split(", ")], map(_comparison_row, entry.rows))
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
