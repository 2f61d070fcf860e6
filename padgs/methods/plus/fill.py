"""Points from the photographs where the cloud has few: few features were matched, or a wall has none."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from padgs.methods.plus.sweep import swept
from padgs.scene import Scene, View
from padgs.training.targets import even_weight, image_of

NEIGHBOURS = 4  # points that say how far a new one is
MOST_VIEWS = 64  # photographs to take points from; more are chosen evenly
BESIDE = 1e-3  # radians; a point nearer to the direction asked for says it all


def filled(scene: Scene, count: int, *, generator: torch.Generator) -> Scene:
    """The scene with up to `count` points; itself, where its cloud has as many.

    New points are pixels of the training views, chosen at random by solid angle and mask. Their range is interpolated
    from the points that this view has in directions nearby (Shepard's way, weights of 1 / angle², of 1 / range, which
    of a plane is smooth), and then put where other views see them alike (`padgs.methods.plus.sweep`). A direction further from
    all of them than points are apart gets none: that may be the sky.

    Args:
        scene: with photographs; points at the centre of a camera, or not finite, are not asked.
        count: points.
        generator: of the random choice, on the CPU.
    """
    missing = count - len(scene.points)
    cloud = scene.points[torch.isfinite(scene.points).all(-1)].double().cpu()
    if missing <= 0 or len(cloud) == 0:
        return scene
    views = scene.train[:: math.ceil(len(scene.train) / MOST_VIEWS)]
    each = math.ceil(missing / len(views))
    made = [_seen(view, cloud, each, generator, scene.train) for view in views]
    points, colors = (torch.cat(parts) for parts in zip(*made, strict=True))
    return replace(
        scene,
        points=torch.cat((scene.points, points.to(scene.points))),
        point_colors=torch.cat((scene.point_colors, colors.to(scene.point_colors))),
    )


def _seen(
    view: View, cloud: Tensor, count: int, generator: torch.Generator, others: Sequence[View]
) -> tuple[Tensor, Tensor]:
    """At most `count` pixels of a view as points [n, 3] float64 world, and their colours [n, 3] uint8."""
    from scipy.spatial import KDTree

    pose = view.cam_from_world.double().cpu()
    camera_points = cloud @ pose[:3, :3].T + pose[:3, 3]
    ranges = camera_points.norm(dim=-1)
    elsewhere = ranges > 0
    directions, nearness = (camera_points / ranges[:, None])[elsewhere], 1 / ranges[elsewhere]
    if len(directions) == 0:
        return cloud[:0], torch.zeros(0, 3, dtype=torch.uint8)

    weight = even_weight(view, torch.device("cpu")).double().expand(view.height, view.width).reshape(-1)
    spread = weight.cumsum(0)  # a choice by weights is limited to 2^24 of them
    chosen = torch.rand(count, dtype=torch.float64, generator=generator) * spread[-1]
    pixels = torch.searchsorted(spread, chosen, right=True).clamp(max=len(spread) - 1)
    rays = view.camera.rays(dtype=torch.float64).reshape(-1, 3)[pixels]

    apart = math.sqrt(4 * math.pi / len(directions))
    found = KDTree(directions.numpy()).query(rays.numpy(), k=min(NEIGHBOURS, len(directions)))
    angles, neighbours = (torch.as_tensor(part).reshape(count, -1) for part in found)
    near = (angles < apart).any(-1)
    weights = 1 / angles[near].clamp(min=BESIDE).square()
    inverse_range = (weights * nearness[neighbours[near]]).sum(-1) / weights.sum(-1)
    inverse_range = swept(view, rays[near], inverse_range, nearness[neighbours[near]], others)

    camera_frame = rays[near] / inverse_range[:, None]
    colors = image_of(view, torch.device("cpu")).reshape(-1, 3)[pixels[near]]
    return (camera_frame - pose[:3, 3]) @ pose[:3, :3], (255 * colors).round().to(torch.uint8)
