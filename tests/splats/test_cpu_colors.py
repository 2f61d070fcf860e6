"""The native colours against the definition, values and gradients."""

import pytest
import torch

from padgs.native import cpu
from padgs.scene import View
from padgs.splats import cpu_colors
from padgs.splats.model import Splats

VIEW = View("v", torch.eye(4, dtype=torch.float64), 32, 16)

pytestmark = pytest.mark.skipif(not cpu.available(), reason="the native CPU library was not built")


@pytest.mark.parametrize("count", [1, 1000])
@pytest.mark.parametrize("stored", [0, 1, 2, 3])
def test_values_and_gradients_are_those_of_the_definition(monkeypatch, generator, stored, count):
    means = torch.randn(count, 3, generator=generator)
    means[0] = VIEW.center  # no direction
    splats = Splats(means, torch.zeros(count, 3), torch.rand(count, 3, generator=generator), degree=stored)
    splats.sh_rest.data = 0.4 * torch.randn(splats.sh_rest.shape, generator=generator)  # some colours are cut at 0
    upstream = torch.randn(count, 3, generator=generator)
    for degree in range(stored + 1):
        splats.active_degree = degree
        found = []
        for native in (True, False):
            with monkeypatch.context() as patch:
                if not native:
                    patch.setattr(cpu_colors, "fits", lambda *_: False)
                splats.zero_grad()
                colors = splats.gaussians(VIEW).colors
                colors.backward(upstream)
            gradients = (splats.means.grad, splats.sh_dc.grad, splats.sh_rest.grad)
            found.append([colors.detach(), *(torch.zeros(()) if g is None else g.clone() for g in gradients)])
        for native, defined in zip(*found, strict=True):
            assert torch.allclose(native, defined.expand_as(native), atol=2e-6 * max(1.0, float(defined.abs().max())))
