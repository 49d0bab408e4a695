"""The voxel model: how it begins, what it renders, and its loss."""

from __future__ import annotations

import builtins
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from lean_models import VIEWS, config_of, full_model, steps_of
from tiny import ball_views, tiny_rays, tiny_trainer

from edge_se_sampler.data.cameras import RayBundle
from edge_se_sampler.data.views import Views
from edge_se_sampler.engine.pipeline import load_weights
from edge_se_sampler.engine.rendering import render_outputs, render_rays
from edge_se_sampler.errors import InputError
from edge_se_sampler.models import lean, voxel_backend, voxel_ops
from edge_se_sampler.models.config import LeanModelConfig
from edge_se_sampler.models.lean import INITIAL_DEPTH_CARVED, INITIAL_RAW_DENSITY, LeanModel
from edge_se_sampler.models.ray_spans import find_spans
from edge_se_sampler.models.voxel_ops import RaySpans
from edge_se_sampler.occupancy.bricks import BrickGrid


def test_a_training_that_sees_nothing_at_all_is_an_error() -> None:
    """Not an empty image at its end."""
    model = full_model()
    assert not model.update_cells(0.19, 0.21)  # the level has just ended
    with pytest.raises(FloatingPointError, match="no cell has anything"):
        model.update_cells(0.21, 0.22)


@pytest.mark.parametrize("size", [8, 64])
def test_the_first_fog_is_sampled_however_many_cells_a_box_has(size: int) -> None:
    model = full_model(torch.ones((size, size, size), dtype=torch.bool))
    assert float(model.density.detach().min()) >= model.marching.density_min
    rendered = render_outputs(model, tiny_rays(100, dtype=torch.float32), ["accumulation_fine"])["accumulation_fine"]
    assert 0.2 < float(rendered.max()) < 0.99


def opaque_views() -> Views:
    views = ball_views()
    return Views(views.names, tuple(image[..., :3].copy() for image in views.images), None, views.cameras)


def test_without_masks_it_begins_with_a_thin_fog_in_all_of_the_box() -> None:
    trainer = tiny_trainer(config_of(50), opaque_views())
    model = trainer.pipeline.model
    through = render_outputs(model, tiny_rays(100, dtype=torch.float32), ["accumulation_fine"])["accumulation_fine"]
    assert 0.3 < float(through.median()) < 0.8  # 1 - exp(-1) along the box
    losses = steps_of(trainer, 50)
    assert losses[-1] < losses[0]


def test_the_fog_is_thin_in_whatever_part_of_a_box_that_masks_leave() -> None:
    """A rig of cameras on one side sees half of it."""
    cells = torch.ones((8, 8, 8), dtype=torch.bool)
    cells[:4] = False
    thin = full_model(cells).density.detach()
    assert float(thin.max()) == pytest.approx(-math.log(8 * 2**2))  # optical depth 1 across


@pytest.mark.parametrize(
    ("max_level", "expected"), [(2, INITIAL_RAW_DENSITY), (7, math.log(INITIAL_DEPTH_CARVED / (8 * 2**7)))]
)
def test_the_fog_of_carved_cells_is_dense_but_for_very_small_ones(max_level: int, expected: float) -> None:
    """So many small cells, each as dense, would hide what is behind them."""
    grid = BrickGrid.from_cells(torch.full((3,), -1.0), 0.25, torch.ones((8, 8, 8), dtype=torch.bool), max_level)
    grid.is_carved_close = True
    carved = LeanModel(LeanModelConfig(size="tiny"), np.random.default_rng(0), grid)
    torch.testing.assert_close(carved.density.detach(), torch.full((len(carved.density), 1), expected))


@pytest.mark.parametrize(("is_carved", "width"), [(True, 128), (False, 64)])
def test_the_network_is_wide_where_masks_show_an_object(is_carved: bool, width: int) -> None:
    """And as wide in what is loaded, whose grid does not say what carved it."""
    config, cells = LeanModelConfig(size="tiny"), torch.ones((8, 8, 8), dtype=torch.bool)
    grid, same = (BrickGrid.from_cells(torch.full((3,), -1.0), 0.25, cells, 2) for _ in range(2))
    grid.is_carved_close = is_carved
    model, loaded = (LeanModel(config, np.random.default_rng(i), g).eval() for i, g in enumerate((grid, same)))
    weights = [*loaded.fine.parameters()]
    load_weights(loaded, model.state_dict())
    assert model.fine.hidden.shape == loaded.fine.hidden.shape == (16, width)
    assert [id(weight) for weight in loaded.fine.parameters()] == [id(weight) for weight in weights]  # an optimizer's
    rays = tiny_rays(50, dtype=torch.float32)
    found, expected = (render_outputs(m, rays, ["rgb_fine"])["rgb_fine"] for m in (loaded, model))
    assert torch.equal(found, expected)


@pytest.mark.parametrize("width", [63, 192])
def test_a_network_of_another_width_is_refused(width: int) -> None:
    """Kernels would read beyond its end."""
    model = full_model()
    state = model.state_dict()
    for name in ("hidden", "view", "view_bias", "color"):
        value = state[f"fine.{name}"]
        state[f"fine.{name}"] = value.new_zeros((*value.shape[:-1], width))
    with pytest.raises(InputError, match="not this model's"):
        load_weights(model, state)


@pytest.mark.parametrize("changes", [{"step_size_voxels": 0.05}, {"alpha_threshold": 0.2}])
def test_the_fog_is_sampled_whatever_is_left_out(changes: dict[str, Any]) -> None:
    grid = BrickGrid.from_cells(torch.full((3,), -1.0), 0.25, torch.ones((8, 8, 8), dtype=torch.bool), 2)
    model = LeanModel(LeanModelConfig(size="tiny", **changes), np.random.default_rng(0), grid)
    assert float(model.density.detach().min()) > model.marching.density_min > INITIAL_RAW_DENSITY


@pytest.mark.parametrize(("share", "expected"), [(0.0, (2.0, 2.0, 2.0)), (0.5, (2.0, 2.5, 3.0))])
def test_rays_begin_at_a_share_of_the_way_to_the_focus(share: float, expected: tuple[float, ...]) -> None:
    """From 3, 5 and 12 away, 3 beyond where training views were at most 6 away; near is 2."""
    model = full_model(torch.ones((80, 80, 80), dtype=torch.bool))  # from -1 to 19
    model.grid.focus = torch.tensor([9.0, 9.0, 9.0, share, 6.0], dtype=torch.float64)
    origins = torch.tensor([[9.0, 9.0, 12.0], [9.0, 4.0, 9.0], [9.0 + 12.0, 9.0, 9.0]])
    directions = torch.nn.functional.normalize(9 - origins, dim=1)
    norm = {"directions_norm": torch.ones(3, 1)}
    rays = RayBundle(origins, directions, torch.zeros((3, 1), dtype=torch.int64), norm)
    spans = find_spans(rays, 1, model.grid, model.config.depths, 1.0)
    begin = spans.begin * float(model.grid.cell_size)
    torch.testing.assert_close(begin, torch.tensor(expected))


@pytest.mark.parametrize("component", [0.0, -0.0, 1e-20, 1e-39])
def test_rays_along_the_boxs_side_lie_in_it(component: float) -> None:
    """However little they leave it."""
    model = full_model()
    ray = torch.tensor([[-1.0, 0.5, 3.0]]), torch.tensor([[component, 0.0, -1.0]])
    rays = RayBundle(*ray, torch.zeros((1, 1), dtype=torch.int64), {"directions_norm": torch.ones(1, 1)})
    spans = find_spans(rays, 1, model.grid, model.config.depths, 1.0)
    assert [float(x) * float(model.grid.cell_size) for x in (spans.begin, spans.end)] == pytest.approx([2.0, 4.0])


@pytest.mark.parametrize("channels", [3, 4])
def test_opacity_is_held_to_alpha_where_there_is_one(channels: int) -> None:
    model = full_model()
    outputs = {"rgb_fine": torch.rand(5, 3), "accumulation_fine": torch.rand(5, 1), "background": torch.ones(5, 3)}
    batch = {"image": torch.rand(5, channels), "weight": torch.rand(5)}
    loss, error = model.loss(outputs, batch)
    expected = error / 3
    if channels == 4:
        expected += 0.1 * (outputs["accumulation_fine"][:, 0] - batch["image"][:, 3]) ** 2
    torch.testing.assert_close(loss, expected * batch["weight"])


def test_a_supersampled_pixel_is_the_mean_of_its_quarters() -> None:
    model = full_model().eval()
    with torch.no_grad():
        model.density.copy_(torch.from_numpy(np.random.default_rng(1).normal(size=model.density.shape)))
        model.features.mul_(100)
    rays = tiny_rays(50, dtype=torch.float32)
    directions, norm = rays.split_pixels()
    origins, camera_indices = (x.repeat_interleave(4, dim=0) for x in (rays.origins, rays.camera_indices))
    split = RayBundle(origins, directions.reshape(-1, 3), camera_indices, {"directions_norm": norm.reshape(-1, 1)})
    center, quarters = model(rays), model(split)
    model.supersampled.fill_(True)
    pixels = model(rays)
    for key in ("rgb_fine", "accumulation_fine"):
        expected = quarters[key].reshape(50, 4, -1).mean(dim=1)
        torch.testing.assert_close(pixels[key], expected)
        assert (pixels[key] - center[key]).abs().max() > 1e-3
    assert pixels["depth_fine"].shape == (50, 1)


@pytest.mark.parametrize("supersampled", [False, True])
def test_a_host_may_bound_rays(supersampled: bool) -> None:
    """Between distances of its own instead of the depths, of each of a pixel's rays."""
    model = full_model().eval()
    with torch.no_grad():
        model.density.fill_(2.0)
    model.supersampled.fill_(supersampled)
    rays = tiny_rays(50, dtype=torch.float32)
    opacity = model(rays)["accumulation_fine"]
    hit = opacity[:, 0] > 0.9
    assert hit.sum() > 10

    def bounded(near: float, far: float) -> torch.Tensor:
        nears, fars = (torch.full((50, 1), value) for value in (near, far))
        return model(replace(rays, metadata=rays.metadata | {"nears": nears, "fars": fars}))["accumulation_fine"]

    torch.testing.assert_close(bounded(0.0, 100.0), opacity)
    middle = rays.origins.norm(dim=1).mean()
    assert bounded(0.0, float(middle) - 2).max() == 0
    assert bounded(float(middle) + 2, 100.0).max() == 0
    assert 0 < bounded(0.0, float(middle))[hit].mean() <= opacity[hit].mean()


@pytest.mark.parametrize(
    ("supersample", "visits", "begin"), [(True, 1000.0, 30), (True, 5.0, 40), (True, 3.0, None), (False, 1000.0, None)]
)
def test_a_pixel_has_more_rays_at_last_if_all_were_trained_on_often_enough(
    supersample: bool, visits: float, begin: int | None
) -> None:
    """From 0.6 of the training on; a step has as many rays as before. `visits`: of a pixel in 50 steps."""
    trainer = tiny_trainer(config_of(50, supersample=supersample), VIEWS)
    model, sampler = trainer.pipeline.model, trainer.pipeline.datamanager.train_pixel_sampler
    supersampled = []
    for step in range(50):
        model.grid.num_pixels.fill_(round(50 * 64 / visits))
        trainer.train_iteration(step)
        supersampled.append(bool(model.supersampled))
        assert sampler.num_rays_per_batch == (16 if supersampled[-1] else 64)
    assert supersampled == [begin is not None and step >= begin for step in range(50)]


@pytest.mark.parametrize("supersampled", [False, True])
def test_plain_torch_looks_at_so_many_steps_at_once(supersampled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model, counts, march = full_model().eval(), [], voxel_ops.march
    model.supersampled.fill_(supersampled)
    assert model.rays_per_chunk == 2**16

    def counted(grid: Any, density: Any, spans: RaySpans, jitter: Any, marching: voxel_ops.Marching) -> Any:
        counts.append(len(spans.begin) * float((spans.end - spans.begin).max()) / marching.step)
        return march(grid, density, spans, jitter, marching)

    monkeypatch.setattr(lean, "choose_ops", lambda _: voxel_ops)
    monkeypatch.setattr(lean, "MAX_STEPS", 2000)
    monkeypatch.setattr(voxel_ops, "march", counted)
    rays = tiny_rays(300, dtype=torch.float32)
    rendered = render_rays(model.train(), rays)
    assert len(counts) > 5
    assert 100 < max(counts) <= 2000
    torch.testing.assert_close(rendered, model.eval()(rays)["rgb_fine"], rtol=0, atol=1e-6)


def test_outputs_in_evaluation_do_not_depend_on_chunks() -> None:
    model = full_model().eval()
    with torch.no_grad():
        model.density.fill_(0.5)
    rays = tiny_rays(300, dtype=torch.float32)
    whole = model(rays)
    assert torch.equal(
        torch.cat([model(rays[rows])["rgb_fine"] for rows in (slice(0, 100), slice(100, 300))]), whole["rgb_fine"]
    )
    middle = -(rays.origins * rays.directions).sum(dim=1, keepdim=True)
    hit = whole["accumulation_fine"] > 0.99
    assert hit.any()
    assert ((whole["depth_fine"] < middle) & (whole["depth_fine"] > middle - 1.8))[hit].all()


def test_without_numba_one_line_says_what_it_would_bring(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(voxel_backend, "find_spec", lambda name: None)
    voxel_backend.compiled_ops.cache_clear()
    try:
        assert steps_of(tiny_trainer(config_of(5), VIEWS), 5)
        assert capsys.readouterr().err.count("edge-se-sampler[fast]") == 1
    finally:
        voxel_backend.compiled_ops.cache_clear()


@pytest.mark.parametrize(
    ("problem", "remedy"),
    [
        (ImportError("Numba needs NumPy 2.4 or less"), "--upgrade"),
        (RuntimeError("cannot cache function 'march_chunk':\nno locator available"), "NUMBA_CACHE_DIR"),
    ],
)
def test_where_numba_cannot_be_used_one_line_says_why(
    problem: Exception, remedy: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import_module = builtins.__import__

    def fail(name: str, *arguments: Any, **options: Any) -> Any:
        if name == "edge_se_sampler.models" and "voxel_kernels" in arguments[2]:
            raise problem
        return import_module(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", fail)
    voxel_backend.compiled_ops.cache_clear()
    try:
        assert steps_of(tiny_trainer(config_of(5), VIEWS), 5)
        said = capsys.readouterr().err
        assert (said.count("\n"), str(problem).split()[-1] in said, remedy in said) == (1, True, True)
    finally:
        voxel_backend.compiled_ops.cache_clear()
