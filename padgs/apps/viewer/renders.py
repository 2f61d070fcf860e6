"""Renders of a run for the viewer: colours, depth or error, cropped, from any pose."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from padgs.data.camera_paths import look_along
from padgs.evaluation.images import DEPTH_COLORS, ERROR_COLORS, ERROR_FULL_SCALE, depth_image, error_image, to_uint8
from padgs.geometry.camera import Panorama, Pinhole, perspective
from padgs.geometry.panorama import sample
from padgs.methods.anchors.method import AnchorModel
from padgs.methods.splats.model import SplatModel
from padgs.runs.load import LoadedRun
from padgs.scene import View
from padgs.training.method import Method

CAMERAS = ("perspective", "panorama")
LAYERS = ("colours", "depth", "error")
Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # lowest and highest corner, world units


@dataclass(frozen=True)
class ViewOptions:
    """Options of a render, except for pose and size."""

    camera: str = "perspective"  # a name of `CAMERAS`
    layer: str = "colours"  # a name of `LAYERS`; error: at the nearest view of the scene
    fov: float = 75.0  # horizontal degrees of a perspective camera
    crop: Box | None = None  # Gaussians outside are not rendered
    gain: float = 1.0  # factor on the error


class RunRenderer:
    """Renderer of a run: of a finished one, or of the newest checkpoint of one that was in training at first."""

    def __init__(self, run: LoadedRun) -> None:
        self.run, self._is_following, self._failure = run, run.result is None, ""
        self._method = lru_cache(maxsize=2)(self._method_for)
        self._error = lru_cache(maxsize=8)(self._error_image)

    @property
    def can_crop(self) -> bool:
        """Return whether the model has positions, by which it can be cropped."""
        return isinstance(self.run.method.model, (SplatModel, AnchorModel))

    @property
    def summary(self) -> str:
        """Return the size of the model and the progress of its training, as text."""
        counts = ", ".join(f"{count} {name}" for name, count in self.run.method.size().counts.items())
        text = counts if self.run.result is not None else f"{counts} after {self.run.iteration} iterations"
        return f"{text}; cannot follow: {self._failure}" if self._failure else text

    def stop(self) -> None:
        """Request that a run in training stops and is scored; does nothing to one that nobody trains."""
        files = self.run.files
        if files.is_busy and files.result() is None:
            files.stop.touch()

    def update(self) -> bool:
        """Load a newer checkpoint, or record why that failed; returns whether anything changed."""
        failure, run = "", None
        try:
            run = self.run.renewed() if self._is_following else None
        except Exception as error:  # often temporary, while the next checkpoint is written
            failure = str(error)
        changed, self._failure = failure != self._failure, failure
        if run is not None:
            self.run = run
            self._method.cache_clear()
            self._error.cache_clear()
        return changed or run is not None

    def render(
        self, options: ViewOptions, cam_from_world: Tensor, width: int, height: int, resolution: float = 1.0
    ) -> np.ndarray:
        """Render an image [h, w, 3] uint8 from `cam_from_world` [4, 4]; panoramas are padded with black.

        `width` and `height` are those at full resolution, `resolution` a factor on them; low-pass filters stay or grow.
        """
        sizes = ((max(2, round(s * width)), max(2, round(s * height))) for s in (1.0, resolution))
        full, lens = (self._lens(options, *size) for size in sizes)
        view = View("page", cam_from_world, lens.width, lens.height, lens=lens)
        if options.layer == "error":
            image = self._error_from(view, options.gain)
        else:
            rendering = self._method(full, options.crop).render(view)
            is_depth, scale = options.layer == "depth", self.run.scene.scale
            image = depth_image(rendering, scale) if is_depth else to_uint8(rendering.image)
        rows = 0 if isinstance(lens, Pinhole) else max(2, round(resolution * height)) - len(image)
        return np.pad(image, ((rows // 2, rows - rows // 2), (0, 0), (0, 0)))

    def nearest(self, cam_from_world: Tensor) -> View:
        """Return the panorama of the scene that is nearest to a pose."""
        center = View("", cam_from_world, 1, 1).center
        views = [view for view in (*self.run.scene.panoramas, *self.run.scene.test) if view.lens is None]
        return min(views, key=lambda view: (view.center - center.to(view.center)).norm().item())

    @staticmethod
    def _lens(options: ViewOptions, width: int, height: int) -> Panorama | Pinhole:
        if options.camera == "perspective":
            return perspective(width, height, options.fov)
        height = min(height, width // 2)
        return Panorama(2 * height, height)

    def _method_for(self, full: Panorama | Pinhole, crop: Box | None) -> Method:
        method = self.run.through(full)
        if crop is None or not self.can_crop:
            return method
        method = method.with_renderer(method.render_config)  # a copy, which can then only render
        model = method.model
        positions = model.anchors.positions if isinstance(model, AnchorModel) else model.splats.means
        if (world := method.world) is not None:  # the box is in the given world
            positions = world.inverse()(positions.double())
        low, high = (positions.new_tensor(corner) for corner in crop)
        model.keep(((positions >= low) & (positions <= high)).all(-1))
        return method

    def _error_from(self, view: View, gain: float) -> np.ndarray:
        """Return the error image of the nearest view of the scene, resampled to the directions of a view."""
        nearest = self.nearest(view.cam_from_world)
        error = torch.from_numpy(self._error(nearest.name, gain)).float()
        rotation = nearest.cam_from_world[:3, :3] @ view.cam_from_world[:3, :3].mT.to(nearest.cam_from_world)
        return sample(error, view.camera.rays() @ rotation.float().cpu().mT).round().byte().numpy()

    def _error_image(self, name: str, gain: float) -> np.ndarray:
        scene = self.run.scene
        view = next(view for view in (*scene.train, *scene.test) if view.name == name)
        image = self.run.method.render(view).image
        truth, mask = view.image(device=image.device), view.mask(device=image.device)
        return error_image(image if mask is None else torch.lerp(truth, image, mask[..., None]), truth, gain).copy()


def level(cam_from_world: Tensor, up: Tensor) -> Tensor:
    """Return the pose [4, 4] at the same place and with the same heading, but upright."""
    center = View("", cam_from_world, 1, 1).center
    heading = cam_from_world[2, :3] - (cam_from_world[2, :3] @ up) * up
    if heading.norm() < 1e-6:  # straight down the top of the image is ahead, straight up its bottom
        heading = cam_from_world[1, :3] * torch.sign(cam_from_world[2, :3] @ up)
        heading = heading - (heading @ up) * up
    return look_along(center[None].numpy(), heading[None].numpy(), up.numpy())[0]


def captioned(image: np.ndarray, text: str) -> np.ndarray:
    """Write a text into the upper left corner of an image."""
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    size = max(9, picture.width // 50)
    draw.text((size, size // 2), text, (255, 255, 255), font_size=size, stroke_width=2, stroke_fill=(0, 0, 0))
    return np.asarray(picture)


def with_legend(image: np.ndarray, layer: str, scale: float, gain: float) -> np.ndarray:
    """Draw the colour bar of depth, with distances in world units, or of the error, into the lower left corner."""
    import matplotlib

    height, width = image.shape[:2]
    rows, columns = max(3, height // 50), width // 4
    along = np.linspace(0, 1, columns)
    colors = matplotlib.colormaps[DEPTH_COLORS if layer == "depth" else ERROR_COLORS](along, bytes=True)[:, :3]
    bar = image.copy()
    left, top = max(2, width // 40), height - 2 * rows
    bar[top : top + rows, left : left + columns] = colors
    picture = Image.fromarray(bar)
    draw, size = ImageDraw.Draw(picture), max(8, width // 70)
    for share in (0.2, 0.5, 0.8) if layer == "depth" else (0.0, 0.5, 1.0):
        value = scale * (1 - share) / share if layer == "depth" else share * ERROR_FULL_SCALE / gain
        place = (left + round(share * columns), top - 2)
        text = f"{value:.3g}"
        draw.text(place, text, (255, 255, 255), font_size=size, anchor="mb", stroke_width=2, stroke_fill=(0, 0, 0))
    return np.asarray(picture)


def side_by_side(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Join two images of one height, with a white line between them."""
    return np.concatenate((left, np.full_like(left[:, :2], 255), right), axis=1)
