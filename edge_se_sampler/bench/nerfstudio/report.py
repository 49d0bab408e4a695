"""README.md of the trainings inside nerfstudio."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.nerfstudio.train import METHODS
from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.report import fill_template
from edge_se_sampler.bench.runner import Run, read_result
from edge_se_sampler.bench.tables import describe_command, markdown_table


def describe(folder: Path) -> str:
    """README.md of the trainings in a folder, and of the costs of steps once they are measured."""
    result = read_result(folder / "result.json")
    parts = {"failures": _tabulate_failures(result["runs"]), "failure_rule": FAILURE_RULE}
    if "costs" in result:
        parts |= {"cost_rays": result["costs"]["rays"], "costs": _tabulate_costs(result["costs"]["medians"])}
    return fill_template(__file__, folder, **result["settings"], **parts, reproduce=describe_command(result))


def _tabulate_failures(runs: list[Run]) -> str:
    rows = []
    for method, label in METHODS.items():
        of_method = [run for run in runs if run["method"] == method]
        if of_method:
            collapsed = sum(run["outcome"] == "collapsed" for run in of_method)
            failures = f"{sum(map(failed, of_method))} of {len(of_method)}"
            psnr = statistics.mean(run["psnr"] for run in of_method)
            rows.append((f"`{method}`: {label}", failures, str(collapsed), f"{psnr:.2f} dB"))
    return markdown_table(("", "failed", "of them collapsed", "mean PSNR"), rows)


def _tabulate_costs(medians: dict[str, Any]) -> str:
    rows = []
    for method in sorted({case.split()[0] for case in medians}):
        se, uniform = medians[f"{method} se"], medians[f"{method} uniform"]
        rows.append((f"`{method}`", *(f"{se[key] / uniform[key]:.2f}" for key in ("seconds", "bytes"))))
    return markdown_table(("", "time per step", "peak memory"), rows)
