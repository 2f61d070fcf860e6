import math
from dataclasses import replace

import pytest
import torch
from support.tiny_scene import in_other_units, tiny_scene

from padgs.geometry.harmonics import basis
from padgs.methods.splats.splats import Splats, initial_scales
from padgs.scene import View

VIEW = View("v", torch.eye(4, dtype=torch.float64), 32, 16)


def some_splats(count: int, generator: torch.Generator, dtype=torch.float32) -> Splats:
    means = torch.randn(count, 3, generator=generator, dtype=dtype)
    splats = Splats(means, means.new_full((count, 3), -1.0), torch.rand(count, 3, generator=generator).to(dtype))
    splats.sh_rest.data.normal_(generator=generator)
    return splats


def test_starts_as_the_point_cloud():
    scene = tiny_scene()
    splats = Splats.from_scene(scene, generator=torch.Generator())
    drawn = splats.gaussians(VIEW)
    assert torch.equal(drawn.means, scene.points)
    assert torch.allclose(drawn.colors, scene.point_colors / 255, atol=1e-6)
    assert torch.allclose(drawn.opacities, torch.full((40,), 0.1))
    assert torch.allclose(drawn.scales, initial_scales(scene.points, scene.scale)[:, None].expand(40, 3), rtol=1e-5)


def test_initial_scale_is_the_root_mean_square_of_three_neighbours():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 50, 50]])
    assert initial_scales(points, scene_scale=1.0)[0].item() == pytest.approx(math.sqrt((1 + 4 + 9) / 3))


def test_coinciding_points_get_a_scale_relative_to_the_scene():
    points = torch.zeros(5, 3)
    assert torch.allclose(initial_scales(points, scene_scale=20.0), torch.full((5,), 2e-3))
    assert initial_scales(points[:1], scene_scale=20.0).item() == pytest.approx(2.0)


def test_colour_is_the_series_in_the_direction_from_the_camera(generator):
    splats = some_splats(5, generator, torch.float64)
    splats.active_degree = 3
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    view = VIEW.at(pose)
    directions = torch.nn.functional.normalize(splats.means - view.center, dim=-1)
    coefficients = torch.cat((splats.sh_dc[:, None], splats.sh_rest), dim=1)
    expected = (0.5 + (basis(directions, 3)[..., None] * coefficients).sum(1)).clamp(min=0)
    assert torch.allclose(splats.gaussians(view).colors, expected, atol=1e-6)


def test_inactive_degrees_neither_show_nor_learn(generator):
    splats = some_splats(5, generator)
    splats.active_degree = 1
    splats.gaussians(VIEW).colors.sum().backward()
    assert splats.sh_rest.grad is not None
    assert splats.sh_rest.grad[:, :3].abs().sum() > 0 and splats.sh_rest.grad[:, 3:].abs().sum() == 0


def test_camera_on_a_gaussian_stays_finite(generator):
    splats = some_splats(3, generator)
    splats.means.data[0] = 0
    splats.active_degree = 3
    splats.gaussians(VIEW).colors.sum().backward()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in splats.parameters())


def test_derivatives_against_finite_differences(generator):
    splats = some_splats(3, generator, torch.float64)
    splats.sh_dc.data += 5  # away from the clamp at black
    splats.active_degree = 3

    def colors(means, rest):
        tensors = {**splats.rows(), "means": means, "sh_rest": rest}
        return torch.func.functional_call(ColorsOf(splats), {f"splats.{n}": t for n, t in tensors.items()})

    assert torch.autograd.gradcheck(colors, (splats.means, splats.sh_rest))


class ColorsOf(torch.nn.Module):
    def __init__(self, splats: Splats) -> None:
        super().__init__()
        self.splats = splats

    def forward(self) -> torch.Tensor:
        return self.splats.gaussians(VIEW).colors


def test_scene_in_other_units_is_the_same_scene():
    scene = tiny_scene()
    small_scales, large_scales = (
        Splats.from_scene(each, generator=torch.Generator()).log_scales for each in (scene, in_other_units(scene, 128))
    )
    assert torch.allclose(large_scales - small_scales, torch.full_like(small_scales, math.log(128)), atol=1e-5)


def test_large_clouds_are_thinned_at_random_but_repeatably():
    scene = tiny_scene()
    thin = [Splats.from_scene(scene, max_gaussians=7, generator=torch.Generator().manual_seed(5)) for _ in range(2)]
    assert len(thin[0]) == 7 and torch.equal(thin[0].means, thin[1].means)


def test_bad_clouds_are_refused():
    scene = tiny_scene()
    empty = replace(scene, points=torch.zeros(0, 3), point_colors=torch.zeros(0, 3, dtype=torch.uint8))
    with pytest.raises(ValueError, match="point cloud is empty"):
        Splats.from_scene(empty, generator=torch.Generator())
    points = scene.points.clone()
    points[3, 1] = math.nan
    with pytest.raises(ValueError, match="point 3 of the cloud is"):
        Splats.from_scene(replace(scene, points=points), generator=torch.Generator())


def test_load_takes_another_count_but_not_another_degree(generator):
    splats, other = some_splats(3, generator), some_splats(5, generator)
    identity = id(splats.means)
    splats.load(other.state_dict())
    assert id(splats.means) == identity and torch.equal(splats.sh_rest, other.sh_rest) and len(splats) == 5
    flat = Splats(other.means.detach(), other.log_scales.detach(), torch.zeros(5, 3), degree=1)
    with pytest.raises(ValueError, match=r"sh_rest of the stored model has shape \[5, 15, 3\]; .* it is \[5, 3, 3\]"):
        flat.load(other.state_dict())
