"""Exposures that learn: gain and offset of each colour channel for each training view, optimised with the model.

As the affine colours per image of URF (Rematas et al. 2022), but diagonal. They are relative: log-gains and offsets
have a mean of 0 over all views, so that views without any, the held-out ones, have the mean exposure.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from padgs.training.schedule import Constant, ParameterGroup

RATE = 3e-3  # of log-gains; at the end still so much, for what is frozen early is wrong
OFFSET_RATE = RATE / 5  # of offsets, in colours from 0 to 1


class Exposures(nn.Module):
    """Of V views, by their numbers; see `padgs.training.views.corrections.Corrections`.

    Each view has parameters of its own, so that the optimiser's moments of a view rest while other views are drawn.

    Attributes:
        log_gains, offsets: V times [3], of the colour channels.
    """

    def __init__(self, views: int) -> None:
        """No correction yet."""
        super().__init__()
        self.log_gains, self.offsets = (nn.ParameterList([torch.zeros(3) for _ in range(views)]) for _ in range(2))

    def groups(self) -> list[ParameterGroup]:
        """Learning rates, at the pace of the run as those of the model that they follow."""
        return [
            ParameterGroup("exposure_log_gains", tuple(self.log_gains), Constant(RATE)),
            ParameterGroup("exposure_offsets", tuple(self.offsets), Constant(OFFSET_RATE)),
        ]

    def exposed(self, image: Tensor, index: int) -> Tensor:
        """An image [H, W, 3] as view `index` would show it; differentiable."""
        return image * self.log_gains[index].exp() + self.offsets[index]

    @torch.no_grad()
    def centre(self) -> None:
        """Take the mean out again; called after each step."""
        for of_views in (self.log_gains, self.offsets):
            mean = torch.stack(list(of_views)).mean(0)
            for own in of_views:
                own -= mean
