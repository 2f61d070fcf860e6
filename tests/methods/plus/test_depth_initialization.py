"""Photographs give the points that the cloud has not: where, how far, how many, of which colour."""

import math
from dataclasses import replace

import pytest
import torch
from tiny_scene import tiny_scene

from padgs.methods.plus import method as method_module
from padgs.methods.plus.depth_initialization import fibonacci_sphere, fill_sparse_cloud
from padgs.methods.plus.method import PlusMethod, PlusOptions
from padgs.methods.plus.model import solid_angle_pixels
from padgs.scene import Scene
from padgs.training.options import Budget

RADIUS = 4.0
COUNT = 2000


def dome(points: int, *, lowest: float = -1.0) -> Scene:
    """The tiny scene under even points at `RADIUS` from its first camera, in directions with y of at least `lowest`."""
    scene = tiny_scene()
    directions = fibonacci_sphere(points)
    directions = directions[directions[:, 1] >= lowest]
    cloud = (scene.train[0].center + RADIUS * directions).float()
    return replace(scene, points=cloud, point_colors=torch.zeros(len(cloud), 3, dtype=torch.uint8))


def new_points(scene: Scene, count: int = COUNT) -> tuple[torch.Tensor, torch.Tensor]:
    found = fill_sparse_cloud(scene, count, generator=torch.Generator().manual_seed(0))
    assert torch.equal(found.points[: len(scene.points)], scene.points), "the cloud itself stays"
    return found.points[len(scene.points) :], found.point_colors[len(scene.points) :]


def moved(scene: Scene, rotation: torch.Tensor, scale: float) -> Scene:
    """The same scene in another world: x' = scale * rotation x."""
    views = []
    for view in scene.train:
        pose = view.cam_from_world.clone()
        pose[:3, :3] = pose[:3, :3] @ rotation.T
        pose[:3, 3] *= scale
        views.append(replace(view, cam_from_world=pose))
    return replace(scene, train=tuple(views), points=scale * (scene.points.double() @ rotation.T).float())


def test_points_fill_a_sphere_at_its_range():
    scene = dome(300)
    scene = replace(scene, train=scene.train[:1])  # alone, for the photographs know nothing of this sphere
    points, _ = new_points(scene)
    assert len(points) == COUNT - 300
    rays = points.double() - scene.train[0].center
    ranges = rays.norm(dim=-1)
    assert (ranges / RADIUS - 1).abs().max() < 0.05
    directions = rays / ranges[:, None]
    moments = directions.T @ directions / len(points)
    assert torch.allclose(moments, torch.eye(3, dtype=torch.float64) / 3, atol=0.03), "even by solid angle"


def test_a_lone_point_says_how_far_everything_is():
    scene = dome(300)
    points, _ = new_points(replace(scene, points=scene.points[:1], train=scene.train[:1]))
    ranges = (points.double() - scene.train[0].center).norm(dim=-1)
    assert torch.allclose(ranges, torch.full_like(ranges, RADIUS), rtol=1e-5)


def test_colours_are_those_of_the_pixels():
    scene = dome(300)
    one = replace(scene, train=scene.train[:1])
    points, colors = new_points(one)
    view = one.train[0]
    rays = view.camera.rays(dtype=torch.float64).reshape(-1, 3)
    directions = torch.nn.functional.normalize(points.double() - view.center, dim=-1)
    seen = (directions @ rays.T).argmax(-1)
    assert torch.equal(colors, view.load_pixels().reshape(-1, 3)[seen])


def test_the_sky_stays_empty():
    points, _ = new_points(dome(600, lowest=0.0))
    directions = torch.nn.functional.normalize(points.double() - tiny_scene().train[0].center, dim=-1)
    assert len(points) > 500 and directions[:, 1].min() > -2 * math.sqrt(4 * math.pi / 300)


def test_masks_hide_pixels():
    scene = dome(300)
    mask = torch.zeros(scene.train[0].height, scene.train[0].width)
    mask[:, :8] = 1
    one = replace(scene, train=(replace(scene.train[0], load_mask=lambda: mask),))
    points, _ = new_points(one)
    rays = points.double() - one.train[0].center
    longitudes = torch.atan2(rays[:, 0], rays[:, 2])
    assert len(points) > 1000 and longitudes.max() < -math.pi / 2 + 1e-6


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_it_turns_and_grows_with_the_world(scale):
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)))[0]
    rotation = rotation * rotation.det()
    points, colors = new_points(dome(300))
    others, their_colors = new_points(moved(dome(300), rotation, scale))
    assert torch.equal(colors, their_colors)
    assert torch.allclose(others.double() / scale, points.double() @ rotation.T, atol=1e-4)


def test_what_has_enough_points_stays_as_it_is():
    scene = dome(300)
    assert fill_sparse_cloud(scene, 300, generator=torch.Generator()) is scene


def test_points_in_a_camera_say_nothing():
    scene = dome(300)
    inside = scene.train[0].center.float().expand(3, 3)
    alone = replace(scene, points=inside, train=scene.train[:1])
    assert len(new_points(alone)[0]) == 0


def test_padgs_plus_starts_from_what_it_asks_for():
    scene = dome(8)
    asked = round(PlusOptions().depth_init_per_pixel * solid_angle_pixels(scene.train[0]))
    for share, count in ((PlusOptions().depth_init_per_pixel, asked), (0.0, 8)):
        method = PlusMethod(PlusOptions(depth_init_per_pixel=share, sky_per_point=0.0), seed=0)
        started = len(method.build_model(scene, 10).splats)
        assert count <= started < count + len(scene.train)


def test_no_more_is_sought_than_a_budget_has_room_for(monkeypatch):
    sought = []
    monkeypatch.setattr(method_module, "fill_sparse_cloud", lambda scene, count, **_: sought.append(count) or scene)
    for budget in (None, 150):
        list(PlusMethod(PlusOptions(sky_per_point=0.5)).fit(dome(300), Budget(16, gaussians=budget)))
    assert sought == [
        round(PlusOptions().depth_init_per_pixel * solid_angle_pixels(dome(8).train[0])),
        math.ceil(2 * 150 / 1.5),
    ]


def test_points_are_sought_once_for_a_run_and_not_where_it_goes_on(monkeypatch):
    sought, scene = [], dome(40)

    def counted(scene, count, *, generator):
        sought.append(count)
        torch.rand(1, generator=generator)  # as a choice of pixels does
        return scene

    monkeypatch.setattr(method_module, "fill_sparse_cloud", counted)
    first = PlusMethod(seed=3)
    list(first.fit(scene, Budget(10_000, seconds=0.3)))  # rehearses
    assert len(sought) == 1
    model = first.resumed(scene, 100).splats
    assert len(sought) == 1 and torch.equal(model.means, first.model.splats.means)
    for again in (PlusMethod(seed=3), PlusMethod(seed=3)):
        list(again.fit(scene, Budget(2)))
    assert len(sought) == 3
    resumed = PlusMethod(seed=3)
    resumed.load_state(again.state())
    list(resumed.fit(scene, Budget(4)))
    begun = PlusMethod(seed=3)
    begun.warm_start(again.state())
    list(begun.fit(scene, Budget(2)))
    assert len(sought) == 3


def test_a_rehearsal_changes_nothing_of_the_points_that_a_run_begins_with():
    scene, one = dome(40), PlusMethod(seed=3)
    first, second, other = (
        method.build_model(scene, length).splats for method, length in ((one, 9), (one, 20), (PlusMethod(seed=3), 20))
    )
    assert torch.equal(first.means, second.means) and torch.equal(second.means, other.means)
