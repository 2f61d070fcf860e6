import math

import pytest
import torch
from support.rates import assert_log_linear
from support.tiny_scene import HEIGHT, WIDTH, tiny_scene

from padgs.baselines.omnigs import OmniGSMethod
from padgs.baselines.sc_omnigs import SCOmniGSMethod, SCOmniGSOptions
from padgs.data.synthetic import SyntheticOptions, SyntheticTruth, generate
from padgs.evaluation.metrics import psnr
from padgs.methods.splats.method import SplatOptions
from padgs.render import RenderConfig
from padgs.training.corrections import align
from padgs.training.options import Budget, TrainOptions

TORCH = RenderConfig(backend="torch")
SOLID_ANGLE = TrainOptions(weight="solid_angle")


def started(method, iterations: int = 10):
    next(method.fit(tiny_scene(), Budget(iterations)))
    return method


def test_first_step_is_bit_equal_to_omnigs():
    """Poses as given and an ideal camera are no calibration: the same drawing, photograph, loss."""
    losses = [
        next(method.fit(tiny_scene(), Budget(100))).loss
        for method in (
            SCOmniGSMethod(SCOmniGSOptions(anisotropy_weight=0.0), TORCH),
            OmniGSMethod(SplatOptions(), TORCH, SOLID_ANGLE),
        )
    ]
    assert losses[0] == losses[1]


def test_learning_rates_follow_the_law_of_omnigs():
    assert SCOmniGSMethod(train=TrainOptions(learning_rates="run")).train_options.learning_rates == "run_linear"


def test_depth_is_in_units_of_the_given_world_whatever_the_size_of_the_model():
    method, view = started(SCOmniGSMethod(render=TORCH)), tiny_scene().test[0]
    poses, splats, rendered = method._poses, method.model.splats, []
    for size in (1, 2):
        with torch.no_grad():
            splats.means *= size
            splats.log_scales += math.log(size)
            for number, (quaternion, shift) in enumerate(zip(poses.quaternions, poses.shifts, strict=True)):
                quaternion.copy_(torch.tensor([1.0, 0, 0, 0]))
                shift.copy_((size - 1) * poses.given[number, :3, 3] / poses.scale)
        assert method.world.scale == pytest.approx(size)
        rendered.append(method.render(view))
    torch.testing.assert_close(rendered[1].image, rendered[0].image, atol=1e-3, rtol=0)
    torch.testing.assert_close(rendered[1].depth, rendered[0].depth, atol=1e-2, rtol=1e-3)
    assert rendered[0].depth.max() > 1


@pytest.mark.parametrize(("name", "value"), [("anisotropy_ratio", 0.5), ("anisotropy_weight", -1.0)])
def test_invalid_options_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}"):
        SCOmniGSOptions(**{name: value})


def test_learning_rates_of_poses_and_camera():
    steps = 400
    trainer = started(SCOmniGSMethod(render=TORCH), steps)._trainer
    poses, camera = trainer.corrections.poses, trainer.corrections.lens
    ends = {  # rates at the start and at the end, and what has them
        "pose_quaternions": (1e-2, 1.6e-4, poses.quaternions),
        "pose_shifts": (1e-2, 6e-3, poses.shifts),
        "camera_focal": (1e-5, 1e-5, [camera.focal]),
        "camera_offsets": (1e-5, 1e-5, [camera.offsets]),
    }
    groups = trainer.corrections.groups(steps)
    assert_log_linear(groups, ends, steps)
    assert {group.name for group in groups} == ends.keys()


def test_size_counts_the_camera():
    sizes = [started(kind(render=TORCH)).size() for kind in (SCOmniGSMethod, OmniGSMethod)]
    assert sizes[0].parameters - sizes[1].parameters == 3 + 3 * WIDTH * HEIGHT
    assert sizes[0].counts == {"gaussians": 40}


def test_last_record_reports_poses_and_camera():
    *_, last = SCOmniGSMethod(render=TORCH).fit(tiny_scene(), Budget(5))
    assert last.events[-2].startswith("poses moved by") and last.events[-1].startswith("camera map moves pixels by")


@pytest.mark.slow
def test_injected_pose_noise_is_corrected(tmp_path, monkeypatch):
    """0.5 % of the median depth and 0.2 degrees: 400 steps leave a fifth and half of it, and gain 0.1 dB."""
    monkeypatch.setenv("PADGS_CACHE", str(tmp_path))
    noise = {"pose_noise_translation": 0.005, "pose_noise_rotation": 0.2}
    options = SyntheticOptions(width=256, train_views=12, test_views=4, points=8000, samples=9, **noise)
    scene, truth = generate(options), SyntheticTruth(options)
    exact = torch.stack([truth.exact_pose(view.name) for view in scene.train])
    splats = {"max_gaussians": 20_000}
    method = SCOmniGSMethod(SCOmniGSOptions(**splats))
    plain = OmniGSMethod(SplatOptions(**splats), train=SOLID_ANGLE)
    for each in (method, plain):
        list(each.fit(scene, Budget(400)))
    poses, rms = method._trainer.corrections.poses, {}
    for name, found in (("given", poses.given), ("refined", poses.poses())):
        left = align(exact, found)[1]
        rms[name] = (left.distance.square().mean().sqrt() / truth.median_depth, left.degrees.square().mean().sqrt())
    quality = [
        torch.stack([psnr(each.render(view).image.clamp(0, 1), view.image()) for view in scene.test]).mean()
        for each in (method, plain)
    ]
    print(rms, quality)
    assert rms["refined"][0] < 0.25 * rms["given"][0] and rms["refined"][1] < 0.6 * rms["given"][1]
    assert quality[0] > quality[1] + 0.05
