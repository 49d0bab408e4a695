"""What a nerfstudio run must remember for its phases, kept beside its checkpoint folder: the length that the first
run was planned for, and under schedule "adaptive" what its watch saw.

nerfstudio 1.1.5 resumes for max_num_iterations *more* steps, in another folder, and its checkpoints are its own. The
files must not lie among them: nerfstudio reads the name of every file there as that of a step.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge_se_sampler.engine.files import write_json
from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.schedule import AdaptiveSchedule

FILE = "edge-se-plan.json"
WATCH_FILE = "edge-se-watch.json"


def planned_steps(trainer: Any) -> int:
    """Steps that the run was first planned for; written beside this run's checkpoint folder for the next to find.

    Args:
        trainer: nerfstudio's, once it has loaded its checkpoint, if there is one.

    Raises:
        InputError: what lies beside the loaded checkpoint's folder is no plan, or this one cannot be written.
    """
    steps = trainer.config.max_num_iterations
    loaded = _loaded_from(trainer)
    if loaded:
        plan = loaded / FILE
        if plan.exists():
            steps = _read(plan)
        else:
            print(
                f"edge-se-sampler: no plan at {plan}: the phases follow this run's max-num-iterations, {steps}",
                file=sys.stderr,
            )
    if trainer.local_rank == 0:
        plan = trainer.checkpoint_dir.parent / FILE
        plan.parent.mkdir(parents=True, exist_ok=True)
        write_json(plan, {"planned_steps": steps})
    return steps


def remember_watch(trainer: Any, watch: AdaptiveSchedule) -> Callable[..., None]:
    """Take up the watch of the loaded checkpoint, if there is one; a function of the step, to be called after each
    iteration, that keeps it wherever nerfstudio saves.

    Raises:
        InputError: what lies beside the loaded checkpoint's folder is no such file, or this one cannot be written.
    """
    start, config = trainer._start_step, trainer.config
    loaded = _loaded_from(trainer)
    if loaded and (loaded / WATCH_FILE).exists():
        try:
            state = json.loads((loaded / WATCH_FILE).read_text()).get(str(start - 1))
            if state is not None:
                watch.load(state)
        except (OSError, ValueError, AttributeError, TypeError) as problem:
            raise InputError(
                f"{loaded / WATCH_FILE}: cannot be read ({problem!r}); delete it to watch anew"
            ) from problem
    path, states = trainer.checkpoint_dir.parent / WATCH_FILE, {}
    last = {config.max_num_iterations - 1, start + config.max_num_iterations - 1}  # of main, of 1.1.5

    def keep(step: int) -> None:
        if trainer.local_rank == 0 and (step % config.steps_per_save == 0 or step in last):
            states[str(step)] = watch.state()
            write_json(path, states)

    return keep


def _loaded_from(trainer: Any) -> Path | None:
    """The folder of the run that the checkpoint is from."""
    config = trainer.config
    loaded = config.load_dir or (config.load_checkpoint and config.load_checkpoint.parent)
    return loaded.resolve().parent if loaded else None


def _read(path: Path) -> int:
    try:
        steps = json.loads(path.read_text())["planned_steps"]
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{path}: cannot be read as a plan ({problem!r}); delete it to plan anew") from problem
    if type(steps) is not int or steps < 1:
        raise InputError(f"{path}: planned_steps is {steps!r}, not a number of steps; delete it to plan anew")
    return steps
