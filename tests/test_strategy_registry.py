"""The strategies' README tells of all of them, and its example of another package's works as it stands there."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import edge_se_sampler
from edge_se_sampler.sampling.parts import Distribution, Selector
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES, strategy_names
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

README = (Path(edge_se_sampler.__file__).parent / "sampling" / "README.md").read_text(encoding="utf-8")

USE = """
import sys
import torch
from edge_se_sampler.cli import main
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig

sampler = EdgeSEPixelSampler(EdgeSEPixelSamplerConfig(early="dark", late="uniform"), num_rays_per_batch=1000)
sampler.bind(squared_error=lambda batch: None, progress=lambda step: step / 100, seed=0)
image = torch.zeros(1, 10, 10, 3, dtype=torch.uint8)
image[:, 5:] = 255
rows = sampler.sample({"image": image, "image_idx": torch.tensor([0])})["indices"][:, 1]
assert 0.9 < float((rows < 5).double().mean()) < 1  # 21 times as likely
main(["train", "edge-nerf", "--help"])
"""


def block(language: str) -> str:
    """The README's block of code in this language."""
    (found,) = re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)
    return found


def install(folder: Path, *entries: str, distribution: str = "dark") -> dict[str, str]:
    """The environment of a process that finds the README's class in a folder, and entry points of a package there."""
    (folder / "dark_pixels.py").write_text(block("python"))
    info = folder / f"{distribution}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[edge_se_sampler.pixel_strategies]\n" + "\n".join(entries) + "\n")
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path]), "COLUMNS": "110"}


def test_the_readmes_strategy_is_listed_and_draws(tmp_path: Path) -> None:
    title, entry = block("toml").strip().splitlines()
    assert title == '[project.entry-points."edge_se_sampler.pixel_strategies"]'
    environment = install(tmp_path, entry.replace('"', ""))
    run = subprocess.run([sys.executable, "-c", USE], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    choices = "".join(re.sub("[│\\s]", "", line) for line in run.stdout.splitlines())
    assert re.search(r"early\{[a-z,-]*dark", choices)
    assert run.stderr == ""


def test_names_that_are_taken_and_classes_that_cannot_be_imported(tmp_path: Path) -> None:
    environment = install(tmp_path, "edge = dark_pixels:DarkPixels", "lost = nowhere:Lost")
    code = USE.replace('"dark"', '"lost"')
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    first, *_, last = run.stderr.splitlines()
    assert first == "edge-se: pixel strategy 'edge' of dark left out: the name is taken"
    assert last.endswith("InputError: pixel strategy nowhere:Lost cannot be imported: No module named 'nowhere'")


@pytest.mark.slow
@pytest.mark.parametrize("target", ["dark_pixels : DarkPixels", "dark_pixels:Outer.DarkPixels"])
def test_entry_points_are_what_pythons_standard_says(target: str, tmp_path: Path) -> None:
    environment = install(tmp_path, f"dark = {target}")
    with (tmp_path / "dark_pixels.py").open("a") as file:
        file.write("\n\nclass Outer:\n    DarkPixels = DarkPixels\n")
    run = subprocess.run([sys.executable, "-c", USE], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_the_readme_tells_of_every_strategy_and_its_phases() -> None:
    rows = re.findall(r"^\| `([a-z-]+)` \| ([a-z, ]+) \|", README, flags=re.MULTILINE)
    assert dict(rows) == {name: ", ".join(strategy.phases) for name, strategy in PIXEL_STRATEGIES.items()}
    assert set(strategy_names("early")) | set(strategy_names("late")) == set(PIXEL_STRATEGIES)


@pytest.mark.parametrize("name", PIXEL_STRATEGIES)
def test_every_strategy_is_a_class_that_has_its_name(name: str) -> None:
    part = PIXEL_STRATEGIES[name].load()(EdgeSEPixelSamplerConfig())
    assert isinstance(part, Selector) or (isinstance(part, Distribution) and part.name == name)
