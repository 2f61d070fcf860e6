import math

import pytest
import torch

from padgs.gaussians import rotation_matrices
from padgs.methods.splats.densification import DensificationOptions, Densifier
from padgs.methods.splats.method import SplatOptions
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig
from padgs.scene import View

LARGE, SMALL = 0.5, 0.005  # scales above and below percent_dense x extent = 0.01
EVERY = 10


def densifier(scales: list[float], **options) -> tuple[Densifier, torch.optim.Adam]:
    """Gaussians of these scales, of opacity 1/2, numbered by their mean; extent 1."""
    means = torch.arange(len(scales), dtype=torch.float32)[:, None].repeat(1, 3)
    splats = Splats(means, torch.tensor(scales).log()[:, None].repeat(1, 3), torch.rand(len(scales), 3))
    splats.opacity_logits.data.zero_()
    optimizer = torch.optim.Adam(splats.parameters(), lr=0.0, fused=True)
    sum(p.sum() for p in splats.parameters()).backward()
    optimizer.step()  # fills the moments, moves nothing
    optimizer.zero_grad()
    settings = {"densify_from": 0, "densify_every": EVERY, "reset_every": 10**6, "prune_by_extent_from": 0} | options
    return Densifier(splats, DensificationOptions(**settings), extent=1.0), optimizer


def pull(densifier: Densifier, gradients: list[float], views: int = 1) -> None:
    for _ in range(views):
        gradient = torch.tensor(gradients)[:, None] * torch.tensor([0.6, 0.8])
        densifier.observe(gradient, torch.ones(len(gradients), dtype=torch.bool), iteration=1)


def test_small_gaussians_are_cloned_exactly():
    grown, optimizer = densifier([SMALL, SMALL])
    before = {name: p.detach().clone() for name, p in grown.splats.rows().items()}
    pull(grown, [0.0, 1e-3])
    assert grown.adapt(EVERY, optimizer) == ("cloned 1, split 0, pruned 0 Gaussians",)
    for name, parameter in grown.splats.rows().items():
        assert torch.equal(parameter, torch.cat((before[name], before[name][1:]))), name
        assert torch.equal(optimizer.state[parameter]["exp_avg"][2:], torch.zeros_like(parameter[2:])), name


def test_large_gaussians_are_replaced_by_two_smaller_ones():
    grown, optimizer = densifier([LARGE, LARGE])
    pull(grown, [1e-3, 0.0])
    assert grown.adapt(EVERY, optimizer) == ("cloned 0, split 1, pruned 0 Gaussians",)
    assert len(grown.splats) == 3
    assert torch.equal(grown.splats.means[0], torch.ones(3)), "the one that was split is gone"
    assert torch.allclose(grown.splats.log_scales[1:].exp(), torch.full((2, 3), LARGE / 1.6))
    assert not torch.equal(grown.splats.means[1], grown.splats.means[2])


def test_large_gaussians_are_pruned_only_on_request_and_perhaps_later():
    grown, optimizer = densifier([LARGE, SMALL])
    grown.adapt(EVERY, optimizer)
    assert len(grown.splats) == 2
    grown, optimizer = densifier([LARGE, SMALL], prune_by_extent=True, prune_by_extent_from=EVERY)
    assert grown.adapt(EVERY, optimizer) == ("cloned 0, split 0, pruned 0 Gaussians",)
    assert grown.adapt(2 * EVERY, optimizer) == ("cloned 0, split 0, pruned 1 Gaussians",)


@pytest.mark.parametrize("clones", [False, True])
def test_pieces_and_sampled_clones_follow_the_distribution_of_their_gaussian(clones):
    """Means N(mean, Sigma); clones keep everything else (GOF)."""
    count = 4000
    largest = 5e-3 if clones else 0.5
    scales, quat = largest * torch.tensor([1.0, 0.4, 0.2]), torch.tensor([0.8, 0.3, -0.4, 0.2])
    grown, optimizer = densifier([largest] * count, max_gaussians=None, sample_clones=clones)
    splats = grown.splats
    splats.means.data.zero_()
    splats.log_scales.data, splats.quats.data = scales.log().repeat(count, 1), quat.repeat(count, 1)
    pull(grown, [1.0] * count)
    cloned, split = (count, 0) if clones else (0, count)
    assert grown.adapt(EVERY, optimizer) == (f"cloned {cloned}, split {split}, pruned 0 Gaussians",)
    assert len(splats) == 2 * count
    steps = splats.means[count:] if clones else splats.means
    spread = rotation_matrices(quat) @ torch.diag(scales)
    assert torch.allclose(steps.T @ steps / len(steps), spread @ spread.T, atol=0.1 * largest**2)
    if clones:
        assert not splats.means[:count].any() and torch.equal(splats.log_scales[count:], splats.log_scales[:count])


def test_threshold_is_on_the_mean_over_views_that_saw_it():
    grown, optimizer = densifier([SMALL, SMALL, SMALL], gradient_threshold=2e-4)
    visible = torch.tensor([[True, True, True], [True, False, True]])
    for view, size in zip(visible, (3e-4, 0.9e-4), strict=True):
        gradient = torch.full((3, 2), size / math.sqrt(2))
        gradient[2] *= 1.1
        grown.observe(gradient, view, iteration=1)
    grown.adapt(EVERY, optimizer)  # means: 1.95e-4, 3e-4, 2.145e-4
    assert grown.splats.means[3:, 0].tolist() == [1.0, 2.0]


def test_statistics_start_again_after_each_round():
    grown, optimizer = densifier([SMALL, SMALL])
    pull(grown, [1e-3, 1e-3])
    grown.adapt(EVERY, optimizer)
    assert grown.adapt(2 * EVERY, optimizer) == ("cloned 0, split 0, pruned 0 Gaussians",)
    assert len(grown.splats) == 4


def test_faint_gaussians_are_pruned():
    grown, optimizer = densifier([SMALL, SMALL, SMALL])
    grown.splats.opacity_logits.data = torch.logit(torch.tensor([0.0049, 0.0051, 0.9]))
    assert grown.adapt(EVERY, optimizer) == ("cloned 0, split 0, pruned 1 Gaussians",)
    assert grown.splats.means[:, 0].tolist() == [1.0, 2.0]


@pytest.mark.parametrize("scale", [SMALL, LARGE])
def test_max_gaussians_keeps_the_largest_gradients(scale):
    grown, optimizer = densifier([scale] * 5, max_gaussians=7)
    pull(grown, [1e-3, 5e-3, 2e-3, 4e-3, 3e-3])
    assert grown.adapt(EVERY, optimizer)[1:] == ("max_gaussians 7 left out 3 of 5 candidates",)
    assert len(grown.splats) == 7
    unchanged = {0.0, 2.0, 4.0}
    assert unchanged <= set(grown.splats.means[:, 0].tolist())
    if scale == SMALL:
        assert grown.splats.means[5:, 0].tolist() == [1.0, 3.0]
    pull(grown, [1.0] * 7)
    grown.adapt(2 * EVERY, optimizer)
    assert len(grown.splats) == 7


@pytest.mark.parametrize(
    ("limit", "before", "after"),
    [(0.01, [0.007, 0.9], [0.007, 0.01]), (0.1, [0.05, 0.9], [0.05, 0.1]), (1.0, [0.05, 0.9], [0.05, 0.9])],
)
def test_a_reset_limits_opacities_and_clears_their_adam_moments(limit, before, after):
    grown, optimizer = densifier([SMALL, SMALL], densify_from=10**6, reset_every=30, reset_opacity=limit)
    grown.splats.opacity_logits.data = torch.logit(torch.tensor(before))
    assert grown.adapt(29, optimizer) == ()
    assert grown.adapt(30, optimizer) == ("reset opacities",)
    assert torch.allclose(torch.sigmoid(grown.splats.opacity_logits), torch.tensor(after))
    assert optimizer.state[grown.splats.opacity_logits]["exp_avg_sq"].abs().sum() == 0
    assert optimizer.state[grown.splats.means]["exp_avg_sq"].abs().sum() > 0


@pytest.mark.parametrize("kind", ["space", "space_absolute"])
def test_target_is_reached_in_equal_steps_by_the_largest_gradients(kind):
    count, target = 20, 50
    grown, optimizer = densifier(
        [SMALL] * count, densify_until=3 * EVERY + 1, positional_gradient=kind, gradient_threshold=1.0
    )
    grown = Densifier(grown.splats, grown.options, extent=1.0, target=target)
    found = []
    for turn in range(1, 4):
        now = len(grown.splats)
        pulls = torch.arange(now, dtype=torch.float32)[:, None].repeat(1, 4)
        if kind == "space_absolute":
            pulls[:, 3] = -pulls[:, 3].flip(0)  # by these the first ones are pulled least, too, but none is 0
            pulls[:, 3] += now
        grown.observe(pulls if kind == "space_absolute" else pulls[:, :3], torch.ones(now, dtype=torch.bool), 1)
        before = grown.splats.means.detach().clone()
        assert grown.adapt(turn * EVERY, optimizer)[0].startswith("cloned 10,")
        found.append(len(grown.splats))
        assert torch.equal(grown.splats.means[now:].sort(0).values, before[-10:].sort(0).values)
    assert found == [30, 40, 50]


def test_absolute_gradients_select_as_many_as_the_threshold():
    """GOF: above the quantile 1 - r, with r the share of those above the threshold."""
    grown, optimizer = densifier([SMALL] * 6, positional_gradient="space_absolute", gradient_threshold=1e-4)
    pulls = torch.tensor([2e-4, 3e-4, 0.0, 5e-5, 0.0, 0.0])
    absolute = torch.tensor([1e-3, 0.0, 9e-3, 2e-3, 8e-3, 9.0])
    visible = torch.tensor([True, True, True, True, True, False])
    grown.observe(torch.cat((pulls[:, None] * torch.tensor([0.6, 0.0, 0.8]), absolute[:, None]), dim=-1), visible, 1)
    quantile = torch.quantile(torch.where(visible, absolute, 0.0), 1 - 2 / 6)
    assert torch.equal(visible & (absolute >= quantile), torch.tensor([False, False, True, False, True, False]))
    assert grown.adapt(EVERY, optimizer) == ("cloned 4, split 0, pruned 0 Gaussians",)
    assert grown.splats.means[6:, 0].tolist() == [0.0, 1.0, 2.0, 4.0]
    assert not grown.statistics["absolute"].any() and len(grown.statistics["absolute"]) == 10


def test_opacities_decay_in_every_round_once_the_faintest_are_gone():
    grown, optimizer = densifier([SMALL] * 4, opacity_decay=0.001)
    opacities = torch.tensor([0.0045, 0.0055, 0.5, 0.0005])
    grown.splats.opacity_logits.data = torch.logit(opacities)
    assert grown.adapt(EVERY, optimizer) == ("cloned 0, split 0, pruned 2 Gaussians",)
    assert torch.allclose(torch.sigmoid(grown.splats.opacity_logits), opacities[1:3] - 0.001, rtol=1e-4)
    moments = {name: optimizer.state[parameter]["exp_avg_sq"] for name, parameter in grown.splats.rows().items()}
    assert [name for name, moment in moments.items() if not moment.any()] == ["opacity_logits"]


@pytest.mark.parametrize("first, expected", [(500, 600), (0, 100)])
def test_the_first_round_comes_after_densify_from(first, expected):
    options = DensificationOptions(densify_from=first).for_run(30_000)
    grown, optimizer = densifier([SMALL], densify_from=options.densify_from, densify_every=100)
    assert [i for i in range(1, 700) if grown.adapt(i, optimizer)][0] == expected


@pytest.mark.parametrize("kind", ["solid", "angular"])
def test_a_reset_limits_the_opacity_that_the_nearest_camera_draws(kind, generator):
    """SPaGS: min(o c, 0.1) / c, with c^2 = prod s^2 / (s^2 + 0.2 (r / f)^2); without the 3D filter c is 1."""
    count, width = 40, 64
    means, centers = torch.randn(count, 3, generator=generator), torch.randn(3, 3, generator=generator)
    scales = 0.1 * torch.rand(count, 3, generator=generator) + 0.02
    splats = Splats(means, scales.log(), torch.rand(count, 3, generator=generator))
    before = torch.rand(count, generator=generator)
    splats.opacity_logits.data = torch.logit(before)
    views = [View("v", torch.eye(4), width, width // 2) for _ in centers]
    for view, center in zip(views, centers, strict=True):
        view.cam_from_world[:3, 3] = -center
    options = SplatOptions(densify_from=10**6, reset_every=3000, reset_opacity=0.1)
    render = RenderConfig(projection="ray", low_pass=0.2, low_pass_kind=kind)
    trained = SplatModel(splats, options, render, extent=1.0, iterations=30_000, views=views)
    trained.adapt(3000, torch.optim.Adam(splats.parameters()))

    nearest = torch.cdist(means, centers).amin(-1)[:, None]
    squares = scales**2
    c = (squares / (squares + 0.2 * (nearest * 2 * math.pi / width) ** 2)).prod(-1).sqrt()
    c = c if kind == "solid" else torch.ones(count)
    after = torch.sigmoid(splats.opacity_logits)
    assert torch.allclose(after, (before * c).clamp(max=0.1) / c, rtol=1e-4)
    assert (after < before - 1e-3).sum() > 5 and (kind == "angular" or (after > 0.2).sum() > 5)


def test_nothing_happens_from_densify_until():
    grown, optimizer = densifier([SMALL], densify_until=40, reset_every=20)
    assert [i for i in range(1, 200) if grown.adapt(i, optimizer)] == [10, 20, 30]


@pytest.mark.parametrize(("iterations", "resets"), [(1000, 0), (1002, 0), (1500, 1), (3000, 2), (3002, 2), (7004, 4)])
def test_rounds_follow_each_reset_as_in_the_published_schedule(iterations, resets):
    options = DensificationOptions().for_run(iterations)
    windows = {name: getattr(options, name) for name in ("densify_until", "reset_every", "densify_every")}
    grown, optimizer = densifier([SMALL], densify_from=10**6, **windows)
    assert sum("reset opacities" in grown.adapt(i, optimizer) for i in range(1, iterations)) == resets


def test_windows_follow_the_run_length():
    published = DensificationOptions()
    assert published.for_run(30_000) == published
    short = published.for_run(3_000)
    assert (short.densify_from, short.densify_until) == (50, 1500)
    assert (short.densify_every, short.reset_every) == (50, 500), "intervals have a floor"
    long = published.for_run(60_000)
    assert (long.densify_until, long.densify_every, long.reset_every) == (30_000, 200, 6000)


def test_invalid_options_are_refused():
    for name, value, rule in (
        ("densify_every", 0, ""),
        ("reset_opacity", 0.0, "; it must be an opacity"),
        ("opacity_decay", 1.5, "; it must be an opacity"),
        ("max_gaussians", 0, ""),
        ("positional_gradient", "pixels", "; known: image, space, space_absolute"),
    ):
        with pytest.raises(ValueError, match=f"{name} (is )?'?{value}'?{rule}"):
            DensificationOptions(**{name: value})


def test_pieces_of_the_longest_axis_keep_its_variance_and_the_opacity_of_the_middle():
    scales, opacity, turn = torch.tensor([0.2, 1.0, 0.4]), 0.7, torch.tensor([0.8, 0.3, -0.4, 0.2])
    splats = Splats(torch.zeros(2, 3), scales.log().repeat(2, 1), torch.rand(2, 3))
    splats.quats.data, splats.opacity_logits.data = turn.repeat(2, 1), torch.full((2,), opacity).logit()
    optimizer = torch.optim.Adam(splats.parameters(), lr=0.0, fused=True)
    grown = Densifier(splats, DensificationOptions(densify_from=0, densify_every=10, split="long_axis"), extent=1.0)
    grown.observe(torch.tensor([[0.0, 0.0], [1.0, 0.0]]), torch.ones(2, dtype=torch.bool), iteration=1)
    assert grown.adapt(10, optimizer) == ("cloned 0, split 1, pruned 0 Gaussians",)
    means, widths = splats.means[1:], splats.log_scales[1:].exp()
    axis = rotation_matrices(turn)[:, 1]
    assert torch.allclose(means, torch.stack((0.7 * axis, -0.7 * axis)), atol=1e-6)
    assert torch.allclose(widths[:, 1].square() + 0.7**2, torch.ones(2)), "variance of the pair"
    assert torch.allclose(widths[:, [0, 2]], 0.7 * scales[[0, 2]].expand(2, 2))
    alpha = splats.opacity_logits[1:].sigmoid() * torch.exp(-0.5 * 0.7**2 / widths[:, 1].square())
    assert (1 - (1 - alpha).prod()).item() == pytest.approx(opacity, abs=1e-5)


def test_an_unknown_split_is_refused():
    with pytest.raises(ValueError, match="split"):
        DensificationOptions(split="short_axis")
