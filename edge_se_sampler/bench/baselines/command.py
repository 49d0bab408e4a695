"""edge-se bench baselines. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from edge_se_sampler.bench.chart.command import ChartOptions

ProgramName = Literal["nerf-pytorch", "tensorf", "nerfstudio-vanilla-nerf", "nerfstudio-nerfacto"]


@dataclass(frozen=True, kw_only=True)
class BenchBaselines(ChartOptions):
    """Train another program, unchanged, on the chart's scenes, timed and evaluated as ours are; leave a json in
    DIR/baselines, which bench chart and bench report show. Goes on where it was stopped."""

    program: ProgramName
    """Which. nerf-pytorch and tensorf need a --checkout, and what they import; nerfstudio's are in the environment."""
    output_dir: Path
    """The chart's folder DIR; runs that it already has are kept."""
    checkout: Path | None = None
    """A git checkout of the program."""
    flags: str = ""
    """The program's own, in one string, besides those that name the data."""
    label: str = ""
    """What distinguishes these flags from others, in pictures and tables."""

    def run(self) -> None:
        from edge_se_sampler.bench.baselines.results import BaselineSettings, path_of
        from edge_se_sampler.bench.baselines.run import run_baseline, version_of
        from edge_se_sampler.engine.files import check_output, make_folder

        settings = BaselineSettings(
            **vars(self.settings()), program=self.program, label=self.label, flags=self.flags,
            program_version=version_of(self.checkout),
        )  # fmt: skip
        path = path_of(settings, self.output_dir)
        make_folder(path.parent, "--output-dir")
        check_output(path, "--output-dir")
        scenes = {scene: self.scene_folder(scene).resolve() for scene in self.scenes}
        for run in run_baseline(settings, self.checkout, scenes, self.seeds, path):
            seconds, psnr = run["curve"][-1]
            print(f"{settings.name}, {run['scene']}, {run['seed']}: {psnr:.2f} dB after {seconds:.0f} s")
