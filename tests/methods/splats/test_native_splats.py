"""The native splats against the definition, values and gradients."""

import pytest
import torch

from padgs.methods.splats import native_splats
from padgs.methods.splats import splats as splats_module
from padgs.methods.splats.splats import Splats
from padgs.native import cpu
from padgs.scene import View

VIEW = View("v", torch.eye(4, dtype=torch.float64), 32, 16)

pytestmark = pytest.mark.skipif(not cpu.available(), reason="the native CPU library was not built")


def splats_of(count: int, degree: int, generator: torch.Generator) -> Splats:
    """Of all sizes and opacities, the first in the camera; some colours are cut at 0."""
    means = torch.randn(count, 3, generator=generator)
    means[0] = VIEW.center
    log_scales = 3 * torch.randn(count, 3, generator=generator) - 4
    splats = Splats(means, log_scales, torch.rand(count, 3, generator=generator), degree=degree)
    splats.opacity_logits.data = 4 * torch.randn(count, generator=generator)
    splats.sh_rest.data = 0.4 * torch.randn(splats.sh_rest.shape, generator=generator)
    return splats


@pytest.mark.parametrize("count", [1, 1000])
@pytest.mark.parametrize("width", [0, 3, 4])
@pytest.mark.parametrize("stored", [0, 1, 2, 3])
def test_values_and_gradients_are_those_of_the_definition(monkeypatch, generator, stored, width, count):
    splats = splats_of(count, stored, generator)
    shapes = [(count, 3), (count, 3), (count,), (count, 3), (count,)]
    upstream = [torch.randn(shape, generator=generator) for shape in shapes]
    for degree in range(stored + 1):
        splats.active_degree = degree
        found = []
        for native in (True, False):
            probe = 0.1 * torch.ones(count, width).cumsum(-1).requires_grad_() if width else None
            with monkeypatch.context() as patch:
                if not native:
                    patch.setattr(splats_module, "native_call", lambda *_: None)
                splats.zero_grad()
                seen, pulls = splats.displaced(VIEW, probe)
                assert (pulls is None) == (width < 4)
                values = [seen.means, seen.scales, seen.opacities, seen.colors, *([] if pulls is None else [pulls])]
                leaves = [*splats.parameters(), *([] if probe is None else [probe])]
                gradients = torch.autograd.grad(values, leaves, upstream[: len(values)], allow_unused=True)
            found.append([*values, *(torch.zeros(()) if g is None else g for g in gradients)])
        for native, defined in zip(*found, strict=True):
            limit = 2e-6 * max(1.0, float(defined.detach().abs().max()))
            torch.testing.assert_close(native, defined.expand_as(native), atol=limit, rtol=1e-6)


def test_initially_black_colours_get_gradients(monkeypatch, generator):
    """Rounding must not cut off what begins at 0, for nothing would ever pull at it."""
    splats = splats_of(4, 2, generator)
    black = Splats(splats.means, splats.log_scales, torch.eye(4)[:, :3], degree=2)
    for native in (True, False):
        with monkeypatch.context() as patch:
            if not native:
                patch.setattr(splats_module, "native_call", lambda *_: None)
            black.zero_grad()
            black.gaussians(VIEW).colors.sum().backward()
            assert black.sh_dc.grad is not None and (black.sh_dc.grad > 0.28).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rest": torch.zeros(2, 3, 3)}, "sh_rest has 3 coefficients, but degree 2 in use takes 8 to 15"),
        ({"rest": torch.zeros(2, 24, 3)}, "sh_rest has 24 coefficients"),
        ({"mean_offsets": torch.zeros(2, 5)}, "mean_offsets has 5 columns; it must have 3 or 4"),
        ({"dc": torch.zeros(2, 3, dtype=torch.float64)}, "dc torch.float64 on cpu"),
    ],
)
def test_invalid_tensors_are_refused(change, said):
    two = {"means": torch.zeros(2, 3), "log_scales": torch.zeros(2, 3), "opacity_logits": torch.zeros(2)}
    learned = native_splats.Parameters(
        **two | {"dc": torch.zeros(2, 3), "rest": torch.zeros(2, 8, 3), "mean_offsets": None} | change
    )
    with pytest.raises(ValueError, match=said):
        native_splats.native_splats(learned, 2, torch.zeros(3), 1e-6)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 80.0, -80.0, 200.0, -200.0, 0.0])
@pytest.mark.parametrize("count", [1, 16, 40])
def test_extreme_parameters_match_the_definition(generator, value, count):
    """So that what is no number is found out, and nothing else becomes one."""
    splats = splats_of(count, 0, generator)
    splats.log_scales.data[-1, 1] = value
    splats.opacity_logits.data[-1] = value
    seen = splats.gaussians(VIEW)
    torch.testing.assert_close(seen.scales, splats.log_scales.exp(), rtol=1e-6, atol=0.0, equal_nan=True)
    torch.testing.assert_close(seen.opacities, splats.opacity_logits.sigmoid(), rtol=1e-6, atol=1e-38, equal_nan=True)
