"""The native splats against the definition, values and gradients."""

import pytest
import torch
from support.splat_cases import assert_matches_definition, splats_of

from padgs.methods.splats import native_splats
from padgs.methods.splats import splats as splats_module
from padgs.methods.splats.splats import Splats
from padgs.native import cpu
from padgs.scene import View

VIEW = View("v", torch.eye(4, dtype=torch.float64), 32, 16)

pytestmark = pytest.mark.skipif(not cpu.available(), reason="the native CPU library was not built")


@pytest.mark.parametrize("count", [1, 1000])
@pytest.mark.parametrize("width", [0, 3, 4])
@pytest.mark.parametrize("stored", [0, 1, 2, 3])
def test_native_matches_the_definition(monkeypatch, generator, stored, width, count):
    splats = splats_of(count, stored, VIEW.center, generator)
    assert_matches_definition(splats, VIEW, width, native_splats.call_cpu, monkeypatch, tolerance=1e-6)


@pytest.mark.parametrize("call", [native_splats.call_cpu, None])
def test_initially_black_colours_get_gradients(monkeypatch, generator, call):
    """Rounding must not clamp colours that begin at 0: they would never get a gradient."""
    monkeypatch.setattr(splats_module, "native_call", lambda *_: call)
    splats = splats_of(4, 2, VIEW.center, generator)
    black = Splats(splats.means, splats.log_scales, torch.eye(4)[:, :3], degree=2)
    black.gaussians(VIEW).colors.sum().backward()
    assert black.sh_dc.grad is not None and (black.sh_dc.grad > 0.28).all()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 80.0, -80.0, 200.0, -200.0, 0.0])
@pytest.mark.parametrize("count", [1, 16, 40])
def test_extreme_parameters_match_the_definition(generator, value, count):
    """NaN stays NaN, and nothing else becomes NaN."""
    splats = splats_of(count, 0, VIEW.center, generator)
    splats.log_scales.data[-1, 1] = value
    splats.opacity_logits.data[-1] = value
    seen = splats.gaussians(VIEW)
    torch.testing.assert_close(seen.scales, splats.log_scales.exp(), rtol=1e-6, atol=0.0, equal_nan=True)
    torch.testing.assert_close(seen.opacities, splats.opacity_logits.sigmoid(), rtol=1e-6, atol=1e-38, equal_nan=True)
