"""Known failures of released programs, each under the condition that causes it: the release fails, ours does not."""

from dataclasses import replace

import pytest
import torch
from support.composed import composed
from support.tiny_scene import tiny_scene

from padgs.data.perturb import StressOptions
from padgs.evaluation.diagnostics import yaw_error
from padgs.geometry.distortion import distortion, polar_axis
from padgs.runs.run import build_method
from padgs.scene import Scene
from padgs.training.health import Failure
from padgs.training.loop import Budget
from padgs.training.method import Method


@pytest.fixture(autouse=True)
def padgs_root(monkeypatch, root):
    monkeypatch.setenv("PADGS_ROOT", str(root))


def trained(preset: str, scene: Scene, iterations: int = 3) -> Method:
    method = build_method(composed(f"method={preset}"))
    list(method.fit(scene, Budget(iterations)))
    return method


def stressed(scene: Scene, condition: str, level: int) -> Scene:
    return StressOptions(condition, level).apply(scene, 0)


@pytest.mark.parametrize(("preset", "cuts"), [("omnigs_release", True), ("omnigs", False)])
def test_the_published_rasterizer_cuts_at_the_seam(preset, cuts):
    scene = stressed(tiny_scene(), "seam", 1)
    scene = replace(scene, points=torch.cat((scene.points, torch.tensor([[0.0, 0.0, -2.0], [0.01, 0.0, -2.0]]))))
    scene = replace(scene, point_colors=torch.full((42, 3), 255, dtype=torch.uint8))
    method, view = trained(preset, scene), tiny_scene().test[0]
    error = yaw_error(method.render, view, method.render(view).image).item()
    assert (error > 0.02) if cuts else (error < 1e-4)


@pytest.mark.parametrize(("preset", "harmed"), [("padgs_release", True), ("padgs", False)])
def test_a_tilted_world_changes_what_padgs_dims(preset, harmed):
    """The released distortion degree is measured from the world's z axis, wherever the camera's vertical is."""
    options, omegas = composed(f"method={preset}").options, []
    for scene in (tiny_scene(), stressed(tiny_scene(), "world_rotation", 3)):
        view = scene.test[0]
        directions = torch.nn.functional.normalize(scene.points.double() - view.center, dim=-1)
        omegas.append(distortion(directions, polar_axis(options.omega_axis, view.cam_from_world)))
    change = (omegas[0] - omegas[1]).abs().max()
    assert (change > 0.3) if harmed else (change < 1e-6)


@pytest.mark.parametrize(("preset", "blind"), [("omnigs_release", True), ("padgs_release", True), ("omnigs", False)])
def test_near_in_world_units_culls_a_small_world(preset, blind):
    small = stressed(stressed(tiny_scene(), "world_scale", 1), "world_scale", 1)  # a hundredth: all within 0.2
    if blind:
        with pytest.raises(Failure) as caught:
            trained(preset, small, 150)
        assert caught.value.status == "collapsed"
    else:
        assert trained(preset, small).render(small.test[0]).transmittance.min() < 0.8


@pytest.mark.parametrize("preset", ["padgs_release", "padgs"])
def test_an_anchor_on_the_polar_axis_is_harmless_without_the_root_of_the_release(preset):
    on_axis = torch.tensor([0.0, 0.0, 1.0], requires_grad=True)
    torch.sqrt(1 - on_axis[2] ** 2).backward()  # what the release feeds its decoder, and differentiates
    assert on_axis.grad is not None and not on_axis.grad.isfinite().all()
    scene = tiny_scene()
    axes = torch.tensor([[0.0, 0.0, 2.0], [0.0, 2.0, 0.0]])
    points = torch.cat([scene.points, *(view.center.float() + axes for view in scene.train)])
    scene = replace(scene, points=points, point_colors=torch.full((len(points), 3), 128, dtype=torch.uint8))
    method = trained(preset, scene, 20)
    assert all(tensor.isfinite().all() for tensor in method.state().tensors.values() if tensor.is_floating_point())
    assert method.render(scene.test[0]).image.std() > 0.01
