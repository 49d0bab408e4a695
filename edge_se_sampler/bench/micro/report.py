"""README.md of the small benchmarks: what sampling pixels, scoring them and a dense training step cost."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge_se_sampler.bench.tables import describe_machine, markdown_table
from edge_se_sampler.bench.timing import medians

INTRODUCTION = """# What sampling costs

Small benchmarks of single operations. *Random* draws pixels uniformly; *Edge* draws them in proportion to the strength
of the image's edges; *SE* draws two uniform candidates for every pixel of a batch and keeps half of them by the rank of
their squared error. Times are medians of steps that were timed in turns.
"""
SAMPLER_LABELS = {
    "edge_all_images": "Edge, of all images",
    "edge_one_image": "Edge, of one image",
    "uniform_all_images": "Random, of all images",
    "flat_searchsorted": "for comparison: torch.searchsorted in one CDF over all pixels",
    "se_selection": "SE's selection by rank, errors given",
    "nerfstudio_uniform": "for comparison: nerfstudio 1.1.5's uniform pixels",
}
ERROR_SOURCES = {
    "fine": "the fine network, as in the paper (`fine`)",
    "coarse": "the coarse network alone (`coarse`)",
    "cached": "errors that training found there earlier (`cached`)",
}


def describe(folder: Path) -> str:
    """README.md of the benchmarks whose json lies in a folder."""
    results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]
    sections = [SECTIONS[result["benchmark"]](result) for result in results if result.get("experiment") == "micro"]
    return "\n".join([INTRODUCTION, *sections])


def draw(folder: Path, workplace: Path | None) -> None:
    """There are no pictures."""


def tables(folder: Path) -> dict[str, str]:
    """No other text shows these tables."""
    return {}


def _describe_samplers(result: dict[str, Any]) -> str:
    settings, tables, memory = (result[key] for key in ("settings", "tables", "training_memory"))
    head = (f"{settings['draws']} pixels", f"median of {settings['rounds']} draws")
    rows = [(SAMPLER_LABELS[name], f"{value:.2f} ms") for name, value in result["milliseconds"].items()]
    pixels = settings["images"] * settings["size"] ** 2 / 1e6
    ratio = memory["se_bytes"] / memory["random_bytes"]
    return f"""## Drawing pixels

Building the tables that Edge draws from, edge filter included, takes {tables["build_seconds"]:.1f} s for
{settings["images"]} noise images of {settings["size"]} x {settings["size"]} pixels ({pixels:.0f} million in all). They
take {tables["bytes_per_pixel"]:.2f} bytes per pixel, and building them at most
{tables["peak_bytes_per_pixel_while_building"]:.1f}.

{markdown_table(head, rows)}

Training with SE peaks at {ratio:.3f} times the memory of training with Random (small networks, {memory["rays"]} pixels
per step, measured in fresh processes): candidates are scored without gradients.

{_origin(result)}"""


def _describe_scoring(result: dict[str, Any]) -> str:
    settings, times = result["settings"], result["milliseconds"]
    rows = [
        (
            label,
            f"{times[source] / times['random']:.2f} x",
            f"{result['memory_against_random'][source]:.2f} x",
            "1" if source == "fine" else f"{result['rank_correlation'][source]:.2f}",
        )
        for source, label in ERROR_SOURCES.items()
    ]
    table = markdown_table(("squared errors from", "time per step", "peak memory", "rank correlation"), rows)
    return f"""## Where squared errors come from: networks of size `{settings["size"]}`

SE's training step against Random's ({times["random"]:.0f} ms), {settings["rays"]} pixels per step, on the synthetic
scene `{settings["scene"]}`. The rank correlation (Spearman's, with the fine network's errors, after \
{settings["iterations"]} iterations) says how alike pixels are ranked: 1 is the same order, 0 is chance. The flag is
`--pipeline.datamanager.pixel-sampler.error-source`.

{table}

{_origin(result)}"""


def _describe_step(result: dict[str, Any]) -> str:
    seconds = medians(result["seconds"])
    ours, other = seconds["vanilla-nerf"], seconds["nerf-pytorch"]
    return f"""## The dense step against nerf-pytorch's

The original NeRF's training step (1024 rays, two networks of 8 x 256, 64 + 128 samples) takes {other:.1f} s in
[nerf-pytorch](https://github.com/yenchenlin/nerf-pytorch) (commit {result["nerf_pytorch_version"]}) and {ours:.1f} s \
in `vanilla-nerf` with networks of size `paper`: {ours / other:.2f} times as long. The programs take turns, a step each,
on all cores.

{_origin(result)}"""


def _origin(result: dict[str, Any]) -> str:
    return f"Reproduce with `{result['command']}`; measured on {describe_machine(result['machine'])}.\n"


SECTIONS: dict[str, Callable[[dict[str, Any]], str]] = {
    "samplers": _describe_samplers,
    "scoring": _describe_scoring,
    "step": _describe_step,
}
"""Benchmark -> the text about its result."""
