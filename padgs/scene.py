"""What every method is given: views with known poses, a split, and a point cloud.

Transforms are named a_from_b: `cam_from_world` maps world points to the camera frame (x right, y down, z forward).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from padgs.geometry.camera import Camera, Panorama

ONE_PLACE = 1e-6  # units of the scene; a reach up to here is rounding
FAR = 1000.0  # units of the scene that its cameras may be away from the origin; there float32 has steps of 6e-5 units


@dataclass(frozen=True)
class View:
    """One image: its pose and size, and how to get its pixels. A panorama, unless it says otherwise by `lens`.

    `load_pixels` and `load_mask` are called whenever pixels are asked for; the loader decides what is cached. A view
    without `load_pixels` can be rendered but not compared with anything.
    """

    name: str
    cam_from_world: Tensor  # [4, 4] float64, rigid
    width: int
    height: int
    load_pixels: Callable[[], Tensor] | None = None  # () -> [H, W, 3] uint8
    load_mask: Callable[[], Tensor] | None = None  # () -> [H, W] float32 in [0, 1], 0 = ignore this pixel
    lens: Camera | None = None  # None: a panorama of this size
    load_depth: Callable[[], Tensor] | None = None  # () -> [H, W] true distance, world units, inf = sky; where known

    @property
    def camera(self) -> Camera:
        """Which direction each pixel looks."""
        return Panorama(self.width, self.height) if self.lens is None else self.lens

    @property
    def center(self) -> Tensor:
        """Camera centre in the world frame, [3]."""
        rotation, translation = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        return -rotation.transpose(0, 1) @ translation

    def image(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
        """The panorama as floats in [0, 1], [H, W, 3], linear in the stored values.

        Raises:
            ValueError: the view has no pixels.
        """
        if self.load_pixels is None:
            raise ValueError(f"view {self.name!r} has a pose but no image; it can only be rendered")
        return self.load_pixels().to(device).to(dtype) / 255  # in this order: a quarter of the bytes travel

    def prefetch(self) -> None:
        """Have the pixels loaded in the background, where the source can; the next `image` is then quicker."""
        start = getattr(self.load_pixels, "prefetch", None)
        if start is not None:
            start()

    def mask(self, *, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor | None:
        """Per-pixel weight [H, W] in [0, 1] (0 = ignore), or None where every pixel counts."""
        return None if self.load_mask is None else self.load_mask().to(device=device, dtype=dtype)

    def at(self, cam_from_world: Tensor | NDArray[Any]) -> View:
        """The same camera at another pose [4, 4], of torch or numpy, without pixels."""
        if not isinstance(cam_from_world, Tensor):
            cam_from_world = torch.as_tensor(cam_from_world).to(self.cam_from_world)
        return replace(self, cam_from_world=cam_from_world, load_pixels=None, load_mask=None, load_depth=None)


@dataclass(frozen=True)
class Scene:
    """Views split into train and test, and the point cloud that methods start from. All in one world frame."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    points: Tensor  # [P, 3] float32 world
    point_colors: Tensor  # [P, 3] uint8
    fingerprint: str  # hex digest of everything read: images, poses, points, split, masks, size
    notes: tuple[str, ...] = ()  # what the loader decided by itself, for the user to read
    # [3] float64: what was taken from the world of the data set, which is x + origin; not 0 if that was far away
    origin: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))

    def centred(self) -> Scene:
        """The scene with points as float32, and in a world about its cameras if they are more than `FAR` units away
        from the origin: georeferenced captures are, and float32 would blur them.
        """
        middle = torch.stack([view.center for view in self.train]).double().median(0).values
        distance = middle.norm() / self.unit
        if not distance > FAR:
            return replace(self, points=self.points.float())
        train, test = (
            tuple(replace(view, cam_from_world=about(middle, view.cam_from_world)) for view in views)
            for views in (self.train, self.test)
        )
        points = (self.points.double() - middle.to(self.points.device)).float()
        text = ", ".join(f"{number:.10g}" for number in middle.tolist())
        note = f"world: about ({text}), for the cameras are {distance:.0f} units of the scene away from its origin"
        origin, notes = self.origin + middle.to(self.origin), (*self.notes, note)
        return replace(self, train=train, test=test, points=points, origin=origin, notes=notes)

    def to(self, device: torch.device | str) -> Scene:
        """The scene with poses and points on a device, where what is made of it will be; pixels come when asked for."""
        if self.points.device == torch.device(device):
            return self
        train, test = (
            tuple(replace(view, cam_from_world=view.cam_from_world.to(device)) for view in views)
            for views in (self.train, self.test)
        )
        points, colors = self.points.to(device), self.point_colors.to(device)
        return replace(self, train=train, test=test, points=points, point_colors=colors)

    @cached_property
    def extent(self) -> float:
        """What 3DGS measures with, in world units: 1.1 x `spread`."""
        return 1.1 * self.spread

    @cached_property
    def spread(self) -> float:
        """The largest distance of a training camera from their mean, world units."""
        centers = torch.stack([view.center for view in self.train])
        return (centers - centers.mean(0)).norm(dim=-1).max().item()

    @property
    def stands_still(self) -> bool:
        """Whether all training cameras stand in one place, up to the rounding of their poses."""
        return self.extent <= ONE_PLACE * self.unit

    @cached_property
    def unit(self) -> float:
        """The scene's own unit of length: the median distance from a training camera to a point, in world units.

        Lengths that the user does not give in world units are multiples of it, so that scaling a scene and its poses
        together changes nothing.
        """
        points = self.points[:: max(1, len(self.points) // 20_000)].double()
        medians = [(points - view.center.double()).norm(dim=-1).median() for view in self.train]
        return torch.stack(medians).median().item()


def about(origin: Tensor, cam_from_world: Tensor) -> Tensor:
    """Poses [..., 4, 4] in a world whose origin [3] is there."""
    poses = cam_from_world.clone()
    poses[..., :3, 3] += poses[..., :3, :3] @ origin.to(poses)
    return poses
