"""3DGS on cube faces and on crops."""

import math
from dataclasses import replace

import pytest
import torch
from support.composed import composed
from support.tiny_scene import tiny_scene

from padgs.baselines import METHODS
from padgs.baselines.perspective_3dgs import Crops3DGSMethod, Cubemap3DGSMethod
from padgs.checks import lookup
from padgs.data.perspectives import solid_angle
from padgs.geometry.camera import Panorama
from padgs.geometry.panorama import rays
from padgs.render import RenderConfig
from padgs.training.options import Budget, TrainOptions

PANORAMA = Panorama(256, 128)
METHOD = {"cubemap_3dgs": Cubemap3DGSMethod, "crops_3dgs": Crops3DGSMethod}
each_method = pytest.mark.parametrize("name", METHOD)


def times_seen(method: Cubemap3DGSMethod) -> torch.Tensor:
    """How many views hold each direction of a panorama, [H, W]."""
    lens = method.lens(PANORAMA)
    tangent = lens.width / 2 / lens.fx
    x, y, z = torch.einsum("kij,hwj->khwi", method.TURNS, PANORAMA.rays(dtype=torch.float64)).unbind(-1)
    return ((z > 0) & (x.abs() <= tangent * z) & (y.abs() <= tangent * z)).sum(0)


@each_method
def test_registered_and_configured_as_the_class_says(name):
    config, method = composed(f"method={name}"), METHOD[name]
    assert lookup(METHODS, name, "method") is method
    assert (config.method, config.options, config.render) == (name, method.Options(), method.RENDER)
    assert config.train.weight == method.TRAIN.weight == "uniform"


def test_cube_faces_show_every_direction_once():
    assert (times_seen(Cubemap3DGSMethod()) == 1).all()
    assert 6 * solid_angle(Cubemap3DGSMethod().lens(PANORAMA)) == pytest.approx(4 * math.pi)


def test_crops_cover_the_sphere_with_equal_solid_angles():
    """One lens, so one solid angle; no direction is missed."""
    seen, weight = times_seen(Crops3DGSMethod()), torch.cos(torch.linspace(-90, 90, 128).deg2rad())[:, None]
    assert seen.min() == 1 and seen.max() <= 3
    crop = solid_angle(Crops3DGSMethod().lens(PANORAMA))
    assert crop == pytest.approx(1.5186, abs=1e-3)
    assert (weight * seen).sum() / (weight * torch.ones_like(seen)).sum() == pytest.approx(
        12 * crop / (4 * math.pi), rel=0.01
    )


@pytest.mark.parametrize(("name", "views"), [("cubemap_3dgs", 6), ("crops_3dgs", 8)])
def test_an_iteration_sees_as_much_as_one_of_a_panoramic_method(name, views):
    """The whole sphere once, to a sixteenth; of a masked panorama what is left of it."""
    method, scene = METHOD[name](), tiny_scene()
    assert views * solid_angle(method.lens(PANORAMA)) == pytest.approx(4 * math.pi, rel=1 / 16)
    seen = []
    method.fit(scene, Budget(1))
    draw, method.model.draw = method.model.draw, lambda view: seen.append(view.name) or draw(view)
    list(method._trainer.records())
    assert len(seen) == len(set(seen)) == views

    up = [replace(view, load_mask=lambda: (rays(64, 32)[..., 1] < 0).float()) for view in scene.train]
    method.fit(replace(scene, train=tuple(up)), Budget(1))
    assert method._views_per_step == {"cubemap_3dgs": 5, "crops_3dgs": 7}[name]


@each_method
def test_cut_views_are_twice_as_fine_with_filters_of_the_panoramas_size(name):
    method, scene = METHOD[name](), tiny_scene()
    method.fit(scene, Budget(1))
    (cut, *_), panorama = method._trainer._views._scene.train, scene.test[0]
    assert cut.camera.focal == pytest.approx(2 * panorama.camera.focal, rel=0.03)
    low_pass = [method.model.render_options(view).low_pass for view in (cut, panorama)]
    assert low_pass == [pytest.approx(4 * 0.3), 0.3]


@each_method
def test_learns_whole_panoramas_from_their_parts(name):
    scene = tiny_scene()
    method = METHOD[name](train=replace(METHOD[name].TRAIN, learning_rates=4.0))
    records = list(method.fit(scene, Budget(25)))
    view = scene.test[0]
    error = (method.render(view).image.clamp(0, 1) - view.image()).square().mean()
    assert records[-1].loss < records[0].loss
    assert -10 * torch.log10(error) > 21


@each_method
def test_a_weight_of_depth_is_refused(name):
    with pytest.raises(ValueError, match="train.depth_weight is not 0, but views that are cut from panoramas have no"):
        METHOD[name](train=replace(METHOD[name].TRAIN, depth_weight=0.1))


@each_method
def test_a_weight_of_latitudes_is_refused(name):
    with pytest.raises(ValueError, match="train.weight is solid_angle, but perspective views have no latitude"):
        METHOD[name](train=TrainOptions(weight="solid_angle"))


@each_method
def test_a_renderer_that_cannot_draw_held_out_panoramas_is_refused_before_training(name):
    with pytest.raises(ValueError, match="pinhole cannot draw the held-out panoramas at once; set render.cubemap=true"):
        METHOD[name](render=RenderConfig(projection="pinhole"))
