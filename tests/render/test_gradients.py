"""Derivatives against central differences (T0, N8): random latitudes, 89.9 degrees, across the seam; all inputs."""

from __future__ import annotations

import math

import pytest
import torch
from render_cases import each_engine, gaussians_of, identity_pose, leaves, stable_pixels
from torch import Tensor

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.panorama import direction
from padgs.render import render
from padgs.scene import View

WIDTH, HEIGHT = 64, 32
PLACES = ("random", "pole", "seam")
SCENES = 7  # for each place
# By precision: step (in units of what moves a footprint by its own size); largest median and 99th percentile of the
# relative error; largest |ratio of magnitudes - 1|, which a dropped term cannot pass. float32 rounds an image to 1e-7,
# so that its differences need longer steps and are worth fewer digits.
LIMITS = {
    torch.float64: (1e-5, 1e-6, 1e-4, 1e-6),
    torch.float32: (1e-2, 5e-3, 6e-2, 5e-3),
}


def scene_at(place: str, generator: torch.Generator) -> Gaussians:
    """Six Gaussians, some pixels broad, near enough to overlap; none reaches the maximum alpha or stops a ray."""
    count = 6
    gaussians = gaussians_of("ordinary", count, generator)
    radius = gaussians.means.norm(dim=-1)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)

    latitude = float(uniform(-1.4, 1.4)[0]) + uniform(-0.15, 0.15)
    longitude = uniform(-0.15, 0.15) / torch.cos(latitude)
    scales = gaussians.scales
    if place == "seam":
        longitude = math.pi + longitude
    if place == "pole":
        latitude = math.radians(89.9) * torch.sign(uniform(-1, 1))
        longitude = uniform(-3, 3)
        scales = 0.02 * scales  # at 89.9 degrees a pixel is 570 times narrower than at the horizon
    means = radius[:, None] * direction(longitude, latitude)
    opacities = gaussians.opacities.clamp(0.1, 0.7)
    moved = Gaussians(means, gaussians.quats, scales, opacities, gaussians.colors)
    return moved.to(torch.float32).to(torch.float64)


def tangent_pose(base: Tensor, twist: Tensor) -> Tensor:
    """The pose [4, 4] turned and shifted by a twist [6]; a rigid motion for every twist."""
    half = torch.cat((torch.ones_like(twist[:1]), 0.5 * twist[:3]))
    top = torch.cat((rotation_matrices(half) @ base[:3, :3], base[:3, 3:] + twist[3:, None]), dim=1)
    return torch.cat((top, base[3:]))


def steps_of(gaussians: Gaussians) -> dict[str, Tensor]:
    """What moves each input by about one footprint: the unit in which steps are taken, one per entry."""
    radius = gaussians.means.norm(dim=-1, keepdim=True)
    cos_latitude = gaussians.means[:, [0, 2]].norm(dim=-1, keepdim=True) / radius
    reach = torch.minimum(gaussians.scales.amax(-1, keepdim=True), 0.3 * cos_latitude * radius)
    smallest = float((reach / radius).min())
    return {
        "means": reach.expand(-1, 3),
        "quats": 0.3 * gaussians.quats.norm(dim=-1, keepdim=True).expand(-1, 4),
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "colors": torch.ones_like(gaussians.colors),
        "probe": torch.full((len(gaussians), 2), 0.05, dtype=torch.float64),
        "twist": smallest * torch.cat((torch.ones(3), radius.min() * torch.ones(3))).double(),
        "background": torch.ones(3, dtype=torch.float64),
    }


@pytest.mark.parametrize("place", PLACES)
@each_engine
def test_n8_gradients_match_central_differences(place: str, backend: str, dtype: torch.dtype):
    step, median_limit, tail_limit, ratio_limit = LIMITS[dtype]
    generator = torch.Generator().manual_seed(8 + PLACES.index(place))
    pairs: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for _ in range(SCENES):
        gaussians = scene_at(place, generator)
        stable = stable_pixels(gaussians, WIDTH, HEIGHT, margin=0.2)  # no pair crosses the cut within a step
        assert stable.double().mean() > 0.5
        shape = (HEIGHT, WIDTH)
        weights = {
            "image": torch.randn(*shape, 3, generator=generator, dtype=torch.float64) * stable[..., None],
            "transmittance": torch.randn(shape, generator=generator, dtype=torch.float64) * stable,
            "depth": 0.2 * torch.randn(shape, generator=generator, dtype=torch.float64) * stable,
        }
        inputs = {
            **{name: tensor.detach() for name, tensor in vars(leaves(gaussians, dtype)).items()},
            "probe": torch.zeros(len(gaussians), 2, dtype=dtype),
            "twist": torch.zeros(6, dtype=dtype),
            "background": torch.tensor([0.2, 0.7, 0.4], dtype=dtype),
        }

        def loss(values: dict[str, Tensor], weights=weights) -> Tensor:
            extra = {name: values[name] for name in ("probe", "background")}
            model = Gaussians(**{n: v for n, v in values.items() if n not in ("probe", "twist", "background")})
            view = View("v", tangent_pose(identity_pose().to(values["twist"].dtype), values["twist"]), WIDTH, HEIGHT)
            rendering = render(model, view, backend=backend, **extra)
            return sum((getattr(rendering, name).double() * weight).sum() for name, weight in weights.items())

        variables = {name: value.clone().requires_grad_() for name, value in inputs.items()}
        gradients = torch.autograd.grad(loss(variables), list(variables.values()))
        units = steps_of(gaussians)
        for name, gradient in zip(variables, gradients, strict=True):
            for row in range(len(gradient)) if gradient.ndim > 1 or name == "opacities" else [slice(None)]:
                size = units[name][row]
                along = torch.randn(size.shape, generator=generator, dtype=torch.float64) * size
                values = []
                for sign in (1, -1):
                    moved = inputs[name].clone()
                    moved[row] = (moved[row].double() + sign * step * along).to(dtype)
                    values.append((loss({**inputs, name: moved}), moved[row].double()))
                (above, at_above), (below, at_below) = values
                difference = above - below
                predicted = (gradient[row].double() * (at_above - at_below)).sum()
                pairs.setdefault(name, []).append((difference / step, predicted / step))
    for name, found in pairs.items():
        measured, predicted = (torch.stack(column) for column in zip(*found, strict=True))
        scale = measured.abs().median()
        assert scale > 0, f"{name} moves nothing"
        error = (measured - predicted).abs() / (measured.abs() + 0.1 * scale)
        ratio = (measured * predicted).sum() / (measured * measured).sum()
        report = f"{name}: median {error.median():.1e}, p99 {error.quantile(0.99):.1e}, ratio - 1 {ratio - 1:.1e}"
        assert error.median() < median_limit and error.quantile(0.99) < tail_limit, report
        assert abs(ratio - 1) < ratio_limit, report
