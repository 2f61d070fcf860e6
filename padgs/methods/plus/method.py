"""padgs_plus: the method of this project, each part chosen by measurement (docs/plus.md).

Explicit Gaussians, rendered exactly along each ray, are densified in eight rounds by their gradient in space, pruned by
importance in a ninth, and kept small as seen from the cameras. No constant is in world units, numbers follow the pixels
of the images, and latitude is no special case. Each part is an option that can be switched off
(`+experiment=plus_ablation`).

The number of Gaussians: `PlusMethod.build_model` sets the initial number and the limit,
`padgs.methods.splats.densification` adds Gaussians above a threshold, `padgs.methods.splats.importance` prunes them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch

from padgs.checks import check
from padgs.methods.plus.depth_initialization import far_gaussians, fill_sparse_cloud, room_count
from padgs.methods.plus.model import GROWN_PER_KEPT, PlusModel, solid_angle_pixels
from padgs.methods.splats.densification import DensificationOptions
from padgs.methods.splats.method import PRUNE_PSNR, SplatMethod, SplatOptions, lowest_limit
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig
from padgs.scene import Scene
from padgs.training.loop import Stage, Trainer
from padgs.training.model import Model
from padgs.training.options import Budget, TrainOptions

PIXEL_VARIANCE = 0.1  # square pixels; a pixel is the mean over a square, whose variance is 1/12
ROUNDS = 8  # of densification
DENSIFIED_SHARE = 0.4  # of the run, after which no Gaussians are added
UNUSED = (  # options of 3DGS that have no effect here
    *("densify_from", "densify_until", "densify_every", "prune_by_extent", "prune_by_extent_from"),
    *("reset_every", "reset_opacity"),
)
LONG_RUN = 2000  # iterations; shorter runs have a higher threshold
REFERENCE_PIXELS = 2 * 256 * 128 / math.pi  # pixels of equal solid angle; larger views have a lower threshold
AMPLE_PIXELS = 16  # training pixels per Gaussian that make dropout unnecessary


def iterations_per_round(iterations: int) -> int:
    """Return the interval between densification rounds in a run of `iterations`."""
    return max(1, round(DENSIFIED_SHARE * iterations / ROUNDS))


@dataclass(frozen=True)
class PlusOptions(SplatOptions):
    """The `method` group of the configuration. Shares of the run are in [0, 1], so no schedule has a length."""

    sh_degree: int = 2  # one more each tenth of the run; degree 3 gains nothing and costs a fifth of the time
    positional_gradient: str = "space_absolute"
    gradient_threshold: float = 5e-5  # of SPaGS; adapted by `for_run` and `for_views`
    threshold_pixel_exponent: float = 1.0  # threshold ~ pixel width ^ exponent, for views above 256x128; 0: constant
    threshold_full_views: int = 28  # fewer views lower the threshold less, by sqrt(views / this); 0: never less
    sample_clones: bool = True
    min_opacity: float = 0.05  # fainter Gaussians are pruned after each round
    coarse_share: float = 0.3  # of the run, on views of half the width or less if they are large
    initial_per_pixel: float | None = 0.6  # initial points per independent pixel of a view; None: all points
    depth_init_per_pixel: float = 0.6  # a sparser cloud is filled from training pixels; 0: never
    limit_per_pixel: float | None = 2.6  # maximal Gaussians per independent pixel, which bounds memory and time
    prune_psnr: float | None = PRUNE_PSNR  # dB of the pruning step, see `count_for_psnr`; None: no pruning
    initial_opacity: float = 0.5  # 0.1 hides what lies in front until opacities have grown
    initial_scale: float = 0.6  # times the distance of the nearest points; 1 in 3DGS, whose Gaussians overlap
    means_rate_factor: float = 2.0  # on the learning rate of the means in 3DGS
    size_weight: float = 0.05  # loss weight of the mean angular size: large Gaussians cost pairs in every frame
    smoothness_weight: float = 0.12  # loss weight of the roughness of surfaces, which few views leave open
    dropout: float = 0.1  # maximal share of Gaussians dropped from a training render, see `dropout_share`
    sky_per_point: float = 0.5  # directions per initial point that get a far Gaussian if no point is there

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "an opacity below 1", lambda opacity: 0 < opacity < 1, "initial_opacity")
        check(self, "> 0 and finite", lambda factor: 0 < factor < math.inf, "initial_scale", "means_rate_factor")
        check(self, "> 0 and finite, or none for no pruning", lambda p: p is None or 0 < p < math.inf, "prune_psnr")
        weights = ("size_weight", "smoothness_weight", "sky_per_point", "depth_init_per_pixel")
        thresholds = ("threshold_pixel_exponent", "threshold_full_views")
        off = "at least 0, which switches it off"
        check(self, off, lambda value: 0 <= value < math.inf, *weights, *thresholds)
        check(self, "a share of the run in [0, 1]", lambda share: 0 <= share <= 1, "coarse_share")
        check(self, "a share of the Gaussians in [0, 1)", lambda share: 0 <= share < 1, "dropout")
        limits = ("initial_per_pixel", "limit_per_pixel")
        check(self, "> 0, or none for no limit", lambda share: share is None or share > 0, *limits)
        for field in fields(DensificationOptions):
            if field.name in UNUSED and getattr(self, field.name) != field.default:
                raise ValueError(
                    f"{field.name} is {getattr(self, field.name)}, but padgs_plus has densification rounds of its own "
                    f"and no resets; leave it at {field.default}"
                )

    def dropout_share(self, pixels: float, gaussians: float) -> float:
        """Return the dropped share for a number of training pixels in all views and a number of Gaussians.

        0 with `AMPLE_PIXELS` per Gaussian, `dropout` with half as many, logarithmic between.
        """
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
        """Return options with evenly spaced rounds up to `DENSIFIED_SHARE` of the run and no opacity resets.

        Shorter runs than `LONG_RUN` have a threshold higher by the square root of the ratio: new Gaussians take
        iterations to fit, and each makes every later iteration slower.
        """
        every = iterations_per_round(iterations)
        plain = DensificationOptions(
            **{field.name: getattr(self, field.name) for field in fields(DensificationOptions)}
        )
        threshold = self.gradient_threshold * max(1.0, math.sqrt(LONG_RUN / iterations))
        schedule = {"densify_from": 0, "densify_until": ROUNDS * every + 1, "densify_every": every}
        return replace(plain, gradient_threshold=threshold, reset_every=iterations + 1, **schedule)


class PlusMethod(SplatMethod):
    """See `padgs.training.method.Method`."""

    Options = PlusOptions
    MODEL = PlusModel
    RENDER = RenderConfig(projection="ray", low_pass=PIXEL_VARIANCE)
    TRAIN = TrainOptions(weight="solid_angle")
    _filled: tuple[Scene, int, Scene, torch.Tensor] | None = None  # last arguments and result of `_filled_scene`

    @property
    def _target(self) -> int | None:
        """Number of Gaussians before the pruning step that a numeric budget asks for."""
        requested = super()._target
        return requested if requested is None or self.options.prune_psnr is None else GROWN_PER_KEPT * requested

    @property
    def _prune_psnr(self) -> float | None:
        return self.options.prune_psnr or super()._prune_psnr

    @property
    def has_smoothing_filter(self) -> bool:
        """See `padgs.methods.splats.smoothing_filter`."""
        return self.model.has_smoothing_filter

    def build_model(self, scene: Scene, iterations: int) -> SplatModel:
        """See `Method.build_model`."""
        options, capacity = self.options, room_count(scene) * solid_angle_pixels(scene.train[0])
        start, limit = (_count(share, capacity) for share in (options.initial_per_pixel, options.limit_per_pixel))
        limit = lowest_limit(options.max_gaussians, limit if self._target is None else self._target)
        for_points = None if limit is None else math.ceil(limit / (1 + options.sky_per_point))
        start, wanted = lowest_limit(start, for_points), round(options.depth_init_per_pixel * capacity)
        points, generator = self._filled_scene(scene, wanted if start is None else min(wanted, start))
        splats = Splats.from_scene(
            points,
            degree=options.sh_degree,
            max_gaussians=start,
            opacity=options.initial_opacity,
            scale=options.initial_scale,
            generator=generator,
        )
        directions = round(options.sky_per_point * len(splats))
        directions = directions if limit is None else min(directions, limit - len(splats))
        if directions > 0:
            sky = far_gaussians(scene, directions, degree=options.sh_degree, opacity=options.initial_opacity)
            splats.load({name: torch.cat((own, sky.rows()[name])) for name, own in splats.rows().items()})
        return self._model_of(splats, options.extent_of(scene), iterations, scene.train, limit=limit)

    def _filled_scene(self, scene: Scene, count: int) -> tuple[Scene, torch.Generator]:
        """Return the scene with its cloud filled from training pixels, and the generator of further random choices.

        Computed once for a rehearsal and its run; not if the parameters come from another model.
        """
        generator = torch.Generator().manual_seed(self.seed)
        if self._loaded_state is not None or self._warm_start_state is not None:
            return scene, generator
        if self._filled is None or self._filled[0] is not scene or self._filled[1] != count:
            self._filled = scene, count, fill_sparse_cloud(scene, count, generator=generator), generator.get_state()
        generator.set_state(self._filled[3])
        return self._filled[2], generator

    def build_trainer(self, model: Model, scene: Scene, budget: Budget, stage: Stage) -> Trainer:
        """See `Method.build_trainer`."""
        share = self.options.coarse_share
        return Trainer(model, scene, budget, self.train_options, self.seed, coarse_share=share, stage=stage)


def _count(share: float | None, pixels: float) -> int | None:
    """Return a multiple of the pixels as a whole number; None stays None."""
    return None if share is None else max(1, round(share * pixels))
