"""What a server shows: a page of the same runs for each browser, which follow the training of those."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from padgs.apps.viewer.page import Page
from padgs.apps.viewer.picture import Box, Gallery
from padgs.apps.viewer.server import Serving
from padgs.data.trajectory import gravity
from padgs.runs.opened import OpenedRun

EVERY = 1.0  # seconds between two looks at whether there is a newer checkpoint


@contextmanager
def showing(server: Serving, runs: Sequence[OpenedRun]) -> Iterator[dict[int, Page]]:
    """Show one run, or two to compare, in the browsers that are there and those that come, until the context ends.
    They change nothing, but may end training where only this machine is served.

    A run in training is shown as its last checkpoint has it, and followed.

    Args:
        server: of `serving`.
        runs: of one scene, the first one's.

    Returns:
        The page of each client that is there, by its number.

    Raises:
        DataError: the data set is not where it was.
    """
    warnings.filterwarnings("ignore", message="Queued .* on a closed connection")  # a page left while it was drawn for
    galleries, scene, viser = [Gallery(run) for run in runs], runs[0].scene, server.viser
    up = np.array(gravity(torch.stack([view.cam_from_world for view in scene.train])).up)
    viser.scene.set_up_direction(up)
    viser.gui.set_panel_label(f"padgs: {scene.name}")
    first = scene.train[len(scene.train) // 2]
    center = first.center.cpu().numpy()
    ahead = center + 0.3 * scene.scale * first.cam_from_world[2, :3].cpu().numpy()
    viser.initial_camera.position, viser.initial_camera.look_at, viser.initial_camera.up = center, ahead, up
    box, drawing = box_of(scene.points), threading.Lock()
    pages: dict[int, Page] = {}

    @viser.on_client_connect
    def _(client: Any) -> None:
        with client.atomic():  # one that was there before the runs were has been somewhere else
            client.camera.up_direction, client.camera.position, client.camera.look_at = up, center, ahead
        page = pages[client.client_id] = Page(client, galleries, box, drawing, may_stop=server.is_local)
        page.start()

    @viser.on_client_disconnect
    def _(client: Any) -> None:
        if page := pages.pop(client.client_id, None):
            page.leave()

    ended = threading.Event()
    follower = threading.Thread(target=_follow, args=(galleries, pages, drawing, ended), daemon=True, name="padgs view")
    follower.start()
    try:
        yield pages
    finally:
        ended.set()
        follower.join()
        for page in list(pages.values()):
            page.leave()


def _follow(
    galleries: Sequence[Gallery], pages: dict[int, Page], drawing: threading.Lock, ended: threading.Event
) -> None:
    """Until the end, let pages draw again whenever training has come further."""
    while not ended.wait(EVERY):
        with drawing:
            news = [gallery.follow() for gallery in galleries]
        if any(news):
            for page in list(pages.values()):
                page.renew()


def box_of(points: torch.Tensor) -> Box:
    """A box around nearly all of the points [P, 3]."""
    some = points[:: max(1, len(points) // 100_000)].double()
    low, high = (some.quantile(share, dim=0).tolist() for share in (0.01, 0.99))
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
