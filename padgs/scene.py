"""Views with known poses, a split into training and test views, and a point cloud: the input of every method.

Transforms are named a_from_b: `cam_from_world` maps world points to the camera frame (x right, y down, z forward).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from padgs.geometry.camera import Camera, Panorama

SINGLE_CENTER = 1e-6  # an extent up to so many scene scales is rounding
FAR = 10.0  # largest distance of the cameras from the origin, in scene scales; there float32 has steps of 1e-6


@dataclass(frozen=True)
class View:
    """One image: its pose, its size, and functions that load its pixels. A panorama unless `lens` is given.

    `load_pixels` and `load_mask` are called on every access; the loader decides what is cached. A view without
    `load_pixels` can be rendered, but has no ground truth.
    """

    name: str
    cam_from_world: Tensor  # [4, 4] float64, rigid
    width: int
    height: int
    load_pixels: Callable[[], Tensor] | None = None  # () -> [H, W, 3] uint8
    load_mask: Callable[[], Tensor] | None = None  # () -> [H, W] float32 in [0, 1], 0 = ignore this pixel
    lens: Camera | None = None  # None: a panorama of this size
    load_depth: Callable[[], Tensor] | None = None  # () -> [H, W] distance along the ray; 0, NaN = unknown, inf = sky
    depth_is_relative: bool = False  # inverse distances are known up to a scale and a shift; not scored
    share: float = 1.0  # of the passes over all training views in which this one is drawn
    sphere_share: float = 1.0  # of all directions that a photograph beside panoramas shows; its weight among them

    @property
    def weight(self) -> float:
        """Return its weight among all views."""
        return self.share * self.sphere_share

    @property
    def camera(self) -> Camera:
        """Return the camera model, which gives the direction of each pixel."""
        return Panorama(self.width, self.height) if self.lens is None else self.lens

    @property
    def center(self) -> Tensor:
        """Return the camera centre in the world frame, [3]."""
        rotation, translation = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        return -rotation.transpose(0, 1) @ translation

    def image(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """Return the image as floats in [0, 1], [H, W, 3], linear in the stored values; a ValueError without pixels."""
        if self.load_pixels is None:
            raise ValueError(f"view {self.name!r} has a pose but no image; it can only be rendered")
        return self.load_pixels().to(device).to(dtype) / 255  # move first: bytes are a quarter of the floats

    def prefetch(self) -> None:
        """Start loading the pixels in the background if the source supports it, so that the next `image` is quicker."""
        start = getattr(self.load_pixels, "prefetch", None)
        if start is not None:
            start()

    def mask(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor | None:
        """Return the weight of each pixel [H, W] in [0, 1] (0 = ignore), or None if every pixel counts."""
        return None if self.load_mask is None else self.load_mask().to(device=device, dtype=dtype)

    def at(self, cam_from_world: Tensor | NDArray[Any]) -> View:
        """Return a view without pixels of the same camera at another pose [4, 4], a tensor or an array."""
        if not isinstance(cam_from_world, Tensor):
            cam_from_world = torch.as_tensor(cam_from_world).to(self.cam_from_world)
        return replace(self, cam_from_world=cam_from_world, load_pixels=None, load_mask=None, load_depth=None)


@dataclass(frozen=True)
class Scene:
    """Training and test views, and the point cloud that methods start from, in one world frame."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: Tensor  # [P, 3] float32 world
    point_colors: Tensor  # [P, 3] uint8
    fingerprint: str  # hex digest of everything read: images, poses, points, split, masks, size
    notes: tuple[str, ...] = ()  # decisions of the loader, for the user to read
    # [3] float64: x + origin are coordinates in the world of the data set; not 0 after `recentered` moved the scene
    origin: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    def recentered(self) -> Scene:
        """Return the scene with float32 points, moved to the origin if its cameras are too far away for float32."""
        middle = torch.stack([view.center for view in self.train]).double().median(0).values
        distance = middle.norm() / self.scale
        if not distance > FAR:
            return replace(self, points=self.points.float())
        step = 2.0 ** round(math.log2(self.scale) - 10)  # processors differ in the last bits, and agree in these steps
        middle = (middle / step).round() * step
        moved = self.with_views(lambda view: replace(view, cam_from_world=move_origin(view.cam_from_world, middle)))
        points = (self.points.double() - middle.to(self.points.device)).float()
        text = ", ".join(f"{number:.10g}" for number in middle.tolist())
        note = f"world: origin moved to ({text}), because the cameras are {distance:.0f} scene scales away from it"
        origin, notes = self.origin + middle.to(self.origin), (*self.notes, note)
        return replace(moved, points=points, origin=origin, notes=notes)

    def to(self, device: torch.device | str) -> Scene:
        """Return the scene with poses and points on a device; pixels are loaded on access."""
        if self.points.device == torch.device(device):
            return self
        moved = self.with_views(lambda view: replace(view, cam_from_world=view.cam_from_world.to(device)))
        return replace(moved, points=self.points.to(device), point_colors=self.point_colors.to(device))

    def with_views(self, change: Callable[[View], View]) -> Scene:
        """Return the scene with all training views changed, and then all test views."""
        return replace(self, train=tuple(map(change, self.train)), test=tuple(map(change, self.test)))

    @property
    def panoramas(self) -> tuple[View, ...]:
        """Return the training panoramas, or all training views if there are none."""
        return tuple(view for view in self.train if view.lens is None) or self.train

    @cached_property
    def extent(self) -> float:
        """Return the scene extent of 3DGS in world units: 1.1 x `camera_radius`."""
        return 1.1 * self.camera_radius

    @cached_property
    def camera_radius(self) -> float:
        """Return the largest distance of a training camera from their mean, in world units."""
        centers = torch.stack([view.center for view in self.train])
        return (centers - centers.mean(0)).norm(dim=-1).max().item()

    @property
    def has_single_center(self) -> bool:
        """Return whether all training cameras share one centre, up to the rounding of their poses."""
        return self.extent <= SINGLE_CENTER * self.scale

    @cached_property
    def scale(self) -> float:
        """Return the scene scale: the median distance from a training camera to a point, in world units.

        Lengths in the configuration are multiples of it unless said, so that training is independent of the scale.
        """
        points = self.points[:: max(1, len(self.points) // 20_000)].double()
        medians = [(points - view.center.double()).norm(dim=-1).median() for view in self.train]
        return torch.stack(medians).median().item()


def move_origin(cam_from_world: Tensor, origin: Tensor) -> Tensor:
    """Return poses [..., 4, 4] in a world frame whose origin is moved to `origin` [3] of the old frame."""
    poses = cam_from_world.clone()
    poses[..., :3, 3] += poses[..., :3, :3] @ origin.to(poses)
    return poses
