"""The compiled kernels against their reference in plain torch: samples, values, gradients, steps of Adam, trainings."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest
import torch
from tiny import ball_views, tiny_trainer

from edge_se_sampler.engine.config import MANAGER, MODEL, TrainerConfig, override
from edge_se_sampler.methods import method_configs
from edge_se_sampler.models import compilation, voxel_backend, voxel_kernels, voxel_ops
from edge_se_sampler.models.compilation import compile_ops
from edge_se_sampler.models.lean import WIDTH, WIDTH_CARVED, ColorNetwork
from edge_se_sampler.models.voxel_kernels import rendering
from edge_se_sampler.models.voxel_ops import Marching, RaySpans, Rendered
from edge_se_sampler.occupancy.bricks import BrickGrid, unpack_bits
from edge_se_sampler.occupancy.subdivision import subdivide

MARCHING = Marching(0.7, 1.0, 0.012, 0.006, 0.01, 0.4)
VIEWS = ball_views()


def shell(size: int = 40) -> BrickGrid:
    """Cells between two spheres, with holes."""
    middle = torch.arange(size) + 0.5 - size / 2
    radius = torch.stack(torch.meshgrid(middle, middle, middle, indexing="ij")).norm(dim=0)
    holes = torch.from_numpy(np.random.default_rng(1).random((size,) * 3) < 0.1)
    return BrickGrid.from_cells(torch.zeros(3), 1.0, (radius < size / 2.2) & (radius > size / 4) & ~holes)


def crossing_spans(count: int = 300, size: int = 40) -> RaySpans:
    """Rays from outside through the box; some along an axis, some that miss all cells."""
    rng = np.random.default_rng(2)
    origins = rng.normal(size=(count, 3))
    origins = size / 2 + 2 * size * origins / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(0, size, (count, 3)) - origins
    origins[:2], directions[:2] = ((size / 2, size / 2 + 0.3, -5), (9.5, size + 7, 20.5)), ((0, 0, 1), (0, -1, 0))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        one, other = -origins / directions, (size - origins) / directions
    begin, end = np.minimum(one, other).max(axis=1).clip(min=0), np.maximum(one, other).min(axis=1)
    return RaySpans(*(torch.from_numpy(value).float() for value in (origins, directions, begin, end)))


def random_tensor(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape)).float()


def jitter() -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(4).random(300)).float()


def render(ops: ModuleType, marching: Marching = MARCHING) -> Rendered:
    grid = shell()
    weights = ColorNetwork(np.random.default_rng(0), WIDTH).weights()
    density, features = random_tensor(grid.num_rows, 1) * 2 - 1, random_tensor(grid.num_rows, 16, seed=5)
    return ops.render(grid, density, features, weights, crossing_spans(), jitter(), marching)


def assert_close(found: torch.Tensor, expected: torch.Tensor, tolerance: float = 1e-4) -> None:
    """Equal to a part of the largest value."""
    assert found.shape == expected.shape
    assert float((found - expected).detach().abs().max()) <= tolerance * float(expected.detach().abs().max())


@pytest.mark.parametrize("step", [0.3, 1.0, 2.5])
def test_the_same_samples_have_colors(step: float) -> None:
    marching = replace(MARCHING, step=step)
    found, expected = render(voxel_kernels, marching), render(voxel_ops, marching)
    assert len(expected.cells) > 200
    assert torch.equal(found.cells, expected.cells)
    for name, value in vars(expected).items():
        assert_close(getattr(found, name), value)


@pytest.mark.parametrize("ops", [voxel_kernels, voxel_ops])
def test_samples_without_a_color_count_in_a_ray_s_distance(ops: ModuleType) -> None:
    all_colored, few_colored = (render(ops, replace(MARCHING, weight_min=least)) for least in (0.0, 0.2))
    assert len(few_colored.cells) < len(all_colored.cells) / 2
    assert_close(few_colored.distance, all_colored.distance, 1e-6)


def test_rays_end_where_no_light_passes() -> None:
    whole, early = (
        render(voxel_kernels, replace(MARCHING, transmittance_min=least)).accumulation.detach() for least in (0.0, 0.5)
    )
    ended = early < whole
    assert 10 < int(ended.sum()) < 290
    assert float(early[ended].min()) >= 0.5


@pytest.mark.parametrize("ops", [voxel_kernels, voxel_ops])
def test_cells_that_are_too_thin_to_be_seen_need_not_be_sampled(ops: ModuleType) -> None:
    grid, rays = shell(), (crossing_spans(), jitter(), MARCHING)
    density, features = 2 * random_tensor(grid.num_rows, 1) - 7, random_tensor(grid.num_rows, 16, seed=5)
    weights = ColorNetwork(np.random.default_rng(0), WIDTH).weights()
    rendered = ops.render(grid, density, features, weights, *rays)
    dense = ops.find_dense_cells(grid, density, MARCHING.density_min)
    corners = grid.corner_rows(*torch.nonzero(grid.occupied, as_tuple=True))
    expected = torch.zeros_like(grid.occupied)
    expected[grid.occupied] = (density[corners][..., 0] > np.log(-np.log(1 - 0.012))).any(dim=1)
    assert torch.equal(unpack_bits(dense), expected)
    assert 0.2 < float(expected.sum() / grid.occupied.sum()) < 0.9
    grid.set_sampled(dense)
    again = ops.render(grid, density, features, weights, *rays)
    assert int((again.accumulation > 0).sum()) > 20
    for name, value in vars(rendered).items():
        assert torch.equal(getattr(again, name), value), name


def test_more_samples_than_were_made_room_for_are_found_in_a_second_round(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = gradients_of(voxel_kernels)
    monkeypatch.setattr(rendering, "SAMPLES_PER_RAY", 1)
    rendering._spare.clear()
    for name, value in gradients_of(voxel_kernels).items():
        assert torch.equal(whole[name], value), name


def test_two_renderings_before_a_backward_pass_do_not_share_memory() -> None:
    grid, network = shell(), ColorNetwork(np.random.default_rng(0), WIDTH)
    density = torch.nn.Parameter(random_tensor(grid.num_rows, 1) * 2 - 1)
    features = torch.nn.Parameter(random_tensor(grid.num_rows, 16, seed=5))

    def rendered(of: float) -> torch.Tensor:
        shift = torch.full((300,), of)
        rays = crossing_spans(), shift, MARCHING
        return voxel_kernels.render(grid, density, features, network.weights(), *rays).rgb.square().sum()

    first, second = rendered(0.1), rendered(0.8)
    (first + second).backward()
    assert features.grad is not None
    both, features.grad = features.grad.to_dense(), None
    rendered(0.1).backward()
    rendered(0.8).backward()
    assert features.grad is not None
    assert_close(features.grad.to_dense(), both, 1e-5)


@pytest.mark.parametrize("ops", [voxel_kernels, voxel_ops])
def test_densities_that_little_light_reaches_have_no_gradient(ops: ModuleType) -> None:
    """A ray through 12 cells in a row that each let 0.6 of the light pass: less than 0.1 behind the fifth."""
    grid = BrickGrid.from_cells(torch.zeros(3), 1.0, torch.ones((12, 4, 4), dtype=torch.bool))
    density = torch.nn.Parameter(torch.full((grid.num_rows, 1), float(np.log(0.5))))
    features = torch.nn.Parameter(random_tensor(grid.num_rows, 16, seed=5))
    ray = RaySpans(torch.full((1, 3), 0.5), torch.eye(3)[:1], torch.zeros(1), torch.full((1,), 11.5))
    marching = Marching(1.0, 1.0, 0.01, 0.0, 0.0, visible_min=0.1)
    weights = ColorNetwork(np.random.default_rng(0), WIDTH).weights()
    rendered = ops.render(grid, density, features, weights, ray, torch.zeros(1), marching)
    (rendered.rgb.sum() + rendered.accumulation.sum()).backward()
    for values, last in ((density, 5), (features, 12)):
        gradient = values.grad
        assert gradient is not None
        rows = torch.nonzero(gradient.to_dense().abs().sum(dim=1))[:, 0]
        cells = grid.coordinates(rows)[:, 0]
        assert sorted(set(cells.tolist())) == list(range(last + 1))


def gradients_of(ops: ModuleType, width: int = WIDTH) -> dict[str, torch.Tensor]:
    """What is rendered, and gradients of everything that is trained, sparse ones made dense."""
    grid, network = shell(), ColorNetwork(np.random.default_rng(0), width)
    raw = torch.nn.Parameter(random_tensor(grid.num_rows, 1) * 2 - 1)
    features = torch.nn.Parameter(random_tensor(grid.num_rows, 16, seed=5))
    rendered = ops.render(grid, raw, features, network.weights(), crossing_spans(), jitter(), MARCHING)
    wanted = random_tensor(300, 4, seed=6)
    (rendered.rgb * wanted[:, :3]).sum().add((rendered.accumulation * wanted[:, 3:]).sum()).backward()
    named = {"density": raw, "features": features, **dict(network.named_parameters())}
    gradients = {name: value.grad for name, value in named.items()}
    assert gradients["density"].is_sparse  # pyright: ignore
    dense = {name: grad.to_dense() for name, grad in gradients.items() if grad is not None}
    assert dense.keys() == named.keys()
    return dense | {name: value.detach() for name, value in vars(rendered).items()}


@pytest.mark.parametrize("width", [WIDTH, WIDTH_CARVED])
@pytest.mark.parametrize("num_sums", [2, 32])
def test_colors_and_gradients_are_the_reference_s(num_sums: int, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "NUM_SUMS", num_sums)  # of five chunks of rays
    found, expected = gradients_of(voxel_kernels, width), gradients_of(voxel_ops, width)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert float(value.abs().max()) > 1e-3, name
        assert_close(found[name], value)


def test_any_number_of_threads_finds_the_same_bits() -> None:
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = gradients_of(voxel_kernels)
        numba.set_num_threads(threads)
        for name, value in gradients_of(voxel_kernels).items():
            assert torch.equal(one[name], value), name
    finally:
        numba.set_num_threads(threads)


@pytest.mark.parametrize("ops", [voxel_kernels, voxel_ops])
def test_a_step_of_adam_moves_the_rows_of_the_gradient_alone(ops: ModuleType) -> None:
    """Twice, and with a row that occurs twice; the largest allowed value is kept."""
    values, mean, square = random_tensor(128, 16), torch.zeros(128, 16), torch.zeros(128, 1)
    expected = values.double().clone()
    m, v = torch.zeros_like(expected), torch.zeros_like(expected[:, :1])
    for seed in (1, 2):
        rows, sums = torch.tensor([70, 3, 127, 3]), random_tensor(4, 16, seed=seed)
        gradient = torch.sparse_coo_tensor(rows[None], sums, (128, 16), check_invariants=True)
        dense = gradient.to_dense().double()
        settings = {"lr": 0.1, "betas": (0.9, 0.99), "eps": 1e-8, "maximum": 1.0, "total_variation": 0.5}
        ops.adam_rows(values, mean, square, gradient, **settings)
        for row in (3, 70, 127):
            x, y, z = row % 64 // 16, row // 4 % 4, row % 4
            near = [row + s * d for s, p in ((16, x), (4, y), (1, z)) for d in (-1, 1) if 0 <= p + d < 4]
            dense[row] += 0.5 * sum(expected[row] - expected[other] for other in near)
        before = expected.clone()
        for row in (3, 70, 127):
            m[row] = 0.9 * m[row] + 0.1 * dense[row]
            v[row] = 0.99 * v[row] + 0.01 * dense[row].square().mean()
            expected[row] = (before[row] - 0.1 * m[row] / (v[row].sqrt() + 1e-8)).clamp(max=1.0)
        torch.testing.assert_close(values.double(), expected, rtol=1e-5, atol=1e-5)
        expected = values.double().clone()


@pytest.mark.parametrize("width", [1, 8, 24])
def test_rows_of_any_width_are_stepped_as_by_the_reference(width: int) -> None:
    rows, sums = torch.tensor([[70, 3, 127]]), random_tensor(3, width)
    gradient = torch.sparse_coo_tensor(rows, sums, (128, width), check_invariants=True)
    found = []
    for ops in (voxel_kernels, voxel_ops):
        values, mean, square = random_tensor(128, width), torch.zeros(128, width), torch.zeros(128, 1)
        settings = {"lr": 0.1, "betas": (0.9, 0.99), "eps": 1e-8, "maximum": 1.0, "total_variation": 0.5}
        ops.adam_rows(values, mean, square, gradient, **settings)
        found.append((values, mean, square))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("ratio", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("ops", [voxel_kernels, voxel_ops])
def test_finer_corners_have_the_values_around_them(ops: ModuleType, ratio: float) -> None:
    """A linear field, sampled at the corners, is the same field at corners of smaller cells inside of the larger ones;
    those beyond have a mean of what is around them."""
    grid = shell()
    in_brick, occupied = torch.cartesian_prod(*[torch.arange(4)] * 3), grid.to_cells(grid.occupied.reshape(-1))

    def positions(of: BrickGrid) -> torch.Tensor:
        return (4 * of.bricks[:, None] + in_brick).reshape(-1, 3) * of.cell_size

    slope = random_tensor(3, 1).double()
    finer = subdivide(grid, occupied, ratio)
    values = torch.cat((positions(grid) @ slope, positions(grid)), dim=1).float()
    found = ops.resample(finer.bricks, ratio, grid.numbers, values)
    brick, cell = torch.nonzero(finer.occupied, as_tuple=True)
    rows = finer.corner_rows(brick, cell).unique()
    position = positions(finer)[rows]
    inside = occupied[tuple(position.long().clamp(max=len(occupied) - 1).T)]
    assert inside.sum() > 1000
    expected = torch.cat((position @ slope, position), dim=1).float()
    torch.testing.assert_close(found[rows[inside]], expected[inside], rtol=1e-5, atol=1e-5)
    assert ((found[rows, 1:] - position).abs() <= 1).all()


COMPILED = """
from numba.core.registry import CPUDispatcher
from edge_se_sampler.models.compilation import compile_ops
from edge_se_sampler.models.voxel_kernels import marching, rendering, rows, shading

def signatures():
    functions = [f for m in (marching, rendering, rows, shading) for f in vars(m).values()]
    return {f.py_func.__name__: len(f.signatures) for f in functions if isinstance(f, CPUDispatcher)}

compile_ops("cpu")
compiled = signatures()
from lean_models import config_of, steps_of, VIEWS
from tiny import tiny_trainer
steps_of(tiny_trainer(config_of(30), VIEWS), 30)
assert signatures() == compiled, (compiled, signatures())
"""


@pytest.mark.slow
def test_nothing_is_left_to_compile_when_the_clock_runs() -> None:
    subprocess.run([sys.executable, "-c", COMPILED], check=True, cwd=Path(__file__).parent)


def test_compiling_leaves_torch_s_global_generator_alone() -> None:
    before = torch.get_rng_state()
    compile_ops("cpu")
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("seconds", [0.0, 30.0])
def test_compiling_that_takes_long_is_said_at_once(
    seconds: float, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said = []
    monkeypatch.setattr(compilation, "SILENT_SECONDS", seconds)
    monkeypatch.setattr(compilation, "_call_all", lambda _: said.append(wait_until_said(capsys) if not seconds else ""))
    compile_ops("cpu")
    assert [compilation.NOTICE in text for text in said] == [not seconds]
    assert compilation.NOTICE not in capsys.readouterr().err


def wait_until_said(capsys: pytest.CaptureFixture[str]) -> str:
    """What is on stderr, as soon as there is something; at most 10 s."""
    for _ in range(200):
        if text := capsys.readouterr().err:
            return text
        time.sleep(0.05)
    return ""


THREADS = """
import torch
torch.set_num_threads(1)
from lean_models import config_of, steps_of, VIEWS
from tiny import tiny_trainer
trainer = tiny_trainer(config_of(30), VIEWS)
steps_of(trainer, 2)
import numba
assert (torch.get_num_threads(), numba.get_num_threads()) == (1, 1)
torch.set_num_threads(2)
steps_of(trainer, 1, 2)
assert (torch.get_num_threads(), numba.get_num_threads()) == (2, min(2, numba.config.NUMBA_NUM_THREADS))
"""


@pytest.mark.slow
def test_kernels_use_as_many_threads_as_torch() -> None:
    subprocess.run([sys.executable, "-c", THREADS], check=True, cwd=Path(__file__).parent)


LOSSES = """
import pytest
from test_voxel_kernels import losses, voxel_kernels
with pytest.MonkeyPatch.context() as monkeypatch:
    print(losses(voxel_kernels, monkeypatch))
"""


@pytest.mark.slow
def test_kernels_that_have_just_been_compiled_round_as_those_that_are_loaded(tmp_path: Path) -> None:
    """Else a training would not be repeated by another process."""
    command, environment = [sys.executable, "-c", LOSSES], os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    folder = Path(__file__).parent
    compiled, loaded = (
        subprocess.run(command, check=True, cwd=folder, env=environment, capture_output=True, text=True).stdout
        for _ in range(2)
    )
    assert compiled == loaded
    assert compiled.count(",") == 49


def losses(ops: ModuleType, monkeypatch: pytest.MonkeyPatch, steps: int = 50) -> list[float]:
    monkeypatch.setattr(voxel_backend, "compiled_ops", lambda: None if ops is voxel_ops else ops)
    config: TrainerConfig = method_configs()["lean-nerf"]
    changes = {f"{MANAGER}.train_num_rays_per_batch": 64, f"{MODEL}.voxel_size_px": 0.5}
    # a sample at a threshold falls on one side or the other by rounding, and has to matter little
    changes |= {f"{MODEL}.{name}_threshold": 1e-5 for name in ("alpha", "weight", "transmittance")}
    trainer = tiny_trainer(override(config, changes | {"max_num_iterations": steps}), VIEWS)
    found = [trainer.train_iteration(step) for step in range(steps)]
    assert int(trainer.pipeline.model.grid.level) == 2
    return found


def test_a_training_has_the_losses_of_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    found, expected = losses(voxel_kernels, monkeypatch), losses(voxel_ops, monkeypatch)
    assert expected[-1] < expected[0] / 2
    assert found == pytest.approx(expected, rel=1e-3)
