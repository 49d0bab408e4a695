"""nerfstudio on copies of captures: our readers' views, but for the motion and scale that it gives every scene."""
# pyright: reportMissingImports=false

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

from capture_folder import OPENCV, write_transforms  # noqa: E402

from edge_se_sampler.bench.baselines.folders import copied_scene  # noqa: E402
from edge_se_sampler.bench.nerfstudio.host import build_config  # noqa: E402
from edge_se_sampler.data.camera_path import read_camera_path, undo_dataparser  # noqa: E402
from edge_se_sampler.data.dataset import DataSettings, read_split  # noqa: E402


@pytest.mark.parametrize("split", ["train", "test"])
def test_pixels_and_rays_are_ours(split: Any, tmp_path: Path) -> None:
    from nerfstudio.data.datasets.base_dataset import InputDataset

    write_transforms(tmp_path / "scene", OPENCV)
    views = read_split(tmp_path / "scene", split, DataSettings(downscale=2))
    assert views is not None
    copy = copied_scene(tmp_path / "work", tmp_path / "scene", downscale=2)
    parser = build_config("nerfacto", 0, copy, tmp_path / "runs").pipeline.datamanager.dataparser
    parser.data = copy
    outputs = parser.setup().get_dataparser_outputs(split)
    dataset = InputDataset(outputs)
    rotation, translation = outputs.dataparser_transform.double().split((3, 1), dim=1)
    assert len(dataset) == len(views.names)
    for i, image in enumerate(views.images):
        np.testing.assert_array_equal(np.rint(dataset[i]["image"].numpy() * 255), image)
        theirs, ours = outputs.cameras.generate_rays(camera_indices=i).flatten(), views.cameras.image_rays(i)
        torch.testing.assert_close(theirs.directions.double(), ours.directions @ rotation.T, atol=1e-5, rtol=0)
        moved = outputs.dataparser_scale * (ours.origins @ rotation.T + translation.T)
        torch.testing.assert_close(theirs.origins.double(), moved, atol=1e-5, rtol=0)


@pytest.mark.parametrize("applied", [{}, {"applied_transform": [[0, 1, 0, 1], [1, 0, 0, 2], [0, 0, -1, 3]]}])
def test_a_path_through_its_cameras_leads_through_ours(applied: dict[str, Any], tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    scene = write_transforms(folder) | applied | {"applied_scale": 2.0}
    (folder / "transforms.json").write_text(json.dumps(scene))
    views = read_split(folder, "train", DataSettings(eval_every=1000))
    assert views is not None
    parser = build_config("nerfacto", 0, folder, tmp_path / "runs").pipeline.datamanager.dataparser
    parser.data, parser.eval_mode = folder, "all"
    outputs = parser.setup().get_dataparser_outputs("train")
    outputs.save_dataparser_transform(tmp_path / "dataparser_transforms.json")
    path = {"render_height": 4, "render_width": 4, "camera_path": []}
    names = [name.name for name in outputs.image_filenames]
    for name in views.names:
        pose = outputs.cameras.camera_to_worlds[names.index(Path(name).name)]
        matrix = [*pose.ravel().tolist(), 0, 0, 0, 1]
        path["camera_path"].append({"camera_to_world": matrix, "fov": 50})
    (tmp_path / "camera_path.json").write_text(json.dumps(path))
    drawn = read_camera_path(tmp_path / "camera_path.json")
    ours = undo_dataparser(drawn, tmp_path / "dataparser_transforms.json", folder, "auto").cameras.camera_to_worlds
    torch.testing.assert_close(ours, views.cameras.camera_to_worlds, atol=1e-5, rtol=0)
