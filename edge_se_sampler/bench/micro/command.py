"""edge-se bench samplers and scoring: what sampling costs. Torch-free until one runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import ClassVar, Literal

from edge_se_sampler.bench.report import write_report
from edge_se_sampler.bench.results import new_result
from edge_se_sampler.engine.files import checksum, make_folder, write_json
from edge_se_sampler.errors import check_value


@dataclass(frozen=True, kw_only=True)
class MicroBenchmark:
    """Measures, writes a json into OUTPUT_DIR, and OUTPUT_DIR/README.md of all benchmarks whose json lies there."""

    name: ClassVar[str]
    """As in `edge-se bench NAME`; `measure` of the module of that name takes all other flags."""
    file_name: ClassVar[str]

    output_dir: Path
    """Where the json and README.md go; a json of an earlier call is replaced."""

    def run(self) -> None:
        """Measure and report; InputError if a flag's value has no meaning, or a file cannot be written."""

        flags = {key: value for key, value in asdict(self).items() if key != "output_dir"}
        settings = {key: value for key, value in flags.items() if not isinstance(value, Path)}
        for key, value in settings.items():
            check_value(key, value, not isinstance(value, int) or value >= 1, "at least 1")
        make_folder(self.output_dir, "--output-dir")
        head = new_result("micro", settings)
        measured = import_module(f"edge_se_sampler.bench.micro.{self.name}").measure(**flags)
        result = {**head, "benchmark": self.name, **measured}
        write_json(self.output_dir / self.file_name.format(**settings), result | {"checksum": checksum(result)})
        write_report(self.output_dir)
        print((self.output_dir / "README.md").read_text(encoding="utf-8"))


@dataclass(frozen=True, kw_only=True)
class BenchSamplers(MicroBenchmark):
    """Time building probability tables, drawing and selecting pixels."""

    name: ClassVar[str] = "samplers"
    file_name: ClassVar[str] = "samplers.json"
    images: int = 100
    """Images in the tables."""
    size: int = 800
    """Rows and columns of an image."""
    draws: int = 4096
    """Pixels per draw."""
    rounds: int = 200
    """Timed draws of each kind; medians are reported."""


@dataclass(frozen=True, kw_only=True)
class BenchScoring(MicroBenchmark):
    """Time and memory of a training step whose squared errors come from the fine network, the coarse one or the cache,
    against Random's; and how well the cheap ones rank pixels."""

    name: ClassVar[str] = "scoring"
    file_name: ClassVar[str] = "scoring-{size}.json"
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
