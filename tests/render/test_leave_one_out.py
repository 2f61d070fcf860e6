"""Leave-one-out scores against actual removals."""

import pytest
import torch
from scipy.stats import spearmanr
from support import cuda_engine
from support import render_cases as cases
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.panorama import rays
from padgs.render import RenderOptions, render
from padgs.render.leave_one_out import leave_one_out
from padgs.scene import View

COUNT = 1000
SHARP = RenderOptions(projection="ray", low_pass=0.0)


def mean_square(gaussians: Gaussians, view: View, target: Tensor, weight: Tensor, options: RenderOptions, backend: str):
    image = render(gaussians, view, options, backend=backend).image
    return ((image - target).double().square().mean(-1) * weight).sum() / weight.expand(target.shape[:2]).sum()


def without(gaussians: Gaussians, removed: Tensor) -> Gaussians:
    kept = torch.ones(len(gaussians), dtype=torch.bool)
    kept[removed] = False
    return cases.chosen(gaussians, kept)


def test_two_gaussians_by_hand():
    view = cases.view_of(cases.camera_of("panorama", 16, 8))
    ray = rays(16, 8, dtype=torch.float64)[3, 5]
    gaussians = Gaussians(
        means=torch.stack((1.0 * ray, 2.0 * ray)),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=torch.float64),
        scales=torch.full((2, 3), 0.1, dtype=torch.float64),
        opacities=torch.tensor([0.5, 0.4], dtype=torch.float64),
        colors=torch.tensor([[1.0, 0, 0], [0, 0, 1.0]], dtype=torch.float64),
    )
    target, weight = torch.zeros(8, 16, 3, dtype=torch.float64), torch.zeros(8, 16, dtype=torch.float64)
    target[3, 5] = torch.tensor([0.0, 0.0, 0.4])
    weight[3, 5] = 7.0  # whatever: only ratios matter
    found = leave_one_out(gaussians, view, target, weight, SHARP)
    # The pixel is (0.5, 0, 0.2). Without the first it is (0, 0, 0.4), the target; without the second (0.5, 0, 0).
    assert found.error.tolist() == pytest.approx([-(0.25 + 0.04) / 3, (0.16 - 0.04) / 3], abs=1e-8)  # q is not quite 0
    assert found.change.tolist() == pytest.approx([(0.25 + 0.04) / 3, 0.04 / 3], abs=1e-8)
    assert found.contribution.tolist() == pytest.approx([0.5, 0.2], abs=1e-8)
    assert found.peak.tolist() == pytest.approx([0.5, 0.2], abs=1e-8)


@cases.each_setup
@pytest.mark.parametrize("backend", ["torch", pytest.param("cpu", marks=cases.needs_native)])
def test_scores_match_actual_removals(projection, lens, backend):
    generator = torch.Generator().manual_seed(3)
    dtype = torch.float64 if backend == "torch" else torch.float32
    gaussians = cases.mixture(6, generator, ("ordinary", "huge", "needle")).to(dtype)
    camera = cases.camera_of(lens, 36, 18)
    view, options = cases.view_of(camera, cases.random_pose(generator)), RenderOptions(projection=projection)
    target = torch.rand(18, 36, 3, generator=generator, dtype=torch.float64).to(dtype)
    weight = torch.rand(18, 36, generator=generator, dtype=torch.float64).to(dtype)
    before = mean_square(gaussians, view, target, weight, options, backend)
    found = leave_one_out(gaussians, view, target, weight, options, backend=backend)
    true = [
        (mean_square(without(gaussians, torch.tensor([i])), view, target, weight, options, backend) - before).item()
        for i in range(len(gaussians))
    ]
    assert found.error.tolist() == pytest.approx(true, rel=1e-6, abs=1e-15 if backend == "torch" else 2e-8)
    assert max(map(abs, true)) > 5e-4, "or the test sees nothing"


@cases.needs_native
def test_targets_have_any_dtype_but_the_size_of_the_view():
    generator = torch.Generator().manual_seed(2)
    gaussians, view = cases.mixture(3, generator).to(torch.float32), cases.view_of(cases.camera_of("panorama", 16, 8))
    target, weight = torch.rand(8, 16, 3, generator=generator), torch.ones(8, 16)
    usual = leave_one_out(gaussians, view, target, weight, SHARP, backend="cpu")
    doubled = leave_one_out(gaussians, view, target.double(), weight.double(), SHARP, backend="cpu")
    assert torch.equal(usual.error, doubled.error) and usual.error.any()
    with pytest.raises(
        ValueError, match=r"target has shape \[4, 16, 3\], but the view is 16x8; it must be \[8, 16, 3\]"
    ):
        leave_one_out(gaussians, view, target[:4], weight[:4], SHARP, backend="cpu")
    for unusable in (weight[0], weight[:, :8], 0 * weight):
        with pytest.raises(
            ValueError, match=r"weights have shape .* or \[H, 1\] for a target of \[8, 16, 3\], with a sum"
        ):
            leave_one_out(gaussians, view, target, unusable, SHARP, backend="cpu")


@cases.each_setup
@pytest.mark.parametrize(
    "backend", [pytest.param("cpu", marks=cases.needs_native), pytest.param("cuda", marks=cuda_engine.marks())]
)
def test_native_agrees_with_the_definition(projection, lens, backend):
    generator = torch.Generator().manual_seed(1)
    gaussians = cases.mixture(20, generator).to(torch.float32)
    view = cases.view_of(cases.camera_of(lens, 70, 44), cases.random_pose(generator))
    target, weight = torch.rand(44, 70, 3, generator=generator), torch.rand(44, 70, generator=generator)
    steepness = 0.3 if projection in ("tangent", "ray") else 0.0
    options = RenderOptions(projection=projection, near=0.001, steepness=steepness, max_instances=400)  # in strips, too
    native, defined = (
        leave_one_out(gaussians, view, target, weight, options, backend=name) for name in (backend, "torch")
    )
    assert torch.allclose(native.error, defined.error, rtol=1e-3, atol=3e-6)
    assert torch.allclose(native.change, defined.change, rtol=1e-3, atol=3e-6)
    assert torch.allclose(native.contribution, defined.contribution, rtol=1e-3, atol=3e-6)
    assert torch.allclose(native.peak, defined.peak, rtol=1e-2, atol=3e-3)


@cases.needs_native
def test_rank_correlation_with_actual_removals():
    generator = torch.Generator().manual_seed(0)
    true = cases.gaussians_of("ordinary", COUNT, generator).to(torch.float32)
    view, options = cases.view_of(cases.camera_of("panorama", 64, 32)), RenderOptions(projection="ray")
    target = render(true, view, options).image
    noise = torch.randn(true.means.shape, generator=generator)
    model = Gaussians(true.means + 0.02 * noise, true.quats, true.scales, true.opacities, true.colors + 0.1 * noise)
    weight = torch.rand(32, 1, generator=generator)
    before = mean_square(model, view, target, weight, options, "cpu")
    error = leave_one_out(model, view, target, weight, options).error

    def correlation(groups: list[Tensor]) -> float:
        costs = [mean_square(without(model, g), view, target, weight, options, "cpu") - before for g in groups]
        return float(spearmanr([error[g].sum() for g in groups], costs)[0])

    shuffled = torch.randperm(COUNT, generator=generator)
    assert correlation(list(shuffled[:200, None])) >= 0.999
    for share in (0.01, 0.05, 0.1):
        groups = [torch.randperm(COUNT, generator=generator)[: int(share * COUNT)] for _ in range(40)]
        assert correlation(groups) > 0.9, share


def test_masks_and_other_blendings():
    generator = torch.Generator().manual_seed(2)
    gaussians, view = (
        cases.gaussians_of("ordinary", 30, generator),
        cases.view_of(cases.camera_of("panorama", 24, 12), cases.identity_pose()),
    )
    target = torch.rand(12, 24, 3, generator=generator, dtype=torch.float64)
    weight = torch.ones(12, 24, dtype=torch.float64)
    weight[:, 6:] = 0
    options = RenderOptions(projection="ray", blending="hybrid", core_size=4)
    found = leave_one_out(gaussians, view, target, weight, options)
    assert torch.equal(found.error, leave_one_out(gaussians, view, target, weight, RenderOptions("ray")).error)
    hidden = found.contribution == 0
    assert hidden.any() and (found.error[hidden] == 0).all() and (found.peak[hidden] > 0).any()
    cubemap = leave_one_out(gaussians, view, target, weight, RenderOptions("pinhole", cubemap=True))
    assert torch.isfinite(cubemap.error).all()
    square = RenderOptions("pinhole", cubemap=True, wrap=False, bounds="square")
    assert torch.equal(leave_one_out(gaussians, view, target, weight, square).change, cubemap.change)
