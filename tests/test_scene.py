from dataclasses import replace

import numpy as np
import pytest
import torch

from padgs.gaussians import rotation_matrices
from padgs.scene import FAR, Scene, View, move_origin

H, W = 4, 8


def pose(center: torch.Tensor, quaternion=(1.0, 0.0, 0.0, 0.0)) -> torch.Tensor:
    """cam_from_world of a camera at `center`."""
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = rotation_matrices(torch.tensor(quaternion, dtype=torch.float64))
    matrix[:3, 3] = -matrix[:3, :3] @ center.double()
    return matrix


def view_at(*center: float, **options) -> View:
    return View("view", pose(torch.tensor(center)), W, H, **options)


def scene_of(centers: list[tuple[float, float, float]], points: torch.Tensor) -> Scene:
    train = tuple(view_at(*center) for center in centers)
    return Scene("scene", train, (), points, torch.zeros(len(points), 3, dtype=torch.uint8), fingerprint="0")


def test_center_of_a_pose():
    center = torch.tensor((1.0, -2.0, 3.0), dtype=torch.float64)
    view = View("view", pose(center, (0.3, -0.5, 0.1, 0.8)), W, H)
    torch.testing.assert_close(view.center, center)
    homogeneous = torch.cat((view.center, torch.ones(1).double()))
    torch.testing.assert_close((view.cam_from_world @ homogeneous)[:3], torch.zeros(3).double())


def test_pixels_are_loaded_on_access_as_floats():
    pixels = torch.arange(H * W * 3).reshape(H, W, 3).remainder(256).byte()
    pixels[0, 0] = 255
    reads = []
    view = view_at(0, 0, 0, load_pixels=lambda: reads.append(1) or pixels)
    assert not reads
    image = view.image(dtype=torch.float64)
    assert reads and image.dtype == torch.float64 and image[0, 0].tolist() == [1.0, 1.0, 1.0]
    assert torch.equal((image * 255).round().byte(), pixels)
    assert view.image().dtype == torch.float32


def test_mask_is_optional_and_missing_image_is_an_error():
    mask = torch.rand(H, W)
    assert torch.equal(view_at(0, 0, 0, load_mask=lambda: mask).mask(dtype=torch.float64), mask.double())
    assert view_at(0, 0, 0).mask() is None
    with pytest.raises(ValueError, match="view 'view' has a pose but no image; it can only be rendered"):
        view_at(0, 0, 0).image()


def test_view_at_another_pose_has_no_pixels():
    view = view_at(0, 0, 0, load_pixels=lambda: torch.zeros(H, W, 3).byte(), load_mask=lambda: torch.zeros(H, W))
    moved = view.at(pose(torch.tensor((5.0, 0, 0))))
    assert moved.center.tolist() == [5, 0, 0] and (moved.width, moved.height, moved.name) == (W, H, "view")
    assert moved.load_pixels is None and moved.mask() is None
    assert torch.equal(view.at(np.eye(4, dtype=np.float32)).cam_from_world, torch.eye(4, dtype=torch.float64))


def test_extent_is_1_1_times_the_camera_radius():
    scene = scene_of([(-1, 0, 0), (1, 0, 0), (0, 3, 0), (0, -3, 0)], torch.rand(10, 3))
    assert scene.extent == pytest.approx(1.1 * 3)


def test_scale_is_the_median_distance_to_the_points():
    distances = torch.tensor([1.0, 2.0, 3.0, 4.0, 500.0])  # one far outlier does not matter
    points = torch.stack((distances, torch.zeros(5), torch.zeros(5)), dim=-1)
    assert scene_of([(0, 0, 0)], points).scale == pytest.approx(3.0)
    # From (0, 4, 0) they are sqrt(d^2 + 16) away, median 5; the lower of two medians is taken.
    assert scene_of([(0, 0, 0), (0, 4, 0)], points).scale == pytest.approx(3.0)
    assert scene_of([(0, 4, 0), (0, 4, 0), (0, 0, 0)], points).scale == pytest.approx(5.0)


def test_scale_of_a_large_cloud(generator):
    points = torch.randn(100_000, 3, generator=generator)
    scene = scene_of([(0.1, 0, 0)], points)
    exact = (points - torch.tensor((0.1, 0, 0))).norm(dim=-1).median().item()
    assert scene.scale == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize(("factor", "shift"), [(1e-3, 0.0), (100.0, 0.0), (1.0, 10.0)])
def test_lengths_scale_with_the_scene_and_do_not_depend_on_the_origin(generator, factor, shift):
    centers = [(0.0, 0.0, 0.0), (1.0, 0.5, 0.0), (0.0, -2.0, 1.0)]
    points = torch.randn(500, 3, generator=generator) * 4
    scene = scene_of(centers, points)
    moved = [tuple(factor * value + shift for value in center) for center in centers]
    grown = scene_of(moved, points * factor + shift)
    assert grown.scale == pytest.approx(factor * scene.scale, rel=1e-5)
    assert grown.extent == pytest.approx(factor * scene.extent, rel=1e-5)
    assert replace(scene, points=2 * scene.points).scale > 1.5 * scene.scale  # not that of the scene before


UTM = torch.tensor((691_000.5, 5_334_000.25, 520.0), dtype=torch.float64)


def test_a_far_scene_is_recentered(generator):
    centers = [(0.0, 0.0, 0.0), (1.0, 0.5, 0.0), (0.0, -2.0, 1.0)]
    points = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    far_away = [tuple((torch.tensor(center).double() + UTM).tolist()) for center in centers]
    scene = replace(
        scene_of([(0, 0, 0)], points + UTM), train=tuple(view_at_exactly(*c) for c in far_away)
    ).recentered()
    assert scene.points.dtype == torch.float32 and "world: origin moved to (69100" in scene.notes[-1]
    assert scene.origin.tolist() == pytest.approx(UTM.tolist(), abs=2)
    shift = scene.origin - UTM
    torch.testing.assert_close(scene.points, (points - shift).float(), atol=1e-6, rtol=0)
    for view, center in zip(scene.train, centers, strict=True):
        torch.testing.assert_close(view.center, torch.tensor(center).double() - shift, atol=1e-8, rtol=0)
    assert torch.equal(scene.recentered().origin, scene.origin)


def view_at_exactly(*center: float) -> View:
    return View("view", pose(torch.tensor(center, dtype=torch.float64), (0.3, -0.5, 0.1, 0.8)), W, H)


@pytest.mark.parametrize(("scales", "moved"), [(0.9 * FAR, False), (1.1 * FAR, True)])
def test_only_far_scenes_are_recentered(scales, moved):
    scene = scene_of(
        [(scales, 0, 0)], torch.tensor([[scales, 1.0, 0], [scales, 0, 1.0]], dtype=torch.float64)
    ).recentered()
    assert scene.points.dtype == torch.float32 and bool(scene.origin.any()) == moved == bool(scene.notes)


def test_move_origin_shifts_camera_centers():
    poses = torch.stack([pose(torch.tensor((1.0, 2, 3)), (0.5, 0.5, -0.5, 0.5)), pose(torch.tensor((4.0, 5, 6)))])
    found = move_origin(poses, torch.tensor((1.0, 1, 1)))
    assert torch.equal(found[:, :3, :3], poses[:, :3, :3])
    centers = -(found[:, :3, :3].transpose(1, 2) @ found[:, :3, 3:])[..., 0]
    torch.testing.assert_close(centers, torch.tensor([[0.0, 1, 2], [3, 4, 5]]).double())
