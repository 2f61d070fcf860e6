"""Attributes of explicit Gaussians on the GPU, or emulated, against their definition: values and gradients."""

from __future__ import annotations

import pytest
import torch
from support import cuda_engine
from torch import Tensor

from padgs.methods.splats import native_splats
from padgs.methods.splats import splats as splats_module
from padgs.methods.splats.splats import Splats
from padgs.scene import View

pytestmark = [*cuda_engine.marks()]
DEVICE = "cuda" if cuda_engine.ON_GPU else "cpu"
POSE = torch.eye(4)
POSE[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
VIEW = View("v", POSE.to(DEVICE), 32, 16)


def splats_of(count: int, stored: int, active: int, generator: torch.Generator) -> Splats:
    """Return splats of all sizes and opacities, the first at the camera; some colours are clamped at 0."""
    means = torch.randn(count, 3, generator=generator)
    means[0] = -POSE[:3, 3]
    log_scales = 3 * torch.randn(count, 3, generator=generator) - 4
    splats = Splats(means, log_scales, torch.rand(count, 3, generator=generator), degree=stored)
    splats.opacity_logits.data = 4 * torch.randn(count, generator=generator)
    splats.sh_rest.data = 0.4 * torch.randn(splats.sh_rest.shape, generator=generator)
    splats.active_degree = active
    return splats.to(DEVICE)


def seen(splats: Splats, width: int, how: str, monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    """Return values and gradients, by kernels or by the definition."""
    probe = 0.1 * torch.ones(len(splats), width, device=DEVICE).cumsum(-1).requires_grad_() if width else None
    with monkeypatch.context() as patch:
        call = native_splats.call_cuda if how == "kernels" else None
        patch.setattr(splats_module, "native_call", lambda *_: call)
        gaussians, pulls = splats.displaced(VIEW, probe)
    values = [gaussians.means, gaussians.scales, gaussians.opacities, gaussians.colors]
    values += [] if pulls is None else [pulls]
    generator = torch.Generator().manual_seed(0)
    upstream = [torch.randn(value.shape, generator=generator).to(DEVICE) for value in values]
    leaves = [*splats.parameters(), *([] if probe is None else [probe])]
    gradients = torch.autograd.grad(values, leaves, upstream, allow_unused=True)
    return [*values, *(torch.zeros((), device=DEVICE) if one is None else one for one in gradients)]


@pytest.mark.parametrize("count", [1, 128, 300])
@pytest.mark.parametrize("width", [0, 3, 4])
@pytest.mark.parametrize("stored", [0, 1, 2, 3])
def test_values_and_gradients_are_those_of_the_definition(monkeypatch, generator, stored: int, width: int, count: int):
    for active in range(stored + 1):
        splats = splats_of(count, stored, active, generator)
        found, expected = (seen(splats, width, how, monkeypatch) for how in ("kernels", "definition"))
        for ours, truth in zip(found, expected, strict=True):
            limit = 4e-6 * max(1.0, float(truth.detach().abs().max()))
            torch.testing.assert_close(ours, truth.expand_as(ours), atol=limit, rtol=2e-6)


def test_nan_stays_nan(monkeypatch: pytest.MonkeyPatch, generator: torch.Generator):
    splats = splats_of(5, 3, 3, generator)
    splats.sh_rest.data[2, 4, 1] = float("nan")
    colors = seen(splats, 0, "kernels", monkeypatch)[3]
    assert colors.isnan().nonzero().tolist() == [[2, 1]]


def test_supported_inputs(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(native_splats.LIBRARIES, DEVICE, native_splats.cuda)
    means, center = torch.zeros(2, 3, device=DEVICE), torch.zeros(3, device=DEVICE)
    assert native_splats.native_call(means, center) is native_splats.call_cuda
    assert native_splats.native_call(means.double(), center) is None
    assert native_splats.native_call(means, center.requires_grad_()) is None
