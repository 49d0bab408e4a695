"""What several tests share: a tiny synthetic scene and the command line, called in this process."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from tiny import SMALL, copy_run

from edge_se_sampler.cli import main
from edge_se_sampler.data.synthetic.folder import make_scenes


@pytest.fixture(scope="session")
def _rendered_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic")
    return make_scenes(folder, ["mic"], size=24, num_train=3, num_val=1, num_test=1)[0]


@pytest.fixture
def scene(_rendered_scene: Path, tmp_path: Path) -> Path:
    """A Blender folder of its own: 3 training views, 1 val, 1 test, 24 x 24."""
    return Path(shutil.copytree(_rendered_scene, tmp_path / "scene"))


@pytest.fixture(scope="session")
def stranger_runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs of both kinds of model, stopped after a step, to be copied and spoiled."""
    return pytest.importorskip("strangers").make_runs(tmp_path_factory.mktemp("strangers"))


@dataclass(frozen=True)
class Answer:
    code: int
    out: str
    err: str


@pytest.fixture
def edge_se(capfd: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Call the command line: edge_se("train", "edge-nerf", ...) -> exit code, stdout, stderr."""

    def call(*arguments: object) -> Answer:
        capfd.readouterr()
        code = 0
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = int(end.code or 0)
        captured = capfd.readouterr()
        return Answer(code, captured.out, captured.err)

    return call


@pytest.fixture(scope="session")
def _trained_run(_rendered_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("outputs")
    flags = ["--data", str(_rendered_scene), "--output-dir", str(folder), "--experiment-name", "scene"]
    main(["train", "edge-se-nerf", *flags, *SMALL])
    return next((folder / "scene" / "edge-se-nerf").iterdir())


@pytest.fixture
def run(_trained_run: Path, scene: Path, tmp_path: Path) -> Path:
    """A finished run of edge-se-nerf on the scene, one training's in all tests."""
    return copy_run(_trained_run, scene, tmp_path / "outputs")
