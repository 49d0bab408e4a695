"""What a config leaves open is decided by the data; what makes no sense is refused by its flag's name."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny import tiny_views

from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.session import resolve_config
from edge_se_sampler.errors import InputError
from edge_se_sampler.models.config import NeRFModelConfig

NAN, INF = float("nan"), float("inf")


def of_size(height: int, width: int) -> Views:
    return dataclasses.replace(tiny_views(1), images=(np.zeros((height, width, 3), dtype=np.uint8),))


def config_with(flag: str, value: Any) -> TrainerConfig:
    """A config in which a flag of the command line, pipeline.model.near for one, has a value."""
    *parents, name = flag.replace("-", "_").split(".")

    def changed(config: Any, path: list[str]) -> Any:
        if not path:
            return dataclasses.replace(config, **{name: value})
        return dataclasses.replace(config, **{path[0]: changed(getattr(config, path[0]), path[1:])})

    return changed(TrainerConfig(), parents)


@pytest.mark.parametrize(
    ("height", "width", "size"),
    [(1, 1, "tiny"), (100, 128, "tiny"), (129, 5, "small"), (5, 129, "small"), (256, 256, "small"), (257, 1, "paper"),
     (800, 800, "paper")],
)  # fmt: skip
def test_the_longer_side_decides_the_size(height: int, width: int, size: str) -> None:
    assert resolve_config(TrainerConfig(), of_size(height, width)).pipeline.model.size == size


def test_the_largest_image_decides() -> None:
    images = tuple(np.zeros((side, 10, 3), dtype=np.uint8) for side in (20, 300, 40))
    views = dataclasses.replace(tiny_views(3), images=images)
    assert resolve_config(TrainerConfig(), views).pipeline.model.size == "paper"


def test_the_papers_size_is_the_papers() -> None:
    resolved = resolve_config(config_with("pipeline.model.size", "paper"), of_size(8, 8))
    model = resolved.pipeline.model
    assert isinstance(model, NeRFModelConfig)
    assert (model.depth, model.width) == (8, 256)
    assert (model.position_frequencies, model.direction_frequencies) == (10, 4)
    assert (model.num_coarse_samples, model.num_importance_samples) == (64, 128)
    assert (resolved.max_num_iterations, resolved.optimizer.lr) == (200_000, 5e-4)
    assert resolved.pipeline.datamanager.train_num_rays_per_batch == 1024


@pytest.mark.parametrize("size", ["auto", "paper", "small", "tiny"])
def test_nothing_is_left_open(size: Any) -> None:
    resolved = resolve_config(config_with("pipeline.model.size", size), of_size(8, 8))

    def left_open(config: Any) -> list[str]:
        fields = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
        nested = [name for value in fields.values() if dataclasses.is_dataclass(value) for name in left_open(value)]
        return nested + [name for name, value in fields.items() if value is None or value == "auto"]

    assert left_open(resolved) == [
        *("device_type", "data", "data_format", "eval_every", "num_views", "views"),  # a folder decides two of these
        *("new_num_iterations", "time_budget", "segments", "max_seconds", "patience"),
    ]
    assert (
        resolve_config(resolved, of_size(800, 800)) == resolved
    )  # planning what is planned changes nothing, whatever the data


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("pipeline.model.width", 6),
        ("pipeline.model.position-frequencies", 0),
        ("pipeline.model.num-coarse-samples", 3),
        ("pipeline.datamanager.train-num-rays-per-batch", 1),
        ("max-num-iterations", 1),
        ("steps-per-eval-image", 7),
        ("optimizer.lr", 0.5),
        ("experiment-name", "mine"),
    ],
)
def test_what_was_given_stays(flag: str, value: Any) -> None:
    given, free = (
        resolve_config(config_with(flag, value), of_size(8, 8)),
        resolve_config(TrainerConfig(), of_size(8, 8)),
    )
    assert given == resolve_config(given, of_size(8, 8))
    found: Any = given
    for name in flag.replace("-", "_").split("."):
        found = getattr(found, name)
    assert found == value
    assert given != free


def test_the_given_config_is_not_changed() -> None:
    config = TrainerConfig()
    resolve_config(config, of_size(8, 8))
    assert config == TrainerConfig()
    assert config.pipeline.datamanager.train_num_rays_per_batch is None


def test_the_experiment_is_named_after_the_data(tmp_path: Path) -> None:
    (tmp_path / "lego").mkdir()
    assert resolve_config(config_with("data", tmp_path / "lego"), of_size(8, 8)).experiment_name == "lego"
    assert resolve_config(config_with("data", tmp_path / "lego" / "x" / ".."), of_size(8, 8)).experiment_name == "lego"


def test_a_preview_is_due_ten_times() -> None:
    for iterations, every in ((2000, 200), (25, 2), (9, 1), (1, 1)):
        resolved = resolve_config(config_with("max-num-iterations", iterations), of_size(8, 8))
        assert resolved.steps_per_eval_image == every


REFUSED = [
    ("max-num-iterations", [0, -1]),
    ("steps-per-save", [0, -1]),
    ("steps-per-eval-image", [0, -1]),
    ("steps-per-log", [0, -1]),
    ("pipeline.datamanager.train-num-rays-per-batch", [0, -1]),
    ("pipeline.model.width", [0, -1]),
    ("pipeline.model.depth", [0, -1]),
    ("pipeline.model.num-importance-samples", [0, -1]),
    ("pipeline.model.num-coarse-samples", [2, 0, -1]),
    ("pipeline.model.position-frequencies", [-1, 25]),
    ("pipeline.model.direction-frequencies", [-1, 25]),
    ("pipeline.model.near", [-0.1, 6.0, 7.0, NAN, INF]),
    ("pipeline.model.far", [2.0, 1.0, NAN, INF]),
    ("pipeline.model.density-noise", [-0.1, NAN, INF]),
    ("max-seconds", [0.0, -1.0, NAN]),
    ("optimizer.lr", [0.0, -1.0, NAN, INF]),
    ("optimizer.final-fraction", [0.0, -1.0, 1.5, NAN]),
    ("optimizer.eps", [-1e-8]),
    ("experiment-name", ["a/b", "..", ".", "a\0b", "/"]),
]


@pytest.mark.parametrize(("flag", "value"), [(flag, value) for flag, values in REFUSED for value in values])
def test_a_value_without_meaning_is_refused_by_its_flag(flag: str, value: Any) -> None:
    with pytest.raises(InputError) as refusal:
        resolve_config(config_with(flag, value), of_size(8, 8))
    assert f"--{flag}" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("value", [NAN, INF])
def test_an_endless_epsilon_is_refused(value: float) -> None:
    with pytest.raises(InputError, match=r"--optimizer\.eps"):
        resolve_config(config_with("optimizer.eps", value), of_size(8, 8))


def test_a_width_that_leaves_the_direction_no_neuron_is_refused() -> None:
    with pytest.raises(InputError, match=r"--pipeline\.model\.width"):
        resolve_config(config_with("pipeline.model.width", 1), of_size(8, 8))


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("pipeline.model.near", 0.0),
        ("pipeline.model.density-noise", 0.0),
        ("pipeline.model.position-frequencies", 24),
        ("pipeline.model.width", 2),
        ("optimizer.final-fraction", 1.0),
        ("optimizer.eps", 0.0),
        ("max-seconds", 1e-3),
        ("experiment-name", "a b.c"),
    ],
)
def test_the_ends_of_a_range_are_taken(flag: str, value: Any) -> None:
    resolve_config(config_with(flag, value), of_size(8, 8))
