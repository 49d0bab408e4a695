"""What reads settings need not wait for torch, and the sampling core knows no files, no host, no command line."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {"torch", "cv2", "matplotlib", "tyro", "imageio", "nerfstudio"}


@pytest.mark.parametrize(
    ("module", "allowed"),
    [
        ("errors", set()),
        ("sampling.random_streams", set()),
        ("protocol", set()),
        ("sampling.settings", set()),
        ("methods", {"tyro"}),
        ("sampling.edges", {"cv2"}),
        ("sampling.distribution", {"torch"}),
        ("sampling.scoring", {"torch", "cv2"}),  # and image_batch, pixel_sampler
    ],
)
def test_importing_a_module_loads_only_what_it_needs(module: str, allowed: set[str]) -> None:
    code = f"import sys, edge_se_sampler.{module}; print(*sys.modules)"
    loaded = set(
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    )
    assert f"edge_se_sampler.{module}" in loaded
    assert loaded & HEAVY == allowed
    if module != "methods":  # the core stays below data, engine, nerf and the command line
        ours = {name.split(".")[1] for name in loaded if name.startswith("edge_se_sampler.")}
        assert not ours & {"data", "engine", "models", "occupancy", "cli", "bench", "methods"}
