"""Growth by need: more Gaussians only where errors are seen, and only as long as they are worth having."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from padgs.learning.stopping import even_weight, quality
from padgs.learning.targets import image_of
from padgs.render import Rendering, RenderOptions, render
from padgs.scene import View
from padgs.splats.model import Splats

AUTO = "auto"  # of `budget.gaussians`
SLOPE = 0.1  # dB per doubling, below which more Gaussians are not worth having
BACK = 2  # rounds that gains are taken over: after one alone the model may not have recovered from its growth
NOTICEABLE = 0.1  # doublings, below which a slope is noise
ERROR = 0.02  # mean absolute error, colours in [0, 1], that is worth a Gaussian more
SEEN = 2  # views that must show it: what one view alone shows may be a floater, which more Gaussians only fit
LOOKED_AT = 8  # training views at most that errors are looked for in


class Governor:
    """Of one model.

    `state` holds all that it remembers, as JSON can.
    """

    def __init__(self, views: Sequence[View], judges: Sequence[View], backend: str) -> None:
        """Look for errors in some of the training `views`, and measure on the `judges`, which are others."""
        self._views = views[:: math.ceil(len(views) / LOOKED_AT)]
        self._judges, self._backend = judges, backend
        self.state: dict[str, Any] = {"rounds": [], "enough": False}

    def candidates(self, splats: Splats, options: RenderOptions) -> Tensor:
        """Which Gaussians [N] may multiply in a round that is due; none once they gained too little.

        What was gained lately is what training gained, too, so growth ends late rather than early.
        """
        value = quality(lambda view: self._drawn(splats, view, options), self._judges)
        count, rounds = len(splats), self.state["rounds"]
        if len(rounds) == BACK and (doublings := math.log2(count / rounds[0][0])) > NOTICEABLE:
            self.state["enough"] |= value - rounds[0][1] < SLOPE * doublings
        self.state["rounds"] = [*rounds, [count, value]][-BACK:]
        if self.state["enough"]:
            return torch.zeros(count, dtype=torch.bool, device=splats.means.device)
        return torch.stack([self._errors(splats, view, options) > ERROR for view in self._views]).sum(0) >= SEEN

    def _drawn(self, splats: Splats, view: View, options: RenderOptions) -> Rendering:
        return render(splats.gaussians(view), view, options, backend=self._backend)

    @torch.no_grad()
    def _errors(self, splats: Splats, view: View, options: RenderOptions) -> Tensor:
        """Mean absolute error [N] of the pixels that a view shows each Gaussian in, by what it contributes; else 0.

        A pixel is a sum of contributions times colours, so the gradient of a weighted sum of pixels by a colour is the
        sum of the contributions times the weights: in one channel the errors, in another one 1.
        """
        gaussians = splats.gaussians(view)
        colors = gaussians.colors.requires_grad_()
        with torch.enable_grad():
            image = render(replace(gaussians, colors=colors), view, options, backend=self._backend).image
        error = (image.detach().clamp(0, 1) - image_of(view, image.device)).abs().mean(-1)
        weight = even_weight(view, image.device).expand_as(error)
        weights = torch.stack((error * weight, weight, torch.zeros_like(weight)), dim=-1)
        (sums,) = torch.autograd.grad(image, colors, weights)
        return sums[:, 0] / sums[:, 1].clamp(min=torch.finfo(sums.dtype).tiny)
