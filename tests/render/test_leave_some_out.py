"""What a removal is said to do on average where others are removed with it, against all groups and random ones."""

import itertools
import math

import pytest
import torch
from render_cases import camera_of, chosen, gaussians_of, needs_native, view_of
from scipy.stats import spearmanr
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.panorama import rays
from padgs.render import RenderOptions, render
from padgs.render.leave_one_out import leave_one_out
from padgs.render.leave_some_out import leave_some_out
from padgs.scene import View

SHARP = RenderOptions(projection="ray", low_pass=0.0)


def four_in_a_row() -> tuple[Gaussians, View, Tensor, Tensor]:
    """Gaussians behind each other in the one pixel that counts, whose target and weight are returned as well."""
    ray = rays(16, 8, dtype=torch.float64)[3, 5]
    gaussians = Gaussians(
        means=torch.arange(1.0, 5.0, dtype=torch.float64)[:, None] * ray,
        quats=torch.tensor([[1.0, 0, 0, 0]] * 4, dtype=torch.float64),
        scales=torch.full((4, 3), 0.1, dtype=torch.float64),
        opacities=torch.tensor([0.5, 0.4, 0.7, 0.9], dtype=torch.float64),
        colors=torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0.2, 0.8, 0.4], [1.0, 1.0, 1.0]], dtype=torch.float64),
    )
    target, weight = torch.zeros(8, 16, 3, dtype=torch.float64), torch.zeros(8, 16, dtype=torch.float64)
    target[3, 5] = torch.tensor([0.3, 0.2, 0.6])
    weight[3, 5] = 1.0
    return gaussians, view_of(camera_of("panorama", 16, 8)), target, weight


@pytest.mark.parametrize("share", [0.0, 0.1, 0.6])
def test_it_is_the_squared_error_of_the_mean_over_all_groups_with_a_gaussian_less_that_without(share):
    gaussians, view, target, weight = four_in_a_row()
    means = torch.zeros(4, 2, 3, dtype=torch.float64)  # of the pixel, by who is asked about, and whether it is there
    for group in itertools.product((False, True), repeat=4):
        there = torch.tensor(group)
        pixel = render(chosen(gaussians, there), view, SHARP, backend="torch").image[3, 5]
        for i in range(4):
            others = group[:i] + group[i + 1 :]
            means[i, int(group[i])] += math.prod(1 - share if one else share for one in others) * pixel
    gone, kept = ((means - target[3, 5]).square().mean(-1)).unbind(1)
    found = leave_some_out(gaussians, view, target, weight, share, SHARP, backend="torch")
    assert found.tolist() == pytest.approx((gone - kept).tolist(), abs=1e-8)
    assert found.abs().min() > 5e-4, "or the test sees nothing"


def test_alone_it_is_what_one_removal_does():
    gaussians, view, target, weight = four_in_a_row()
    found = leave_some_out(gaussians, view, target, weight, 0.0, SHARP, backend="torch")
    alone = leave_one_out(gaussians, view, target, weight, SHARP, backend="torch").error
    assert found.tolist() == pytest.approx(alone.tolist(), rel=1e-12)


@needs_native
@pytest.mark.parametrize("seed", [1, 7])
def test_ranks_of_random_groups_are_those_of_true_ones_and_nearer_than_by_sums_of_single_removals(seed):
    count, generator = 1000, torch.Generator().manual_seed(seed)
    true = gaussians_of("ordinary", count, generator).to(torch.float32)
    true = Gaussians(true.means, true.quats, 2 * true.scales, true.opacities / 2, true.colors)  # many in a pixel
    view, options = view_of(camera_of("panorama", 64, 32)), RenderOptions(projection="ray")
    target = render(true, view, options, backend="cpu").image
    noise = torch.randn(true.means.shape, generator=generator)
    model = Gaussians(true.means + 0.006 * noise, true.quats, true.scales, true.opacities, true.colors + 0.03 * noise)
    weight = torch.rand(32, 1, generator=generator)

    def mean_square(kept: Tensor) -> float:
        image = render(chosen(model, kept), view, options, backend="cpu").image
        return float(((image - target).double().square().mean(-1) * weight).sum() / (64 * weight.sum()))

    before = mean_square(torch.ones(count, dtype=torch.bool))
    alone = leave_one_out(model, view, target, weight, options, backend="cpu").error
    for share in (0.01, 0.05, 0.1):
        groups = torch.stack([torch.randperm(count, generator=generator) < share * count for _ in range(100)])
        costs = [mean_square(~group) - before for group in groups]
        together = leave_some_out(model, view, target, weight, share, options, backend="cpu")
        ranks, ranks_alone = (spearmanr(groups.double() @ scores, costs)[0] for scores in (together, alone))
        assert ranks > 0.9, share
    assert ranks > ranks_alone + 0.02, "of a tenth"


@pytest.mark.parametrize("share", [-0.1, 1.0, math.nan])
def test_a_group_that_is_no_share_is_refused(share):
    gaussians, view, target, weight = four_in_a_row()
    with pytest.raises(ValueError, match=rf"share is {share}; a group has a share of the Gaussians in \[0, 1\)"):
        leave_some_out(gaussians, view, target, weight, share, SHARP)
