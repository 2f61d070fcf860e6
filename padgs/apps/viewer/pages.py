"""Pages of the viewer: controls and a render thread for each browser, and updates from training."""

import shlex
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from io import BytesIO
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from padgs.apps.viewer import renders
from padgs.apps.viewer.controls import CropControls, FilmControls
from padgs.apps.viewer.renders import CAMERAS, LAYERS, Box, RunRenderer, ViewOptions
from padgs.apps.viewer.server import Server
from padgs.data.camera_paths import gravity
from padgs.gaussians import rotation_matrices
from padgs.runs.load import LoadedRun
from padgs.scene import View

IDLE_SECONDS = 0.2  # without a change, after which the full resolution is rendered
UPDATE_SECONDS = 1.0  # between searches for a newer checkpoint
FRAME_SECONDS = 0.06  # target while something changes; the resolution adapts
MIN_RESOLUTION = 0.125  # factor on width and height
WIDTHS = ("512", "768", "1024", "1536", "2048")
FOVS, GAINS = range(20, 141), range(1, 17)  # degrees, factors
HELP = "**drag**: look around; **right-drag**: shift; **scroll**: go; keys **W A S D** go, **Q E** down and up"
MAX_NUMBER = 1e15  # of a camera or crop, whose square is a finite float32
BOTH = "side by side"


@dataclass(frozen=True)
class PageState:
    """Controls and camera of a page."""

    options: ViewOptions
    cam_from_world: Tensor  # [4, 4]
    width: int
    height: int
    renderers: tuple[RunRenderer, ...]
    names: tuple[str, ...] = ()  # of the renderers, written into a comparison

    def render(self, resolution: float) -> np.ndarray:
        """Render the image at a fraction of its full width and height."""
        width, options = self.width // len(self.renderers), self.options
        place = (options, self.cam_from_world, width, self.height, resolution)
        images = [renderer.render(*place) for renderer in self.renderers]
        if options.layer != "colours":
            scale = self.renderers[0].run.scene.scale
            images = [renders.with_legend(image, options.layer, scale, options.gain) for image in images]
        if len(images) == 1:
            return images[0]
        captioned = (renders.captioned(image, name) for image, name in zip(images, self.names, strict=True))
        return renders.side_by_side(*captioned)


class Page:
    """Controls and render thread of a viser client."""

    def __init__(
        self, client: Any, renderers: Sequence[RunRenderer], box: Box, lock: threading.Lock, *, may_stop: bool
    ) -> None:
        """Add the controls to a `viser.ClientHandle`; pages share the processor by a `lock`; `may_stop` training."""
        self._client, self._renderers, self._lock = client, tuple(renderers), lock
        self._changed, self._closed = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._render_loop, daemon=True, name="padgs page")
        scene = renderers[0].run.scene
        self._views = {view.name: view for view in (*scene.train, *scene.test)}
        gui = client.gui
        gui.add_markdown(HELP)
        self._summary = gui.add_html("rendering the first image")
        self._camera = gui.add_dropdown("camera", CAMERAS)
        layers = tuple(layer for layer in LAYERS if layer != "error" or scene.train[0].load_pixels is not None)
        self._layer = gui.add_dropdown("show", layers)
        self._gain = gui.add_slider("gain of the error", min=GAINS[0], max=GAINS[-1], step=1, initial_value=1)
        folders = [renderer.run.folder.name for renderer in renderers]
        names = folders if len(folders) == 1 else [f"{number}: {name}" for number, name in enumerate(folders, 1)]
        self._by_name = dict(zip(names, self._renderers, strict=True))
        runs = tuple(names) if len(names) == 1 else (*names, BOTH)
        self._run = gui.add_dropdown("run", runs)
        self._fov = gui.add_slider("degrees across", min=FOVS[0], max=FOVS[-1], step=1, initial_value=75)
        self._width = gui.add_dropdown("pixels across", WIDTHS, initial_value="1024")
        self._offers = {"camera": CAMERAS, "layer": layers, "gain": GAINS, "run": runs, "fov": FOVS, "width": WIDTHS}
        self._target = gui.add_dropdown("go to", ("", *self._views))
        self._frusta_shown = gui.add_checkbox("cameras", initial_value=False)
        self._level = gui.add_checkbox("level panoramas", initial_value=True, hint="dragging does not tilt them")
        gui.add_button("save picture").on_click(lambda _: self.save_picture())
        if may_stop and any(renderer.run.result is None for renderer in renderers):
            gui.add_button("stop and score", hint="end training now").on_click(lambda _: self._confirm_stop())
        folder, can_crop = renderers[0].run.folder, all(renderer.can_crop for renderer in renderers)
        poses = torch.stack([view.cam_from_world for view in scene.panoramas])
        self._up = torch.tensor(gravity(poses).up, dtype=torch.float64)
        model = getattr(renderers[0].run, "file", folder)  # as commands name it
        words = shlex.join([str(model), *renderers[0].run.opened_with])
        self._crop = CropControls(client, box, words if model.is_dir() else "", can_crop, self.redraw)
        self._film = FilmControls(client, folder, words, scene.origin, lambda: self.state().cam_from_world, may_stop)
        self._frusta = [self._frustum(view) for view in self._views.values()]
        for control in (self._camera, self._layer, self._gain, self._run, self._fov, self._width, self._level):
            control.on_update(self.redraw)
        self._frusta_shown.on_update(self.redraw)
        self._target.on_update(lambda _: self.go_to(self._views.get(self._target.value)))
        client.camera.on_update(self.redraw)
        client.camera.near, client.camera.far = 1e-3 * scene.scale, 1e3 * scene.scale

    def start(self) -> None:
        """Start the render thread."""
        self._changed.set()
        self._thread.start()

    def redraw(self, _: object = None) -> None:
        """Render again, because something has changed."""
        self._changed.set()

    def close(self) -> None:
        """Stop the render thread, and wait for it."""
        self._closed.set()
        self._changed.set()
        self._thread.join()

    def go_to(self, view: View | None) -> None:
        """Move the camera to a view of the scene, if there is one."""
        if view is None:
            return
        world_from_cam = view.cam_from_world[:3, :3].mT.cpu().numpy()
        with self._client.atomic():
            self._client.camera.position = view.center.cpu().numpy()
            self._client.camera.wxyz = wxyz_of(world_from_cam)

    def state(self) -> PageState:
        """Return the state of controls and camera; a ValueError for values that the page does not offer."""
        for name, offer in self._offers.items():  # any message may come from a browser
            if (value := getattr(self, f"_{name}").value) not in offer:
                raise ValueError(f"{name} = {str(value)[:40]!r} is not one of the page's choices; choose one of them")
        crop = self._crop.box
        fov, gain = float(self._fov.value), float(self._gain.value)
        options = ViewOptions(self._camera.value, self._layer.value, fov, crop, gain)
        camera = self._client.camera
        numbers = np.concatenate((camera.wxyz, camera.position, *(crop or ())))
        if not np.all(np.abs(numbers) < MAX_NUMBER) or not np.linalg.norm(camera.wxyz) > 1 / MAX_NUMBER:  # also NaN
            raise ValueError(f"camera and crop need a rotation and numbers below {MAX_NUMBER:g}; reload the page")
        world_from_cam = rotation_matrices(torch.as_tensor(camera.wxyz)).numpy()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = world_from_cam.T, -world_from_cam.T @ camera.position
        width, height = sides(int(self._width.value), camera.aspect)
        names = tuple(self._by_name) if self._run.value == BOTH else (self._run.value,)
        cam_from_world = torch.from_numpy(pose)
        if options.camera == "panorama" and self._level.value:
            cam_from_world = renders.level(cam_from_world, self._up)
        return PageState(options, cam_from_world, width, height, tuple(self._by_name[name] for name in names), names)

    def save_picture(self) -> None:
        """Let the browser download the picture, at full resolution."""
        with self._lock:
            image = (state := self.state()).render(1.0)
        content = BytesIO()
        Image.fromarray(image).save(content, "PNG")
        name = "-".join(renderer.run.folder.name for renderer in state.renderers)
        self._client.send_file_download(f"{name}.png", content.getvalue())

    def _confirm_stop(self) -> None:
        gui = self._client.gui
        with gui.add_modal("Stop training now?") as question:
            gui.add_markdown("The schedule ends early, and the model is scored after fewer iterations than planned.")
            stop, resume = gui.add_button("stop training"), gui.add_button("continue training")
        stop.on_click(lambda _: [renderer.stop() for renderer in self._renderers])
        for answer in (stop, resume):
            answer.on_click(lambda _: question.close())

    def _frustum(self, view: View) -> Any:
        frustum = self._client.scene.add_camera_frustum(
            f"/cameras/{view.name}",
            fov=1.0,
            aspect=1.5,
            scale=0.05 * self._renderers[0].run.scene.scale,
            thickness=1.5,
            thickness_units="screen",
            color=(40, 120, 220),
            wxyz=wxyz_of(view.cam_from_world[:3, :3].mT.cpu().numpy()),
            position=view.center.cpu().numpy(),
            visible=False,
        )
        frustum.on_click(lambda _: self.go_to(view))
        return frustum

    def _render_loop(self) -> None:
        resolution, full = 0.5, False
        while not self._closed.is_set():
            if not self._changed.wait(IDLE_SECONDS) and full:
                continue
            full = not self._changed.is_set()
            self._changed.clear()
            try:
                seconds = self._update(self.state(), 1.0 if full else resolution)
            except Exception as error:  # of any method; shown on the page, which continues
                if self._closed.is_set():
                    return
                self._summary.content = f"<b>{type(error).__name__}</b>: {escape(str(error), quote=False)}"
                continue
            if not full:
                change = (FRAME_SECONDS / max(seconds, 1e-3)) ** 0.5
                resolution = min(1.0, max(MIN_RESOLUTION, resolution * change))

    def _update(self, state: PageState, resolution: float) -> float:
        """Render and send an image; returns the seconds of rendering."""
        with self._lock:
            start = time.perf_counter()
            image = state.render(resolution)
            seconds = time.perf_counter() - start
        camera = self._client.camera
        has_overlay = state.options.camera == "perspective" and len(state.renderers) == 1
        with self._client.atomic():
            if has_overlay:  # frusta are drawn by viser with the same lens
                camera.fov = 2 * np.arctan(np.tan(np.radians(state.options.fov) / 2) * state.height / state.width)
            for frustum in self._frusta:
                frustum.visible = bool(self._frusta_shown.value) and has_overlay
            self._crop.show(has_overlay)
            self._client.scene.set_background_image(image, format="jpeg", jpeg_quality=90 if resolution == 1 else 60)
            text = f"{1000 * seconds:.0f} ms, {image.shape[1]}x{image.shape[0]}"
            if state.options.layer == "error":
                text += f"; error of {state.renderers[0].nearest(state.cam_from_world).name}"
            # Names and errors come from other people's files.
            lines = [escape(line, quote=False) for line in (*(one.summary for one in state.renderers), text)]
            self._summary.content = "<br>".join(lines)
        return seconds


def wxyz_of(matrix: np.ndarray) -> np.ndarray:
    """Return the quaternion [4] of a rotation [3, 3]."""
    from viser.transforms import SO3

    return SO3.from_matrix(matrix).wxyz


def sides(longer: int, aspect: float) -> tuple[int, int]:
    """Return width and height, at least 2, of an image with a given longer side and aspect ratio.

    >>> sides(1024, 1.6), sides(1024, 0.5)
    ((1024, 640), (512, 1024))
    """
    shorter = max(2, round(longer * min(aspect, 1 / aspect)))
    return (longer, shorter) if aspect >= 1 else (shorter, longer)


@contextmanager
def show_runs(server: Server, runs: Sequence[LoadedRun]) -> Iterator[dict[int, Page]]:
    """Show one run, or two of a scene to compare, in all connected browsers until the context ends.

    Runs in training are shown from their last checkpoint, and followed. Pages can stop training if the server is local,
    and change nothing else. Yields the page of each connected client, by its number.
    """
    # A browser was closed while rendering; or values have a wrong type.
    warnings.filterwarnings("ignore", message=r"Queued .* on a closed connection|\[viser\]")
    renderers, scene, viser = [RunRenderer(run) for run in runs], runs[0].scene, server.viser
    up = np.array(gravity(torch.stack([view.cam_from_world for view in scene.panoramas])).up)
    viser.scene.set_up_direction(up)
    viser.gui.set_panel_label(f"padgs: {scene.name}")
    first = scene.panoramas[len(scene.panoramas) // 2]
    center = first.center.cpu().numpy()
    target = center + 0.3 * scene.scale * first.cam_from_world[2, :3].cpu().numpy()
    viser.initial_camera.position, viser.initial_camera.look_at, viser.initial_camera.up = center, target, up
    box, lock = crop_box(scene.points), threading.Lock()
    pages: dict[int, Page] = {}

    @viser.on_client_connect
    def _(client: Any) -> None:
        with client.atomic():  # it may have connected before the runs were loaded
            client.camera.up_direction, client.camera.position, client.camera.look_at = up, center, target
        page = pages[client.client_id] = Page(client, renderers, box, lock, may_stop=server.is_local)
        page.start()

    @viser.on_client_disconnect
    def _(client: Any) -> None:
        if page := pages.pop(client.client_id, None):
            page.close()

    ended = threading.Event()
    updates = threading.Thread(target=_update, args=(renderers, pages, lock, ended), daemon=True, name="padgs view")
    updates.start()
    try:
        yield pages
    finally:
        ended.set()
        updates.join()
        for page in list(pages.values()):
            page.close()


def _update(shown: Sequence[RunRenderer], pages: dict[int, Page], lock: threading.Lock, ended: threading.Event) -> None:
    """Redraw all pages whenever training has written a checkpoint."""
    while not ended.wait(UPDATE_SECONDS):
        with lock:
            changed = [renderer.update() for renderer in shown]
        if any(changed):
            for page in list(pages.values()):
                page.redraw()


def crop_box(points: torch.Tensor) -> Box:
    """Return a box around 98 % of the points [P, 3] along each axis."""
    some = points[:: max(1, len(points) // 100_000)].double()
    low, high = (some.quantile(share, dim=0).tolist() for share in (0.01, 0.99))
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
