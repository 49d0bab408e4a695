"""Exports, renderings, masks, pictures and copies of what is changed at random: they are written, or refused in one
line, and nothing else is written."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from spoiled_folders import FORMATS, Folders, attack
from strangers import change_state, contents

from edge_se_sampler.commands import Masks, Offcenter, Show
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.export.cameras import export_cameras
from edge_se_sampler.export.commands import ExportCameras, ExportMesh, ExportPoints, ExportSplats
from edge_se_sampler.masks import votes
from edge_se_sampler.methods import method_configs
from edge_se_sampler.run_commands import Export, Render

OUTPUTS: Any = "rgb", "rgba", "accumulation", "depth", "raw-depth"


def make_opaque(state: dict[str, Any]) -> None:
    """What a step has trained is fog, of which nothing can be exported."""
    model = state["model"]
    (model["density"] if "density" in model else model["fine.density.bias"]).fill_(5.0)


@pytest.fixture(scope="module")
def folders(stranger_runs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Folders:
    folders = Folders(tmp_path_factory.mktemp("fuzz"), stranger_runs)
    for run in folders.runs:
        change_state(run, make_opaque)
    return folders


def export(what: Any) -> Callable[[Folders, Path, random.Random], None]:
    """A command that is given a run whose settings or checkpoint are changed."""

    def case(folders: Folders, out: Path, rng: random.Random) -> None:
        spoil = rng.choice((folders.config, folders.checkpoint))
        spoil(rng, lambda run: Export(run, replace(what, output_path=out / what.output_path)).run())

    return case


def cameras(folders: Folders, out: Path, rng: random.Random) -> None:
    config = RunFolder(folders.runs[0]).config(method_configs())
    changes: Any = {"data_format": "auto", "eval_every": None}
    folders.capture(rng, lambda data: export_cameras(replace(config, data=data, **changes), out / "transforms.json"))


def masks(folders: Folders, out: Path, rng: random.Random) -> None:
    folders.capture(rng, lambda data: Masks(data=data, out=out, output_path=out / "masks.png").run(), FORMATS[1:])


def show(folders: Folders, out: Path, rng: random.Random) -> None:
    folders.capture(rng, lambda data: Show(data=data, output_path=out / "show.png", num_views=1).run())


def offcenter(folders: Folders, out: Path, rng: random.Random) -> None:
    folders.capture(rng, lambda data: Offcenter(data=data, out=out / "copies").run(), FORMATS[:1])


def render(folders: Folders, out: Path, rng: random.Random) -> None:
    """A video, or a folder of all outputs."""
    run, (name, outputs) = rng.choice(folders.runs), rng.choice((("a.gif", OUTPUTS[:1]), ("a", OUTPUTS)))

    def use(paths: Path) -> None:
        path, dataparser = paths / "camera_path.json", paths / "dataparser_transforms.json"
        Render(run, output_path=out / name, outputs=outputs, camera_path=path, dataparser_transforms=dataparser).run()

    folders.path(rng, use)


CASES: dict[str, tuple[int, Callable[[Folders, Path, random.Random], None]]] = {
    "mesh": (12, export(ExportMesh(Path("mesh.glb"), tolerance=0.5))),
    "points": (12, export(ExportPoints(num_points=100))),
    "splats": (12, export(ExportSplats(num_points=100))),
    "cameras": (20, cameras),
    "cameras of changed settings": (6, export(ExportCameras())),
    "masks": (30, masks),
    "show": (30, show),
    "offcenter": (20, offcenter),
    "camera path": (30, render),
}
"""How many of each, and what."""


def attack_command(kind: str, seeds: range, folders: Folders, folder: Path) -> None:
    before, out = contents(folders.folder), folder / "out"
    refused: list[str] = []
    for seed in seeds:
        out.mkdir()
        refused.append(attack(partial(CASES[kind][1], folders, out), seed))
        shutil.rmtree(out)
    assert contents(folders.folder) == before
    assert 0 < refused.count("") < len(refused)
    assert list(folder.iterdir()) == []


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(votes, "RESOLUTIONS", (8, 16))


@pytest.mark.slow
@pytest.mark.parametrize("kind", CASES)
def test_any_change(kind: str, folders: Folders, tmp_path: Path) -> None:
    attack_command(kind, range(CASES[kind][0]), folders, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", CASES)
def test_many_changes(kind: str, folders: Folders, tmp_path: Path) -> None:
    attack_command(kind, range(1000, 1000 + 30 * CASES[kind][0]), folders, tmp_path)


Rename = Callable[[Path, str], Path]


@pytest.fixture
def rename(tmp_path: Path) -> Rename:
    """Give an image of a capture another name."""

    def call(capture: Path, name: str) -> Path:
        scene = Path(shutil.copytree(capture, tmp_path / "scene"))
        document = next(scene.glob("transforms*.json"))
        content = json.loads(document.read_text())
        frame = content["frames"][-1]
        path = scene / f"{frame['file_path'].removesuffix('.png')}.png"
        frame["file_path"] = Path(frame["file_path"]).with_name(name).as_posix()
        path.rename(path.with_name(name))
        document.write_text(json.dumps(content))
        return scene

    return call


def check_refused(answer: Any, problem: str) -> None:
    assert answer.code == 2, answer
    assert answer.err.count("\n") == 1
    assert problem in answer.err


@pytest.mark.parametrize("command", ["show", "inspect"])
def test_a_name_that_is_a_formula_is_shown(command: str, folders: Folders, rename: Rename, edge_se: Any) -> None:
    scene = rename(folders.folder / "transforms", r"view 00z $\frac$.png")
    assert edge_se(command, "--data", scene, "--output-path", "a.png").code == 0


def test_a_name_of_two_lines_is_refused_in_one(folders: Folders, rename: Rename, edge_se: Any) -> None:
    scene = rename(folders.folder / "transforms", "view 00z\n.png")
    flags = "--data", scene, "--output-path", "a.png"
    check_refused(edge_se("show", *flags, "--pixel-sampler.edge-source", "alpha"), "alpha")
    check_refused(edge_se("show", *flags, "--downscale", "100"), "--downscale is 100")


def test_a_name_too_long_for_a_masks_name_leaves_no_masks(folders: Folders, rename: Rename, edge_se: Any) -> None:
    scene = rename(folders.folder / "transforms", "x" * 251 + ".png")
    check_refused(edge_se("masks", "--data", scene, "--output-path", "masks.png"), "shorten that name")
    assert sorted(path.name for path in scene.iterdir()) == ["images", "transforms.json"]


def test_images_whose_copies_would_be_file_and_folder_are_not_copied(
    folders: Folders, rename: Rename, tmp_path: Path, edge_se: Any
) -> None:
    scene = rename(folders.folder / "blender", "a.jpg")
    (scene / "train" / "a.png").mkdir()
    document = scene / "transforms_train.json"
    content = json.loads(document.read_text())
    (scene / "train" / "r_0.png").rename(scene / "train" / "a.png" / "r_0.png")
    content["frames"][0]["file_path"] = "train/a.png/r_0"
    document.write_text(json.dumps(content))
    check_refused(edge_se("offcenter", "--data", scene, "--out", tmp_path / "out"), "cannot be written")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("method", "weights", "what"),
    [
        ("edge-se-nerf", "feature", ExportMesh()),
        ("edge-se-nerf", "density", ExportMesh()),
        ("edge-se-nerf", "density", ExportPoints(num_points=100)),
        ("lean-nerf", "feature", ExportMesh(Path("mesh.glb"))),
        ("lean-nerf", "feature", ExportPoints(num_points=100)),
        ("lean-nerf", "feature", ExportSplats(num_points=100)),
    ],
)
def test_what_overflows_is_not_exported(method: str, weights: str, what: Any, folders: Folders, tmp_path: Path) -> None:
    run = Path(shutil.copytree(folders.folder / "runs" / method, tmp_path / "run"))

    def overflow(state: dict[str, Any]) -> None:
        for name, value in state["model"].items():
            if weights in name:
                value.reshape(-1)[::2] = 3e38
                value.reshape(-1)[1::2] = -3e38

    change_state(run, overflow)
    with pytest.raises(FloatingPointError, match="not finite"):
        Export(run, what).run()
    assert not what.output_path.exists()


@pytest.mark.parametrize("far", ["position", "scale"])
def test_a_path_far_away_is_refused(far: str, folders: Folders, tmp_path: Path, edge_se: Any) -> None:
    paths = Path(shutil.copytree(folders.folder / "paths", tmp_path / "paths"))
    path, dataparser = paths / "camera_path.json", paths / "dataparser_transforms.json"
    content, transforms = json.loads(path.read_text()), json.loads(dataparser.read_text())
    if far == "position":
        content["camera_path"][0]["camera_to_world"][3] = 1e300
    else:
        transforms["scale"] = 1e-310
    path.write_text(json.dumps(content))
    dataparser.write_text(json.dumps(transforms))
    flags = "--camera-path", path, "--dataparser-transforms", dataparser, "--output-path", tmp_path / "frames"
    check_refused(edge_se("render", folders.runs[0], *flags), "too far away")
    assert not (tmp_path / "frames").exists()
