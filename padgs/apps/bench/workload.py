"""What is timed: a PaD-GS model that decodes to a stated number of Gaussians of a stated size, seeded.

The defaults are near what training gives. A model trained on real panoramas (3 000 iterations, 512x256, 62 k
Gaussians) had 60 contributing pairs per pixel, 3.0 evaluated for each of them, 2.7 tiles per Gaussian and a median
opacity of 0.15; these Gaussians, 100 k at 512x256, have 40, 3.8, 2.0 and 0.15.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor

from padgs.methods.anchors.growth import GrowthOptions
from padgs.methods.anchors.model import PaDGS
from padgs.methods.anchors.trainee import AnchorTrainee, LearningRates
from padgs.methods.splats.clone_split import CloneSplitOptions
from padgs.methods.splats.model import Splats
from padgs.methods.splats.trainee import SplatTrainee
from padgs.render import RenderConfig, RenderOptions
from padgs.scene import Scene, View
from padgs.training.budget import Budget
from padgs.training.loop import Stage, Trainer
from padgs.training.schedule import Constant, ParameterGroup

NEAREST, FURTHEST = 1.0, 4.0  # distances of anchors, world units, uniform
SIGMA = 0.7  # median size of a Gaussian's axis, in pixels of the equator
SHRINKAGE = 0.44  # what the covariance network leaves of an axis, as far as the median of all is concerned
LOG_SIGMA_DEVIATION = 0.8  # of each axis, between anchors; the covariance network adds its own
OFFSET = 4.0  # distance between an anchor and its Gaussians, pixels of the equator
RAW_DEVIATIONS = {"opacity": 0.35, "color": 1.0, "covariance": 1.0}  # of the networks' outputs before tanh or sigmoid
OPTIONS = RenderOptions(near=0.01)
NEVER = 1 << 40  # iterations
LEAST = (1e-30, 1e-30)  # a learning rate that changes no float32, for schedules that have no 0
STILL = LearningRates(
    offset_rate=LEAST,
    offset_rate_unit="scene",
    feature_rate=0.0,
    log_scale_rate=0.0,
    **dict.fromkeys(("opacity_rate", "color_rate", "covariance_rate"), LEAST),
)


@dataclass(frozen=True)
class Size:
    """How much work."""

    width: int
    height: int
    gaussians: int  # about so many are decoded
    views: int = 1


SIZES = {
    "quick": Size(128, 64, 2_000),
    "small": Size(256, 128, 20_000),
    "medium": Size(512, 256, 100_000),
    "large": Size(2048, 1024, 1_000_000, views=11),
}


def refuse_unknown(sizes: Sequence[str]) -> None:
    """Raise ValueError for names that are none of `SIZES`, or none at all."""
    unknown = [name for name in sizes if name not in SIZES]
    if unknown or not sizes:
        raise ValueError(f"unknown size {', '.join(unknown) or '(none)'}; known: {', '.join(SIZES)}")


@dataclass(frozen=True)
class Workload:
    """A model and the panoramas, of noise, that it is compared with."""

    size: Size
    model: PaDGS
    scene: Scene

    @property
    def view(self) -> View:
        """The first view."""
        return self.scene.train[0]

    def trainer(self, options: RenderOptions = OPTIONS, *, grows: bool = False, stage: Stage = nullcontext) -> Trainer:
        """The real one. Nothing learns, so that all iterations have the same work; the optimiser does all of its own.

        Args:
            options: how the model is drawn.
            grows: act on the statistics of every iteration; else they are collected and never acted on.
            stage: see `Trainer`.
        """
        grow_from = 0 if grows else NEVER
        growth = GrowthOptions(statistics_from=0, grow_from=grow_from, grow_until=NEVER, grow_every=1 if grows else 100)
        trainee = AnchorTrainee(self.model, options, growth=growth, rates=STILL, extent=1.0, iterations=NEVER)
        return Trainer(trainee, self.scene, Budget(NEVER), stage=stage)

    def explicit_trainer(self, options: RenderOptions = OPTIONS) -> Trainer:
        """That of the Gaussians of the first view, each for itself with harmonics of all degrees; nothing learns."""
        with torch.no_grad():
            seen = self.model.decode(self.view).gaussians
        splats = Splats(seen.means, seen.scales.log(), seen.colors)
        splats.opacity_logits.data, splats.quats.data = seen.opacities.logit(), seen.quats
        splats.active_degree = splats.degree
        config = RenderConfig(**asdict(options))
        return Trainer(
            StillSplats(splats, CloneSplitOptions(), config, extent=1.0, iterations=NEVER), self.scene, Budget(NEVER)
        )


class StillSplats(SplatTrainee):
    """Splats that stay as they are, though the optimiser does all of its work."""

    def groups(self, means_speed: float = 1.0) -> list[ParameterGroup]:
        """All parameters."""
        return [replace(group, learning_rate=Constant(0.0)) for group in super().groups(means_speed)]


def build(size: Size, seed: int = 0) -> Workload:
    """Anchors all around the camera, in directions uniform on the sphere; half of their Gaussians are selected."""
    generator = torch.Generator().manual_seed(seed)
    per_anchor = 10 * 0.5
    count = max(1, round(size.gaussians / per_anchor))
    pixel = 2 * math.pi / size.width
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    distance = NEAREST + (FURTHEST - NEAREST) * torch.rand(count, 1, generator=generator)
    reach = (distance * OFFSET * pixel).log().expand(-1, 3)
    axes = (distance * SIGMA / SHRINKAGE * pixel).log() + LOG_SIGMA_DEVIATION * torch.randn(
        count, 3, generator=generator
    )
    model = PaDGS(direction * distance, torch.cat((reach, axes), dim=-1), voxel_size=0.01, generator=generator)
    views = tuple(_view(f"noise-{number}", size, generator) for number in range(size.views))
    with torch.no_grad():
        model.features.normal_(generator=generator)
        model.offsets.normal_(generator=generator)
        _spread_outputs(model, views[0])
    scene = Scene("bench", views, (), model.positions, torch.zeros(count, 3, dtype=torch.uint8), fingerprint="")
    return Workload(size, model, scene)


def sigma_quantiles(workload: Workload) -> dict[str, float]:
    """Sizes of the decoded Gaussians (geometric mean of the axes) in pixels of the equator."""
    with torch.no_grad():
        gaussians = workload.model.decode(workload.view).gaussians
        angle = gaussians.scales.log().mean(-1).exp() / gaussians.means.norm(dim=-1)
    pixels = (angle * workload.size.width / (2 * math.pi)).sort().values
    return {f"p{percent}": float(pixels[percent * (len(pixels) - 1) // 100]) for percent in (5, 50, 95)}


def _view(name: str, size: Size, generator: torch.Generator) -> View:
    pixels = torch.randint(0, 256, (size.height, size.width, 3), generator=generator, dtype=torch.uint8)
    pose = torch.eye(4, dtype=torch.float64)
    return View(name, pose, size.width, size.height, load_pixels=lambda: pixels)


def _spread_outputs(model: PaDGS, view: View) -> None:
    """Give every output of the networks a median of 0 over the anchors, and the deviation of `RAW_DEVIATIONS`."""
    direction, distance, omega = model.seen_from(view)
    inputs = torch.cat((model.features, direction, distance[:, None], omega[:, None]), dim=-1)
    for name, head in model.decoder.weights()._asdict().items():
        outputs: Tensor = head(inputs)
        head.w2.mul_((RAW_DEVIATIONS[name] / outputs.std(0))[:, None])
        head.b2.zero_()
        head.b2.sub_(head(inputs).median(0).values)
