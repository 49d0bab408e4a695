"""The sampler on hand-made batches: what a step gets back, and that nothing else changes."""

from __future__ import annotations

import copy
import random
from typing import Any

import numpy as np
import pytest
import torch
from batches import LATE, MIXED, NUMBERS, SAME, batch_of, brightness, following, half_masks
from goodness import ALPHA, p_value, pixel_counts

from edge_se_sampler.errors import InputError
from edge_se_sampler.sampling.distribution import PixelTable
from edge_se_sampler.sampling.edges import edge_strength
from edge_se_sampler.sampling.image_batch import ImageBatch
from edge_se_sampler.sampling.pixel_sampler import EdgeSEPixelSampler
from edge_se_sampler.sampling.registry import PIXEL_STRATEGIES, PixelStrategy
from edge_se_sampler.sampling.settings import EdgeSEPixelSamplerConfig
from edge_se_sampler.sampling.strategies import Edge

PHASES = {
    "uniform": {"step": 0, "early": "uniform"},
    "precrop": {"step": 0, "early": "precrop"},
    "edge": {"step": 0, "early": "edge"},
    "se": {"step": LATE, "late": "se"},
}


@pytest.fixture(params=PHASES)
def phase(request: pytest.FixtureRequest) -> dict[str, Any]:
    """A step and settings that make the step's strategy the named one."""
    return dict(PHASES[request.param])


# ---- rows


@pytest.mark.parametrize(("sizes", "stacked"), [(SAME, True), (SAME, False), (MIXED, False), ([(9, 14)], True)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("images_per_step", ["one", "all"])
@pytest.mark.parametrize("rays", [1, 7, 600])  # odd; more than pixels
def test_exactly_n_rows_gathered_where_the_indices_say(
    phase: dict, sizes: Any, stacked: bool, masked: bool, images_per_step: str, rays: int
) -> None:
    numbers = NUMBERS[: len(sizes)]
    host = batch_of(sizes, numbers, stacked=stacked, masks=half_masks(sizes) if masked else None)
    pixels = following(**phase, rays=rays, images_per_step=images_per_step).sample(host)
    assert set(pixels) == {"image", "address", "indices"} | ({"mask"} if masked else set())
    assert pixels["indices"].dtype == torch.int64
    assert pixels["indices"].shape == (rays, 3)
    assert torch.equal(pixels["address"], pixels["indices"])
    for row in range(min(rays, 10)):
        number, y, x = pixels["indices"][row].tolist()
        assert torch.equal(pixels["image"][row], host["image"][numbers.index(number)][y, x])
    if masked:
        assert pixels["mask"].all()


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_images_keep_their_channels_and_type(phase: dict, channels: int, dtype: torch.dtype) -> None:
    host = batch_of(channels=channels, dtype=dtype)
    pixels = following(**phase).sample(host)
    assert pixels["image"].shape == (64, channels)
    assert pixels["image"].dtype == dtype
    position = {number: k for k, number in enumerate(NUMBERS)}
    expected = [host["image"][position[number]][y, x] for number, y, x in pixels["indices"].tolist()]
    assert torch.equal(pixels["image"], torch.stack(expected))


def test_stacked_and_listed_images_draw_the_same(phase: dict) -> None:
    stacked = following(**phase).sample(batch_of(stacked=True, masks=half_masks(SAME)))
    listed = following(**phase).sample(batch_of(stacked=False, masks=half_masks(SAME)))
    assert all(torch.equal(stacked[key], listed[key]) for key in stacked)


def test_eight_bits_and_floats_draw_the_same_pixels(phase: dict) -> None:
    indices = [following(**phase).sample(batch_of(dtype=dtype))["indices"] for dtype in (torch.uint8, torch.float32)]
    assert torch.equal(*indices)


def test_the_number_of_rays_can_change(phase: dict) -> None:
    sampler = following(**phase, rays=10)
    for rays in (33, 1, 10):
        sampler.set_num_rays_per_batch(rays)
        assert len(sampler.sample(batch_of())["indices"]) == rays


def test_keep_full_image_returns_whole_images(phase: dict) -> None:
    host = batch_of()
    assert following(**phase, keep_full_image=True).sample(host)["full_image"] is host["image"]
    assert "full_image" not in following(**phase).sample(host)


# ---- images


@pytest.mark.parametrize("sizes", [SAME, MIXED])
@pytest.mark.parametrize("images_per_step", ["one", "all"])
def test_one_image_a_step_or_all(phase: dict, sizes: Any, images_per_step: str) -> None:
    sampler, host = following(**phase, images_per_step=images_per_step), batch_of(sizes)
    per_step = []
    for step in range(phase["step"], phase["step"] + 60):
        sampler.set_step(step)
        per_step.append(set(sampler.sample(host)["indices"][:, 0].tolist()))
    assert {len(images) for images in per_step} == {1 if images_per_step == "one" else 3}
    assert set().union(*per_step) == set(NUMBERS)


def test_every_drawable_image_is_the_steps_image_equally_often(phase: dict) -> None:
    sizes, numbers = [*MIXED, (7, 8)], [*NUMBERS, 5]
    masks = half_masks(sizes)
    masks[1][:] = False  # never this one
    sampler, host = following(**phase, rays=1, planned=10**6), batch_of(sizes, numbers, masks=masks)
    start = 0 if phase["step"] == 0 else 10**6 // 2
    counts = dict.fromkeys(numbers, 0)
    for step in range(start, start + 800):
        sampler.set_step(step)
        counts[int(sampler.sample(host)["indices"][0, 0])] += 1
    assert p_value(np.array(list(counts.values())), np.array([1, 0, 1, 1]) / 3) > ALPHA


# ---- masks


@pytest.mark.parametrize("sizes", [SAME, MIXED])
def test_masked_pixels_are_never_drawn(phase: dict, sizes: Any) -> None:
    scored = []

    def squared_error(candidates: dict[str, Any]) -> torch.Tensor:
        scored.append(candidates["mask"])
        return brightness(candidates)

    masks = half_masks(sizes)
    masks[2][:] = False
    sampler = following(**phase, rays=3000, images_per_step="all", squared_error=squared_error)
    pixels = sampler.sample(batch_of(sizes, masks=masks))
    assert pixels["mask"].all()
    assert set(pixels["indices"][:, 0].tolist()) == set(NUMBERS[:2])
    assert all(mask.all() for mask in scored)  # candidates neither


def test_ignore_mask_draws_them(phase: dict) -> None:
    host = batch_of(masks=half_masks(SAME))
    ignoring = following(**phase, rays=3000, ignore_mask=True).sample(host)
    assert 0.3 < ignoring["mask"].float().mean() < 0.7
    without = {key: value for key, value in host.items() if key != "mask"}
    assert torch.equal(ignoring["indices"], following(**phase, rays=3000).sample(without)["indices"])


@pytest.mark.parametrize("sizes", [SAME, MIXED])
def test_nothing_to_draw_is_an_input_error(phase: dict, sizes: Any) -> None:
    masks = [torch.zeros(size, dtype=torch.bool) for size in sizes]
    sampler, host = following(**phase), batch_of(sizes, masks=masks)
    with pytest.raises(InputError, match="masked in all images"):
        sampler.sample(host)
    with pytest.raises(InputError, match="masked in all images"):
        sampler.check_images(host)


def test_a_mask_over_the_whole_box_leaves_precrop_nothing() -> None:
    mask = torch.ones(9, 14, dtype=torch.bool)
    mask[3:7, 4:11] = False  # 9/4 <= i < 27/4, 14/4 <= j < 42/4
    host = batch_of(SAME[:1], NUMBERS[:1], masks=[mask])
    with pytest.raises(InputError, match="precrop"):
        following(early="precrop").sample(host)
    with pytest.raises(InputError, match="precrop"):
        following(early="precrop").check_images(host)
    mask[6, 10] = True
    host = batch_of(SAME[:1], NUMBERS[:1], masks=[mask])
    assert following(early="precrop").sample(host)["indices"].unique(dim=0).tolist() == [[NUMBERS[0], 6, 10]]


def test_alpha_edges_without_alpha_name_the_image() -> None:
    with pytest.raises(InputError, match=rf"image {NUMBERS[0]}: edge source 'alpha'"):
        following(edge_source="alpha").sample(batch_of())
    with pytest.raises(InputError, match=rf"image {NUMBERS[0]}: edge source 'alpha'"):  # which begins at edges
        following(early="uniform", late="soft-mining", edge_source="alpha").check_images(batch_of())
    assert len(following(edge_source="alpha").sample(batch_of(channels=4))["indices"]) == 64


def test_a_pixel_that_is_not_finite_names_its_image() -> None:
    host = batch_of(dtype=torch.float32)
    host["image"][1, 2, 2, 0] = torch.nan
    with pytest.raises(InputError, match=rf"image {NUMBERS[1]}: .*not finite"):
        following().sample(host)


# ---- distributions


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    ("strategy", "settings"),
    [
        ("uniform", {}),
        ("precrop", {}),
        ("precrop", {"precrop_fraction": 0.75}),
        ("edge", {}),
        ("edge", {"edge_filter": "laplacian", "edge_epsilon": 0.3}),
        ("edge", {"edge_filter": "canny", "edge_epsilon": 0.2}),
        ("edge", {"edge_source": "both", "edge_epsilon": 0.1}),
        ("edge", {"background": (0.0, 0.2, 0.0)}),
    ],
)
def test_pixels_are_drawn_as_the_settings_say(masked: bool, strategy: str, settings: dict) -> None:
    masks = half_masks(MIXED)
    host = batch_of(MIXED, channels=4, masks=masks if masked else None)
    background = settings.get("background")
    settings = {key: value for key, value in settings.items() if key != "background"}
    named: dict[str, Any] = {"early": strategy, "images_per_step": "all"} | settings
    config = EdgeSEPixelSamplerConfig(**named)
    sampler = EdgeSEPixelSampler(config, num_rays_per_batch=90_000, background_color=background)
    sampler.bind(squared_error=brightness, progress=lambda step: step / 10, seed=1)
    drawn = sampler.sample(host)["indices"]
    for k, (number, (height, width)) in enumerate(zip(NUMBERS, MIXED, strict=True)):
        if strategy == "edge":
            chosen: Any = {"edge_filter": config.edge_filter, "source": config.edge_source}
            strength = edge_strength(host["image"][k].numpy(), background=background or (1.0, 1.0, 1.0), **chosen)
            strength = strength.astype(np.float64) + config.edge_epsilon
        else:
            side = config.precrop_fraction if strategy == "precrop" else 1
            inside = [[n * (1 - side) / 2 <= i < n * (1 + side) / 2 for i in range(n)] for n in (height, width)]
            strength = np.outer(inside[0], inside[1]).astype(np.float64)
        if masked:
            strength *= masks[k].numpy()
        here = drawn[drawn[:, 0] == number]
        assert abs(len(here) - 30_000) < 5 * (90_000 * 2 / 9) ** 0.5
        assert p_value(pixel_counts(here[:, 1:], (height, width)), strength / strength.sum()) > ALPHA


def test_tables_follow_the_absolute_number_not_the_position() -> None:
    numbers = [40, 2, 17, 9, 33]
    sampler = following(planned=10**6)
    for subset in ([17, 2], [2, 17], [33, 17, 40], [9], [40, 33, 9, 17, 2]):
        batch = ImageBatch.of(batch_of([(9, 14)] * len(subset), subset), use_mask=True)
        table, table_index = sampler.strategies["edge"].distribution.tables(batch)
        for k, number in enumerate(subset):
            alone = ImageBatch.of(batch_of(SAME[:1], [number]), use_mask=True)
            fresh, _ = Edge(sampler.config).tables(alone)
            assert isinstance(table, PixelTable)
            assert isinstance(fresh, PixelTable)
            p, expected = table.probability(int(table_index[k])), fresh.probability(0)
            torch.testing.assert_close(p, expected, rtol=1e-6, atol=2**-30)
            assert len(table) <= len(numbers)


def test_an_images_strength_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[bytes] = []

    class CountingEdge(Edge):
        def strength(self, image: np.ndarray, background_color: Any) -> np.ndarray:
            computed.append(image.tobytes())
            return super().strength(image, background_color)

    monkeypatch.setitem(PIXEL_STRATEGIES, "edge", PixelStrategy(CountingEdge, ("early",), ""))
    sampler = following()
    for subset in ([1, 2], [2, 3], [3, 1], [2]):
        sampler.sample(batch_of([(9, 14)] * len(subset), subset))
    assert len(computed) == len(set(computed)) == 3


def test_as_many_strengths_as_pixels_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    class Half(Edge):
        def strength(self, image: np.ndarray, background_color: Any) -> np.ndarray:
            return super().strength(image, background_color)[::2]

    monkeypatch.setitem(PIXEL_STRATEGIES, "edge", PixelStrategy(Half, ("early",), ""))
    with pytest.raises(InputError, match=rf"image {NUMBERS[0]}: its strengths are \(5, 14\), .* \(9, 14\)"):
        following().check_images(batch_of(SAME))


# ---- nothing else changes


def test_the_same_seed_and_step_give_the_same_pixels_whatever_came_before(phase: dict) -> None:
    straight, resumed = following(**phase), following(**phase)
    start = phase["step"]
    for step in range(start, start + 5):
        straight.set_step(step)
        reached = straight.sample(batch_of())
    resumed.set_step(start + 4)
    again = resumed.sample(batch_of())
    assert all(torch.equal(reached[key], again[key]) for key in again)  # pyright: ignore[reportPossiblyUnboundVariable]


@pytest.mark.parametrize("change", [{"seed": 1}, {"step": 1}])
def test_another_seed_or_step_gives_other_pixels(phase: dict, change: dict) -> None:
    base = following(**phase).sample(batch_of())["indices"]
    step = phase["step"] + change.get("step", 0)
    other = following(**(phase | {"step": step}), seed=change.get("seed", 0)).sample(batch_of())["indices"]
    assert not torch.equal(base, other)


@pytest.mark.parametrize("masked", [False, True])
def test_global_random_numbers_are_neither_read_nor_moved(phase: dict, masked: bool) -> None:
    host = batch_of(masks=half_masks(SAME) if masked else None)

    def drawn_after(seed: int) -> torch.Tensor:
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        torch.manual_seed(seed)
        before = random.getstate(), str(np.random.get_state()), torch.get_rng_state()  # noqa: NPY002
        indices = following(**phase).sample(host)["indices"]
        assert random.getstate() == before[0]
        assert str(np.random.get_state()) == before[1]  # noqa: NPY002
        assert torch.equal(torch.get_rng_state(), before[2])
        return indices

    assert torch.equal(drawn_after(0), drawn_after(1))


def test_the_config_is_not_written_into(phase: dict) -> None:
    settings = {key: value for key, value in phase.items() if key != "step"}
    config = EdgeSEPixelSamplerConfig(**settings)
    before = copy.deepcopy(config)
    train = config.setup(num_rays_per_batch=17, keep_full_image=True)
    train.bind(squared_error=brightness, progress=lambda step: step / 10, seed=0)
    train.set_step(5)
    train.sample(batch_of())
    assert config == before
    evaluation = config.setup()
    assert evaluation.num_rays_per_batch == before.num_rays_per_batch
    assert not evaluation.config.keep_full_image


def test_the_hosts_batch_is_not_written_into(phase: dict) -> None:
    host = batch_of(masks=half_masks(SAME))
    kept = {key: value.clone() for key, value in host.items()}
    pixels = following(**phase).sample(host)
    for value in pixels.values():
        value.zero_()
    assert set(host) == set(kept)
    assert all(torch.equal(host[key], kept[key]) for key in kept)


# ---- unbound


def test_an_unbound_sampler_is_uniform() -> None:
    sampler = EdgeSEPixelSampler(
        EdgeSEPixelSamplerConfig(early="edge", images_per_step="all"), num_rays_per_batch=40_000
    )
    assert sampler.strategy == "uniform"
    drawn = sampler.sample(batch_of())["indices"]
    order = torch.tensor([NUMBERS.index(number) for number in drawn[:, 0].tolist()])
    counts = pixel_counts(torch.cat((order[:, None], drawn[:, 1:]), dim=1), (3, 9, 14))
    assert p_value(counts, np.full(counts.shape, 1 / counts.size)) > ALPHA


def test_an_unbound_sampler_does_not_repeat_itself() -> None:
    sampler = EdgeSEPixelSampler(EdgeSEPixelSamplerConfig())
    first, second = (sampler.sample(batch_of())["indices"] for _ in range(2))
    assert not torch.equal(first, second)


def test_a_bound_sampler_stays_at_its_step(phase: dict) -> None:
    sampler = following(**phase)
    first, second = (sampler.sample(batch_of())["indices"] for _ in range(2))
    assert torch.equal(first, second)
