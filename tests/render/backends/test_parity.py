"""All backends draw the same and differentiate the same as the definition in float64."""

from __future__ import annotations

import pytest
import torch
from render_cases import (
    KINDS,
    ODD_SIZES,
    SETUPS,
    camera_of,
    engines,
    gaussians_of,
    leaves,
    mixture,
    needs_native,
    random_pose,
    row_error,
    stable_pixels,
    view_of,
)
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.camera import RayTable
from padgs.render import Rendering, RenderOptions, render

OUTPUTS = ("image", "transmittance", "depth")
CONFIGURATIONS = {
    "ours": {},
    "sharp": {"near": 0.005, "low_pass": 0.05},
    "no wrap": {"wrap": False},
    "published": {"near": 0.005, "wrap": False, "bounds": "square"},
}
COMBINATIONS = [
    (projection, lens, name, kind)
    for projection, lens in SETUPS
    for name in CONFIGURATIONS
    for kind in KINDS
    if not (name == "no wrap" and projection != "erp")
    and not (name == "published" and (projection == "ray" or (projection == "tangent" and lens != "panorama")))
    and not (lens == "pinhole" and kind in ("polar", "pole", "seam"))  # it sees too few of them
]
ENGINES_IN_FLOAT32 = [engine for engine in engines() if torch.float32 in engine.values]


def run(gaussians, size, lens, options, weights, *, pose, backend, dtype) -> tuple[Rendering, dict[str, Tensor]]:
    """A rendering, and the gradients of the sum of its outputs times the weights by every input."""
    inputs, camera = leaves(gaussians, dtype), camera_of(lens, *size)
    extra = {
        "pose": pose.to(dtype, copy=True).requires_grad_(),
        "background": torch.tensor([0.3, 0.6, 0.9], dtype=dtype, requires_grad=True),
        "mean_offsets": torch.zeros(len(gaussians), 2, dtype=dtype, requires_grad=True),
    }
    if isinstance(camera, RayTable):
        extra["rays"] = camera.table.to(dtype, copy=True).requires_grad_()
        camera = RayTable(extra["rays"], camera.focal)
    arguments = {"background": extra["background"], "mean_offsets": extra["mean_offsets"], "backend": backend}
    rendering = render(inputs, view_of(camera, extra["pose"]), options, **arguments)
    sum((getattr(rendering, name) * weight.to(dtype)).sum() for name, weight in weights.items()).backward()
    gradients = {name: leaf.grad for name, leaf in {**vars(inputs), **extra}.items()}
    gradients["pose"] = twist_gradient(gradients["pose"], extra["pose"].detach())
    return rendering, gradients


def twist_gradient(gradient: Tensor, pose: Tensor) -> Tensor:
    """By a small turn and shift [2, 3] of the camera. Of the nine entries of a rotation only three can move."""
    turn = gradient[:3, :3] @ pose[:3, :3].T
    turn = turn - turn.T
    return torch.stack((torch.stack((turn[2, 1], turn[0, 2], turn[1, 0])), gradient[:3, 3]))


def random_weights(size: tuple[int, int], where: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    width, height = size
    shapes = {"image": (height, width, 3), "transmittance": (height, width), "depth": (height, width)}
    mask = {"image": where[..., None], "transmittance": where, "depth": where}
    return {
        name: torch.randn(shape, generator=generator, dtype=torch.float64) * mask[name]
        for name, shape in shapes.items()
    }


def assert_same(gaussians: Gaussians, size, lens, options, generator, *, pose, backend, dtype, slack=1) -> None:
    stable = stable_pixels(gaussians, *size, lens=lens, pose=pose, options=options)
    assert stable.double().mean() > 0.85
    weights = random_weights(size, stable, generator)
    arguments = (gaussians, size, lens, options, weights)
    expected, expected_gradients = run(*arguments, pose=pose, backend="torch", dtype=torch.float64)
    actual, gradients = run(*arguments, pose=pose, backend=backend, dtype=dtype)
    if options.projection in ("erp", "pinhole"):
        assert torch.equal(actual.visible, expected.visible)
    else:  # the definition knows no bounds: what it draws may lie outside the image
        assert not (actual.visible & ~expected.visible).any()
    for name, (absolute, relative) in {"image": (2e-5, 0), "transmittance": (2e-5, 0), "depth": (0, 1e-5)}.items():
        output, truth = (getattr(rendering, name)[stable].double() for rendering in (actual, expected))
        torch.testing.assert_close(
            output, truth, atol=slack * absolute, rtol=slack * relative, msg=lambda text, n=name: f"{n}: {text}"
        )
    pairs = [rendering.counters["contributing"] for rendering in (actual, expected)]
    assert abs(pairs[0] - pairs[1]) <= 8 * int((~stable).sum())
    for name, gradient in expected_gradients.items():
        assert gradient.any(), f"{name} has no gradient to compare"
        if name == "rays":  # a row is a pixel here, and faint ones have few digits
            assert (gradients[name] - gradient).abs().max() < slack * 2e-3 * gradient.norm(dim=-1).max()
        else:
            assert row_error(gradients[name], gradient) < slack * 2e-3, name


@pytest.mark.parametrize(
    ("projection", "lens", "configuration", "kind"), COMBINATIONS, ids=["-".join(c) for c in COMBINATIONS]
)
@pytest.mark.parametrize(("backend", "dtype"), ENGINES_IN_FLOAT32)
def test_every_engine_agrees_with_the_definition(projection, lens, configuration, kind, backend, dtype):
    generator = torch.Generator().manual_seed(KINDS.index(kind))
    options = RenderOptions(projection, **CONFIGURATIONS[configuration])
    size = ODD_SIZES[KINDS.index(kind) % len(ODD_SIZES)]
    gaussians = gaussians_of(kind, 25, generator)
    gaussians.opacities[0] = 1.0  # reaches the maximum alpha, where the derivative is 0
    pose = random_pose(generator)
    if kind in ("ordinary", "huge", "needle"):
        pose[:3, 3] = torch.tensor([0.25, -0.125, 0.5])
    elif lens == "panorama":  # these places are named in the camera frame
        pose[:3, :3] = torch.eye(3)
    if kind in ("huge", "near", "pole") and (configuration == "published" or projection == "ray"):
        gaussians = Gaussians(**{**vars(gaussians), "scales": 0.2 * gaussians.scales})
    if kind == "needle" and projection == "ray":  # which fades what is thinner than a pixel
        gaussians = Gaussians(**{**vars(gaussians), "scales": gaussians.scales.clamp(min=0.03)})
    slack = 8 if kind == "needle" else 1  # their covariances alone cost four digits of seven
    assert_same(gaussians, size, lens, options, generator, pose=pose, backend=backend, dtype=dtype, slack=slack)


@pytest.mark.parametrize("projection", ["erp", "tangent", "ray"])
@needs_native
def test_a_large_odd_image_agrees(projection: str):
    generator = torch.Generator().manual_seed(9)
    gaussians = mixture(3, generator, ("ordinary", "polar", "seam", "needle"))
    pose = torch.eye(4, dtype=torch.float64)
    engine = {"backend": "cpu", "dtype": torch.float32}
    options = RenderOptions(projection)
    assert_same(gaussians, (500, 250), "panorama", options, generator, pose=pose, **engine)
