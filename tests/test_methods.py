"""Methods: ours, and those that other packages register."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from edge_se_sampler.methods import registered_methods
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig


def test_the_six_strategies_of_the_paper_and_two_on_its_other_method():
    samplers = {
        name: method.specification.config.pipeline.datamanager.pixel_sampler
        for name, method in registered_methods().items()
        if method.origin == "edge_se_sampler" and name != "lean-nerf"
    }
    table = {
        "vanilla-nerf": ("uniform", "uniform"),
        "precrop-nerf": ("precrop", "uniform"),
        "se-nerf": ("uniform", "se"),
        "precrop-se-nerf": ("precrop", "se"),
        "edge-nerf": ("edge", "uniform"),
        "edge-se-nerf": ("edge", "se"),
        "info-nerf": ("uniform", "uniform"),
        "edge-se-info-nerf": ("edge", "se"),
    }
    assert {name: (getattr(s, "early", ""), getattr(s, "late", "")) for name, s in samplers.items()} == table
    for sampler in samplers.values():  # faithful to the paper, for ever
        assert isinstance(sampler, EdgeSEPixelSamplerConfig)
        assert (sampler.schedule, sampler.early_fraction, sampler.precrop_fraction) == ("fraction", 0.1, 0.5)
        assert (sampler.images_per_step, sampler.se_candidates, sampler.importance_weight) == ("one", 2, 0.0)
        assert (sampler.edge_filter, sampler.edge_source) == ("sobel", "color")


MODULE = """
from dataclasses import replace
from edge_se_sampler.methods import registered_methods  # noqa: F401  (a plugin may look at ours)
from edge_se_sampler.engine.config import MethodSpecification, TrainerConfig
tiny = MethodSpecification(TrainerConfig(method_name="third-party"), "made by somebody else")
taken = MethodSpecification(TrainerConfig(method_name="vanilla-nerf"), "an impostor")
nothing = 3
"""
PYPROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "third-party-method"
version = "1.0"
[project.entry-points."edge_se_sampler.method_configs"]
third-party = "third_party:tiny"
taken = "third_party:taken"
no-specification = "third_party:nothing"
broken = "third_party_missing:x"
[tool.hatch.build.targets.wheel]
only-include = ["third_party.py"]
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real package with entry points, installed into a folder of its own."""
    source = tmp_path_factory.mktemp("package")
    (source / "third_party.py").write_text(MODULE)
    (source / "pyproject.toml").write_text(PYPROJECT)
    target = tmp_path_factory.mktemp("site")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(target), str(source)]
    subprocess.run(install, check=True, capture_output=True)
    return target


@pytest.mark.slow
def test_a_third_party_method_joins_and_a_broken_one_harms_nobody(site: Path, scene: Path, tmp_path: Path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), *sys.path])}

    def edge_se(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "edge_se_sampler", *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True)

    listed = edge_se("methods")
    assert "third-party          made by somebody else  [third-party-method]" in listed.stdout
    assert listed.stdout.count("vanilla-nerf") == 1
    assert sorted(line.split("'")[1] for line in listed.stderr.splitlines()) == ["broken", "no-specification", "taken"]
    edge_se(
        "train", "third-party", "--data", str(scene), "--output-dir", str(tmp_path / "o"), "--max-num-iterations", "1"
    )
    assert len(list(tmp_path.glob("o/scene/third-party/*/checkpoints/*.ckpt"))) == 1
