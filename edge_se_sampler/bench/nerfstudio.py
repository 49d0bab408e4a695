"""`edge-se bench nerfstudio`: how often training dies inside nerfstudio, with its own sampler and with ours.

Runs in an environment that has all of nerfstudio 1.1.5. Its vanilla NeRF has a softplus density, torch's initial
weights and RAdam; the two methods differ in their data managers alone.
"""
# pyright: reportMissingImports=false
# nerfstudio's pins rule out the environment that is linted

from __future__ import annotations

import contextlib
import copy
import json
import random
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from edge_se_sampler.bench.machine import machine, resident_memory
from edge_se_sampler.bench.outcome import background_measures, foreground_share, outcome
from edge_se_sampler.data.blender import read_blender
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.files import make_folder, write_json
from edge_se_sampler.engine.metrics import compute_metrics
from edge_se_sampler.engine.progress import Progress
from edge_se_sampler.engine.rendering import to_pictures
from edge_se_sampler.errors import InputError

METHODS = ("vanilla-nerf", "edge-se-nerf")
SIZE, VIEWS, TEST_VIEWS = 64, 30, 3
OFFSET = (0.2, 0.15)
RAYS = "--pipeline.datamanager.train-num-rays-per-batch"


def bench_nerfstudio(
    output_dir: Path, workplace: Path, scene: str, seeds: Sequence[int], iterations: int, rays: int, samples: int
) -> dict[str, Any]:
    """Train both methods with every seed and leave result.json; runs that it already has are kept.

    Args:
        output_dir: of the result.
        workplace: where the scene and nerfstudio's runs are kept.
        samples: coarse samples a ray, and as many importance samples.

    Raises:
        InputError: no nerfstudio here, a folder that cannot be written, an unknown scene, or a result of other
            settings in output_dir.
    """
    if find_spec("nerfstudio") is None or find_spec("torchvision") is None:
        raise InputError("bench nerfstudio needs all of nerfstudio 1.1.5 beside edge_se_sampler in one environment")
    make_folder(output_dir, "--output-dir")
    data = workplace / "scenes" / f"{scene}-off-centre-{SIZE}"
    if not data.exists():
        (made,) = make_scenes(
            workplace / "scenes-tmp", [scene], size=SIZE, num_train=VIEWS, num_val=1, num_test=TEST_VIEWS,
            placement="shifted", offset=OFFSET,
        )  # fmt: skip
        data.parent.mkdir(parents=True, exist_ok=True)
        made.rename(data)
    settings = {
        "scene": {"name": scene, "placement": "shifted", "offset": OFFSET, "size": SIZE, "num_train": VIEWS},
        "iterations": iterations,
        "rays": rays,
        "samples": [samples, samples],
    }
    path = output_dir / "result.json"
    result = _begun(path, settings)
    done = {(run["method"], run["seed"]) for run in result["runs"]}
    missing = [(method, seed) for seed in seeds for method in METHODS if (method, seed) not in done]
    progress = Progress(len(missing), "bench nerfstudio")
    for i, (method, seed) in enumerate(missing):
        with open(workplace / "nerfstudio.log", "a") as log, contextlib.redirect_stdout(log):
            result["runs"].append(_run(method, seed, data, workplace / "runs", settings))
        write_json(path, result)
        progress.update(i + 1)
    progress.close()
    if "costs" not in result:
        result["costs"] = costs(data, workplace / "runs", rays=256)
    result["failures"] = _failures(result["runs"])
    write_json(path, result)
    return result


def _begun(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """What an earlier call has left, if its settings were these."""
    settings = json.loads(json.dumps(settings))
    if not path.exists():
        return {
            "command": "edge-se bench nerfstudio",
            "settings": settings,
            "nerfstudio": version("nerfstudio"),
            "machine": machine(),
            "runs": [],
        }
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
        found, _ = result["settings"], result["runs"]
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise InputError(f"{path}: not a result of this command ({problem!r})") from problem
    if found != settings:
        raise InputError(f"{path}: is of other settings; name another --output-dir, or move it away")
    return result


def host_config(method: str, seed: int, data: Path, runs: Path, flags: Sequence[str] = ()) -> Any:
    """A method's config on the scene, as ns-train makes it of flags."""
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
    from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig

    config = copy.deepcopy(tyro.cli(AnnotatedBaseConfigUnion, args=[method, *flags]))
    config.output_dir, config.vis, config.machine.seed = runs, "tensorboard", seed
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 10**9
    manager = config.pipeline.datamanager
    manager.data, manager.dataparser = data, BlenderDataParserConfig()
    config.set_timestamp()
    return config


def host_trainer(config: Any, test_mode: str) -> Any:
    """nerfstudio's trainer, seeded as ns-train seeds it."""
    random.seed(config.machine.seed)
    torch.manual_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup(test_mode=test_mode)
    return trainer


def _run(method: str, seed: int, data: Path, runs: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Train once, and look at the test views."""
    config = host_config(method, seed, data, runs, [RAYS, str(settings["rays"])])
    config.max_num_iterations = settings["iterations"]
    model = config.pipeline.model
    model.num_coarse_samples, model.num_importance_samples = settings["samples"]
    trainer = host_trainer(config, "test")
    began, cpu = time.monotonic(), time.process_time()
    trainer.train()
    seconds, cpu = time.monotonic() - began, time.process_time() - cpu
    return {"method": method, "seed": seed, "seconds": seconds, "cpu_seconds": cpu} | _looked_at(trainer, data)


def rendered_views(trainer: Any) -> list[Any]:
    """The test views as nerfstudio renders them now, (H, W, 3) each."""
    pipeline = trainer.pipeline
    pipeline.eval()
    cameras = pipeline.datamanager.eval_dataset.cameras.to(pipeline.device)
    outputs = [pipeline.model.get_outputs_for_camera(cameras[i : i + 1]) for i in range(len(cameras))]
    pipeline.train()
    return [shown["rgb_fine" if "rgb_fine" in shown else "rgb"].cpu().numpy() for shown in outputs]


def _looked_at(trainer: Any, data: Path) -> dict[str, Any]:
    """PSNR on the test views, and the error on the object as a share of what the background alone has there."""
    pictures = to_pictures(read_blender(data, "test"))
    rows = [compute_metrics(shown, p.image, 1.0) for shown, p in zip(rendered_views(trainer), pictures, strict=True)]
    background = background_measures(pictures, 1.0)
    return {
        "psnr": statistics.mean(row["psnr"] or 0.0 for row in rows),
        "background_psnr": statistics.mean(row["psnr"] or 0.0 for row in background),
        "foreground_share": foreground_share({"images": rows}, background),
    }


_COST = "import sys; from edge_se_sampler.bench.nerfstudio import cost; cost(*sys.argv[1:])"


def costs(data: Path, runs: Path, rays: int, rounds: int = 3) -> dict[str, Any]:
    """Seconds a step (medians, interleaved) and peak memory of late sampling, uniform and by squared error."""
    told: dict[str, list[dict[str, float]]] = {}
    cases = [(method, late) for method in ("edge-se-nerf", "edge-se-nerfacto") for late in ("uniform", "se")]
    for _ in range(rounds):
        for case in cases:
            command = [sys.executable, "-W", "ignore", "-c", _COST, *case, str(data), str(runs), str(rays)]
            said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            told.setdefault(" ".join(case), []).append(json.loads(said.splitlines()[-1]))
    medians = {
        case: {key: statistics.median(one[key] for one in several) for key in several[0]}
        for case, several in told.items()
    }
    ratios = {
        method: {key: medians[f"{method} se"][key] / value for key, value in medians[f"{method} uniform"].items()}
        for method in ("edge-se-nerf", "edge-se-nerfacto")
    }
    return {"rays": rays, "medians": medians, "se_against_uniform": ratios}


def cost(method: str, late: str, data: str, runs: str, rays: str) -> None:
    """Print what a late step costs: seconds, and peak resident bytes above the level after set-up."""
    config = host_config(method, 0, Path(data), Path(runs), [RAYS, rays])
    config.pipeline.datamanager.pixel_sampler.early = "uniform"
    config.pipeline.datamanager.pixel_sampler.late = late
    config.pipeline.datamanager.pixel_sampler.early_fraction = 0.0
    trainer = host_trainer(config, "test")
    before = resident_memory()
    seconds = []
    for step in range(8):
        began = time.perf_counter()
        for callback in trainer.callbacks:
            callback.func(step=step)
        trainer.train_iteration(step)
        seconds.append(time.perf_counter() - began)
    print(json.dumps({"seconds": statistics.median(seconds), "bytes": resident_memory("VmHWM") - before}))


def _failures(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """For each method, of how many runs: at the background, and failed at all; and the mean PSNR."""
    told = {}
    for method in METHODS:
        mine = [run for run in runs if run["method"] == method]
        ends = [outcome(run["psnr"], run["background_psnr"], run["foreground_share"]) for run in mine]
        told[method] = {
            "runs": len(mine),
            "at_background": ends.count("background"),
            "failed": len(ends) - ends.count("learnt"),
            "mean_psnr": statistics.mean(run["psnr"] for run in mine) if mine else None,
        }
    return told
