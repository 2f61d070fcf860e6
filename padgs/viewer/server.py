"""The server that pages come from: viser, on this machine alone unless another address is given."""

from __future__ import annotations

import socket
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
import torch

from padgs.data.trajectory import gravity
from padgs.extras import installing
from padgs.runs.opened import OpenedRun
from padgs.viewer.page import Page
from padgs.viewer.picture import Box, Gallery

LOCAL, PORT = "127.0.0.1", 8080
EVERYWHERE = "0.0.0.0"  # any address of this machine
EVERY = 1.0  # seconds between two looks at whether there is a newer checkpoint


@dataclass(frozen=True)
class Serving:
    """A server at work."""

    address: str  # for a browser
    pages: dict[int, Page] = field(default_factory=dict)  # by the number of the client


@contextmanager
def serving(runs: Sequence[OpenedRun], *, host: str = LOCAL, port: int = PORT) -> Iterator[Serving]:
    """Serve one run, or two to compare, to any number of browsers, until the context ends. They change nothing, but
    may end training where only this machine is served.

    A run in training is shown as its last checkpoint has it, and followed.

    Args:
        runs: of one scene, the first one's.
        host: `LOCAL` is this machine alone.
        port: the first to try; the next free one is taken.

    Raises:
        ValueError: the extra `view` is not installed.
        OSError: the address cannot be served.
    """
    viser = viser_module()
    warnings.filterwarnings("ignore", message="Queued .* on a closed connection")  # a page left while it was drawn for
    galleries, scene = [Gallery(run) for run in runs], runs[0].scene
    local = is_local(host)
    with redirect_stdout(None):  # it draws a box around addresses, whatever `verbose` says
        server = viser.ViserServer(host=host, port=port, label=f"padgs: {scene.name}", verbose=False)
    up = np.array(gravity(torch.stack([view.cam_from_world for view in scene.train])).up)
    server.scene.set_up_direction(up)
    server.gui.configure_theme(dark_mode=True, show_share_button=False)  # sharing would go through a stranger's server
    first = scene.train[len(scene.train) // 2]
    center = first.center.cpu().numpy()
    server.initial_camera.position = center
    server.initial_camera.look_at = center + 0.3 * scene.unit * first.cam_from_world[2, :3].cpu().numpy()
    server.initial_camera.up = up
    box, drawing = box_of(scene.points), threading.Lock()
    name = "localhost" if local else own_address() if host == EVERYWHERE else host
    found = Serving(f"http://{name}:{server.get_port()}")

    @server.on_client_connect
    def _(client: Any) -> None:
        page = found.pages[client.client_id] = Page(client, galleries, box, drawing, may_stop=local)
        page.start()

    @server.on_client_disconnect
    def _(client: Any) -> None:
        if page := found.pages.pop(client.client_id, None):
            page.leave()

    ended = threading.Event()
    follower = threading.Thread(target=_follow, args=(galleries, found, drawing, ended), daemon=True, name="padgs view")
    follower.start()
    try:
        yield found
    finally:
        ended.set()
        follower.join()
        for page in list(found.pages.values()):
            page.leave()
        with redirect_stdout(None):
            server.stop()


def is_local(host: str) -> bool:
    """Whether only this machine is served."""
    return host in (LOCAL, "localhost")


def own_address() -> str:
    """What others in the network call this machine; localhost where there is no network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as way:
        try:
            way.connect(("192.0.2.1", 9))  # no machine has this address: the way out is looked up, nothing is sent
        except OSError:
            return "localhost"
        return way.getsockname()[0]


def viser_module() -> ModuleType:
    """The package that serves.

    Raises:
        ValueError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise ValueError(f"the viewer needs viser: {installing('view')}") from error
    return viser


def _follow(galleries: Sequence[Gallery], serving: Serving, drawing: threading.Lock, ended: threading.Event) -> None:
    """Until the end, let pages draw again whenever training has come further."""
    while not ended.wait(EVERY):
        with drawing:
            news = [gallery.follow() for gallery in galleries]
        if any(news):
            for page in list(serving.pages.values()):
                page.renew()


def box_of(points: torch.Tensor) -> Box:
    """A box around nearly all of the points [P, 3]."""
    some = points[:: max(1, len(points) // 100_000)].double()
    low, high = (some.quantile(share, dim=0).tolist() for share in (0.01, 0.99))
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
