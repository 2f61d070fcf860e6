"""padgs_plus in training: splats with schedules as shares of the run, priors and dropout."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.plus.smoothness import roughness
from padgs.methods.splats.depth_initialization import MIN_PIXELS, solid_angle_pixels
from padgs.methods.splats.importance import GROWN_PER_KEPT
from padgs.methods.splats.model import SplatModel
from padgs.methods.splats.smoothing_filter import cameras_of, finest_pixels, smoothed_for_view
from padgs.methods.splats.splats import TINY, Splats
from padgs.render import RenderConfig
from padgs.scene import View
from padgs.training.model import State, TrainingRender

if TYPE_CHECKING:
    from padgs.methods.plus.method import PlusOptions

DEGREE_SHARE = 0.1  # of the run, between two SH degrees
DROPOUT_UNTIL = 0.9  # share of the run after which no Gaussians are dropped
SMOOTH_UP_TO = 4.0  # scene scales; surfaces farther away are smoothed less
CAMERAS = "cameras"  # key of the training cameras in a state


class PlusModel(SplatModel):
    """Splats with the schedule of padgs_plus for a run of `iterations`."""

    def __init__(self, splats: Splats, options: PlusOptions, config: RenderConfig, **kwargs: Any) -> None:
        views = kwargs.get("views", ())
        largest = max(map(solid_angle_pixels, views), default=MIN_PIXELS)
        count = round(sum(view.sphere_share for view in views))
        super().__init__(splats, options.for_views(largest, count), config, **kwargs)
        self.options = options
        self._smoothness = options.smoothness(count)
        self._pixels = sum(map(solid_angle_pixels, self._views))
        self._cameras = cameras_of(self._views)
        self._finest: tuple[Tensor, Tensor] | None = None  # means, and the finest training pixel at each

    def degree_at(self, iteration: int) -> int:
        """Return the scheduled SH degree: one more after each `DEGREE_SHARE` of the run."""
        return int(iteration / (DEGREE_SHARE * self.iterations))

    def draw(self, view: View, mean_offsets: Tensor | None = None) -> TrainingRender:
        """Render all Gaussians, differentiably, with a penalty on rough surfaces if views are few."""
        drawing, unit = super().draw(view, mean_offsets), self.splats.scene_scale
        if self._smoothness == 0:
            return drawing
        near = max(self.render_options(view).near, TINY * unit)  # it may be 0, and so is the depth of empty pixels
        rough = roughness(drawing.rendering, view.camera, near=near, far=SMOOTH_UP_TO * unit)
        return replace(drawing, penalty=self._smoothness * rough)

    def _training_gaussians(self, gaussians: Gaussians) -> Gaussians:
        factors, gaussians = self._dropout(), super()._training_gaussians(gaussians)
        return gaussians if factors is None else replace(gaussians, opacities=factors * gaussians.opacities)

    @torch.no_grad()
    def _dropout(self) -> Tensor | None:
        """Return factors [N] on opacities for the next render; None: no dropout.

        Random dropout of opacities (DropGaussian, Park et al. 2025): 0 for dropped Gaussians, 1 / (1 - p) for kept ones
        as far as opacities stay below 1. It exposes Gaussians that fit a single view only. There is none in the last
        states, which become the model.
        """
        if self._pixels == 0 or self._step >= DROPOUT_UNTIL * self.iterations:
            return None
        fewer = GROWN_PER_KEPT if self.pruning.is_ahead(self._step) else 1
        share = self.options.dropout_share(self._pixels, len(self.splats) / fewer)
        if share == 0:
            return None
        opacities = torch.sigmoid(self.splats.opacity_logits)
        seed = int(torch.randint(2**31, (), generator=self.densifier.generator))
        kept = _hashed(seed, len(opacities), opacities.device) >= share * 2**32
        return kept * (1 / opacities).clamp(max=1 / (1 - share))

    @property
    def has_smoothing_filter(self) -> bool:
        """True if the training cameras are known and the low-pass acts in space, where it can be widened."""
        return len(self._cameras) > 0 and self._config.resolved_low_pass_kind == "solid"

    def _final_gaussians(self, view: View) -> Gaussians:
        gaussians = super()._final_gaussians(view)
        if not self.has_smoothing_filter:
            return gaussians
        if self._finest is None or not torch.equal(self._finest[0], gaussians.means):
            means = gaussians.means.detach().clone()
            self._finest = means, finest_pixels(means, self._cameras)
        return smoothed_for_view(gaussians, view, self._finest[1], self._config.low_pass)

    def state(self) -> State:
        state = super().state()
        return State(state.tensors | {CAMERAS: self._cameras}, state.values)

    def load_state(self, state: State) -> None:
        super().load_state(state)
        self._cameras, self._finest = state.tensors[CAMERAS], None


def _hashed(seed: int, count: int, device: torch.device) -> Tensor:
    """Return pseudo-random integers [count] below 2^32, the same on each device, by the finalizer of MurmurHash3."""
    mixed = torch.arange(seed, seed + count, device=device)
    for factor, shift in ((0x9E3779B1, 16), (0x85EBCA6B, 13), (0xC2B2AE35, 16)):
        mixed = mixed * factor & 0xFFFFFFFF
        mixed = mixed ^ (mixed >> shift)
    return mixed
