"""Gaussians that are hard to draw, poses, and the engines (backend, dtype) that every test of drawing runs on."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from padgs.camera import Panorama
from padgs.gaussians import Gaussians, rotation_matrices
from padgs.panorama import direction
from padgs.render import BACKENDS, Rendering, RenderOptions, native, render
from padgs.render.contract import ALPHA_MIN
from padgs.render.planar import PlanarFootprints
from padgs.render.projection import project
from padgs.scene import View

INPUTS = ("means", "quats", "scales", "opacities", "colors")
KINDS = ("ordinary", "polar", "pole", "seam", "near", "huge")
ODD_SIZES = ((72, 36), (70, 44), (33, 17))


def engines() -> list:
    """Every backend in every dtype that it takes, as pytest parameters `backend, dtype`."""
    found = []
    for backend in BACKENDS:
        for dtype in (torch.float64, torch.float32) if backend == "torch" else (torch.float32,):
            marks = [pytest.mark.cuda] if backend == "cuda" else []
            if backend == "cpu":
                marks.append(pytest.mark.skipif(not native.available(), reason="the native library is not built"))
            found.append(pytest.param(backend, dtype, id=f"{backend}-{str(dtype)[-2:]}", marks=marks))
    return found


each_engine = pytest.mark.parametrize(("backend", "dtype"), engines())
needs_native = pytest.mark.skipif(not native.available(), reason="the native library is not built")


def gaussians_of(kind: str, count: int, generator: torch.Generator) -> Gaussians:
    """Random Gaussians around a camera at the origin, float64 but exactly representable in float32.

    ordinary: anywhere; polar: 0.2 to 15 degrees from a pole; pole: broad, covering it; seam: across longitude 180;
    near: centimetres away where the others are metres; huge: one to five times as broad as far away.
    """

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    longitude = uniform(-math.pi, math.pi, count)
    latitude = torch.asin(uniform(-0.95, 0.95, count))
    radius, size = uniform(1, 4, count), uniform(0.02, 0.15, count, 3)
    colatitude = None
    if kind == "polar":
        colatitude = torch.deg2rad(uniform(0.2, 15, count))
    elif kind == "pole":
        size = uniform(0.05, 0.4, count, 3)
        colatitude = size.mean(-1) * uniform(0.1, 1.5, count)
    elif kind == "seam":
        longitude = math.pi + uniform(-0.08, 0.08, count)
    elif kind == "near":
        radius, size = uniform(0.002, 0.05, count), uniform(0.1, 0.6, count, 3)
    elif kind == "huge":
        size = uniform(1, 5, count, 3)
    if colatitude is not None:
        latitude = (math.pi / 2 - colatitude) * torch.sign(uniform(-1, 1, count))
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64) + 1e-3
    gaussians = Gaussians(
        means=radius[:, None] * direction(longitude, latitude),
        quats=quats,
        scales=size * radius[:, None],
        opacities=uniform(0.05, 0.95, count),
        colors=uniform(0, 1, count, 3),
    )
    return gaussians.to(torch.float32).to(torch.float64)


def mixture(count_of_each: int, generator: torch.Generator, kinds: tuple[str, ...] = KINDS) -> Gaussians:
    """Some of every kind in one set."""
    parts = [gaussians_of(kind, count_of_each, generator) for kind in kinds]
    return Gaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name in INPUTS})


def identity_pose() -> Tensor:
    return torch.eye(4, dtype=torch.float64)


def random_pose(generator: torch.Generator, shift: float = 0.0) -> Tensor:
    """A rigid pose [4, 4] float64, representable in float32."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrices(torch.randn(4, generator=generator, dtype=torch.float64))
    pose[:3, 3] = shift * torch.randn(3, generator=generator, dtype=torch.float64)
    return pose.float().double()


def draw(
    gaussians: Gaussians,
    width: int,
    height: int,
    *,
    backend: str,
    dtype: torch.dtype,
    pose: Tensor | None = None,
    options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
    **more,
) -> Rendering:
    """Render in one engine; the pose may carry a gradient."""
    pose = identity_pose() if pose is None else pose
    more = {name: value.to(dtype) if isinstance(value, Tensor) else value for name, value in more.items()}
    return render(
        gaussians.to(dtype),
        View("test", pose, width, height),
        options=options,
        backend=backend,
        check_values=True,
        **more,
    )


def leaves(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    """A copy whose tensors collect gradients."""
    return Gaussians(
        **{name: getattr(gaussians, name).detach().to(dtype, copy=True).requires_grad_() for name in INPUTS}
    )


def stable_pixels(
    gaussians: Gaussians,
    width: int,
    height: int,
    *,
    pose: Tensor | None = None,
    options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
    margin: float = 1e-3,
) -> Tensor:
    """Pixels [H, W] bool where no yes/no decision is near: the image is smooth there and rounding flips nothing.

    A decision is near where an alpha is within `margin` (relative) of 1/255 or 0.99, or, for a footprint broader than
    half a turn, where the pixel is within `margin` pixels of the longitude opposite to the mean.
    """
    pose = identity_pose() if pose is None else pose
    footprints = project(gaussians, pose.to(gaussians.means.dtype), Panorama(width, height), options)
    everything = torch.arange(len(gaussians))[footprints.visible]
    pixels = torch.arange(height * width)
    rows, columns = pixels // width, pixels % width
    q, _ = footprints.squared_distance(everything, rows, columns)
    alpha = footprints.opacities[everything] * torch.exp(-0.5 * q)
    unstable = ((alpha / ALPHA_MIN - 1).abs() < margin) | ((alpha / 0.99 - 1).abs() < margin)
    if isinstance(footprints, PlanarFootprints) and options.wrap:
        across = ((columns[:, None] + 0.5 - footprints.centers[everything, 0] + width / 2) % width).abs()
        unstable |= (torch.minimum(across, width - across) < max(margin, 1e-3)) & (alpha >= ALPHA_MIN / 2)
    after = torch.cumprod(1 - alpha.clamp(max=0.99)[..., torch.argsort(footprints.depths[everything])], dim=-1)
    unstable |= (after / 1e-4 - 1).abs() < max(margin, 1e-2)
    return ~unstable.any(-1).view(height, width)


def row_error(actual: Tensor, expected: Tensor) -> float:
    """Largest error of a gradient, row by row: max |g - e| / (|e| + 1e-3 E), E the largest row (golden README)."""
    actual, expected = actual.double(), expected.double()
    if actual.ndim == 1:
        actual, expected = actual[:, None], expected[:, None]
    norms = expected.norm(dim=-1)
    largest = norms.max()
    if largest == 0:
        return actual.abs().max().item()
    return ((actual - expected).abs().amax(-1) / (norms + 1e-3 * largest)).max().item()
