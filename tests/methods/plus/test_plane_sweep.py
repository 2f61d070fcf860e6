"""The sweep finds the range at which photographs agree, in any units, and leaves alone what nobody can tell."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from padgs.geometry.camera import perspective
from padgs.methods.plus import depth_initialization
from padgs.methods.plus.depth_initialization import CHUNK, fibonacci_sphere, plane_sweep
from padgs.scene import Scene, View

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
def test_ranges_are_those_at_which_all_views_agree(scale):
    inverse, true, _ = found(ball(scale), scale)
    off = (inverse / true).log2().abs()
    assert off.median() < 0.08 and (off < 0.2).double().mean() > 0.95, "steps between those tried are 0.19 octaves"


def test_what_looks_alike_everywhere_stays_as_likely():
    inverse, _, likely = found(ball(contrast=0.0))
    assert torch.equal(inverse, likely)


def test_a_view_alone_and_one_that_is_no_panorama_stay_as_they_are():
    views = ball()
    for alone in (views[:1], (views[0], views[0])):
        inverse, _, likely = found(alone)
        assert torch.equal(inverse, likely)
    rays = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    likely = torch.ones(1, dtype=torch.float64)
    straight = replace(views[0], lens=perspective(WIDTH, WIDTH // 2, 90.0))
    assert torch.equal(plane_sweep(straight, rays, likely, likely[:, None], (straight, *views[1:])), likely)


def test_one_that_something_hides_is_outvoted():
    views = ball()
    hidden = replace(views[1], load_pixels=lambda: torch.zeros(WIDTH // 2, WIDTH, 3, dtype=torch.uint8))
    inverse, true, _ = found((views[0], hidden, *views[2:]))
    assert ((inverse / true).log2().abs() < 0.2).double().mean() > 0.9


def test_parts_are_put_together_in_order():
    views = ball()
    whole, true, _ = found(views, count=CHUNK + 5)
    assert len(whole) == len(true) == CHUNK + 5
    assert torch.equal(whole[:300], found(views)[0])
    assert ((whole[-5:] / true[-5:]).log2().abs() < 0.2).all()


def test_points_from_photographs_lie_where_these_agree_and_not_where_the_cloud_has_them(monkeypatch):
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
