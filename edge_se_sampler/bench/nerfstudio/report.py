"""README.md of the trainings inside nerfstudio."""

from __future__ import annotations

import json
import statistics
from pathlib import Path

from edge_se_sampler.bench.outcomes import failed
from edge_se_sampler.bench.tables import describe_machine, markdown_table

LABELS = {"vanilla-nerf": "`vanilla-nerf`: nerfstudio's uniform pixels", "edge-se-nerf": "`edge-se-nerf`: Edge + SE"}


def describe(folder: Path) -> str:
    """README.md of the trainings in a folder."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    settings, shown = result["settings"], tables(folder)
    samples = f"{settings['samples']} + {settings['samples']} samples"
    costs = ""
    if "costs" in result:
        costs = f"""
## What a step costs

A training step of {result["costs"]["rays"]} rays after the early phase, its pixels chosen by squared error (SE) or \
uniformly by the same method, as ratios of SE to uniform. SE renders two further pixels for each that is trained on,
without gradients. `edge-nerf` and `precrop-nerf` draw uniformly after the early phase: their steps cost no more.

{shown["costs"]}
"""
    return f"""# Inside nerfstudio

How often does a training die inside nerfstudio {settings["nerfstudio"]}, with its own pixel sampler and with Edge + SE
(edge strength for the first tenth of the iterations, then the rank of squared errors)? Both train nerfstudio's vanilla
NeRF and differ in the data manager alone. Its softplus density always has a gradient, so that it dies later than a NeRF
with ReLU. The scene is the synthetic `{settings["scene"]}`, 64 x 64 pixels, off centre, trained for
{settings["iterations"]} iterations of {settings["rays"]} rays with {samples}. Such short runs show how training
starts, not where a long one ends; and both train equally many iterations, not equally long.

*Collapsed*: on the test views the training has more than 90% of the error on the object that the background alone has;
*failed*: collapsed, or less than 0.5 dB better than the background alone.

{shown["failures"]}
{costs}
## Reproduce

`{result["command"]}`, in an environment that has nerfstudio. Measured on
{describe_machine(result["machine"])}.
"""


def tables(folder: Path) -> dict[str, str]:
    """`failures` of each method; `costs` of steps by squared error against uniform ones, once they are measured."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    rows = []
    for method, label in LABELS.items():
        runs = [run for run in result["runs"] if run["method"] == method]
        if runs:
            collapsed = sum(run["outcome"] == "collapsed" for run in runs)
            psnr = statistics.mean(run["psnr"] for run in runs)
            rows.append((label, f"{sum(map(failed, runs))} of {len(runs)}", str(collapsed), f"{psnr:.2f} dB"))
    shown = {"failures": markdown_table(("", "failed", "of them collapsed", "mean PSNR"), rows)}
    if "costs" in result:
        medians = result["costs"]["medians"]
        ratios = []
        for method in sorted({case.split()[0] for case in medians}):
            se, uniform = medians[f"{method} se"], medians[f"{method} uniform"]
            ratios.append((f"`{method}`", *(f"{se[key] / uniform[key]:.2f}" for key in ("seconds", "bytes"))))
        shown["costs"] = markdown_table(("", "time per step", "peak memory"), ratios)
    return shown


def draw(folder: Path, workplace: Path | None) -> None:
    """There are no pictures."""
