"""The measuring commands, edge-se bench NAME. Torch-free until one runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from edge_se_sampler.bench.baselines.command import BenchBaselines
from edge_se_sampler.bench.chart.command import BenchChart
from edge_se_sampler.bench.micro.command import BenchSamplers, BenchScoring
from edge_se_sampler.bench.nerfstudio.command import BenchNerfstudio
from edge_se_sampler.bench.paper.command import BenchPaper
from edge_se_sampler.bench.processes.command import BenchProcesses
from edge_se_sampler.bench.real.command import BenchReal
from edge_se_sampler.bench.report import write_report
from edge_se_sampler.bench.schedule.command import BenchSchedule
from edge_se_sampler.bench.stability.command import BenchStability
from edge_se_sampler.bench.strategies.command import BenchStrategies


@dataclass(frozen=True)
class BenchReport:
    """Write the README.md and pictures of an experiment's folder again; trains nothing."""

    folder: tyro.conf.Positional[Path]
    """Folder with the result of another bench command."""
    readme: Path | None = None
    """A text whose tables between `<!-- table: NAME -->` and `<!-- end -->` are filled in too."""
    workplace: Path = Path("bench")
    """Where the experiment left renderings; pictures of them are drawn again only if they are there."""

    def run(self) -> None:
        write_report(self.folder, self.readme, self.workplace)
        print(f"wrote {self.folder / 'README.md'}")


BENCHES: dict[str, type] = {
    "samplers": BenchSamplers,
    "scoring": BenchScoring,
    "processes": BenchProcesses,
    "nerfstudio": BenchNerfstudio,
    "paper": BenchPaper,
    "stability": BenchStability,
    "schedule": BenchSchedule,
    "chart": BenchChart,
    "real": BenchReal,
    "strategies": BenchStrategies,
    "baselines": BenchBaselines,
    "report": BenchReport,
}
