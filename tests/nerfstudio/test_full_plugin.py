"""The whole host's plugin loading: light, and harmless to everybody else's methods."""
# pyright: reportMissingImports=false

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import distributions, version
from typing import Any

import pytest

pytestmark = pytest.mark.nerfstudio_full
pytest.importorskip("nerfstudio.engine.trainer", reason="needs all of nerfstudio 1.1.5")

OURS = {"edge-nerf", "edge-se-nerf", "se-nerf", "precrop-nerf", "precrop-se-nerf", "edge-se-nerfacto", "lean-nerf"}


def answer(code: str) -> tuple[Any, str]:
    """What a fresh interpreter's last printed line says, as json, and its stderr."""
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


DUMP = """
import json, yaml
from nerfstudio.configs.method_configs import all_methods
print(json.dumps({name: yaml.dump(config) for name, config in all_methods.items()}))
"""
WITHOUT_US = """
import importlib.metadata as metadata
found = metadata.entry_points
def entry_points(**chosen):
    if chosen.get("group") != "nerfstudio.method_configs":
        return found(**chosen)
    return metadata.EntryPoints(p for p in found(**chosen) if not p.value.startswith("edge_se_sampler"))
metadata.entry_points = entry_points
import nerfstudio.plugins.registry as registry
registry.entry_points = entry_points
"""
BROKEN = """
import sys
sys.modules["edge_se_sampler.nerfstudio.plugin"] = None
"""


def test_stock_configurations_are_the_same_with_and_without_us() -> None:
    with_us, complaints = answer(DUMP)
    assert "edge-se-sampler" not in complaints
    without_us, _ = answer(WITHOUT_US + DUMP)
    assert set(with_us) - set(without_us) == OURS
    assert {name: text for name, text in with_us.items() if name not in OURS} == without_us


def test_when_ours_fails_to_load_the_others_stay_and_one_line_says_so() -> None:
    broken, complaints = answer(BROKEN + DUMP)
    without_us, _ = answer(WITHOUT_US + DUMP)
    assert broken == without_us
    assert sum("edge-se-sampler: its methods are left out" in line for line in complaints.splitlines()) == 1
    assert "Traceback" not in complaints


def test_the_plugin_is_light() -> None:
    """It loads while nerfstudio loads its methods: no circle, and half a second at most beyond what they need."""
    took, _ = answer(
        WITHOUT_US + "import nerfstudio.configs.method_configs, time, json\n"
        "began = time.process_time()\n"
        "import edge_se_sampler.nerfstudio.entry_points as e\n"
        "took = time.process_time() - began\n"
        "assert e.edge_se_nerf is not None\n"
        "print(json.dumps(took))"
    )
    assert took < 0.5
    imported, _ = answer(
        "import edge_se_sampler.nerfstudio.entry_points as e, sys, json\n"
        "assert e.edge_se_nerf is not None\n"
        "print(json.dumps('nerfstudio.configs.method_configs' in sys.modules))"
    )
    assert imported is False


def test_nerfstudios_own_cv2_is_the_only_one() -> None:
    ships = {d.metadata["Name"] for d in distributions() if any(f.parts[0] == "cv2" for f in d.files or [])}
    assert ships == {"opencv-python-headless"}
    assert version("opencv-python-headless") == "4.10.0.84"
