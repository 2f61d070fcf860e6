"""Explicit Gaussians in training: parameters, learning rates and densification as one trainable model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.methods.splats.densification import MIN_DENSIFY_EVERY, Densifier
from padgs.methods.splats.importance import PruningStep, importance_scores, most_important
from padgs.methods.splats.lengths import NEAREST_CAMERA, LocalLengths
from padgs.methods.splats.smoothing_filter import SmoothingFilter, cameras_of, finest_pixels, widened
from padgs.methods.splats.splats import Splats
from padgs.render import RenderConfig, Rendering, RenderOptions, render
from padgs.render.contract import ALPHA_MIN
from padgs.render.projection import widened_scales
from padgs.scene import View
from padgs.training.health import Failure
from padgs.training.model import Parts, Size, State, TrainingRender
from padgs.training.optimizer import keep_rows
from padgs.training.schedule import Constant, LogLinear, ParameterGroup, scaled

if TYPE_CHECKING:
    from padgs.methods.splats.method import SplatOptions

OFFSET_COLUMNS = {"image": 2, "space": 3, "space_absolute": 4}  # of `mean_offsets`, by positional gradient
FILTER_VARIANCES = "filter/variances"  # key in a state
LENGTHS = "lengths"  # key in a state
DEGREE_EVERY = 1000  # published iterations between two SH degrees


class SplatModel:
    """Splats with the schedule of 3DGS for a run of `iterations`; a `padgs.training.model.Model`.

    The `densifier` adds and removes Gaussians; `pruning` removes the least important once densification has ended.
    """

    def __init__(
        self,
        splats: Splats,
        options: SplatOptions,
        config: RenderConfig,
        *,
        extent: float,
        iterations: int,
        views: Sequence[View] = (),
        target: int | None = None,
        seed: int = 0,
        requested: int | str | None = None,
        prune_psnr: float | None = None,
    ) -> None:
        """Wrap splats for a run of `iterations`, with training `views` unless they are only rendered.

        `options` are those of a published run; `extent` is in world units; `target` as in `Densifier`; `requested` and
        `prune_psnr` as in `PruningStep`.
        """
        self.splats, self.options, self.iterations = splats, options, iterations
        self._config, self._views, self._extent = config, views, extent
        self._step = 0  # last step of the schedule
        self._lengths = LocalLengths(cameras_of(views)) if options.length_unit == NEAREST_CAMERA else None
        self.densifier = Densifier(
            splats,
            options.for_run(iterations),
            extent=extent,
            target=target,
            extents=None if self._lengths is None else self._lengths.at,
            rendered_opacities=self._rendered_opacities,
            seed=seed,
        )
        self.pruning = PruningStep(self.densifier.options, requested=requested, prune_psnr=prune_psnr)
        variance = options.smoothing_filter
        self._filter = SmoothingFilter(variance, cameras_of(views)) if variance > 0 else None
        parts: dict[str, Any] = {FILTER_VARIANCES: self._filter, LENGTHS: self._lengths}
        self._measured = {name: part for name, part in parts.items() if part is not None}
        self.follow(iterations)

    def groups(self) -> list[ParameterGroup]:
        """Return the learning rates of 3DGS; that of the means decays over the run and scales with `length_unit`."""
        splats, lengths = self.splats, self._lengths
        factor = self.options.means_rate_factor * (self._extent if lengths is None else 1.0)
        rates = {
            "means": LogLinear(1.6e-4 * factor, 1.6e-6 * factor, self.iterations),
            "quats": Constant(1e-3),
            "log_scales": Constant(5e-3),
            "opacity_logits": Constant(5e-2),
            "sh_dc": Constant(2.5e-3),
            "sh_rest": Constant(2.5e-3 / 20),
        }
        of_rows = None if lengths is None else lambda: lengths.values
        own = {"means": {"least_pace": self.options.means_least_pace, "row_rates": of_rows}}
        rows = splats.rows()
        return [ParameterGroup(name, (rows[name],), rate, **own.get(name, {})) for name, rate in rates.items()]

    def draw(self, view: View, mean_offsets: Tensor | None = None) -> TrainingRender:
        """Render all Gaussians, differentiably; `mean_offsets` of another render get the sum of both gradients."""
        splats, kind = self.splats, self.densifier.options.positional_gradient
        offsets = mean_offsets
        # Later the gradients of offsets are not used. A warm start begins after the last step.
        observes = self._step % self.iterations + 1 < self.densifier.options.densify_until
        if offsets is None:
            offsets = splats.means.new_zeros(len(splats), OFFSET_COLUMNS[kind], requires_grad=observes)
        gaussians, absolute = splats.displaced(view, offsets if observes and kind != "image" else None)
        gaussians, options = self._training_gaussians(gaussians), self.render_options(view)
        if kind == "image":
            rendering = self._rendered(gaussians, view, options, mean_offsets=offsets)
        else:
            rendering = self._rendered(gaussians, view, options, absgrad=absolute)
        slots = torch.arange(len(offsets), device=offsets.device)
        return TrainingRender(rendering, offsets, gaussians, slots)

    def _rendered(self, gaussians: Gaussians, view: View, options: RenderOptions, **offsets: Any) -> Rendering:
        return render(gaussians, view, options, backend=self._config.backend, **offsets)

    def _training_gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians as the next training render has them."""
        return gaussians if self._filter is None else self._filter(gaussians)

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        gradient = drawing.mean_offsets.grad
        assert gradient is not None or not drawing.mean_offsets.requires_grad, "observe is called after backward"
        if gradient is not None:
            self.densifier.observe(gradient, drawing.rendering.visible, iteration)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Densify, prune by importance, and activate the next SH degree, each when it is due."""
        self._step = iteration
        events = self.densifier.adapt(iteration, optimizer, grows=self._has_enough_views)
        if self.pruning.is_due(iteration):
            events += self._prune(optimizer)
        self.follow(iteration)
        if self._filter is not None and iteration >= self.iterations:
            events += self._prune_invisible(self._filter, optimizer)
        degree = min(self.splats.degree, self.degree_at(iteration + 1))
        if degree > self.splats.active_degree:
            self.splats.active_degree = degree
            events += (f"spherical harmonics of degree {degree}",)
        return events

    def _has_enough_views(self) -> bool:
        """Return whether gradients are over enough views; by the clock, a round may come after few, and is skipped."""
        if len(self.splats) == 0:  # the next render ends the run
            return False
        views = int(self.densifier.statistics["seen"].max())  # some Gaussian is seen by all
        return 2 * views >= min(self.densifier.options.densify_every, MIN_DENSIFY_EVERY)

    def _prune(self, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Keep the most important Gaussians, scored on about as many training views as a round has iterations."""
        before, step = len(self.splats), math.ceil(len(self._views) / self.densifier.options.densify_every)
        scores = importance_scores(self, self._views[::step])
        kept = self.pruning.count(scores)
        keep_rows(self.splats.rows(), optimizer, most_important(scores, kept))
        self.densifier.reset_statistics()
        self.pruning.done = True
        return (f"pruned the least important of {before} Gaussians, kept {kept}",)

    def follow(self, iteration: int) -> None:
        """Let filter and lengths follow the means: after rows changed, at least once a round, and at the end."""
        is_due = iteration >= self.iterations or iteration % self.densifier.options.densify_every == 0
        for part in self._measured.values():
            if is_due or len(part.values) != len(self.splats):
                part.update(self.splats.means)

    def _prune_invisible(self, smooth: SmoothingFilter, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        splats = self.splats
        visible, before = self._rendered_opacities() >= ALPHA_MIN, len(splats)
        if not visible.any():
            raise Failure("collapsed", f"all {before} Gaussians are invisible at the end of the run")
        keep_rows(splats.rows(), optimizer, visible)
        self.densifier.reset_statistics()
        smooth.update(splats.means)
        return (f"pruned {before - len(splats)} invisible Gaussians",)

    def degree_at(self, iteration: int) -> int:
        """Return the SH degree scheduled for an iteration, if the model has it."""
        return iteration // scaled(DEGREE_EVERY, self.iterations)

    def counts(self) -> dict[str, int]:
        return {"gaussians": len(self.splats)}

    def parts(self, view: View) -> Parts:
        """Return all Gaussians; each is a row."""
        slots = torch.arange(len(self.splats), device=self.splats.means.device)
        return Parts(self._final_gaussians(view), slots, 1, self.render_options(view))

    def keep(self, rows: Tensor) -> None:
        keep_rows(self.splats.rows(), None, rows)
        self.densifier.statistics = {name: values[rows] for name, values in self.densifier.statistics.items()}
        for part in self._measured.values():
            part.values = part.values[rows]

    def prune(self, count: int, views: Sequence[View]) -> None:
        self.keep(most_important(importance_scores(self, views), count))

    @torch.no_grad()
    def render(self, view: View) -> Rendering:
        return self._rendered(self._final_gaussians(view), view, self.render_options(view))

    def _final_gaussians(self, view: View) -> Gaussians:
        """Return the Gaussians as a finished model renders them."""
        gaussians = self.splats.gaussians(view)
        return gaussians if self._filter is None else self._filter(gaussians)

    def baked(self) -> Splats:
        """Return splats with the smoothing filter applied, for programs that have no such filter."""
        return self.splats if self._filter is None else widened(self.splats, self._filter.values)

    def size(self) -> Size:
        return Size.of(self.counts(), self.splats.parameters(), stored=self.splats.parameters())

    def state(self) -> State:
        """Return parameters, statistics and random state; not copies."""
        tensors = {f"splats/{name}": tensor for name, tensor in self.splats.state_dict().items()}
        tensors |= {f"statistics/{name}": tensor for name, tensor in self.densifier.statistics.items()}
        tensors["random/pieces"] = self.densifier.generator.get_state()
        tensors |= {name: part.values for name, part in self._measured.items()}
        values = {
            "active_degree": self.splats.active_degree,
            "degree": self.splats.degree,
            "scene_scale": self.splats.scene_scale,
            "extent": self._extent,
            "iterations": self.iterations,
            "pruned": self.pruning.done,
            "step": self._step,
        }
        return State(tensors, values)

    def load_state(self, state: State) -> None:
        self.load_model(state)
        device = self.splats.means.device
        self.densifier.statistics = {n: t.to(device, copy=True) for n, t in state.under("statistics/").items()}
        self.densifier.generator.set_state(state.tensors["random/pieces"].cpu())
        self.pruning.done, self._step = state.values["pruned"], state.values["step"]
        for name, part in self._measured.items():
            part.values = state.tensors[name].to(device, copy=True)

    def load_model(self, state: State) -> None:
        """Load the parameters only, as those of a finished schedule until `adapt` says otherwise."""
        self.splats.load(state.under("splats/"))
        self.splats.active_degree = state.values["active_degree"]
        self.splats.scene_scale = state.values["scene_scale"]
        self._step = self.iterations
        self.densifier.reset_statistics()
        self.follow(self.iterations)

    @torch.no_grad()
    def _rendered_opacities(self) -> Tensor:
        """Return opacities [N] as rendered by the training camera with the finest pixel; 3D filters lower them."""
        splats, cameras = self.splats, cameras_of(self._views)
        added = 0.0 if self._filter is None else self._filter.square_pixels
        variances = added * finest_pixels(splats.means, cameras).square()
        if self._config.resolved_low_pass_kind == "solid":
            low_pass = torch.tensor([self.render_options(view).low_pass for view in self._views]).to(cameras)
            cameras[:, 3] *= self._samples / low_pass.sqrt()  # the low-pass of a sample is one square pixel now
            variances = variances + finest_pixels(splats.means, cameras).square()
        return torch.sigmoid(splats.opacity_logits) * widened_scales(splats.log_scales.exp(), variances)[1]

    @property
    def _samples(self) -> int:
        """Samples along each side of a pixel at this step of the schedule."""
        begins = self.options.supersampling_from * self.iterations
        return 1 if self._step < begins else self._config.supersampling

    def render_options(self, view: View) -> RenderOptions:
        """Return the renderer options for a view."""
        return replace(self._config.options(self.splats.scene_scale), supersampling=self._samples)
