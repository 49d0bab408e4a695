"""edge-se bench baselines. Torch-free until it runs."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal

from edge_se_sampler.bench.chart.command import ChartOptions
from edge_se_sampler.bench.results import load_or_create, write_result
from edge_se_sampler.bench.runner import run_in_subprocess
from edge_se_sampler.engine.files import make_folder
from edge_se_sampler.errors import InputError, check_value

ProgramName = Literal["nerf-pytorch", "tensorf", "nerfstudio-vanilla-nerf", "nerfstudio-nerfacto"]


@dataclass(frozen=True, kw_only=True)
class BenchBaselines(ChartOptions):
    """Train another program, unchanged, on the scenes of the chart or of bench real, timed and evaluated as ours are;
    leave a json in DIR/baselines, which bench chart, bench real and bench report show. Goes on where it was stopped."""

    program: ProgramName
    """Which. nerf-pytorch and tensorf need a --checkout, and what they import; nerfstudio's are in the environment."""
    output_dir: Path
    """The folder DIR of bench chart or bench real; runs that it already has are kept."""
    downscale: int = 1
    """Every so many pixels of the images of --data, along both axes, become one. Programs read a copy in the workplace,
    as they do where --data is no Blender folder: of the images as we read them, undistorted and with our split."""
    eval_seconds: tuple[float, ...] = (2, 7, 20, 60)
    """Seconds of training after which test views are evaluated, beside the end; that takes some programs minutes."""
    checkout: Path | None = None
    """A git checkout of the program."""
    flags: str = ""
    """The program's own, in one string, besides those that name the data."""
    label: str = ""
    """What distinguishes these flags from others, in pictures and tables."""

    def run(self) -> None:
        """Train one after the other; what has ended is kept. InputError: the program is not there, refuses its flags or
        ends too soon, or the json is of other settings."""
        from edge_se_sampler.bench.baselines.run import BaselineSettings, train, version_of

        check_value("downscale", self.downscale, self.downscale == 1 or self.data is not None, "1 without --data")
        settings = BaselineSettings(
            **vars(self.settings()), program=self.program, label=self.label, flags=self.flags,
            program_version=version_of(self.checkout),
        )  # fmt: skip
        path = self.output_dir / "baselines" / f"{'-'.join(re.findall(r'[A-Za-z0-9.]+', settings.name))}.json"
        make_folder(path.parent, "--output-dir")
        result = load_or_create(path, "baselines", settings)
        for seed, scene in product(self.seeds, self.scenes):
            if any((run["scene"], run["seed"]) == (scene, seed) for run in result["runs"]):
                continue
            data = self.scene_folder(scene).resolve()
            try:
                run = run_in_subprocess(train, settings, self.checkout, data, seed, self.eval_seconds)
            except RuntimeError as problem:
                raise InputError(f"{settings.name} on {scene}, seed {seed}: {problem}") from None
            result["runs"].append({"scene": scene, "seed": seed, **run})
            write_result(path, result)
        for run in result["runs"]:
            seconds, psnr = run["curve"][-1]
            print(f"{settings.name}, {run['scene']}, {run['seed']}: {psnr:.2f} dB after {seconds:.0f} s")

    def scene_folder(self, scene: str) -> Path:
        from edge_se_sampler.bench.baselines.folders import copied_scene
        from edge_se_sampler.data.dataset import find_format

        folder = super().scene_folder(scene)
        if self.downscale == 1 and find_format(folder) == "blender":
            return folder
        return copied_scene(self.workplace, folder, self.downscale)
