"""README.md and pictures of the paper's experiments."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from pathlib import Path

from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.paper.figures import draw_figures
from edge_se_sampler.bench.paper.published import LABELS, REAL_SCENES, SCENES, published
from edge_se_sampler.bench.paper.trials import PAPER_TABLES, REAL_DOWNSCALE, TABLES
from edge_se_sampler.bench.paper.verdicts import MIN_DIFFERENCE, ClaimVerdict, evaluate_claims
from edge_se_sampler.bench.report import decimals, describe_command, fill_template, markdown_table, read_notes
from edge_se_sampler.bench.results import Run, read_result
from edge_se_sampler.bench.statistics import format_difference

OTHER_CURES = {
    "Xavier weights, ReLU density": (1, 2),
    "softplus density": (14, 15),
    "torch's initial weights": (7, 8),
    "torch's initial weights, dead networks reinitialised": (17, 18),
}
"""What may keep Random from failing -> its tables, centred and off centre."""
COLUMNS = ["", "difference", "failures", "of the baseline", "pairs compared", "could show", "scenes above 0", "verdict"]


def draw(folder: Path, workplace: Path | None) -> None:
    """Draw the pictures; those with renderings only if the workplace has them."""
    draw_figures(read_result(folder / "result.json")["runs"], (workplace or folder) / "paper" / "views", folder)


def describe(folder: Path) -> str:
    """The README.md of a folder with a result.json and pictures."""
    result = read_result(folder / "result.json")
    all_runs = result["runs"]
    runs = [run for run in all_runs if run["scene"] not in REAL_SCENES]
    real_runs = [run for run in all_runs if run["scene"] in REAL_SCENES]
    claims, real_claims = (evaluate_claims(found) for found in (runs, real_runs))
    on_real = {entry.claim.text: entry for entry in real_claims}
    numbers = [number for number in TABLES if any(run["table"] == number for run in all_runs)]
    tables = [f"**Table {number}: {TABLES[number].title}**\n\n{psnr_table(number, all_runs)}" for number in numbers]
    cures = [[cure, *_psnr_cells(runs, "vanilla-nerf", numbers)] for cure, numbers in OTHER_CURES.items()]
    return fill_template(
        __file__,
        folder,
        num_runs=len(runs),
        **result["settings"],
        dead=sum(bool(run["dead_at_start"]) for run in all_runs),
        failure_rule=FAILURE_RULE,
        summary=_summarize(runs),
        num_real_runs=len(real_runs) or "",
        real_size=800 // REAL_DOWNSCALE if real_runs else "",
        real_summary=_summarize(real_runs) if real_runs else "",
        disagreements=_list_disagreements(claims, on_real),
        claims=markdown_table(
            ["claim", "whose", "verdict", "intervals", "real scenes", "intervals"],
            [_claim_row(entry, on_real.get(entry.claim.text)) for entry in claims],
        ),
        other_cures=markdown_table(["Random with", "NeRF, all views, centred", "off centre"], cures),
        margin=MIN_DIFFERENCE,
        comparisons="\n\n".join(map(_describe_claim, claims)),
        real_comparisons="\n\n".join(map(_describe_claim, real_claims)),
        tables="\n\n".join(tables),
        notes=read_notes(folder),
        reproduce=describe_command(result),
    )


def psnr_table(number: int, runs: list[Run]) -> str:
    """A row for each strategy, a column for each scene that has runs; mean and seconds of the synthetic ones."""
    synthetic, real = (
        select_runs([run for run in runs if (run["scene"] in REAL_SCENES) == is_real], number)
        for is_real in (False, True)
    )
    scenes, real_scenes = (
        [scene for scene in of if any(run["scene"] == scene for run in found)]
        for of, found in ((SCENES, synthetic), (REAL_SCENES, real))
    )
    reference = published(number) if number in PAPER_TABLES else {}
    columns = [*scenes, *(["mean", "CPU s"] if scenes else []), *real_scenes]
    rows = []
    for strategy, label in LABELS.items():
        found = [run for run in synthetic + real if run["strategy"] == strategy]
        cells = {
            scene: format_psnr([run for run in found if run["scene"] == scene], reference.get((strategy, scene)))
            for scene in [*scenes, *real_scenes]
        }
        if of_strategy := [run for run in found if run["scene"] in SCENES]:
            average = statistics.mean(reference[strategy, scene] for scene in scenes) if reference else None
            cells["mean"] = format_psnr(of_strategy, average)
            cells["CPU s"] = f"{statistics.median(run['cpu_seconds'] for run in of_strategy):.1f}"
        if found:
            rows.append([label, *(cells.get(column, "–") for column in columns)])
    return markdown_table(["", *columns], rows)


def select_runs(runs: list[Run], table: int) -> list[Run]:
    """A table's runs of the seeds that all its strategies have; all its runs, if there is no such seed.

    Seeds that only some have were added for a verdict's sake: means over them would compare different seeds.
    """
    runs = [run for run in runs if run["table"] == table]
    strategies = {run["strategy"] for run in runs}
    seeds = [{run["seed"] for run in runs if run["strategy"] == strategy} for strategy in strategies]
    return [run for run in runs if run["seed"] in set.intersection(*seeds)] or runs


def format_psnr(runs: list[Run], reference: float | None = None) -> str:
    """Mean PSNR, in which every scene counts alike whatever its number of runs; of a single scene the deviation of the
    seeds; failures; the paper's number."""
    if not runs:
        return "–"
    by_scene: dict[str, list[float]] = {}
    for run in runs:
        by_scene.setdefault(run["scene"], []).append(run["psnr"])
    text = f"{statistics.mean(map(statistics.mean, by_scene.values())):.2f}"
    if len(by_scene) == 1 < len(runs):
        text += f" ± {statistics.stdev(run['psnr'] for run in runs):.2f}"
    if failures := sum(map(failed, runs)):
        text += f" ✗{failures}/{len(runs)}"
    return text if reference is None else f"{text} <sub>{reference:.2f}</sub>"


def _summarize(runs: list[Run]) -> str:
    """Of the paper's tables: a strategy's mean PSNR and failures in each."""
    rows = [[label, *_psnr_cells(runs, strategy, PAPER_TABLES)] for strategy, label in LABELS.items()]
    return markdown_table(["", *(table.title for table in PAPER_TABLES.values())], rows)


def _list_disagreements(claims: list[ClaimVerdict], on_real: dict[str, ClaimVerdict]) -> str:
    """The claims of which real scenes say something else, a line each."""
    pairs = [(entry, on_real[entry.claim.text]) for entry in claims if entry.claim.text in on_real]
    return "\n".join(
        f"- {entry.claim.text}: {entry.verdict} on the synthetic scenes, {real.verdict} on the real ones"
        for entry, real in pairs
        if real.verdict != entry.verdict
    )


def _psnr_cells(runs: list[Run], strategy: str, tables: Iterable[int]) -> list[str]:
    """A strategy's mean PSNR and failures in each table."""
    return [format_psnr([run for run in select_runs(runs, n) if run["strategy"] == strategy]) for n in tables]


def _claim_row(entry: ClaimVerdict, on_real: ClaimVerdict | None) -> list[str]:
    return [entry.claim.text, entry.claim.source, *_verdict_cells(entry), *_verdict_cells(on_real)]


def _verdict_cells(entry: ClaimVerdict | None) -> list[str]:
    if entry is None:
        return ["–", "–"]
    known = [row.difference for row in entry.rows]
    above, below = sum((d.low or 0) > 0 for d in known), sum((d.high or 0) < 0 for d in known)
    return [f"**{entry.verdict}**", f"{above} above, {below} below, of {len(known)}"]


def _describe_claim(entry: ClaimVerdict) -> str:
    rows = [
        [
            row.comparison.label,
            format_difference(row.difference),
            str(row.failures),
            str(row.baseline_failures),
            f"{row.difference.runs} of {row.pairs}",
            decimals(row.difference.detectable),
            f"{row.difference.scenes_better} of {row.difference.scenes}",
            row.verdict,
        ]
        for row in entry.rows
    ]
    title = f"**{entry.claim.text}** ({entry.claim.source}; {entry.claim.kind}): {entry.verdict}"
    return f"{title}\n\n{markdown_table(COLUMNS, rows)}"
