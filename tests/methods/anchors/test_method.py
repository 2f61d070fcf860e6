"""PaD-GS as a method: it learns, resumes bit-identically, and does not care about the units of the world."""

from dataclasses import replace

import pytest
import torch
from support.states import assert_same_but_time
from support.tiny_scene import squared_error

from padgs.geometry.panorama import rays
from padgs.methods.anchors.anchors import PaDGS
from padgs.methods.anchors.method import LearningRates, PaDGSMethod, PaDGSMethodOptions
from padgs.render import RenderConfig
from padgs.scene import Scene, View
from padgs.training.options import Budget, TrainOptions

WIDTH, HEIGHT = 48, 24
EAGER = PaDGSMethodOptions(  # grows often: in a run of 60 iterations after 8, before 40
    offsets=4, voxel_size=0.05, statistics_from=2000, grow_from=4000, grow_until=20_000, grow_every=4
)
RENDER = RenderConfig()


def scene(scale: float = 1.0) -> Scene:
    """A ball of radius 2 painted with a smooth pattern, seen from inside by four cameras."""
    generator = torch.Generator().manual_seed(5)
    points = 2 * torch.nn.functional.normalize(torch.randn(60, 3, generator=generator, dtype=torch.float64), dim=-1)
    views = []
    for index in range(4):
        center = 0.2 * torch.tensor([index - 1.5, 0.3 * index, (-1.0) ** index], dtype=torch.float64)
        directions = rays(WIDTH, HEIGHT, dtype=torch.float64)
        along = directions @ center
        hit = center + directions * (torch.sqrt(along**2 + 4 - center @ center) - along)[..., None]
        pixels = (255 * (0.5 + 0.4 * torch.sin(2 * hit))).to(torch.uint8)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -scale * center
        views.append(View(f"view{index}", pose, WIDTH, HEIGHT, lambda pixels=pixels: pixels))
    colors = torch.zeros(len(points), 3, dtype=torch.uint8)
    return Scene("ball", tuple(views[:3]), tuple(views[3:]), (scale * points).float(), colors, "0")


def trained(iterations: int, *, scale: float = 1.0, options=EAGER, seed: int = 0):
    method = PaDGSMethod(options, RENDER, TrainOptions(), seed)
    return method, list(method.fit(scene(scale), Budget(iterations)))


@pytest.fixture(scope="module")
def long_run():
    return trained(60)


def test_test_view_is_learned(long_run):
    method, records = long_run
    untrained, _ = trained(1)
    assert [record.iteration for record in records] == list(range(1, 61))
    view = scene().test[0]
    assert squared_error(method, view) < 0.35 * squared_error(untrained, view)
    assert records[-1].loss < 0.6 * records[0].loss


def test_growth_happens_in_its_window_only(long_run):
    _, records = long_run
    assert {r.iteration for r in records if any("grew" in e for e in r.events)} <= set(range(12, 40, 4))
    assert records[-1].counts["anchors"] > records[0].counts["anchors"]


def test_resumed_run_is_bit_identical(long_run):
    whole, records = long_run
    interrupted = PaDGSMethod(EAGER, RENDER, TrainOptions(), 0)
    run = interrupted.fit(scene(), Budget(60))
    for _ in range(22):
        next(run)
    state = interrupted.state()
    assert len(state.tensors["model/positions"]) != records[0].counts["anchors"]  # it has grown by then

    resumed = PaDGSMethod(EAGER, RENDER, TrainOptions(), seed=99)  # the state brings all randomness along
    resumed.load_state(state)
    view = scene().test[0]
    assert torch.equal(resumed.render(view).image, interrupted.render(view).image)
    assert resumed.state() is state
    rest = list(resumed.fit(scene(), Budget(60)))
    assert [(r.iteration, r.loss, r.counts) for r in rest] == [(r.iteration, r.loss, r.counts) for r in records[22:]]
    assert_same_but_time(resumed.state(), whole.state())


@pytest.mark.parametrize("scale", [100.0, 2.0**10, 2.0**-10])
def test_training_is_invariant_to_world_units(scale):
    options = replace(EAGER, voxel_size="auto", voxel_pixels=3.0, coarsest=4, refinement=2)
    options = replace(options, offset_rate=(0.01, 0.0001))  # 100 rounds differently, which a faster one magnifies
    (small, before), (large, after) = trained(14, options=options), trained(14, scale=scale, options=options)
    assert [r.counts for r in before] == [r.counts for r in after]
    assert before[-1].counts["anchors"] > before[0].counts["anchors"]
    assert [r.loss for r in after] == pytest.approx([r.loss for r in before], rel=1e-3)
    view, far = scene().test[0], scene(scale).test[0]
    if scale != 100:
        assert [r.loss for r in after] == [r.loss for r in before], "powers of two change no bit"
        assert torch.equal(small.render(view).image, large.render(far).image)
    assert (small.render(view).image - large.render(far).image).abs().max() < 0.02
    assert torch.allclose(scale * small.render(view).depth, large.render(far).depth, rtol=0.05)


def test_size_counts_parameters_and_bytes(long_run):
    method, records = long_run
    size, anchors = method.size(), records[-1].counts["anchors"]
    networks = sum(p.numel() for p in method.model.anchors.decoder.parameters())
    assert size.counts == {"anchors": anchors, "gaussians": 4 * anchors}
    assert size.parameters == anchors * (32 + 4 * 3 + 6) + networks
    assert size.bytes == 4 * (size.parameters + 3 * anchors)


def test_state_of_other_options_is_refused(long_run):
    other = PaDGSMethod(replace(EAGER, features=16), RENDER, TrainOptions())
    with pytest.raises(ValueError, match="features of the stored model has shape"):
        other.load_state(long_run[0].state())


def test_published_learning_rates():
    model, world = PaDGS.from_scene(scene()), scene()
    extent = world.extent / world.scale
    groups = {g.name: g for g in LearningRates().groups(model, extent, 30_000)}
    ends = {
        "offsets": (0.05 * extent, 0.0005 * extent),
        "features": (0.0075, 0.0075),
        "log_scales": (0.007, 0.007),
        "opacity": (0.002, 2e-5),
        "covariance": (0.004, 0.004),
        "color": (0.008, 5e-5),
    }
    for name, (first, last) in ends.items():
        assert groups[name].learning_rate(0) == pytest.approx(first), name
        assert groups[name].learning_rate(30_000) == pytest.approx(last), name
    held = [id(p) for g in groups.values() for p in g.parameters]
    assert sorted(held) == sorted(id(p) for p in model.parameters())


@pytest.mark.parametrize(
    ("unit", "views", "rate"),
    [
        ("anchor", 1, lambda alone: 0.05),
        ("world", 1, lambda alone: 0.05 * EAGER.min_extent * alone.scale),
        ("anchor", 2, lambda pair: 0.05),
        ("world", 2, lambda pair: 0.05 * pair.extent),
    ],
)
def test_the_rate_of_offsets_is_in_its_unit(unit, views, rate):
    """One camera, whose extent is 0, can still place Gaussians."""
    world = scene()
    few = replace(world, train=world.train[:views])
    method = PaDGSMethod(replace(EAGER, offset_rate_unit=unit), RENDER)
    next(method.fit(few, Budget(100)))
    assert method.model.groups()[0].learning_rate(0) == pytest.approx(rate(few))


@pytest.mark.parametrize("wrong", [{"omega_axis": "z"}, {"coarsest": 7}, {"offset_rate_unit": "m"}])
def test_invalid_options_of_every_part_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        PaDGSMethodOptions(**wrong)
