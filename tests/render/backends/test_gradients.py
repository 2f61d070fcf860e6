"""Derivatives against central differences: random latitudes, 89.9 degrees, across the seam; all inputs."""

import math

import pytest
import torch
from support import render_cases as cases
from torch import Tensor

from padgs.gaussians import Gaussians, rotation_matrices
from padgs.geometry.camera import RayTable
from padgs.geometry.panorama import direction
from padgs.render import RenderOptions, render

WIDTH, HEIGHT = 48, 24
PLACES = ("random", "pole", "seam")
PLACES_OF_SETUPS = [
    (*setup, place) for setup in cases.SETUPS for place in (PLACES if "panorama" in setup else PLACES[:1])
]
# By precision: scenes for each place; step (in units of what moves a footprint by its own size); largest median and
# 99th percentile of the relative error; largest |ratio of magnitudes - 1|, which a dropped term cannot pass. float32
# rounds an image to 1e-7, so that its differences need longer steps and are worth fewer digits.
LIMITS = {
    torch.float64: (2, 1e-5, 1e-6, 1e-4, 1e-6),
    torch.float32: (7, 1e-2, 5e-3, 6e-2, 5e-3),
}


def scene_at(place: str, projection: str, lens: str, generator: torch.Generator) -> Gaussians:
    """Six Gaussians, some pixels broad, near enough to overlap; none reaches the maximum alpha or stops a ray."""
    count = 6
    gaussians = cases.gaussians_of("ordinary", count, generator)
    radius = gaussians.means.norm(dim=-1)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)

    steepest = 1.4 if lens == "panorama" else 0.2  # a perspective image ends there
    latitude = float(uniform(-steepest, steepest)[0]) + uniform(-0.15, 0.15)
    longitude = uniform(-0.15, 0.15) / torch.cos(latitude)
    scales = gaussians.scales
    if place == "seam":
        longitude = math.pi + longitude
    if place == "pole":
        latitude = math.radians(89.9) * torch.sign(uniform(-1, 1))
        longitude = uniform(-3, 3)
        if projection == "erp":
            scales = 0.02 * scales  # at 89.9 degrees a pixel is 570 times narrower than at the horizon
    means = radius[:, None] * direction(longitude, latitude)
    opacities = gaussians.opacities.clamp(0.1, 0.7)
    moved = Gaussians(means, gaussians.quats, scales, opacities, gaussians.colors)
    return moved.to(torch.float32).to(torch.float64)


def tangent_pose(base: Tensor, twist: Tensor) -> Tensor:
    """Return the pose [4, 4] rotated and shifted by a twist [6]; rigid for every twist."""
    half = torch.cat((torch.ones_like(twist[:1]), 0.5 * twist[:3]))
    top = torch.cat((rotation_matrices(half) @ base[:3, :3], base[:3, 3:] + twist[3:, None]), dim=1)
    return torch.cat((top, base[3:]))


def steps_of(gaussians: Gaussians, projection: str) -> dict[str, Tensor]:
    """Return the change of each input that moves a footprint by about its size: the unit of steps."""
    radius = gaussians.means.norm(dim=-1, keepdim=True)
    cos_latitude = gaussians.means[:, [0, 2]].norm(dim=-1, keepdim=True) / radius
    reach = gaussians.scales.amax(-1, keepdim=True)
    if projection == "erp":  # the chart bends over the distance to the pole
        reach = torch.minimum(reach, 0.3 * cos_latitude * radius)
    smallest = float((reach / radius).min())
    return {
        "means": reach.expand(-1, 3),
        "quats": 0.3 * gaussians.quats.norm(dim=-1, keepdim=True).expand(-1, 4),
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "colors": torch.ones_like(gaussians.colors),
        "mean_offsets": torch.full((len(gaussians), 2), 0.05, dtype=torch.float64),
        "twist": smallest * torch.cat((torch.ones(3), radius.min() * torch.ones(3))).double(),
        "background": torch.ones(3, dtype=torch.float64),
        "rays": torch.full((HEIGHT, WIDTH, 3), smallest, dtype=torch.float64),
    }


class Scene:
    """Six Gaussians, weights of all outputs, and the weighted loss."""

    def __init__(self, place: str, projection: str, lens: str, generator: torch.Generator, dtype: torch.dtype) -> None:
        self.camera, self.options = cases.camera_of(lens, WIDTH, HEIGHT), RenderOptions(projection)
        self.gaussians = scene_at(place, projection, lens, generator)
        stable = cases.stable_pixels(self.gaussians, WIDTH, HEIGHT, lens=lens, options=self.options, margin=0.2)
        assert stable.double().mean() > 0.4  # no pair crosses the cut within a step
        shape = (HEIGHT, WIDTH)
        self.weights = {
            "image": torch.randn(*shape, 3, generator=generator, dtype=torch.float64) * stable[..., None],
            "transmittance": torch.randn(shape, generator=generator, dtype=torch.float64) * stable,
            "depth": 0.2 * torch.randn(shape, generator=generator, dtype=torch.float64) * stable,
        }
        self.inputs = {
            **{name: tensor.detach() for name, tensor in vars(cases.leaves(self.gaussians, dtype)).items()},
            "mean_offsets": torch.zeros(len(self.gaussians), 2, dtype=dtype),
            "twist": torch.zeros(6, dtype=dtype),
            "background": torch.tensor([0.2, 0.7, 0.4], dtype=dtype),
        }
        if isinstance(self.camera, RayTable):
            self.inputs["rays"] = self.camera.table.to(dtype)

    def loss(self, values: dict[str, Tensor], backend: str) -> Tensor:
        model = Gaussians(**{name: values[name] for name in vars(self.gaussians)})
        camera = RayTable(values["rays"], self.camera.focal) if "rays" in values else self.camera
        view = cases.view_of(camera, tangent_pose(cases.identity_pose().to(values["twist"].dtype), values["twist"]))
        extra = {"mean_offsets": values["mean_offsets"], "background": values["background"], "backend": backend}
        rendering = render(model, view, self.options, **extra)
        return sum((getattr(rendering, name).double() * weight).sum() for name, weight in self.weights.items())


def slopes(scene: Scene, step: float, backend: str, generator: torch.Generator) -> dict[str, list]:
    """Return (difference, prediction) of the loss along random directions, one for each row of each input."""
    variables = {name: value.clone().requires_grad_() for name, value in scene.inputs.items()}
    gradients = torch.autograd.grad(scene.loss(variables, backend), list(variables.values()))
    units, found = steps_of(scene.gaussians, scene.options.projection), {}
    for name, gradient in zip(variables, gradients, strict=True):
        by_row = name not in ("twist", "background", "rays")
        for row in range(len(gradient)) if by_row else [slice(None)]:
            size = units[name][row]
            along = torch.randn(size.shape, generator=generator, dtype=torch.float64) * size
            ends = []
            for sign in (1, -1):
                moved = scene.inputs[name].clone()
                moved[row] = (moved[row].double() + sign * step * along).to(moved.dtype)
                ends.append((scene.loss({**scene.inputs, name: moved}, backend), moved[row].double()))
            (above, at_above), (below, at_below) = ends
            predicted = (gradient[row].double() * (at_above - at_below)).sum()
            found.setdefault(name, []).append(((above - below) / step, predicted / step))
    return found


@pytest.mark.parametrize(("projection", "lens", "place"), PLACES_OF_SETUPS)
@pytest.mark.parametrize(("backend", "dtype"), [engine for engine in cases.engines() if engine.id != "torch-32"])
def test_gradients_match_central_differences(projection: str, lens: str, place: str, backend, dtype):
    scenes, step, median_limit, tail_limit, ratio_limit = LIMITS[dtype]
    generator = torch.Generator().manual_seed(8 + PLACES.index(place))
    pairs: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for _ in range(scenes):
        scene = Scene(place, projection, lens, generator, dtype)
        for name, found in slopes(scene, step, backend, generator).items():
            pairs.setdefault(name, []).extend(found)
    assert ("rays" in pairs) == (lens == "fisheye")
    for name, found in pairs.items():
        measured, predicted = (torch.stack(column) for column in zip(*found, strict=True))
        scale = measured.abs().median()
        assert scale > 0, f"{name} moves nothing"
        error = (measured - predicted).abs() / (measured.abs() + 0.1 * scale)
        ratio = (measured * predicted).sum() / (measured * measured).sum()
        report = f"{name}: median {error.median():.1e}, p99 {error.quantile(0.99):.1e}, ratio - 1 {ratio - 1:.1e}"
        assert error.median() < median_limit and error.quantile(0.99) < tail_limit, report
        assert abs(ratio - 1) < ratio_limit, report


@cases.each_setup
@cases.each_engine
def test_every_output_alone_has_gradients(projection: str, lens: str, backend: str, dtype: torch.dtype):
    """No other output has one then; every Gaussian is in the image, so that no row is empty."""
    generator = torch.Generator().manual_seed(11)
    gaussians, pose = cases.gaussians_of("ordinary", 20, generator), cases.random_pose(generator, shift=0.1)
    if lens != "panorama":  # in front of it
        pose[:3, :3] = torch.eye(3)
        ahead = gaussians.means.abs() * torch.tensor([0.3, 0.3, 1.0]) + 0.3
        gaussians = Gaussians(**{**vars(gaussians), "means": ahead})
    inputs, camera = vars(cases.leaves(gaussians, dtype)), cases.camera_of(lens, 64, 32)
    extra = {"background": torch.full((3,), 0.5), "mean_offsets": torch.zeros(20, 2)}
    extra = {name: value.to(dtype).requires_grad_() for name, value in extra.items()}
    everything = {**inputs, **extra, "pose": pose.to(dtype).requires_grad_()}
    if isinstance(camera, RayTable):
        everything["rays"] = camera.table.to(dtype).requires_grad_()
        camera = RayTable(everything["rays"], camera.focal)
    for output in ("image", "transmittance", "depth"):
        view, options = cases.view_of(camera, everything["pose"]), RenderOptions(projection)
        value = getattr(render(Gaussians(**inputs), view, options, backend=backend, **extra), output)
        weight = torch.randn(value.shape, generator=generator, dtype=torch.float64).to(dtype)
        gradients = torch.autograd.grad((value * weight).sum(), list(everything.values()), allow_unused=True)
        for name, gradient in zip(everything, gradients, strict=True):
            if output != "image" and name in ("colors", "background"):
                assert gradient is None or not gradient.any(), f"{output} cannot depend on {name}"
                continue
            assert gradient is not None and torch.isfinite(gradient).all(), f"{output} by {name}"
            rows = gradient[:3] if name == "pose" else gradient
            norms = rows.reshape(len(rows), -1).norm(dim=-1)
            share = 0.3 if name == "rays" else 1.0  # nothing is drawn in the upper and lower rows
            assert (norms != 0).double().mean() >= share, f"{output} by {name} has empty rows"


@pytest.mark.parametrize("projection", sorted({projection for projection, lens in cases.SETUPS if lens == "panorama"}))
@cases.each_native_engine
def test_gradients_of_subsets_of_inputs(projection: str, backend: str):
    """Gradients of a subset of inputs equal those computed together with all others."""
    generator = torch.Generator().manual_seed(14)
    gaussians = cases.gaussians_of("ordinary", 12, generator)
    weight = torch.randn(HEIGHT, WIDTH, 3, generator=generator)

    def gradients(names: tuple[str, ...]) -> dict[str, Tensor]:
        values = {name: getattr(gaussians, name).float().requires_grad_(name in names) for name in cases.INPUTS}
        pose = cases.identity_pose().float().requires_grad_("pose" in names)
        view = cases.view_of(cases.camera_of("panorama", WIDTH, HEIGHT), pose)
        image = render(Gaussians(**values), view, RenderOptions(projection), backend=backend).image
        wanted = {**values, "pose": pose}
        return dict(zip(names, torch.autograd.grad((image * weight).sum(), [wanted[n] for n in names]), strict=True))

    everything = gradients((*vars(gaussians), "pose"))
    for names in (("means",), ("colors",), ("pose",), ("opacities", "scales")):
        for name, gradient in gradients(names).items():
            assert torch.equal(gradient, everything[name]), name
