"""An hour of trainings in one process (pytest -m soak): its memory stays flat, and no file stays open. The result and
its page in configs/soak are written by the soak itself."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_se_sampler.bench.machine import machine, resident_memory
from edge_se_sampler.bench.report import describe_machine
from edge_se_sampler.cli import main
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.files import write_json

FOLDER = Path(__file__).parent.parent / "configs" / "soak"
SECONDS, WARMUP_SECONDS = 3600, 60
ADDRESS_SPACE = 4 * 2**30
MAX_SLOPE = 1.0
"""Of resident memory after the warmup, in MiB a minute."""
METHODS = {
    "lean-nerf": ["--max-num-iterations", "200", "--pipeline.datamanager.train-num-rays-per-batch", "512"],
    "edge-se-nerf": ["--max-num-iterations", "40", "--pipeline.model.size", "tiny"],
}
FLAGS = ["--machine.device-type", "cpu", "--steps-per-save", "20", "--steps-per-eval-image", "20"]


def train_in_a_loop(folder: Path, seconds: float) -> dict[str, Any]:
    """Train the methods in turns for so many seconds, each training to a run of its own; after every one: seconds since
    the start, resident MiB, open files."""
    (scene,) = make_scenes(folder / "scenes", ["bricks"], size=64, num_train=20, num_val=1, num_test=1)
    began, cpu_began, samples = time.monotonic(), time.process_time(), []
    while not samples or samples[-1][0] < seconds:
        for method, flags in METHODS.items():
            output_dir = folder / "runs" / f"{len(samples)}"
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                main(["train", method, "--data", str(scene), "--output-dir", str(output_dir), *FLAGS, *flags])
            num_files = len(os.listdir("/proc/self/fd"))
            samples.append([round(time.monotonic() - began, 1), resident_memory() / 2**20, num_files])
    return {
        "machine": machine(),
        "address_space_mib": ADDRESS_SPACE // 2**20,
        "cpu_minutes": (time.process_time() - cpu_began) / 60,
        "peak_mib": resident_memory("VmHWM") / 2**20,
        "samples": samples,
    }


def slope(samples: list[list[float]]) -> float:
    """Of resident memory by the least squares after the warmup, in MiB a minute."""
    seconds, resident, _ = np.array([sample for sample in samples if sample[0] >= WARMUP_SECONDS]).T
    return float(np.polyfit(seconds / 60, resident, 1)[0])


def describe(result: dict[str, Any]) -> str:
    """The page of a result."""
    warm = [sample for sample in result["samples"] if sample[0] >= WARMUP_SECONDS]
    resident, open_files = [sample[1] for sample in warm], sorted({sample[2] for sample in warm})
    return (
        f"# An hour of trainings in one process\n\n"
        f"{' and '.join(METHODS)} trained in turns on a synthetic scene (`bricks`, 20 views of 64 x 64), "
        f"{len(result['samples'])} trainings in {result['samples'][-1][0] / 60:.0f} minutes "
        f"({result['cpu_minutes']:.0f} of CPU), each through the command line with checkpoints and previews, in one "
        f"process whose address space is limited to {result['address_space_mib'] / 1024:g} GiB. After the first minute "
        f"resident memory stayed between {min(resident):.1f} and {max(resident):.1f} MiB (at most "
        f"{result['peak_mib']:.1f} during a training), with a slope of {slope(result['samples']):+.3f} MiB a minute; "
        f"{' or '.join(map(str, open_files))} files were open after every training. "
        f"`pytest -m soak` writes this page and its json again.\n\n"
        f"Measured on: {describe_machine(result['machine'])}.\n"
    )


def check(result: dict[str, Any]) -> None:
    assert slope(result["samples"]) < MAX_SLOPE
    assert len({num_files for seconds, _, num_files in result["samples"] if seconds >= WARMUP_SECONDS}) == 1


@pytest.mark.soak
def test_memory_and_open_files_stay_the_same(tmp_path: Path) -> None:
    command = [sys.executable, __file__, tmp_path, str(SECONDS)]
    out = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    result = json.loads(out.splitlines()[-1])
    FOLDER.mkdir(exist_ok=True)
    write_json(FOLDER / "result.json", result)
    (FOLDER / "README.md").write_text(describe(result), encoding="utf-8")
    check(result)


def test_they_stayed_the_same_in_the_committed_hour() -> None:
    result = json.loads((FOLDER / "result.json").read_text(encoding="utf-8"))
    assert result["samples"][-1][0] >= SECONDS
    check(result)
    assert (FOLDER / "README.md").read_text(encoding="utf-8") == describe(result)


if __name__ == "__main__":
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    print(json.dumps(train_in_a_loop(Path(sys.argv[1]), float(sys.argv[2]))))
