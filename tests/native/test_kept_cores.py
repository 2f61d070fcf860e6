"""Cores that hybrid blending keeps for its backward pass."""

from dataclasses import replace

import pytest
import torch
from support.render_cases import each_native_engine, gaussians_of, identity_pose, leaves, needs_native
from test_hybrid_rendering import options_of

from padgs.gaussians import Gaussians
from padgs.render import RenderOptions, render
from padgs.render.backends import cpu as cpu_backend
from padgs.scene import View


@pytest.mark.parametrize("options", [RenderOptions("ray"), options_of("ray", 3)], ids=["sorted", "hybrid"])
@each_native_engine
def test_repeated_backward_is_equal(backend: str, options: RenderOptions, generator: torch.Generator):
    inputs = leaves(gaussians_of("ordinary", 12, generator), torch.float32)
    rendering = render(inputs, View("v", identity_pose(), 40, 20), options, backend=backend)
    loss = rendering.image.square().sum() + rendering.depth.sum()
    first, second = (torch.autograd.grad(loss, [*vars(inputs).values()], retain_graph=True) for _ in range(2))
    assert all(torch.equal(*pair) and pair[0].any() for pair in zip(first, second, strict=True))


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> list:
    """Collect the cores that forward passes on the CPU keep."""
    found, draw = [], cpu_backend._Image.draw

    def drawn(image, *arguments, **options):
        pixels = draw(image, *arguments, **options)
        found.extend(image._cores)
        return pixels

    monkeypatch.setattr(cpu_backend._Image, "draw", drawn)
    return found


@needs_native
@pytest.mark.parametrize("size", [1, 3, 16, 256])
def test_kept_cores_fit_their_buffer(size: int, kept: list, generator: torch.Generator):
    """Opaque dots of about a pixel: neighbouring pixels have different cores."""
    count, view = 20_000, View("v", identity_pose(), 60, 30)
    gaussians = gaussians_of("ordinary", count, generator)
    dots = replace(gaussians, scales=torch.full((count, 3), 0.1), opacities=torch.full((count,), 0.9))
    inputs = leaves(dots, torch.float32)
    for few in (5, count):
        part = Gaussians(*(value[:few] for value in vars(inputs).values()))
        render(part, view, options_of("ray", size, low_pass=0.0), backend="cpu").image.sum().backward()
        words, start = kept[-1]
        used, room = int(start[-1]), len(words)
        patches = 8 * 15
        assert 98 * patches < used <= room <= patches * (98 + min(17 * few, 32 * size))
        assert few < count or used > patches * (98 + 12)  # in words: a third of the room where the core is one


@needs_native
def test_cores_are_kept_only_with_gradients(kept: list, generator: torch.Generator):
    gaussians, view = gaussians_of("ordinary", 12, generator).to(torch.float32), View("v", identity_pose(), 40, 20)
    render(gaussians, view, options_of("ray", 3), backend="cpu")
    with torch.no_grad():
        render(leaves(gaussians, torch.float32), view, options_of("ray", 3), backend="cpu")
    render(leaves(gaussians, torch.float32), view, RenderOptions("ray"), backend="cpu")
    assert not kept
