"""A scene small enough to train on in a second: eight coloured Gaussians seen by six cameras."""

import functools
from dataclasses import replace

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.render import RenderOptions, render
from padgs.scene import Scene, View

WIDTH, HEIGHT = 32, 16


def truth() -> Gaussians:
    corners = torch.tensor([[x, y, z] for x in (-2.0, 2.0) for y in (-1.5, 1.5) for z in (-2.0, 2.0)])
    return Gaussians(
        means=corners,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(8, 1),
        scales=torch.full((8, 3), 0.6),
        opacities=torch.full((8,), 0.9),
        colors=0.1 + 0.8 * (corners > 0).float(),
    )


def in_other_units(scene: Scene, scale: float, rotation: Tensor | None = None) -> Scene:
    """Return the same scene in another world: x' = scale * rotation x."""

    def moved(view: View) -> View:
        pose = view.cam_from_world.clone()
        if rotation is not None:
            pose[:3, :3] = pose[:3, :3] @ rotation.T
        pose[:3, 3] *= scale
        return replace(view, cam_from_world=pose)

    points = scene.points if rotation is None else (scene.points.double() @ rotation.T).float()
    train, test = (tuple(map(moved, views)) for views in (scene.train, scene.test))
    return replace(scene, points=scale * points, train=train, test=test)


def squared_error(method, view: View) -> float:
    """Return the mean squared error of a method's render of a view."""
    return (method.render(view).image.clamp(0, 1) - view.image()).square().mean().item()


@functools.cache
def _pictures() -> list[tuple[Tensor, Tensor]]:
    """Return pose and pixels of each view."""
    found = []
    for number in range(6):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = 0.3 * torch.tensor([number % 2, (number // 2) % 2, number / 3], dtype=torch.float64)
        image = render(truth(), View("", pose, WIDTH, HEIGHT), RenderOptions(), backend="torch").image
        found.append((pose, (image.clamp(0, 1) * 255).round().to(torch.uint8)))
    return found


def tiny_scene() -> Scene:
    views = []
    for number, (pose, pixels) in enumerate(_pictures()):
        views.append(View(f"{number:02d}", pose.clone(), WIDTH, HEIGHT, load_pixels=pixels.clone))
    noise = 0.2 * torch.randn(40, 3, generator=torch.Generator().manual_seed(1))
    points = truth().means.repeat(5, 1) + noise
    grey = torch.full((40, 3), 128, dtype=torch.uint8)
    return Scene("tiny", tuple(views[:5]), tuple(views[5:]), points, grey, fingerprint="tiny")
