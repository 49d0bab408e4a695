"""The whole host: lenses of lean-nerf's training images are undone, or refused."""
# pyright: reportMissingImports=false

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

from capture_folder import COLUMN_STEP, FX, HEIGHT, OPENCV, ROW_STEP, WIDTH, Distortion, write_transforms  # noqa: E402
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig  # noqa: E402

from edge_se_sampler.errors import InputError  # noqa: E402
from edge_se_sampler.nerfstudio.training_images import TrainingImages  # noqa: E402


def capture(folder: Path, distortion: Distortion) -> Any:
    """The data parser's training views of a capture whose colors are their pixels' coordinates, with masks: True in the
    left half."""
    document = write_transforms(folder, distortion)
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[:, : WIDTH // 2] = 255
    iio.imwrite(folder / "mask.png", mask)
    document["frames"] = [frame | {"mask_path": "mask.png"} for frame in document["frames"]]
    (folder / "transforms.json").write_text(json.dumps(document))
    parser = NerfstudioDataParserConfig(data=folder, downscale_factor=1, eval_mode="all").setup()
    return parser.get_dataparser_outputs("train")


def test_a_lens_is_undone_as_nerfstudios_rays_bend(tmp_path: Path) -> None:
    """What a pinhole shows at a pixel is what nerfstudio's ray, through that pixel of the image as it was, meets."""
    outputs = capture(tmp_path, OPENCV)
    images = TrainingImages(outputs)
    images.keep_alpha()
    views = images.read_views()
    image = views.images[1].astype(np.float64)
    rows, columns = slice(4, -4), slice(4, -4)
    coords = torch.from_numpy(np.stack((image[..., 1] / ROW_STEP, image[..., 0] / COLUMN_STEP), axis=2)).float() + 0.5
    bent = outputs.cameras[1:2].generate_rays(torch.zeros((*coords.shape[:2], 1), dtype=torch.long), coords)
    straight = views.cameras.image_rays(1).directions.reshape(*coords.shape[:2], 3).float()
    stored = outputs.cameras[1:2].generate_rays(0, keep_shape=True, disable_distortion=True)
    off, undone = (
        (bent.directions - other)[rows, columns].norm(dim=2).max() for other in (straight, stored.directions)
    )
    assert off < 0.25 / FX  # of a pixel: colors are rounded
    assert undone > 0.5 / FX
    assert views.masks is not None
    left = coords[..., 1].numpy() - WIDTH // 2  # of the middle, which is not a pixel's center
    assert views.masks[1][left < -0.6].all()
    assert not views.masks[1][left > -0.4].any()


@pytest.mark.parametrize(
    ("distortion", "message"),
    [
        (Distortion("OPENCV_FISHEYE", {"k1": 0.05}), "perspective cameras"),
        (Distortion("OPENCV", {"k1": 0.0, "k4": 0.1}), "fourth radial"),
    ],
)
def test_lenses_that_it_cannot_undo_are_refused(distortion: Distortion, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        TrainingImages(capture(tmp_path, distortion))


def test_rgb_images_among_rgba_ones_are_opaque_and_all_are_composited_where_they_are_looked_at(tmp_path: Path) -> None:
    document = write_transforms(tmp_path)
    colors = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    clear = np.dstack((colors, np.zeros((HEIGHT, WIDTH), np.uint8)))
    for frame, image in zip(document["frames"], (colors, clear), strict=False):
        iio.imwrite(tmp_path / frame["file_path"], image)
    parser = NerfstudioDataParserConfig(data=tmp_path, downscale_factor=1, eval_mode="all").setup()
    outputs = parser.get_dataparser_outputs("train")
    outputs.alpha_color = torch.ones(3)
    images = TrainingImages(outputs)
    assert [images[i]["image"].mean().item() for i in range(2)] == pytest.approx([200 / 255, 1.0])
    images.keep_alpha()
    assert {images[i]["image"].shape[2] for i in range(len(images))} == {4}
    assert [images[i]["image"][..., 3].mean().item() for i in range(2)] == [1, 0]
