"""The viewer's server: alone, or beside a training."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress

import numpy as np
import torch
import viser

from edge_se_sampler.data.cameras import find_far
from edge_se_sampler.engine.config import TrainerConfig
from edge_se_sampler.engine.run_folder import RunFolder
from edge_se_sampler.engine.trainer import Trainer
from edge_se_sampler.errors import InputError
from edge_se_sampler.occupancy.hull import find_focus
from edge_se_sampler.viewer.address import ViewerConfig
from edge_se_sampler.viewer.camera_path import View
from edge_se_sampler.viewer.panel import Panel
from edge_se_sampler.viewer.viewed import Viewed

RELOAD_SECONDS = 2.0
"""Between two looks for a newer checkpoint."""


def view_run(run: RunFolder, config: TrainerConfig, address: ViewerConfig) -> None:
    """Show a run until Ctrl-C, and the checkpoints that another process adds to it. InputError for a bad run or data,
    or an address that is taken."""
    address.check()
    viewed = Viewed.load(run, config)
    with suppress(KeyboardInterrupt), open_viewer(viewed, address):
        while True:
            time.sleep(RELOAD_SECONDS)
            with suppress(InputError):  # replaced by a newer one just now
                viewed.reload()


def view_training(trainer: Trainer, address: ViewerConfig, train: Callable[[Trainer], None]) -> None:
    """Train, by calling `train`, while whoever wants looks at the model; then show it until Ctrl-C."""
    with open_viewer(Viewed(trainer), address):
        train(trainer)
        with suppress(KeyboardInterrupt):
            print("the viewer goes on until Ctrl-C", flush=True)
            threading.Event().wait()


@contextmanager
def open_viewer(viewed: Viewed, address: ViewerConfig) -> Iterator[viser.ViserServer]:
    """Show a run to whoever opens the page, whose address is printed."""
    with start_server(address) as server:
        panels: dict[int, Panel] = {}
        scale = set_initial_camera(server, viewed)[1]

        @server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            panels[client.client_id] = panel = Panel(client, viewed, scale)
            if client.client_id not in server.get_clients():  # gone in the meantime
                panel.close()

        @server.on_client_disconnect
        def _(client: viser.ClientHandle) -> None:
            if client.client_id in panels:
                panels.pop(client.client_id).close()

        host = f"[{address.host}]" if ":" in address.host else address.host
        print(f"viewer   http://{host}:{server.get_port()}  (Ctrl-C ends it)", flush=True)
        try:
            yield server
        finally:
            for panel in list(panels.values()):
                panel.close()


@contextmanager
def start_server(address: ViewerConfig) -> Iterator[viser.ViserServer]:
    """A server without content; viser's own lines on stdout are left out. InputError: the port is taken."""
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(address.host, address.port, label="edge-se", verbose=False)
    try:
        if address.port not in (0, server.get_port()):  # viser takes the next one instead
            raise address.taken()
        server.gui.configure_theme(show_share_button=False)  # it would publish the page through a stranger's server
        yield server
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def set_initial_camera(server: viser.ViserServer, viewed: Viewed) -> tuple[np.ndarray, float]:
    """Begin at the first training camera, looking at what all of them look at; returns that point (3,), and how far it
    is from them, world units. Cameras that are far from all others do not count."""
    cameras = viewed.cameras.to("cpu").to(dtype=torch.float64)
    far, _ = find_far(cameras.camera_to_worlds[:, :, 3].numpy())
    cameras = cameras[np.flatnonzero(~far).tolist()]
    focus, depth = find_focus(cameras)
    view, start = View.of_training(cameras, 0), server.initial_camera
    if not depth.any():  # all look the same way: at what is halfway between near and far
        depth = np.full(len(depth), sum(viewed.trainer.config.pipeline.model.depths) / 2)
        focus = view.pose[:, 3] - depth[0] * view.pose[:, 2]
    scale = max(float(np.median(np.abs(depth))), 1e-9)
    ahead = max(float(depth[0]), 0.1 * scale)
    server.scene.set_up_direction(viewed.up)
    start.position, start.look_at, start.fov = view.pose[:, 3], view.pose[:, 3] - ahead * view.pose[:, 2], view.fov
    start.near, start.far = 0.01 * scale, 100 * scale
    return focus, scale
