"""The bench inside nerfstudio, as far as it can be tested without it: what counts as a failure, and what is kept."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from edge_se_sampler.bench.nerfstudio import _begun, _failures
from edge_se_sampler.errors import InputError


def run(method: str, psnr: float, share: float) -> dict:
    return {"method": method, "psnr": psnr, "background_psnr": 20.0, "foreground_share": share}


def test_failures_are_counted_by_kind() -> None:
    runs = [
        run("vanilla-nerf", 20.0, 1.0),  # nothing but background
        run("vanilla-nerf", 20.4, 0.8),  # on its way, but no better than the background yet
        run("vanilla-nerf", 20.6, 0.8),
        run("vanilla-nerf", 20.6, 0.95),  # a better background, and no object
        run("edge-se-nerf", 25.0, 0.2),
    ]
    told = _failures(runs)
    assert told["vanilla-nerf"] == {"runs": 4, "at_background": 2, "failed": 3, "mean_psnr": pytest.approx(20.4)}
    assert told["edge-se-nerf"] == {"runs": 1, "at_background": 0, "failed": 0, "mean_psnr": 25.0}


def test_a_result_of_other_settings_is_neither_continued_nor_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    path.write_text(json.dumps({"settings": {"offset": [0.2, 0.1]}, "runs": [1]}))
    assert _begun(path, {"offset": (0.2, 0.1)})["runs"] == [1]
    with pytest.raises(InputError, match=r"result.json: is of other settings"):
        _begun(path, {"offset": (0.3, 0.1)})
