"""Random splats, and their native evaluation against the definition."""

import pytest
import torch
from torch import Tensor

from padgs.methods.splats import splats as splats_module
from padgs.methods.splats.splats import Splats
from padgs.scene import View
from support.tiny_scene import tiny_scene


def splats_of(count: int, stored: int, center: Tensor, generator: torch.Generator) -> Splats:
    """Return splats of all sizes and opacities, the first at the camera; some colours are clamped at 0."""
    means = torch.randn(count, 3, generator=generator)
    means[0] = center
    log_scales = 3 * torch.randn(count, 3, generator=generator) - 4
    splats = Splats(means, log_scales, torch.rand(count, 3, generator=generator), degree=stored)
    splats.opacity_logits.data = 4 * torch.randn(count, generator=generator)
    splats.sh_rest.data = 0.4 * torch.randn(splats.sh_rest.shape, generator=generator)
    return splats


def evaluated(splats: Splats, view: View, width: int, call, monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    """Return values and gradients by a native function, or by the definition if `call` is None.

    `width` is the number of columns of the mean offsets; 0: none are given.
    """
    device = splats.means.device
    mean_offsets = 0.1 * torch.ones(len(splats), width, device=device).cumsum(-1).requires_grad_() if width else None
    with monkeypatch.context() as patch:
        patch.setattr(splats_module, "native_call", lambda *_: call)
        gaussians, absgrad = splats.displaced(view, mean_offsets)
    assert (absgrad is None) == (width < 4)
    values = [gaussians.means, gaussians.scales, gaussians.opacities, gaussians.colors]
    values += [] if absgrad is None else [absgrad]
    generator = torch.Generator().manual_seed(0)
    upstream = [torch.randn(value.shape, generator=generator).to(device) for value in values]
    leaves = [*splats.parameters(), *([] if mean_offsets is None else [mean_offsets])]
    gradients = torch.autograd.grad(values, leaves, upstream, allow_unused=True)
    return [*values, *(torch.zeros((), device=device) if one is None else one for one in gradients)]


def assert_matches_definition(
    splats: Splats, view: View, width: int, call, monkeypatch: pytest.MonkeyPatch, *, tolerance: float
) -> None:
    """Compare values and gradients at all active degrees."""
    for degree in range(splats.degree + 1):
        splats.active_degree = degree
        found, expected = (evaluated(splats, view, width, each, monkeypatch) for each in (call, None))
        for ours, truth in zip(found, expected, strict=True):
            limit = 2 * tolerance * max(1.0, float(truth.detach().abs().max()))
            torch.testing.assert_close(ours, truth.expand_as(ours), atol=limit, rtol=tolerance)


def random_splats(degree: int, generator: torch.Generator) -> Splats:
    """Return splats of the tiny scene with random numbers in all rows."""
    splats = Splats.from_scene(tiny_scene(), degree=degree, generator=generator)
    for row in splats.rows().values():
        row.data = torch.randn(row.shape, generator=generator)
    splats.active_degree = degree
    return splats
