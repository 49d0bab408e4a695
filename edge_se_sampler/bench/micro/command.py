"""edge-se bench samplers, scoring and step: what sampling and training steps cost. Torch-free until one runs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from edge_se_sampler.errors import InputError


@dataclass(frozen=True, kw_only=True)
class MicroBenchmark(ABC):
    """Measures, writes OUTPUT_DIR/NAME.json, and OUTPUT_DIR/README.md of all benchmarks whose json lies there."""

    name: ClassVar[str]
    """As in `edge-se bench NAME`."""

    output_dir: Path
    """Where the json and README.md go; a json of an earlier call is replaced."""

    def run(self) -> None:
        """Measure and report.

        Raises:
            InputError: a flag's value has no meaning, or a file cannot be written.
        """
        from edge_se_sampler.bench.micro.report import SECTIONS
        from edge_se_sampler.bench.report import write_report
        from edge_se_sampler.bench.runner import new_result
        from edge_se_sampler.engine.files import make_folder, write_json

        settings = {key: value for key, value in asdict(self).items() if not isinstance(value, Path)}
        for key, value in settings.items():
            if isinstance(value, int) and value < 1:
                raise InputError(f"--{key} is {value}: must be at least 1")
        make_folder(self.output_dir, "--output-dir")
        result = {**new_result("micro", settings), "benchmark": self.name, **self.measure()}
        write_json(self.output_dir / f"{self.file_name}.json", result)
        write_report(self.output_dir)
        print(SECTIONS[self.name](result))

    @property
    def file_name(self) -> str:
        """Of the json, without its suffix."""
        return self.name

    @abstractmethod
    def measure(self) -> dict[str, Any]:
        """What was measured."""


@dataclass(frozen=True, kw_only=True)
class BenchSamplers(MicroBenchmark):
    """Time building probability tables, drawing and selecting pixels; compare training memory of SE with Random's."""

    name: ClassVar[str] = "samplers"
    images: int = 100
    """Images in the tables."""
    size: int = 800
    """Rows and columns of an image."""
    draws: int = 4096
    """Pixels per draw."""
    rounds: int = 200
    """Timed draws of each kind; medians are reported."""

    def measure(self) -> dict[str, Any]:
        from edge_se_sampler.bench.micro.samplers import measure_samplers

        return measure_samplers(self.images, self.size, self.draws, self.rounds)


@dataclass(frozen=True, kw_only=True)
class BenchScoring(MicroBenchmark):
    """Time and memory of a training step whose squared errors come from the fine network, the coarse one or the cache,
    against Random's; and how well the cheap ones rank pixels."""

    name: ClassVar[str] = "scoring"
    workplace: Path = Path("bench")
    """Where the scene is kept."""
    scene: str = "bricks"
    """One of edge-se scenes."""
    size: Literal["paper", "small", "tiny"] = "small"
    """Of the networks."""
    rays: int = 1024
    """Per step."""
    rounds: int = 15
    """Timed steps of each; medians are reported."""
    iterations: int = 300
    """Of training before rankings are compared."""

    @property
    def file_name(self) -> str:
        return f"scoring-{self.size}"

    def measure(self) -> dict[str, Any]:
        from edge_se_sampler.bench.micro.scoring import measure_scoring
        from edge_se_sampler.bench.scenes import cached_scene

        scene = cached_scene(self.workplace, self.scene)
        return measure_scoring(scene, self.size, self.rays, self.rounds, self.iterations)


@dataclass(frozen=True, kw_only=True)
class BenchStep(MicroBenchmark):
    """Time the dense faithful step (1024 rays, two networks of 8 x 256, 64 + 128 samples) against nerf-pytorch's, in
    turns. Leave the machine alone meanwhile."""

    name: ClassVar[str] = "step"
    checkout: Path
    """A git checkout of github.com/yenchenlin/nerf-pytorch."""
    workplace: Path = Path("bench")
    """Where the scene is kept."""
    rounds: int = 8
    """Timed steps of each; medians are reported."""

    def measure(self) -> dict[str, Any]:
        from edge_se_sampler.bench.micro.step import measure_step
        from edge_se_sampler.bench.scenes import cached_scene

        return measure_step(self.checkout, cached_scene(self.workplace, "bricks"), self.rounds)
