"""Learned camera models: a map of the panoramic camera (SC-OmniGS), and two fisheye lenses (Seam360GS)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize

from padgs.geometry.camera import Panorama, RayTable
from padgs.geometry.distortion import solid_angle_weight
from padgs.geometry.lens import axis_direction, bend, hemisphere_weight
from padgs.geometry.panorama import project, rays, sample_pixels
from padgs.render import Rendering
from padgs.render.cubemap import channels_of, from_channels, summed_counters
from padgs.scene import View
from padgs.training.loss import pixel_weight
from padgs.training.model import TrainingRender
from padgs.training.schedule import Constant, LogLinear, ParameterGroup
from padgs.training.targets import Target

MAP_RATE = 1e-5  # learning rate of a camera map, radians
ROUGHNESS_WEIGHT = 1e-2  # loss weight of its total variation per radian
INVERSE_STEPS = 8  # of a fixed-point iteration; each multiplies the error by about the derivative of D
LENS_RATE, DECAY = 1e-3, 0.1  # learning rate of gap (scene units) and coefficients; decays to this share over a run


class CameraMap(nn.Module):
    """A panoramic camera that is not ideal, shared by all views: where each ideal direction lies in its images.

    Camera model of SC-OmniGS (arXiv 2502.04734) as far as it is known: a grid S of unit directions, a focal-type
    coefficient f and an angular distortion map D. The ideal pixel p is found at pi(normalize(f * S(p) + D(p))), pi the
    equirectangular projection. Per-axis f, the fixed gauge and the roughness are ours (docs/methods.md).

    Attributes:
        focal: [3] f, one per camera axis; a common factor has no effect as long as D is small.
        offsets: [H, W, 3] D, camera frame, radians where it is orthogonal to the direction.
    """

    _rays: Tensor  # [H, W, 3]
    _weight: Tensor  # [H, 1, 1]
    _centers: Tensor  # [H, W, 2]
    _pixels: Tensor  # [H, W, 2]

    def __init__(self, width: int, height: int, *, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.width, self.height = width, height
        self.focal = nn.Parameter(torch.ones(3, dtype=dtype))
        self.offsets = nn.Parameter(torch.zeros(height, width, 3, dtype=dtype))
        directions = rays(width, height, dtype=dtype)
        weight = solid_angle_weight(height, dtype=dtype)[:, None, None]
        grid = torch.meshgrid(*(torch.arange(n, dtype=dtype) + 0.5 for n in (width, height)), indexing="xy")
        self.register_buffer("_rays", directions, persistent=False)
        self.register_buffer("_weight", weight / weight.sum(), persistent=False)  # of rows; sums to 1
        self.register_buffer("_centers", torch.stack(grid, -1), persistent=False)
        # The same arithmetic as below, so that an ideal camera moves no pixel by a bit.
        self.register_buffer("_pixels", project(normalize(directions, dim=-1), width, height), persistent=False)
        self._inverse: tuple[Tensor, Tensor] | None = None  # `directions`, and `ideal_pixels` for them

    @classmethod
    def restored(cls, tensors: Mapping[str, Tensor]) -> CameraMap:
        """Return the camera of a `state_dict`."""
        height, width, _ = tensors["offsets"].shape
        camera = cls(width, height).to(tensors["offsets"].device)
        camera.load_state_dict(tensors)
        return camera

    def groups(self, iterations: int) -> list[ParameterGroup]:
        """Return the learning rates, which are constant."""
        return [
            ParameterGroup("camera_focal", (self.focal,), Constant(MAP_RATE), paced=False),
            ParameterGroup("camera_offsets", (self.offsets,), Constant(MAP_RATE), paced=False),
        ]

    def undistorted(self, view: View, target: Target, weight: str) -> Target:
        """Return a training image and its mask as an ideal camera would take them; `weight` is in `ROW_WEIGHTS`."""
        pixels = self._resized(self.source_pixels(), view.width, view.height)
        if (mask := view.mask(device=pixels.device)) is None:
            return Target(sample_pixels(target.image, pixels), target.weight)
        mask = mask[..., None]
        layers = sample_pixels(torch.cat((target.image, target.image * mask, mask), dim=-1), pixels)
        plain, kept, share = layers.split((3, 3, 1), dim=-1)
        # Weighted by the mask, so that ignored pixels do not bleed into their neighbours.
        image = torch.where(share > 0, kept / share.clamp(min=1e-6), plain)
        return Target(image, pixel_weight(weight, view.height, share[..., 0].detach(), device=mask.device))

    @torch.no_grad()
    def photographed(self, ideal: Rendering) -> Rendering:
        """Return a rendered panorama as this camera would take it."""
        directions = self.directions()
        if self._inverse is None or not torch.equal(self._inverse[0], directions):
            self._inverse = directions, self.ideal_pixels()
        height, width = ideal.depth.shape
        return from_channels(sample_pixels(channels_of(ideal), self._resized(self._inverse[1], width, height)), ideal)

    def directions(self) -> Tensor:
        """Return unit directions [H, W, 3] in the image for each pixel of the ideal panorama."""
        return normalize(self.focal * self._rays + self._free_offsets(), dim=-1)

    def source_pixels(self) -> Tensor:
        """Return `directions` as pixels (u, v) [H, W, 2]; exact pixel centres for the ideal camera."""
        return self._pixels_of(self.directions())

    @torch.no_grad()
    def ideal_pixels(self) -> Tensor:
        """Return the ideal panorama's pixels (u, v) [H, W, 2] of each of the image's: the inverse, by iteration."""
        targets = normalize(self._rays, dim=-1)
        offsets, found = self._free_offsets(), targets
        for _ in range(INVERSE_STEPS):
            reached = normalize(self.focal * found + sample_pixels(offsets, self._pixels_of(found)), dim=-1)
            found = normalize(found + (targets - reached), dim=-1)
        return self._pixels_of(found)

    def roughness(self) -> Tensor:
        """Return the total variation of D per radian, the mean over the sphere; a scalar."""
        d = self.offsets
        # A step east is shorter by cos(latitude), and so is its solid angle: both cancel.
        across = (d.roll(-1, dims=1) - d).abs().sum(-1).mean() * (self.width / 4)
        down = (d[1:] - d[:-1]).abs().sum(-1).mean(1) * (self.height / math.pi)
        weight = self._weight[:, 0, 0]
        return across + (down * (weight[1:] + weight[:-1]) / 2).sum()  # a step is between two rows

    def summary(self) -> str:
        """Return the result as a sentence."""
        moved = (self.source_pixels() - self._centers).norm(dim=-1).mean()
        return f"camera map moves pixels by {moved:.3g} on average"

    def _resized(self, pixels: Tensor, width: int, height: int) -> Tensor:
        """Return places (u, v) [H, W, 2] in an image of another size; both of the same camera."""
        if (width, height) == (self.width, self.height):
            return pixels
        moved = (pixels - self._centers).permute(2, 0, 1)[None]
        moved = interpolate(moved, (height, width), mode="bilinear")[0].permute(1, 2, 0) * (width / self.width)
        columns, rows = (torch.arange(n, dtype=moved.dtype, device=moved.device) + 0.5 for n in (width, height))
        return moved + torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)

    def _free_offsets(self) -> Tensor:
        """Return D without its mean rotation, which poses can express as well."""
        turn = 1.5 * (self._weight * torch.linalg.cross(self._rays, self.offsets)).mean(1).sum(0)
        return self.offsets - torch.linalg.cross(turn.expand_as(self._rays), self._rays)

    def _pixels_of(self, directions: Tensor) -> Tensor:
        """Return pixels (u, v) [H, W, 2] of directions [H, W, 3], the short way around from each pixel."""
        moved = project(directions, self.width, self.height) - self._pixels
        turns = torch.round(moved[..., 0].detach() / self.width)
        return self._centers + moved - torch.stack((turns * self.width, torch.zeros_like(turns)), dim=-1)


class DualLens(nn.Module):
    """Two fisheye lenses at centre +- (gap / 2) axis, along +- axis, stitched as if they had one centre.

    The stitching causes parallax at the seam. Two views with their own centres and rays are blended per pixel. After
    the abstract of Seam360GS (arXiv 2508.20080); the formulas are ours (docs/methods.md).

    `gap` [] is the distance between the optical centres, scene units; positive: each lens is on its own side.
    `coefficients` [2, K] of `padgs.geometry.lens.bend` are for the lens along the `axis` [3] float64, camera frame, and
    the other; `blend`, radians, is half the width of the band in which both lenses are seen.
    """

    axis: Tensor

    def __init__(self, axis: str = "z", *, order: int = 2, blend: float = 5.0, scene_scale: float = 1.0) -> None:
        """Build the ideal camera, without gap and bending; `order` is the number K of coefficients, `blend` degrees."""
        super().__init__()
        self.gap = nn.Parameter(torch.zeros(()))
        self.coefficients = nn.Parameter(torch.zeros(2, order))
        self.register_buffer("axis", axis_direction(axis), persistent=False)
        self.blend, self.scene_scale, self._axis_name = math.radians(blend), scene_scale, axis

    def groups(self, iterations: int) -> list[ParameterGroup]:
        """Return the learning rates for a run of `iterations`."""
        rate = LogLinear(LENS_RATE, DECAY * LENS_RATE, iterations)
        return [
            ParameterGroup("lens_gap", (self.gap,), rate, paced=False),
            ParameterGroup("lens_coefficients", (self.coefficients,), rate, paced=False),
        ]

    def lenses(self, view: View) -> tuple[View, View]:
        """Return the views of both lenses on all pixels of a panorama; differentiable by gap and coefficients."""
        assert isinstance(view.camera, Panorama)
        focal = view.camera.focal
        rays, weight = _sphere(view.camera, self._axis_name, self.blend, self.gap.device)
        given = view.cam_from_world.to(self.gap.device)
        both = []
        for sign, seen, coefficients in zip((1.0, -1.0), (weight > 0, weight < 1), self.coefficients, strict=True):
            axis = sign * self.axis
            shift = torch.zeros(4, 4, dtype=torch.float64, device=axis.device)
            shift[:3, 3] = axis
            pose = given - (0.5 * self.scene_scale * self.gap) * shift  # the world moves the other way
            straight = rays.to(coefficients)
            # Rays outside the lens stay straight: there the polynomial diverges, and bounds with it.
            table = torch.where(seen[..., None], bend(straight, axis.to(coefficients), coefficients), straight)
            both.append(replace(view, cam_from_world=pose, lens=RayTable(table, focal)))
        return both[0], both[1]

    def draw(self, draw: Callable[..., TrainingRender], view: View) -> TrainingRender:
        """Render the panorama as this camera stitches it; `draw(view, mean_offsets)` renders one lens."""
        first, second = self.lenses(view)
        front = draw(first)
        back = draw(second, mean_offsets=front.mean_offsets)  # both add to one positional gradient
        assert isinstance(view.camera, Panorama)
        _, weight = _sphere(view.camera, self._axis_name, self.blend, self.gap.device)
        return replace(front, rendering=stitched(front.rendering, back.rendering, weight))

    def summary(self) -> str:
        """Return the result as a sentence."""
        k = ", ".join(f"({', '.join(f'{value:.4f}' for value in lens)})" for lens in self.coefficients.tolist())
        return f"lens gap {self.gap.item():.5f} scene units, radial coefficients {k}"


def stitched(front: Rendering, back: Rendering, weight: Tensor) -> Rendering:
    """Blend two renderings of the same Gaussians by `weight` [H, W] of the front; equal pixels do not change."""
    weight, visible = weight.to(front.image), front.visible | back.visible
    of_front, of_back = weight * (1 - front.transmittance), (1 - weight) * (1 - back.transmittance)
    covered = of_front + of_back
    share = of_front / covered.where(covered > 0, 1)  # depth is the mean over what is drawn
    return Rendering(
        image=torch.lerp(back.image, front.image, weight[..., None]),
        transmittance=torch.lerp(back.transmittance, front.transmittance, weight),
        depth=torch.lerp(back.depth, front.depth, share),
        visible=visible,
        counters=summed_counters((front, back), visible),
    )


@lru_cache(maxsize=4)
def _sphere(camera: Panorama, axis: str, blend: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return rays [H, W, 3] and weights [H, W] of the front lens, float64."""
    rays = camera.rays(dtype=torch.float64, device=device)
    return rays, hemisphere_weight(rays, axis_direction(axis).to(device), blend)
