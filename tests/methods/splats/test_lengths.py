"""Steps and sizes in lengths of each Gaussian: what another room is like does not change them."""

from dataclasses import replace

import pytest
import torch
from support.tiny_scene import tiny_scene
from torch import nn

from padgs.methods.splats.densification import DensificationOptions, Densifier
from padgs.methods.splats.lengths import EXTENT, EXTENT_PER_DISTANCE, NEAREST_CAMERA, LocalLengths
from padgs.methods.splats.method import SplatMethod, SplatOptions
from padgs.methods.splats.smoothing_filter import cameras_of
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig
from padgs.scene import Scene
from padgs.training.optimizer import Optimizer
from padgs.training.options import Budget
from padgs.training.schedule import Constant, ParameterGroup

CAMERAS = torch.tensor([[0.0, 0, 0, 10], [4.0, 0, 0, 20]], dtype=torch.float64)
RATE = 1.6e-4


def with_a_far_camera(scene: Scene) -> Scene:
    """One more camera, so far away that it sees nothing of the rest."""
    pose = scene.train[0].cam_from_world.clone()
    pose[0, 3] += 100.0
    return replace(scene, train=(*scene.train, replace(scene.train[0], name="far", cam_from_world=pose)))


def fitted(scene: Scene, unit: str) -> SplatMethod:
    method = SplatMethod(SplatOptions(length_unit=unit), render=RenderConfig(backend="torch"))
    method.fit(scene, Budget(100))
    return method


def test_a_length_is_a_multiple_of_the_distance_to_the_nearest_camera():
    means = torch.tensor([[1.0, 0, 0], [3.5, 0, 0], [0, -8.0, 0]])
    lengths = LocalLengths(CAMERAS)
    lengths.update(means)
    assert lengths.values.tolist() == [[pytest.approx(EXTENT_PER_DISTANCE * d)] for d in (1.0, 0.5, 8.0)]
    assert torch.equal(lengths.at(means), lengths.values[:, 0])


def test_rows_step_as_if_each_had_an_optimizer_of_its_own(generator):
    """Far from the origin, where a step is not much larger than the rounding of a position."""
    start, factors = 1000 + torch.randn(4, 3, generator=generator), torch.tensor([[0.5], [1.0], [3.0], [200.0]])
    together = nn.Parameter(start.clone())
    group = ParameterGroup("rows", (together,), Constant(1e-3), row_rates=lambda: factors)
    optimizer = Optimizer([group], 1)
    alone = [nn.Parameter(row.clone()) for row in start]
    others = [torch.optim.Adam([p], lr=1e-3 * f.item()) for p, f in zip(alone, factors, strict=True)]
    for number in range(5):
        pull = torch.randn(4, 3, generator=generator)
        (together * pull).sum().backward()
        optimizer.step(number + 1)
        for parameter, other, row in zip(alone, others, pull, strict=True):
            other.zero_grad()
            (parameter * row).sum().backward()
            other.step()
    assert torch.allclose(together, torch.stack(alone), rtol=0, atol=2e-4)
    assert (together - start).abs().amax(1)[3] > 0.1


def test_a_camera_in_another_room_does_not_change_the_steps():
    """With the extent of all cameras it makes them more than 20 times as large."""
    scenes = tiny_scene(), with_a_far_camera(tiny_scene())
    alone, beside = (fitted(scene, NEAREST_CAMERA).model.groups()[0] for scene in scenes)
    assert beside.learning_rate(0) == alone.learning_rate(0) == pytest.approx(RATE)
    assert torch.equal(beside.row_rates(), alone.row_rates())
    alone, beside = (fitted(scene, EXTENT).model.groups()[0] for scene in scenes)
    assert beside.learning_rate(0) > 20 * alone.learning_rate(0)


def test_a_first_step_is_the_rate_times_the_length():
    method = fitted(tiny_scene(), NEAREST_CAMERA)
    before = method.model.splats.means.detach().clone()
    lengths = method.model.groups()[0].row_rates().clone()
    rate = method.model.groups()[0].learning_rate(1)
    next(method._trainer.records())
    pace = method._trainer._optimizer.pace(1)
    steps = (method.model.splats.means.detach() - before).abs()
    expected = (rate * pace * lengths).expand_as(steps)
    moved = steps > 0.5 * expected
    assert moved.float().mean() > 0.5, "most Gaussians are seen"
    assert torch.allclose(steps[moved], expected[moved], rtol=0.01)


def test_gaussians_are_split_if_they_are_large_beside_their_distance():
    """Two alike: the near one is split, the far one is cloned."""
    means = torch.tensor([[1.0, 0, 0], [100.0, 0, 0]])
    splats = Splats(means, torch.full((2, 3), 0.1).log(), torch.rand(2, 3))
    options = DensificationOptions(densify_from=0, densify_every=10, percent_dense=0.01)
    grown = Densifier(splats, options, extent=1e9, extents=LocalLengths(CAMERAS[:1]).at)
    optimizer = torch.optim.Adam(splats.parameters(), fused=True)
    grown.observe(torch.ones(2, 2), torch.ones(2, dtype=torch.bool), iteration=1)
    assert grown.adapt(10, optimizer) == ("cloned 1, split 1, pruned 0 Gaussians",)
    scales = splats.log_scales.exp().amax(1)
    assert scales[splats.means[:, 0] > 50].tolist() == pytest.approx([0.1, 0.1])
    assert (scales[splats.means[:, 0] < 50] < 0.1).all()


def test_a_run_resumes_with_the_lengths_that_it_had():
    """They are those of the last round, not of the present means."""
    scene, whole = tiny_scene(), fitted(tiny_scene(), NEAREST_CAMERA)
    records = whole._trainer.records()
    for _ in range(7):
        next(records)
    resumed = SplatMethod(whole.options, render=whole.render_config)
    resumed.load_state(whole.state())
    resumed.fit(scene, Budget(100))
    assert torch.equal(resumed.model._lengths.values, whole.model._lengths.values)
    moved = LocalLengths(resumed.model._lengths._cameras).at(whole.model.splats.means)
    assert not torch.equal(moved, whole.model._lengths.values[:, 0])
    again = resumed._trainer.records()
    for _ in range(3):
        next(records), next(again)
    assert torch.equal(resumed.model.splats.means, whole.model.splats.means)


def test_a_run_from_a_model_that_is_pruned_first_steps_in_its_lengths():
    scene, source = tiny_scene(), fitted(tiny_scene(), NEAREST_CAMERA)
    count = len(source.model.splats) // 2
    method = SplatMethod(source.options, render=source.render_config)
    method.warm_start(source.state())
    records = method.fit(scene, Budget(100, gaussians=count))
    lengths = method.model.groups()[0].row_rates()
    assert torch.equal(lengths[:, 0], LocalLengths(cameras_of(scene.train)).at(method.model.splats.means))
    assert len(lengths) == count
    next(records)


def test_an_unknown_unit_is_refused():
    with pytest.raises(ValueError, match=r"unknown length_unit 'metres'; known: extent, nearest_camera"):
        SplatOptions(length_unit="metres")
