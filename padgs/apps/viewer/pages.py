"""Pages."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.apps.viewer.renders import CAMERAS, LAYERS, Box, Gallery, Look, beside
from padgs.apps.viewer.server import Serving
from padgs.data.camera_paths import gravity
from padgs.runs.opened import OpenedRun
from padgs.scene import View

STILL = 0.2  # seconds without a change, after which the full resolution is drawn
FRAME = 0.06  # seconds that a frame may take while something changes; resolution follows
COARSEST = 0.125  # share of the full width and height
WIDTHS = ("512", "768", "1024", "1536", "2048")
BOTH = "side by side"


@dataclass(frozen=True)
class Asked:
    """What a page shows next."""

    look: Look
    cam_from_world: Tensor  # [4, 4]
    width: int
    height: int
    galleries: tuple[Gallery, ...]

    def drawn(self, share: float) -> np.ndarray:
        """The picture at a share of its full width and height."""
        width = self.width // len(self.galleries)
        pictures = [
            gallery.picture(self.look, self.cam_from_world, width, self.height, share) for gallery in self.galleries
        ]
        return pictures[0] if len(pictures) == 1 else beside(*pictures)


class Page:
    """A client of viser with its controls; `start` draws for it until it leaves."""

    def __init__(
        self, client: Any, galleries: Sequence[Gallery], box: Box, drawing: threading.Lock, *, may_stop: bool
    ) -> None:
        """Lay out the controls.

        Args:
            client: a `viser.ClientHandle`.
            galleries: one run, or two.
            box: what is cropped to at first.
            drawing: held while a picture is drawn: pages share the processor.
            may_stop: whether it may end training, the only thing that a page can do to a run.
        """
        self._client, self._galleries, self._drawing = client, tuple(galleries), drawing
        self._changed, self._left = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._draw, daemon=True, name="padgs page")
        scene = galleries[0].run.scene
        self._views = {view.name: view for view in (*scene.train, *scene.test)}
        gui = client.gui
        self._facts = gui.add_markdown("drawing the first picture")
        self._camera = gui.add_dropdown("camera", CAMERAS)
        self._layer = gui.add_dropdown("show", LAYERS)
        folders = [gallery.run.folder.name for gallery in galleries]
        names = folders if len(folders) == 1 else [f"{number}: {name}" for number, name in enumerate(folders, 1)]
        self._named = dict(zip(names, self._galleries, strict=True))
        self._which = gui.add_dropdown("run", names if len(names) == 1 else (*names, BOTH))
        self._fov = gui.add_slider("degrees across", min=20, max=140, step=1, initial_value=75)
        self._width = gui.add_dropdown("pixels across", WIDTHS, initial_value="1024")
        self._goal = gui.add_dropdown("go to", ("", *self._views))
        self._frusta_shown = gui.add_checkbox("cameras", initial_value=False)
        if any(gallery.run.result is None for gallery in galleries):
            follow = gui.add_checkbox("follow training", initial_value=any(gallery.follows for gallery in galleries))
            follow.on_update(lambda _: self._follow(follow.value))
            if may_stop:
                gui.add_button("stop and score", hint="end training now").on_click(
                    lambda _: self._ask_whether_to_stop()
                )
        with gui.add_folder("crop", expand_by_default=False):
            able = all(gallery.crops for gallery in galleries)
            self._crop = gui.add_checkbox("crop", initial_value=False, disabled=not able)
            step = float(np.ptp(box, axis=0).max() / 200)
            self._low, self._high = (
                gui.add_vector3(name, tuple(float(f"{step * round(c / step):.6g}") for c in corner), step=step)
                for name, corner in zip(("lowest", "highest"), box, strict=True)
            )
        self._frusta = [self._frustum(view) for view in self._views.values()]
        for control in (self._camera, self._layer, self._which, self._fov, self._width, self._frusta_shown):
            control.on_update(self.renew)
        for control in (self._crop, self._low, self._high):
            control.on_update(self.renew)
        self._goal.on_update(lambda _: self.go_to(self._views[self._goal.value]) if self._goal.value else None)
        client.camera.on_update(self.renew)
        client.camera.near, client.camera.far = 1e-3 * scene.scale, 1e3 * scene.scale

    def start(self) -> None:
        """Draw, in a thread of its own, whatever is asked for next."""
        self._changed.set()
        self._thread.start()

    def renew(self, _: object = None) -> None:
        """Draw again: something has changed."""
        self._changed.set()

    def leave(self) -> None:
        """Stop drawing; returns when it has stopped."""
        self._left.set()
        self._changed.set()
        self._thread.join()

    def go_to(self, view: View) -> None:
        """Stand where a photograph was taken, and look along its middle."""
        world_from_cam = view.cam_from_world[:3, :3].mT.cpu().numpy()
        with self._client.atomic():
            self._client.camera.position = view.center.cpu().numpy()
            self._client.camera.wxyz = wxyz_of(world_from_cam)

    def asked(self) -> Asked:
        """What the controls and the camera say now."""
        crop: Box | None = (self._low.value, self._high.value) if self._crop.value else None
        look = Look(self._camera.value, self._layer.value, float(self._fov.value), crop)
        camera = self._client.camera
        world_from_cam = matrix_of(camera.wxyz)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = world_from_cam.T, -world_from_cam.T @ camera.position
        width, height = sides(int(self._width.value), camera.aspect)
        shown = self._galleries if self._which.value == BOTH else (self._named[self._which.value],)
        return Asked(look, torch.from_numpy(pose), width, height, shown)

    def _follow(self, follows: bool) -> None:
        for gallery in self._galleries:  # of all pages
            gallery.follows = follows

    def _ask_whether_to_stop(self) -> None:
        gui = self._client.gui
        with gui.add_modal("End training now?") as question:
            gui.add_markdown("It fades out and is scored after fewer iterations than planned.")
            end, go_on = gui.add_button("end training"), gui.add_button("go on training")
        end.on_click(lambda _: [gallery.stop() for gallery in self._galleries])
        for answer in (end, go_on):
            answer.on_click(lambda _: question.close())

    def _frustum(self, view: View) -> Any:
        frustum = self._client.scene.add_camera_frustum(
            f"/cameras/{view.name}",
            fov=1.0,
            aspect=1.5,
            scale=0.05 * self._galleries[0].run.scene.scale,
            thickness=1.5,
            thickness_units="screen",
            color=(40, 120, 220),
            wxyz=wxyz_of(view.cam_from_world[:3, :3].mT.cpu().numpy()),
            position=view.center.cpu().numpy(),
            visible=False,
        )
        frustum.on_click(lambda _: self.go_to(view))
        return frustum

    def _draw(self) -> None:
        share, full = 0.5, False
        while not self._left.is_set():
            if not self._changed.wait(STILL) and full:
                continue
            full = not self._changed.is_set()
            self._changed.clear()
            try:
                seconds = self._put(self.asked(), 1.0 if full else share)
            except Exception as error:  # of any method: said on the page, which goes on
                if self._left.is_set():
                    return
                self._facts.content = f"**{type(error).__name__}**: {error}"
                continue
            if not full:
                share = min(1.0, max(COARSEST, share * (FRAME / max(seconds, 1e-3)) ** 0.5))

    def _put(self, asked: Asked, share: float) -> float:
        """Draw and send a picture; the seconds that drawing took."""
        with self._drawing:
            start = time.perf_counter()
            picture = asked.drawn(share)
            seconds = time.perf_counter() - start
        camera = self._client.camera
        whole = asked.look.camera == "perspective" and len(asked.galleries) == 1
        with self._client.atomic():
            if whole:  # what lies over the picture is seen by the same lens
                camera.fov = 2 * np.arctan(np.tan(np.radians(asked.look.fov) / 2) * asked.height / asked.width)
            for frustum in self._frusta:
                frustum.visible = bool(self._frusta_shown.value) and whole
            self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90 if share == 1 else 60)
            facts = f"{1000 * seconds:.0f} ms, {picture.shape[1]}x{picture.shape[0]}"
            if asked.look.layer == "error":
                facts += f"; error of {asked.galleries[0].nearest(asked.cam_from_world).name}"
            self._facts.content = "  \n".join((*(gallery.facts for gallery in asked.galleries), facts))
        return seconds


def wxyz_of(matrix: np.ndarray) -> np.ndarray:
    """The quaternion [4] of a rotation [3, 3]."""
    from viser.transforms import SO3

    return SO3.from_matrix(matrix).wxyz


def matrix_of(wxyz: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] of a quaternion [4]."""
    from viser.transforms import SO3

    return SO3(wxyz).as_matrix()


def sides(longer: int, aspect: float) -> tuple[int, int]:
    """Width and height of a picture, at least 2, whose longer side is given: a phone may stand.

    >>> sides(1024, 1.6), sides(1024, 0.5)
    ((1024, 640), (512, 1024))
    """
    shorter = max(2, round(longer * min(aspect, 1 / aspect)))
    return (longer, shorter) if aspect >= 1 else (shorter, longer)


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
