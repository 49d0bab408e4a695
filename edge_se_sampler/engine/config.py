"""The settings of a training run. Torch-free."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import tyro

from edge_se_sampler.data.config import DataFormat, Masks, VanillaDataManagerConfig
from edge_se_sampler.data.scene_file import quote
from edge_se_sampler.errors import InputError, check_value
from edge_se_sampler.models.config import (
    INFINITY,
    MAX_RAYS,
    LeanModelConfig,
    ModelConfig,
    NeRFModelConfig,
    SizePreset,
)
from edge_se_sampler.protocol import ADDED_LATER, InstantiateConfig

MAX_INTEGER = 2**63
"""Integers of a config are less, and more than its negative: torch knows no others."""


@dataclass(frozen=True)
class MachineConfig:
    """The machine, and the seed."""

    seed: int = 0
    """Seed of weights, pixels and jitter. The same seed gives every method the same initial weights."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to train on; auto is cuda if torch finds such a GPU, else the CPU; mps is an Apple GPU."""


@dataclass(frozen=True)
class PipelineConfig:
    """Data manager and model."""

    datamanager: VanillaDataManagerConfig = field(default_factory=VanillaDataManagerConfig)
    model: ModelConfig = field(default_factory=NeRFModelConfig)


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam with an exponentially decaying learning rate (NeRF, section 5.3)."""

    lr: float | None = None
    """Initial learning rate; by default the model size's (the paper: 5e-4)."""
    final_fraction: float = 0.1
    """Learning rate at the end of the planned iterations, as a share of the initial one."""
    eps: float = 1e-8
    """Adam's epsilon."""
    beta2: float = 0.999
    """Adam's decay of the running mean of squared gradients."""
    warmup_steps: int = 0
    """Iterations over which the learning rate rises at first."""
    fused: bool = False
    """Use torch's fused implementation: faster, and rounded a little differently."""


@dataclass(frozen=True)
class TrainerConfig(InstantiateConfig):
    """One training run."""

    _target: ClassVar[type | str] = "edge_se_sampler.engine.trainer:Trainer"

    method_name: Annotated[str, tyro.conf.Suppress] = "edge-se-nerf"
    """Name of the method, part of the run folder's path."""
    data: Path | None = None
    """The folder to train on: images, and a file of their cameras."""
    data_format: DataFormat = "auto"
    """Format of the folder: NeRF's Blender scenes (transforms_train.json and so on), one transforms.json (nerfstudio,
    instant-ngp), COLMAP's sparse model, or LLFF's poses_bounds.npy; auto: the first of these that it has."""
    masks: Masks = "ignore"
    """What mask files mean. ignore: what is outside is unknown, and not trained on; object: it is background, as if
    the mask were the image's alpha."""
    eval_every: int | None = None
    """Hold out every EVAL_EVERY-th image in the order of names, where the data has no split; by default 8."""
    num_views: int | None = None
    """Train on this many of the views, selected as InfoNeRF's code does; by default on all."""
    views: tuple[int, ...] | None = None
    """Indices (from 0) of the views to train on, instead of --num-views."""
    downscale: int = 1
    """Average every DOWNSCALE x DOWNSCALE pixels of all images, held-out ones too, and train on these."""
    output_dir: Path = Path("outputs")
    """Runs are written to OUTPUT_DIR/EXPERIMENT/METHOD/TIMESTAMP."""
    experiment_name: str | None = None
    """Name of the experiment; by default the data folder's name."""
    max_num_iterations: int | None = None
    """Planned iterations, which determine phases and learning rate; by default those of --pipeline.model.size."""
    new_num_iterations: Annotated[int | None, tyro.conf.Suppress] = field(default=None, metadata=ADDED_LATER)
    """Planned iterations since `edge-se resume --max-num-iterations`, by which the early phase is no longer."""
    time_budget: str | None = None
    """Train for so long (60, 90s, 10m, 1h) in place of a number of iterations: phases and learning rate follow the
    clock (lean-nerf)."""
    segments: tuple[int, ...] | None = None
    """Iterations of each hundredth of the training; config.json has those of a run with a time budget, to repeat it."""
    max_seconds: float | None = None
    """Stop after so many seconds, even if iterations are left."""
    patience: int | None = field(default=None, metadata=ADDED_LATER)
    """Stop when the validation view's PSNR has not risen by MIN_GAIN for so many previews; by default never."""
    min_gain: float = field(default=0.1, metadata=ADDED_LATER)
    """dB by which the PSNR must rise above the best so far for --patience to begin anew."""
    steps_per_save: int = 1000
    """Iterations between checkpoints, of which the last two are kept; one is saved at the end and on Ctrl-C too."""
    steps_per_eval_image: int | None = None
    """Iterations between previews of a validation view; by default a tenth of the planned ones."""
    steps_per_log: int = 10
    """Iterations between lines of metrics.jsonl."""
    reinit_dead: bool = False
    """Reinitialize a dead network (density 0 everywhere, hence no gradient), each time with other random numbers of the
    seed. A softplus density cannot die."""
    machine: MachineConfig = field(default_factory=MachineConfig)
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)

    @property
    def preset(self) -> SizePreset:
        """The numbers of the model's size, which is not auto, with those set here in their place: none is left open."""
        rays = self.pipeline.datamanager.train_num_rays_per_batch
        given = {"learning_rate": self.optimizer.lr, "rays": rays, "iterations": self.max_num_iterations}
        return self.pipeline.model.preset.overridden_by(given)

    @property
    def budget_seconds(self) -> float | None:
        """The time budget; InputError if it is none."""
        if self.time_budget is None:
            return None
        match = re.fullmatch(r"(\d+(?:\.\d*)?) *([smh]?)", self.time_budget.strip())
        seconds = float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]] if match else 0.0
        check_value("time-budget", quote(self.time_budget), 0 < seconds < INFINITY, "seconds above 0, or 10m, or 1h")
        return seconds

    @property
    def preview_interval(self) -> int:
        """Steps between previews."""
        return max(1, self.preset.iterations // 10) if self.steps_per_eval_image is None else self.steps_per_eval_image

    def check(self) -> None:
        """Raise InputError if a value is out of its range or has no effect with the others; the size is decided."""
        manager, model, optimizer = self.pipeline.datamanager, self.pipeline.model, self.optimizer
        at_least_one = {
            "max-num-iterations": self.max_num_iterations,
            "new-num-iterations": self.new_num_iterations,
            "patience": self.patience,
            "downscale": self.downscale,
            "steps-per-save": self.steps_per_save,
            "steps-per-eval-image": self.steps_per_eval_image,
            "steps-per-log": self.steps_per_log,
            "pipeline.datamanager.train-num-rays-per-batch": manager.train_num_rays_per_batch,
        }
        _check_integers(self)
        for flag, value in at_least_one.items():
            check_value(flag, value, value is None or value >= 1, "at least 1")
        rays = self.preset.rays
        flag = "pipeline.datamanager.train-num-rays-per-batch"
        check_value(flag, rays, rays <= MAX_RAYS, f"at most {MAX_RAYS}")
        seconds = self.max_seconds
        check_value("max-seconds", seconds, seconds is None or 0 < seconds < INFINITY, "above 0, and finite")
        check_value("min-gain", self.min_gain, 0 <= self.min_gain < INFINITY, "at least 0, and finite")
        for name in (self.method_name, self.experiment_name):
            if name in ("", ".", "..") or "/" in str(name) or "\0" in str(name):
                raise InputError(f"{name!r} cannot name a folder: give --experiment-name a plain name")
        self.check_plan()
        lr, final = optimizer.lr, optimizer.final_fraction
        check_value("optimizer.lr", lr, lr is None or 0 < lr < INFINITY, "above 0")
        check_value("optimizer.final-fraction", final, 0 < final <= 1, "in (0, 1]")
        check_value("optimizer.eps", optimizer.eps, 0 <= optimizer.eps < INFINITY, "at least 0")
        check_value("optimizer.beta2", optimizer.beta2, 0 <= optimizer.beta2 < 1, "in [0, 1)")
        check_value("optimizer.warmup-steps", optimizer.warmup_steps, optimizer.warmup_steps >= 0, "at least 0")
        model.check("pipeline.model.")
        if manager.skip_empty_rays and not model.needs_grid:
            remedy = "add --pipeline.model.empty-space-skipping True"
            raise InputError(f"--pipeline.datamanager.skip-empty-rays has no effect here; {remedy}")
        if not isinstance(model, LeanModelConfig):
            return
        if self.reinit_dead:
            raise InputError("--reinit-dead: this model's density is never 0, it cannot die; leave the flag out")
        check_value("optimizer.eps", optimizer.eps, optimizer.eps > 0, f"above 0 for {self.method_name}")
        if getattr(manager.pixel_sampler, "error_source", "fine") == "coarse":
            flag = "--pipeline.datamanager.pixel-sampler.error-source"
            raise InputError(f"{flag} is coarse: this model has no coarse network")

    def check_plan(self) -> None:
        """Raise InputError if what is set of the run's length has no meaning."""
        given = self.budget_seconds is not None or self.segments is not None
        if given and not isinstance(self.pipeline.model, LeanModelConfig):
            raise InputError(f"--time-budget and --segments: {self.method_name} cannot follow them; use lean-nerf")
        if given and self.max_num_iterations is not None:
            raise InputError("--max-num-iterations and --time-budget or --segments: give one of them")
        valid = self.segments is None or (len(self.segments) == 100 and min(self.segments) >= 0 < sum(self.segments))
        check_value("segments", self.segments, valid, "100 numbers of iterations, not all of them 0")


def _check_integers(config: Any, prefix: str = "") -> None:
    """InputError for an integer that a run's config.json could not hold, which would be read as none."""
    for name in (setting.name for setting in fields(config)):
        value, flag = getattr(config, name), prefix + name.replace("_", "-")
        if is_dataclass(value):
            _check_integers(value, f"{flag}.")
        elif isinstance(value, int):
            check_value(flag, value, abs(value) < MAX_INTEGER, "an integer of at most 63 bits")


@dataclass(frozen=True)
class MethodSpecification:
    """A named method, as an entry point of the group edge_se_sampler.method_configs offers it."""

    config: TrainerConfig
    description: str


Config = TypeVar("Config")

SAMPLER = "pipeline.datamanager.pixel_sampler"
MANAGER = "pipeline.datamanager"
MODEL = "pipeline.model"


def override(config: Config, changes: Mapping[str, Any]) -> Config:
    """The config with the fields at dotted paths replaced, e.g. {"pipeline.model.width": 64}."""
    for path, value in changes.items():
        name, _, rest = path.partition(".")
        new = override(getattr(config, name), {rest: value}) if rest else value
        config = replace(config, **{name: new})  # pyright: ignore[reportArgumentType, reportCallIssue]
    return config
