"""SC-OmniGS (arXiv 2502.04734): OmniGS with self-calibration of poses and of the panoramic camera.

Implemented after the abstract and the project page, without the paper and without code, which is not public.
docs/methods.md lists what is stated there and what is inferred.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from padgs.checks import check
from padgs.geometry.panorama import sample_pixels
from padgs.methods.calibration.align import Difference, Similarity, align
from padgs.methods.calibration.lenses import CameraMap
from padgs.methods.calibration.model import CalibratedMethod, Calibration
from padgs.methods.splats.method import SplatOptions
from padgs.render import Rendering
from padgs.scene import Scene, View
from padgs.training.corrections import PoseRates, PoseRefinement
from padgs.training.loss import pixel_weight
from padgs.training.model import State, TrainingRender
from padgs.training.options import TrainOptions
from padgs.training.schedule import Constant, ParameterGroup
from padgs.training.targets import Target


@dataclass(frozen=True)
class SCOmniGSOptions(SplatOptions):
    """Options of OmniGS and of the calibration."""

    poses: PoseRates = PoseRates()
    focal_rate: float = 1e-5  # learning rate of the focal-type coefficient
    distortion_rate: float = 1e-5  # learning rate of the angular distortion map, radians
    roughness_weight: float = 1e-2  # loss weight of the map's total variation per radian
    anisotropy_weight: float = 1e-3  # loss weight of `anisotropy`
    anisotropy_ratio: float = 10.0  # longest to shortest axis without penalty

    def __post_init__(self) -> None:
        super().__post_init__()
        rates, weights = ("focal_rate", "distortion_rate"), ("roughness_weight", "anisotropy_weight")
        check(self, "at least 0, which switches it off", lambda value: value >= 0, *rates, *weights)
        if not self.anisotropy_ratio >= 1:
            raise ValueError(f"anisotropy_ratio is {self.anisotropy_ratio}; longest to shortest is at least 1")


class SelfCalibration(Calibration):
    """Poses of all training views and their common camera."""

    def __init__(self, poses: PoseRefinement, camera: CameraMap, options: SCOmniGSOptions, weight: str) -> None:
        """Start from the given poses and an ideal camera; `weight` is a name of `padgs.training.loss.ROW_WEIGHTS`."""
        super().__init__()
        self.poses, self.camera = poses, camera
        self._options, self._weight = options, weight

    def groups(self, iterations: int) -> list[ParameterGroup]:
        """Return the learning rates of poses and camera."""
        options, camera = self._options, self.camera
        return [
            *self.poses.groups(options.poses, iterations),
            ParameterGroup("camera_focal", (camera.focal,), Constant(options.focal_rate), paced=False),
            ParameterGroup("camera_offsets", (camera.offsets,), Constant(options.distortion_rate), paced=False),
        ]

    def draw(self, draw: Callable[..., TrainingRender], view: View) -> TrainingRender:
        """Render the ideal panorama at the refined pose; the image is resampled to it."""
        drawing, options = draw(self.poses.refined(view)), self._options
        penalty = options.roughness_weight * self.camera.roughness()
        penalty = penalty + options.anisotropy_weight * anisotropy(drawing.gaussians.scales, options.anisotropy_ratio)
        return replace(drawing, penalty=penalty, photo=partial(self.resampled, view))

    def summary(self) -> str:
        """Return the median distance of the poses from the given ones after alignment, as a sentence."""
        _, left = aligned(self.poses)
        return (
            f"poses moved by {left.distance.median():.3g} world units and {left.degrees.median():.3g} degrees (median)"
        )

    def values(self) -> dict[str, Any]:
        """Return names of the views, image size and scene scale."""
        size = {"width": self.camera.width, "height": self.camera.height}
        return {"views": self.poses.names, "unit": self.poses.scale, **size}

    def counts(self) -> dict[str, int]:
        """Return the number of poses."""
        return {"poses": len(self.poses.names)}

    def resampled(self, view: View, target: Target) -> Target:
        """Return a training image and its mask, resampled to an ideal camera."""
        pixels, mask = self.camera.source_pixels(), view.mask(device=target.image.device)
        if mask is None:
            return Target(sample_pixels(target.image, pixels), target.weight)
        mask = mask[..., None]
        layers = sample_pixels(torch.cat((target.image, target.image * mask, mask), dim=-1), pixels)
        plain, kept, share = layers.split((3, 3, 1), dim=-1)
        # Weighted by the mask, so that ignored pixels do not bleed into their neighbours.
        image = torch.where(share > 0, kept / share.clamp(min=1e-6), plain)
        weight = pixel_weight(self._weight, view.height, share[..., 0].detach(), device=mask.device)
        return Target(image, weight)


class SCOmniGSMethod(CalibratedMethod):
    """See `padgs.training.method.Method`.

    The similarity between given and refined training poses maps held-out poses into the world of the model; no pixel of
    a held-out view is used. `render` includes the distortion of the camera.
    """

    Options = SCOmniGSOptions
    TRAIN = TrainOptions(weight="solid_angle")

    _render_cache: tuple[int, Similarity, Tensor] | None = None  # iteration, and what rendering takes then

    def render(self, view: View) -> Rendering:
        """Render a view of the given world through its camera, without gradients.

        Raises:
            ValueError: a view of another size than the training views.
        """
        model, calibration = self.model, self.model.calibration
        poses, camera = calibration.poses, calibration.camera
        if (view.width, view.height) != (camera.width, camera.height):
            raise ValueError(
                f"view {view.name!r} is {view.width}x{view.height}; the camera was calibrated at "
                f"{camera.width}x{camera.height}"
            )
        iteration = -1 if self._trainer is None else self._trainer.iteration
        if self._render_cache is None or self._render_cache[0] != iteration:
            self._render_cache = iteration, aligned(poses)[0], camera.ideal_pixels()
        _, similarity, pixels = self._render_cache
        ideal = model.render(replace(view, cam_from_world=mapped_pose(view.cam_from_world, similarity)))
        layers = torch.cat((ideal.image, ideal.transmittance[..., None], ideal.depth[..., None]), dim=-1)
        image, transmittance, depth = sample_pixels(layers, pixels).split((3, 1, 1), dim=-1)
        return replace(ideal, image=image, transmittance=transmittance[..., 0], depth=depth[..., 0])

    def load_state(self, state: State) -> None:
        """See `Method.load_state`."""
        self._render_cache = None
        super().load_state(state)

    def _refuse_impossible(self) -> None:
        super()._refuse_impossible()
        if self.train_options.poses == "learned":
            raise ValueError(
                "train.poses is learned, but sc_omnigs refines poses itself; set train.poses=given, or take omnigs"
            )

    def initial_calibration(self, scene: Scene) -> SelfCalibration:
        """See `CalibratedMethod.initial_calibration`."""
        sizes = {(view.width, view.height) for view in scene.train}
        if len(sizes) > 1:
            raise ValueError(f"sc_omnigs calibrates one camera, but the training views have sizes {sorted(sizes)}")
        if scene.has_single_center:
            raise ValueError(
                f"the {len(scene.train)} training cameras of scene {scene.name!r} stand in one place, which has no "
                "scale to carry held-out views by; sc_omnigs needs two places, omnigs does without"
            )
        poses = PoseRefinement.of(scene.train, scale=scene.scale)
        return self._calibrating(poses, *sizes.pop())

    def restored_calibration(self, values: Mapping[str, Any]) -> SelfCalibration:
        """See `CalibratedMethod.restored_calibration`."""
        names = values["views"]
        poses = PoseRefinement(names, torch.eye(4).repeat(len(names), 1, 1), scale=values["unit"])
        return self._calibrating(poses, values["width"], values["height"])

    def _calibrating(self, poses: PoseRefinement, width: int, height: int) -> SelfCalibration:
        return SelfCalibration(poses, CameraMap(width, height), self.options, self.train_options.weight)


def aligned(poses: PoseRefinement) -> tuple[Similarity, Difference]:
    """Return the similarity refined_from_given and the residual corrections (world units, degrees)."""
    return align(poses.poses(), poses.given)


def mapped_pose(cam_from_world: Tensor, similarity: Similarity) -> Tensor:
    """Map a pose [4, 4] by a similarity; float64."""
    cam_from_world = cam_from_world.to(similarity.rotation)
    rotation = cam_from_world[:3, :3] @ similarity.rotation.mT
    center = similarity(-cam_from_world[:3, :3].mT @ cam_from_world[:3, 3])
    pose = torch.eye(4, dtype=torch.float64, device=rotation.device)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return pose


def anisotropy(scales: Tensor, ratio: float) -> Tensor:
    """Return the mean excess of ln(longest / shortest axis) over ln(ratio), for scales [N, 3]; a scalar.

    >>> round(anisotropy(torch.tensor([[1.0, 1.0, 20.0], [1.0, 1.0, 1.0]]), 10.0).item(), 4)  # ln(2) / 2
    0.3466
    """
    return torch.relu(torch.log(scales.amax(-1) / scales.amin(-1)) - math.log(ratio)).mean()
