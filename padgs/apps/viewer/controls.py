"""Groups of controls of a page: a crop box with handles, and a film of views."""

import json
import shlex
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padgs.apps.camera_path_video import free_name
from padgs.apps.viewer.renders import Box
from padgs.files import write_atomically
from padgs.scene import move_origin

CORNERS = np.array(list(product((0, 1), repeat=3)))
EDGES = [(a, b) for a in range(8) for b in range(a) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 1]
CROP_COLOR = (255, 180, 40)


class CropControls:
    """A box whose outside is not rendered: numbers, and handles at two corners."""

    def __init__(self, client: Any, box: Box, words: str, can_crop: bool, redraw: Callable[[object], None]) -> None:
        """Add the controls; `box` is the initial one, `words` those of `padgs export` that open the model, if any."""
        self._client, self._words, self._redraw, self._shown = client, words, redraw, False
        size = float(np.ptp(box, axis=0).max()) or 1.0  # of a single Gaussian
        step = size / 200
        with client.gui.add_folder("crop", expand_by_default=False):
            self.is_on = client.gui.add_checkbox("crop", initial_value=False, disabled=not can_crop)
            self.low, self.high = (
                client.gui.add_vector3(name, tuple(float(f"{step * round(c / step):.6g}") for c in corner), step=step)
                for name, corner in zip(("lowest", "highest"), box, strict=True)
            )
            self._command = client.gui.add_markdown("")
        self._handles = []
        for name, corner in (("lowest", self.low), ("highest", self.high)):
            handle = client.scene.add_transform_controls(
                f"/crop/{name}", scale=0.08 * size, disable_rotations=True, depth_test=False, visible=False
            )
            handle.on_update(lambda _, corner=corner, handle=handle: self._dragged(corner, handle))
            self._handles.append(handle)
        self._update()
        for control in (self.is_on, self.low, self.high):
            control.on_update(self._update)

    @property
    def box(self) -> Box | None:
        """The box, if it is switched on."""
        return (self.low.value, self.high.value) if self.is_on.value else None

    def show(self, is_perspective: bool) -> None:
        """Show handles and edges where the page draws them with the lens of the render."""
        if self._shown != (shown := is_perspective and bool(self.is_on.value)):
            self._shown = shown
            self._draw()

    def _dragged(self, corner: Any, handle: Any) -> None:
        corner.value = tuple(float(f"{c:.6g}") for c in handle.position)

    def _update(self, _: object = None) -> None:
        box = self.box
        self._command.content = ""
        if box is not None and self._words:
            numbers = " ".join(f"{c:.6g}" for corner in box for c in corner)
            self._command.content = f"`padgs export {self._words} --crop '{numbers}'`"
        self._draw()
        self._redraw(None)

    def _draw(self) -> None:
        corners = np.array((self.low.value, self.high.value), np.float64)
        if not np.isfinite(corners).all():
            return
        for handle, corner in zip(self._handles, corners, strict=True):
            handle.visible = self._shown
            if not np.allclose(handle.position, corner):
                handle.position = corner
        points = corners[CORNERS, np.arange(3)][np.array(EDGES)]
        self._client.scene.add_line_segments(
            "/crop/edges", points, CROP_COLOR, thickness=2.0, thickness_units="screen", visible=self._shown
        )


class FilmControls:
    """Keyframes of a camera path, saved as a file that `padgs render --path` reads."""

    def __init__(
        self, client: Any, folder: Path, words: str, origin: Tensor, pose: Callable[[], Tensor], may_write: bool
    ) -> None:
        """Add the controls to a `viser.ClientHandle`.

        `folder` is that of the run or beside a file, `words` those of `padgs render` that open the model. Paths are
        stored in the world of the data set, where the scene has its `origin`; `pose` returns the current
        cam_from_world. `may_write`: save beside the run; else the browser downloads the file.
        """
        self._client, self._folder, self._words, self._origin, self._pose = client, folder, words, origin, pose
        self._may_write, self.keyframes = may_write, list[Tensor]()
        with client.gui.add_folder("film", expand_by_default=False):
            client.gui.add_button("add view").on_click(lambda _: self.change(self.keyframes.append, self._pose()))
            remove = client.gui.add_button("remove last view")
            remove.on_click(lambda _: self.change(self.keyframes.pop) if self.keyframes else None)
            client.gui.add_button("save film").on_click(lambda _: self.save())
            self.words = client.gui.add_markdown("Add at least two views, then save the film.")

    def change(self, action: Callable[..., object], *arguments: Tensor) -> None:
        """Change the keyframes, and show their number."""
        action(*arguments)
        self.words.content = f"{len(self.keyframes)} views"

    def save(self) -> None:
        """Save the keyframes in the first free film.json, film-2.json, ... of the run, or let the browser do it."""
        if len(self.keyframes) < 2:
            self.words.content = f"{len(self.keyframes)} views; a film needs at least two"
            return
        poses = move_origin(torch.stack(self.keyframes), -self._origin.cpu())
        content = json.dumps({"keyframes": [{"cam_from_world": pose.tolist()} for pose in poses]}, indent=1).encode()
        reason = ""
        if self._may_write:
            try:
                file = free_name(self._folder / "film.json")
                self._folder.mkdir(parents=True, exist_ok=True)
                write_atomically(file, content)
                self.words.content = f"saved. `padgs render {self._words} --path {shlex.quote(str(file))}`"
                return
            except OSError as error:
                reason = f"cannot write into {self._folder}: {error.strerror or error}; "
        self._client.send_file_download("film.json", content)
        self.words.content = f"{reason}downloaded: `padgs render {self._words} --path film.json` makes the video"
