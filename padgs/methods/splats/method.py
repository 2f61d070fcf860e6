"""Explicit Gaussians as a method: common base of OmniGS, ODGS, OP43DGS and other methods of the 3DGS family.

They differ in their options: densification (`padgs.methods.splats.densification`), renderer and loss. Each is a
subclass in `baselines`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from padgs.checks import check, check_known
from padgs.geometry.harmonics import MAX_DEGREE
from padgs.methods.splats.densification import DensificationOptions
from padgs.methods.splats.depth_initialization import far_gaussians, fill_sparse_cloud, room_count, solid_angle_pixels
from padgs.methods.splats.importance import GROWN_PER_KEPT, RECOVERY, RECOVERY_SHARE, pruning_iteration
from padgs.methods.splats.lengths import EXTENT, LENGTH_UNITS
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.splats import INITIAL_OPACITY, Splats
from padgs.scene import Scene, View
from padgs.training.corrections import LEARNED, LEARNED_FAST
from padgs.training.initial_points import ExtentOptions
from padgs.training.loss import MEASURED
from padgs.training.method import Method
from padgs.training.model import State
from padgs.training.options import AUTO, Budget, TrainOptions

PRUNE_PSNR = 44.0  # dB, with budget.gaussians=auto; see `padgs.methods.splats.importance.count_for_psnr`


@dataclass(frozen=True)
class SplatOptions(DensificationOptions, ExtentOptions):
    """The `method` group of the configuration: the model and its densification."""

    sh_degree: int = 3  # 0: colours do not depend on the direction
    initial_opacity: float = INITIAL_OPACITY  # opacity of the Gaussians at the start
    initial_scale: float = 1.0  # times the distance of the nearest points; below 1 Gaussians do not overlap at first
    initial_per_pixel: float | None = None  # initial points per independent pixel of a view; None: all points
    depth_init_per_pixel: float = 0.0  # a sparser cloud is filled from training pixels by plane sweep; 0: never
    sky_per_point: float = 0.0  # directions per initial point that get a far Gaussian if no point is there
    limit_per_pixel: float | None = None  # maximal Gaussians per independent pixel, which bounds memory and time
    # Length that steps of the means and sizes are multiples of. extent: that of all cameras (3DGS). nearest_camera: of
    # each Gaussian, by its distance to the nearest training camera (`padgs.methods.splats.lengths`).
    length_unit: str = EXTENT
    means_rate_factor: float = 1.0  # factor on the learning rate of the means in 3DGS
    means_least_pace: float = 1.0  # least factor on it by train.learning_rates=run, which longer runs stay at
    prune_psnr: float | None = None  # dB to which the least important are pruned; None: by `budget.gaussians` only
    supersampling_from: float = 0.0  # share of the run with one sample a pixel, before `render.supersampling` acts
    # Variance in square pixels of the finest training view (3D smoothing filter of Mip-Splatting and SPaGS,
    # `padgs.methods.splats.smoothing_filter`); 0: none.
    smoothing_filter: float = 0.0

    def __post_init__(self) -> None:
        for part in (DensificationOptions, ExtentOptions):
            part.__post_init__(self)
        check(self, f"0 to {MAX_DEGREE}", lambda degree: 0 <= degree <= MAX_DEGREE, "sh_degree")
        check(self, "a variance >= 0 in square pixels", lambda v: 0 <= v < math.inf, "smoothing_filter")
        check(self, "a share of the run in [0, 1)", lambda share: 0 <= share < 1, "supersampling_from")
        check(self, "an opacity below 1", lambda opacity: 0 < opacity < 1, "initial_opacity")
        factors = ("initial_scale", "means_rate_factor", "means_least_pace")
        check(self, "> 0 and finite", lambda factor: 0 < factor < math.inf, *factors)
        check_known(self, length_unit=LENGTH_UNITS)
        check(self, "> 0 and finite, or null for no pruning", lambda p: p is None or 0 < p < math.inf, "prune_psnr")
        off = "at least 0, which switches it off"
        check(self, off, lambda value: 0 <= value < math.inf, "sky_per_point", "depth_init_per_pixel")
        limits = ("initial_per_pixel", "limit_per_pixel")
        check(self, "> 0, or null for no limit", lambda share: share is None or share > 0, *limits)


def lowest_limit(*limits: int | None) -> int | None:
    """Return the smallest limit; None means no limit."""
    return min((limit for limit in limits if limit is not None), default=None)


class SplatMethod(Method):
    """See `padgs.training.method.Method`; subclasses set options, model class and renderer defaults."""

    Options = SplatOptions
    HAS_GAUSSIANS = True
    MODEL: ClassVar[Callable[..., SplatModel]] = SplatModel
    TRAIN = TrainOptions(weight="uniform")
    _filled: tuple[Scene, int, Scene, torch.Tensor] | None = None  # last arguments and result of `_filled_scene`

    def _refuse_impossible(self) -> None:
        super()._refuse_impossible()
        default = type(self.options)().supersampling_from
        if self.render_config.supersampling == 1 and self.options.supersampling_from not in (0, default):
            raise ValueError(
                f"method.supersampling_from is {self.options.supersampling_from}, but render.supersampling is 1; set "
                f"render.supersampling=2, or method.supersampling_from={default:g}"
            )
        if self.options.positional_gradient == "space_absolute" and self.render_config.projection != "ray":
            raise ValueError(
                "method.positional_gradient=space_absolute is made for render.projection=ray, not "
                f"{self.render_config.projection}; set method.positional_gradient=space"
            )

    def refuse_budget(self, budget: Budget) -> None:
        """Also refuse pruning by importance from the given poses if the world of the model drifts away from them."""
        super().refuse_budget(budget)
        prunes = budget.gaussians == AUTO or self.options.prune_psnr is not None
        if prunes and self.train_options.poses == LEARNED_FAST:
            raise ValueError(
                f"train.poses is {LEARNED_FAST}, but budget.gaussians={AUTO} and method.prune_psnr score Gaussians "
                f"from the given poses; set train.poses={LEARNED}, or both to null"
            )

    def build_model(self, scene: Scene, iterations: int) -> SplatModel:
        options = self.options
        shares = (options.initial_per_pixel, options.limit_per_pixel, options.depth_init_per_pixel or None)
        pixels = room_count(scene) * max(map(solid_angle_pixels, scene.train)) if any(shares) else 0.0
        start, limit, filled = (None if share is None else max(1, round(share * pixels)) for share in shares)
        target = self._target(iterations)
        limit = lowest_limit(options.max_gaussians, limit if target is None else target)
        for_points = None if limit is None else math.ceil(limit / (1 + options.sky_per_point))
        start = lowest_limit(start, for_points)
        points, generator = self._filled_scene(scene, (lowest_limit(filled, start) or 0) if filled else 0)
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
        return self._model_of(splats, options.extent_of(scene), iterations, scene.train, limit)

    def _filled_scene(self, scene: Scene, count: int) -> tuple[Scene, torch.Generator]:
        """Return the scene with up to `count` points, once for rehearsal and run, and the generator of more choices."""
        generator = torch.Generator().manual_seed(self.seed)
        if count == 0 or self._loaded_state is not None or self._warm_start_state is not None:
            return scene, generator
        if self._filled is None or self._filled[0] is not scene or self._filled[1] != count:
            options = self.train_options
            measured = options.depth_weight > 0 and options.depth_kind == MEASURED
            filled = fill_sparse_cloud(scene, count, generator=generator, measured=measured)
            self._filled = scene, count, filled, generator.get_state()
        generator.set_state(self._filled[3])
        return self._filled[2], generator

    def _prune_psnr(self, iterations: int) -> float | None:
        """Return the PSNR of the pruning step; None: there is none, as training would not recover from it."""
        due = pruning_iteration(self.options.for_run(iterations))
        asked = self.options.prune_psnr or (PRUNE_PSNR if self._gaussians == AUTO else None)
        return asked if iterations - due >= max(RECOVERY, RECOVERY_SHARE * iterations) else None

    def _target(self, iterations: int) -> int | None:
        """Return the number that densification aims at: that of the budget, if it is one; twice that before pruning."""
        requested = self._gaussians if isinstance(self._gaussians, int) else None
        return requested if requested is None or self._prune_psnr(iterations) is None else GROWN_PER_KEPT * requested

    def restore(self, state: State) -> SplatModel:
        stored = state.of_model()
        values, empty = stored.values, stored.tensors["splats/means"][:0]
        splats = Splats(empty, empty, empty, degree=self.options.sh_degree, scene_scale=values["scene_scale"])
        return self._model_of(splats, values["extent"], values["iterations"])

    def _model_of(
        self, splats: Splats, extent: float, iterations: int, views: Sequence[View] = (), limit: int | None = None
    ) -> SplatModel:
        """Return the trainable model; `limit` is the maximal number of Gaussians."""
        options = self.options
        return self.MODEL(
            splats,
            replace(options, max_gaussians=limit),
            self.render_config,
            extent=extent,
            iterations=iterations,
            views=views,
            target=self._target(iterations),
            seed=self.seed,
            requested=self._gaussians,
            prune_psnr=self._prune_psnr(iterations),
        )
