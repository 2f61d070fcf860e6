from dataclasses import replace

import pytest
import torch
from composed import composed
from tiny_scene import tiny_scene

from padgs.data.synthetic import SyntheticOptions, SyntheticTruth, generate
from padgs.evaluation.metrics import psnr
from padgs.geometry.camera import Pinhole
from padgs.runs.config import config_from_values
from padgs.runs.identity import run_id
from padgs.runs.session import build
from padgs.scene import Scene
from padgs.stress.conditions import CONDITIONS
from padgs.stress.options import StressOptions
from padgs.training.options import TrainOptions

OPTIONS = SyntheticOptions("room", 64, train_views=9, test_views=1, samples=1, points=1000, outliers=0.0)


@pytest.fixture(autouse=True)
def cached(monkeypatch, root, cache):
    monkeypatch.setenv("PADGS_ROOT", str(root))
    monkeypatch.setenv("PADGS_CACHE", str(cache))


def stressed(name: str, level: int, scene: Scene | None = None, seed: int = 0) -> Scene:
    return StressOptions(name, level).scene(scene or generate(OPTIONS), seed)


def content(scene: Scene) -> list[torch.Tensor]:
    views = (*scene.train, *scene.test)
    return [scene.points, *(view.cam_from_world for view in views), *(view.load_pixels() for view in views)]


def same(first: Scene, second: Scene) -> bool:
    pairs = zip(content(first), content(second), strict=True)
    return len(first.train) == len(second.train) and all(torch.equal(*pair) for pair in pairs)


OF_SCENES = [name for name, condition in CONDITIONS.items() if condition.scene]


@pytest.mark.parametrize("name", OF_SCENES)
def test_a_seed_says_it_all_and_each_level_is_another_scene(name):
    rest, levels = generate(OPTIONS), [stressed(name, level) for level in (1, 2, 3)]
    assert all(same(scene, stressed(name, level)) for level, scene in enumerate(levels, 1))
    for first, second in zip([rest, *levels], levels, strict=False):
        assert (
            len(first.train) != len(second.train) or len(first.points) != len(second.points) or not same(first, second)
        )
    assert levels[0].notes[-1].startswith("stress: ") and levels[0].fingerprint == rest.fingerprint


@pytest.mark.parametrize(
    "name", ["pose_noise", "pose_rotation", "exposure", "nadir", "jpeg", "noise", "resolution", "few_views"]
)
def test_test_views_stay_what_they_are_where_training_views_alone_are_wrong(name):
    rest, scene = generate(OPTIONS).test[0], stressed(name, 3).test[0]
    assert torch.equal(rest.load_pixels(), scene.load_pixels())
    assert torch.equal(rest.cam_from_world, scene.cam_from_world)


@pytest.mark.parametrize(("name", "decibel", "depth"), [("seam", 60, 1e-6), ("pitch", 20, 0.1)])
def test_a_turned_camera_sees_what_a_camera_turned_so_would_have_taken(name, decibel, depth):
    options = replace(OPTIONS, samples=16)
    truth = SyntheticTruth(options)
    for level in (1, 2, 3):
        view = stressed(name, level, generate(options)).test[0]
        seen, there = view.load_pixels().float(), replace(view, name="another")  # a name of the scene has its own pose
        assert psnr(seen / 255, truth.image(there) / 255) > decibel  # turned the other way: 12
        exact = truth.depth(there)
        assert ((view.load_depth() - exact).abs() / exact).quantile(0.9) < depth


@pytest.mark.parametrize("name", ["world_rotation", "world_scale"])
def test_another_frame_changes_nothing_that_a_camera_sees(name):
    rest, scene = generate(OPTIONS), stressed(name, 3)
    factor = scene.scale / rest.scale
    for before, after in zip(rest.train, scene.train, strict=True):
        seen, again = (
            s.points.double() @ v.cam_from_world[:3, :3].T + v.cam_from_world[:3, 3]
            for s, v in ((rest, before), (scene, after))
        )
        torch.testing.assert_close(again, factor * seen, rtol=1e-4, atol=1e-4 * factor)
        torch.testing.assert_close(after.load_depth(), factor * before.load_depth())
    assert factor == pytest.approx(100 if name == "world_scale" else 1, rel=1e-4)


def test_points_go_where_their_condition_says():
    rest = generate(OPTIONS)
    centers = torch.stack([view.center for view in rest.train])
    near = torch.cdist(stressed("near_points", 3).points.double(), centers).amin(1) < 0.02 * rest.scale
    assert near.sum() == 100
    assert len(stressed("few_points", 1).points) == 100 and len(stressed("few_points", 3).points) == 8
    moved = (stressed("outlier_points", 3).points != rest.points).any(1)
    assert moved.sum() == 200
    assert stressed("outlier_points", 3).points.abs().max() > 3 * rest.points.abs().max()
    assert (stressed("random_points", 1).point_colors == 128).all()


def test_poses_are_off_by_as_much_as_they_say():
    rest, scene = generate(OPTIONS), stressed("pose_noise", 3)
    offsets = torch.stack([a.center - b.center for a, b in zip(rest.train, scene.train, strict=True)])
    assert offsets.std().item() == pytest.approx(0.02 * rest.scale, rel=0.35)
    angles = []
    for before, after in zip(rest.train, stressed("pose_rotation", 3).train, strict=True):
        torch.testing.assert_close(after.center, before.center)
        twist = after.cam_from_world[:3, :3] @ before.cam_from_world[:3, :3].T - torch.eye(3)
        angles.append(twist.norm() / 2**0.5)  # 2 sqrt(2) sin(angle / 2)
    assert torch.stack(angles).square().mean().sqrt().rad2deg().item() == pytest.approx(1.0, rel=0.35)


def painted(pixels: torch.Tensor) -> Scene:
    """The scene with that picture for each training view."""
    scene = generate(OPTIONS)
    return replace(scene, train=tuple(replace(view, load_pixels=lambda: pixels) for view in scene.train))


def test_pictures_change_by_as_much_as_they_say(generator: torch.Generator):
    grey = torch.full((32, 64, 3), 100, dtype=torch.uint8)
    gains = [view.load_pixels()[0, 0, 0] / 100 for view in stressed("exposure", 3, painted(grey)).train]
    doublings = torch.stack(gains).log2().abs()
    assert doublings.max() <= 1.01 and doublings.mean().item() == pytest.approx(0.5, abs=0.25)
    for view in stressed("nadir", 3, painted(grey)).train:
        assert (view.load_pixels() != grey).any(-1).any(1).nonzero().flatten().tolist() == [27, 28, 29, 30, 31]
    fine = torch.randint(0, 256, (64, 128, 3), generator=generator, dtype=torch.uint8)
    left = stressed("textureless", 2, painted(fine)).train[0].load_pixels()
    assert left.float().std().item() == pytest.approx(0.2 * fine.float().std().item(), rel=0.15)


def test_noise_has_the_size_that_it_says_and_is_the_same_each_time():
    first, second = stressed("noise", 2, painted(torch.full((32, 64, 3), 128, dtype=torch.uint8))).train[:2]
    off = (first.load_pixels().float() - 128) / 255
    assert off.std().item() == pytest.approx(0.05, rel=0.05) and abs(off.mean().item()) < 0.003
    assert torch.equal(first.load_pixels(), first.load_pixels())
    assert not torch.equal(first.load_pixels(), second.load_pixels())


def test_a_capacity_is_of_the_pixels_of_a_view():
    config = composed("stress.condition=capacity", "stress.level=2")
    assert config.stress.budget(config.time, generate(OPTIONS)).gaussians == round(0.2 * 64 * 32)


def test_training_is_changed_and_its_configuration_is_not():
    config = composed("stress.condition=schedule", "stress.level=2", "train.iterations=300")
    assert (config.train.iterations, config.training.iterations) == (300, 1200)
    faster = composed("stress.condition=learning_rates", "stress.level=1", "train.iterations=7500")
    assert faster.train.learning_rates == "run" and faster.training.learning_rates == 6.0
    assert faster.values()["train"]["learning_rates"] == "run"
    slower = composed("stress.condition=low_rates", "stress.level=3", "train.iterations=7500")
    assert slower.training.learning_rates == pytest.approx(2 / 3) and slower.row == "low_rates 1"
    assert composed().training == composed().train and isinstance(composed().training, TrainOptions)


def test_networks_multiply_in_fewer_bits_and_methods_without_any_are_what_they_were():
    for level, precision in ((0, "float32"), (1, "float16"), (2, "bfloat16"), (3, "bfloat16")):
        stress = ("stress.condition=precision", f"stress.level={level}")
        config = composed("method=padgs", *stress)
        assert build(config).options == replace(config.options, precision=precision)
        assert config.options.precision == "float32" == config.values()["method"]["precision"]
        explicit = composed("method=omnigs", *stress)
        assert build(explicit).options == explicit.options


def test_levels_that_a_condition_does_not_have_are_no_runs_of_their_own():
    second, third = (composed("method=padgs", "stress.condition=precision", f"stress.level={n}") for n in (2, 3))
    assert third.values() == second.values() and third.row == "precision 2"


def test_a_run_without_stress_is_the_run_that_it_was_before_there_was_any():
    plain = composed("method=padgs")
    level_zero = composed("method=padgs", "stress.condition=pose_noise", "stress.level=0")
    assert "stress" not in plain.values() and level_zero.values() == plain.values()
    stress = composed("method=padgs", "stress.condition=pose_noise", "stress.level=2")
    assert stress.row == "pose_noise 2" and stress.variant == ""
    assert run_id(stress.values(), "room", "f").startswith("room_padgs_pose-noise-2_")
    assert config_from_values(stress.values()).stress == stress.stress


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("stress.condition=pose", "unknown condition 'pose'; known: none, world_rotation"),
        ("stress.level=4", "unknown level 4; known: 0, 1, 2, 3"),
        ("stress.amount=4", "unknown key stress.amount; known: stress.condition, stress.level"),
    ],
)
def test_what_is_unknown_is_refused_with_what_is_known(setting, said):
    with pytest.raises(ValueError, match=said):
        composed(setting)


def test_what_cannot_be_done_to_a_view_is_refused():
    scene = tiny_scene()
    pinhole = Pinhole(32, 16, 20.0, 20.0, 16.0, 8.0)
    cut = replace(scene, train=tuple(replace(view, lens=pinhole) for view in scene.train))
    with pytest.raises(ValueError, match="is no panorama"):
        stressed("seam", 1, cut)
    odd = replace(scene, train=tuple(replace(view, width=36) for view in scene.train))
    with pytest.raises(ValueError, match="set data.width to a multiple of 16"):
        stressed("resolution", 3, odd)


def test_masks_go_along_with_the_pixels():
    mask = torch.ones(16, 32)
    mask[:, :4] = 0
    scene = tiny_scene()
    scene = replace(scene, train=tuple(replace(view, load_mask=lambda: mask) for view in scene.train))
    turned = stressed("seam", 1, scene).train[0].load_mask()
    assert turned[:, 8:12].sum() == 0 and turned.sum() == mask.sum()
    assert stressed("resolution", 1, scene).train[0].load_mask().shape == (8, 16)
    assert stressed("pitch", 1, scene).train[0].load_mask().shape == (16, 32)


@pytest.mark.parametrize("level", [2, 3])
def test_a_world_far_away_comes_back_as_loaded_ones_do(level):
    rest, far = generate(OPTIONS), stressed("world_offset", level)
    assert far.points.dtype == torch.float64
    shift = (far.recentered().points - rest.points).mean(0)
    torch.testing.assert_close(far.recentered().points - shift, rest.points, atol=1e-4 * rest.scale, rtol=0)
    for one, other in zip(rest.train, far.recentered().train, strict=True):
        torch.testing.assert_close(other.center - shift, one.center, atol=1e-4 * rest.scale, rtol=0)
