"""The measuring commands, edge-se bench NAME. Torch-free until one runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from edge_se_sampler.bench.baselines.command import BenchBaselines
from edge_se_sampler.bench.chart.command import BenchChart
from edge_se_sampler.bench.micro.command import BenchSamplers, BenchScoring, BenchStep
from edge_se_sampler.bench.paper.command import BenchPaper
from edge_se_sampler.bench.schedule.command import BenchSchedule
from edge_se_sampler.bench.stability.command import BenchStability
from edge_se_sampler.errors import InputError


@dataclass(frozen=True)
class BenchNerfstudio:
    """Count failures inside nerfstudio, with its own sampler and with ours; leave result.json. Resumes."""

    output_dir: Path
    """Where the result goes; runs that it already has are kept."""
    workplace: Path = Path("bench")
    """Where the scene and nerfstudio's runs are kept."""
    scene: str = "chair"
    """One of edge-se scenes."""
    seeds: tuple[int, ...] = tuple(range(10))
    """Of weights, pixels and jitter."""
    iterations: int = 1500
    """Of every run."""
    rays: int = 32
    """Pixels a step."""
    samples: int = 16
    """Coarse samples a ray, and as many importance samples."""

    def run(self) -> None:
        from edge_se_sampler.bench.nerfstudio import bench_nerfstudio

        if not self.seeds or min(self.iterations, self.rays, self.samples) < 1:
            raise InputError("--seeds, --iterations, --rays and --samples: at least one of each")
        result = bench_nerfstudio(
            self.output_dir, self.workplace, self.scene, self.seeds, self.iterations, self.rays, self.samples
        )
        for method, told in result["failures"].items():
            print(
                f"{method}: {told['failed']} of {told['runs']} failed, {told['at_background']} at the background; "
                f"{told['mean_psnr']:.2f} dB on average"
            )


@dataclass(frozen=True)
class BenchReport:
    """Write the README.md and pictures of an experiment's folder again; trains nothing."""

    folder: tyro.conf.Positional[Path]
    """Folder with the result of another bench command."""
    readme: Path | None = None
    """A text whose tables between `<!-- table: NAME -->` and `<!-- end -->` are filled in too."""
    workplace: Path = Path("bench")
    """Where the experiment left renderings; pictures made of them are drawn again only if they are there."""

    def run(self) -> None:
        from edge_se_sampler.bench.report import write_report

        write_report(self.folder, self.readme, self.workplace)
        print(f"wrote {self.folder / 'README.md'}")


BENCHES: dict[str, type] = {
    "samplers": BenchSamplers,
    "scoring": BenchScoring,
    "nerfstudio": BenchNerfstudio,
    "paper": BenchPaper,
    "stability": BenchStability,
    "schedule": BenchSchedule,
    "chart": BenchChart,
    "baselines": BenchBaselines,
    "step": BenchStep,
    "report": BenchReport,
}
