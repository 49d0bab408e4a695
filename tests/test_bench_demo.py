"""`edge-se demo`, a short one on small images."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from edge_se_sampler.bench import demo
from edge_se_sampler.engine.rendering import Picture


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "SCENE", demo.SCENE | {"size": 24})
    monkeypatch.setattr(demo, "SPLITS", {"num_train": 3, "num_val": 1, "num_test": 2})
    monkeypatch.setattr(demo, "ITERATIONS", 20)
    monkeypatch.setattr(demo, "TIME_BUDGET", "1")
    monkeypatch.setattr(demo, "TURN", 3)
    monkeypatch.setattr(demo, "compiled_ops", lambda: None)


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_the_demo_prints_its_result_and_leaves_pictures_a_page_and_a_json(tmp_path: Path, edge_se: Any) -> None:
    answer = edge_se("demo", "--output-dir", tmp_path / "seed-3", "--seed", 3)
    assert answer.code == 0, answer
    names = {"demo.html", "demo.png", "demo.gif", "demo.json", "demo"}
    assert {path.name for path in (tmp_path / "seed-3").iterdir()} == names
    result = json.loads((tmp_path / "seed-3" / "demo.json").read_text())
    methods = result["methods"]
    page = (tmp_path / "seed-3" / "demo.html").read_text()
    assert list(methods) == ["vanilla-nerf", "edge-se-nerf", "lean-nerf"]
    for method, label in demo.METHODS.items():
        measured = methods[method]
        shown = f"{measured['results']['psnr']:.2f} dB"
        assert f"{label}: {shown}" in answer.out
        row = next(line for line in page.splitlines() if f"({method})</td>" in line)  # settings are printed, too
        values = (
            shown,
            measured["model"],
            measured["pixels"],
            f"{measured['steps']:,} of {measured['rays_per_step']:,}",
        )
        assert all(value in row for value in (*values, f"{measured['training_seconds']:.1f} s"))
    assert methods["vanilla-nerf"]["steps"] == methods["edge-se-nerf"]["steps"] == 20
    assert 0.5 < methods["lean-nerf"]["training_seconds"] < 5
    assert methods["lean-nerf"]["results"]["psnr"] > result["background_psnr"] + 1
    assert iio.imread(tmp_path / "seed-3" / "demo.gif", index=None).shape == (3, 240, 240, 3)
    _check_self_contained(page, (tmp_path / "seed-3" / "demo.gif").read_bytes())
    pictures, box = {name: np.ones((8, 8, 3)) for name in ("truth", *methods)}, (slice(4), slice(4))
    with_numba = demo._page(tmp_path / "seed-3" / "demo.gif", result | {"numba": True}, pictures, box)
    assert ["numba is not installed" in text for text in (page, with_numba)] == [True, False]
    strange = demo._page(tmp_path / "seed-3" / "demo.gif", result | {"command": "edge-se demo '<b>&'"}, pictures, box)
    assert "edge-se demo &#x27;&lt;b&gt;&amp;&#x27;" in strange


def _check_self_contained(page: str, gif: bytes) -> None:
    """All of its images are in it: each view whole and enlarged, and the turn."""
    sources = re.findall(r'<(?:img|script|link|iframe)[^>]* (?:src|href)="([^"]*)"', page)
    assert len(sources) == 2 * (1 + len(demo.METHODS)) + 1
    contents = [base64.b64decode(source.split(";base64,")[1]) for source in sources]
    assert all(source.startswith("data:image/") for source in sources)
    assert contents[-1] == gif
    whole = [iio.imread(io.BytesIO(content), extension=".png") for content in contents[1:-1:2]]
    assert [image.shape for image in whole] == [(24, 24, 3)] * 4
    assert len({image.tobytes() for image in whole}) == 4  # of four
    assert not re.search(r"\$\w|url\(|@import", page)


def test_the_enlarged_part_is_a_square_around_the_object() -> None:
    image = np.zeros((40, 60, 4), dtype=np.float32)
    image[25:39, 50:58, 3] = 0.5
    rows, columns = demo._object_box(Picture("", image, camera=None))  # pyright: ignore[reportArgumentType]
    inside = image[rows, columns]
    assert inside.shape == (15, 15, 4)
    assert inside.sum() == image.sum()
