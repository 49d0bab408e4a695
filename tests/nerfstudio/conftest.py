"""What the tests of the whole host share; nothing of it is touched without nerfstudio."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest

from edge_se_sampler.data.synthetic.folder import make_scenes


@pytest.fixture(scope="session")
def host_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic Blender folder: 4 training views, 2 val, 2 test, 32 x 32; and LPIPS weights to load."""
    if importlib.util.find_spec("nerfstudio") is None or importlib.util.find_spec("torchvision") is None:
        pytest.skip("needs all of nerfstudio 1.1.5")
    from full_host import without_lpips_downloads

    # nerfstudio's checkpoints of scheduled methods hold numpy scalars, which torch >= 2.6 refuses without this
    os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"
    os.environ["TORCH_HOME"] = str(tmp_path_factory.mktemp("torch"))
    without_lpips_downloads()
    return make_scenes(
        tmp_path_factory.mktemp("synthetic"), ["mic"], size=32, num_train=4, num_val=2, num_test=2, placement="shifted"
    )[0]
