"""Synthetic scenes: the same pixels everywhere."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from edge_se_sampler.data.synthetic.cameras import framing, poses
from edge_se_sampler.data.synthetic.catalogue import SCENE_NAMES, synthetic_scene
from edge_se_sampler.data.synthetic.linear import unit
from edge_se_sampler.data.synthetic.render import render
from edge_se_sampler.data.synthetic.shading import radiance
from edge_se_sampler.data.synthetic.visibility import first_hits

# sha256 of the pixels of one 32 x 32 view. A change here changes every synthetic picture that anyone has.
PIXELS = {
    "chair": "058f25527133d9a9ea63d6b54c17df324fa094bdbeb5f6845821e6aff463569c",
    "drums": "12828348bfba12172c76484d6895f4eba8d55954431ec4607f68f10bb5609266",
    "ficus": "4027c89f2c08b21fc9ffcb5b6ee78e8bdc206fd20d707c2ac8be4d568997c40b",
    "hotdog": "c6865cb543faad8d90a672f414c0a6fa2a427688d63ac1ce7f34ca4279169542",
    "bricks": "ad826fcf3a00a2a50ee8afb627fed9fe738759e87ec9268e224f70da1460154e",
    "materials": "3939db3f5dd28672dfb44809fe1d536f360cba8ff6ec6ffcdae7b8d497136b68",
    "mic": "80534b94aac43544718fd541f39d6bebcd7c30638cce24ad6cc639010a8f41af",
}


def digest(*arrays: np.ndarray) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def small_picture(name: str) -> np.ndarray:
    return render(synthetic_scene(name), framing(32).camera(poses("train", 1)[0]))


def float_digest(name: str) -> str:
    """Of every float64 on the way to the pixels: an eighth bit hides most differences, these bits hide none."""
    scene = synthetic_scene(name)
    camera = framing(48).camera(poses("val", 2)[1])
    depth, seen = first_hits(scene, camera, 1)
    rows, columns = np.nonzero(seen >= 0)
    x, y = camera.sample_slopes(1)
    rotation = camera.to_world[:3, :3]
    rays = rotation[:, 0, None] * x[columns] + rotation[:, 1, None] * y[rows] - rotation[:, 2, None]
    points = camera.to_world[:3, 3:4] + depth[rows, columns] * rays
    light = radiance(scene, seen[rows, columns], points, unit(rays))
    return digest(camera.to_world, scene.to_world, scene.to_local, depth, seen, light)


@pytest.mark.parametrize("name", SCENE_NAMES)
def test_pixels_are_bit_identical_to_the_recorded_ones(name: str) -> None:
    assert digest(small_picture(name)) == PIXELS[name]


def test_pixels_do_not_depend_on_the_cpu() -> None:
    core = importlib.import_module("numpy._core" if hasattr(np, "_core") else "numpy.core")
    umath = core._multiarray_umath
    extras = [feature for feature in umath.__cpu_dispatch__ if umath.__cpu_features__[feature]]
    if not extras:
        pytest.skip("this CPU has nothing to switch off")
    report = (
        "import sys, json, tests.test_synthetic_pixels as t\n"
        "umath = t.importlib.import_module(sys.argv[1])._multiarray_umath\n"
        "on = [f for f in umath.__cpu_dispatch__ if umath.__cpu_features__[f]]\n"
        "print(json.dumps([on, {n: [t.digest(t.small_picture(n)), t.float_digest(n)] for n in t.SCENE_NAMES}]))\n"
    )
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(extras)}
    command = [sys.executable, "-W", "ignore", "-c", report, core.__name__]
    root = Path(__file__).parent.parent
    done = subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=True)
    still_on, without = json.loads(done.stdout)
    assert still_on == []
    assert without == {name: [PIXELS[name], float_digest(name)] for name in SCENE_NAMES}


def test_importing_needs_no_torch() -> None:
    code = "import sys, edge_se_sampler.data.synthetic; print({'torch', 'cv2', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
