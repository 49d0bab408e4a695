"""The whole host from its own commands: ns-train, resuming, ns-eval, ns-render, ns-export, the viewer, --help."""
# pyright: reportMissingImports=false

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
from full_host import max_num_iterations

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

COMMON = [
    *("--machine.device-type", "cpu", "--vis", "tensorboard", "--max-num-iterations", "20"),
    *("--steps-per-eval-image", "1000", "--steps-per-eval-batch", "1000", "--timestamp", "run"),
    *("--experiment-name", "small"),
    *("--pipeline.datamanager.train-num-rays-per-batch", "33"),
]
SMALL = {
    "edge-se-nerf": ["--pipeline.model.num-coarse-samples", "8", "--pipeline.model.num-importance-samples", "8"],
    "edge-se-nerfacto": [
        *("--pipeline.model.log2-hashmap-size", "10", "--pipeline.model.num-nerf-samples-per-ray", "8"),
        *("--pipeline.model.num-proposal-samples-per-ray", "16", "8"),
        *("--pipeline.model.predict-normals", "True"),  # what pointcloud export asks for
    ],
    "lean-nerf": [],
}


def ns(command: str, *arguments: object) -> str:
    """Run ns-COMMAND of this environment; what it said."""
    program = Path(sys.executable).parent / f"ns-{command}"
    environment = {**os.environ, "COLUMNS": "90", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, env=environment, timeout=400)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def trained(host_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Method -> run folder, trained by ns-train."""
    runs = tmp_path_factory.mktemp("runs")
    for method, small in SMALL.items():
        ns("train", method, *COMMON, *small, "--output-dir", runs, "blender-data", "--data", host_scene)
    return {method: runs / "small" / method / "run" for method in SMALL}


@pytest.mark.parametrize("method", SMALL)
def test_train_resume_and_evaluate(method: str, trained: dict[str, Path], host_scene: Path, tmp_path: Path) -> None:
    run = trained[method]
    assert [path.name for path in (run / "nerfstudio_models").iterdir()] == ["step-000000019.ckpt"]
    resume = [*COMMON, *SMALL[method], "--output-dir", tmp_path, "--max-num-iterations", max_num_iterations(20, 3)]
    ns("train", method, *resume, "--load-dir", run / "nerfstudio_models", "blender-data", "--data", host_scene)
    again = tmp_path / "small" / method / "run"
    assert [path.name for path in (again / "nerfstudio_models").iterdir()] == ["step-000000022.ckpt"]
    assert json.loads((again / "edge-se-plan.json").read_text()) == {"planned_steps": 20}
    ns("eval", "--load-config", again / "config.yml", "--output-path", tmp_path / "eval.json")
    evaluation = json.loads((tmp_path / "eval.json").read_text())
    assert evaluation["method_name"] == method
    assert math.isfinite(evaluation["results"]["psnr"])


def test_render(trained: dict[str, Path], tmp_path: Path) -> None:
    config = trained["edge-se-nerf"] / "config.yml"
    ns("render", "dataset", "--load-config", config, "--output-path", tmp_path, "--split", "test",
       "--rendered-output-names", "rgb_fine")  # fmt: skip
    assert len(list(tmp_path.rglob("*.jpg"))) + len(list(tmp_path.rglob("*.png"))) == 2


def test_export(trained: dict[str, Path], tmp_path: Path) -> None:
    """It draws from the training sampler, which is unbound then: uniformly, and with a warning."""
    for needed in ("open3d", "pymeshlab", "xatlas"):
        pytest.importorskip(needed, reason="ns-export needs it", exc_type=ImportError)
    config = trained["edge-se-nerfacto"] / "config.yml"
    said = ns("export", "pointcloud", "--load-config", config, "--output-dir", tmp_path, "--num-points", "500",
              "--num-rays-per-batch", "256", "--remove-outliers", "False", "--normal-method", "open3d")  # fmt: skip
    assert "is not bound to a training run and draws uniformly" in said
    assert (tmp_path / "point_cloud.ply").stat().st_size > 0


def test_the_viewer(host_scene: Path, tmp_path: Path) -> None:
    arguments = [*COMMON, *SMALL["edge-se-nerf"], "--output-dir", tmp_path, "--vis", "viewer+tensorboard"]
    quits = ["--viewer.quit-on-train-completion", "True", "--viewer.websocket-port-default", "7177"]
    ns("train", "edge-se-nerf", *arguments, *quits, "blender-data", "--data", host_scene)
    assert list(tmp_path.rglob("step-000000019.ckpt"))


def test_help_names_the_methods_and_their_flags() -> None:
    def help_of(*arguments: str) -> str:
        return " ".join(ns("train", *arguments, "--help").replace("│", " ").split())

    methods = help_of()
    for method in (
        "edge-nerf",
        "edge-se-nerf",
        "se-nerf",
        "precrop-nerf",
        "precrop-se-nerf",
        "edge-se-nerfacto",
        "lean-nerf",
    ):
        assert method in methods
    assert "by edge strength first, then by squared error" in methods
    flags = help_of("edge-se-nerf")
    choices = "".join(flags.replace("│", "").split())  # however they are wrapped
    assert "--pipeline.datamanager.pixel-sampler.early{uniform,precrop,edge," in choices
    assert "--pipeline.datamanager.pixel-sampler.late{uniform,se," in choices
