"""The planned length of a nerfstudio run, kept beside its checkpoint folder: phases follow the plan of the first run.

nerfstudio 1.1.5 resumes for max_num_iterations *more* steps, in another folder, and its checkpoints are its own. The
file must not lie among them: nerfstudio reads the name of every file there as that of a step.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from edge_se_sampler.engine.files import write_json
from edge_se_sampler.errors import InputError

FILE = "edge-se-plan.json"


def planned_steps(trainer: Any) -> int:
    """Steps that the run was first planned for; written beside this run's checkpoint folder for the next to find.

    Args:
        trainer: nerfstudio's, once it has loaded its checkpoint, if there is one.

    Raises:
        InputError: what lies beside the loaded checkpoint's folder is no plan, or this one cannot be written.
    """
    config = trainer.config
    steps = config.max_num_iterations
    loaded = config.load_dir or (config.load_checkpoint and config.load_checkpoint.parent)
    if loaded:
        plan = loaded.resolve().parent / FILE
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


def _read(path: Path) -> int:
    try:
        steps = json.loads(path.read_text())["planned_steps"]
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{path}: cannot be read as a plan ({problem!r}); delete it to plan anew") from problem
    if type(steps) is not int or steps < 1:
        raise InputError(f"{path}: planned_steps is {steps!r}, not a number of steps; delete it to plan anew")
    return steps
