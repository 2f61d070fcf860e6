"""Initial Gaussians: points from training pixels, plane sweep, far Gaussians, and the number of rooms."""

import math
from dataclasses import replace

import pytest
import torch
from support.tiny_scene import in_other_units, tiny_scene
from torch import Tensor

from padgs.data.perturb import StressOptions
from padgs.data.synthetic import SyntheticOptions, generate
from padgs.geometry.camera import perspective
from padgs.methods.plus.method import PlusMethod, PlusOptions
from padgs.methods.splats import depth_initialization
from padgs.methods.splats import method as method_module
from padgs.methods.splats.depth_initialization import (
    CHUNK,
    COVERED_SPACINGS,
    FAR_FACTOR,
    far_gaussians,
    fibonacci_sphere,
    fill_sparse_cloud,
    plane_sweep,
    room_count,
    solid_angle_pixels,
)
from padgs.methods.splats.splats import Splats
from padgs.scene import Scene, View
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


def even(directions: torch.Tensor, tolerance: float) -> bool:
    """Return whether unit vectors have the second moments of the sphere."""
    moments = directions.T @ directions / len(directions)
    return torch.allclose(moments, torch.eye(3, dtype=torch.float64) / 3, atol=tolerance)


def test_fibonacci_directions_are_unit_and_even():
    directions = fibonacci_sphere(DIRECTIONS)
    assert torch.allclose(directions.norm(dim=-1), torch.ones(DIRECTIONS, dtype=torch.float64))
    assert directions.mean(0).abs().max() < 1e-3 and even(directions, 1e-3)


def test_points_fill_a_sphere_at_its_range():
    scene = dome(300)
    scene = replace(scene, train=scene.train[:1])  # alone, for the photographs know nothing of this sphere
    points, _ = new_points(scene)
    assert len(points) == COUNT - 300
    rays = points.double() - scene.train[0].center
    ranges = rays.norm(dim=-1)
    assert (ranges / RADIUS - 1).abs().max() < 0.05
    assert even(rays / ranges[:, None], 0.03), "even by solid angle"


def test_a_single_point_sets_the_depth_of_all_pixels():
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


def test_pixels_far_from_all_points_are_dropped():
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
def test_points_are_equivariant_to_rotation_and_scale(scale):
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)))[0]
    rotation = rotation * rotation.det()
    points, colors = new_points(dome(300))
    others, their_colors = new_points(in_other_units(dome(300), scale, rotation))
    assert torch.equal(colors, their_colors)
    assert torch.allclose(others.double() / scale, points.double() @ rotation.T, atol=1e-4)


def test_dense_clouds_are_unchanged():
    scene = dome(300)
    assert fill_sparse_cloud(scene, 300, generator=torch.Generator()) is scene


def test_points_at_a_camera_centre_are_ignored():
    scene = dome(300)
    inside = scene.train[0].center.float().expand(3, 3)
    alone = replace(scene, points=inside, train=scene.train[:1])
    assert len(new_points(alone)[0]) == 0


def test_initial_number_of_gaussians():
    scene = dome(8)
    asked = round(PlusOptions().depth_init_per_pixel * solid_angle_pixels(scene.train[0]))
    for share, count in ((PlusOptions().depth_init_per_pixel, asked), (0.0, 8)):
        method = PlusMethod(PlusOptions(depth_init_per_pixel=share, sky_per_point=0.0), seed=0)
        started = len(method.build_model(scene, 10).splats)
        assert count <= started < count + len(scene.train)


def test_a_budget_limits_the_number_of_filled_points(monkeypatch):
    sought = []
    monkeypatch.setattr(method_module, "fill_sparse_cloud", lambda scene, count, **_: sought.append(count) or scene)
    for budget, iterations in ((None, 200), (150, 200), (150, 16)):
        PlusMethod(PlusOptions(sky_per_point=0.5)).fit(dome(300), Budget(iterations, gaussians=budget))
    assert sought == [
        round(PlusOptions().depth_init_per_pixel * solid_angle_pixels(dome(8).train[0])),
        math.ceil(2 * 150 / 1.5),
        math.ceil(150 / 1.5),  # so short a run prunes nothing
    ]


def test_the_cloud_is_filled_once_per_run_and_not_when_resuming(monkeypatch):
    sought, scene = [], dome(40)

    def counted(scene, count, *, generator, measured):
        sought.append(count)
        torch.rand(1, generator=generator)  # as a choice of pixels does
        return scene

    monkeypatch.setattr(method_module, "fill_sparse_cloud", counted)
    first = PlusMethod(seed=3)
    list(first.fit(scene, Budget(10_000, seconds=0.3)))  # rehearses
    assert len(sought) == 1
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


def test_speed_measurement_does_not_change_the_initial_points():
    scene, one = dome(40), PlusMethod(seed=3)
    first, second, other = (
        method.build_model(scene, length).splats for method, length in ((one, 9), (one, 20), (PlusMethod(seed=3), 20))
    )
    assert torch.equal(first.means, second.means) and torch.equal(second.means, other.means)


RADIUS, WIDTH = 4.0, 128
CENTERS = ((0.0, 0.0, 0.0), (1.0, 0.2, 0.0), (-0.6, 0.0, 0.9), (0.3, -0.4, -1.0))


def ball(scale: float = 1.0, *, contrast: float = 1.0) -> tuple[View, ...]:
    """Cameras in a hollow ball about the origin, whose colours wave with the place."""
    return tuple(_inside(torch.tensor(center, dtype=torch.float64), scale, contrast) for center in CENTERS)


def _inside(center: Tensor, scale: float, contrast: float) -> View:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -scale * center
    view = View("v", pose, WIDTH, WIDTH // 2)
    rays = view.camera.rays(dtype=torch.float64)
    places = center + ranges(rays, center)[..., None] * rays
    waves = torch.stack([torch.sin(places @ torch.tensor(way).double()) for way in ((5, 3, 1), (-2, 5, 4), (3, -4, 5))])
    pixels = (255 * (0.5 + 0.45 * contrast * waves.permute(1, 2, 0))).round().to(torch.uint8)
    return replace(view, load_pixels=lambda: pixels)


def ranges(rays: Tensor, center: Tensor) -> Tensor:
    """Distances [...] along rays [..., 3] from within to the ball of `RADIUS`."""
    along = rays @ center
    return (along * along - center @ center + RADIUS**2).sqrt() - along


def found(views: tuple[View, ...], scale: float = 1.0, count: int = 300) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse ranges found for pixels of the first view, the true ones, and what was said to be likely."""
    rays = views[0].camera.rays(dtype=torch.float64)[8:-8].reshape(-1, 3)
    rays = rays[torch.randperm(len(rays), generator=torch.Generator().manual_seed(0))[:count]]
    true = 1 / (scale * ranges(rays, torch.zeros(3, dtype=torch.float64)))
    likely, around = 0.7 * true, torch.stack((0.5 * true, 0.7 * true, 1.6 * true), dim=1)
    return plane_sweep(views[0], rays, likely, around, views), true, likely


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_plane_sweep_finds_the_depth(scale):
    inverse, true, _ = found(ball(scale), scale)
    off = (inverse / true).log2().abs()
    assert off.median() < 0.08 and (off < 0.2).double().mean() > 0.95, "steps between those tried are 0.19 octaves"


def test_plane_sweep_needs_several_panoramas_with_texture():
    views = ball()
    for useless in (views[:1], (views[0], views[0]), ball(contrast=0.0)):
        inverse, _, likely = found(useless)
        assert torch.equal(inverse, likely)
    rays = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    likely = torch.ones(1, dtype=torch.float64)
    straight = replace(views[0], lens=perspective(WIDTH, WIDTH // 2, 90.0))
    assert torch.equal(plane_sweep(straight, rays, likely, likely[:, None], (straight, *views[1:])), likely)


def test_an_occluded_view_is_outvoted():
    views = ball()
    hidden = replace(views[1], load_pixels=lambda: torch.zeros(WIDTH // 2, WIDTH, 3, dtype=torch.uint8))
    inverse, true, _ = found((views[0], hidden, *views[2:]))
    assert ((inverse / true).log2().abs() < 0.2).double().mean() > 0.9


def test_chunks_are_concatenated_in_order():
    views = ball()
    whole, true, _ = found(views, count=CHUNK + 5)
    assert len(whole) == len(true) == CHUNK + 5
    assert torch.equal(whole[:300], found(views)[0])
    assert ((whole[-5:] / true[-5:]).log2().abs() < 0.2).all()


def test_plane_sweep_improves_the_depth_of_a_rough_cloud(monkeypatch):
    directions = fibonacci_sphere(60)
    off = torch.where(torch.arange(60) % 2 == 0, 0.65, 1.5)[:, None]  # of a rough cloud
    points = (RADIUS * off * directions).float()
    scene = Scene("ball", ball(), (), points, torch.zeros(60, 3, dtype=torch.uint8), "")
    errors = []
    for others in (True, False):
        if not others:
            monkeypatch.setattr(depth_initialization, "plane_sweep", lambda view, rays, inverse, *_: inverse)
        filled = depth_initialization.fill_sparse_cloud(scene, 1000, generator=torch.Generator().manual_seed(0))
        errors.append((filled.points[60:].norm(dim=-1) / RADIUS).log2().abs().median().item())
    assert errors[0] < 0.5 * errors[1] and errors[1] > 0.15


DIRECTIONS = 3000


def under(hemisphere: bool, scale: float = 1.0) -> Scene:
    """A dome of points at a distance of 4 around the cameras of the tiny scene; or the lower half of it (y is down)."""
    scene = tiny_scene()
    centre = torch.stack([view.center for view in scene.train]).median(0).values
    directions = fibonacci_sphere(20_000)
    if hemisphere:
        directions = directions[directions[:, 1] > 0]
    colors = torch.zeros(len(directions), 3, dtype=torch.uint8)
    return in_other_units(replace(scene, points=(centre + 4 * directions).float(), point_colors=colors), scale)


def sky(scene: Scene) -> tuple[Splats, torch.Tensor]:
    """The far Gaussians, and where they are as seen from the middle of the cameras."""
    made = far_gaussians(scene, DIRECTIONS, degree=1, opacity=0.5)
    centre = torch.stack([view.center for view in scene.train]).median(0).values
    return made, made.means.detach().double() - centre


@pytest.mark.parametrize("points", [100, 500, None])
def test_closed_clouds_get_few_far_gaussians(points):
    scene = under(hemisphere=False)
    if points is None:
        assert len(sky(scene)[0]) == 0
        return
    few = torch.randperm(len(scene.points), generator=torch.Generator().manual_seed(0))[:points]
    assert len(sky(replace(scene, points=scene.points[few]))[0]) < 0.02 * DIRECTIONS


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_far_gaussians_fill_the_open_half(scale):
    made, rays = sky(under(hemisphere=True, scale=scale))
    assert rays.norm(dim=-1) == pytest.approx([FAR_FACTOR * 4 * scale] * len(rays), rel=0.02)
    height = rays[:, 1] / rays.norm(dim=-1)
    margin = COVERED_SPACINGS * math.sqrt(4 * math.pi / DIRECTIONS)
    assert height.max() < -0.8 * margin and len(rays) == pytest.approx(DIRECTIONS * (1 - margin) / 2, rel=0.02)
    apart = torch.cdist(rays, rays).fill_diagonal_(math.inf).min(-1).values.median()
    assert made.log_scales.exp().median().item() == pytest.approx(apart.item() / 2, rel=0.3)  # they touch


@pytest.fixture(autouse=True)
def cached(monkeypatch, cache):
    monkeypatch.setenv("PADGS_CACHE", str(cache))


def scene_of(name: str, count: int = 1):
    views, points = 8 * count, 3000 * count
    return generate(
        SyntheticOptions(
            scene=name,
            rooms=count if name == "room_chain" else None,
            width=16,
            samples=1,
            train_views=views,
            test_views=1,
            points=points,
        )
    )


def test_room_count_grows_with_the_rooms():
    one, two, five = (room_count(scene_of("room_chain", count)) for count in (1, 2, 5))
    assert one == 1.0 < two < five
    assert 1.5 < five < 5


@pytest.mark.parametrize("name", ["room", "outdoor", "near_clutter"])
def test_room_count_of_single_rooms_is_one(name):
    assert room_count(scene_of(name)) == 1.0


@pytest.mark.parametrize(("condition", "level"), [("world_scale", 3), ("world_offset", 2), ("world_rotation", 3)])
def test_the_room_count_is_invariant_to_the_world_frame(condition, level):
    scene = scene_of("room_chain", 3)
    assert room_count(StressOptions(condition, level).apply(scene, 0)) == pytest.approx(room_count(scene), rel=0.1)


def test_points_that_are_not_finite_are_ignored():
    scene = scene_of("room_chain", 2)
    lost = replace(scene, points=torch.cat((scene.points, torch.full((9, 3), torch.nan))))
    assert room_count(lost) == pytest.approx(room_count(scene), rel=0.01)
    assert room_count(replace(scene, points=scene.points[:0])) == 1.0
    here = scene.train[0].center.float().expand(3, 3)
    assert room_count(replace(scene, points=here)) >= 1.0


def test_a_row_of_rooms_may_have_more_gaussians_than_one():
    """With as many points and views, the row begins with more of them."""
    row = scene_of("room_chain", 5)
    near = row.train[0].center
    one = replace(row, points=near + 0.3 * torch.nn.functional.normalize(row.points - near, dim=-1))
    method = PlusMethod(PlusOptions(sky_per_point=0.0, depth_init_per_pixel=0.0))
    starts = [len(method.build_model(scene, 100).splats) for scene in (one, row)]
    assert starts[1] == pytest.approx(room_count(row) * starts[0], rel=0.01)
