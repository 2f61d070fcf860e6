"""What padgs_plus consists of, part by part; each has a value that takes it away."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from padgs.checks import check
from padgs.methods.splats.clone_split import CloneSplitOptions
from padgs.methods.splats.method import REMOVAL_PSNR, SplatOptions

ROUNDS = 8
SCHEDULE = (  # options of 3DGS that mean nothing here
    *("densify_from", "densify_until", "densify_every", "prune_by_extent", "prune_by_extent_from"),
    *("reset_every", "reset_opacity", "released_start", "released_reset"),
)
LONG = 2000  # iterations from which on the threshold of growth does not fall any more
COARSE = 2 * 256 * 128 / math.pi  # pixels of equal solid angle in a view; where there are more, it falls on
GROWN = 0.4  # share of the run after which nothing grows any more
GROWN_PER_KEPT = 2  # Gaussians before the choice, for each after it; more or less
PLENTY = 16  # pixels of training views for each Gaussian: with fewer, pleasing one view may spoil another


def between_rounds(iterations: int) -> int:
    """Iterations from one round to the next, in a run of so many."""
    return max(1, round(GROWN * iterations / ROUNDS))


@dataclass(frozen=True)
class PlusOptions(SplatOptions):
    """The `method` group of the configuration. Shares of the run are in [0, 1], so no schedule has a length."""

    sh_degree: int = 2  # a degree more each tenth of the run; the third gains nothing and costs a fifth of the time
    signal: str = "space_absolute"  # the pull on the mean itself, in no image plane and at no latitude
    gradient_threshold: float = 5e-5  # SPaGS's; see `for_run` and `for_views`
    pixel_power: float = 1.0  # of the width of pixels under those of 256x128: the threshold falls with it; 0: not
    many_views: int = 28  # as `bedroom` has; with fewer that threshold falls less, by the root of them; 0: as much
    sample_clones: bool = True
    min_opacity: float = 0.05  # what is fainter when a round ends was not needed
    coarse_share: float = 0.3  # of the run, on views that are half as wide if they are large, at first still smaller
    start_share: float | None = 0.6  # points to begin with, per independent pixel of a view; None: all that there are
    fill_share: float = 0.6  # ... up to which photographs give what the cloud has not, near its points; 0: not
    limit_share: float | None = 2.6  # ... and Gaussians at most while it grows: a guard on memory and time
    removal_psnr: float | None = REMOVAL_PSNR  # a round later the least missed go, by what each alone changes, added up
    initial_opacity: float = 0.5  # 0.1 hides what lies in front until opacities have grown
    initial_scale: float = 0.6  # times the distance of the nearest points; 1 is 3DGS's, whose Gaussians overlap
    means_speed: float = 2.0  # learning rate of the means, beside that of 3DGS
    size_weight: float = 0.05  # in the loss, of the mean angular size: what is large costs pairs in every frame
    smoothness_weight: float = 0.12  # in the loss, of the roughness of surfaces, which few views leave open
    drop_share: float = 0.1  # of Gaussians, left out of a drawing by chance where views are few; see `dropped_share`
    average_share: float = 0.04  # of the run: parameters are averaged over about so much of its end; 0: not
    sky_share: float = 0.5  # directions, per point to begin with, that get a far Gaussian if no point is there

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "an opacity below 1", lambda opacity: 0 < opacity < 1, "initial_opacity")
        check(self, "> 0 and finite", lambda factor: 0 < factor < math.inf, "initial_scale", "means_speed")
        check(self, "> 0 and finite, or none to keep all", lambda p: p is None or 0 < p < math.inf, "removal_psnr")
        off = "at least 0, which switches it off"
        for name in ("size_weight", "smoothness_weight", "sky_share", "fill_share", "pixel_power", "many_views"):
            check(self, off, lambda value: 0 <= value < math.inf, name)
        check(self, "a share of the run in [0, 1]", lambda share: 0 <= share <= 1, "coarse_share")
        check(self, "a share of the Gaussians in [0, 1)", lambda share: 0 <= share < 1, "drop_share")
        check(self, "a share of the run in [0, 0.1]", lambda share: 0 <= share <= 0.1, "average_share")
        for name in ("start_share", "limit_share"):
            check(self, "> 0, or none for no limit", lambda share: share is None or share > 0, name)
        for field in fields(CloneSplitOptions):
            if field.name in SCHEDULE and getattr(self, field.name) != field.default:
                raise ValueError(
                    f"{field.name} is {getattr(self, field.name)}, but padgs_plus has rounds of growth of its own "
                    f"and no resets; leave it at {field.default}"
                )

    def dropped_share(self, pixels: float, gaussians: float) -> float:
        """Share of so many Gaussians that a drawing leaves out, where training views have so many pixels in all.

        None where each Gaussian has `PLENTY` of them to be learned from; then more with the logarithm of what is
        missing, and all of `drop_share` where it has half as many.
        """
        if gaussians == 0:
            return 0.0
        return self.drop_share * min(max(math.log2(PLENTY * gaussians / pixels), 0.0), 1.0)

    def for_views(self, pixels: float, count: int) -> PlusOptions:
        """With the threshold for so many views of so many pixels (`counted_pixels`): lower where these are more than
        `COARSE`.

        A Gaussian as large as a few pixels has a part in the mean loss that falls with their solid angle, and a slope
        that rises with one over their width, so its pull falls with their width. Fewer panoramas than `many_views`
        raise it by the square root of many_views / count, to that of `COARSE` at most: a mean over few is less certain.
        """
        finer = min(1.0, math.sqrt(COARSE / pixels))  # width of a pixel
        fewer = max(1.0, math.sqrt(self.many_views / max(count, 1)))
        lower = min(1.0, finer**self.pixel_power * fewer)
        return replace(self, gradient_threshold=self.gradient_threshold * lower)

    def for_run(self, iterations: int) -> CloneSplitOptions:
        """Rounds of growth at even distances up to `GROWN`; no resets, which a run of any length must recover from.

        The threshold is higher in short runs, by the square root of what they are shorter: what grows must be fitted,
        and each Gaussian makes every later iteration slower.
        """
        every = between_rounds(iterations)
        plain = CloneSplitOptions(**{field.name: getattr(self, field.name) for field in fields(CloneSplitOptions)})
        until = ROUNDS * every + 1
        threshold = self.gradient_threshold * max(1.0, math.sqrt(LONG / iterations))
        when = {"densify_from": 0, "densify_until": until, "densify_every": every, "reset_every": iterations + 1}
        return replace(plain, gradient_threshold=threshold, **when)
