from dataclasses import replace

import pytest
import torch
from support.composed import composed
from support.tiny_scene import tiny_scene

from padgs.data.perturb import CONDITIONS, StressOptions
from padgs.data.synthetic import SyntheticOptions, SyntheticTruth, camera, generate
from padgs.evaluation.metrics import psnr
from padgs.geometry.camera import Pinhole
from padgs.runs.config import config_from_values
from padgs.runs.store import run_id
from padgs.scene import Scene

OPTIONS = SyntheticOptions("room", 64, train_views=9, test_views=1, samples=1, points=1000, outliers=0.0)


@pytest.fixture(autouse=True)
def cached(monkeypatch, root, cache):
    monkeypatch.setenv("PADGS_ROOT", str(root))
    monkeypatch.setenv("PADGS_CACHE", str(cache))


def perturbed(name: str, level: int, scene: Scene | None = None) -> Scene:
    return StressOptions(name, level).apply(scene or generate(OPTIONS), 0)


def content(scene: Scene) -> list[torch.Tensor]:
    views = (*scene.train, *scene.test)
    return [scene.points, *(view.cam_from_world for view in views), *(view.load_pixels() for view in views)]


def same(first: Scene, second: Scene) -> bool:
    one, other = content(first), content(second)
    return len(one) == len(other) and all(map(torch.equal, one, other))


def test_the_table_has_three_levels_each_and_limits_that_rise():
    for condition in CONDITIONS.values():
        assert len(condition.levels) == 3 >= len(condition.allowed)
        assert sorted(condition.allowed) == list(condition.allowed)


def test_the_docs_list_every_condition(root):
    rows = [line.replace(" †", "") for line in (root / "docs" / "robustness.md").read_text().splitlines()]
    missing = [f"| `{name}` | {' | '.join(c.row())} |" for name, c in CONDITIONS.items()]
    assert [row for row in missing if row not in rows] == [], "copy these rows into docs/robustness.md"


@pytest.mark.parametrize("name", CONDITIONS)
def test_a_scene_follows_from_seed_and_level_and_test_views_change_only_where_the_table_says(name):
    rest, levels = generate(OPTIONS), [perturbed(name, level) for level in (1, 2, 3)]
    assert all(same(scene, perturbed(name, level)) for level, scene in enumerate(levels, 1))
    assert not any(same(*pair) for pair in zip([rest, *levels], levels, strict=False))
    assert levels[0].notes[-1].startswith("stress: ") and levels[0].fingerprint == rest.fingerprint
    before, after = rest.test[0], levels[2].test[0]
    is_kept = torch.equal(before.load_pixels(), after.load_pixels())
    assert (is_kept and torch.equal(before.cam_from_world, after.cam_from_world)) != CONDITIONS[name].test_views


@pytest.mark.parametrize(("name", "decibel", "depth"), [("seam", 60, 1e-6), ("pitch", 20, 0.1)])
def test_a_rotated_camera_sees_the_ground_truth_of_its_new_pose(name, decibel, depth):
    options = replace(OPTIONS, samples=16)
    truth = SyntheticTruth(options)
    for level in (1, 2, 3):
        view = perturbed(name, level, generate(options)).test[0]
        image, there = view.load_pixels().float(), replace(view, name="another")  # known names have their own pose
        drawn = camera.draw(truth.world, truth._pose(there), there.width, options.samples, options.seed)
        assert psnr(image / 255, torch.from_numpy(drawn) / 255) > decibel  # rotated the other way: 12
        exact = truth.depth(there)
        assert ((view.load_depth() - exact).abs() / exact).quantile(0.9) < depth


@pytest.mark.parametrize("name", ["world_rotation", "world_scale"])
def test_another_world_frame_changes_nothing_in_camera_frames(name):
    rest, scene = generate(OPTIONS), perturbed(name, 3)
    factor = scene.scale / rest.scale
    for before, after in zip(rest.train, scene.train, strict=True):
        first, second = (
            s.points.double() @ v.cam_from_world[:3, :3].T + v.cam_from_world[:3, 3]
            for s, v in ((rest, before), (scene, after))
        )
        torch.testing.assert_close(second, factor * first, rtol=1e-4, atol=1e-4 * factor)
        torch.testing.assert_close(after.load_depth(), factor * before.load_depth())
    assert factor == pytest.approx(100 if name == "world_scale" else 1, rel=1e-4)


def test_points_move_to_where_their_condition_says():
    rest = generate(OPTIONS)
    centers = torch.stack([view.center for view in rest.train])
    near = torch.cdist(perturbed("near_points", 3).points.double(), centers).amin(1) < 0.02 * rest.scale
    assert near.sum() == 100
    assert len(perturbed("few_points", 1).points) == 100 and len(perturbed("few_points", 3).points) == 8
    outliers = perturbed("outlier_points", 3).points
    assert (outliers != rest.points).any(1).sum() == 200 and outliers.abs().max() > 3 * rest.points.abs().max()
    assert (perturbed("random_points", 1).point_colors == 128).all()


def test_poses_are_off_by_the_stated_amount():
    rest, scene = generate(OPTIONS), perturbed("pose_noise", 3)
    offsets = torch.stack([a.center - b.center for a, b in zip(rest.train, scene.train, strict=True)])
    assert offsets.std().item() == pytest.approx(0.02 * rest.scale, rel=0.35)
    angles = []
    for before, after in zip(rest.train, perturbed("pose_rotation", 3).train, strict=True):
        torch.testing.assert_close(after.center, before.center)
        twist = after.cam_from_world[:3, :3] @ before.cam_from_world[:3, :3].T - torch.eye(3)
        angles.append(twist.norm() / 2**0.5)  # 2 sqrt(2) sin(angle / 2)
    assert torch.stack(angles).square().mean().sqrt().rad2deg().item() == pytest.approx(1.0, rel=0.35)


def test_images_change_by_the_stated_amount(generator: torch.Generator):
    def images(name: str, level: int, image: torch.Tensor) -> list[torch.Tensor]:
        scene = generate(OPTIONS)
        scene = replace(scene, train=tuple(replace(view, load_pixels=lambda: image) for view in scene.train))
        views = perturbed(name, level, scene).train
        assert torch.equal(views[0].load_pixels(), views[0].load_pixels())
        return [view.load_pixels() for view in views]

    gray = torch.full((32, 64, 3), 100, dtype=torch.uint8)
    doublings = torch.stack([pixels[0, 0, 0] / 100 for pixels in images("exposure", 3, gray)]).log2().abs()
    assert doublings.max() <= 1.01 and doublings.mean().item() == pytest.approx(0.5, abs=0.25)
    for pixels in images("nadir", 3, gray):
        assert (pixels != gray).any(-1).any(1).nonzero().flatten().tolist() == [27, 28, 29, 30, 31]
    fine = torch.randint(0, 256, (64, 128, 3), generator=generator, dtype=torch.uint8)
    left = images("textureless", 2, fine)[0].float().std().item()
    assert left == pytest.approx(0.2 * fine.float().std().item(), rel=0.15)
    first, second = images("noise", 2, gray)[:2]
    off = (first.float() - 100) / 255
    assert off.std().item() == pytest.approx(0.05, rel=0.05) and abs(off.mean().item()) < 0.003
    assert not torch.equal(first, second)


def test_a_run_without_stress_keeps_its_id_and_one_under_stress_has_the_condition_in_it():
    plain, level_zero, stressed = (
        composed("method=padgs", f"stress.condition={name}", f"stress.level={level}")
        for name, level in (("none", 1), ("pose_noise", 0), ("pose_noise", 2))
    )
    assert "stress" not in plain.values() and level_zero.values() == plain.values()
    assert stressed.row == "pose_noise 2" and stressed.variant == ""
    assert run_id(stressed.values(), "room", "f").startswith("room_padgs_pose-noise-2_")
    assert config_from_values(stressed.values()).stress == stressed.stress


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("stress.condition=pose", "unknown condition 'pose'; known: none, world_rotation"),
        ("stress.level=4", "unknown level 4; known: 0, 1, 2, 3"),
        ("stress.amount=4", "unknown key stress.amount; known: stress.condition, stress.level"),
    ],
)
def test_unknown_settings_are_refused_with_the_known_ones(setting, message):
    with pytest.raises(ValueError, match=message):
        composed(setting)


def test_views_that_a_condition_cannot_change_are_refused():
    scene = tiny_scene()
    pinhole = Pinhole(32, 16, 20.0, 20.0, 16.0, 8.0)
    cut = replace(scene, train=tuple(replace(view, lens=pinhole) for view in scene.train))
    with pytest.raises(ValueError, match="is not a panorama"):
        perturbed("seam", 1, cut)
    odd = replace(scene, train=tuple(replace(view, width=36) for view in scene.train))
    with pytest.raises(ValueError, match="set data.width to a multiple of 16"):
        perturbed("resolution", 3, odd)


def test_masks_change_with_the_pixels():
    mask = torch.ones(16, 32)
    mask[:, :4] = 0
    scene = tiny_scene()
    scene = replace(scene, train=tuple(replace(view, load_mask=lambda: mask) for view in scene.train))
    turned = perturbed("seam", 1, scene).train[0].load_mask()
    assert turned[:, 8:12].sum() == 0 and turned.sum() == mask.sum()
    assert perturbed("resolution", 1, scene).train[0].load_mask().shape == (8, 16)
    known = replace(scene, train=tuple(replace(view, load_depth=lambda: 2 * mask) for view in scene.train))
    assert torch.equal(perturbed("resolution", 1, known).train[0].load_depth(), 2 * mask[1::2, 1::2])
    assert perturbed("pitch", 1, scene).train[0].load_mask().shape == (16, 32)


@pytest.mark.parametrize("level", [2, 3])
def test_a_world_far_from_its_origin_is_recentered(level):
    rest, far = generate(OPTIONS), perturbed("world_offset", level)
    assert far.points.dtype == torch.float64
    near = far.recentered()
    shift = (near.points - rest.points).mean(0)
    torch.testing.assert_close(near.points - shift, rest.points, atol=1e-4 * rest.scale, rtol=0)
    for one, other in zip(rest.train, near.train, strict=True):
        torch.testing.assert_close(other.center - shift, one.center, atol=1e-4 * rest.scale, rtol=0)
