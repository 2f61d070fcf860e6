from dataclasses import replace

import pytest
import torch
from support.tiny_scene import tiny_scene, truth

from padgs.apps.export.bake import axes_of, bake, contributions, distill, sample_cameras
from padgs.gaussians import rotation_matrices
from padgs.methods.anchors.method import PaDGSMethod
from padgs.methods.splats.splats import Splats
from padgs.render import RenderOptions, render
from padgs.training.options import Budget


@pytest.fixture(scope="module")
def trained() -> PaDGSMethod:
    method = PaDGSMethod()
    for _ in method.fit(tiny_scene(), Budget(80)):
        pass
    return method


def decibels(method: PaDGSMethod, splats: Splats) -> float:
    """Return the mean PSNR of baked renders against the method's renders, over all views."""
    options = method.render_config.options(splats.scene_scale)
    errors = [
        (render(splats.gaussians(view), view, options).image - method.render(view).image).square().mean()
        for view in (*tiny_scene().train, *tiny_scene().test)
    ]
    return -10 * torch.stack(errors).mean().log10().item()


def test_baked_anchors_resemble_the_method(trained):
    scene = tiny_scene()
    options = trained.render_config.options(scene.scale)
    splats = bake(trained.model.anchors, sample_cameras(scene.train, 16), options, "auto", scene.scale)
    assert decibels(trained, splats) > 35
    assert 0 < len(splats) < trained.size().counts["gaussians"], "what never shows is dropped"


def test_distillation_reduces_the_error(trained):
    scene = tiny_scene()
    options = trained.render_config.options(scene.scale)
    splats = bake(trained.model.anchors, scene.train, options, "auto", scene.scale)
    splats.sh_dc.data += 0.5
    first, done = decibels(trained, splats), []
    distill(splats, trained.render, scene, trained.render_config, 60, done.append)
    assert done == list(range(1, 61)) and decibels(trained, splats) > first + 6


def test_distillation_works_with_one_camera_centre(trained):
    scene = tiny_scene()
    options = trained.render_config.options(scene.scale)
    splats = bake(trained.model.anchors, scene.train, options, "auto", scene.scale)
    before = splats.means.clone()
    alone = replace(scene, train=tuple(view.at(scene.train[0].cam_from_world) for view in scene.train))
    distill(splats, trained.render, alone, trained.render_config, 5)
    assert not torch.equal(splats.means, before)


def test_contributions_are_sums_of_blending_weights():
    view = tiny_scene().train[0]
    found = contributions(truth(), view, RenderOptions(), "auto")
    drawn = render(truth(), view, RenderOptions())
    assert torch.allclose(found.sum(), (1 - drawn.transmittance).sum(), rtol=1e-4)
    assert (found > 0).all()


def test_axes_of_covariances(generator):
    scales = torch.rand(200, 3, generator=generator) + 0.01
    quats = torch.nn.functional.normalize(torch.randn(200, 4, generator=generator), dim=-1)
    axes = rotation_matrices(quats) * scales[:, None]
    found, rotated = axes_of(axes @ axes.mT)
    assert torch.allclose(found.sort(-1).values, scales.sort(-1).values, atol=1e-4)
    again = rotation_matrices(rotated) * found[:, None]
    assert torch.allclose(again @ again.mT, axes @ axes.mT, atol=1e-5)
    flat, _ = axes_of(torch.diag(torch.tensor([1.0, 0.0, 0.0]))[None])
    assert flat.min() > 0, "a scale of nothing has no logarithm"


def test_sampled_cameras_are_deterministic_and_start_with_the_views():
    views = tiny_scene().train
    found = sample_cameras(views, 12)
    assert len(found) == 12 and all(new is old for new, old in zip(found, views, strict=False))
    again = sample_cameras(views, 12)
    assert all(torch.equal(a.cam_from_world, b.cam_from_world) for a, b in zip(found, again, strict=True))
    spread = torch.stack([view.center for view in found])
    assert spread.isfinite().all() and spread.abs().max() < 3
    many = [views[0]] * 100
    assert len(sample_cameras(many, 12)) == 12, "of many cameras some"
