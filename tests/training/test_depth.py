"""The loss on inverse range, and what depth maps do to initial points and to training."""

import math
from dataclasses import replace

import pytest
import torch
from support.tiny_scene import HEIGHT, WIDTH, tiny_scene, truth

from padgs.methods.plus.method import PlusMethod, PlusOptions
from padgs.methods.splats.depth_initialization import fill_sparse_cloud
from padgs.render import RenderOptions, render
from padgs.scene import Scene, View
from padgs.training.loss import inverse_range_loss
from padgs.training.options import Budget, TrainOptions
from padgs.training.targets import depth_of, halved

EVEN = torch.ones(1, 1)


def row(*values: float) -> torch.Tensor:
    return torch.tensor([values])


def test_the_loss_is_the_mean_difference_of_inverse_ranges_where_they_are_known():
    depth = row(2.0, 4.0, 5.0, 8.0, 0.0).requires_grad_()
    known = inverse_range_loss(depth, row(4.0, math.inf, 0.0, math.nan, 3.0), EVEN, 2.0)
    assert known.item() == pytest.approx((2 / 4 + 2 / 4) / 2)  # the sky has the inverse range 0
    known.backward()
    assert depth.grad[0].tolist() == pytest.approx([-2 / 4 / 2, -2 / 16 / 2, 0, 0, 0])
    assert inverse_range_loss(depth, row(*[math.nan] * 5), EVEN, 2.0) == 0
    weighted = inverse_range_loss(row(2.0, 4.0), row(4.0, 4.0), row(3.0, 1.0), 1.0)
    assert weighted.item() == pytest.approx(0.75 * 0.25)


def test_monocular_depth_is_fitted_by_scale_and_shift_of_the_inverse():
    depth = row(1.0, 2.0, 4.0, 8.0).requires_grad_()
    loss = inverse_range_loss(depth, 1 / (0.3 / depth.detach() + 0.05), EVEN, 1.0, "monocular")
    assert loss.item() == pytest.approx(0, abs=1e-6)
    turned = inverse_range_loss(depth, 1 / (2 - 1 / depth.detach()), EVEN, 1.0, "monocular")
    turned.backward()
    assert turned == 0 and not depth.grad.any(), "near and far are exchanged: nothing is learned"
    assert inverse_range_loss(depth, row(1.0, 2.0, 4.0, 1.0), EVEN, 1.0, "monocular") > 0.1


def with_depth() -> Scene:
    """The tiny scene with the true depth of its training views; a column of each is unknown."""

    def measured(view: View) -> View:
        depth = render(truth(), view, RenderOptions()).depth
        depth[:, 0] = math.nan
        return replace(view, load_depth=lambda: depth)

    scene = tiny_scene()
    return replace(scene, train=tuple(map(measured, scene.train)))


def test_initial_points_are_at_the_measured_depth():
    scene = replace(with_depth(), train=with_depth().train[:1])
    cloud = fill_sparse_cloud(scene, 300, generator=torch.Generator().manual_seed(0), measured=True)
    view, added = scene.train[0], cloud.points[len(scene.points) :]
    seen = added.double() - view.center
    rays, depth = view.camera.rays(dtype=torch.float64).reshape(-1, 3), depth_of(view).reshape(-1)
    pixel = (torch.nn.functional.normalize(seen, dim=-1) @ (rays @ view.cam_from_world[:3, :3]).T).argmax(-1)
    assert len(added) > 50 and torch.allclose(seen.norm(dim=-1), depth[pixel].double(), rtol=1e-4)


def test_depth_maps_pull_depth_and_count_nothing_when_switched_off():
    scene, errors, losses = with_depth(), [], []
    for options in (TrainOptions(), TrainOptions(depth_weight=1.0)):
        method = PlusMethod(PlusOptions(depth_init_per_pixel=0.0), train=options)
        losses.append([record.loss for record in method.fit(scene, Budget(30))])
        views = [(method.render(view).depth, depth_of(view)) for view in scene.train]
        errors.append(sum(inverse_range_loss(*pair, EVEN, scene.scale).item() for pair in views))
    assert errors[1] < 0.7 * errors[0]
    plain = PlusMethod(PlusOptions(depth_init_per_pixel=0.0), train=TrainOptions())
    without = plain.fit(tiny_scene(), Budget(30))
    assert losses[0] == [record.loss for record in without]


def test_small_views_have_small_depth_maps():
    view = with_depth().train[0]
    assert torch.equal(depth_of(halved(view)).nan_to_num(), depth_of(view)[::2, ::2].nan_to_num())


def test_some_views_may_have_no_depth_map():
    scene = with_depth()
    first = replace(scene.train[0], load_depth=None)
    method = PlusMethod(train=TrainOptions(depth_weight=0.1))
    assert next(method.fit(replace(scene, train=(first, *scene.train[1:])), Budget(5, seconds=0.5))).loss > 0


def test_missing_and_wrong_depth_maps_are_refused():
    scene, options = tiny_scene(), TrainOptions(depth_weight=0.1)
    with pytest.raises(ValueError, match="train.depth_weight is not 0, but no training view has a depth map"):
        next(PlusMethod(train=options).fit(scene, Budget(5)))
    wrong = replace(scene, train=tuple(replace(v, load_depth=lambda: torch.ones(4, 8)) for v in scene.train))
    with pytest.raises(ValueError, match=f"depth map of view '.*' is 8x4; the view is {WIDTH}x{HEIGHT}"):
        next(PlusMethod(train=options).fit(wrong, Budget(5)))
    for given, said in (({"depth_weight": -1.0}, "depth_weight is -1.0"), ({"depth_kind": "x"}, "unknown depth_kind")):
        with pytest.raises(ValueError, match=said):
            TrainOptions(**given)
