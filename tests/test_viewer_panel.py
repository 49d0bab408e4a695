"""What a browser is sent, while it moves, while it is slow, and while a training goes on."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lean_models import VIEWS, config_of
from tiny import tiny_trainer

from edge_se_sampler.engine.trainer import Trainer

viser = pytest.importorskip("viser", reason="the viewer needs the [view] extra")

from browsers import FakeClient, view_tiny, wait_until  # noqa: E402

from edge_se_sampler.viewer.viewed import Viewed  # noqa: E402


@pytest.fixture
def viewed() -> Viewed:
    return view_tiny()


def test_a_browser_sees_a_small_picture_at_once_and_then_a_sharp_one_until_it_moves(viewed: Viewed) -> None:
    client = FakeClient()
    panel = client.panel(viewed)
    panel.renderer.frame = SimpleNamespace(rays=600, record=lambda *_: None)  # type: ignore[assignment]
    wait_until(lambda: client.pictures and client.pictures[-1].shape == (128, 192, 3))
    time.sleep(0.5)
    count = len(client.pictures)
    time.sleep(0.5)
    assert len(client.pictures) == count  # nothing has changed: nothing is rendered
    client.move(1.0)
    wait_until(lambda: len(client.pictures) > count and client.pictures[-1].shape == (128, 192, 3))
    assert [len(picture) for picture in client.pictures[count:]] == [20, 40, 80, 128]
    assert (client.pictures[-1] != client.pictures[count - 1]).any()
    viewed.trainer.next_step += 1  # newer weights: sharp again, but not small in between
    wait_until(lambda: len(client.pictures) == count + 5)
    assert len(client.pictures[-1]) == 128
    panel.close()
    assert panel._thread not in threading.enumerate()  # torch must not be at work when the interpreter ends


def test_a_move_is_seen_even_if_it_comes_as_the_panel_stops_waiting_for_one(
    viewed: Viewed, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = FakeClient()
    moves: list[float] = []

    class LateEvent(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            was_set = super().wait(timeout)
            if not was_set and moves:
                client.move(moves.pop())
            return was_set

    with monkeypatch.context() as patch:
        patch.setattr("edge_se_sampler.viewer.panel.threading.Event", LateEvent)
        panel = client.panel(viewed)
    wait_until(lambda: client.pictures and len(client.pictures[-1]) == 128)
    count = len(client.pictures)
    moves.append(1.0)
    wait_until(lambda: len(client.pictures) > count)
    panel.close()


def test_the_next_move_interrupts_what_becomes_sharp(viewed: Viewed) -> None:
    client = FakeClient()
    panel, moves = client.panel(viewed), []
    panel.renderer.frame = SimpleNamespace(rays=600, record=lambda *_: None)  # type: ignore[assignment]
    wait_until(lambda: client.pictures and len(client.pictures[-1]) == 128)
    count = len(client.pictures)

    def move_once(*_: Any) -> None:
        if len(client.pictures) == count + 1 and not moves:  # the second picture is being rendered
            moves.append(client.move(0.2))

    panel.renderer.turn = SimpleNamespace(rays=300, record=move_once)  # type: ignore[assignment]
    client.move(0.1)
    wait_until(lambda: len(client.pictures) > count and len(client.pictures[-1]) == 128)
    assert [len(picture) for picture in client.pictures[count:]] == [20, 20, 40, 80, 128]
    panel.close()


def test_a_slow_browser_stalls_neither_training_nor_others(viewed: Viewed) -> None:
    stuck, slow = threading.Event(), threading.Event()

    def hang(_: np.ndarray) -> None:
        stuck.set()
        slow.wait(60)

    slow_client, quick_client = FakeClient(hang), FakeClient()
    panels = [slow_client.panel(viewed)]
    assert stuck.wait(20)
    for angle in range(100):  # its moves do not queue
        slow_client.move(angle / 10)
    panels.append(quick_client.panel(viewed))
    wait_until(lambda: quick_client.pictures and len(quick_client.pictures[-1]) == 128)
    with viewed.turns:
        viewed.trainer.train_iteration(2)
    assert len(slow_client.pictures) == 1
    slow.set()
    wait_until(lambda: len(slow_client.pictures[-1]) == 128)
    assert len(slow_client.pictures) < 20
    for panel in panels:
        panel.close()


def trained(folder: Path, view: Callable[[Trainer], None] = lambda _: None) -> Trainer:
    trainer = tiny_trainer(config_of(60), VIEWS, folder)
    view(trainer)
    trainer.train()
    return trainer


def test_a_viewed_training_has_bit_for_bit_the_weights_of_another(tmp_path: Path) -> None:
    client, flights = FakeClient(), []

    def view(trainer: Trainer) -> None:
        panel = client.panel(Viewed(trainer))
        panel.renderer.turn = SimpleNamespace(rays=500, record=lambda *_: None)  # type: ignore[assignment]

        def fly() -> None:
            for angle in range(1000):
                client.move(angle / 10)
                panel.viewed.probability(0, lambda: None)
                panel.viewed.occupied_cells()
                time.sleep(0.01)
                if trainer.next_step == 60:
                    break
            panel.close()

        flights.append(threading.Thread(target=fly, daemon=True))
        flights[0].start()
        wait_until(lambda: client.pictures)

    alone, seen = trained(tmp_path / "alone"), trained(tmp_path / "viewed", view)
    flights[0].join(60)
    assert len(client.pictures) > 1  # the first was waited for: at least one more while it trained
    assert int(seen.pipeline.model.grid.level) > 0  # cells have been subdivided under the viewer's eyes
    states = [trainer.pipeline.model.state_dict() for trainer in (alone, seen)]
    for name, value in states[0].items():
        assert torch.equal(states[1][name], value), name
    assert torch.equal(alone.pipeline.model.random.get_state(), seen.pipeline.model.random.get_state())
