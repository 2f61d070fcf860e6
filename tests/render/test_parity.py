"""All backends draw the same and differentiate the same as the definition in float64 (T0, N9); for any thread count."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from render_cases import (
    INPUTS,
    KINDS,
    ODD_SIZES,
    each_engine,
    gaussians_of,
    leaves,
    mixture,
    needs_native,
    random_pose,
    row_error,
    stable_pixels,
)
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.render import Rendering, RenderOptions, render
from padgs.scene import View

OUTPUTS = ("image", "transmittance", "depth")
CONFIGURATIONS = {
    "ours": RenderOptions(),
    "no wrap": RenderOptions(wrap=False),
    "published": RenderOptions(near=0.02, wrap=False, bounds="square"),
    "sharp": RenderOptions(near=0.02, low_pass=0.05),
}


def run(gaussians, width, height, options, weights, *, pose, backend, dtype) -> tuple[Rendering, dict[str, Tensor]]:
    """A rendering, and the gradients of the sum of its outputs times the weights by every input."""
    inputs = leaves(gaussians, dtype)
    extra = {
        "pose": pose.to(dtype, copy=True).requires_grad_(),
        "background": torch.tensor([0.3, 0.6, 0.9], dtype=dtype, requires_grad=True),
        "probe": torch.zeros(len(gaussians), 2, dtype=dtype, requires_grad=True),
    }
    view = View("v", extra["pose"], width, height)
    rendering = render(inputs, view, options, background=extra["background"], probe=extra["probe"], backend=backend)
    sum((getattr(rendering, name) * weight.to(dtype)).sum() for name, weight in weights.items()).backward()
    leaf_of = {**vars(inputs), **extra}
    gradients = {name: leaf.grad for name, leaf in leaf_of.items()}
    gradients["pose"] = gradients["pose"][:3]
    return rendering, gradients


def random_weights(width: int, height: int, where: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    shapes = {"image": (height, width, 3), "transmittance": (height, width), "depth": (height, width)}
    mask = {"image": where[..., None], "transmittance": where, "depth": where}
    return {
        name: torch.randn(shape, generator=generator, dtype=torch.float64) * mask[name]
        for name, shape in shapes.items()
    }


def assert_same(
    gaussians: Gaussians, width: int, height: int, options, generator, *, pose, backend, dtype, limit=2e-3
) -> None:
    stable = stable_pixels(gaussians, width, height, pose=pose, options=options)
    assert stable.double().mean() > 0.85
    weights = random_weights(width, height, stable, generator)
    arguments = (gaussians, width, height, options, weights)
    expected, expected_gradients = run(*arguments, pose=pose, backend="torch", dtype=torch.float64)
    actual, gradients = run(*arguments, pose=pose, backend=backend, dtype=dtype)
    assert torch.equal(actual.visible, expected.visible)
    for name, (absolute, relative) in {"image": (2e-5, 0), "transmittance": (2e-5, 0), "depth": (0, 1e-4)}.items():
        output, truth = (getattr(rendering, name)[stable].double() for rendering in (actual, expected))
        torch.testing.assert_close(output, truth, atol=absolute, rtol=relative, msg=lambda text, n=name: f"{n}: {text}")
    pairs = [rendering.counters["contributing"] for rendering in (actual, expected)]
    assert abs(pairs[0] - pairs[1]) <= 8 * int((~stable).sum())
    for name, gradient in expected_gradients.items():
        assert gradient.any(), f"{name} has no gradient to compare"
        assert row_error(gradients[name], gradient) < limit, name


@pytest.mark.parametrize("configuration", CONFIGURATIONS)
@pytest.mark.parametrize("kind", KINDS)
@each_engine
def test_n9_every_engine_agrees_with_the_definition(kind: str, configuration: str, backend: str, dtype: torch.dtype):
    generator = torch.Generator().manual_seed(KINDS.index(kind))
    options = CONFIGURATIONS[configuration]
    for width, height in ODD_SIZES:
        gaussians = gaussians_of(kind, 25, generator)
        gaussians.opacities[0] = 1.0  # reaches the maximum alpha, where the derivative is 0
        pose = random_pose(generator, shift=0.0)
        if kind in ("ordinary", "huge"):
            pose[:3, 3] = torch.tensor([0.25, -0.125, 0.5])
        else:  # these places are named in the camera frame
            pose[:3, :3] = torch.eye(3)
        if configuration == "published" and kind in ("huge", "near", "pole"):
            gaussians = Gaussians(**{**vars(gaussians), "scales": 0.2 * gaussians.scales})
        assert_same(gaussians, width, height, options, generator, pose=pose, backend=backend, dtype=dtype)


@needs_native
def test_n9_a_large_odd_image_agrees():
    generator = torch.Generator().manual_seed(9)
    gaussians = mixture(4, generator, ("ordinary", "polar", "seam"))
    pose = torch.eye(4, dtype=torch.float64)
    engine = {"backend": "cpu", "dtype": torch.float32}
    assert_same(gaussians, 1000, 500, RenderOptions(), generator, pose=pose, limit=4e-3, **engine)


@pytest.fixture
def restored_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@needs_native
@pytest.mark.parametrize(("width", "height"), [(250, 125), (1000, 500)])
def test_n9_results_are_bit_equal_for_any_number_of_threads(width: int, height: int, restored_threads):
    generator = torch.Generator().manual_seed(99)
    gaussians = mixture(1500, generator, ("ordinary", "polar", "seam"))  # several blocks of the pose gradient's sum
    pose = random_pose(generator, shift=0.1)
    weights = random_weights(width, height, torch.ones(height, width, dtype=torch.bool), generator)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        arguments = (gaussians, width, height, RenderOptions(), weights)
        results.append(run(*arguments, pose=pose, backend="cpu", dtype=torch.float32))
    (reference, reference_gradients), *others = results
    for rendering, gradients in others:
        assert rendering.counters == reference.counters
        for name in OUTPUTS:
            assert torch.equal(getattr(rendering, name), getattr(reference, name)), name
        for name in (*INPUTS, "pose", "background", "probe"):
            assert torch.equal(gradients[name], reference_gradients[name]), name
