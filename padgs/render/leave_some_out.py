"""What each Gaussian's removal adds to the error of an image where others are removed with it by chance.

Sums of what each does alone (`padgs.render.leave_one_out`) fall short for groups: what stands behind a Gaussian and
would have taken its place may be gone, too. But a pixel's colour is linear in whether a Gaussian is there, so its mean
over all groups, where each Gaussian is gone with a probability p by itself, is the colour with opacities times 1 - p.
Drawn like that, one scoring pass says what a Gaussian's absence changes on average, D: it finds (1 - p) D, as the
opacity that it takes away has been lowered as well. With r = mean image - target the squared error of the mean differs
between "gone", r + (1 - p) D, and "there", r - p D, by 2 <r, D> + (1 - 2 p) ||D||^2.

The sum of that over a group is nearly the best that any sum can be: that is the difference of the mean error itself
(Hoeffding, A class of statistics with asymptotically normal distribution, 1948), which knows of the change of the
pixels' variance, too. What no sum knows is who of the group stands in for whom (docs/need.md).
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.render.contract import RenderOptions
from padgs.render.leave_one_out import leave_one_out
from padgs.scene import View


def leave_some_out(
    gaussians: Gaussians,
    view: View,
    target: Tensor,
    weight: Tensor,
    share: float,
    options: RenderOptions = RenderOptions(),  # noqa: B008 - frozen dataclass
    *,
    backend: str = "auto",
) -> Tensor:
    """Score N Gaussians [N], float64: their sum over a random group predicts the change of the mean square error.

    It ranks groups of that share; the sum itself is up to a fifth larger than what a tenth does, in trained models
    a seventh. The mean picture is exact where colours are linear in who is there: not where an alpha is cut at 0.99 or
    below 1/255, where a ray ends early, or where the order depends on alphas (hybrid blending). `padgs need` removes
    whom the views miss least instead, by `leave_one_out`; this is for asking what a random loss would do.

    Args:
        gaussians: N Gaussians.
        view: pose and image size.
        target: [H, W, 3], what it should look like.
        weight: [H, W] or [H, 1] of the pixels, as for `leave_one_out`.
        share: of the Gaussians in a group, in [0, 1). With 0 it is `leave_one_out(...).error`.
        options: how it is drawn.
        backend: as for `leave_one_out`.

    Raises:
        ValueError: a share outside [0, 1), or what `leave_one_out` refuses.
    """
    if not 0 <= share < 1:
        raise ValueError(f"share is {share}; a group has a share of the Gaussians in [0, 1), and leaves some")
    there = 1 - share
    dimmed = replace(gaussians, opacities=there * gaussians.opacities)
    found = leave_one_out(dimmed, view, target, weight, options, backend=backend)
    across, square = (found.error - found.change) / there, found.change / there**2
    return across + (1 - 2 * share) * square
