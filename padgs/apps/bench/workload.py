"""The timed workload: a seeded PaD-GS model with a stated number and size of Gaussians, and panoramas of noise.

The defaults are near what training gives. A model trained on real panoramas (3 000 iterations, 512x256, 62 k
Gaussians) had 60 contributing pairs per pixel, 3.0 evaluated pairs per contributing one, 2.7 tiles per Gaussian and a
median opacity of 0.15; these Gaussians, 100 k at 512x256, have 40, 3.8, 2.0 and 0.15.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from padgs.methods.anchors.anchors import PaDGS
from padgs.methods.anchors.growth import GrowthOptions
from padgs.methods.anchors.method import AnchorModel, LearningRates
from padgs.render import RenderOptions
from padgs.scene import Scene, View
from padgs.training.loop import Stage, Trainer
from padgs.training.options import Budget

NEAREST, FURTHEST = 1.0, 4.0  # uniform distances of anchors, world units
SIGMA = 0.7  # median size of a Gaussian's axis, in pixels at the equator
SHRINKAGE = 0.44  # median factor of the covariance network on an axis
LOG_SIGMA_DEVIATION = 0.8  # of each axis between anchors; the covariance network adds to it
OFFSET = 4.0  # distance between an anchor and its Gaussians, pixels at the equator
RAW_DEVIATIONS = {"opacity": 0.35, "color": 1.0, "covariance": 1.0}  # of the networks' outputs before tanh or sigmoid
OPTIONS = RenderOptions(near=0.01)
NEVER = 1 << 40  # iterations
LEAST = (1e-30, 1e-30)  # a learning rate that changes no float32, for schedules that cannot be 0
STILL = LearningRates(
    offset_rate=LEAST,
    feature_rate=0.0,
    log_scale_rate=0.0,
    **dict.fromkeys(("opacity_rate", "color_rate", "covariance_rate"), LEAST),
)


@dataclass(frozen=True)
class Size:
    """Size of a workload."""

    width: int
    height: int
    gaussians: int  # approximate number that is decoded
    views: int = 1


SIZES = {
    "quick": Size(128, 64, 2_000),
    "small": Size(256, 128, 20_000),
    "medium": Size(512, 256, 100_000),
    "large": Size(2048, 1024, 1_000_000, views=11),
}


@dataclass(frozen=True)
class Workload:
    """A model, and panoramas of noise as ground truth."""

    size: Size
    model: PaDGS
    scene: Scene

    @property
    def view(self) -> View:
        """The first view."""
        return self.scene.train[0]

    def trainer(self, *, grows: bool = False, stage: Stage = nullcontext) -> Trainer:
        """Return a trainer with learning rates near 0, so that iterations do the same work; `grows`: each densifies."""
        grow_from = 0 if grows else NEVER
        growth = GrowthOptions(statistics_from=0, grow_from=grow_from, grow_until=NEVER, grow_every=1 if grows else 100)
        trainee = AnchorModel(self.model, OPTIONS, growth=growth, rates=STILL, extent=1.0, iterations=NEVER)
        return Trainer(trainee, self.scene, Budget(NEVER), stage=stage)

    def to(self, device: torch.device) -> Workload:
        """Move the model to a device, and return a workload whose poses and panoramas are there, too."""
        self.model.to(device)
        return replace(self, scene=resident(self.scene, device))


def build(size: Size, seed: int = 0) -> Workload:
    """Return anchors in directions uniform on the sphere; half of their Gaussians are selected."""
    generator = torch.Generator().manual_seed(seed)
    per_anchor = 10 * 0.5
    count = max(1, round(size.gaussians / per_anchor))
    pixel = 2 * math.pi / size.width
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    distance = NEAREST + (FURTHEST - NEAREST) * torch.rand(count, 1, generator=generator)
    reach = (distance * OFFSET * pixel).log().expand(-1, 3)
    deviations = LOG_SIGMA_DEVIATION * torch.randn(count, 3, generator=generator)
    axes = (distance * SIGMA / SHRINKAGE * pixel).log() + deviations
    model = PaDGS(direction * distance, torch.cat((reach, axes), dim=-1), voxel_size=0.01, generator=generator)
    views = tuple(_view(f"noise-{number}", size, generator) for number in range(size.views))
    with torch.no_grad():
        model.features.normal_(generator=generator)
        model.offsets.normal_(generator=generator)
        _spread_outputs(model, views[0])
    scene = Scene("bench", views, (), model.positions, torch.zeros(count, 3, dtype=torch.uint8), fingerprint="")
    return Workload(size, model, scene)


def resident(scene: Scene, device: torch.device) -> Scene:
    """Return a scene with poses and panoramas (as bytes) on a device, as a run trains on it."""

    def held(view: View) -> View:
        assert view.load_pixels is not None, view.name
        pixels = view.load_pixels().to(device)
        return replace(view, load_pixels=lambda: pixels)

    moved = scene.to(device)
    return replace(moved, train=tuple(map(held, moved.train)))


def _view(name: str, size: Size, generator: torch.Generator) -> View:
    pixels = torch.randint(0, 256, (size.height, size.width, 3), generator=generator, dtype=torch.uint8)
    return View(name, torch.eye(4, dtype=torch.float64), size.width, size.height, load_pixels=lambda: pixels)


def _spread_outputs(model: PaDGS, view: View) -> None:
    """Set every output of the networks to a median of 0 over the anchors and a deviation of `RAW_DEVIATIONS`."""
    direction, distance, omega = model.seen_from(view)
    inputs = torch.cat((model.features, direction, distance[:, None], omega[:, None]), dim=-1)
    for name, head in model.decoder.weights()._asdict().items():
        outputs: Tensor = head(inputs)
        head.w2.mul_((RAW_DEVIATIONS[name] / outputs.std(0))[:, None])
        head.b2.zero_()
        head.b2.sub_(head(inputs).median(0).values)
