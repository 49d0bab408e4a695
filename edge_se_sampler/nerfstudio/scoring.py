"""The squared errors of nerfstudio's models at drawn pixels, computed without changing the model's state."""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted; here its classes count as unknown

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.edges import WHITE
from edge_se_sampler.sampling.image_batch import unit_interval
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling.schedule import AdaptiveSchedule, Schedule

BLACK = (0.0, 0.0, 0.0)
DEAD_CHECK_STEPS = 1000
DEAD_ERROR_SHARE = 0.98
"""A model whose error is still above this share of an empty scene's after so many iterations is reported as dead."""


def ray_errors(model: Any, ray_bundle: Any, batch: dict[str, Tensor]) -> Tensor:
    """(n,) squared errors of the model's fine colors, compared as in its loss; raises as `squared_errors`."""
    with _preserved_state(model):
        return squared_errors(model, model(ray_bundle), batch["image"])


def squared_errors(model: Any, outputs: dict[str, Tensor], image: Tensor) -> Tensor:
    """(n,) squared errors of rendered rays against (n, 3|4) pixels, uint8 or in [0, 1]. InputError if the outputs have
    neither "rgb" nor "rgb_fine"."""
    level = "" if "rgb" in outputs else "_fine"
    if f"rgb{level}" not in outputs:
        name = type(model).__name__
        raise InputError(f"{name} renders neither rgb nor rgb_fine: its squared errors cannot be computed")
    colors = outputs[f"rgb{level}"]
    image = unit_interval(image.to(colors.device))
    accumulation = outputs.get(f"accumulation{level}")
    renderer: Any = getattr(model, "renderer_rgb", None)
    if accumulation is not None and hasattr(renderer, "blend_background_for_loss_computation"):
        colors, image = renderer.blend_background_for_loss_computation(
            pred_image=colors, pred_accumulation=accumulation, gt_image=image
        )
    return (colors.float() - image[:, :3]).square().sum(dim=1)


def observe_training_errors(model: nn.Module, sampler: ImportantPixels) -> None:
    """Give the sampler the squared errors of every training batch that the model renders, by a forward hook.

    Evaluation is not in training mode, and while candidates are scored the sampler has no pending batch.
    """

    def observe(module: nn.Module, _: Any, outputs: dict[str, Tensor]) -> None:
        pending = sampler.pending_batch
        if not module.training or pending is None:
            return
        image = pending.values["image"]
        with torch.no_grad():
            errors = squared_errors(module, outputs, image)
        if len(errors) == len(image):
            sampler.observe(errors)
            _warn_if_dead(sampler.schedule)

    model.register_forward_hook(observe)


def _warn_if_dead(schedule: Schedule) -> None:
    """Say once that the model has learnt nothing, which no sampler can mend."""
    if not isinstance(schedule, AdaptiveSchedule) or schedule.observations != DEAD_CHECK_STEPS:
        return
    if schedule.remaining > DEAD_ERROR_SHARE:
        print(
            f"edge-se-sampler: after {DEAD_CHECK_STEPS} iterations nothing of the object is learnt. The density may be "
            "dead (negative everywhere, no gradient), which no choice of pixels can help: try another --machine.seed",
            file=sys.stderr,
        )


@contextmanager
def _preserved_state(model: nn.Module) -> Iterator[None]:
    """Render as training does, pose corrections and all, and leave everything as it was.

    Random numbers are others than training will see; the host's generators go on from where they were. nerfacto's
    proposal sampler counts the steps since it last let gradients through: a forward pass that resets the counter takes
    the next step's turn, and the proposal networks would never be trained again.
    """
    counters = [(m, m._steps_since_update) for m in model.modules() if hasattr(m, "_steps_since_update")]
    was_training = model.training
    model.train()
    device: Any = getattr(model, "device", torch.device("cpu"))
    try:
        with torch.random.fork_rng([device] if torch.device(device).type == "cuda" else []):
            torch.manual_seed(int(torch.randint(2**62, ())))
            yield
    finally:
        model.train(was_training)
        for module, count in counters:
            module._steps_since_update = count


def get_background_color(model: Any) -> tuple[float, float, float]:
    """What the model's loss composites RGBA images on; a random background has no edge of its own, and counts as
    white. Without alpha the data parser has composited them already, and this is of no account."""
    background: Any = getattr(getattr(model, "renderer_rgb", None), "background_color", None)
    if isinstance(background, Tensor):
        red, green, blue = background.tolist()
        return red, green, blue
    return BLACK if background in ("black", "last_sample") else WHITE
