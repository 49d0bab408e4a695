"""nerfstudio on copies of captures: our readers' views, but for the motion and scale that it gives every scene."""
# pyright: reportMissingImports=false

from __future__ import annotations

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
