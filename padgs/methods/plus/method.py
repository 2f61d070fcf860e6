"""padgs_plus: the method of this project, each part chosen by measurement (docs/plus.md).

Explicit Gaussians, rendered exactly along each ray, are densified in eight rounds and pruned by importance in a ninth.
No constant is in world units, numbers follow the pixels of the images, and latitude is no special case. Each part is an
option that can be switched off (`+experiment=plus_ablation`).

The number of Gaussians: `SplatMethod.build_model` sets the initial number and the limit,
`padgs.methods.splats.densification` adds Gaussians above a threshold, `padgs.methods.splats.importance` prunes them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from padgs.checks import check
from padgs.methods.plus.model import PlusModel
from padgs.methods.splats.densification import DensificationOptions
from padgs.methods.splats.lengths import NEAREST_CAMERA
from padgs.methods.splats.method import PRUNE_PSNR, SplatMethod, SplatOptions
from padgs.render import RenderConfig
from padgs.scene import Scene
from padgs.training.loop import Stage, Trainer
from padgs.training.model import Model
from padgs.training.options import Budget, TrainOptions

STEEPNESS = 0.25  # of the kernel: flatter in the middle and shorter than a Gaussian (`padgs.render.contract`)
PIXEL_VARIANCE = 0.1  # square pixels; a pixel is the mean over a square, whose variance is 1/12
ROUNDS = 8  # of densification
DENSIFIED_SHARE = 0.4  # of the run, after which no Gaussians are added
UNUSED = (  # options of 3DGS that have no effect here
    *("densify_from", "densify_until", "densify_every", "prune_by_extent", "prune_by_extent_from"),
    *("max_scale", "reset_every", "reset_opacity"),
)
LONG_RUN = 2000  # iterations; shorter runs have a higher threshold
REFERENCE_PIXELS = 2 * 256 * 128 / math.pi  # pixels of equal solid angle; larger views have a lower threshold
FEW_VIEWS = 8  # training views that leave surfaces open
AMPLE_PIXELS = 16  # training pixels per Gaussian that make dropout unnecessary


@dataclass(frozen=True)
class PlusOptions(SplatOptions):
    """The `method` group of the configuration. Shares of the run are in [0, 1], so no schedule has a length."""

    sh_degree: int = 2  # one more each tenth of the run; degree 3 gains nothing and costs a fifth of the time
    positional_gradient: str = "space_absolute"
    gradient_threshold: float = 5e-5  # that of SPaGS; adapted to iterations, pixels and views (docs/plus.md)
    threshold_pixel_exponent: float = 1.0  # threshold ~ pixel width ^ exponent, for views above 256x128; 0: constant
    threshold_full_views: int = 28  # fewer views lower the threshold less, by sqrt(views / this); 0: never less
    sample_clones: bool = True
    split: str = "long_axis"
    min_opacity: float = 0.05  # fainter Gaussians are pruned after each round
    initial_per_pixel: float | None = 0.6
    depth_init_per_pixel: float = 0.6
    sky_per_point: float = 0.5
    initial_opacity: float = 0.5
    initial_scale: float = 0.6
    limit_per_pixel: float | None = 2.6
    supersampling_from: float = 0.7
    length_unit: str = NEAREST_CAMERA
    means_rate_factor: float = 2.0
    means_least_pace: float = 5.0  # that of runs of 1200 iterations
    prune_psnr: float | None = PRUNE_PSNR
    coarse_share: float = 0.3  # share of the run on views of half the width or less, if they are large
    smoothness_weight: float = 0.12  # loss weight of the roughness of surfaces; less above 8 views, 0 from 16
    dropout: float = 0.1  # maximal share of Gaussians dropped from a render; 0 from 16 training pixels per Gaussian on

    def __post_init__(self) -> None:
        super().__post_init__()
        thresholds = ("threshold_pixel_exponent", "threshold_full_views")
        off = "at least 0, which switches it off"
        check(self, off, lambda value: 0 <= value < math.inf, "smoothness_weight", *thresholds)
        check(self, "a share of the run in [0, 1]", lambda share: 0 <= share <= 1, "coarse_share")
        check(self, "a share of the Gaussians in [0, 1)", lambda share: 0 <= share < 1, "dropout")
        for field in fields(DensificationOptions):
            if field.name in UNUSED and getattr(self, field.name) != field.default:
                raise ValueError(
                    f"{field.name} is {getattr(self, field.name)}, but padgs_plus has densification rounds of its own "
                    f"and no resets; leave it at {field.default}"
                )

    def smoothness(self, views: int) -> float:
        """Return the loss weight for a number of training views.

        Few views leave surfaces open. It is full with up to `FEW_VIEWS`, 0 from twice as many on, and logarithmic
        between: many views know better than the prior, above all at the poles and beside the sky (docs/plus.md).
        """
        return self.smoothness_weight * min(max(math.log2(2 * FEW_VIEWS / max(views, 1)), 0.0), 1.0)

    def dropout_share(self, pixels: float, gaussians: float) -> float:
        """Return the share dropped: 0 with `AMPLE_PIXELS` per Gaussian, `dropout` with half, logarithmic between."""
        if gaussians == 0:
            return 0.0
        return self.dropout * min(max(math.log2(AMPLE_PIXELS * gaussians / pixels), 0.0), 1.0)

    def for_views(self, pixels: float, count: int) -> PlusOptions:
        """Return options with the threshold for `count` views of so many `solid_angle_pixels`.

        The part of a Gaussian of a few pixels in the mean loss falls with their solid angle, and its slope rises with
        one over their width; so its gradient falls with their width, and so does the threshold above
        `REFERENCE_PIXELS`. With fewer views than `threshold_full_views` the mean gradient is less certain: the
        threshold rises by the square root of their ratio, up to that of `REFERENCE_PIXELS`.
        """
        pixel_width = min(1.0, math.sqrt(REFERENCE_PIXELS / pixels))
        few_views = max(1.0, math.sqrt(self.threshold_full_views / max(count, 1)))
        factor = min(1.0, pixel_width**self.threshold_pixel_exponent * few_views)
        return replace(self, gradient_threshold=self.gradient_threshold * factor)

    def for_run(self, iterations: int) -> DensificationOptions:
        """Return options with evenly spaced rounds up to `DENSIFIED_SHARE` of the run and no opacity resets."""
        every = max(1, round(DENSIFIED_SHARE * iterations / ROUNDS))
        names = (field.name for field in fields(DensificationOptions))
        plain = DensificationOptions(**{name: getattr(self, name) for name in names})
        # Higher in short runs, because new Gaussians take iterations to fit.
        threshold = self.gradient_threshold * max(1.0, math.sqrt(LONG_RUN / iterations))
        schedule = {"densify_from": 0, "densify_until": ROUNDS * every + 1, "densify_every": every}
        return replace(plain, gradient_threshold=threshold, reset_every=iterations + 1, **schedule)


class PlusMethod(SplatMethod):
    """padgs+: explicit Gaussians along rays, with its own start, densification and pruning."""

    Options = PlusOptions
    MODEL = PlusModel
    RENDER = RenderConfig(projection="ray", low_pass=PIXEL_VARIANCE, supersampling=2, steepness=STEEPNESS)
    TRAIN = TrainOptions(weight="solid_angle", square_weight=20.0, random_background=True, adam_beta2=0.99)

    @property
    def has_smoothing_filter(self) -> bool:
        return self.model.has_smoothing_filter

    def build_trainer(self, model: Model, scene: Scene, budget: Budget, stage: Stage) -> Trainer:
        # A rehearsal has one view, of usual size, and refinement begins with a fine model.
        share = 0.0 if len(scene.train) == 1 or self.train_options.refine else self.options.coarse_share
        return Trainer(model, scene, budget, self.train_options, self.seed, coarse_share=share, stage=stage)
