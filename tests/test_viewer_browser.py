"""edge-se view in a real browser: the page comes up, and does what one does to it."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from lean_models import config_of

from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.engine.config import override
from edge_se_sampler.engine.session import prepare
from edge_se_sampler.engine.trainer import Trainer

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
playwright = pytest.importorskip("playwright.sync_api", reason="the browser is driven by playwright")
pytest.importorskip("viser", reason="the viewer needs the [view] extra")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium among the system's packages")

from edge_se_sampler.viewer import html  # noqa: E402
from edge_se_sampler.viewer.address import ViewerConfig  # noqa: E402
from edge_se_sampler.viewer.server import open_viewer  # noqa: E402
from edge_se_sampler.viewer.viewed import Viewed  # noqa: E402

WIDTH, HEIGHT, PANEL = 900, 600, 560
"""Of the page, in pixels, and where the panel begins."""


@pytest.fixture(scope="module")
def trainer(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """A finished run."""
    folder = tmp_path_factory.mktemp("viewed")
    scene = make_scenes(folder, ("bricks",), size=24, num_train=8, num_val=1, num_test=1)[0]
    trainer = prepare(override(config_of(80), {"data": scene, "output_dir": folder, "machine.device_type": "cpu"}))
    trainer.train()
    return trainer


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        # without a GPU, and where tests run as root
        flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
        yield driver.chromium.launch(executable_path=CHROMIUM, args=flags)


def shown(page: Any) -> np.ndarray:
    """(H, W, 3) float: the page, left of the panel and below viser's notes."""
    picture = iio.imread(page.screenshot(), extension=".png")[..., :3].astype(float)
    if folder := os.environ.get("EDGE_SE_SCREENSHOTS"):  # to be looked at
        iio.imwrite(Path(folder) / f"page-{time.monotonic_ns()}.png", picture.astype(np.uint8))
    return picture[160:, :PANEL]


def wait_until(condition: Callable[[], Any], page: Any, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        page.wait_for_timeout(200)


def settled(page: Any) -> np.ndarray:
    """What is shown once it stays the same."""
    pictures = [shown(page)]

    def stays() -> bool:
        page.wait_for_timeout(1000)
        pictures.append(shown(page))
        return bool((pictures[-1] == pictures[-2]).all())

    wait_until(stays, page)
    return pictures[-1]


def drag(page: Any, dx: int, dy: int) -> None:
    page.mouse.move(300, 400)
    page.mouse.down()
    page.mouse.move(300 + dx, 400 + dy, steps=8)
    page.mouse.up()


def test_a_run_in_the_browser(trainer: Trainer, browser: Any) -> None:
    viewed = Viewed(trainer)
    with open_viewer(viewed, ViewerConfig(port=0)) as server:
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        requests: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        page.get_by_text(f"step {trainer.next_step}").wait_for(timeout=60_000)
        page.get_by_text("View 0: image").wait_for()
        first = settled(page)
        assert first.std() > 10  # not blank
        page.get_by_role("checkbox", name="Cameras").click()
        without_frusta = settled(page)
        assert without_frusta.std() > 10

        drag(page, 60, 20)
        moved = settled(page)
        assert np.abs(moved - without_frusta).mean() > 3

        page.get_by_role("checkbox", name="Occupied cells").click()
        wait_until(lambda: np.abs(shown(page) - moved).mean() > 3, page)
        page.get_by_role("checkbox", name="Occupied cells").click()
        page.locator("input.mantine-Select-input:visible").first.click()
        page.get_by_role("option", name="accumulation").click()
        wait_until(lambda: np.abs(shown(page) - moved).mean() > 20, page)

        page.get_by_role("button", name="Add keyframe").click()
        page.get_by_role("button", name="Save").click()
        path = trainer.run.path / "camera_path.json"
        wait_until(path.exists, page)
        assert all(url.startswith(("http://127.0.0.1:", "data:", "blob:")) for url in requests)
        page.close()


def test_a_click_on_a_camera_shows_its_image_and_looks_from_there(trainer: Trainer, browser: Any) -> None:
    viewed = Viewed(trainer)
    with open_viewer(viewed, ViewerConfig(port=0)) as server:
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        page.get_by_text("View 0: image").wait_for(timeout=60_000)
        (client,) = server.get_clients().values()
        poses = viewed.cameras.camera_to_worlds.double().numpy()
        # from behind camera 3
        target = poses[3, :, 3]
        client.camera.position, client.camera.look_at = target + 0.6 * poses[3, :, 2] + 0.05 * poses[3, :, 1], target
        settled(page)
        beside = page.locator("img:visible").last
        before = beside.get_attribute("src")
        page.mouse.click(WIDTH // 2, HEIGHT // 2)
        page.get_by_text("View 3: image").wait_for(timeout=30_000)
        wait_until(lambda: beside.get_attribute("src") != before, page)
        wait_until(lambda: np.allclose(client.camera.position, target, atol=1e-3), page)
        page.locator("input.mantine-Select-input:visible").nth(1).click()
        page.get_by_role("option", name="error").click()
        page.get_by_text("View 3: error").wait_for(timeout=30_000)
        page.close()


def test_the_html_file_turns_without_a_server_or_a_network(
    trainer: Trainer, browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(html, "NUM_POINTS", 5_000)
    html.write_html(trainer.run, trainer.config, tmp_path / "run.html")
    assert [file.name for file in tmp_path.iterdir()] == ["run.html"]
    context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, offline=True)
    page, requests = context.new_page(), []
    page.on("request", lambda request: requests.append(request.url))
    page.goto(f"file://{tmp_path}/run.html")
    wait_until(lambda: shown(page).std() > 5, page)
    first = shown(page)
    wait_until(lambda: np.abs(shown(page) - first).mean() > 1, page)  # the turntable turns
    before = shown(page)
    drag(page, 100, 60)
    assert np.abs(shown(page) - before).mean() > 1
    assert all(url.startswith(("file:", "data:", "blob:")) for url in requests)
    context.close()
