"""What importing a module loads: reading settings need not wait for torch, and sampling knows no files or hosts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = "edge_se_sampler"
HEAVY = {"torch", "cv2", "matplotlib", "tyro", "imageio", "nerfstudio"}


def modules_loaded_by(code: str) -> set[str]:
    """Modules that a new process has loaded after running some code."""
    command = [sys.executable, "-c", f"{code}\nimport sys\nprint(*sys.modules)"]
    return set(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1].split())


@pytest.mark.parametrize(
    ("module", "allowed"),
    [
        ("errors", set()),
        ("protocol", set()),
        ("sampling.random_streams", set()),
        ("sampling.settings", set()),
        ("methods", {"tyro"}),
        ("sampling.edges", {"cv2"}),
        ("sampling.distribution", {"torch"}),
        ("sampling.scoring", {"torch", "cv2"}),  # and all else in sampling
    ],
)
def test_importing_a_module_loads_only_what_it_needs(module: str, allowed: set[str]) -> None:
    loaded = modules_loaded_by(f"import {PACKAGE}.{module}")
    assert f"{PACKAGE}.{module}" in loaded
    assert loaded & HEAVY == allowed


def test_sampling_loads_no_files_networks_or_hosts() -> None:
    modules = [
        f"{PACKAGE}.sampling.{path.stem}"
        for path in (Path(__file__).parent.parent / PACKAGE / "sampling").glob("[!_]*.py")
    ]
    loaded = modules_loaded_by(f"import {', '.join(modules)}")
    assert loaded >= set(modules)
    layers = {name.split(".")[1] for name in loaded if name.startswith(f"{PACKAGE}.")}
    assert layers == {"errors", "protocol", "sampling"}
