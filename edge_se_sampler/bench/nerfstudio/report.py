"""README.md of the trainings inside nerfstudio."""

from __future__ import annotations

import statistics
from pathlib import Path

from edge_se_sampler.bench.nerfstudio.train import METHODS
from edge_se_sampler.bench.outcomes import FAILURE_RULE, failed
from edge_se_sampler.bench.report import describe_command, fill_template, markdown_table
from edge_se_sampler.bench.results import read_result


def describe(folder: Path) -> str:
    """README.md of the trainings in a folder."""
    result, rows = read_result(folder / "result.json"), []
    for method, label in METHODS.items():
        of_method = [run for run in result["runs"] if run["method"] == method]
        if of_method:
            collapsed = sum(run["outcome"] == "collapsed" for run in of_method)
            failures = f"{sum(map(failed, of_method))} of {len(of_method)}"
            psnr = statistics.mean(run["psnr"] for run in of_method)
            rows.append((f"`{method}`: {label}", failures, str(collapsed), f"{psnr:.2f} dB"))
    return fill_template(
        __file__,
        folder,
        **result["settings"],
        failure_rule=FAILURE_RULE,
        failures=markdown_table(("", "failed", "of them collapsed", "mean PSNR"), rows),
        reproduce=describe_command(result),
    )
