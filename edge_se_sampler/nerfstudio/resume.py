"""What a resumed nerfstudio run needs for its pixels, kept in files beside the run's checkpoint folder: the number of
iterations that the first run was planned for, the state of an adaptive schedule, and what strategies have learnt.

nerfstudio 1.1.5 resumes for max_num_iterations *more* steps, in another folder, and its checkpoints are its own. The
files must not lie among them: nerfstudio reads the name of every file there as that of a step.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.engine.files import write_atomically, write_json
from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.pixel_sampler import ImportantPixels
from edge_se_sampler.sampling.saved_sampler import is_alike, is_sampler_state
from edge_se_sampler.sampling.schedule import AdaptiveSchedule

PLAN_FILE = "edge-se-plan.json"
SCHEDULE_FILE = "edge-se-schedule.json"
SAMPLER_FILE = "edge-se-sampler-{rank}-{step}.pt"
"""Of every process and checkpoint: each has learnt from its own pixels."""
OLD_SAMPLER_FILE = "edge-se-sampler-{rank}.pt"
"""The same in runs of earlier versions, of their last checkpoint."""


def run_progress(trainer: Any) -> Callable[[int], float]:
    """The part of the run, in [0, 1], that is done when a step begins, of nerfstudio's trainer once it has loaded its
    checkpoint: of the iterations that the run was first planned for, which are also written beside this run's
    checkpoints, for the next to find. InputError if the loaded one's file is no plan, or this run's cannot be
    written."""
    steps = trainer.config.max_num_iterations
    if loaded := _loaded_run(trainer):
        plan = loaded / PLAN_FILE
        if plan.exists():
            steps = _read_plan(plan)
        else:
            problem = f"no plan at {plan}: the phases follow this run's max-num-iterations, {steps}"
            print(f"edge-se-sampler: {problem}", file=sys.stderr)
    if trainer.local_rank == 0:
        plan = trainer.checkpoint_dir.parent / PLAN_FILE
        plan.parent.mkdir(parents=True, exist_ok=True)
        write_json(plan, {"planned_steps": steps})
    return lambda step: min(1.0, step / steps)


def restore_schedule(trainer: Any, schedule: AdaptiveSchedule) -> None:
    """Load the state that the schedule had at the loaded checkpoint; a line if that is not known. InputError: the file
    beside the loaded checkpoint's folder holds no such state."""
    if not (loaded := _loaded_run(trainer)):
        return
    path, step = loaded / SCHEDULE_FILE, trainer._start_step - 1
    try:
        state = json.loads(path.read_text()).get(str(step)) if path.exists() else None
        if state is not None and not is_alike(state, schedule.state_dict()):
            raise ValueError(f"the state of step {step} is none")
    except (OSError, ValueError, AttributeError) as problem:
        raise InputError(f"{path}: cannot be read ({problem!r}); delete it to begin with the early phase") from problem
    if state is None:
        print(f"edge-se-sampler: {path} has no state of step {step}: the early phase begins anew", file=sys.stderr)
    else:
        schedule.load_state_dict(state)


def schedule_writer(trainer: Any, schedule: AdaptiveSchedule) -> Callable[..., None]:
    """A function to be called after each step: writes the schedule's state whenever nerfstudio saves a checkpoint, and
    raises InputError where it cannot."""
    path = trainer.checkpoint_dir.parent / SCHEDULE_FILE
    states = _read_states(path)  # a run may go on in its folder, where checkpoints of before are

    def write_schedule(step: int) -> None:
        if trainer.local_rank == 0 and _is_saved(trainer, step):
            states[str(step)] = schedule.state_dict()
            write_json(path, states)

    return write_schedule


def restore_sampler(trainer: Any, sampler: ImportantPixels, rank: int, images: dict[int, tuple[int, int]]) -> None:
    """Load what a sampler, bound to the run, had learnt at the loaded checkpoint from these training images (rows and
    columns by number); a line if that is not known. InputError: the file beside the loaded checkpoint's folder holds
    no such state."""
    if not (loaded := _loaded_run(trainer)):
        return
    step = trainer._start_step - 1
    path, old = (loaded / name.format(rank=rank, step=step) for name in (SAMPLER_FILE, OLD_SAMPLER_FILE))
    if old.exists() and not path.exists():
        path = old
    try:
        found: dict[str, Any] = torch.load(path, weights_only=True) if path.exists() else {"step": None}
        if found["step"] == step and not is_sampler_state(found["state"], sampler, images):
            raise ValueError("it is of another training")
    except Exception as problem:  # torch raises all kinds of a damaged file
        raise InputError(
            f"{path}: cannot be read ({problem!r}); delete it to let the strategies learn anew"
        ) from problem
    if found["step"] == step:
        sampler.load_state_dict(found["state"])
    else:
        print(f"edge-se-sampler: {path} has no state of step {step}: the strategies learn anew", file=sys.stderr)


def sampler_writer(trainer: Any, sampler: ImportantPixels, rank: int) -> Callable[..., None]:
    """A function to be called after each step: writes what the sampler has learnt whenever nerfstudio saves a
    checkpoint, and raises InputError where it cannot. nerfstudio does so afterwards, and may be killed before: what
    belongs to the checkpoint before is kept, too, and where it keeps all checkpoints, all is."""
    folder, written = trainer.checkpoint_dir.parent, []

    def write_sampler(step: int) -> None:
        if not _is_saved(trainer, step):
            return
        content = io.BytesIO()
        torch.save({"step": step, "state": sampler.state_dict()}, content)
        folder.mkdir(parents=True, exist_ok=True)
        written.append(folder / SAMPLER_FILE.format(rank=rank, step=step))
        write_atomically(written[-1], content.getvalue())
        if trainer.config.save_only_latest_checkpoint and len(written) > 2:
            written.pop(0).unlink(missing_ok=True)

    return write_sampler


def _read_states(path: Path) -> dict[str, Any]:
    """The states in a schedule's file, by step; none, where it cannot be read."""
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def _is_saved(trainer: Any, step: int) -> bool:
    """Whether nerfstudio saves a checkpoint after that step."""
    config, start = trainer.config, trainer._start_step
    last = {config.max_num_iterations - 1, start + config.max_num_iterations - 1}  # of nerfstudio's main, of 1.1.5
    is_due = config.steps_per_save > 0 < step and step % config.steps_per_save == 0
    return is_due or step in last


def _loaded_run(trainer: Any) -> Path | None:
    """The folder of the run that the loaded checkpoint is from."""
    config = trainer.config
    loaded = config.load_dir or (config.load_checkpoint and config.load_checkpoint.parent)
    return loaded.resolve().parent if loaded else None


def _read_plan(path: Path) -> int:
    remedy = "delete it to follow max-num-iterations"
    try:
        steps = json.loads(path.read_text())["planned_steps"]
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{path}: cannot be read ({problem!r}); {remedy}") from problem
    if type(steps) is not int or steps < 1:
        raise InputError(f"{path}: planned_steps is {steps!r}, not a number of steps; {remedy}")
    return steps
