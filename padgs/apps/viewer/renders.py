"""What a page shows of a run: a picture for each thing that it may ask for. Knows no page."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from padgs.evaluation.images import depth_image, error_image, to_uint8
from padgs.geometry.camera import Panorama, Pinhole, perspective
from padgs.geometry.panorama import sample
from padgs.methods.anchors.trainee import AnchorTrainee
from padgs.methods.splats.trainee import SplatTrainee
from padgs.runs.opened import OpenedRun
from padgs.scene import View
from padgs.training.method import Method

CAMERAS = ("perspective", "panorama")
LAYERS = ("colours", "depth", "error")
Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # lowest and highest corner, world units


@dataclass(frozen=True)
class Look:
    """What is asked for, but for the place and the size."""

    camera: str = "perspective"  # a name of `CAMERAS`
    layer: str = "colours"  # a name of `LAYERS`; error: of the nearest photograph, from where that was taken
    fov: float = 75.0  # degrees across a perspective picture
    crop: Box | None = None  # what lies outside is not drawn


class Gallery:
    """The pictures of one run, finished or in training.

    Attributes:
        run: whose.
        follows: whether `follow` takes over what training makes of it.
    """

    def __init__(self, run: OpenedRun) -> None:
        """Prepare; nothing is drawn yet."""
        self.run, self.follows, self._trouble = run, run.result is None, ""
        self._method = lru_cache(maxsize=2)(self._prepared)
        self._error = lru_cache(maxsize=8)(self._error_of)

    @property
    def crops(self) -> bool:
        """Whether what the run has learned has places, so that it can be cropped."""
        return isinstance(self.run.method.trainee, (SplatTrainee, AnchorTrainee))

    @property
    def facts(self) -> str:
        """What the run consists of, and how far it is, for people."""
        counts = ", ".join(f"{count} {name}" for name, count in self.run.method.size().counts.items())
        facts = counts if self.run.result is not None else f"{counts} after {self.run.iteration} iterations"
        return f"{facts}; not followed: {self._trouble}" if self._trouble else facts

    def stop(self) -> None:
        """Ask a run in training to end now and be scored; nothing to one that is finished."""
        files = self.run.files
        if files.result() is None:
            files.stop.touch()

    def follow(self) -> bool:
        """Show what training has come to since, or why that cannot be shown; whether there is anything new."""
        trouble, run = "", None
        try:
            run = self.run.renewed() if self.follows else None
        except Exception as error:  # often for a moment only, where the next checkpoint takes its place
            trouble = str(error)
        changed, self._trouble = trouble != self._trouble, trouble
        if run is not None:
            self.run = run
            self._method.cache_clear()
            self._error.cache_clear()
        return changed or run is not None

    def picture(self, look: Look, cam_from_world: Tensor, width: int, height: int, share: float = 1.0) -> np.ndarray:
        """The picture [h, w, 3] uint8, of the shape that is asked for.

        Args:
            look: what is shown.
            cam_from_world: [4, 4] from where.
            width, height: pixels at full resolution; a panorama leaves some of them black.
            share: of width and height that are drawn; filters stay those of the full resolution, or grow.
        """
        full, lens = (self._lens(look, max(2, round(s * width)), max(2, round(s * height))) for s in (1.0, share))
        view = View("page", cam_from_world, lens.width, lens.height, lens=lens)
        if look.layer == "error":
            drawn = self._error_from(view)
        else:
            rendering = self._method(full, look.crop).render(view)
            drawn = (
                to_uint8(rendering.image)
                if look.layer == "colours"
                else depth_image(rendering, self.run.scene.scale)
            )
        return drawn if isinstance(lens, Pinhole) else _framed(drawn, max(2, round(share * height)))

    def nearest(self, cam_from_world: Tensor) -> View:
        """The photograph that was taken nearest to a pose."""
        center = View("", cam_from_world, 1, 1).center
        views = (*self.run.scene.train, *self.run.scene.test)
        return min(views, key=lambda view: (view.center - center.to(view.center)).norm().item())

    @staticmethod
    def _lens(look: Look, width: int, height: int) -> Panorama | Pinhole:
        if look.camera == "perspective":
            return perspective(width, height, look.fov)
        height = min(height, width // 2)
        return Panorama(2 * height, height)

    def _prepared(self, full: Panorama | Pinhole, crop: Box | None) -> Method:
        method = self.run.through(full)
        if crop is None or not self.crops:
            return method
        return cropped(method.drawn_with(method.render_config), crop)

    def _error_from(self, view: View) -> np.ndarray:
        """The error of the nearest photograph, in the directions that a view has."""
        taken = self.nearest(view.cam_from_world)
        error = torch.from_numpy(self._error(taken.name)).float()
        turn = (taken.cam_from_world[:3, :3] @ view.cam_from_world[:3, :3].mT.to(taken.cam_from_world)).float().cpu()
        return sample(error, view.camera.rays() @ turn.mT).round().byte().numpy()

    def _error_of(self, name: str) -> np.ndarray:
        scene = self.run.scene
        view = next(view for view in (*scene.train, *scene.test) if view.name == name)
        image = self.run.method.render(view).image
        truth, mask = view.image(device=image.device), view.mask(device=image.device)
        return error_image(image if mask is None else torch.lerp(truth, image, mask[..., None]), truth).copy()


def cropped(method: Method, crop: Box) -> Method:
    """The method without all that lies outside of a box, in place; only good for drawing."""
    trainee = method.trainee
    places = trainee.model.positions if isinstance(trainee, AnchorTrainee) else trainee.splats.means
    low, high = (places.new_tensor(corner) for corner in crop)
    trainee.keep(((places >= low) & (places <= high)).all(-1))
    return method


def beside(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Two pictures of one height side by side, with a line between them."""
    return np.concatenate((left, np.full_like(left[:, :2], 255), right), axis=1)


def _framed(picture: np.ndarray, height: int) -> np.ndarray:
    """A picture in the middle of a black one of another height."""
    room = height - len(picture)
    return np.pad(picture, ((room // 2, room - room // 2), (0, 0), (0, 0)))
