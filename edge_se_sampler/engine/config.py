"""What can be set of a training run. Torch-free."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from edge_se_sampler.data.config import VanillaDataManagerConfig
from edge_se_sampler.models.config import ModelConfig, NeRFModelConfig
from edge_se_sampler.protocol import InstantiateConfig


@dataclass(frozen=True)
class MachineConfig:
    """The machine, and the seed."""

    seed: int = 0
    """Of weights, pixels and jitter. The same seed gives every method the same initial weights."""
    device_type: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto takes a GPU if there is one."""


@dataclass(frozen=True)
class PipelineConfig:
    """Data manager and model."""

    datamanager: VanillaDataManagerConfig = field(default_factory=VanillaDataManagerConfig)
    model: ModelConfig = field(default_factory=NeRFModelConfig)


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam, its rate decaying exponentially (NeRF, section 5.3)."""

    lr: float | None = None
    """Initial learning rate; left out, the model's size decides (the paper: 5e-4)."""
    final_fraction: float = 0.1
    """Learning rate at the end of the planned iterations, as a share of the initial one."""
    eps: float = 1e-8
    """Adam's epsilon."""
    fused: bool = False
    """Take the step in one pass over the weights: faster, and rounded a little differently."""


@dataclass(frozen=True)
class TrainerConfig(InstantiateConfig):
    """One training run."""

    _target: ClassVar[type | str] = "edge_se_sampler.engine.trainer:Trainer"

    method_name: Annotated[str, tyro.conf.Suppress] = "edge-se-nerf"
    """Name of the method, part of the run folder's path."""
    data: Path | None = None
    """The Blender folder (transforms_train.json and so on) to train on."""
    num_views: int | None = None
    """Train on this many of the views, picked as InfoNeRF's code picks them; left out, on all."""
    views: tuple[int, ...] | None = None
    """Numbers of the views to train on, from 0; instead of --num-views."""
    output_dir: Path = Path("outputs")
    """Runs land in OUTPUT_DIR/EXPERIMENT/METHOD/TIMESTAMP."""
    experiment_name: str | None = None
    """Name of the experiment; left out, the data folder's name."""
    max_num_iterations: int | None = None
    """Planned iterations, which phases and learning rate follow; left out, the model's size decides."""
    max_seconds: float | None = None
    """Stop after this time, wherever the plan is."""
    steps_per_save: int = 1000
    """Iterations between checkpoints; one is saved at the end and on Ctrl-C too."""
    steps_per_eval_image: int | None = None
    """Iterations between previews of a validation view; left out, a tenth of the plan."""
    steps_per_log: int = 10
    """Iterations between lines of metrics.jsonl."""
    reinit_dead: bool = False
    """Give a dead network (density 0 everywhere, so no gradient) new initial weights, of the next sub-seed."""
    machine: MachineConfig = field(default_factory=MachineConfig)
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)


@dataclass(frozen=True)
class MethodSpecification:
    """A named method, as an entry point of the group edge_se_sampler.method_configs offers it."""

    config: TrainerConfig
    description: str
