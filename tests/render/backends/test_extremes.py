"""Gaussians at the limits of arithmetic: nothing becomes infinite or NaN, and neighbours are not harmed."""

import math

import pytest
import torch
from support import render_cases as cases
from test_parity import ENGINES_IN_FLOAT32, assert_same

from padgs.gaussians import Gaussians
from padgs.render import RenderOptions, render


def one(mean, scale, *, quat=(1.0, 0.0, 0.0, 0.0), opacity=0.8) -> Gaussians:
    values = (mean, quat, scale, opacity, (0.3, 0.5, 0.7))
    return Gaussians(*(torch.tensor([value], dtype=torch.float64) for value in values))


EXTREME = {
    "on the camera": one((0, 0, 0), (0.1, 0.1, 0.1)),
    **{f"{r:g} from the camera": one((r, 0, r), (0.1, 0.1, 0.1)) for r in (1e-30, 1e-20, 1e-12, 1e-7, 1e-5, 1e-3)},
    **{f"a small one {r:g} from the camera": one((r, 0, r), (0.1 * r,) * 3) for r in (1e-30, 1e-20, 1e-12, 1e-5)},
    **{
        f"{a:g} rad from the axis": one((0, s, a), (0.1, 0.2, 0.1))
        for a, s in ((0, 1), (1e-7, -1), (1e-5, 1), (1e-3, -1))
    },
    **{f"scale {s:g}": one((0, 0.3, 1), (s, s, s)) for s in (1e-30, 1e-8, 1e4, 1e12, 1e30)},
    "needle": one((0.2, 0.3, 1), (1e4, 1e-8, 1e-8), quat=(0.3, -0.5, 0.7, 0.1)),
    "short needle": one((0.2, 0.3, 1), (0.1, 1e-15, 1e-25), quat=(0.3, -0.5, 0.7, 0.1)),
    "very far": one((1e25, 0, 1e25), (1e24, 1e24, 1e24)),
    "far": one((1e15, 0, 1e15), (1e14, 1e14, 1e14)),
    "in the image plane": one((1, 0.2, 0), (0.1, 0.1, 0.1)),
    "just before the image plane": one((1, 0.2, 1e-12), (0.1, 0.1, 0.1)),
    "opacity 0": one((0, 0.3, 1), (0.1, 0.2, 0.3), opacity=0.0),
    "opacity 1": one((0, 0.3, 1), (0.1, 0.2, 0.3), opacity=1.0),
    "tiny quaternion": one((0, 0.3, 1), (0.1, 0.2, 0.3), quat=(1e-18, 1e-18, 0, 0)),
}


@pytest.mark.parametrize("name", EXTREME)
@cases.each_setup
@cases.each_engine
def test_extreme_gaussians_stay_finite(name: str, projection, lens, backend, dtype):
    both = cases.joined(EXTREME[name], cases.gaussians_of("ordinary", 3, torch.Generator().manual_seed(1)))
    inputs, pose = cases.leaves(both, dtype), cases.identity_pose().to(dtype).requires_grad_()
    view = cases.view_of(cases.camera_of(lens, 32, 16), pose)
    settings = ({}, {"low_pass": 0.0}, {"wrap": False}) if projection == "erp" else ({}, {"low_pass": 0.0})
    for options in (RenderOptions(projection, **some) for some in settings):
        rendering = render(inputs, view, options, backend=backend)
        outputs = (rendering.image, rendering.transmittance, rendering.depth)
        for output in outputs:
            assert torch.isfinite(output).all()
        gradients = torch.autograd.grad(sum(output.sum() for output in outputs), [*vars(inputs).values(), pose])
        for key, gradient in zip((*cases.INPUTS, "pose"), gradients, strict=True):
            assert torch.isfinite(gradient).all(), key
        stepped = Gaussians(
            **{key: getattr(inputs, key).detach() - 1e-4 * g for key, g in zip(cases.INPUTS, gradients, strict=False)}
        )
        assert torch.isfinite(render(stepped, view, options, backend=backend).image).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("numbers", [slice(None), slice(-1, None)], ids=["all", "one"])  # of a Gaussian
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities"])
@cases.each_setup
@cases.each_engine
def test_non_finite_gaussians_are_not_rendered(name: str, numbers, bad: float, projection, lens, backend, dtype):
    gaussians = cases.gaussians_of("ordinary", 4, torch.Generator().manual_seed(2))
    broken, options = cases.leaves(gaussians, dtype), RenderOptions(projection)
    getattr(broken, name).data[1].view(-1)[numbers] = bad
    engine = {"backend": backend, "dtype": dtype, "lens": lens, "options": options}
    pose = cases.identity_pose().to(dtype).requires_grad_()
    rendering = render(broken, cases.view_of(cases.camera_of(lens, 32, 16), pose), options, backend=backend)
    if (name, bad) != ("opacities", math.inf):  # an opacity above the maximum is limited to it
        expected = cases.draw(cases.chosen(gaussians, torch.tensor([0, 2, 3])), 32, 16, **engine)
        torch.testing.assert_close(rendering.image, expected.image, rtol=0, atol=1e-6)
        rendering.image.sum().backward()
        assert torch.isfinite(broken.colors.grad).all() and torch.isfinite(broken.means.grad).all()
        assert backend == "torch" or torch.isfinite(pose.grad).all()  # autograd multiplies an infinite mean by 0
    assert torch.isfinite(rendering.image).all()


@pytest.mark.slow
@pytest.mark.parametrize(("projection", "lens"), [setup for setup in cases.SETUPS if setup[0] in ("erp", "pinhole")])
@pytest.mark.parametrize(("backend", "dtype"), ENGINES_IN_FLOAT32)
def test_long_oblique_needles_in_float32(projection, lens, backend, dtype):
    """Hundreds of pixels long and thinner than one: du^2, du dv and dv^2 are large, but their sum is small."""
    generator = torch.Generator().manual_seed(3)
    half = torch.deg2rad(torch.tensor([[45.0], [-30.0], [20.0]], dtype=torch.float64)) / 2
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.05, 1.25], [-0.2, 0.1, 1.5]], dtype=torch.float64),
        quats=half.cos() * torch.tensor([1.0, 0, 0, 0]) + half.sin() * torch.tensor([0, 0, 0, 1.0]),
        scales=torch.tensor([[0.3, 1e-4, 1e-4]], dtype=torch.float64).expand(3, 3),
        opacities=torch.tensor([0.9, 0.5, 0.7], dtype=torch.float64),
        colors=torch.tensor([[0.3, 0.5, 0.7], [0.9, 0.2, 0.1], [0.2, 0.8, 0.4]], dtype=torch.float64),
    )
    gaussians = gaussians.to(torch.float32).to(torch.float64)
    options, pose = RenderOptions(projection), torch.eye(4, dtype=torch.float64)
    assert_same(gaussians, (2048, 1024), lens, options, generator, pose=pose, backend=backend, dtype=dtype, slack=6)
