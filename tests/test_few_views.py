"""Training on a few of the views: which ones, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_folder import write_colmap
from tiny import tiny_views

from edge_se_sampler.data.capture import Capture
from edge_se_sampler.data.colmap import read_colmap
from edge_se_sampler.data.dataset import READERS
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.session import read_train_views, select_views
from edge_se_sampler.errors import InputError


def test_num_views_picks_the_views_of_infonerfs_code() -> None:
    """From its own run: numpy.random.RandomState(0).permutation(100)[:10]."""
    assert select_views(TrainerConfig(num_views=10), 100) == [26, 86, 2, 55, 75, 93, 16, 73, 54, 95]
    assert select_views(TrainerConfig(num_views=4), 100) == [26, 86, 2, 55]
    assert sorted(select_views(TrainerConfig(num_views=7), 7) or []) == list(range(7))
    assert select_views(TrainerConfig(), 7) is None
    assert select_views(TrainerConfig(views=(5, 0, 3)), 7) == [5, 0, 3]


def test_points_are_those_of_the_chosen_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(folder: Path) -> Capture:
        capture = read_colmap(folder)
        return replace(capture, points=[np.full((1, 3), float(i)) for i in range(len(capture.frames))])

    monkeypatch.setitem(READERS, "colmap", read)
    write_colmap(tmp_path / "capture")
    everything, few = (read_train_views(TrainerConfig(data=tmp_path / "capture", views=v)) for v in (None, (1, 0)))
    assert everything.points is not None
    assert few.points is not None
    assert few.names == (everything.names[1], everything.names[0])
    for found, expected in zip(few.points, (everything.points[1], everything.points[0]), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_subset_keeps_every_field() -> None:
    views = replace(tiny_views(4, 8, 6), masks=tuple(np.full((8, 6), i > 1) for i in range(4)))
    few = views.subset([3, 1])
    assert few.names == (views.names[3], views.names[1])
    assert few.masks is not None
    assert (few.masks[0].all(), few.masks[1].any()) == (True, False)
    np.testing.assert_array_equal(few.images[0], views.images[3])
    for key, values in vars(views.cameras).items():
        np.testing.assert_array_equal(getattr(few.cameras, key), values[[3, 1]])


def test_a_run_reads_only_the_chosen_views(scene: Path) -> None:
    everything = read_train_views(TrainerConfig(data=scene))
    few = read_train_views(TrainerConfig(data=scene, views=(2,)))
    assert few.names == everything.names[2:]
    assert len(read_train_views(TrainerConfig(data=scene, num_views=2)).names) == 2
    first = scene / "train" / "r_0.png"
    first.write_bytes(first.read_bytes()[:100])  # a header; no pixel, which nobody asks for
    assert read_train_views(TrainerConfig(data=scene, views=(2,))).names == few.names


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"num_views": 0}, "--num-views is 0: must be between 1 and 3"),
        ({"num_views": 4}, "--num-views is 4: must be between 1 and 3"),
        ({"num_views": 2, "views": (1,)}, "--num-views and --views: give one of them"),
        ({"views": ()}, "at least one of the training views"),
        ({"views": (1, 1)}, "each once"),
        ({"views": (0, 3)}, "the training views 0 to 2"),
        ({"views": (-1,)}, "the training views 0 to 2"),
    ],
)
def test_invalid_choices_are_refused(choice: dict[str, Any], message: str, scene: Path) -> None:
    with pytest.raises(InputError, match=message):
        read_train_views(replace(TrainerConfig(data=scene), **choice))
