"""Evaluation protocols: the metrics, the evaluated part of the image, and the weights.

Scores of different protocols or options cannot be compared, so a result stores its whole protocol.

All protocols compare 8-bit images: the render is clamped to [0, 1] and rounded to 1/255, as in a PNG. Masks are weights
(see `padgs.evaluation.metrics`). The released evaluation has no masks; without masks, `paper` reproduces its numbers.
"""

import math
from dataclasses import dataclass

from padgs.checks import check, check_known
from padgs.evaluation.lpips import INPUTS, NETS
from padgs.evaluation.metrics import BANDS, METRICS

LPIPS_CHOICES = (*NETS, "none")


@dataclass(frozen=True)
class Protocol:
    """The settings of one evaluation."""

    name: str
    metrics: tuple[str, ...]  # names of padgs.evaluation.metrics.METRICS
    lpips: str  # alex: 0.1 s per megapixel pair on a CPU; vgg: 30 times that; none: left out
    lpips_inputs: str  # 11: fed [-1, 1]; 01: fed [0, 1]
    solid_angle: bool  # weight LPIPS by solid angle, and hide `bottom_crop` by weight instead of cutting it off
    bottom_crop: float = 0.0  # share of the rows at the bottom that is not evaluated (a tripod, a car)

    def __post_init__(self) -> None:
        check(self, f"at least one of {', '.join(METRICS)}", bool, "metrics")
        unknown = [name for name in self.metrics if name not in METRICS]
        if unknown:
            raise ValueError(f"unknown metric {unknown[0]!r}; known: {', '.join(METRICS)}")
        check_known(self, lpips=LPIPS_CHOICES, lpips_inputs=INPUTS)
        check(self, "a share of the rows, 0 <= share < 1", lambda share: 0 <= share < 1, "bottom_crop")

    @property
    def lpips_name(self) -> str | None:
        """Return the name of the LPIPS metric: weighting, network and input range; None if it is left out."""
        if self.lpips == "none":
            return None
        return f"{'ws_' if self.solid_angle else ''}lpips_{self.lpips}{'_01' if self.lpips_inputs == '01' else ''}"

    def rows(self, height: int) -> int:
        """Return how many rows of an image are evaluated; a row that the crop touches is not.

        >>> from dataclasses import replace
        >>> replace(PROTOCOLS["paper"], bottom_crop=ROAM_360_BOTTOM_CROP).rows(1024)
        959
        """
        return max(1, math.floor(height * (1 - self.bottom_crop) + 1e-9))


ON_THE_SPHERE = ("psnr", "ssim", "ws_psnr", "ws_ssim", *(f"ws_psnr_{band}" for band in BANDS), "seam")
OF_FAILURES = ("ws_psnr", "ws_psnr_equator", "ws_psnr_pole", "seam")
PROTOCOLS = {
    # The evaluation released with the paper: flat image, LPIPS-VGG fed [0, 1].
    "paper": Protocol("paper", ("psnr", "ssim"), lpips="vgg", lpips_inputs="01", solid_angle=False),
    # Every direction has the same weight; the networks of LPIPS alone see the left and the right edge apart.
    "sphere": Protocol("sphere", ON_THE_SPHERE, lpips="alex", lpips_inputs="11", solid_angle=True),
    # Signs of failed training; `padgs.evaluation.scoring` adds diagnostics and further scores.
    "stability": Protocol("stability", OF_FAILURES, lpips="none", lpips_inputs="11", solid_angle=True),
}
ROAM_360_BOTTOM_CROP = 65 / 1024  # 360Roam shows the robot there; the released evaluation cuts rows >= 959 of 1024
