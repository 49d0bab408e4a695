"""edge-se bench chart. Torch-free until it runs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from edge_se_sampler.bench.chart.variants import VARIANTS
from edge_se_sampler.bench.command import ExperimentCommand
from edge_se_sampler.bench.runner import Experiment, run_in_subprocess
from edge_se_sampler.errors import InputError, check_known, check_value

if TYPE_CHECKING:
    from edge_se_sampler.bench.chart.trials import ChartSettings


@dataclass(frozen=True, kw_only=True)
class ChartOptions:
    workplace: Path = Path("bench")
    """Where synthetic scenes, and copies of others, are kept."""
    data: Path | None = None
    """Folder with a folder a scene, all of one image size; left out, seven synthetic scenes of 100 x 100."""
    scenes: tuple[str, ...] = ("bricks",)
    """Of the seven, or of --data."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights, pixels and jitter."""
    seconds: float = 60
    """Of training, and of the plan, of each."""
    threads: int = 1
    """Of a training. One: timed in CPU seconds; more: in wall-clock time, so leave the machine alone."""

    def settings(self) -> ChartSettings:
        """InputError if a value has no meaning, or the scenes' images differ in size."""
        from edge_se_sampler.bench.chart.trials import ChartSettings
        from edge_se_sampler.data.synthetic.catalogue import ANALOG_OF

        if not (self.seeds and self.scenes):
            raise InputError("--seeds and --scenes: give at least one of each")
        check_value("seconds", self.seconds, 1 <= self.seconds < math.inf, "at least 1")
        check_value("threads", self.threads, self.threads >= 1, "at least 1")
        if self.data is None:
            check_known("scenes", self.scenes, ANALOG_OF)
            return ChartSettings(self.seconds, self.threads)
        sizes = {scene: self.image_size(scene) for scene in self.scenes}
        if len(set(sizes.values())) > 1:
            listed = ", ".join(f"{scene} {size}" for scene, size in sizes.items())
            raise InputError(f"--data {self.data}: scenes of different sizes ({listed} pixels): chart them separately")
        return ChartSettings(self.seconds, self.threads, sizes[self.scenes[0]], self.data.resolve().name)

    def image_size(self, scene: str) -> int:
        """The longer side of a scene's first image, pixels."""
        from edge_se_sampler.data.dataset import read_split

        views = read_split(self.scene_folder(scene), "train")
        assert views is not None
        return max(views.images[0].shape[:2])

    def scene_folder(self, scene: str) -> Path:
        from edge_se_sampler.bench.train import cached_scene

        return cached_scene(self.workplace, scene) if self.data is None else self.data / scene


@dataclass(frozen=True, kw_only=True)
class BenchChart(ChartOptions, ExperimentCommand):
    """Chart test PSNR against training seconds: methods, lean-nerf with one thing changed at a time, and the baselines
    in the folder. Goes on where it was stopped.

    Every training has a process of its own, because its memory is measured: start dask workers with --no-nanny."""

    variants: tuple[str, ...] = ()
    """Which; none: all. --dry-run lists their names."""

    def experiment(self) -> Experiment:
        from edge_se_sampler.bench.baselines.run import read_baselines
        from edge_se_sampler.bench.chart.trials import Trial, train_and_evaluate

        check_known("variants", self.variants, VARIANTS)
        settings = self.settings()
        # refuses, before anything is trained, those that cannot be compared
        read_baselines(self.output_dir, threads=settings.threads, image_size=settings.image_size, data=settings.data)
        # seed by seed and scene by scene, so that what is compared is trained side by side
        keys = product(self.seeds, self.scenes, self.variants or VARIANTS)
        trials = [Trial(variant, scene, seed) for seed, scene, variant in keys]
        train = partial(run_in_subprocess, train_and_evaluate)  # a process has a single peak of memory
        return Experiment(
            "chart", settings, lambda _: trials, train, lambda trial: (settings, self.scene_folder(trial.scene))
        )

    def default_workers(self) -> int:
        return max(1, super().default_workers() // self.threads)
