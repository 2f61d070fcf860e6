"""padgs_plus in training: splats with schedules in shares of the run, kept small, and averaged at the end."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.plus.angular_size import mean_angular_size
from padgs.methods.plus.options import GROWN_PER_KEPT, PlusOptions
from padgs.methods.plus.smoothness import roughness
from padgs.methods.splats.model import TINY, Splats
from padgs.methods.splats.nearest import cameras_of, finest_pixels, no_finer
from padgs.methods.splats.trainee import SplatTrainee
from padgs.render import RenderConfig
from padgs.scene import View
from padgs.training.model import State, TrainingRender
from padgs.training.schedule import ParameterGroup

DEGREE_SHARE = 0.1  # of the run, after which the next SH degree comes into use
AVERAGED_FROM = 0.9  # share of the run after which parameters are averaged, and all Gaussians drawn
AVERAGE = "average/"  # of its tensors in a state
CAMERAS = "cameras"  # of the training views, in a state
FEWEST_PIXELS = 2000.0  # panoramas of less than 80 x 40: many of them together show more than each


def counted_pixels(view: View) -> float:
    """What numbers of Gaussians are shares of: the pixels of equal solid angle that a panorama shows, W H times the
    mean cosine of the latitude, 2 / pi; at least `FEWEST_PIXELS`.
    """
    return max(FEWEST_PIXELS, 2 * view.width * view.height / math.pi)


def _chances(seed: int, count: int, device: torch.device) -> Tensor:
    """Random integers [count] below 2^32, the same on each device and made there, so that nobody waits for a GPU.

    They are the numbers from `seed` on, mixed as MurmurHash3 ends.
    """
    mixed = torch.arange(seed, seed + count, device=device)
    for factor, shift in ((0x9E3779B1, 16), (0x85EBCA6B, 13), (0xC2B2AE35, 16)):
        mixed = mixed * factor & 0xFFFFFFFF
        mixed = mixed ^ (mixed >> shift)
    return mixed


class PlusTrainee(SplatTrainee):
    """Splats with the schedule of padgs_plus for a run of `iterations`.

    Attributes:
        average: name of a parameter -> its running mean in the last tenth of the run; empty before and after.
    """

    def __init__(
        self, splats: Splats, options: PlusOptions, config: RenderConfig, *, limit: int | None = None, **kwargs: Any
    ) -> None:
        """Arguments as for `SplatTrainee`; `limit`: as many Gaussians as there may be."""
        views = kwargs.get("views", ())
        largest = max(map(counted_pixels, views), default=FEWEST_PIXELS)
        growth = replace(options.for_views(largest, len(views)), max_gaussians=limit)
        super().__init__(splats, growth, config, **kwargs)
        self.options, self.average = options, dict[str, Tensor]()
        self._moment = 0  # of the schedule, the last that has passed
        self._pixels = sum(map(counted_pixels, self._views))
        self._cameras = cameras_of(self._views)
        self._finest: tuple[Tensor, Tensor] | None = None  # means, and the pixel of the finest camera at each

    def groups(self, means_speed: float = 1.0) -> list[ParameterGroup]:
        """Those of 3DGS, the means faster."""
        return super().groups(means_speed * self.options.means_speed)

    def degree_at(self, iteration: int) -> int:
        """A degree more each tenth of the run."""
        return int(iteration / (DEGREE_SHARE * self.iterations))

    def draw(self, view: View, probe: Tensor | None = None) -> TrainingRender:
        """Render all Gaussians, differentiably; large ones and rough surfaces are penalised, as the view sees them."""
        drawing, options, penalties = super().draw(view, probe), self.options, []
        near = max(self.render_options(view).near, TINY * self.splats.unit)  # that may be 0, as the depth of nothing is
        if options.size_weight > 0:
            penalties.append(options.size_weight * mean_angular_size(drawing.gaussians, view, near=near))
        if options.smoothness_weight > 0:
            penalties.append(options.smoothness_weight * roughness(drawing.rendering, view.camera, near=near))
        return replace(drawing, penalty=sum(penalties)) if penalties else drawing

    def _in_training(self, gaussians: Gaussians) -> Gaussians:
        """As all splats are, but that some are left out."""
        share, gaussians = self._share_of_opacities(), super()._in_training(gaussians)
        return gaussians if share is None else replace(gaussians, opacities=share * gaussians.opacities)

    @torch.no_grad()
    def _share_of_opacities(self) -> Tensor | None:
        """What opacities [N] are multiplied with in the next drawing; None: 1. Nothing of a few by chance, which the
        others must make up for, and so much more of those.

        Dropout, as DropGaussian has it: what stands in front of one view only to please it is found out. The last
        states, which become the model, know all Gaussians.
        """
        if self._pixels == 0 or self._moment >= AVERAGED_FROM * self.iterations:
            return None
        fewer = GROWN_PER_KEPT if self.choice.lies_ahead(self._moment) else 1
        share = self.options.dropped_share(self._pixels, len(self.splats) / fewer)
        if share == 0:
            return None
        opacities = torch.sigmoid(self.splats.opacity_logits)
        seed = int(torch.randint(2**31, (), generator=self.densifier.generator))
        drawn = _chances(seed, len(opacities), opacities.device) >= share * 2**32
        return drawn * (1 / opacities).clamp(max=1 / (1 - share))

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Average, densify, choose whom to keep, and bring the next SH degree into use, where it is time to."""
        self._moment, events = iteration, ()
        if iteration > AVERAGED_FROM * self.iterations and self.options.average_share > 0:
            events = self._averaged(iteration)
        return events + super().adapt(iteration, optimizer)

    def _averaged(self, iteration: int) -> tuple[str, ...]:
        """Note the parameters; at the end of the run their mean takes their place."""
        parameters = self.splats.rows()
        new = 1 / max(1.0, self.options.average_share * self.iterations)
        for name, parameter in parameters.items():
            self.average.setdefault(name, parameter.detach().clone()).lerp_(parameter, new)
        if iteration < self.iterations:
            return ()
        for name, parameter in parameters.items():
            parameter.copy_(self.average[name])
        self.average = {}
        return ("the model is the mean of its last states",)

    @property
    def is_drawn_no_finer(self) -> bool:
        """Whether there are training views to be no finer than, and the filter is one in space, which can grow."""
        return len(self._cameras) > 0 and self._config.resolved_low_pass_kind == "solid"

    def _shown(self, view: View) -> Gaussians:
        """No finer than the training views have seen them."""
        gaussians = super()._shown(view)
        if not self.is_drawn_no_finer:
            return gaussians
        if self._finest is None or not torch.equal(self._finest[0], gaussians.means):
            means = gaussians.means.detach().clone()
            self._finest = means, finest_pixels(means, self._cameras)
        return no_finer(gaussians, view, self._finest[1], self._config.low_pass)

    def state(self) -> State:
        """That of splats, the moment, and the running means."""
        state = super().state()
        averages = {AVERAGE + name: mean for name, mean in self.average.items()}
        return State(state.tensors | averages | {CAMERAS: self._cameras}, state.values | {"moment": self._moment})

    def load_state(self, state: State) -> None:
        """Become the model that `state` was taken of."""
        super().load_state(state)
        self._moment = state.values.get("moment", self.iterations)  # older checkpoints left nothing out
        device = self.splats.means.device
        self.average = {name: mean.to(device, copy=True) for name, mean in state.under(AVERAGE).items()}
        self._cameras = state.tensors.get(CAMERAS, self._cameras)  # older checkpoints have none
        self._finest = None
