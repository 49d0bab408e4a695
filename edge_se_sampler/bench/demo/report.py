"""README.md of the demos in a folder, one in a folder of its own for each seed."""

from __future__ import annotations

import json
from pathlib import Path

from edge_se_sampler.bench.demo.train import METHODS
from edge_se_sampler.bench.report import fill_template
from edge_se_sampler.bench.tables import describe_machine, markdown_table


def describe(folder: Path) -> str:
    """README.md of every demo.json below a folder."""
    paths = sorted(folder.glob("**/demo.json"))
    results = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    head = ["seed", *METHODS.values(), "background alone", *(f"training, {label}" for label in METHODS.values())]
    rows = [
        (
            str(result["settings"]["seed"]),
            *(f"{result['methods'][method]['results']['psnr']:.2f} dB" for method in METHODS),
            f"{result['background_psnr']:.2f} dB",
            *(f"{result['methods'][method]['training_seconds']:.0f} s" for method in METHODS),
            f"{result['total_seconds']:.0f} s",
        )
        for result in results
    ]
    pictures = [path.with_name("demo.png") for path in paths]
    return fill_template(
        __file__,
        folder,
        **results[0]["settings"],
        table=markdown_table([*head, "the whole demo"], rows),
        pictures="\n\n".join(
            f"![Ground truth, renderings, and validation PSNR]({path.relative_to(folder)})" for path in pictures
        ),
        commands="\n".join(f"- `{result['command']}`" for result in results),
        machine=describe_machine(results[0]["machine"]),
    )
