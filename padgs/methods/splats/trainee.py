"""Training explicit Gaussians: splats, their learning rates, and their densification, as a trainee."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from padgs.gaussians import Gaussians
from padgs.geometry.panorama import longitude_latitude
from padgs.methods.splats.choice import Choice
from padgs.methods.splats.clone_split import MIN_DENSIFY_EVERY, CloneSplit, CloneSplitOptions
from padgs.methods.splats.model import Splats
from padgs.methods.splats.nearest import PixelFilter, cameras_of, finest_pixels, widened
from padgs.methods.splats.probes import render_probed
from padgs.render import RenderConfig, Rendering, RenderOptions, render
from padgs.render.contract import ALPHA_MIN
from padgs.render.projection import widened_scales
from padgs.scene import View
from padgs.training.model import Parts, Size, State, TrainingRender
from padgs.training.optimizer import keep_rows
from padgs.training.schedule import Constant, LogLinear, ParameterGroup, scaled
from padgs.training.worth import most_wanted, worth

VARIANCES = "filter/variances"  # of the filter, in a state
DEGREE_EVERY = 1000  # published iterations after which the next SH degree comes into use


class SplatTrainee:
    """Splats with the schedule of 3DGS for a run of `iterations`.

    Attributes:
        splats: the model.
        densifier: its growth.
        choice: of those that stay after it.
    """

    def __init__(
        self,
        splats: Splats,
        options: CloneSplitOptions,
        config: RenderConfig,
        *,
        extent: float,
        iterations: int,
        views: Sequence[View] = (),
        target: int | None = None,
        seed: int = 0,
        asked: int | str | None = None,
        removal_psnr: float | None = None,
        filter_pixels: float = 0.0,
    ) -> None:
        """Wrap splats.

        Args:
            splats: the model.
            options: of a published run, see `for_run`.
            config: how it is drawn.
            extent: of the scene, world units.
            iterations: of the run.
            views: of the training; without them there can be none.
            target: as `CloneSplit` has it.
            seed: of all that is random.
            asked, removal_psnr: as `Choice` has them.
            filter_pixels: variance of `padgs.methods.splats.nearest.PixelFilter`, square pixels; 0: there is none.
        """
        self.splats, self.iterations = splats, iterations
        self._config, self._views, self._extent = config, views, extent
        self.densifier = CloneSplit(
            splats,
            options.for_run(iterations),
            extent=extent,
            target=target,
            drawn_opacities=self._drawn_opacities,
            seed=seed,
        )
        self.choice = Choice(self.densifier.options, iterations, asked=asked, removal_psnr=removal_psnr)
        self._drawn: View | None = None  # the view of the last drawing
        self._filter = PixelFilter(filter_pixels, cameras_of(views)) if filter_pixels > 0 else None
        if self._filter is not None:
            self._filter.renew(splats.means)

    def groups(self, means_speed: float = 1.0) -> list[ParameterGroup]:
        """Learning rates of 3DGS; that of the means falls over the whole run and follows the size of the scene."""
        splats, speed = self.splats, means_speed * self._extent
        rates = {
            "means": LogLinear(1.6e-4 * speed, 1.6e-6 * speed, self.iterations),
            "quats": Constant(1e-3),
            "log_scales": Constant(5e-3),
            "opacity_logits": Constant(5e-2),
            "sh_dc": Constant(2.5e-3),
            "sh_rest": Constant(2.5e-3 / 20),
        }
        rows = splats.rows()
        return [ParameterGroup(name, (rows[name],), rate, is_of_rows=True) for name, rate in rates.items()]

    def draw(self, view: View, probe: Tensor | None = None) -> TrainingRender:
        """Render all Gaussians, differentiably.

        `probe` is that of another drawing of the same Gaussians, for views that are made of several.
        """
        self._drawn = view
        rendering, gaussians, probe = render_probed(
            self.splats,
            view,
            self.render_options(view),
            signal=self.densifier.options.signal,
            probe=probe,
            change=self._in_training,
            backend=self._config.backend,
        )
        return TrainingRender(rendering, probe, gaussians, torch.arange(len(probe), device=probe.device))

    def _in_training(self, gaussians: Gaussians) -> Gaussians:
        """All Gaussians as the next drawing of the training has them."""
        return gaussians if self._filter is None else self._filter(gaussians)

    def observe(self, drawing: TrainingRender, iteration: int) -> None:
        """Note how hard each Gaussian was pulled."""
        assert drawing.probe.grad is not None and self._drawn is not None, "observe is called after draw and backward"
        cos_latitudes = None
        if self.densifier.options.polar_threshold is not None:
            means, pose = self.splats.means, self._drawn.cam_from_world.to(self.splats.means)
            _, latitudes = longitude_latitude(means @ pose[:3, :3].T + pose[:3, 3])
            cos_latitudes = latitudes.cos()
        self.densifier.observe(drawing.probe.grad, drawing.rendering.visible, iteration, cos_latitudes)

    def adapt(self, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Densify, choose whom to keep, and bring the next SH degree into use, where it is time to."""
        events = self.densifier.adapt(iteration, optimizer, grows=self._has_seen_enough)
        if self.choice.is_due(iteration):
            events += self._chosen(optimizer)
        if self._filter is not None:
            events += self._filtered(self._filter, iteration, optimizer)
        degree = min(self.splats.degree, self.degree_at(iteration + 1))
        if degree > self.splats.active_degree:
            self.splats.active_degree = degree
            events += (f"spherical harmonics of degree {degree}",)
        return events

    def _has_seen_enough(self) -> bool:
        """Whether a round of growth has views enough behind it for their mean to say something.

        Where a schedule follows the clock, a round may come after few: it is left out, for growth on their noise would
        feed on itself, as larger models take fewer steps in the time.
        """
        if len(self.splats) == 0:  # which ends the run at the next drawing
            return False
        views = int(self.densifier.statistics["seen"].max())  # some Gaussian is seen by all
        return 2 * views >= min(self.densifier.options.densify_every, MIN_DENSIFY_EVERY)

    def _chosen(self, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Keep those that the training views would miss most; scored by as many as lie between two rounds."""
        grown, step = len(self.splats), math.ceil(len(self._views) / self.densifier.options.densify_every)
        found = worth(self, self._views[::step])
        kept = self.choice.count(found)
        keep_rows(self.splats.rows(), optimizer, most_wanted(found, kept))
        self.densifier.forget()
        self.choice.made = True
        return (f"kept {kept} of {grown} Gaussians, those that the training views would miss most",)

    def _filtered(self, pixels: PixelFilter, iteration: int, optimizer: torch.optim.Adam) -> tuple[str, ...]:
        """Renew the filter where rows have changed and at least once a round; at the end leave out what nobody sees."""
        splats, every = self.splats, self.densifier.options.densify_every
        if len(pixels.variances) == len(splats) and iteration % every and iteration < self.iterations:
            return ()
        pixels.renew(splats.means)
        if iteration < self.iterations:
            return ()
        seen, before = self._drawn_opacities() >= ALPHA_MIN, len(splats)
        keep_rows(splats.rows(), optimizer, seen)
        self.densifier.forget()
        pixels.renew(splats.means)
        return (f"left out {before - len(splats)} Gaussians that are too faint to be seen",)

    def degree_at(self, iteration: int) -> int:
        """The SH degree that is in use by then, if the model has it."""
        return iteration // scaled(DEGREE_EVERY, self.iterations)

    def counts(self) -> dict[str, int]:
        """Number of Gaussians."""
        return {"gaussians": len(self.splats)}

    def parts(self, view: View) -> Parts:
        """All Gaussians; each is a row."""
        slots = torch.arange(len(self.splats), device=self.splats.means.device)
        return Parts(self._shown(view), slots, 1, self.render_options(view))

    def keep(self, rows: Tensor) -> None:
        """Keep these Gaussians only."""
        keep_rows(self.splats.rows(), None, rows)
        self.densifier.statistics = {name: values[rows] for name, values in self.densifier.statistics.items()}
        if self._filter is not None:
            self._filter.variances = self._filter.variances[rows]

    def truncate(self, degree: int) -> None:
        """Leave out the harmonics above a degree; of all that has them, but no optimizer."""
        self.splats.truncate(degree)

    @torch.no_grad()
    def render(self, view: View) -> Rendering:
        """Render a view without gradients."""
        return render(self._shown(view), view, self.render_options(view), backend=self._config.backend)

    def _shown(self, view: View) -> Gaussians:
        """All Gaussians as a finished model shows them."""
        gaussians = self.splats.gaussians(view)
        return gaussians if self._filter is None else self._filter(gaussians)

    def baked(self) -> Splats:
        """The splats as a finished model shows them, for programs that know nothing of its filter."""
        return self.splats if self._filter is None else widened(self.splats, self._filter.variances)

    def size(self) -> Size:
        """Counts and bytes of the model."""
        return Size.of(self.counts(), self.splats.parameters(), stored=self.splats.parameters())

    def state(self) -> State:
        """Parameters, statistics, random state; not copies."""
        tensors = {f"splats/{name}": tensor for name, tensor in self.splats.state_dict().items()}
        tensors |= {f"statistics/{name}": tensor for name, tensor in self.densifier.statistics.items()}
        tensors["random/pieces"] = self.densifier.generator.get_state()
        if self._filter is not None:
            tensors[VARIANCES] = self._filter.variances
        values = {
            "active_degree": self.splats.active_degree,
            "degree": self.splats.degree,
            "unit": self.splats.unit,
            "extent": self._extent,
            "iterations": self.iterations,
            "has_chosen": self.choice.made,
        }
        return State(tensors, values)

    def load_state(self, state: State) -> None:
        """Become the model that `state` was taken of.

        Raises:
            ValueError: the state is of a model with other options.
        """
        self.load_model(state)
        device = self.splats.means.device
        self.densifier.statistics = {n: t.to(device, copy=True) for n, t in state.under("statistics/").items()}
        self.densifier.generator.set_state(state.tensors["random/pieces"].cpu())
        self.choice.made = state.values.get("has_chosen")
        if self._filter is not None:
            self._filter.variances = state.tensors[VARIANCES].to(device, copy=True)

    def load_model(self, state: State) -> None:
        """Take the splats alone, whose densification begins anew.

        Raises:
            ValueError: the state is of a model with other options.
        """
        self.splats.load(state.under("splats/"))
        self.splats.active_degree, self.splats.unit = state.values["active_degree"], state.values["unit"]
        self.densifier.forget()
        if self._filter is not None:
            self._filter.renew(self.splats.means)

    @torch.no_grad()
    def _drawn_opacities(self) -> Tensor:
        """Opacities [N] as the training camera with the finest pixel there draws them: filters in space lower them."""
        splats, pixels = self.splats, 0.0 if self._filter is None else self._filter.pixels
        if self._config.resolved_low_pass_kind == "solid":
            pixels += self._config.low_pass
        squared = finest_pixels(splats.means, cameras_of(self._views)).square()
        return torch.sigmoid(splats.opacity_logits) * widened_scales(splats.log_scales.exp(), pixels * squared)[1]

    def render_options(self, view: View) -> RenderOptions:
        """How a view is drawn."""
        return self._config.options(self.splats.unit)
