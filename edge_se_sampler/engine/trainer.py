"""The training loop: one run from its data to its last checkpoint."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import replace
from typing import Any

import torch
from torch.optim.lr_scheduler import LambdaLR

from edge_se_sampler import ranks
from edge_se_sampler.engine.checkpoint import save_checkpoint
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.early_stopping import EarlyStopping
from edge_se_sampler.engine.files import write_image
from edge_se_sampler.engine.optimizers import create_adam, learning_rate_factor
from edge_se_sampler.engine.pipeline import Pipeline, load_weights
from edge_se_sampler.engine.plan import Plan
from edge_se_sampler.engine.progress import Progress, write_line
from edge_se_sampler.engine.reinitialization import PROBE_RAYS, DeadNetworkReset
from edge_se_sampler.engine.rendering import Picture, measure_psnr, render_view
from edge_se_sampler.engine.run_folder import EventWriter, RunFolder, config_digest
from edge_se_sampler.engine.saved_state import check_training, load_sampler
from edge_se_sampler.errors import InputError
from edge_se_sampler.protocol import TrainingCallbackAttributes, TrainingCallbackLocation
from edge_se_sampler.sampling.random_streams import Stream, stream


class Trainer:
    """Trains a model into a run folder by a resolved config; `preview` is a held-out view, rendered now and then. Of a
    time budget, `setup_seconds` have passed."""

    def __init__(
        self,
        config: TrainerConfig,
        *,
        run: RunFolder,
        pipeline: Pipeline,
        preview: Picture | None,
        setup_seconds: float = 0.0,
    ) -> None:
        self.config, self.run, self.pipeline, self.preview_picture = config, run, pipeline, preview
        num_steps = config.new_num_iterations or config.max_num_iterations
        self.plan = Plan(num_steps, config.segments or (), config.budget_seconds)
        self.first_plan = Plan(config.max_num_iterations) if config.new_num_iterations else self.plan
        self.max_seconds = config.max_seconds  # whoever goes on with a run may have another limit
        self.early_stopping = EarlyStopping(config.patience, config.min_gain)
        self.setup_seconds = setup_seconds
        self.optimizer = create_adam(pipeline.model.parameter_groups(), config.preset, config.optimizer)
        self.scheduler = LambdaLR(self.optimizer, self._learning_rate_factor)
        self.next_step = 0
        self.elapsed = 0.0
        self.events = EventWriter(run.path)
        self.stop_requested = False
        self.turns: AbstractContextManager[Any] = nullcontext()
        """Held while the model is used: a viewer, which has others wait for their turn, renders in between."""
        attributes = TrainingCallbackAttributes(pipeline, self)
        self.callbacks = pipeline.datamanager.get_training_callbacks(attributes)
        self.callbacks += pipeline.model.get_training_callbacks(attributes)
        self.dead_network_reset: DeadNetworkReset | None = None
        if config.reinit_dead:
            seed = config.machine.seed
            probe = pipeline.datamanager.probe_rays(PROBE_RAYS, stream(seed, 0, Stream.PROBE))
            self.dead_network_reset = DeadNetworkReset(pipeline.model, self.optimizer, probe, seed)
        self._preview_psnr: float | None = None

    def progress(self, step: int) -> float:
        """The part of the training, in [0, 1], that is done when a step begins."""
        return self.plan.progress(step)

    def first_progress(self, step: int) -> float:
        """The same of the training as first planned, at most 1: one that goes on for longer has no longer early phase,
        nor another."""
        return min(1.0, self.first_plan.progress(step))

    def _learning_rate_factor(self, step: int) -> float:
        return learning_rate_factor(self.config.optimizer, self.progress(step), step)

    def resume(self, state: dict[str, Any], changed_data: bool = False) -> None:
        """Continue from a checkpoint's state; InputError if it is another model's, or, unless that is accepted, of
        other training images. What the sampler remembers of others is forgotten."""
        is_same_data = self.pipeline.has_data_of(state)
        if not (is_same_data or changed_data):
            remedy = "restore them, or add --changed-data True"
            raise InputError(f"{self.config.data}: not the training images that the run began with; {remedy}")
        weights, grid = state["model"], self.pipeline.model.grid
        load_weights(self.pipeline.model, weights if grid is None else {**weights, "grid.scene": grid.scene})
        check_training(state, self)
        if state["optimizer"] is not None:  # of a run that has ended
            self.optimizer.load_state_dict(state["optimizer"])
        self.plan.load_state_dict(state["plan"])
        self.scheduler.load_state_dict(state["scheduler"])
        if self.dead_network_reset is not None:
            self.dead_network_reset.load_state_dict(state["dead_network_reset"])
        self.early_stopping.load_state_dict(state.get("early_stopping", {}))
        if is_same_data:
            load_sampler(self.pipeline.datamanager, state["sampler"])
        self.next_step, self.elapsed = state["step"] + 1, state["elapsed"]
        # a time budget goes on from where it was; earlier versions did not keep them
        self.setup_seconds = state.get("setup_seconds", self.setup_seconds)
        for group, initial in zip(self.optimizer.param_groups, self.scheduler.base_lrs, strict=True):
            group["lr"] = initial * self._learning_rate_factor(self.next_step)  # the plan may be another
            group["fused"] = self.optimizer.defaults["fused"]  # the torch or the device may be another
        if ranks.is_main():
            self.run.drop_metrics_after(state["step"])
            self.events = EventWriter(self.run.path, self.next_step)

    def train(self) -> None:
        """Train until the planned iterations are done, max_seconds have passed, patience is lost, or Ctrl-C; then save.
        FloatingPointError if the loss or a weight is not finite: the last checkpoint is kept."""
        config = self.config
        began = time.monotonic() - self.elapsed
        deadline = math.inf if self.max_seconds is None else time.monotonic() + self.max_seconds
        plan = self.plan
        (self.setup_seconds,) = ranks.agree(self.setup_seconds)
        plan.decide(self.next_step, self.setup_seconds + self.elapsed)
        with self._interruptible(), Progress(plan.num_steps or 0, config.method_name, self.next_step) as progress:
            while plan.num_steps is None or self.next_step < plan.num_steps:
                step = self.next_step
                learning_rate = float(self.optimizer.param_groups[0]["lr"])
                with self.turns:
                    loss = self.train_iteration(step)
                self.next_step = step + 1
                stopping = self.stop_requested or time.monotonic() >= deadline
                self.elapsed, stopping = ranks.agree(time.monotonic() - began, stopping)
                plan.decide(self.next_step, self.setup_seconds + self.elapsed)
                ended = self.next_step == plan.num_steps
                with self._saved_if_it_fails():
                    if ended or step % config.steps_per_log == 0:
                        strategy = getattr(self.pipeline.datamanager.train_pixel_sampler, "strategy", None)
                        self._record(step, loss=loss, learning_rate=learning_rate, strategy=strategy)
                    if ended or self._preview_is_due():
                        with self.turns:
                            self._preview(step)
                        stopping = ranks.share(lambda: self.early_stopping.is_due) or stopping
                        began = time.monotonic() - self.elapsed  # a preview is not training time
                if ended or stopping or self.next_step % config.steps_per_save == 0:
                    self.save()
                total = plan.num_steps or round(self.next_step / max(plan.progress(self.next_step), 1e-3))
                progress.update(self.next_step, total, note=self._status(loss))
                if stopping:
                    break
        if ranks.is_main() and plan.time_budget is not None and self.next_step == plan.num_steps:
            self.config = replace(config, segments=tuple(plan.segments))
            self.run.write_config(self.config)
        self.events.close()

    def train_iteration(self, step: int) -> float:
        """Train one step, and return its loss; FloatingPointError if that is not finite: the weights stay."""
        model = self.pipeline.model
        model.train()
        for callback in self.callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        seed = self.config.machine.seed
        model.begin_step(step, int(stream(seed, step, Stream.MODEL).integers(2**63)))
        rays, batch = self.pipeline.datamanager.next_train(step)
        self.optimizer.zero_grad()
        batch.pop("full_image", None)  # whole images: not indexed by ray
        errors = torch.zeros(len(rays), dtype=model.dtype, device=model.device)

        def training_loss(rows: slice) -> torch.Tensor:
            loss, error = model.training_loss(rays[rows], {key: value[rows] for key, value in batch.items()})
            errors[rows] = error
            return loss

        loss = self._backward(len(rays), training_loss)
        if model.num_unseen_rays:
            unseen = self.pipeline.datamanager.unseen_rays(model.num_unseen_rays, stream(seed, step, Stream.UNSEEN))
            loss += self._backward(len(unseen), lambda rows: model.auxiliary_loss(unseen[rows]))
        ranks.add_up_gradients(model.parameters(), loss)
        value = float(loss)
        if not math.isfinite(value):
            raise FloatingPointError(f"the loss is not finite at step {step}; try a lower --optimizer.lr")
        reinitialized = {} if self.dead_network_reset is None else self.dead_network_reset.after_backward()
        for network, sub_seed in reinitialized.items():
            message = f"step {step}: the {network} network is dead; reinitialized from sub-seed {sub_seed}"
            if ranks.is_main():
                write_line(message)
            self._record(step, reinitialized=network, sub_seed=sub_seed)
        self.optimizer.step()
        self.scheduler.step()
        self.pipeline.datamanager.observe(errors)
        for callback in self.callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        return value

    def _backward(self, num_rays: int, loss_of: Callable[[slice], torch.Tensor]) -> torch.Tensor:
        """Accumulate the gradients of the mean loss over rays, chunk by chunk, and return that mean; of several ranks,
        each has its part of both sums."""
        loss = torch.zeros((), device=self.pipeline.model.device)
        for rows in self.pipeline.model.own_chunks(num_rays):
            chunk_loss = loss_of(rows).sum() / num_rays
            chunk_loss.backward()
            loss += chunk_loss.detach()
        return loss

    def save(self) -> None:
        """Write a checkpoint of the steps done so far; FloatingPointError, and no file, if a weight is not finite."""
        step = self.next_step - 1
        # for good: what has a number of iterations can be given a larger one
        ended = self.next_step == self.plan.num_steps and self.config.max_num_iterations is None
        extremes = [
            torch.stack(torch.aminmax(weight)) for weight in self.pipeline.model.parameters()
        ]  # needs no memory
        if not torch.cat(extremes).isfinite().all():
            raise FloatingPointError(f"a weight is not finite after step {step}; try a lower --optimizer.lr")
        if not ranks.is_main():
            return
        state = {
            "step": step,
            "elapsed": self.elapsed,
            "setup_seconds": self.setup_seconds,
            "config_digest": config_digest(self.config),
            "model": self.pipeline.model.state_dict(),
            "plan": self.plan.state_dict(),
            "optimizer": None if ended else self.optimizer.state_dict(),  # as large as the model, twice
            "scheduler": self.scheduler.state_dict(),
            "dead_network_reset": None if self.dead_network_reset is None else self.dead_network_reset.state_dict(),
            "sampler": self.pipeline.datamanager.state_dict(),
            "early_stopping": self.early_stopping.state_dict(),
            "data_digest": self.pipeline.data_digest,
        }
        save_checkpoint(self.run.checkpoints, step, state)

    def _record(self, step: int, **values: Any) -> None:
        if not ranks.is_main():
            return
        line = {"step": step, **values, "seconds": round(self.elapsed, 3)}
        self.run.log(line)
        self.events.write(line)

    def _preview_is_due(self) -> bool:
        """Before `next_step`: at regular steps, or ten times in a time budget."""
        interval = self.config.steps_per_eval_image
        if interval is not None:
            return self.next_step % interval == 0
        before, now = (int(10 * self.progress(step)) for step in (self.next_step - 1, self.next_step))
        return before < now

    def _preview(self, step: int) -> None:
        if self.preview_picture is not None and ranks.is_main():
            model = self.pipeline.model
            rendered = render_view(model, self.preview_picture)
            self._preview_psnr = measure_psnr(rendered, self.preview_picture, model.config.background_level)
            self.early_stopping.update(self._preview_psnr)
            self._record(step, val_psnr=self._preview_psnr)
            write_image(self.run.path / "previews" / f"step-{step:09d}.png", rendered)

    @contextmanager
    def _saved_if_it_fails(self) -> Iterator[None]:
        """What was learned is worth more than a line or a picture that cannot be written."""
        try:
            yield
        except InputError:
            with suppress(InputError):
                self.save()
            raise

    def _status(self, loss: float) -> str:
        rate = self.next_step * self.config.preset.rays / self.elapsed
        psnr = "" if self._preview_psnr is None else f", PSNR {self._preview_psnr:.2f}"
        return f"{rate:,.0f} rays/s, loss {loss:.5f}{psnr}"

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let Ctrl-C, a SIGTERM or a terminal that is closed end the current step first, so that a consistent state is
        saved."""

        def request_stop(*_: Any) -> None:
            self.stop_requested = True

        previous, numbers = {}, [signal.SIGINT, signal.SIGTERM]
        hangup = getattr(signal, "SIGHUP", None)  # not on Windows
        if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:  # nohup's
            numbers.append(hangup)
        with suppress(ValueError):  # only the main thread may handle signals
            previous = {number: signal.signal(number, request_stop) for number in numbers}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
