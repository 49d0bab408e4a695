"""Names that can be imported from the package itself, and that nothing heavy is loaded before they are used."""

from __future__ import annotations

import subprocess
import sys

import pytest

import edge_se_sampler

HEAVY = {"torch", "cv2", "matplotlib", "imageio", "nerfstudio"}


def loaded_by(*command: str) -> set[str]:
    """Modules that python has loaded once it has run this command."""
    answer = subprocess.run([sys.executable, "-X", "importtime", *command], capture_output=True, text=True, check=True)
    lines = [line for line in answer.stderr.splitlines() if line.startswith("import time:")]
    return {line.split("|")[-1].strip() for line in lines}


@pytest.mark.parametrize("name", [*edge_se_sampler._MODULES, "__version__"])
def test_every_name_can_be_imported(name: str) -> None:
    value = getattr(edge_se_sampler, name)
    assert getattr(value, "__name__", name).strip("_") == name.strip("_")
    assert name in dir(edge_se_sampler)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'edge_se_sampler' has no attribute 'edge_strenght'"):
        _ = edge_se_sampler.edge_strenght  # pyright: ignore[reportAttributeAccessIssue]


def test_importing_the_package_loads_nothing_heavy_and_using_a_name_loads_what_it_needs() -> None:
    assert not loaded_by("-c", "import edge_se_sampler") & (HEAVY | {"numpy", "tyro"})
    loaded = loaded_by("-c", "from edge_se_sampler import edge_strength")
    assert loaded & HEAVY == {"cv2"}


@pytest.mark.parametrize("arguments", [["--help"], ["train", "lean-nerf", "--help"], ["methods"]])
def test_help_does_not_load_torch(arguments: list[str]) -> None:
    loaded = loaded_by("-m", "edge_se_sampler", *arguments)
    assert "tyro" in loaded  # the measurement sees what is loaded
    assert not loaded & HEAVY
