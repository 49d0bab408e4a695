"""What a checkpoint may hold. Its checksum says that nobody changed it by accident; whoever made it knows that, too.

Checked are a file's archive before anything is unpacked, its tensors before any is copied, and what a training
continues from before a kernel, which knows no bounds, sees it.
"""

from __future__ import annotations

import os
import pickletools
import zipfile
from collections.abc import Callable, Mapping
from typing import IO, Any

import torch
from torch import Tensor

from edge_se_sampler.engine.plan import NUM_SEGMENTS, Plan
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.config import ModelConfig, NeRFModelConfig
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling.saved_sampler import MAX_STEP, is_alike, is_finite, is_sampler_state

GLOBALS = {"collections OrderedDict", "torch._utils _rebuild_tensor_v2"} | {
    f"torch {kind}Storage" for kind in ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Byte", "Bool")
}
"""Names that torch's pickles of tensors, numbers, texts, lists and dicts have."""
PARTS = {
    *("step", "elapsed", "config_digest", "model", "plan"),
    *("optimizer", "scheduler", "dead_network_reset", "sampler"),
}
ADDED_PARTS = {"early_stopping", "data_digest", "setup_seconds"}
"""Which those of earlier versions lack."""
GROUP = {"params", "lr", "betas", "eps", "weight_decay", "amsgrad", "initial_lr", "maximum", "total_variation"}
"""What Adam's groups have in every version of torch, and ours."""


def check_archive(file: IO[bytes]) -> None:
    """ValueError, or one of zipfile's, for what is not torch's archive of plain tensors, or is larger once unpacked."""
    size = file.seek(0, os.SEEK_END)
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in entries)
        if not stored or sum(entry.file_size for entry in entries) > size:
            raise ValueError("it is larger once unpacked")
        for entry in entries:
            if entry.filename.endswith(".pkl"):
                _check_pickle(archive.read(entry))


def _check_pickle(data: bytes) -> None:
    for code, argument, _ in pickletools.genops(data):
        if code.name in ("STACK_GLOBAL", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4") or (
            code.name == "GLOBAL" and argument not in GLOBALS
        ):
            raise ValueError(f"{code.name} {argument}")


def check_tensors(state: Any) -> None:
    """ValueError for a tensor that is not plain, has more elements than numbers, or a number that is not finite."""
    pending, seen = [state], set()
    while pending:  # not recursive: a pickle may be nested as deeply as it is long
        value = pending.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, dict):
            pending += value.values()
        elif isinstance(value, (list, tuple)):
            pending += value
        elif isinstance(value, Tensor):
            _check_tensor(value)


def _check_tensor(value: Tensor) -> None:
    if value.layout != torch.strided or value.device.type != "cpu":
        raise ValueError("a tensor of another layout")
    if value.numel() * value.element_size() > value.untyped_storage().nbytes():
        raise ValueError("a tensor that repeats its numbers")
    if value.is_floating_point() and value.numel() and not torch.stack(torch.aminmax(value)).isfinite().all():
        raise ValueError("a number that is not finite")


def check_parts(state: dict[str, Any], config: ModelConfig) -> None:
    """InputError if a checkpoint has other parts than a training saves, or fewer weights than the config's model has:
    memory is asked for none that are not there."""
    weights: Any = state.get("model")
    valid = (
        PARTS <= set(state) <= PARTS | ADDED_PARTS
        and isinstance(weights, dict)
        and all(isinstance(key, str) and isinstance(value, Tensor) for key, value in weights.items())
        and all(isinstance(state[name], dict) for name in ("plan", "scheduler", "sampler"))
        and isinstance(state.get("data_digest", ""), str)
        and type(state["step"]) is int
        and 0 <= state["step"] < MAX_STEP
        and is_finite(state["elapsed"])
        and is_finite(state.get("setup_seconds", 0.0))
    )
    if valid and isinstance(config, NeRFModelConfig):
        depth, width = config.preset.depth, config.preset.width
        valid = depth <= len(weights) and (depth - 1) * width**2 <= sum(value.numel() for value in weights.values())
    if not valid:
        raise _other_training()


def check_training(state: Mapping[str, Any], trainer: Any) -> None:
    """InputError if a trainer cannot continue from a checkpoint's state; its weights are the trainer's model's."""
    _require(_is_training, state, trainer)


def load_plan(plan: Plan, state: Mapping[str, Any]) -> None:
    """Let a plan continue from a checkpoint's; InputError if it cannot."""
    _require(_is_plan, state, plan)
    plan.load_state_dict(dict(state))


def load_sampler(manager: Any, state: Mapping[str, Any]) -> None:
    """Let a data manager's sampler continue from a checkpoint's state; InputError if it cannot."""
    sampler = manager.train_pixel_sampler
    if state and isinstance(sampler, ImportantPixels):
        images = {number: tuple(image.shape[:2]) for number, image in enumerate(manager.image_batch["image"])}
        _require(is_sampler_state, state, sampler, images)
    manager.load_state_dict(state)


def _require(is_valid: Callable[..., bool], *arguments: Any) -> None:
    try:
        valid = is_valid(*arguments)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError):
        valid = False  # of a kind that was not expected there
    if not valid:
        raise _other_training()


def _is_training(state: Mapping[str, Any], trainer: Any) -> bool:
    optimizer, scheduler, reset = (state[key] for key in ("optimizer", "scheduler", "dead_network_reset"))
    own = trainer.scheduler.state_dict()
    own_reset = None if trainer.dead_network_reset is None else trainer.dead_network_reset.state_dict()
    stopping = state.get("early_stopping")
    return (
        _is_plan(state["plan"], trainer.plan)
        and is_alike({key: scheduler.get(key, own[key]) for key in own}, own)
        and scheduler["last_epoch"] == state["step"] + 1
        and is_alike(reset, own_reset)
        and (stopping is None or _is_early_stopping(stopping, trainer.early_stopping.state_dict()))
        and (optimizer is None or _is_optimizer(optimizer, trainer.optimizer))
    )


def _is_plan(state: Mapping[str, Any], plan: Plan) -> bool:
    segments = state["segments"]
    return (
        is_alike(state, plan.state_dict() | {"segments": [0] * len(segments)})
        and len(segments) <= NUM_SEGMENTS
        and all(0 <= length < MAX_STEP for length in segments)
    )


def _is_early_stopping(state: Any, own: dict[str, Any]) -> bool:
    best = state["best"]  # -inf before the first
    return isinstance(best, float) and best == best and is_alike(state | {"best": 0.0}, own | {"best": 0.0})


def _other_training() -> InputError:
    return InputError("the checkpoint is not of a training by this run's config.json; begin a new training")


def _is_optimizer(state: Any, optimizer: torch.optim.Optimizer) -> bool:
    own = optimizer.state_dict()
    if not (
        isinstance(state, dict)
        and state.keys() == own.keys()
        and len(state["param_groups"]) == len(own["param_groups"])
    ):
        return False
    for group, own_group in zip(state["param_groups"], own["param_groups"], strict=True):
        same = group.keys() & own_group.keys() - {"lr", "fused"}
        if not all(group[key] == own_group[key] for key in same):
            return False
        if not (group.keys() >= GROUP and is_finite(group["lr"]) and group["lr"] >= 0):
            return False
        switches = (group[key] for key in group.keys() - same - {"lr"})  # where torch's versions differ
        if not all(value is None or isinstance(value, bool) for value in switches):
            return False
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    return isinstance(state["state"], dict) and all(
        number in range(len(weights)) and _are_moments(moments, weights[number])
        for number, moments in state["state"].items()
    )


def _are_moments(moments: Any, weight: Tensor) -> bool:
    """Whether Adam's running means are those of a weight."""
    if not isinstance(moments, dict) or set(moments) != {"step", "exp_avg", "exp_avg_sq"}:
        return False
    mean, square = moments["exp_avg"], moments["exp_avg_sq"]
    shapes = weight.shape, weight[..., :1].shape  # of sparse gradients one for a row
    steps = moments["step"]
    return (
        all(isinstance(value, Tensor) and value.is_floating_point() for value in (mean, square, steps))
        and mean.shape == weight.shape
        and square.shape in shapes
        and mean.is_contiguous()
        and square.is_contiguous()  # torch's fused Adam takes that for granted
        and steps.shape == ()
        and 0 <= float(steps) < MAX_STEP
    )
